"""Turns on a connection to a serial line or host that drivers share.

A serial port can be opened once, and many devices accept few connections. The drivers take turns, in the order in which
they ask, one request each. So each gets a fair rate, and a device that does not answer holds the others up for as long
as a request may wait for its answer; on a serial line, twice as long, as late bytes must be awaited.
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from otolith_drivers.common.sharing import Place, SharedConnection
from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus.client import ConnectionLostError, NoReplyError, ReadOnlyClient
from otolith_drivers.modbus.options import LineOptions, Table

OWN = frozenset({"pause", "serial", "host", "port"})  # Options of each user; the line is that of _place
TURN_POLL = 0.05  # s; delay of a stop while a turn is awaited; engineering choice


class _Line(SharedConnection["LineUser"]):
    """The connection, and whose turn it is."""

    def __init__(self, options: LineOptions) -> None:
        super().__init__()
        self.client, self.is_open = ReadOnlyClient(options), False
        self._lock = threading.Lock()
        self._waiting: deque[threading.Event] = deque()
        self._is_busy = False

    @contextmanager
    def turn(self, cancelled: threading.Event) -> Iterator[None]:
        """Wait for the turn; raise ConnectionLostError once ``cancelled`` is set."""
        with self._lock:
            mine = threading.Event()
            if self._is_busy:
                self._waiting.append(mine)
            else:
                self._is_busy = True
                mine.set()
        try:
            while not mine.wait(TURN_POLL):
                if cancelled.is_set() and self._gave_up(mine):
                    raise ConnectionLostError("closed")
            yield
        finally:
            if mine.is_set():
                self._pass_on()

    def _gave_up(self, mine: threading.Event) -> bool:
        """Leave the queue; return False if it is one's turn meanwhile."""
        with self._lock:
            if mine.is_set():
                return False
            self._waiting.remove(mine)
            return True

    def _pass_on(self) -> None:
        with self._lock:
            if self._waiting:
                self._waiting.popleft().set()
            else:
                self._is_busy = False

    def open(self) -> None:
        """Open the connection if it is not; raise ConnectionLostError if it cannot be opened. Requires the turn."""
        if not self.is_open:
            self.client.connect()
            self.is_open = True

    def close(self) -> None:
        """Close the connection."""
        self.is_open = False
        self.client.close()


class LineUser:
    """A driver that reads devices on a line, for one thread; only :meth:`abort` may be called from another."""

    def __init__(self, options: LineOptions) -> None:
        self._options = options
        self._line: _Line | None = None
        self._cancelled = threading.Event()

    def connect(self) -> None:
        """Open the connection, or use the one that others have opened.

        Raises:
            ConnectionLostError: it cannot be opened, or others use the line with other options.
        """
        line = self._joined()
        with line.turn(self._cancelled):
            line.open()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Wait until no other driver reads, and pause afterwards; raise ConnectionLostError after :meth:`abort`."""
        with self._joined().turn(self._cancelled):
            try:
                yield
            finally:
                self._cancelled.wait(self._options.pause)

    def read(self, device: int, table: Table, address: int, count: int) -> list[int]:
        """Return and raise what :meth:`ReadOnlyClient.read` does; requires the turn.

        After no reply the connection is closed, so that nobody takes a late answer for that to another request.
        """
        line = self._joined()
        line.open()
        try:
            return line.client.read(device, table, address, count)
        except ConnectionLostError:
            line.close()
            raise
        except NoReplyError:
            line.is_open = False
            line.client.drain()
            raise

    def close(self) -> None:
        """Use the connection no longer; the last one closes it. May be called twice."""
        line, self._line = self._line, None
        if line is not None:
            line.leave(self)

    def abort(self) -> None:
        """End a read in progress, or the wait for a turn; callable from another thread."""
        self._cancelled.set()
        line = self._line
        if line is not None and line.is_last_use_of(self):  # the read of another one goes on
            line.client.abort()

    def _joined(self) -> _Line:
        """Return the line, of which this driver is a user from now on."""
        if self._line is None:
            options = {name: getattr(self._options, name) for name in LineOptions.model_fields if name not in OWN}
            try:
                self._line = _Line.join(_place(self._options), self, lambda: _Line(self._options), options)
            except DeviceError as error:
                raise ConnectionLostError(str(error)) from error
        return self._line


def _place(options: LineOptions) -> Place:
    """Return what identifies the line on this computer, however it is spelled."""
    if options.host is not None:
        return "modbus", options.host.lower(), options.port
    return "modbus", str(Path(options.serial or "").resolve())
