"""One connection to a serial line or host for all drivers of this process that read devices on it.

A serial port can be opened once, and many devices accept few connections. The drivers take turns, in the order in which
they ask, one request each. So each gets a fair rate, and a device that does not answer holds the others up for as long
as a request may wait for its answer; on a serial line, twice as long, as late bytes must be awaited.
"""

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from otolith_drivers.modbus.client import ConnectionLostError, NoReplyError, ReadOnlyClient
from otolith_drivers.modbus.options import LineOptions, Table

OWN = frozenset({"pause", "serial", "host", "port"})  # Options of each user; the line is that of _place
TURN_POLL = 0.05  # s; delay of a stop while a turn is awaited; engineering choice

_lines_lock = threading.Lock()
_lines: dict[str, "_Line"] = {}  # That are in use


class _Line:
    """The connection, and whose turn it is."""

    def __init__(self, place: str, options: LineOptions) -> None:
        self.place, self.options, self.client, self.is_open = place, options, ReadOnlyClient(options), False
        self.users: set[LineUser] = set()
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
        if line is None:
            return
        with _lines_lock:
            line.users.discard(self)
            if line.users:
                return
            if _lines.get(line.place) is line:
                del _lines[line.place]
            line.close()

    def abort(self) -> None:
        """End a read in progress, or the wait for a turn; callable from another thread."""
        self._cancelled.set()
        with _lines_lock:
            if self._line is not None and self._line.users == {self}:  # the read of another one goes on
                self._line.client.abort()

    def _joined(self) -> _Line:
        """Return the line, of which this driver is a user from now on."""
        if self._line is None:
            with _lines_lock:
                place = _place(self._options)
                line = _lines.setdefault(place, _Line(place, self._options))
                if differing := _differences(line.options, self._options):
                    text = f"another machine or source uses this line with other options: {differing}"
                    raise ConnectionLostError(text)
                line.users.add(self)
                self._line = line
        return self._line


def _place(options: LineOptions) -> str:
    """Return what identifies the line on this computer, however it is spelled."""
    if options.host is not None:
        return f"{options.host.lower()}:{options.port}"
    return str(Path(options.serial or "").resolve())


def _differences(there: LineOptions, here: LineOptions) -> str:
    """Return the options in which the users of a line differ; each may have its own pause, and its own spelling."""
    names = [name for name in LineOptions.model_fields if name not in OWN]
    pairs = {name: (getattr(there, name), getattr(here, name)) for name in names}
    return ", ".join(f"{name} {one} there and {other} here" for name, (one, other) in pairs.items() if one != other)
