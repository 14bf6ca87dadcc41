"""Whether registers read in a certain order make a number that a machine could have. Pure.

A wrong order turns the fine steps of a signal into its coarse ones. Floating-point numbers then change their exponent
from reading to reading, or have one that no machine knows; integers jump over their whole range.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus_types import Order, TypeName, is_float, orders_of, reader, registers_of

Array = NDArray[np.float64]

FEWEST = 8  # readings that a judgement needs
DECADES = 6.0  # over which the middle half of a signal's numbers may spread
JUMP, OFTEN = 3.0, 0.25  # decades from reading to reading; share of readings
LEVELS = 3  # between which a signal may jump over decades, as set-points do
MUCH = 1e3  # times the usual size
SMALLEST, LARGEST = 1e-12, 1e12  # magnitudes in any unit that people use
COARSE = 1e-3  # of its whole range, by which an integer changes from reading to reading when bytes are swapped
BYTE = 256
FEWEST_STEPS = 4  # between different numbers, before their size says anything
OFTEN_CHANGED = 0.6  # share of readings, from which on a few numbers are no levels of a set-point
TIMES = 30.0  # how much calmer another order must be


@dataclass(frozen=True, slots=True)
class Judgement:
    """On the order of a number's bytes."""

    plausible: bool
    reason: str = ""
    better: Order | None = None
    """An order in which the numbers are plausible, where these are not."""


def judge(history: Sequence[Sequence[int]], kind: TypeName, order: Order, usual: float = 0.0) -> Judgement:
    """Of the registers of one number, read again and again; what is not enough to judge counts as plausible.

    ``usual`` is the size that the number had while it was plausible, 0 if it never was: a filter of a machine at rest
    ends in numbers that are as good as zero, and only another order that makes the usual ones of them is better.
    """
    if len(history) < FEWEST:
        return Judgement(plausible=True)
    orders = orders_of(kind)
    chosen = _among(orders, order)
    if is_float(kind) and not fault_of_floats(_numbers(history, kind, chosen)):  # seldom is more than this needed
        return Judgement(plausible=True)
    numbers = {other: _numbers(history, kind, other) for other in orders}
    reason = _fault(numbers, kind, chosen)
    if not reason:
        return Judgement(plausible=True)
    others = [other for other in orders if other != chosen and not _fault(numbers, kind, other)]
    if usual and is_float(kind) and _size(numbers[chosen]) < SMALLEST:
        others = [other for other in others if usual / MUCH < _size(numbers[other]) < usual * MUCH]
        if not others:
            return Judgement(plausible=True)
    better = min(others, key=lambda other: _roughness(numbers[other]), default=None)
    return Judgement(plausible=False, reason=reason, better=better)


def usual_size(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> float:
    """Of the numbers; 0 where they are all too small to tell."""
    size = _size(_numbers(history, kind, order))
    return size if size >= SMALLEST else 0.0


def _among(orders: tuple[Order, ...], order: Order) -> Order:
    return order if order in orders else orders[0 if order in ("ABCD", "CDAB") else 1]


def _size(numbers: Array) -> float:
    sizes = np.abs(numbers[np.isfinite(numbers) & (numbers != 0.0)])
    return float(np.median(sizes)) if len(sizes) else 0.0


def _numbers(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> Array:
    read = reader(kind, order)
    return np.array([read(registers[: registers_of(kind)]) for registers in history], dtype=np.float64)


def _fault(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    """What is wrong with the numbers in this order; nothing if they will do."""
    return fault_of_floats(numbers[order]) if is_float(kind) else _fault_of_integers(numbers, kind, order)


def fault_of_floats(numbers: Array) -> str:
    """What is wrong with ``numbers`` as readings of a machine, in words; nothing if they will do.

    Those that are no numbers are how a device says that it has no reading; such a reading is none in any order.
    """
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return "none of the readings is a number"
    sizes = np.abs(finite[finite != 0.0])
    if not len(sizes):
        return ""
    middle = float(np.median(sizes))
    if not SMALLEST <= middle <= LARGEST:
        return f"it reads {middle:.3g}, which no machine has"
    return _wild(np.log10(sizes))


def _wild(logs: Array) -> str:
    """Whether numbers are scattered over decades, and that again and again: a set-point jumps between a few levels."""
    low, high = np.quantile(logs, (0.25, 0.75))
    if high - low <= DECADES or np.mean(np.abs(np.diff(logs)) > JUMP) < OFTEN:
        return ""
    apart = np.sort(np.diff(np.sort(logs)[len(logs) // 10 : len(logs) - len(logs) // 10]))
    return f"it jumps over {high - low:.0f} decades" if apart[: 1 - LEVELS].sum() > DECADES else ""


def _fault_of_integers(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    whole = 2.0 ** (16 * registers_of(kind))
    jumps = {other: _jump(found, whole) for other, found in numbers.items()}
    calmest = min(jumps.values())
    steps = np.diff(np.unique(numbers[order]))
    held = len(steps) < FEWEST_STEPS and np.mean(np.diff(numbers[order]) != 0.0) < OFTEN_CHANGED  # as set-points are
    if not held and jumps[order] > COARSE * whole and jumps[order] > TIMES * calmest:
        return f"it jumps by {jumps[order] / whole:.1%} of its whole range from reading to reading"
    if len(steps) >= FEWEST_STEPS and jumps[order] > calmest and not np.any(np.fmod(steps, BYTE)):
        return f"it only ever changes by multiples of {BYTE}"
    return ""


def _jump(numbers: Array, whole: float) -> float:
    """The mean one from reading to reading, the shorter way round: a counter that wraps does not jump."""
    jumps = np.abs(np.diff(numbers))
    return float(np.mean(np.minimum(jumps, whole - jumps)))


def _roughness(numbers: Array) -> float:
    """How much numbers change from reading to reading, as a share of their size."""
    size = float(np.mean(np.abs(numbers)))
    return float(np.mean(np.abs(np.diff(numbers)))) / size if size else 0.0
