"""The simulated machine as a Modbus drive in real time, on a port (TCP) or on a serial line of its own (RTU).

What a simulated machine answers as a Modbus device: its registers at the latest tick, and nothing that writes.

pymodbus speaks: frames, checksums, limits of requests. Here is what the device makes of a request that is one.
"""

import asyncio
import contextlib
import errno
import logging
import math
import os
import socket
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from dataclasses import dataclass
from typing import Any

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from otolith_drivers.errors import DeviceError
from otolith_drivers.plant.faults import Effect
from otolith_drivers.plant.pseudo_terminal import LineTransport, SerialLine, default_link
from otolith_drivers.plant.realtime import Summary, TruthFile, Turn, in_real_time
from otolith_drivers.plant.register_map import ModbusOptions, RegisterMap
from otolith_drivers.plant.scenario import Scenario

READS = frozenset({3, 4})  # holding and input registers: the functions that are answered
UNREADABLE = 0  # stands for the function of a request that cannot be decoded


@dataclass(frozen=True, slots=True)
class _ConnectionState:
    """What the device is between two ticks; put in place of the one before as a whole."""

    registers: list[int]
    effect: Effect


class ModbusDrive:
    """The device. Its ticks come from one thread and its requests from another, the only one that counts requests."""

    def __init__(self, options: ModbusOptions, registers: RegisterMap, *, alone: bool) -> None:
        """``alone``: who asks for another device hears that there is none; else it is for others on the line to say."""
        self._options, self._map, self._alone = options, registers, alone
        self._state = _ConnectionState([0] * registers.size, Effect())
        self._done = Summary({})

    def begin(self, done: Summary) -> None:
        """Count in ``done`` from now on."""
        self._done = done

    def live(self, turn: Turn) -> None:
        """Take over a tick, all registers at once."""
        order = turn.effect.order or self._options.order
        registers = self._map.encode(turn.tick.measured, turn.index, order)
        self._state = _ConnectionState(registers, turn.effect)

    def device(self) -> SimDevice:
        """For pymodbus, which asks :meth:`answer` before it looks here."""

        async def refresh(
            _function: int, _start: int, _address: int, _count: int, registers: list[int], values: object
        ) -> ExcCodes | None:
            if values is not None:
                return ExcCodes.ILLEGAL_FUNCTION
            registers[: self._map.size] = self._state.registers
            return None

        data = SimData(0, values=[0] * self._map.size, datatype=DataType.REGISTERS, readonly=True)
        return SimDevice(id=self._options.device, simdata=[data], action=refresh)

    async def answer(self, request: ModbusPDU, context: Any) -> ModbusPDU | None:
        """To ``request``, or None for silence; ``context`` is pymodbus' own."""
        function = request.function_code
        if not (state := self._heard(request.dev_id, function)):
            return None
        if request.dev_id != self._options.device:
            return ExceptionResponse(function, ExcCodes.GATEWAY_NO_RESPONSE)
        if function not in READS:
            self._done.refused[function] += 1
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        for number, refusal in state.effect.refusals:
            if refusal.concerns(request.address, request.count):
                self._done.faults[number].refused += 1
                return ExceptionResponse(function, refusal.code)
        return await request.datastore_update(context, request.dev_id)

    def refuses_unreadable(self, device: int) -> bool:
        """Whether to say that a request cannot be decoded."""
        if not self._heard(device, UNREADABLE):
            return False
        self._done.refused[UNREADABLE] += 1
        return True

    def answered(self) -> None:
        """Another answer is on its way."""
        self._done.answers += 1

    def _heard(self, device: int, function: int) -> _ConnectionState | None:
        """The state that answers a request; None if it stays unanswered. Either is counted."""
        state = self._state
        if device != self._options.device and not self._alone:
            return None
        self._done.functions[function] += 1
        if state.effect.withheld is not None:
            self._done.faults[state.effect.withheld].withheld += 1
            return None
        return state


class Conversation(ServerRequestHandler):
    """With one client, or with all on a line."""

    server: "Server"

    def __init__(self, server: "Server") -> None:
        """For one who has come."""
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call] # pymodbus does not say

    async def handle_request(self) -> None:
        """Answer what has come, or be silent."""
        request = self.last_pdu
        if request is None or (response := await self.server.drive.answer(request, self.server.context)) is None:
            return
        response.transaction_id, response.dev_id = request.transaction_id, request.dev_id
        self._say(response)

    def server_send(self, pdu: ModbusPDU, addr: tuple[Any, ...] | None) -> None:
        """What pymodbus itself answers: to a request that it cannot decode."""
        if self.server.drive.refuses_unreadable(pdu.dev_id):
            self._say(pdu)

    def disturb(self, data: bytes) -> None:
        """Put bytes on the line that are no answer."""
        if self.transport is not None:
            self.send(data)

    def _say(self, response: ModbusPDU) -> None:
        if self.transport is None:  # the client has gone meanwhile
            return
        self.server.drive.answered()
        self.pdu_send(response)


class Server(ModbusTcpServer):
    """A server of pymodbus that answers what ``drive`` does, on whatever ``attach`` makes."""

    def __init__(self, drive: ModbusDrive, framer: FramerType) -> None:
        """To be made where its event loop runs."""
        super().__init__(drive.device(), framer=framer)
        self.drive = drive

    async def begin(self, attach: Callable[[], Awaitable[Any]]) -> None:
        """Serve what ``attach`` makes: a listening server, or a transport and its protocol."""
        self.call_create = attach  # type: ignore[assignment]  # declared as what its own constructor gives
        await self.serve_forever(background=True)

    def callback_new_connection(self) -> Conversation:
        """For a client that has come."""
        return Conversation(self)

    def disturb(self, data: bytes) -> None:
        """Put bytes on all lines that are no answer."""
        for conversation in self.active_connections.values():
            if isinstance(conversation, Conversation):
                conversation.disturb(data)


SWITCH_INTERVAL = 2e-4  # s; how long the machine's equations may keep a request waiting
PATIENCE = 30.0  # s; with the server's thread


class _ModbusNode(ABC):
    """Implements :class:`otolith_drivers.plant.realtime.Node` over pymodbus, whose server has a thread of its own."""

    FRAMER: FramerType

    def __init__(self, scenario: Scenario, *, alone: bool) -> None:
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what it would say of requests is counted
        self._scenario = scenario
        self._map = RegisterMap(scenario.modbus, scenario.SIGNALS)
        self._drive = ModbusDrive(scenario.modbus, self._map, alone=alone)
        self._server: Server | None = None

    def title(self) -> str:
        """See :meth:`otolith_drivers.plant.realtime.Node.title`."""
        options, units = self._scenario.modbus, self._scenario.SIGNALS
        registers = [f"{address} {name} [{units[name]}]" for name, address in self._map.addresses.items()]
        what = f"{self._scenario.plant} on {self._where()}, device {options.device}, {options.type} {options.order}"
        return f"{what}: {', '.join(registers)}, {self._map.counter} tick counter"

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> Summary:
        """See :meth:`otolith_drivers.plant.realtime.Node.run`."""
        done = Summary.of(self._scenario.faults)
        self._drive.begin(done)
        with _quick_switches(), _Loop() as loop:
            try:
                for turn in in_real_time(self._scenario, done, stopped, duration):
                    self._drive.live(turn)
                    self._be_there(loop, there=not (turn.effect.gone and self._vanishes()))
                    for data in turn.effect.garbage:
                        loop.call(self._disturb, data)
                    if truth is not None:
                        truth.note(turn)
            finally:
                self._be_there(loop, there=False)
        return done

    @abstractmethod
    def close(self) -> None:
        """See :meth:`otolith_drivers.plant.realtime.Node.close`."""

    def say(self, done: Summary) -> str:
        """See :meth:`otolith_drivers.plant.realtime.Node.say`."""
        functions = ", ".join(f"{count} of function {code}" for code, count in sorted(done.functions.items()))
        return (
            f"{done.answers} answers to {done.functions.total()} requests ({functions or 'none'}), "
            f"{done.refused.total()} refused, {done.withheld} withheld, "
            f"in {done.seconds:.1f} s of simulated time, {done.stalls} stalls"
        )

    @abstractmethod
    def _where(self) -> str:
        """In words."""

    @abstractmethod
    def _vanishes(self) -> bool:
        """Whether a client can see from the line alone that the device is gone."""

    @abstractmethod
    async def _attach(self, server: Server) -> Any:
        """The line, as pymodbus wants it."""

    def _be_there(self, loop: "_Loop", *, there: bool) -> None:
        if there and self._server is None:
            self._prepare()
            self._server = loop.wait_for(self._begin())
        elif not there:
            if self._server is not None:
                server, self._server = self._server, None
                loop.wait_for(_end(server))
            self._withdraw()

    @abstractmethod
    def _prepare(self) -> None:
        """Whatever may fail before the server can begin."""

    @abstractmethod
    def _withdraw(self) -> None:
        """Nothing is left that a client could see, if the device vanishes at all."""

    async def _begin(self) -> Server:
        server = Server(self._drive, self.FRAMER)
        await server.begin(lambda: self._attach(server))
        return server

    def _disturb(self, data: bytes) -> None:
        if self._server is not None:
            self._server.disturb(data)


class TcpNode(_ModbusNode):
    """On a port."""

    FRAMER = FramerType.SOCKET

    def __init__(self, scenario: Scenario) -> None:
        """Take the port.

        Raises:
            DeviceError: it is in use, or may not be used.
        """
        super().__init__(scenario, alone=True)
        self._socket: socket.socket | None = self._listen()

    def close(self) -> None:
        """See :meth:`otolith_drivers.plant.realtime.Node.close`."""
        self._withdraw()

    def _where(self) -> str:
        return f"Modbus TCP {self._scenario.modbus.host}:{self._scenario.modbus.port}"

    def _vanishes(self) -> bool:
        return True

    def _prepare(self) -> None:
        if self._socket is None:
            self._socket = self._listen()

    def _withdraw(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def _attach(self, server: Server) -> Any:
        listening, self._socket = self._socket, None  # asyncio closes it with the server
        assert listening is not None  # noqa: S101 - it has just been prepared
        return await asyncio.get_running_loop().create_server(server.handle_new_connection, sock=listening)

    def _listen(self) -> socket.socket:
        host, port = self._scenario.modbus.host, self._scenario.modbus.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            return socket.create_server((host, port), family=family)
        except (OSError, UnicodeError) as error:
            number = error.errno if isinstance(error, OSError) else None
            cause = os.strerror(number) if number is not None and number in errno.errorcode else str(error)
            raise DeviceError(
                f"{self._where()} cannot be listened on: {cause}; is a second plant running? Stop it, "
                "or set modbus.port (and modbus.host) in the scenario"
            ) from error


class RtuNode(_ModbusNode):
    """On a serial line that ends here and in a file which a client opens like ``/dev/ttyUSB0``."""

    FRAMER = FramerType.RTU

    def __init__(self, scenario: Scenario) -> None:
        """Make the line.

        Raises:
            DeviceError: its name is taken, or the kernel has no terminal left.
        """
        super().__init__(scenario, alone=False)
        self._line = SerialLine(scenario.modbus.line or default_link())

    def close(self) -> None:
        """See :meth:`otolith_drivers.plant.realtime.Node.close`."""
        self._line.close()

    def _where(self) -> str:
        options = self._scenario.modbus
        pace = "8N1" if options.pace_line else "without timing"
        return f"Modbus RTU {self._line.link} ({options.baudrate} baud, {pace})"

    def _vanishes(self) -> bool:
        return False

    def _prepare(self) -> None:
        return

    def _withdraw(self) -> None:
        return

    async def _attach(self, server: Server) -> Any:
        options = self._scenario.modbus
        conversation = server.handle_new_connection()
        transport = LineTransport(self._line.ours, conversation, options.baudrate if options.pace_line else math.inf)
        conversation.connection_made(transport)
        return transport, conversation


async def _end(server: Server) -> None:
    await server.shutdown()  # type: ignore[no-untyped-call] # pymodbus does not say
    await asyncio.sleep(0)  # connections close in the next round of the loop


class _Loop:
    """An event loop in a thread."""

    def __enter__(self) -> "_Loop":
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="modbus-serve", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE)
        self._loop.close()

    def call(self, function: Callable[..., None], *arguments: object) -> None:
        """In the loop, soon."""
        self._loop.call_soon_threadsafe(function, *arguments)

    def wait_for(self, work: Coroutine[Any, Any, Any]) -> Any:
        """What ``work`` gives, done in the loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE)


@contextlib.contextmanager
def _quick_switches() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
