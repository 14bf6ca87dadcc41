"""Rows of a clock that is too coarse: several rows in a row have one time, but other values.

The rows are spread evenly if they come regularly. Then their number is proportional to time, and each time of the file
is that of the last step of the clock before the row: ``time <= start + number * interval < time + step`` holds for all
rows with one start and one interval. Otherwise the times of the rows are not known, and they keep those of the file.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from otolith_drivers.replay.readers import Array, Integers, Mask, Rows

# Thresholds: docs/reference/thresholds-replay.md has the origin of each.
BLOCK_ROWS, BLOCK_STEPS = 2048, 16  # least rows and steps of the clock that are judged together
MIN_ROWS, MIN_STEPS = 200, 8  # in which a regular interval can be recognised
MIN_COARSE = 0.01  # share of rows with the time, but not the values of the row above: fewer are accidents
TOLERANCE = 0.1  # intervals of the rows by which a row may be off
MAX_SPREAD = 0.33  # intervals: standard deviation of the times from the steps of the clock to the row after it
MISSING_STEP = 1.5  # usual steps of the clock: after a longer one, rows are missing
UNEVEN = 2.0  # ratio of mean squared changes from row to row that rows at even times do not have


@dataclass(frozen=True, slots=True)
class CoarseClock:
    """The clock of some rows that were spread."""

    step: float
    """s."""
    interval: float
    """Time between two rows, s."""


class EvenTimes:
    """Spreads rows with a coarse time; the result does not depend on how the rows are split into chunks."""

    def __init__(self) -> None:
        self._held: Rows | None = None
        self._known: CoarseClock | None = None  # that of the last rows that were spread
        self._spread_rows, self._first, self._is_spreading = 0, "", False

    def text(self) -> str | None:
        """Return what was done, in a sentence; None if nothing."""
        return f"rows that share times: {self._spread_rows} were spread evenly; {self._first}" if self._first else None

    def of(self, rows: Rows) -> Iterator[Rows]:
        """Yield rows with their times; the last ones wait for those that follow."""
        rows = rows if self._held is None else self._held.followed_by(rows)
        steps = np.flatnonzero(np.diff(rows.times, prepend=np.nan, append=np.nan))  # edges: not-a-number is no zero
        times, done = rows.times.copy(), 0
        while done < len(steps) - 1:  # the last edge is the end of the rows
            if not self._is_spreading:
                several = np.flatnonzero(np.diff(steps[done:]) > 1)
                done += int(several[0]) if len(several) else len(steps) - 2 - done
            enough = max(int(np.searchsorted(steps, steps[done] + BLOCK_ROWS)), done + BLOCK_STEPS)
            if enough >= len(steps) - 1:
                break
            block = slice(int(steps[done]), int(steps[enough]))
            times[block] = self._times(rows.part(block))
            done = enough
        ready = int(steps[done])
        self._held = rows.part(slice(ready, None))
        if ready:
            yield _with_times(rows.part(slice(0, ready)), times[:ready])

    def rest(self) -> Iterator[Rows]:
        """Yield the rows that still wait."""
        held, self._held = self._held, None
        if held is not None:
            yield _with_times(held, self._times(held))

    def _times(self, rows: Rows) -> Array:
        """Return the times (rows,) of a block, s."""
        spread_before, differing = self._spread_rows, _differs_at_one_time(rows)
        self._is_spreading = False
        if np.count_nonzero(differing) <= MIN_COARSE * len(rows.times):
            return rows.times
        times, steps = rows.times.copy(), np.diff(rows.times)
        forward = steps[steps > 0.0]
        usual = float(np.median(forward)) if len(forward) else np.inf
        breaks = np.flatnonzero((steps < 0.0) | (steps > MISSING_STEP * usual) | rows.begins[1:]) + 1
        edges = [0, *breaks.tolist(), len(times)]
        for piece in (slice(*edge) for edge in pairwise(edges)):
            times[piece] = self._spread(rows.part(piece))
        self._is_spreading = self._spread_rows > spread_before
        return times

    def _spread(self, rows: Rows) -> Array:
        """Return the times of consecutive rows without a gap: those of the file where the rows are not regular."""
        times, starts = rows.times, np.flatnonzero(np.diff(rows.times, prepend=np.nan))
        is_short = len(times) < MIN_ROWS or len(starts) < MIN_STEPS
        if len(starts) < 2 or not _is_even(rows) or (is_short and self._known is None):
            return times
        clock = self._known if is_short else _clock_of(times)
        if clock is not None and (even := _even_times(times, clock)) is not None:
            self._count(rows, clock)
            return even
        middle = int(starts[len(starts) // 2])
        if is_short or min(middle, len(times) - middle) < 2 * MIN_ROWS:
            return times
        return np.concatenate([self._spread(rows.part(half)) for half in (slice(None, middle), slice(middle, None))])

    def _count(self, rows: Rows, clock: CoarseClock) -> None:
        self._known = clock
        self._spread_rows += len(rows.times)
        if not self._first:
            steps = f"steps of {1e3 * clock.step:.4g} ms, but a row comes every {1e3 * clock.interval:.4g} ms"
            self._first = f"from line {rows.lines[0]} on t has {steps}"


def _with_times(rows: Rows, times: Array) -> Rows:
    return Rows(times, rows.columns, rows.lines, rows.bad, rows.marks)


def _differs_at_one_time(rows: Rows) -> Mask:
    """Return which rows but the first have the time of the row above and another value of some signal."""
    same: Mask = np.diff(rows.times) == 0.0
    differs: Mask = np.zeros(len(same), dtype=np.bool_)
    if same.any():
        for values in rows.columns.values():
            with np.errstate(over="ignore"):
                differs |= np.nan_to_num(np.diff(values), nan=0.0) != 0.0
    return same & differs


def _is_even(rows: Rows) -> bool:
    """Whether the signals move as in rows at even times, one after the other.

    Rows of two machines alternate. Rows that were recorded twice hardly differ within a time, and jump to the next.
    """
    same: Mask = np.diff(rows.times) == 0.0
    jumps = []
    for values in rows.columns.values():
        with np.errstate(over="ignore", invalid="ignore"):
            within, across = (_mean_square(np.diff(values)[part]) for part in (same, ~same))
            lags = [_mean_square(values[lag:] - values[:-lag]) for lag in (1, 2, 3)]
        if lags[0] > UNEVEN * min(lags[1:]):
            return False
        if within > 0.0 or across > 0.0:
            jumps.append(across > UNEVEN * within)
    return 2 * sum(jumps) <= len(jumps)  # a command may change with the clock


def _mean_square(changes: Array) -> float:
    finite = changes[np.isfinite(changes)]
    return float(np.mean(finite**2)) if len(finite) else 0.0


def _clock_of(times: Array) -> CoarseClock | None:
    """Return step and interval of regular rows: the slope of a line through the first row of each step.

    Such a row comes within an interval of its step, but others anywhere in it. The step is a whole number of intervals
    if that is as near.
    """
    starts = np.flatnonzero(np.diff(times)) + 1
    numbers, since = starts - starts.mean(), times[starts] - times[0]
    step = float(np.diff(since).mean())
    interval = float(numbers @ since / (numbers @ numbers))
    if not 0.0 < interval < step:
        return None
    whole = step / round(step / interval)
    is_whole = abs(interval - whole) * len(times) < TOLERANCE * step
    return CoarseClock(step, whole if is_whole else interval)


def _even_times(times: Array, clock: CoarseClock) -> Array | None:
    """Return even times at which the clock would show ``times``; None if there are none.

    A row that comes with a step of the clock has its time. Other choices move all signals alike.
    """
    numbers: Integers = np.arange(len(times))
    since = times - clock.interval * numbers
    starts = np.flatnonzero(np.diff(times)) + 1
    firsts, rounding = since[starts], float(np.ptp(np.diff(times[starts]))) if len(starts) > 1 else 0.0
    if np.ptp(firsts) > (1.0 + TOLERANCE) * clock.interval + rounding:
        return None
    if firsts.std() > MAX_SPREAD * clock.interval + rounding:
        return None
    return np.asarray(clock.interval * numbers + 0.5 * (firsts.min() + firsts.max()))
