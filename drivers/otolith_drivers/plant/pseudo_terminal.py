"""A serial line as a pseudo-terminal: a client opens it like ``/dev/ttyUSB0``, and bytes take their time."""

import asyncio
import contextlib
import math
import os
import pty
import tempfile
import tty
from pathlib import Path

from pymodbus.transport import ModbusProtocol

from otolith_drivers.errors import DeviceError

BITS_PER_BYTE = 10  # 8N1: start, eight of data, stop
# End of a frame by the Modbus serial line specification: a silence of 3.5 characters, 1.75 ms above 19200 baud.
SILENCE = 3.5  # bytes
MIN_SILENCE = 1.75e-3  # s
# Engineering choices; test_modbus_node.py guards the second.
UNPACED_SILENCE = 0.05  # s; end of a frame on a line without timing: longer than a pause within a write
WRITE_INTERVAL = 1e-3  # s; bytes are written in pieces of this length, the resolution of the event loop's clock
MAX_READ = 4096  # bytes; the kernel buffers no more for a terminal
DEFAULT_NAME = "ttyOtolith"


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
            raise DeviceError(
                f"no pseudo-terminal for the serial line: {error.strerror}; is /dev/pts mounted?"
            ) from error
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
            raise DeviceError(
                f"{link}: the serial line cannot be created: {error.strerror}; set modbus.line"
            ) from error

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
        raise DeviceError(
            f"{link}: exists already: is a second plant running? Stop it, remove the file, or set modbus.line"
        ) from None


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
