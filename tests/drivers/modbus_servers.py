"""Modbus servers for tests: pymodbus's own, and one that can misbehave."""

import asyncio
import socket
import socketserver
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count, groupby
from typing import Any

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from tests.conftest import free_port
from tests.waiting import PATIENCE

Words = dict[int, int]


@contextmanager
def library_server(words: Words, moving: Callable[[int], Words] | None = None) -> Iterator[int]:
    """Pymodbus serving ``words`` (by address) as device 1; the port.

    A request for any other register is refused. ``moving`` takes the first address of each request and returns its new
    words.
    """
    port = free_port(socket.SOCK_STREAM)

    async def before(_: int, start: int, *others: Any) -> None:
        registers = others[2]  # from ``start`` on; after the address and length of the request
        for at, word in moving(start).items() if moving else ():
            registers[at - start] = word

    blocks = [list(run) for _, run in groupby(sorted(words), key=_place_less_rank())]
    data = [SimData(run[0], values=[words[at] for at in run], datatype=DataType.REGISTERS) for run in blocks]
    device = SimDevice(id=1, simdata=data, action=before)
    loop, up = asyncio.new_event_loop(), threading.Event()
    servers: list[ModbusTcpServer] = []

    async def serve() -> None:
        server = ModbusTcpServer(device, address=("127.0.0.1", port))
        servers.append(server)
        await server.serve_forever(background=True)
        up.set()
        await server.serving

    thread = threading.Thread(target=loop.run_until_complete, args=(serve(),), name="server")
    thread.start()
    assert up.wait(PATIENCE)
    try:
        yield port
    finally:
        ending = servers[0].shutdown()  # type: ignore[no-untyped-call]
        asyncio.run_coroutine_threadsafe(ending, loop).result(PATIENCE)
        thread.join(5.0)
        loop.close()


def _place_less_rank() -> Callable[[int], int]:
    """A key that is equal for adjacent addresses, if it is called for all of them in order."""
    rank = count()
    return lambda address: address - next(rank)


@dataclass
class Behaviour:
    """How a server answers; tests change it while it serves."""

    words: Words
    refuse: Callable[[int, int, int], int | None] = lambda device, address, count: None
    """Takes device, address and count; returns an exception code, None to answer."""
    silent: Callable[[int], bool] = lambda device: False
    """Whether a device does not answer."""
    corrupt: Callable[[bytes], bytes] = lambda reply: reply
    """Takes a reply and returns the bytes to send."""
    closes: bool = False
    """Whether the server closes the connection after each answer."""
    functions: list[int] = field(default_factory=list)
    """Function codes of all requests."""
    asked: list[tuple[int, int, int, int]] = field(default_factory=list)
    """Device, function code, address and count of each request."""


class _Handler(socketserver.BaseRequestHandler):
    server: "OddServer"

    def handle(self) -> None:
        self.server.connections.add(self.request)
        try:
            while header := self._exactly(7):
                transaction, _, length, device = struct.unpack(">HHHB", header)
                self._answer(transaction, device, self._exactly(length - 1))
        except OSError:
            self.request.close()
        finally:
            self.server.connections.discard(self.request)

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self.request.recv(count - len(data))
            if not part:
                return b""
            data += part
        return data

    def _answer(self, transaction: int, device: int, request: bytes) -> None:
        behaviour = self.server.behaviour
        function, address, count = struct.unpack(">BHH", request[:5])
        behaviour.functions.append(function)
        behaviour.asked.append((device, function, address, count))
        if behaviour.silent(device):
            return
        code = behaviour.refuse(device, address, count)
        if code is not None:
            body = bytes([function | 0x80, code])
        elif function in {1, 2}:
            bits = sum(bool(behaviour.words.get(address + at, 0)) << at for at in range(count))
            body = bytes([function, (count + 7) // 8]) + bits.to_bytes((count + 7) // 8, "little")
        else:
            words = [behaviour.words.get(at, 0) for at in range(address, address + count)]
            body = bytes([function, 2 * count]) + struct.pack(f">{count}H", *words)
        reply = struct.pack(">HHHB", transaction, 0, len(body) + 1, device) + body
        self.request.sendall(behaviour.corrupt(reply))
        if behaviour.closes:
            raise ConnectionAbortedError


class OddServer(socketserver.ThreadingTCPServer):
    """A server that serves each connection in its own thread."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, port: int, behaviour: Behaviour) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.behaviour = behaviour
        self.connections: set[Any] = set()


@contextmanager
def odd_server(behaviour: Behaviour, port: int) -> Iterator["OddServer"]:
    """A server on ``port`` with this behaviour; its connections are closed at the end."""
    server = OddServer(port, behaviour)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), name="odd-server")
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        for connection in list(server.connections):
            connection.close()
        server.server_close()
        thread.join(5.0)
