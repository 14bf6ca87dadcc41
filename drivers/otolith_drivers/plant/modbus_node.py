"""The simulated machine as a Modbus drive in real time, on a port (TCP) or on a serial line of its own (RTU)."""

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
from collections.abc import Callable, Coroutine, Iterator
from typing import Any

from pymodbus import FramerType

from otolith_drivers.errors import DeviceError
from otolith_drivers.plant.modbus_drive import Drive, Server
from otolith_drivers.plant.pace import in_real_time
from otolith_drivers.plant.registers import RegisterMap
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.serial_line import LineTransport, SerialLine, default_link
from otolith_drivers.plant.summary import Summary
from otolith_drivers.plant.truth import TruthFile

SWITCH_INTERVAL = 2e-4  # s; how long the machine's equations may keep a request waiting
PATIENCE = 30.0  # s; with the server's thread


class _ModbusNode(ABC):
    """Implements :class:`otolith_drivers.plant.nodes.Node` over pymodbus, whose server has a thread of its own."""

    FRAMER: FramerType

    def __init__(self, scenario: Scenario, *, alone: bool) -> None:
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # what it would say of requests is counted
        self._scenario = scenario
        self._map = RegisterMap(scenario.modbus, scenario.SIGNALS)
        self._drive = Drive(scenario.modbus, self._map, alone=alone)
        self._server: Server | None = None

    def title(self) -> str:
        """See :meth:`otolith_drivers.plant.nodes.Node.title`."""
        options, units = self._scenario.modbus, self._scenario.SIGNALS
        registers = [f"{address} {name} [{units[name]}]" for name, address in self._map.addresses.items()]
        what = f"{self._scenario.plant} on {self._where()}, device {options.device}, {options.type} {options.order}"
        return f"{what}: {', '.join(registers)}, {self._map.counter} tick counter"

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> Summary:
        """See :meth:`otolith_drivers.plant.nodes.Node.run`."""
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
        """See :meth:`otolith_drivers.plant.nodes.Node.close`."""

    def say(self, done: Summary) -> str:
        """See :meth:`otolith_drivers.plant.nodes.Node.say`."""
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
        """See :meth:`otolith_drivers.plant.nodes.Node.close`."""
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
        """See :meth:`otolith_drivers.plant.nodes.Node.close`."""
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
