"""Which registers are read together, which requests are sent now, and when the next round starts. Pure.

All times are in s and come in as arguments. Rounds start on a grid of absolute times, so that a late round does not
delay the next ones. If the line is too slow for the requested period, the grid becomes as coarse as needed, because
estimation needs evenly spaced samples more than many samples.
"""

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from otolith_drivers.modbus.client import (
    BUSY_CODES,
    GATEWAY_CODES,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    PERMANENT_CODES,
    ExceptionReplyError,
)
from otolith_drivers.modbus.options import BIT_TABLES, RegisterSignal, Table

# Requests. Engineering choices, guarded by tests/drivers/modbus/test_schedule.py.
MAX_FAILURES = 3  # in a row before a request or device is paused; one timeout on a noisy line is no dead device
MIN_PAUSE, MAX_PAUSE = 1.0, 10.0  # s, doubled from one to the other: a device that returns is read again within 10 s
TABLE_DIGITS = {"holding": 4, "input": 3, "discrete": 1}  # before a register in manuals that count from 40001

# Rounds: decisions about the grid.
DECISION_ROUNDS = 50  # engineering choice: half a second at 100 Hz, and enough for a median
MAX_LOAD = 0.95  # share of the period beyond which rounds leave no room for delays; engineering choice
PERIOD_MARGIN = 1.15  # new period over the round's duration; engineering choice, more than 1 / MAX_LOAD
MAX_SKIPPED_SHARE = 0.2  # of rounds; test_schedule: a computer that is busy now and then must not change the grid
MAX_SKIPPED_AT_ONCE = 2  # rounds counted for one delay: a timeout skips more, and is not the line's speed
SLOW_DECISIONS = 2  # in a row, and
SLOW_TIME = 3.0  # s of evidence before the grid is coarsened; a computer with stolen time was slow for half a second
FAST_DECISIONS = 20  # in a row before a finer grid is tried again; engineering choice
ROUND_STEPS = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # times a power of ten: usual periods

# Aliasing: the device renews its registers as often as they are read, at nearly the same time.
ALIASED_SHARES = (0.02, 0.6)  # of rounds that repeat the previous one; beyond, registers are coarse or at rest
ALIASING_ROUNDS = 100  # per check
SHIFTS_PER_PERIOD = 4  # phases that are tried: every quarter of a period
MAX_CHECKS_BETWEEN_SHIFTS = 64  # where shifts do not help; test_schedule: at most 15 shifts in 20 000 rounds


@dataclass(frozen=True, slots=True, eq=False)
class Request:
    """Registers of one device that are read at once."""

    device: int
    table: Table
    address: int
    count: int
    signals: tuple[RegisterSignal, ...]  # In the order of their addresses

    @property
    def samples(self) -> int:
        """Number of samples in an answer."""
        return sum(signal.is_sampled for signal in self.signals)

    @classmethod
    def of(cls, signals: Sequence[RegisterSignal]) -> "Request":
        """Return the request that reads ``signals``, which are sorted by address."""
        first, end = signals[0], max(signal.end for signal in signals)
        return cls(first.device, first.table, first.address, end - first.address, tuple(signals))

    def describe(self) -> str:
        """Return device and registers in words, as the machine file counts them."""
        first = self.address + self.signals[0].source.register_ - self.signals[0].address
        noun = BIT_TABLES.get(self.table, f"{self.table} register")
        return f"device {self.device}, {noun}s {first} to {first + self.count - 1}"


def plan(signals: Iterable[RegisterSignal], max_gap: int, max_registers: int) -> tuple[Request, ...]:
    """Return the fewest requests for ``signals`` with gaps of at most ``max_gap`` and at most ``max_registers``."""
    groups: list[list[RegisterSignal]] = []
    end = 0
    for signal in sorted(signals, key=lambda signal: (signal.device, signal.table, signal.address, signal.end)):
        first = groups[-1][0] if groups else signal
        fits = signal.address - end <= max_gap and max(end, signal.end) - first.address <= max_registers
        if groups and fits and (signal.device, signal.table) == (first.device, first.table):
            groups[-1].append(signal)
            end = max(end, signal.end)
        else:
            groups.append([signal])
            end = signal.end
    return tuple(map(Request.of, groups))


def split(request: Request) -> tuple[Request, ...]:
    """Return the same signals in two requests, cut at the widest gap; the request itself if it cannot be cut.

    A device that refuses a request may refuse only unneeded registers in it, or only one of its signals.
    """
    signals = request.signals
    ends = [max(signal.end for signal in signals[: at + 1]) for at in range(len(signals))]
    gaps = [signals[at].address - ends[at - 1] for at in range(1, len(signals))]
    if not gaps or max(gaps) < 0:  # a single signal, or overlapping ones
        return (request,)
    middle = len(signals) / 2
    at = 1 + max(range(len(gaps)), key=lambda index: (gaps[index], -abs(index + 1 - middle)))
    return Request.of(signals[:at]), Request.of(signals[at:])


def summary(requests: Sequence[Request]) -> str:
    """Return the number of requests and registers in words."""
    registers = sum(request.count for request in requests)
    return f"{len(requests)} request{'s' * (len(requests) != 1)}, {registers} register{'s' * (registers != 1)}"


@dataclass(slots=True)
class Backoff:
    """Failures in a row of a request or a device, and the pause that they cause."""

    failures: int = 0
    fault: str = ""
    since: float = 0.0  # Time of the first failure in s
    until: float = 0.0  # End of the pause in s; 0 if there is none

    def fail(self, fault: str, now: float, max_failures: float) -> None:
        """Count a failure; from ``max_failures`` in a row on, pause, each time twice as long."""
        if not self.failures:
            self.since = now
        self.failures += 1
        self.fault = fault
        if self.failures >= max_failures:
            self.until = now + min(MIN_PAUSE * 2.0 ** (self.failures - max_failures), MAX_PAUSE)

    def reset(self) -> None:
        """Forget all failures after a success."""
        self.failures, self.fault, self.until = 0, "", 0.0

    @property
    def paused(self) -> bool:
        """Whether there were too many failures since the last success."""
        return self.until > 0.0


@dataclass(slots=True)
class RequestSet:
    """All requests of a driver, with the backoff of each request and device, so that a fault affects nothing else."""

    requests: tuple[Request, ...]
    _by_request: defaultdict[Request, Backoff] = field(default_factory=lambda: defaultdict(Backoff))
    _by_device: defaultdict[int, Backoff] = field(default_factory=lambda: defaultdict(Backoff))

    def due(self, now: float) -> list[Request]:
        """Return the requests to send now, healthy devices first; only one request for a device that failed."""
        chosen: list[Request] = []
        devices: set[int] = set()
        for request in sorted(self.requests, key=lambda request: self._by_device[request.device].failures > 0):
            device = self._by_device[request.device]
            waits = now < max(device.until, self._by_request[request].until)
            if not waits and not (device.failures and request.device in devices):
                devices.add(request.device)
                chosen.append(request)
        return chosen

    def answered(self, request: Request) -> None:
        """Note that the request was answered."""
        self._by_device[request.device].reset()
        self._by_request[request].reset()

    def unanswered(self, request: Request, fault: str, now: float) -> None:
        """Note that the device did not answer."""
        self._by_device[request.device].fail(fault, now, MAX_FAILURES)

    def refused(self, request: Request, error: ExceptionReplyError, now: float) -> None:
        """Note that the device answered with an exception; split the request if it is permanent, pause if not busy."""
        if error.code in GATEWAY_CODES:
            self.unanswered(request, str(error), now)
            return
        self._by_device[request.device].reset()
        permanent = error.code in PERMANENT_CODES
        parts = split(request) if permanent else (request,)
        if len(parts) > 1:
            at = self.requests.index(request)
            self.requests = (*self.requests[:at], *parts, *self.requests[at + 1 :])
            self._by_request.pop(request, None)
        else:
            limit = math.inf if error.code in BUSY_CODES else 1 if permanent else MAX_FAILURES
            self._by_request[request].fail(f"{error}{_hint(request, error)}", now, limit)

    @property
    def all_silent(self) -> bool:
        """Whether every device is paused."""
        return all(self._by_device[request.device].paused for request in self.requests)

    def warnings(self, now: float) -> list[str]:
        """Return a line for each paused device and request, and for each request that the device is too busy for."""
        lines = [
            f"device {number} does not answer for {now - backoff.since:.0f} s: {backoff.fault}; retried"
            for number, backoff in list(self._by_device.items())
            if backoff.paused
        ]
        for request, backoff in list(self._by_request.items()):
            if backoff.paused:
                names = ", ".join(signal.name for signal in request.signals)
                lines.append(f"{names}: {request.describe()} refused: {backoff.fault}; retried after a pause")
            elif backoff.failures >= MAX_FAILURES:
                where, seconds = request.describe(), now - backoff.since
                lines.append(f"{where}: no values for {seconds:.0f} s: {backoff.fault}; repeated in each round")
        return lines


def _hint(request: Request, error: ExceptionReplyError) -> str:
    """Return what may help, as the end of a sentence; empty if nothing is known."""
    other = {"holding": "input", "coil": "discrete"}.get(request.table)
    if error.code == ILLEGAL_FUNCTION and other is not None:
        return f'; try table = "{other}"'
    if error.code == ILLEGAL_ADDRESS and request.address // 10_000 == (digit := TABLE_DIGITS.get(request.table)):
        return f"; where a manual says {digit}0103, write first_address = 1 and register = 103"
    return ""


class PollSchedule:
    """The grid of rounds: when the next one is due, and which period the line can keep."""

    def __init__(self, requested: float) -> None:
        self.requested = requested
        self.period = requested
        self.due = math.inf
        self.known = False  # Whether enough rounds have passed to know that the line keeps the period
        self._starts: deque[float] = deque(maxlen=DECISION_ROUNDS + 1)
        self._durations: list[float] = []
        self._skipped = self._slow = self._fast = 0
        self._slow_time = 0.0
        self._rounds = self._repeats = 0
        self._checks = self._shifts = 0

    def start(self, now: float) -> None:
        """Start the grid at ``now``."""
        self.due = now

    def begin(self, now: float) -> int:
        """Begin a round; return how many rounds before it were skipped."""
        behind = self._behind(now)
        self.due += (behind + 1) * self.period
        self._skipped += min(behind, MAX_SKIPPED_AT_ONCE)
        self._starts.append(now)
        return behind

    def pass_over(self, now: float) -> int:
        """Skip the rounds that fell due while the line was down; return how many."""
        missed = self._behind(now) + 1 if now >= self.due else 0
        self.due += missed * self.period
        self._starts.clear()
        return missed

    def _behind(self, now: float) -> int:
        return max(0, math.floor((now - self.due) / self.period))

    def end(self, duration: float, *, repeated: bool) -> bool:
        """End a round of ``duration`` s in which all devices answered; return whether the period changed.

        ``repeated`` is whether each register had the value of the previous round. If some rounds do, the device renews
        its registers at the time of reading, so the grid is shifted away from that time.
        """
        self._durations.append(duration)
        self._rounds += 1
        self._repeats += repeated
        if self._rounds >= ALIASING_ROUNDS:
            low, high = ALIASED_SHARES
            self._shift(aliased=low <= self._repeats / self._rounds <= high)
            self._rounds = self._repeats = 0
        if len(self._durations) < DECISION_ROUNDS:
            return False
        period = self._best_period()
        self._durations.clear()
        self._skipped, self.known = 0, self._slow == 0
        if period == self.period:
            return False
        self.due += period - self.period
        self.period = period
        self._starts.clear()
        return True

    def _shift(self, *, aliased: bool) -> None:
        """Shift the grid by a part of the period; ever more seldom, as coarse registers look like aliasing."""
        self._checks += 1
        if not aliased:
            self._shifts = max(0, self._shifts - 1)
        elif self._checks >= min(2 ** max(0, self._shifts - SHIFTS_PER_PERIOD), MAX_CHECKS_BETWEEN_SHIFTS):
            self.due += self.period / SHIFTS_PER_PERIOD
            self._checks, self._shifts = 0, self._shifts + 1

    def _best_period(self) -> float:
        """Return the period (s) that the last rounds suggest."""
        median = sorted(self._durations)[DECISION_ROUNDS // 2]
        overloaded = median > MAX_LOAD * self.period
        skipped = self._skipped / (DECISION_ROUNDS + self._skipped)
        if overloaded or skipped > MAX_SKIPPED_SHARE:
            self._slow, self._fast = self._slow + 1, 0
            self._slow_time += DECISION_ROUNDS * max(median, self.period)
            if self._slow < SLOW_DECISIONS or self._slow_time < SLOW_TIME:
                return self.period
            self._slow_time = 0.0
            return _usual_period(PERIOD_MARGIN * median if overloaded else self.period / (1.0 - skipped))
        self._slow, self._slow_time = 0, 0.0
        finer = max(self.requested, _usual_period(PERIOD_MARGIN * median))
        self._fast = self._fast + 1 if finer < self.period else 0
        if self._fast < FAST_DECISIONS:
            return self.period
        self._fast = 0
        return finer

    @property
    def achieved(self) -> float | None:
        """Mean time from round to round in s; None while too few rounds have followed each other."""
        starts = tuple(self._starts)  # another thread may clear it
        if len(starts) < DECISION_ROUNDS // 2:
            return None
        return (starts[-1] - starts[0]) / (len(starts) - 1)

    def describe(self) -> str:
        """Return the requested and achieved rate in words."""
        period = self.achieved
        achieved = "achieved: not known yet" if period is None else f"{1 / period:.1f} achieved"
        coarser = f" (the grid is now {self.period * 1e3:g} ms)" if self.is_slow else ""
        return f"{1 / self.requested:g} Hz asked, {achieved}{coarser}"

    @property
    def is_slow(self) -> bool:
        """Whether the line or this computer is slower than requested."""
        return self.period > self.requested

    def describe_period(self) -> str:
        """Return the present and the requested period in words, for the moment at which the present one begins."""
        if not self.is_slow:
            return f"read every {self.period * 1e3:g} ms again, as asked"
        asked = f"instead of every {self.requested * 1e3:g} ms"
        return f"read every {self.period * 1e3:g} ms from now on, {asked}: a round of requests takes too long for that"


def _usual_period(period: float) -> float:
    """Return the next longer usual period in s."""
    power = 10.0 ** math.floor(math.log10(period))
    return next(step * power for step in ROUND_STEPS if step * power >= period * (1 - 1e-9))
