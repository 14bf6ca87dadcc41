"""Which numbers are in bytes that were read again and again, told by how they move. Pure.

A machine's signals change by little from reading to reading. So of all ways to cut the bytes into numbers, the one in
which the changes take the fewest bits to write down is the most probable (minimum description length). A number cut
in two leaves a low half that jumps over its whole range; one in a wrong order changes by coarse steps. What stands
still tells nothing, and nothing is claimed of it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith_drivers.probe_bits import FEWEST, LONGEST, TOLD, TOLD_OF_EACH, Piece, counts, pieces
from otolith_drivers.probe_layouts import Bytes, Layout

LONE = 2  # bytes of a number that is not long
MOST_OTHERS = 3  # that are named
LOW_HALF = 0x2000  # magnitude from which a register may well be the low half of a number whose high half stands still


class Verdict(StrEnum):
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
    verdict: Verdict
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
        return Part(piece.start, piece.width, Verdict.STILL, None, math.nan, math.nan, math.nan)
    numbers = piece.numbers
    verdict, others = Verdict.TOLD, _others(piece, cuts)
    if piece.wild:
        verdict, others = Verdict.WILD, ()
    elif not piece.layout.is_float and counts(piece.layout, piece.layout.ranks(data[:, piece.start : piece.end])):
        verdict, others = Verdict.COUNTS, ()
    elif others or len(data) < FEWEST:
        verdict = Verdict.LIKELY
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
