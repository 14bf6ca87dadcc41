"""Infer from repeated readings which bytes are numbers, and of which type and byte order. Pure.

A machine's signals change little from reading to reading. So of all ways to cut the bytes into numbers, the one whose
changes take the fewest bits to write down is the most probable (minimum description length). A number that is cut in
two leaves a low half that jumps over its whole range; a number in a wrong order changes in coarse steps. Bytes that do
not change carry no information about their type, and none is inferred.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus.options import (
    BYTES_SWAPPED,
    LETTERS,
    WORDS_SWAPPED,
    Order,
    TypeName,
    orders_of,
    registers_of,
)
from otolith_drivers.modbus.plausibility import fault_of_floats

# Costs in bits. The prior of a type is roughly the negative logarithm of how common it is; the other costs are weighed
# against it. All are engineering choices that tests/drivers/test_number_inference.py guards as a set.
REGISTER_PRIORS = {"int16": 2.0, "int32": 5.0, "float32": 1.0, "int64": 8.0, "float64": 6.0}
ORDER_PRIORS: dict[Order, float] = {"ABCD": 0.0, "CDAB": 0.25, "BADC": 5.0, "DCBA": 5.25}
FRAME_PRIORS = {1: 6.0, 2: 1.0, 3: 4.0, 4: 3.0}  # by bytes
STILL_BITS = 0.5  # for each byte that does not change
CHANGE_BITS = 3.0  # for each change beside its size: the sign, and the spread of sizes
INTEGER_SIZE_BITS = 0.3  # for each bit of an integer's size: large integers are less common
WRAP_BITS = 30.0  # for each step over more than half of an integer's range
COUNTER_BITS = 2.0  # for each byte of a counter
ERRATIC_BITS = 10.0  # for each moving byte and change of an erratic number

MIN_READINGS = 8  # for a verdict beyond "likely"
MIN_DISTINCT = 8  # values of an erratic number
MAX_MEAN_STEP = 0.25  # share of the range, beyond which a number is erratic; the mean step of uniform noise is 1/3
COUNTING_SHARE = 0.9  # of steps that are +1, from which on a number is a counter
TRUNCATED_SHARE = 0.25  # of changes that reach the last moving bit, above which a float is cut off there
CERTAIN_MARGIN = 8.0  # bits (odds of 256:1) by which a certain number is ahead of any other,
CERTAIN_MARGIN_PER_CHANGE = 0.3  # and for each change of long numbers, of which the model is no better than this
LOW_HALF_SIZE = 0x2000  # magnitude from which a register may be the low half of a number whose high half is still
LIKELY_FLOATS = (1e-6, 1e8)  # median magnitudes of most signals in the units that people use
MAX_WRITTEN = 30  # values whose decimal digits are counted, to bound the time
MAX_PROBABILITY = 0.95  # of an inferred number; more are not right (see the page of thresholds)
MAX_OTHERS = 3  # alternatives reported for one number

MAX_WIDTH = 8  # bytes of a number
FRACTION_BITS = {4: 24, 8: 53}  # of IEEE 754 floats, by bytes

Bytes = NDArray[np.uint8]  # Readings by bytes
Floats = NDArray[np.float64]
Ranks = NDArray[np.int64] | NDArray[np.uint64]


@dataclass(frozen=True)
class Layout:
    """A way to read bytes as a number."""

    kind: str  # "int16", "uint24", "float32"
    order: str  # As the machine file writes it: "CDAB", "little"
    positions: tuple[int, ...]  # Positions of the number's bytes, the highest byte first
    prior: float  # Cost of the type and order in bits

    @property
    def width(self) -> int:
        """Number of bytes."""
        return len(self.positions)

    @property
    def is_float(self) -> bool:
        """Whether the type is a float."""
        return self.kind.startswith("float")

    @property
    def signed(self) -> bool:
        """Whether the number can be negative."""
        return not self.kind.startswith("u")

    @cached_property
    def name(self) -> str:
        """Type and order for tables; the order is left out where it is the usual one."""
        return self.kind if self.width == 1 or (self.width, self.order) == (2, "ABCD") else f"{self.kind} {self.order}"

    def numbers(self, data: Bytes) -> Floats:
        """Return the number in each reading."""
        if not self.is_float:
            return self.ranks(data).astype(np.float64)
        high_first = np.ascontiguousarray(data[:, self.positions])
        with np.errstate(invalid="ignore"):
            numbers: Floats = high_first.view(f">f{self.width}")[:, 0].astype(np.float64)
        return numbers

    def ranks(self, data: Bytes) -> Ranks:
        """Return integers in the order of the numbers: an integer itself, or the count of floats from 0 to a float."""
        whole = np.zeros(len(data), dtype=np.uint64)
        for position in self.positions:
            whole = (whole << np.uint64(8)) | data[:, position].astype(np.uint64)
        if self.is_float:
            sign = np.uint64(1 << (8 * self.width - 1))
            size = (whole & ~sign).view(np.int64)
            return np.where(whole & sign, -size, size)
        if not self.signed:
            return whole if self.width == MAX_WIDTH else whole.view(np.int64)
        spare = 8 * (MAX_WIDTH - self.width)
        return (whole << np.uint64(spare)).view(np.int64) >> np.int64(spare)

    def fault(self, numbers: Floats) -> str:
        """Return why no machine has these numbers; empty if one could, as for all integers."""
        if not self.is_float:
            return ""
        return fault_of_floats(numbers) if (numbers != 0.0).any() else "it is always zero, with or without a sign"

    def is_likely_float(self, numbers: Floats) -> bool:
        """Whether these are floats of a usual magnitude."""
        if not self.is_float or not np.isfinite(numbers).all():
            return False
        low, high = LIKELY_FLOATS
        return bool(low <= np.median(np.abs(numbers[numbers != 0.0])) <= high)


def register_layouts(kind: TypeName) -> tuple[Layout, ...]:
    """Return the layouts of a type in Modbus registers, one for each order."""
    prior, width = REGISTER_PRIORS[kind.removeprefix("u")], 2 * registers_of(kind)
    return tuple(
        Layout(kind, order, _register_positions(width, order), prior + ORDER_PRIORS[order]) for order in orders_of(kind)
    )


def _register_positions(width: int, order: Order) -> tuple[int, ...]:
    words = [(at + 1, at) if order in BYTES_SWAPPED else (at, at + 1) for at in range(0, width, 2)]
    return tuple(position for word in (words[::-1] if order in WORDS_SWAPPED else words) for position in word)


def _frame_layouts() -> Iterator[Layout]:
    for width, prior in FRAME_PRIORS.items():
        kinds = [f"int{8 * width}", f"uint{8 * width}"] + ["float32"] * (width == 4)
        for order in ("little", "big") if width > 1 else ("little",):
            positions = tuple(range(width)) if order == "big" else tuple(range(width))[::-1]
            yield from (Layout(kind, order, positions, prior) for kind in kinds)


REGISTERS: tuple[Layout, ...] = tuple(layout for kind in LETTERS for layout in register_layouts(kind))
"""All layouts of Modbus registers."""
FRAMES: tuple[Layout, ...] = tuple(_frame_layouts())  # All layouts of whole bytes in a CAN frame


class LayoutVerdict(StrEnum):
    """What is known about some bytes."""

    CERTAIN = "certain"  # The changes fit this number only
    LIKELY = "likely"  # The changes are too few to exclude other numbers
    STILL = "still"  # The bytes do not change, so their type is unknown
    ERRATIC = "erratic"  # The number jumps over its whole range: part of a larger number, a checksum, or noise
    COUNTER = "counter"  # The number increases by one: a counter of frames or cycles


@dataclass(frozen=True, slots=True)
class Other:
    """An alternative number in the same bytes, or in some of them and their neighbours."""

    start: int
    layout: Layout
    latest: float


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Bytes that are one number, or whose type is unknown."""

    start: int  # Position of the first byte
    width: int
    bits: float  # Cost of writing down all readings
    verdict: LayoutVerdict = LayoutVerdict.STILL
    layout: Layout | None = None  # None for bytes that do not change
    numbers: Floats = field(default_factory=lambda: np.full(1, np.nan))  # The number in each reading
    others: tuple[Other, ...] = ()  # Alternatives with other values, the most probable first
    probability: float = MAX_PROBABILITY  # That it is this number, if one of the layouts is right

    @property
    def end(self) -> int:
        """Position behind the last byte."""
        return self.start + self.width

    @property
    def latest(self) -> float:
        """The latest reading."""
        return float(self.numbers[-1])

    @property
    def low(self) -> float:
        """The smallest finite reading; NaN if there is none."""
        return float(np.fmin.reduce(self._finite))

    @property
    def high(self) -> float:
        """The largest finite reading; NaN if there is none."""
        return float(np.fmax.reduce(self._finite))

    @property
    def _finite(self) -> Floats:
        return np.where(np.isfinite(self.numbers), self.numbers, np.nan)


def parts(data: Bytes, layouts: Sequence[Layout], step: int) -> list[Part]:
    """Return the most probable numbers in ``data`` (readings by bytes); a number starts at a multiple of ``step``."""
    length = data.shape[1]
    starts = range(0, length, step)
    candidates = {at: list(_candidates(data, at, layouts, step)) for at in starts}
    before, after = {0: 0.0}, {length: 0.0}  # bits of the cheapest cut up to a byte, and from it on
    best: dict[int, Part] = {}
    for at in starts:
        for part in candidates[at]:
            before[part.end] = min(before[at] + part.bits, before.get(part.end, math.inf))
    for at in reversed(starts):
        best[at] = min(candidates[at], key=lambda part: part.bits + after[part.end])
        after[at] = best[at].bits + after[best[at].end]

    def rivals(part: Part) -> list[tuple[float, Part]]:
        near = [rival for at in range(part.start - MAX_WIDTH + 1, part.end) for rival in candidates.get(at, ())]
        overlapping = [rival for rival in near if rival.end > part.start and rival is not part]
        return [(before[rival.start] + rival.bits + after[rival.end] - after[0], rival) for rival in overlapping]

    at, inferred = 0, []
    while at < length:
        inferred.append(_judged(best[at], rivals(best[at])))
        at = best[at].end
    return inferred


def _candidates(data: Bytes, at: int, layouts: Sequence[Layout], step: int) -> Iterator[Part]:
    """Yield all numbers that may start at ``at``."""
    moves = (data[:, at : at + MAX_WIDTH] != data[:1, at : at + MAX_WIDTH]).any(axis=0)
    if not moves[:step].any():
        yield Part(at, step, STILL_BITS * step)
    possible = []
    for layout in layouts:
        span = data[:, at : at + layout.width]
        if span.shape[1] == layout.width and moves[: layout.width].any():
            numbers = layout.numbers(span)
            if not layout.fault(numbers):
                possible.append((layout, span, numbers))
    floats = {layout.positions for layout, _, numbers in possible if layout.is_likely_float(numbers)}
    for layout, span, numbers in possible:
        if layout.is_float or layout.positions not in floats:  # an integer that reads as a likely float is a float
            verdict, bits = _verdict_and_bits(layout, span, numbers)
            yield Part(at, layout.width, bits, verdict, layout, numbers)


def _verdict_and_bits(layout: Layout, span: Bytes, numbers: Floats) -> tuple[LayoutVerdict, float]:
    """Return the verdict without regard to rivals, and the cost of all changes."""
    ranks = layout.ranks(span)
    if _is_counter(layout, ranks):
        return LayoutVerdict.COUNTER, COUNTER_BITS * layout.width
    bits = layout.prior + (_digit_bits(layout, ranks, numbers) if layout.is_float else _size_bits(layout, numbers))
    steps = np.abs(np.diff(ranks).view(np.int64).astype(np.float64))
    changes = int(np.count_nonzero(steps))
    # Bytes that are filled from end to end and never carry into the byte above are no number of their own.
    moving = [bool((span[:, position] != span[0, position]).any()) for position in layout.positions]
    used_range = 256.0 ** (layout.width - moving.index(True))
    fills_range = steps.mean() > MAX_MEAN_STEP * used_range and len(np.unique(ranks)) >= MIN_DISTINCT
    if fills_range and not (layout.is_float and moving[0]):
        return LayoutVerdict.ERRATIC, bits + ERRATIC_BITS * sum(moving) * changes
    if layout.is_float:  # a float that is set by hand ends in zeros, which cost nothing
        still = moving[::-1].index(True)
        steps /= 256.0**still
        if still and np.count_nonzero(steps % 2.0 == 1.0) > TRUNCATED_SHARE * changes:
            bits += CERTAIN_MARGIN + 2.0 * CERTAIN_MARGIN_PER_CHANGE * changes
    else:
        bits += WRAP_BITS * np.count_nonzero(steps > 0.5 * 256.0**layout.width)
    return LayoutVerdict.CERTAIN, bits + float(np.log2(1.0 + steps).sum()) + CHANGE_BITS * changes


def _is_counter(layout: Layout, ranks: Ranks) -> bool:
    """Whether an integer increases by one from reading to reading, and wraps."""
    if layout.is_float or layout.width == MAX_WIDTH or len(ranks) < MIN_READINGS:
        return False
    steps = np.diff(ranks).view(np.int64)
    return float(np.mean((steps == 1) | (steps == 1 - (1 << 8 * layout.width)))) > COUNTING_SHARE


def _size_bits(layout: Layout, numbers: Floats) -> float:
    """Return the cost of an integer's magnitude, and of an unsigned one that is rather a small negative number."""
    bits, whole, low = INTEGER_SIZE_BITS * math.log2(1.0 + np.abs(numbers).max()), 256.0**layout.width, numbers.min()
    return bits + (2.0 * math.log2(whole / (whole - low)) if not layout.signed and low >= whole / 2 else 0.0)


def _digit_bits(layout: Layout, ranks: Ranks, numbers: Floats) -> float:
    """Return the cost of a float's decimal digits.

    It is negative if the decimal digits are far fewer than the binary ones, which they are not in a wrong layout.
    """
    _, first = np.unique(ranks, return_index=True)
    digits, fraction, saved = [], FRACTION_BITS[layout.width], 0.0
    for at in first[:MAX_WRITTEN]:
        text = str(np.float32(numbers[at])) if layout.width == 4 else repr(float(numbers[at]))
        digits.append(len(text.partition("e")[0].replace(".", "").strip("-0")) if np.isfinite(numbers[at]) else 0)
        rank = abs(int(ranks[at]))
        used = fraction - min(fraction - 1, (rank & -rank).bit_length() - 1 if rank else fraction - 1)
        saved += max(0.0, used - math.log2(10.0) * digits[-1])
    return float(np.mean(digits)) - saved


def _judged(part: Part, rivals: Sequence[tuple[float, Part]]) -> Part:
    """Return ``part`` with its probability and the cheapest rivals that cost hardly more and have other values.

    A rival's odds are 1 to 2 per bit of its cost, scaled so that the margin of a certain number is ``CERTAIN_MARGIN``.
    """
    if part.verdict is not LayoutVerdict.CERTAIN:
        return part
    changes = int(np.count_nonzero(np.diff(part.numbers)))
    weights: dict[tuple[int, tuple[int, ...]], float] = {}
    others: dict[tuple[int, tuple[int, ...]], Other] = {}  # a signed and an unsigned number count as one
    for cost, rival in sorted(rivals, key=lambda rival: rival[0]):
        if rival.layout is None:
            continue
        key, equal = (rival.start, rival.layout.positions), np.array_equal(rival.numbers, part.numbers)
        per_change = CERTAIN_MARGIN_PER_CHANGE if max(part.width, rival.width) > 2 else 0.0
        margin = max(CERTAIN_MARGIN, per_change * changes)
        if not equal:
            weights.setdefault(key, 2.0 ** (-CERTAIN_MARGIN * max(cost, 0.0) / margin))
        if cost >= margin:
            continue
        # If the high half is constant, the integer has the values of its low half, up to a constant.
        extends = rival.width > part.width and not rival.layout.is_float
        same = equal and (extends or rival.start == part.start)
        if not same and not (extends and np.abs(part.numbers).max() < LOW_HALF_SIZE):
            others.setdefault(key, Other(rival.start, rival.layout, rival.latest))
    verdict = LayoutVerdict.LIKELY if others or len(part.numbers) < MIN_READINGS else LayoutVerdict.CERTAIN
    probability = min(1.0 / (1.0 + sum(weights.values())), MAX_PROBABILITY)
    return replace(part, verdict=verdict, others=tuple(others.values())[:MAX_OTHERS], probability=probability)


def number_text(value: float, layout: Layout, step: float = 0.0) -> str:
    """Return an integer in full, or a float with the digits in which it differs by ``step``."""
    if not math.isfinite(value):
        return str(value)
    if not layout.is_float:
        return f"{value:.0f}"
    size = max(abs(value), step)
    digits = 4
    if step > 0.0 and size > 0.0:
        digits = min(max(digits, 2 + math.ceil(math.log10(size / step))), 7 if layout.width == 4 else 12)
    return f"{value:.{digits}g}"


def spread(part: Part) -> str:
    """Return the latest, lowest and highest value in words."""
    if (layout := part.layout) is None:
        return ""
    latest, low, high = (
        number_text(value, layout, part.high - part.low) for value in (part.latest, part.low, part.high)
    )
    return f"{latest} now, between {low} and {high}"
