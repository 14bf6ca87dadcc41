"""What it costs to write down readings as numbers, in bits: the less, the more probable that they are these. Pure.

The prices are those of minimum description length, roughly: differences from reading to reading by their size, and once
for each number how uncommon it is.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.probe_layouts import LARGEST_INTEGER, Bytes, Floats, Layout, Ranks

FEWEST = 8  # readings that a judgement needs
WILD = 0.25  # of its range, by which a number may change on average; numbers drawn at random do by a third
FEWEST_DISTINCT = 8  # numbers, before they are called wild
WILD_COST, WILD_ONCE = 10.0, 10.0  # bits for each byte of each reading, and once: no signal is like that
BITS_OF_SIZE = 0.3  # once, for each bit of an integer's size: large ones are less common
CHANGE = 3.0  # bits of each reading that differs: its sign, and how its size lies about the usual one
CHOPPED = 0.25  # of all changes
BITS_OF_COUNTER = 2.0  # for each byte of what is always one more than before
WRAP = 30.0  # bits for each jump over more than half of the range
STILL_ZERO, STILL = 0.5, 1.0  # bits for each byte that stands still: a zero wants no explanation
UNLIKELY_FLOAT = 8.0  # bits
TOLD = 8.0  # bits (1 in 256) by which the best must be ahead of any other to be called told,
TOLD_OF_EACH = 0.3  # and for each reading that differs, as bits of long numbers are reckoned no better than that
COUNTING = 0.9  # of all steps that are one
FRACTION = 24.0  # bits of a float's fraction
BITS_OF_A_DIGIT, SPARE = math.log2(10.0), 3.0
MOST_WRITTEN = 30  # different readings, whose digits are counted
LONGEST = 8  # bytes of a number

Moves = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Piece:
    """Some bytes as one number, and what that costs."""

    start: int
    width: int
    bits: float
    layout: Layout | None = None
    numbers: Floats | None = None
    wild: bool = False

    @property
    def end(self) -> int:
        """The first byte behind it."""
        return self.start + self.width


def pieces(data: Bytes, moves: Moves, at: int, layouts: Sequence[Layout], step: int) -> Iterator[Piece]:
    """All that may begin with byte ``at``; ``moves`` says which bytes change."""
    if not moves[at : at + step].any():
        yield Piece(at, step, step * (STILL if data[0, at : at + step].any() else STILL_ZERO))
    found: list[tuple[Layout, Bytes, Floats]] = []
    for layout in layouts:
        end = at + layout.width
        if end <= data.shape[1] and moves[at:end].any():
            span = data[:, at:end]
            numbers = layout.numbers(span)
            if not layout.fault(numbers):
                found.append((layout, span, numbers))
    calmest = _calmest(found)
    floats = {layout.places for layout, _, numbers in found if layout.likely(numbers)}
    for layout, span, numbers in found:
        if layout.is_float:
            bits, wild = _bits_of_float(layout, span, numbers, calmest[layout.kind])
            yield Piece(at, layout.width, bits, layout, numbers, wild)
        elif layout.places not in floats or float(np.median(np.abs(numbers))) <= LARGEST_INTEGER:
            bits, wild = _bits_of_integer(layout, span, numbers)
            yield Piece(at, layout.width, bits, layout, numbers, wild)


def _calmest(found: Sequence[tuple[Layout, Bytes, Floats]]) -> dict[str, float]:
    """Of each kind the least roughness of any order."""
    calmest: dict[str, float] = {}
    for layout, _, numbers in found:
        if layout.is_float:
            calmest[layout.kind] = min(_roughness(numbers), calmest.get(layout.kind, math.inf))
    return calmest


def _roughness(numbers: Floats) -> float:
    """By how many bits of its fraction a float changes."""
    seen = numbers[np.isfinite(numbers)]
    size = float(np.abs(seen).max(initial=0.0))
    change = float(np.abs(np.diff(seen / size)).mean()) if size and len(seen) > 1 else 0.0
    return max(0.0, FRACTION + math.log2(change)) if change else 0.0


def _bits_of_float(layout: Layout, span: Bytes, numbers: Floats, calmest: float) -> tuple[float, bool]:
    """As of an integer, but what stands still at its end costs nothing: floats that are set by hand end in zeros.

    Those that are measured do not: if the last bits that move do so all the time, a shorter number ends there.
    """
    ranks = layout.ranks(span)
    sizes = np.abs(np.diff(ranks).view(np.int64).astype(np.float64))
    moving = _moving(layout, span)
    once = layout.handicap + _roughness(numbers) - calmest + _length(layout, ranks, numbers)
    once += 0.0 if layout.likely(numbers) else UNLIKELY_FLOAT
    if not moving[0] and _wild(sizes, ranks, moving):
        return WILD_COST * sum(moving) * np.count_nonzero(sizes) + WILD_ONCE + once, True
    still = moving[::-1].index(True)
    sizes /= 256.0**still
    changes = np.count_nonzero(sizes)
    if still and np.count_nonzero(sizes % 2.0 == 1.0) > CHOPPED * changes:
        once += TOLD + 2.0 * TOLD_OF_EACH * changes
    return _bits_of_changes(sizes) + once, False


def _moving(layout: Layout, span: Bytes) -> list[bool]:
    """Which bytes change, the highest first."""
    return [bool((span[:, place] != span[0, place]).any()) for place in layout.places]


def _bits_of_changes(sizes: Floats) -> float:
    return float(np.log2(1.0 + sizes).sum()) + CHANGE * np.count_nonzero(sizes)


def _wild(sizes: Floats, ranks: Ranks, moving: Sequence[bool]) -> bool:
    """Whether the bytes that move are filled from end to end, and yet never carry into the others."""
    whole = 256.0 ** (len(moving) - moving.index(True))
    return float(sizes.mean()) > WILD * whole and len(np.unique(ranks)) >= FEWEST_DISTINCT


def _length(layout: Layout, ranks: Ranks, numbers: Floats) -> float:
    """Bits for the digits of floats; negative where they are far fewer in decimal than in binary: that is no chance."""
    _, places = np.unique(ranks, return_index=True)
    written = [_digits(layout, float(numbers[place])) for place in places[:MOST_WRITTEN]]
    fraction = {4: 24, 8: 53}[layout.width]
    total = float(np.mean(written))
    for digits, place in zip(written, places[:MOST_WRITTEN], strict=True):
        rank = abs(int(ranks[place]))
        used = fraction - min(fraction - 1, (rank & -rank).bit_length() - 1 if rank else fraction - 1)
        total -= max(0.0, used - BITS_OF_A_DIGIT * digits - SPARE)
    return total


def _digits(layout: Layout, number: float) -> int:
    """Of the shortest decimal that is this float."""
    if not math.isfinite(number):
        return 0
    text = str(np.float32(number)) if layout.width == 4 else repr(number)
    return len(text.partition("e")[0].replace(".", "").strip("-0"))


def _bits_of_integer(layout: Layout, span: Bytes, numbers: Floats) -> tuple[float, bool]:
    """What it takes to write down all changes, and whether they are wild."""
    ranks = layout.ranks(span)
    sizes = np.abs(np.diff(ranks).view(np.int64).astype(np.float64))
    moving = _moving(layout, span)
    once = layout.handicap + _wrong_sign(layout, numbers) + BITS_OF_SIZE * math.log2(1.0 + float(np.abs(numbers).max()))
    if counts(layout, ranks):
        return BITS_OF_COUNTER * layout.width, False
    if _wild(sizes, ranks, moving):
        return WILD_COST * sum(moving) * np.count_nonzero(sizes) + WILD_ONCE + once, True
    wraps = np.count_nonzero(sizes > 0.5 * 256.0**layout.width)
    return _bits_of_changes(sizes) + WRAP * wraps + once, False


def _wrong_sign(layout: Layout, numbers: Floats) -> float:
    """What stays near the end of an unsigned range is a small negative number."""
    whole = 256.0**layout.width
    if layout.signed:
        return 3.0 if float(numbers.max()) < -whole / 4 else 0.0
    low = float(numbers.min())
    return 2.0 * math.log2(whole / (whole - low)) if low >= whole / 2 else 0.0


def counts(layout: Layout, ranks: Ranks) -> bool:
    """Whether an integer goes up by one each time, and begins anew behind the last."""
    if len(ranks) < FEWEST or layout.width == LONGEST:
        return False
    steps = np.diff(ranks).view(np.int64)
    return float(np.mean((steps == 1) | (steps == 1 - (1 << 8 * layout.width)))) > COUNTING
