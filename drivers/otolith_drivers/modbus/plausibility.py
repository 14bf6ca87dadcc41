"""Plausibility of what registers hold: is the byte order right, and were the registers renewed? Pure.

A wrong byte order turns the fine steps of a signal into coarse ones: floats then change their exponent from reading to
reading or have one that no machine has, integers jump over their whole range. Such a signal is withheld before
anything is estimated from it.

Registers with noise in them seldom repeat. If they do so now and then, the device was late, and an old image under a
new time is rejected. If they repeat often, they are coarse, the machine is at rest, or the device renews them more
slowly than they are read: then repeated images are valid. Registers that move by a few steps only may repeat by
chance, and are then wrong by no more than these steps. A single repeated image is aliasing of two equally fast clocks:
it is wrong by less than a period, and is accepted.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import cycle
from statistics import fmean, median

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus.options import Order, RegisterSignal, TypeName, is_float, orders_of, reader, registers_of
from otolith_drivers.modbus.schedule import Request

# Byte order. Engineering choices, guarded as a set by tests/drivers/modbus/test_plausibility.py: all swapped orders
# of its signals are detected, and none of its setpoints, filters, counters and square waves is withheld.
MIN_READINGS = 8  # for a judgement
READINGS = 20  # looked at in a judgement
REJUDGE_ROUNDS = 100  # after which each number is judged again
MAX_DECADES = 6.0  # over which the middle half of a signal's floats may spread
JUMP_DECADES, MAX_JUMP_SHARE = 3.0, 0.25  # size of a jump from reading to reading; share of readings that may jump
SETPOINT_LEVELS = 3  # between which a setpoint may jump over decades
SMALLEST, LARGEST = 1e-12, 1e12  # magnitudes in any unit that people use
USUAL_SIZE_RATIO = 1e3  # by which a size may differ from the usual one
COARSE_CHANGE = 1e-3  # share of its range by which an integer with swapped bytes changes from reading to reading
CALMER = 30.0  # times that the mean change of another order must be smaller
MIN_STEPS = 4  # different steps of an integer, below which it may be a setpoint,
MAX_SETPOINT_CHANGES = 0.6  # if it changes in a smaller share of readings than this

# Staleness.
RARE_REPEATS = 0.1  # share of readings, below which a repeated image is old; noise of three steps repeats in 9 %
FREQUENT_REPEATS = 0.6  # share of readings, above which the user is warned; engineering choice
SHARE_WEIGHT = 0.01  # of one reading in a running share: engineering choice, a memory of 100 readings
SETTLING_READINGS = 200  # two memories, before which the initial value dominates a share
COARSE_STEPS = 16  # of a register, up to which it may repeat by chance; test_plausibility: noise of a few steps
COARSE_SHARE = 0.5  # of changes so small, above which registers are coarse; engineering choice
MAX_STALE_RUN = 100  # old images in a row; a longer run is a machine at rest (test_plausibility: one that stops)
MIN_RENEWALS, RENEWALS = 8, 100  # times between renewals of which the usual one is told; of a driver kept
REST_RATIO = 3.0  # times the median of them, above which the machine was at rest meanwhile
USUAL_SHARE = 0.15  # by which a period may differ from 1, 2, 5, 10 ... ms, to be that one

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OrderVerdict:
    """Plausibility of a number in its byte order."""

    plausible: bool
    reason: str = ""
    better: Order | None = None  # An order in which the number is plausible, if it is not in its own


def judge_order(
    history: Sequence[Sequence[int]], kind: TypeName, order: Order, usual_size: float = 0.0
) -> OrderVerdict:
    """Return the plausibility of a number whose registers were read repeatedly; too few readings are plausible.

    ``usual_size`` is the number's magnitude while it was plausible, 0 if it never was. A filter of a machine at rest
    ends in numbers that are practically zero: then only an order with numbers of the usual size is better.
    """
    if len(history) < MIN_READINGS:
        return OrderVerdict(plausible=True)
    orders = orders_of(kind)
    chosen = order if order in orders else orders[0 if order in ("ABCD", "CDAB") else 1]
    if is_float(kind) and not fault_of_floats(_numbers(history, kind, chosen)):  # the usual case, made quick
        return OrderVerdict(plausible=True)
    numbers = {other: _numbers(history, kind, other) for other in orders}
    reason = _fault(numbers, kind, chosen)
    if not reason:
        return OrderVerdict(plausible=True)
    others = [other for other in orders if other != chosen and not _fault(numbers, kind, other)]
    if not np.isfinite(numbers[chosen]).any() and len(set(map(tuple, history))) == 1:
        others = []  # what a device writes that has no reading is plausible in some wrong orders
    if usual_size and is_float(kind) and _size(numbers[chosen]) < SMALLEST:
        low, high = usual_size / USUAL_SIZE_RATIO, usual_size * USUAL_SIZE_RATIO
        others = [other for other in others if low < _size(numbers[other]) < high]
        if not others:
            return OrderVerdict(plausible=True)
    better = min(others, key=lambda other: _relative_change(numbers[other]), default=None)
    return OrderVerdict(plausible=False, reason=reason, better=better)


def fault_of_floats(numbers: Array) -> str:
    """Return why no machine has these ``numbers``; empty if one could.

    Single NaN or infinite numbers are no fault: devices write them if they have no reading.
    """
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return "none of the readings is a number"
    sizes = np.abs(finite[finite != 0.0])
    if not len(sizes):
        return ""
    median = float(np.median(sizes))
    if not SMALLEST <= median <= LARGEST:
        return f"it reads {median:.3g}, which no machine has"
    return _fault_of_magnitudes(np.log10(sizes))


def _fault_of_magnitudes(logs: Array) -> str:
    """Return a fault if the magnitudes (decades) jump again and again between more levels than a setpoint has."""
    low, high = np.quantile(logs, (0.25, 0.75))
    if high - low <= MAX_DECADES or np.mean(np.abs(np.diff(logs)) > JUMP_DECADES) < MAX_JUMP_SHARE:
        return ""
    gaps = np.sort(np.diff(np.sort(logs)[len(logs) // 10 : len(logs) - len(logs) // 10]))
    return f"it jumps over {high - low:.0f} decades" if gaps[: 1 - SETPOINT_LEVELS].sum() > MAX_DECADES else ""


def _fault(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    if is_float(kind):
        return fault_of_floats(numbers[order])
    whole = 2.0 ** (16 * registers_of(kind))
    changes = {other: _mean_change(values, whole) for other, values in numbers.items()}
    calmest = min(changes.values())
    steps = np.diff(np.unique(numbers[order]))
    setpoint = len(steps) < MIN_STEPS and np.mean(np.diff(numbers[order]) != 0.0) < MAX_SETPOINT_CHANGES
    if not setpoint and changes[order] > COARSE_CHANGE * whole and changes[order] > CALMER * calmest:
        return f"it jumps by {changes[order] / whole:.1%} of its whole range from reading to reading"
    if len(steps) >= MIN_STEPS and changes[order] > calmest and not np.any(np.fmod(steps, 256)):
        return "it only ever changes by multiples of 256"
    return ""


def _mean_change(numbers: Array, whole: float) -> float:
    """Return the mean change from reading to reading; a counter that wraps changes little."""
    changes = np.abs(np.diff(numbers))
    return float(np.mean(np.minimum(changes, whole - changes)))


def _relative_change(numbers: Array) -> float:
    """Return the mean change from reading to reading as a share of the mean magnitude."""
    size = float(np.mean(np.abs(numbers)))
    return float(np.mean(np.abs(np.diff(numbers)))) / size if size else 0.0


def _size(numbers: Array) -> float:
    """Return the median magnitude of the finite numbers other than zero; 0 if there is none."""
    sizes = np.abs(numbers[np.isfinite(numbers) & (numbers != 0.0)])
    return float(np.median(sizes)) if len(sizes) else 0.0


def _numbers(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> Array:
    read = reader(kind, order)
    return np.array([read(registers[: registers_of(kind)]) for registers in history], dtype=np.float64)


class OrderMonitor:
    """Judges the byte order of all numbers with more than one register, each again from time to time."""

    def __init__(self, signals: Sequence[RegisterSignal]) -> None:
        self._signals = {signal.name: signal for signal in signals if signal.count > 1 and not signal.source.trusted}
        self._history: dict[str, deque[Sequence[int]]] = {name: deque(maxlen=READINGS) for name in self._signals}
        self._verdicts: dict[str, OrderVerdict] = {}
        self._usual_sizes: dict[str, float] = {}
        self.withheld: frozenset[str] = frozenset()  # Names of the signals that are not plausible now
        self._next = cycle(self._signals or [""])
        self._rounds = 0

    def is_unjudged(self, name: str) -> bool:
        """Whether the signal waits for its first judgement."""
        return name in self._signals and name not in self._verdicts

    def take(self, signal: RegisterSignal, registers: Sequence[int]) -> None:
        """Add a reading."""
        history = self._history.get(signal.name)
        if history is not None:
            history.append(registers)

    def end_round(self) -> None:
        """Judge the signals that were never judged, one that is withheld, and from time to time one of all."""
        self._rounds += 1
        due = {name for name in self._signals if name not in self._verdicts}
        if self.withheld:
            due.add(sorted(self.withheld)[self._rounds % len(self.withheld)])
        if self._rounds % max(1, REJUDGE_ROUNDS // max(1, len(self._signals))) == 0:
            due.add(next(self._next))
        due = {name for name in due if len(self._history.get(name, ())) == READINGS}
        for name in due:
            self._judge(name)
        if due:
            self.withheld = frozenset(name for name, verdict in self._verdicts.items() if not verdict.plausible)

    def _judge(self, name: str) -> None:
        signal, history = self._signals[name], self._history[name]
        verdict = judge_order(history, signal.kind, signal.order, self._usual_sizes.get(name, 0.0))
        self._verdicts[name] = verdict
        if verdict.plausible and (size := _size(_numbers(history, signal.kind, signal.order))) >= SMALLEST:
            self._usual_sizes[name] = size

    def warnings(self) -> list[str]:
        """Return a line with reason and remedy for each withheld signal."""
        lines = []
        for name, verdict in list(self._verdicts.items()):
            if verdict.plausible:
                continue
            remedy = "no order of its bytes makes it plausible: is the register or type wrong?"
            if verdict.better:
                remedy = f'as {verdict.better} it would be plausible: set order = "{verdict.better}", '
                remedy += "unless the register is one off"
            where = self._signals[name].describe()
            lines.append(f"{name} ({where}) is withheld: {verdict.reason}; {remedy}, or set trusted = true")
        return lines


def renewal_period(intervals: Sequence[float]) -> float | None:
    """Return the time between renewals of registers while the machine moves, rounded; None if there are too few.

    ``intervals`` are the times from change to change as readings show them, so that each is a multiple of theirs.
    """
    if len(intervals) < MIN_RENEWALS:
        return None
    longest = REST_RATIO * median(intervals)
    mean = fmean(each for each in intervals if each <= longest)
    decade = 10.0 ** math.floor(math.log10(mean))
    usual = min((decade * step for step in (1.0, 2.0, 5.0, 10.0)), key=lambda each: abs(math.log(mean / each)))
    return float(f"{usual if abs(mean / usual - 1.0) <= USUAL_SHARE else mean:.2g}")


@dataclass(slots=True)
class _Repeats:
    """Running shares of one request; a device may repeat itself until it has shown otherwise."""

    image: Sequence[int] | None = None
    readings: int = 0
    run: int = 0  # Repeated images in a row
    renewals: deque[int] = field(default_factory=lambda: deque(maxlen=RENEWALS))  # Readings from change to change
    share: float = 1.0  # Share of readings that repeat the previous one
    run_share: float = 1.0  # The same with each run counted once
    coarse_share: float = 1.0  # Share of changes by a few steps only


class StalenessMonitor:
    """Detects old images in the answers to all requests of a driver."""

    def __init__(self) -> None:
        self._repeats: dict[Request, _Repeats] = {}

    def take(self, request: Request, registers: Sequence[int]) -> tuple[bool, bool]:
        """Return whether ``registers`` repeat the previous ones, and whether they are an old image."""
        state = self._repeats.setdefault(request, _Repeats())
        previous, state.image = state.image, registers
        repeated = previous == registers
        state.readings += 1
        if previous is not None and not repeated and state.run <= MAX_STALE_RUN:
            state.renewals.append(state.run + 1)
        state.run = state.run + 1 if repeated else 0
        stale = 1 < state.run <= MAX_STALE_RUN and state.run_share < RARE_REPEATS and state.coarse_share < COARSE_SHARE
        state.share += SHARE_WEIGHT * (repeated - state.share)
        if state.run <= 1:
            state.run_share += SHARE_WEIGHT * (repeated - state.run_share)
        if previous is not None and not repeated:
            state.coarse_share += SHARE_WEIGHT * (_is_near(previous, registers) - state.coarse_share)
        return repeated, stale

    def warnings(self, requests: Sequence[Request], period: float) -> list[str]:
        """Return a line for each request whose registers repeat too often for a period of ``period`` s."""
        states = [(request, self._repeats.get(request, _Repeats())) for request in requests]
        return [
            f"{request.describe()} repeat in {state.share:.0%} of the readings: the machine is at rest, or the device "
            f"renews them {_renewal_text(state.renewals, period)}"
            for request, state in states
            if state.readings >= SETTLING_READINGS and FREQUENT_REPEATS < state.share < 1.0 - SHARE_WEIGHT
        ]


def _renewal_text(renewals: Sequence[int], period: float) -> str:
    """Return how often registers are renewed that are read every ``period`` s, and what to write."""
    usual = renewal_period([period * each for each in list(renewals)])
    if usual is None or usual <= period:
        return f"more slowly than every {period * 1e3:g} ms"
    return f'about every {usual * 1e3:g} ms: write sample_period = "{usual * 1e3:g} ms"'


def _is_near(before: Sequence[int], after: Sequence[int]) -> bool:
    """Whether no register has moved by more than a few steps, the shorter way round."""
    steps = ((new - old) % 65536 for old, new in zip(before, after, strict=True))
    return all(step <= COARSE_STEPS or step >= 65536 - COARSE_STEPS for step in steps)
