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
SMALLEST, LARGEST = 1e-12, 1e12  # magnitudes in any unit that people use
COARSE = 1e-3  # of its whole range, by which an integer changes from reading to reading when bytes are swapped
BYTE = 256
FEWEST_STEPS = 4  # between different numbers, before their size says anything
TIMES = 30.0  # how much calmer another order must be


@dataclass(frozen=True, slots=True)
class Judgement:
    """On the order of a number's bytes."""

    plausible: bool
    reason: str = ""
    better: Order | None = None
    """An order in which the numbers are plausible, where these are not."""


def judge(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> Judgement:
    """Of the registers of one number, read again and again; what is not enough to judge counts as plausible."""
    if len(history) < FEWEST:
        return Judgement(plausible=True)
    orders = orders_of(kind)
    chosen = order if order in orders else orders[0 if order in ("ABCD", "CDAB") else 1]
    if is_float(kind) and not fault_of_floats(_numbers(history, kind, chosen)):  # seldom is more than this needed
        return Judgement(plausible=True)
    numbers = {other: _numbers(history, kind, other) for other in orders}
    reason = _fault(numbers, kind, chosen)
    if not reason:
        return Judgement(plausible=True)
    others = [other for other in orders if other != chosen and not _fault(numbers, kind, other)]
    better = min(others, key=lambda other: _roughness(numbers[other]), default=None)
    return Judgement(plausible=False, reason=reason, better=better)


def _numbers(history: Sequence[Sequence[int]], kind: TypeName, order: Order) -> Array:
    read = reader(kind, order)
    return np.array([read(registers[: registers_of(kind)]) for registers in history], dtype=np.float64)


def _fault(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    """What is wrong with the numbers in this order; nothing if they will do."""
    return fault_of_floats(numbers[order]) if is_float(kind) else _fault_of_integers(numbers, kind, order)


def fault_of_floats(numbers: Array) -> str:
    """What is wrong with ``numbers`` as readings of a machine, in words; nothing if they will do."""
    finite = np.isfinite(numbers)
    if finite.mean() < 0.9:
        return f"{np.mean(~finite):.0%} of the readings are no numbers"
    sizes = np.abs(numbers[finite & (numbers != 0.0)])
    if not len(sizes):
        return ""
    middle = float(np.median(sizes))
    if not SMALLEST <= middle <= LARGEST:
        return f"it reads {middle:.3g}, which no machine has"
    low, high = np.quantile(np.log10(sizes), (0.25, 0.75))
    if high - low > DECADES:
        return f"it jumps over {high - low:.0f} decades"
    return ""


def _fault_of_integers(numbers: dict[Order, Array], kind: TypeName, order: Order) -> str:
    jumps = {other: float(np.mean(np.abs(np.diff(found)))) for other, found in numbers.items()}
    whole = 2.0 ** (16 * registers_of(kind))
    if jumps[order] > COARSE * whole and jumps[order] > TIMES * min(jumps.values()):
        return f"it jumps by {jumps[order] / whole:.1%} of its whole range from reading to reading"
    steps = np.diff(np.unique(numbers[order]))
    if len(steps) >= FEWEST_STEPS and not np.any(np.fmod(steps, BYTE)):
        return f"it only ever changes by multiples of {BYTE}"
    return ""


def _roughness(numbers: Array) -> float:
    """How much numbers change from reading to reading, as a share of their size."""
    size = float(np.mean(np.abs(numbers)))
    return float(np.mean(np.abs(np.diff(numbers)))) / size if size else 0.0
