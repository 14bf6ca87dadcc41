"""The ways in which bytes can be a number: those of Modbus registers, and those of CAN frames. Pure.

What it costs to write down readings as numbers, in bits: the less, the more probable that they are these. Pure.

The prices are those of minimum description length, roughly: differences from reading to reading by their size, and once
for each number how uncommon it is.

Which numbers are in bytes that were read again and again, told by how they move. Pure.

A machine's signals change by little from reading to reading. So of all ways to cut the bytes into numbers, the one in
which the changes take the fewest bits to write down is the most probable (minimum description length). A number cut
in two leaves a low half that jumps over its whole range; one in a wrong order changes by coarse steps. What stands
still tells nothing, and nothing is claimed of it.

How numbers are written in tables, and in lines of a machine file. Pure.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus.plausibility import fault_of_floats
from otolith_drivers.modbus.protocol import (
    BYTES_SWAPPED,
    LETTERS,
    WORDS_SWAPPED,
    Order,
    TypeName,
    is_float,
    orders_of,
    registers_of,
)

Bytes = NDArray[np.uint8]
"""Readings by bytes."""
Floats = NDArray[np.float64]
Ranks = NDArray[np.int64] | NDArray[np.uint64]

LIKELY_FLOATS = (1e-6, 1e8)  # magnitudes of most readings in the units that people use
BIAS = {2: 0x8000, 4: 0x8000_0000, 8: 0x8000_0000_0000_0000}
LARGEST_INTEGER = 2.0**24  # magnitude, beyond which an integer that reads as a likely float is taken for one


@dataclass(frozen=True)
class Layout:
    """How so many bytes are read as a number."""

    kind: str
    """``"int16"``, ``"uint24"``, ``"float32"``."""
    order: str
    """As the machine file writes it: ``"CDAB"``, ``"little"``."""
    places: tuple[int, ...]
    """Where the bytes of the number stand, the highest first."""
    handicap: float
    """Bits: how much less common it is than others."""

    @property
    def width(self) -> int:
        """Bytes."""
        return len(self.places)

    @property
    def is_float(self) -> bool:
        """Whether it has an exponent."""
        return self.kind.startswith("float")

    @property
    def signed(self) -> bool:
        """Whether it can be negative."""
        return not self.kind.startswith("u")

    @cached_property
    def name(self) -> str:
        """In words."""
        return self.kind if self.width == 1 or (self.width, self.order) == (2, "ABCD") else f"{self.kind} {self.order}"

    def numbers(self, data: Bytes) -> Floats:
        """What the readings ``data`` say, read like this."""
        if self.is_float:
            high_first = np.ascontiguousarray(data[:, self.places])
            with np.errstate(invalid="ignore"):
                found: Floats = high_first.view(f">f{self.width}")[:, 0].astype(np.float64)
            return found
        return self.ranks(data).astype(np.float64)

    def ranks(self, data: Bytes) -> Ranks:
        """Integers in the order of the numbers: themselves, or for floats how many lie between one and zero."""
        whole = np.zeros(len(data), dtype=np.uint64)
        for place in self.places:
            whole = (whole << np.uint64(8)) | data[:, place].astype(np.uint64)
        if self.is_float:
            sign = np.uint64(BIAS[self.width])
            size = (whole & ~sign).view(np.int64)
            return np.where(whole & sign, -size, size)
        if not self.signed:
            return whole if self.width == 8 else whole.view(np.int64)
        spare = 64 - 8 * self.width
        return (whole << np.uint64(spare)).view(np.int64) >> np.int64(spare)

    def fault(self, numbers: Floats) -> str:
        """Why these cannot be the readings of a machine; empty where they can. Integers always can."""
        if not self.is_float:
            return ""
        return fault_of_floats(numbers) if (numbers != 0.0).any() else "it is always zero, with or without a sign"

    def likely(self, numbers: Floats) -> bool:
        """Whether these are floats as most readings are."""
        sizes = np.abs(numbers[numbers != 0.0])
        if not self.is_float or not len(sizes) or not np.isfinite(sizes).all():
            return False
        low, high = LIKELY_FLOATS
        return bool(low <= float(np.median(sizes)) <= high)


def register_layouts(kind: TypeName) -> tuple[Layout, ...]:
    """Of a type, in every order, as Modbus registers carry it."""
    width = 2 * registers_of(kind)
    return tuple(Layout(kind, order, _places(width, order), _handicap(kind, order)) for order in orders_of(kind))


def _places(width: int, order: Order) -> tuple[int, ...]:
    words = [(at, at + 1) for at in range(0, width, 2)]
    if order in BYTES_SWAPPED:
        words = [(second, first) for first, second in words]
    if order in WORDS_SWAPPED:
        words = words[::-1]
    return tuple(place for word in words for place in word)


def _handicap(kind: TypeName, order: Order) -> float:
    """Seldom: swapped bytes, 64 bits; a float wants no explanation where its numbers are likely."""
    common = {1: 2.0, 2: 1.0 if is_float(kind) else 5.0, 4: 6.0 if is_float(kind) else 8.0}[registers_of(kind)]
    swapped = {"ABCD": 0.0, "CDAB": 0.25, "BADC": 5.0, "DCBA": 5.25}[order]
    return common + swapped + (0.5 if kind.startswith("u") else 0.0)


REGISTERS: tuple[Layout, ...] = tuple(layout for kind in LETTERS for layout in register_layouts(kind))
"""All that registers can be."""


def _frame_layouts() -> tuple[Layout, ...]:
    found = []
    for width, handicap in ((1, 6.0), (2, 1.0), (3, 4.0), (4, 3.0)):
        for order, places in (("little", tuple(range(width))[::-1]), ("big", tuple(range(width)))):
            if width == 1 and order == "big":
                continue
            for kind, extra in (("int", 0.0), ("uint", 0.5)):
                found.append(Layout(f"{kind}{8 * width}", order, places, handicap + extra))
            if width == 4:
                found.append(Layout("float32", order, places, handicap))
    return tuple(found)


FRAMES: tuple[Layout, ...] = _frame_layouts()
"""All that whole bytes of a CAN frame can be."""


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


LONE = 2  # bytes of a number that is not long
MOST_OTHERS = 3  # that are named
LOW_HALF = 0x2000  # magnitude from which a register may well be the low half of a number whose high half stands still


class LayoutVerdict(StrEnum):
    """What can be said of a part."""

    TOLD = "told"
    """It moves as only this number would."""
    LIKELY = "likely"
    """It hardly moves, so others are possible."""
    STILL = "still"
    """Cannot be told: it does not change."""
    WILD = "wild"
    """It jumps over its whole range: a piece of something larger, a checksum, or noise."""
    COUNTS = "counts"
    """It goes up by one: a counter of frames or cycles."""


@dataclass(frozen=True, slots=True)
class Part:
    """Some bytes that are one number, or of which nothing is known."""

    start: int
    """Its first byte."""
    width: int
    verdict: LayoutVerdict
    layout: Layout | None
    """None where it stands still."""
    latest: float
    low: float
    high: float
    others: tuple["Other", ...] = ()
    """What else it could be, with other numbers, the likeliest first."""


@dataclass(frozen=True, slots=True)
class Other:
    """Another number that could be in the same bytes, or in them and their neighbours."""

    start: int
    layout: Layout
    latest: float


def parts(data: Bytes, layouts: Sequence[Layout], step: int) -> list[Part]:
    """The numbers in ``data`` (readings by bytes), which begin at multiples of ``step`` bytes only."""
    moves = (data != data[:1]).any(axis=0)
    found = [piece for at in range(0, data.shape[1], step) for piece in pieces(data, moves, at, layouts, step)]
    cuts = _Cuts(found, data.shape[1])
    return [_part(piece, cuts, data) for piece in cuts.cheapest()]


class _Cuts:
    """All ways to cut the bytes into pieces, by what they cost."""

    def __init__(self, found: Sequence[Piece], length: int) -> None:
        self._length = length
        self._before, self._after = {0: 0.0}, {length: 0.0}
        """Bits of the cheapest way up to a byte, and from it on."""
        self._choice: dict[int, Piece] = {}
        self._at: dict[int, list[Piece]] = {}
        for piece in found:
            self._at.setdefault(piece.start, []).append(piece)
            cost = self._before.get(piece.start, math.inf) + piece.bits
            self._before[piece.end] = min(cost, self._before.get(piece.end, math.inf))
        for piece in reversed(found):
            cost = self._after.get(piece.end, math.inf) + piece.bits
            if cost < self._after.get(piece.start, math.inf):
                self._after[piece.start], self._choice[piece.start] = cost, piece

    def cheapest(self) -> Iterator[Piece]:
        """The pieces of the cheapest way."""
        at = 0
        while at < self._length:
            yield self._choice[at]
            at = self._choice[at].end

    def rivals(self, piece: Piece) -> list[Piece]:
        """What overlaps ``piece`` in a way that costs hardly more, the cheapest first."""
        assert piece.numbers is not None  # noqa: S101 - asked only of those that have them
        changes = int(np.count_nonzero(np.diff(piece.numbers)))
        found = []
        for start in range(piece.start - LONGEST + 1, piece.end):
            for rival in self._at.get(start, ()):
                cost = self._before[start] + rival.bits + self._after[rival.end] - self._after[0]
                long = max(piece.width, rival.width) > LONE
                margin = max(TOLD, TOLD_OF_EACH * changes) if long else TOLD
                if rival is not piece and rival.layout is not None and rival.end > piece.start and cost < margin:
                    found.append((cost, rival))
        return [rival for _, rival in sorted(found, key=lambda pair: pair[0])]


def _part(piece: Piece, cuts: _Cuts, data: Bytes) -> Part:
    if piece.layout is None or piece.numbers is None:
        return Part(piece.start, piece.width, LayoutVerdict.STILL, None, math.nan, math.nan, math.nan)
    numbers = piece.numbers
    verdict, others = LayoutVerdict.TOLD, _others(piece, cuts)
    if piece.wild:
        verdict, others = LayoutVerdict.WILD, ()
    elif not piece.layout.is_float and counts(piece.layout, piece.layout.ranks(data[:, piece.start : piece.end])):
        verdict, others = LayoutVerdict.COUNTS, ()
    elif others or len(data) < FEWEST:
        verdict = LayoutVerdict.LIKELY
    seen = numbers[np.isfinite(numbers)]
    low, high = (float(seen.min()), float(seen.max())) if len(seen) else (math.nan, math.nan)
    return Part(piece.start, piece.width, verdict, piece.layout, float(numbers[-1]), low, high, others)


def _others(piece: Piece, cuts: _Cuts) -> tuple[Other, ...]:
    """What else may be in the same bytes, or in some of them and their neighbours."""
    assert piece.numbers is not None  # noqa: S101 - asked only of those that have them
    others: list[Other] = []
    for rival in cuts.rivals(piece):
        assert rival.layout is not None  # noqa: S101 - what stands still is no rival
        assert rival.numbers is not None  # noqa: S101 - the same
        same = np.array_equal(rival.numbers, piece.numbers)
        low_half = rival.width > piece.width and not rival.layout.is_float
        if any((other.start, other.layout.places) == (rival.start, rival.layout.places) for other in others):
            continue  # without a sign what has just been named with one, or the other way round
        if not (same and (low_half or rival.start == piece.start)) and not (
            low_half and float(np.abs(piece.numbers).max()) < LOW_HALF
        ):
            others.append(Other(rival.start, rival.layout, float(rival.numbers[-1])))
    return tuple(others[:MOST_OTHERS])


def quoted(value: Any) -> str:
    """As TOML writes a number or a text."""
    return str(value) if isinstance(value, int) else '"' + str(value).replace("\\", "\\\\").replace('"', '\\"') + '"'


def number_text(value: float, layout: Layout, step: float = 0.0) -> str:
    """A number as people write it: integers in full, floats with the digits in which they differ by ``step``."""
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
    """The latest value, and between which it was."""
    layout = part.layout
    if layout is None:
        return ""
    step = part.high - part.low
    latest, low, high = (number_text(value, layout, step) for value in (part.latest, part.low, part.high))
    return f"{latest} now, between {low} and {high}"
