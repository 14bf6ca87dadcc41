"""What python-can does not ask of the kernel: room for frames, how many were thrown away, and whether the bus is up."""

import contextlib
import os
import socket
import stat
import struct

import can

SO_RCVBUFFORCE, SO_MEMINFO = 33, 55  # of <asm-generic/socket.h>; the socket module has no names for them
MEMORY_INFO = struct.Struct("9I")  # of <linux/sock_diag.h>
DROPS = 8  # its last
BUFFER = 8 << 20  # bytes; a second or two of a bus at its limit
RECENT = 60.0  # s for which dropped frames are told


def enlarge_buffer(bus: can.BusABC) -> None:
    """Let the kernel keep frames for as long as this computer may be busy; above its limit where that is permitted."""
    descriptor = _descriptor(bus)
    if descriptor is None:
        return
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as handle:
        try:
            handle.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER)
        except PermissionError:
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)


def frames_dropped(bus: can.BusABC) -> int | None:
    """Frames that the kernel had no room for since the bus was opened; None where it does not say."""
    descriptor = _descriptor(bus)
    if descriptor is None:
        return None
    try:
        with socket.socket(fileno=os.dup(descriptor)) as handle:
            if handle.type == socket.SOCK_STREAM:  # what is dropped there is sent again
                return None
            told = handle.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMORY_INFO.size)
    except OSError:
        return None
    if len(told) < MEMORY_INFO.size:
        return None
    drops: int = MEMORY_INFO.unpack_from(told)[DROPS]
    return drops


def refusal(bus: can.BusABC) -> str | None:
    """What the kernel has against a bus that was just opened: it opens one that is down, too, and then refuses to read.

    The error is taken off the bus by asking, so that it is to be shut.
    """
    descriptor = _descriptor(bus)
    if descriptor is None:
        return None
    try:
        with socket.socket(fileno=os.dup(descriptor)) as handle:
            code = handle.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    except OSError:
        return None
    return os.strerror(code) if code else None


def _descriptor(bus: can.BusABC) -> int | None:
    """Of the socket under ``bus``; other interfaces have none, or that of a serial line."""
    try:
        found = bus.fileno()
        is_socket = isinstance(found, int) and found >= 0 and stat.S_ISSOCK(os.fstat(found).st_mode)
    except (NotImplementedError, OSError):
        return None
    return found if is_socket else None


class Drops:
    """Frames that this computer did not read in time, over all the buses that were opened."""

    def __init__(self) -> None:
        self.total = 0
        self._of_this_bus = 0
        self._at = 0.0

    def begin(self) -> None:
        """Another socket counts from zero."""
        self._of_this_bus = 0

    def note(self, count: int | None, now: float) -> None:
        """What the kernel says of this bus."""
        if count is not None and count > self._of_this_bus:
            self.total += count - self._of_this_bus
            self._of_this_bus, self._at = count, now

    def complaints(self, now: float) -> list[str]:
        """A line for a while after it happened."""
        if not self.total or now - self._at > RECENT:
            return []
        return [f"this computer was too busy to read {self.total} frames, the last {now - self._at:.1f} s ago"]
