"""The simulated machine as a Modbus drive in real time, on a TCP port or on a simulated serial line (RTU).

pymodbus handles frames, checksums and limits of requests in a thread of its own; :class:`ModbusDrive` answers valid
requests from the registers of the latest sample. Nothing can be written.
"""

import asyncio
import contextlib
import errno
import logging
import math
import os
import pty
import socket
import sys
import tempfile
import threading
import tty
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import ModbusProtocol

from otolith_drivers.errors import DeviceError
from otolith_drivers.plant.faults import BusEffect
from otolith_drivers.plant.realtime import Node, NodeSummary, ScheduledSample
from otolith_drivers.plant.scenario import NodeModbusOptions, RegisterMap, Scenario

READ_FUNCTIONS = frozenset({3, 4})  # holding and input registers: the functions that are answered
UNDECODABLE = 0  # function code under which requests are counted that cannot be decoded
# Engineering choice: 1/25 of Python's default, so that the simulation delays an answer by less than a millisecond.
# No test guards it.
SWITCH_INTERVAL = 2e-4  # s
SERVER_TIMEOUT = 30.0  # s; engineering choice; a hanging server thread ends with an error instead of a hanging node
BITS_PER_BYTE = 10  # 8N1: start, eight of data, stop
# End of a frame by the Modbus serial line specification: a silence of 3.5 characters, 1.75 ms above 19200 baud.
SILENCE = 3.5  # bytes
MIN_SILENCE = 1.75e-3  # s
# Engineering choices; test_modbus_node.py guards the second.
UNPACED_SILENCE = 0.05  # s; end of a frame on a line without timing: longer than a pause within a write
WRITE_INTERVAL = 1e-3  # s; bytes are written in pieces of this length, the resolution of the event loop's clock
MAX_READ = 4096  # bytes; the kernel buffers no more for a terminal
DEFAULT_NAME = "ttyOtolith"


@dataclass(frozen=True, slots=True)
class _DriveState:
    """The device between two samples; replaced as a whole, so a read never mixes two samples."""

    registers: list[int]
    effect: BusEffect
    summary: NodeSummary  # In which requests are counted


class ModbusDrive:
    """The device. One thread updates it; another one, that of the server, answers and counts requests."""

    def __init__(self, options: NodeModbusOptions, registers: RegisterMap, *, point_to_point: bool) -> None:
        """With ``point_to_point`` a request to another device is refused; on a shared line it stays unanswered."""
        self._options, self._map, self._point_to_point = options, registers, point_to_point
        self._state = _DriveState([0] * registers.size, BusEffect(), NodeSummary({}))

    def update(self, scheduled: ScheduledSample, summary: NodeSummary) -> None:
        """Replace all registers at once by those of a sample; requests are counted in ``summary``."""
        order = scheduled.effect.order or self._options.order
        registers = self._map.encode(scheduled.sample.measured, scheduled.index, order)
        self._state = _DriveState(registers, scheduled.effect, summary)

    def device(self) -> SimDevice:
        """The device for pymodbus, which reads it after :meth:`answer` has admitted a request."""

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
        """The answer to ``request``, or None for no answer; ``context`` is that of pymodbus."""
        function = request.function_code
        if not (state := self._state_for(request.dev_id, function)):
            return None
        if request.dev_id != self._options.device:
            return ExceptionResponse(function, ExcCodes.GATEWAY_NO_RESPONSE)
        if function not in READ_FUNCTIONS:
            state.summary.refused[function] += 1
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        for number, refusal in state.effect.refusals:
            if refusal.concerns(request.address, request.count):
                state.summary.faults[number].refused += 1
                return ExceptionResponse(function, refusal.code)
        return await request.datastore_update(context, request.dev_id)

    def refuses_undecodable(self, device: int) -> bool:
        """Whether a request that cannot be decoded gets an exception; counts it."""
        if not (state := self._state_for(device, UNDECODABLE)):
            return False
        state.summary.refused[UNDECODABLE] += 1
        return True

    def count_answer(self) -> None:
        """Count another answer."""
        self._state.summary.answers += 1

    def _state_for(self, device: int, function: int) -> _DriveState | None:
        """The state that answers a request, or None if it stays unanswered; counts the request."""
        state = self._state
        if device != self._options.device and not self._point_to_point:
            return None
        state.summary.functions[function] += 1
        if state.effect.withheld is not None:
            state.summary.faults[state.effect.withheld].withheld += 1
            return None
        return state


class DriveRequestHandler(ServerRequestHandler):
    """Handles the requests of one TCP client, or of all clients on a serial line."""

    server: "DriveServer"

    def __init__(self, server: "DriveServer") -> None:
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call] # untyped in pymodbus

    async def handle_request(self) -> None:
        """Answer the latest request; called by pymodbus."""
        request = self.last_pdu
        if request is None or (response := await self.server.drive.answer(request, self.server.context)) is None:
            return
        response.transaction_id, response.dev_id = request.transaction_id, request.dev_id
        self._respond(response)

    def server_send(self, pdu: ModbusPDU, addr: tuple[Any, ...] | None) -> None:
        """Send the exception of pymodbus for a request that it cannot decode; called by pymodbus."""
        if self.server.drive.refuses_undecodable(pdu.dev_id):
            self._respond(pdu)

    def _respond(self, response: ModbusPDU) -> None:
        if self.transport is not None:  # None if the client has disconnected
            self.server.drive.count_answer()
            self.pdu_send(response)


Attach = Callable[["DriveServer"], Awaitable[Any]]  # Returns a listening server, or transport and protocol


class DriveServer(ModbusTcpServer):
    """A server of pymodbus that answers for ``drive``, on TCP or a serial line."""

    def __init__(self, drive: ModbusDrive, framer: FramerType) -> None:
        """Must be called in the event loop of the server."""
        super().__init__(drive.device(), framer=framer)
        self.drive = drive

    async def start(self, attach: Attach) -> "DriveServer":
        """Serve the line of ``attach`` in the background."""
        self.call_create = lambda: attach(self)  # type: ignore[assignment,return-value]  # typed by its own constructor
        await self.serve_forever(background=True)
        return self

    async def stop(self) -> None:
        """Close the line and all connections."""
        await self.shutdown()  # type: ignore[no-untyped-call] # untyped in pymodbus
        await asyncio.sleep(0)  # connections close in the next iteration of the loop

    def callback_new_connection(self) -> DriveRequestHandler:
        """A handler for a new client; called by pymodbus."""
        return DriveRequestHandler(self)

    def send_garbage(self, data: bytes) -> None:
        """Send bytes that are no answer on all connections."""
        for handler in self.active_connections.values():
            if isinstance(handler, DriveRequestHandler) and handler.transport is not None:
                handler.send(data)


class _ModbusNode(Node):
    """A node over a server of pymodbus."""

    FRAMER: ClassVar[FramerType]
    CLOSES_WHEN_GONE: ClassVar[bool]  # Whether the line itself disappears with the device

    def __init__(self, scenario: Scenario, *, point_to_point: bool) -> None:
        logging.getLogger("pymodbus").setLevel(
            logging.CRITICAL
        )  # it warns of each wrong request; they are counted here
        super().__init__(scenario)
        self._map = RegisterMap(scenario.modbus, scenario.SIGNALS)
        self._drive = ModbusDrive(scenario.modbus, self._map, point_to_point=point_to_point)
        self._server: DriveServer | None = None

    def title(self) -> str:
        options, units = self._scenario.modbus, self._scenario.SIGNALS
        registers = [f"{address} {name} [{units[name]}]" for name, address in self._map.addresses.items()]
        what = f"{self._scenario.plant} on {self._place()}, device {options.device}, {options.type} {options.order}"
        return f"{what}: {', '.join(registers)}, {self._map.counter} tick counter"

    @contextlib.contextmanager
    def online(self) -> Iterator[None]:
        with _short_switch_interval(), _LoopThread() as self._loop:
            try:
                yield
            finally:
                self._set_online(online=False)

    def publish(self, scheduled: ScheduledSample, summary: NodeSummary) -> None:
        self._drive.update(scheduled, summary)
        self._set_online(online=not (scheduled.effect.gone and self.CLOSES_WHEN_GONE))
        if self._server is not None:
            for data in scheduled.effect.garbage:
                self._loop.call(self._server.send_garbage, data)

    def summary_line(self, summary: NodeSummary) -> str:
        functions = ", ".join(f"{count} of function {code}" for code, count in sorted(summary.functions.items()))
        return (
            f"{summary.answers} answers to {summary.functions.total()} requests ({functions or 'none'}), "
            f"{summary.refused.total()} refused, {summary.withheld} withheld, "
            f"in {summary.seconds:.1f} s of simulated time, {summary.stalls} stalls"
        )

    def _set_online(self, *, online: bool) -> None:
        """Start or stop the server, unless it is already so."""
        if online and self._server is None:
            self._server = self._loop.wait_for(self._start(self._open_line()))
        elif not online:
            if self._server is not None:
                server, self._server = self._server, None
                self._loop.wait_for(server.stop())
            if self.CLOSES_WHEN_GONE:
                self.close()

    async def _start(self, attach: Attach) -> DriveServer:
        return await DriveServer(self._drive, self.FRAMER).start(attach)

    @abstractmethod
    def _place(self) -> str:
        """The line, as a text for users."""

    @abstractmethod
    def _open_line(self) -> Attach:
        """Open the line if it is closed; raise DeviceError if it cannot be opened."""


class TcpNode(_ModbusNode):
    """A drive on a TCP port."""

    FRAMER = FramerType.SOCKET
    CLOSES_WHEN_GONE = True

    def __init__(self, scenario: Scenario) -> None:
        """Listen on the port; raise DeviceError if it is in use, or not permitted."""
        super().__init__(scenario, point_to_point=True)
        self._socket: socket.socket | None = self._listen()

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _place(self) -> str:
        return f"Modbus TCP {self._scenario.modbus.host}:{self._scenario.modbus.port}"

    def _open_line(self) -> Attach:
        listening, self._socket = self._socket or self._listen(), None  # asyncio closes it with the server

        async def attach(server: DriveServer) -> Any:
            return await asyncio.get_running_loop().create_server(server.handle_new_connection, sock=listening)

        return attach

    def _listen(self) -> socket.socket:
        host, port = self._scenario.modbus.host, self._scenario.modbus.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            return socket.create_server((host, port), family=family)
        except (OSError, UnicodeError) as error:
            number = error.errno if isinstance(error, OSError) else None
            cause = os.strerror(number) if number is not None and number in errno.errorcode else str(error)
            raise DeviceError(
                f"{self._place()} cannot be listened on: {cause}; is a second plant running? Stop it, "
                "or set modbus.port (and modbus.host) in the scenario"
            ) from error


class RtuNode(_ModbusNode):
    """A drive on a pseudo-terminal, which a client opens like ``/dev/ttyUSB0``."""

    FRAMER = FramerType.RTU
    CLOSES_WHEN_GONE = False

    def __init__(self, scenario: Scenario) -> None:
        """Create the line; raise DeviceError if its path exists, or the kernel has no terminal left."""
        super().__init__(scenario, point_to_point=False)
        self._line = SerialLine(scenario.modbus.line)

    def close(self) -> None:
        self._line.close()

    def _place(self) -> str:
        options = self._scenario.modbus
        timing = "8N1" if options.pace_line else "without timing"
        return f"Modbus RTU {self._line.link} ({options.baudrate} baud, {timing})"

    def _open_line(self) -> Attach:
        baudrate = self._scenario.modbus.baudrate if self._scenario.modbus.pace_line else math.inf

        async def attach(server: DriveServer) -> Any:
            handler = server.handle_new_connection()
            transport = LineTransport(self._line.device_end, handler, baudrate)
            handler.connection_made(transport)
            return transport, handler

        return attach


class _LoopThread:
    """An event loop in a thread."""

    def __enter__(self) -> "_LoopThread":
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="modbus-serve", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(SERVER_TIMEOUT)
        self._loop.close()

    def call(self, function: Callable[..., None], *arguments: object) -> None:
        """Call ``function`` in the loop, soon."""
        self._loop.call_soon_threadsafe(function, *arguments)

    def wait_for(self, work: Coroutine[Any, Any, Any]) -> Any:
        """The result of ``work``, run in the loop."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(SERVER_TIMEOUT)


@contextlib.contextmanager
def _short_switch_interval() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


class SerialLine:
    """Both ends of a pseudo-terminal, and a link to the one that a client opens."""

    def __init__(self, link: Path | None) -> None:
        """Create the line; by default ``link`` is in this user's runtime folder, else in that of temporary files.

        Raises:
            DeviceError: the path exists or cannot be created, or the kernel has no terminal left.
        """
        link = link or Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / DEFAULT_NAME
        try:
            # This process keeps the client's end open too: Linux returns EIO to a reader if no process has it open.
            self.device_end, self._client_end = pty.openpty()
        except OSError as error:
            text = f"no pseudo-terminal for the serial line: {error.strerror}; is /dev/pts mounted?"
            raise DeviceError(text) from error
        tty.setraw(self._client_end)
        os.set_blocking(self.device_end, False)
        self.link = link
        try:
            _create_link(link, os.ttyname(self._client_end))
        except (DeviceError, OSError) as error:
            os.close(self.device_end)
            os.close(self._client_end)
            if isinstance(error, DeviceError):
                raise
            text = f"{link}: the serial line cannot be created: {error.strerror}; set modbus.line"
            raise DeviceError(text) from error

    def close(self) -> None:
        """Close both ends and remove the link."""
        with contextlib.suppress(OSError):
            self.link.unlink()
        os.close(self.device_end)
        os.close(self._client_end)


def _create_link(link: Path, terminal: str) -> None:
    if link.is_symlink() and (not link.exists() or str(link.readlink()) == terminal):
        link.unlink()  # left by a node that was killed: its terminal is gone, or is now this one
    try:
        link.symlink_to(terminal)
    except FileExistsError:
        text = f"{link}: exists already: is a second plant running? Stop it, remove the file, or set modbus.line"
        raise DeviceError(text) from None


class LineTransport(asyncio.Transport):
    """The end of the drive, for a protocol of pymodbus.

    A silence ends a frame, as in Modbus RTU, so bytes that are no frame do not spoil the next frame. An answer that
    no client reads is lost if the terminal is full, as on a wire.
    """

    def __init__(self, end: int, receiver: ModbusProtocol, baudrate: float) -> None:
        """``end`` is the file descriptor of the drive's end; ``baudrate`` in bit/s, infinite for no timing."""
        super().__init__()
        self._end, self._receiver = end, receiver
        self._byte_time = BITS_PER_BYTE / baudrate  # s
        self._paced = math.isfinite(baudrate)
        self._silence = max(SILENCE * self._byte_time, MIN_SILENCE) if self._paced else UNPACED_SILENCE
        self._loop = asyncio.get_running_loop()
        self._received = bytearray()
        self._received_until = -math.inf  # s, clock of the loop
        self._frame_timer: asyncio.TimerHandle | None = None
        self._unsent = bytearray()
        self._sent_until = 0.0  # s, clock of the loop
        self._write_timer: asyncio.TimerHandle | None = None
        self._loop.add_reader(end, self._read)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Send bytes."""
        if not self._unsent:
            self._sent_until = self._loop.time()
        self._unsent += data
        if self._write_timer is None:
            self._write_due()

    def close(self) -> None:
        """Stop reading and writing; the line itself stays. May be called twice."""
        self._loop.remove_reader(self._end)
        for timer in (self._frame_timer, self._write_timer):
            if timer is not None:
                timer.cancel()

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._end, MAX_READ)
            now = self._loop.time()
            if not self._paced:
                if now > self._received_until + self._silence:
                    self._receiver.recv_buffer = b""
                self._received_until = now
                self._receiver.data_received(data)
                return
            self._received += data
            self._received_until = max(now, self._received_until) + len(data) * self._byte_time
            if self._frame_timer is not None:
                self._frame_timer.cancel()
            self._frame_timer = self._loop.call_at(self._received_until + self._silence, self._end_frame)

    def _end_frame(self) -> None:
        self._frame_timer = None
        data = bytes(self._received)
        self._received.clear()
        self._receiver.recv_buffer = b""
        self._receiver.data_received(data)

    def _write_due(self) -> None:
        """Write the bytes whose time on the line has passed, and set a timer for the rest."""
        self._write_timer = None
        now = self._loop.time()
        due = min(math.floor((now - self._sent_until) / self._byte_time), len(self._unsent)) if self._paced else None
        ready = bytes(self._unsent[:due])
        if ready:
            with contextlib.suppress(BlockingIOError):
                os.write(self._end, ready)
            del self._unsent[:due]
            self._sent_until += len(ready) * self._byte_time
        if self._unsent:
            piece = min(max(math.ceil(WRITE_INTERVAL / self._byte_time), 1), len(self._unsent))
            self._write_timer = self._loop.call_at(self._sent_until + piece * self._byte_time, self._write_due)
