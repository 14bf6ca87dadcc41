"""Questions to Modbus devices, timed, and a line that is opened anew where it has to be.

Everything goes through :class:`otolith_drivers.modbus_line.Line`, which can read and nothing else.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus_failures import EXCEPTIONS, GATEWAY_CODES, Broken, Refused, Silent
from otolith_drivers.modbus_line import Line
from otolith_drivers.modbus_options import LineOptions, Table

MOST_TIMES = 1000  # kept of each length of request
BUSY, MOST_BUSY, BUSY_PAUSE = (5, 6), 5, 0.1  # exceptions that say "later"; how often; s
Stopped = Callable[[], bool]
"""Whether the user has seen enough."""
Told = Callable[[str], None]
"""Takes what is being done, for a line of progress."""


class Asker:
    """One table of one device, asked again and again; counts and times the answers."""

    def __init__(self, line: Line, options: LineOptions, device: int, table: Table) -> None:
        self._line = line
        self.options, self.device, self.table = options, device, table
        self.round_trips: dict[int, deque[float]] = {}
        """s, by the number of registers asked for."""
        self.alive = False
        """Whether the device has ever answered, be it with an exception."""
        self._answered: int | None = None

    def read(self, address: int, count: int) -> list[int]:
        """The registers.

        Raises:
            Refused: the device answers with an exception.
            Silent: it does not answer; the line is ready for the next question.
            DeviceError: the line is gone and cannot be opened anew.
        """
        for _ in range(MOST_BUSY):
            try:
                return self._once(address, count)
            except Refused as error:
                self.alive = True
                if error.code not in BUSY:
                    raise
                time.sleep(BUSY_PAUSE)
        return self._once(address, count)

    def _once(self, address: int, count: int) -> list[int]:
        begun = time.perf_counter()
        try:
            words = self._line.read(self.device, self.table, address, count)
        except Silent:
            self._again()
            raise
        except Broken:
            self._again()
            words = self._second(address, count)
        self.alive, self._answered = True, self.device
        self.round_trips.setdefault(count, deque(maxlen=MOST_TIMES)).append(time.perf_counter() - begun)
        if self.options.pause:
            time.sleep(self.options.pause)
        return words

    def _again(self) -> None:
        """An answer that comes late must not be taken for that to another question to the same device."""
        if self._answered == self.device:
            self._line.drain()
        self._line.close()
        open_line(self._line, self.options)

    def _second(self, address: int, count: int) -> list[int]:
        """Some servers close a connection that has been idle, or after every answer."""
        try:
            return self._line.read(self.device, self.table, address, count)
        except Broken as error:
            raise Silent(f"{error} instead of an answer") from error


def open_line(line: Line, options: LineOptions) -> None:
    """Open it.

    Raises:
        DeviceError: it cannot be opened; with the way out.
    """
    try:
        line.connect()
    except Broken as error:
        raise DeviceError(f"{options.title()} cannot be opened: {error}; {_way_out(options, str(error))}") from error


@contextmanager
def opened(options: LineOptions, told: Told) -> Iterator[Line]:
    """The line, open, and closed at the end.

    Raises:
        DeviceError: it cannot be opened; with the way out.
    """
    line = Line(options)
    told(f"opening {options.title()}")
    open_line(line, options)
    try:
        yield line
    finally:
        line.close()


def _way_out(options: LineOptions, cause: str) -> str:
    if options.host is not None:
        if "refused" in cause:
            return f"the host is there, but nobody listens on port {options.port}: write HOST:PORT for another one"
        return "are address and cable right, and does 'ping' reach it?"
    from serial.tools import list_ports  # noqa: PLC0415 - only on the way to an error

    if "settings" in cause:
        return "try another --parity or --baudrate"
    if "denied" in cause:
        return "add yourself to the group that owns it, as a rule with 'sudo usermod -aG dialout $USER'"
    known = ", ".join(port.device for port in list_ports.comports() if port.vid is not None)
    return f"serial adapters of this computer: {known or 'none'}"


@dataclass(frozen=True, slots=True)
class Answer:
    """What a device says to a single question."""

    device: int
    said: str
    """Why it does not give the register; empty if it does."""


def scan(asker: Asker, devices: Sequence[int], register: int, stopped: Stopped, told: Told) -> list[Answer]:
    """Those of ``devices`` that answer when asked for one register.

    Raises:
        DeviceError: the line is gone.
    """
    found: list[Answer] = []
    for device in devices:
        if stopped():
            break
        told(f"asking device {device}; {len(found)} answered so far")
        asker.device = device
        try:
            asker.read(register, 1)
        except Refused as error:
            if error.code not in GATEWAY_CODES:
                found.append(Answer(device, EXCEPTIONS.get(error.code, str(error))))
        except Silent:
            continue
        else:
            found.append(Answer(device, ""))
    return found
