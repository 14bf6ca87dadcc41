"""Which registers are read together: as few requests as the device's limits allow. Pure.

Which requests are worth sending now: one dead device or refused register never costs the others. Pure: no clock.

A device that does not answer is left alone for a while, longer each time, and tried again for ever. A request that is
refused is split until only what the device does not have is left out.

When the next round of requests is due, and what rate is achieved. Pure: times (s) come in as arguments.

Rounds begin on a grid of absolute moments, so that a late one does not delay those after it. Where the line is slower
than asked, the grid is made as coarse as it takes: evenly spaced samples are worth more than many.
"""

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from otolith_drivers.modbus.options import Item, Table
from otolith_drivers.modbus.protocol import GATEWAY_CODES, Refused


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Registers of one device that are read at once."""

    device: int
    table: Table
    address: int
    count: int
    items: tuple[Item, ...]
    """In the order of their addresses."""

    def describe(self) -> str:
        """In words."""
        last = self.address + self.count - 1
        return f"device {self.device}, {self.table} registers {self.address} to {last}"


def plan(items: Iterable[Item], max_gap: int, max_registers: int) -> tuple[Request, ...]:
    """Requests for all ``items``, each at most ``max_registers`` long and with gaps of at most ``max_gap`` in it."""
    requests: list[Request] = []
    together: list[Item] = []
    for item in sorted(items, key=lambda item: (item.device, item.table, item.address, item.end)):
        if together and not _fits(together, item, max_gap, max_registers):
            requests.append(_request(together))
            together = []
        together.append(item)
    return tuple([*requests, _request(together)] if together else requests)


def split(request: Request) -> tuple[Request, ...]:
    """The same items in two requests, apart where the gap between them is widest; itself if it cannot be split.

    A device that refuses a request may refuse only what nobody wants in it, or only one of its items.
    """
    items = request.items
    ends = [max(item.end for item in items[: at + 1]) for at in range(len(items))]
    gaps = [items[at].address - ends[at - 1] for at in range(1, len(items))]
    if not gaps or max(gaps) < 0:  # nothing to part, or only what overlaps
        return (request,)
    middle = len(items) / 2
    at = 1 + max(range(len(gaps)), key=lambda index: (gaps[index], -abs(index + 1 - middle)))
    return _request(items[:at]), _request(items[at:])


def summary(requests: Sequence[Request]) -> str:
    """How much is read."""
    registers = sum(request.count for request in requests)
    return f"{len(requests)} request{'s' * (len(requests) != 1)}, {registers} register{'s' * (registers != 1)}"


def _fits(together: Sequence[Item], item: Item, max_gap: int, max_registers: int) -> bool:
    first, end = together[0], max(other.end for other in together)
    return (
        (item.device, item.table) == (first.device, first.table)
        and item.address - end <= max_gap
        and max(end, item.end) - first.address <= max_registers
    )


def _request(items: Sequence[Item]) -> Request:
    first = items[0]
    end = max(item.end for item in items)
    return Request(first.device, first.table, first.address, end - first.address, tuple(items))


PATIENCE = 3  # failures in a row before something is left alone
FIRST_REST, LONGEST_REST = 1.0, 10.0  # s
STRUCTURAL = (1, 2, 3)  # exceptions that say "never", not "not now"


@dataclass(slots=True)
class Rest:
    """How a request or a device has fared."""

    failures: int = 0
    fault: str = ""
    since: float = 0.0
    """s, of the first failure."""
    until: float = 0.0
    """s; not tried before."""

    def fail(self, fault: str, now: float, patience: int) -> None:
        """Note a failure; from ``patience`` in a row on it rests, twice as long each time."""
        if not self.failures:
            self.since = now
        self.failures += 1
        self.fault = fault
        if self.failures >= patience:
            self.until = now + min(FIRST_REST * 2.0 ** (self.failures - patience), LONGEST_REST)

    def recover(self) -> None:
        """It works."""
        self.failures, self.fault, self.until = 0, "", 0.0

    @property
    def resting(self) -> bool:
        """Whether it is given up for now."""
        return self.until > 0.0


@dataclass(slots=True)
class Requests:
    """All requests of a driver, and the health of each and of each device."""

    requests: tuple[Request, ...]
    _requests: dict[Request, Rest] = field(default_factory=dict)
    _devices: dict[int, Rest] = field(default_factory=dict)

    def due(self, now: float) -> list[Request]:
        """Those worth sending now, doubtful devices last; of such a device only one, to ask whether it is back."""
        chosen: list[Request] = []
        asked: set[int] = set()
        for request in sorted(self.requests, key=lambda request: self._device(request).failures > 0):
            device = self._device(request)
            if now < device.until or now < self._request(request).until:
                continue
            if device.failures and request.device in asked:
                continue
            asked.add(request.device)
            chosen.append(request)
        return chosen

    def answered(self, request: Request) -> None:
        """It was read."""
        self._device(request).recover()
        self._request(request).recover()

    def silent(self, request: Request, fault: str, now: float) -> None:
        """Its device did not answer."""
        self._device(request).fail(fault, now, PATIENCE)

    def refused(self, request: Request, error: Refused, now: float) -> None:
        """The device answered with an exception."""
        if error.code in GATEWAY_CODES:
            self.silent(request, str(error), now)
            return
        self._device(request).recover()
        parts = split(request) if error.code in STRUCTURAL and len(request.items) > 1 else (request,)
        if len(parts) > 1:
            at = self.requests.index(request)
            self.requests = (*self.requests[:at], *parts, *self.requests[at + 1 :])
            self._requests.pop(request, None)
            return
        self._request(request).fail(str(error), now, 1 if error.code in STRUCTURAL else PATIENCE)

    @property
    def all_silent(self) -> bool:
        """Whether no device answers."""
        devices = {request.device for request in self.requests}
        return all(self._devices.get(device, Rest()).resting for device in devices)

    def warnings(self, now: float) -> list[str]:
        """What is left alone and why, a line each."""
        lines = [
            f"device {number} does not answer for {now - rest.since:.0f} s: {rest.fault}; tried again"
            for number, rest in list(self._devices.items())
            if rest.resting
        ]
        for request, rest in list(self._requests.items()):
            if rest.resting:
                names = ", ".join(item.name for item in request.items)
                lines.append(f"{names}: {request.describe()} refused: {rest.fault}; tried again now and then")
        return lines

    def _device(self, request: Request) -> Rest:
        return self._devices.setdefault(request.device, Rest())

    def _request(self, request: Request) -> Rest:
        return self._requests.setdefault(request, Rest())


ROUNDS = 50  # that a decision is based on
FULL = 0.95  # share of the period beyond which rounds leave no room for what delays them
ROOM = 1.15  # of a longer period over what rounds take
MOST_LEFT_OUT = 0.2  # share of the grid; less is a busy computer, and passes
MOST_AT_ONCE = 2  # left out before a round, that are laid to the line's speed; a timeout leaves out more
SLOW_IN_A_ROW = 2  # decisions by which a coarser grid is needed, before it is made
SLOW_FOR = 3.0  # s, for the same: a computer that is busy for a moment is no slow line
EASY = 20  # decisions in a row by which a finer grid would do, before it is tried again
STEPS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # times a power of ten: periods that people use
SELDOM, OFTEN = 0.02, 0.6  # shares of rounds that repeat the one before, between which the beat is heard
BEAT_ROUNDS = 100
QUARTERS = 4  # of the period: steps away from the beat
MOST_BEATS = 64  # hundreds of rounds between two steps away from the beat, where steps do not help


class PollSchedule:
    """The grid of rounds."""

    def __init__(self, asked: float) -> None:
        self.asked = asked
        self.period = asked
        self.due = math.inf
        self._starts: deque[float] = deque(maxlen=ROUNDS + 1)
        self._durations: list[float] = []
        self._left_out = self._slow = self._easy = 0
        self._slow_for = 0.0
        self._repeats = self._rounds = 0
        self._beats = self._steps = 0
        self.known = False
        """Whether enough rounds were seen to know that the period can be held."""

    def start(self, now: float) -> None:
        """Lay the grid through ``now``."""
        self.due = now

    def begin(self, now: float) -> int:
        """A round begins; how many before it were left out since the last one."""
        behind = self._behind(now)
        self.due += (behind + 1) * self.period
        self._left_out += min(behind, MOST_AT_ONCE)
        self._starts.append(now)
        return behind

    def pass_over(self, now: float) -> int:
        """The line is away: how many rounds were due meanwhile; they are left out."""
        missed = self._behind(now) + 1 if now >= self.due else 0
        self.due += missed * self.period
        self._starts.clear()
        return missed

    def _behind(self, now: float) -> int:
        return max(0, math.floor((now - self.due) / self.period))

    def end(self, duration: float, *, repeated: bool) -> bool:
        """A round in which all answered took ``duration`` s; whether the grid was changed because of it.

        ``repeated``: every register had the value of the round before. Where that happens now and then, the device
        renews its registers as often as they are read, and at the same moment: reading then moves away from it.
        """
        self._durations.append(duration)
        self._rounds += 1
        self._repeats += repeated
        if self._rounds >= BEAT_ROUNDS:
            self._step_aside(heard=SELDOM <= self._repeats / self._rounds <= OFTEN)
            self._rounds = self._repeats = 0
        if len(self._durations) < ROUNDS:
            return False
        wanted = self._wanted()
        self._durations.clear()
        self._left_out, self.known = 0, self._slow == 0
        if wanted == self.period:
            return False
        self.due += wanted - self.period
        self.period = wanted
        self._starts.clear()
        return True

    def _step_aside(self, *, heard: bool) -> None:
        """Away from the beat; less and less often once all quarters were tried, as coarse registers sound like one."""
        self._beats += 1
        if not heard:
            self._steps = max(0, self._steps - 1)
        elif self._beats >= min(2 ** max(0, self._steps - QUARTERS), MOST_BEATS):
            self.due += self.period / QUARTERS
            self._beats, self._steps = 0, self._steps + 1

    def _wanted(self) -> float:
        """The period (s) that the last rounds speak for."""
        usual = sorted(self._durations)[ROUNDS // 2]
        share = self._left_out / (ROUNDS + self._left_out)
        if usual > FULL * self.period or share > MOST_LEFT_OUT:
            self._slow, self._easy = self._slow + 1, 0
            self._slow_for += ROUNDS * max(usual, self.period)
            if self._slow < SLOW_IN_A_ROW or self._slow_for < SLOW_FOR:
                return self.period
            self._slow_for = 0.0
            return _even(ROOM * usual if usual > FULL * self.period else self.period / (1.0 - share))
        self._slow, self._slow_for = 0, 0.0
        finer = max(self.asked, _even(ROOM * usual))
        self._easy = self._easy + 1 if finer < self.period else 0
        if self._easy < EASY:
            return self.period
        self._easy = 0
        return finer

    @property
    def achieved(self) -> float | None:
        """Seconds from round to round; None while too few have followed each other."""
        if len(self._starts) < ROUNDS // 2:
            return None
        return (self._starts[-1] - self._starts[0]) / (len(self._starts) - 1)

    def describe(self) -> str:
        """Asked and achieved, in words."""
        achieved = "achieved: not known yet" if self.achieved is None else f"{1 / self.achieved:.1f} achieved"
        coarser = f" (the grid is now {self.period * 1e3:g} ms)" if self.period > self.asked else ""
        return f"{1 / self.asked:g} Hz asked, {achieved}{coarser}"


def _even(period: float) -> float:
    """The next longer period (s) that people would write."""
    power = 10.0 ** math.floor(math.log10(period))
    return next(step * power for step in STEPS if step * power >= period * (1 - 1e-9))
