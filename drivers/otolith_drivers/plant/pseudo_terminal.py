"""A serial line that is a pseudo-terminal: its other end is opened like ``/dev/ttyUSB0``, and bytes take their time."""

import asyncio
import contextlib
import math
import os
import pty
import tempfile
import tty
from pathlib import Path
from typing import Protocol

from otolith_drivers.errors import DeviceError

BITS_PER_BYTE = 10  # 8N1: start, eight of data, stop
SILENCE, SHORTEST_SILENCE = 3.5, 1.75e-3  # bytes, s: what ends a frame of Modbus RTU
UNPACED_SILENCE = 0.05  # s; without timing on the line, what is surely no pause within a frame
PIECE = 1e-3  # s; bytes are put on the line in pieces of this length, as the event loop's clock is no finer
MOST_AT_ONCE = 4096  # bytes; what the kernel keeps of a terminal
DEFAULT_NAME = "ttyOtolith"


class Receiver(Protocol):
    """Who takes what arrives: the part of pymodbus' protocol that a line needs."""

    recv_buffer: bytes

    def data_received(self, data: bytes) -> None:
        """Bytes, as they come."""


def default_link() -> Path:
    """Where a line is found if nobody says it: this user's runtime folder, else the one for temporary files."""
    return Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / DEFAULT_NAME


class SerialLine:
    """Both ends of the terminal, and a name for the one that a client opens."""

    def __init__(self, link: Path) -> None:
        """Make the line.

        Raises:
            DeviceError: the name is taken or cannot be made, or the kernel has no terminal left.
        """
        try:
            # The client's end stays open here as well: without anybody on it, reading ours would be an error.
            self.ours, self._theirs = pty.openpty()
        except OSError as error:
            raise DeviceError(
                f"no pseudo-terminal for the serial line: {error.strerror}; is /dev/pts mounted?"
            ) from error
        tty.setraw(self._theirs)
        os.set_blocking(self.ours, False)
        self.link = link
        try:
            _make_link(link, os.ttyname(self._theirs))
        except (DeviceError, OSError) as error:
            os.close(self.ours)
            os.close(self._theirs)
            if isinstance(error, DeviceError):
                raise
            raise DeviceError(f"{link}: no serial line can be made there: {error.strerror}; set modbus.line") from error

    def close(self) -> None:
        """Give up both ends and the name."""
        with contextlib.suppress(OSError):
            self.link.unlink()
        os.close(self.ours)
        os.close(self._theirs)


def _make_link(link: Path, terminal: str) -> None:
    if link.is_symlink() and (not link.exists() or str(link.readlink()) == terminal):
        link.unlink()  # of a node that was killed: its terminal is gone, or has become ours
    try:
        link.symlink_to(terminal)
    except FileExistsError:
        raise DeviceError(
            f"{link}: is there already: is a second plant running? Stop it, remove the file, or set modbus.line"
        ) from None


class LineTransport(asyncio.Transport):
    """The drive's end, for a protocol of pymodbus.

    A frame ends with silence, as Modbus RTU says, and what comes after it is another one, so that bytes that were no
    frame cost no more than themselves. An answer that nobody reads is lost when the terminal is full, as on a wire.
    """

    def __init__(self, end: int, receiver: Receiver, baudrate: float) -> None:
        """``end`` is the file descriptor of ours; ``baudrate`` in bit/s, infinite for a line without timing."""
        super().__init__()
        self._end, self._receiver = end, receiver
        self._byte = BITS_PER_BYTE / baudrate  # s
        self._paced = math.isfinite(baudrate)
        self._silence = max(SILENCE * self._byte, SHORTEST_SILENCE) if self._paced else UNPACED_SILENCE
        self._loop = asyncio.get_running_loop()
        self._heard = bytearray()
        self._heard_until = -math.inf
        self._frame: asyncio.TimerHandle | None = None
        self._waiting = bytearray()
        self._free_at = 0.0
        self._piece: asyncio.TimerHandle | None = None
        self._loop.add_reader(end, self._hear)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Put bytes on the line."""
        if not self._waiting:
            self._free_at = self._loop.time()
        self._waiting += data
        if self._piece is None:
            self._put()

    def close(self) -> None:
        """Neither hear nor say anything more; the line itself stays. May be called twice."""
        self._loop.remove_reader(self._end)
        for handle in (self._frame, self._piece):
            if handle is not None:
                handle.cancel()

    def _hear(self) -> None:
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._end, MOST_AT_ONCE)
            now = self._loop.time()
            if not self._paced:
                if now > self._heard_until + self._silence:
                    self._receiver.recv_buffer = b""
                self._heard_until = now
                self._receiver.data_received(data)
                return
            self._heard += data
            self._heard_until = max(now, self._heard_until) + len(data) * self._byte
            if self._frame is not None:
                self._frame.cancel()
            self._frame = self._loop.call_at(self._heard_until + self._silence, self._end_frame)

    def _end_frame(self) -> None:
        self._frame = None
        data = bytes(self._heard)
        self._heard.clear()
        self._receiver.recv_buffer = b""
        self._receiver.data_received(data)

    def _put(self) -> None:
        """What has had the time to be on the line; the rest in a moment."""
        self._piece = None
        now = self._loop.time()
        passed = min(math.floor((now - self._free_at) / self._byte), len(self._waiting)) if self._paced else None
        ready = bytes(self._waiting[:passed])
        if ready:
            with contextlib.suppress(BlockingIOError):
                os.write(self._end, ready)
            del self._waiting[:passed]
            self._free_at += len(ready) * self._byte
        if self._waiting:
            piece = min(max(math.ceil(PIECE / self._byte), 1), len(self._waiting))
            self._piece = self._loop.call_at(self._free_at + piece * self._byte, self._put)
