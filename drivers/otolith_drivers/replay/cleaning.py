"""What rows of a table need before they are samples: cells that are no readings go, rows of a coarse clock are spread.

No readings are numbers beyond a stated range, and sentinels as -9999 or the largest integer, which loggers and drives
write where they have no value. A sentinel is one of few numbers, and far from all readings, so it is none that a signal
passes. Commands jump, so for an input it must be far from its ordinary range as well.

Rows of a coarse clock have one time, but other values. They are spread evenly if they come regularly. Then their number
is proportional to time, and each time of the file is that of the last step of the clock before the row:
``time <= start + number * interval < time + step`` holds for all rows with one start and one interval. Otherwise the
times of the rows are not known, and they keep those of the file. So it is with times that are rounded to steps below
the interval: 0, 3, 7, 10 ms are rows that come every 3.5 ms.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from otolith_drivers.config_files import Range
from otolith_drivers.errors import counted
from otolith_drivers.replay.readers import Array, Integers, Mask, Rows

# Thresholds: docs/reference/thresholds-replay.md has the origin of each.
BLOCK_ROWS, BLOCK_STEPS = 2048, 16  # least rows and steps of the clock that are judged together
MIN_ROWS, MIN_STEPS = 200, 8  # in which a regular interval can be recognised
MIN_COARSE = 0.01  # share of rows with the time, but not the values of the row above: fewer are accidents
TOLERANCE = 0.1  # intervals of the rows by which a row may be off
MAX_SPREAD = 0.33  # intervals: standard deviation of the times from the steps of the clock to the row after it
MIN_ROUNDING = 0.01  # intervals: steps to which times are rounded; finer ones move no estimate
WHOLE = 0.05  # steps of the clock by which an interval may differ from a whole number of them
ROUNDED_SHARE = 0.9  # of the intervals that must be one of two neighbours; where rows are missing they are longer
EQUAL_INTERVALS = 4.0  # spacings of floating-point numbers by which equal intervals may differ
MISSING_STEP = 1.5  # usual steps of the clock: after a longer one, rows are missing
UNEVEN = 2.0  # ratio of mean squared changes from row to row that rows at even times do not have
ENDS_OF_INTEGERS = frozenset({"32767", "32768", "65535", "2147483647", "2147483648", "4294967295"})
NINES = frozenset({"999", "9999", "99999", "999999", "9999999", "99999999", "99925"})
MIN_NINES = 999.0
BEYOND_MACHINES = 1e9
MAX_SENTINELS = 4
SENTINEL_DISTANCE = 2.0
MIN_LEVELS = 20


def is_sentinel_number(value: float) -> bool:
    """Whether loggers and drives write this number where they have no value; integers with any decimal factor."""
    size = abs(value)
    digits = f"{size:.11e}".partition("e")[0].replace(".", "").rstrip("0")
    return size >= BEYOND_MACHINES or digits in ENDS_OF_INTEGERS or (size >= MIN_NINES and digits in NINES)


class NoReadings:
    """Those of one column, whose numbers come part by part."""

    def __init__(self, stated: Range | None = None, ordinary: Range | None = None) -> None:
        """Numbers beyond ``stated`` are no readings; without it, sentinels. ``ordinary`` is the range of an input."""
        self._stated, self._ordinary = stated, ordinary
        self._low, self._high, self._levels = math.inf, -math.inf, 0  # of the readings so far
        self._beyond, self._sentinels = 0, Counter[float]()

    def among(self, numbers: Array) -> Mask:
        """Return which of the next ``numbers`` (n,) are no readings, and count them; NaN stands for a blank cell."""
        if self._stated is not None:
            beyond: Mask = (numbers < self._stated[0]) | (numbers > self._stated[1])
            self._beyond += int(np.count_nonzero(beyond))
            return beyond
        sentinels = self._sentinels_among(numbers[np.isfinite(numbers)])
        refused: Mask = np.isin(numbers, sentinels)
        if sentinels:
            self._sentinels.update(numbers[refused].tolist())
        return refused

    def _sentinels_among(self, readings: Array) -> list[float]:
        """Return the sentinels of ``readings``, all finite; the other readings become known."""
        candidates = list[float]()
        for end in (np.min, np.max):
            for _ in range(MAX_SENTINELS):
                if not len(readings) or not is_sentinel_number(value := float(end(readings))):
                    break
                candidates.append(value)
                readings = readings[readings != value]
        if len(readings):
            self._low, self._high = min(self._low, float(readings.min())), max(self._high, float(readings.max()))
            if self._levels < MIN_LEVELS:
                self._levels = max(self._levels, len(np.unique(readings)))
        if self._levels == 0 or (self._ordinary is None and self._levels < MIN_LEVELS):
            return []
        low, high = self._ordinary or (self._low, self._high)
        low, high = min(low, self._low), max(high, self._high)
        distance = SENTINEL_DISTANCE * (high - low)
        return [value for value in candidates if not low - distance <= value <= high + distance]

    def warnings(self, name: str) -> list[str]:
        """Return what was left out of the column of a signal, a line each."""
        remedy = f"write {name} = {{ range = [lowest, highest] }} under [signals] if it is one"
        lines = [
            f"{name}: {value:.12g} in {counted(count, 'cell')} is no reading and left out: {remedy}"
            for value, count in sorted(self._sentinels.items())
        ]
        if self._stated is not None and self._beyond:
            lines.append(f"{name}: {counted(self._beyond, 'cell')} beyond its range {list(self._stated)}, left out")
        return lines


@dataclass(frozen=True, slots=True)
class CoarseClock:
    """The clock of some rows that were spread."""

    step: float  # s
    interval: float  # Time between two rows, s


class EvenTimes:
    """Spreads rows with a coarse time; the result does not depend on how the rows are split into chunks."""

    def __init__(self) -> None:
        self._held: Rows | None = None
        self._known: CoarseClock | None = None  # that of the last rows that were spread
        self._spread_rows, self._first, self._is_spreading = 0, "", False

    @property
    def waiting(self) -> int:
        """Number of the rows that wait for those that follow."""
        return 0 if self._held is None else len(self._held.times)

    def text(self) -> str | None:
        """Return what was done, in a sentence; None if nothing."""
        return f"rows of a coarse clock: {self._spread_rows} were spread evenly; {self._first}" if self._first else None

    def of(self, rows: Rows) -> Iterator[Rows]:
        """Yield rows with their times; the last ones wait for those that follow."""
        rows = rows if self._held is None else self._held.followed_by(rows)
        steps = np.flatnonzero(np.diff(rows.times, prepend=np.nan, append=np.nan))  # edges: not-a-number is no zero
        times, done = rows.times.copy(), 0
        while done < len(steps) - 1:  # the last edge is the end of the rows
            if not self._is_spreading:
                done = max(done, _first_suspect(rows.times, steps, done))
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
        times, steps = rows.times.copy(), np.diff(rows.times)
        forward = steps[steps > 0.0]
        longest = MISSING_STEP * float(np.median(forward)) if len(forward) else np.inf
        if np.count_nonzero(differing) <= MIN_COARSE * len(times):
            if (rounded := _rounded_intervals(times)) is None or not _share_signals(rows):
                return times
            longest = rounded[1] + 0.5 * (rounded[1] - rounded[0])
        breaks = np.flatnonzero((steps < 0.0) | (steps > longest) | rows.begins[1:]) + 1
        edges = [0, *breaks.tolist(), len(times)]
        for piece in (slice(*edge) for edge in pairwise(edges)):
            times[piece] = self._spread(rows.part(piece))
        self._is_spreading = self._spread_rows > spread_before
        return times

    def _spread(self, rows: Rows) -> Array:
        """Return the times of consecutive rows without a gap: those of the file where the rows are not regular."""
        times, starts = rows.times, np.flatnonzero(np.diff(rows.times, prepend=np.nan))
        is_short, share = len(times) < MIN_ROWS or len(starts) < MIN_STEPS, len(starts) < len(times)
        if len(starts) < 2 or (share and not _is_even(rows)) or (is_short and self._known is None):
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


def _first_suspect(times: Array, steps: Integers, done: int) -> int:
    """Return the first step of the clock from ``done`` on in which rows must be judged.

    It is one with several rows. Where intervals differ, rows before belong to the same clock. The last step may get
    further rows.
    """
    intervals = np.diff(times[steps[done:-1]], prepend=np.nan, append=np.nan)
    uneven, several = np.abs(np.diff(intervals)) > _rounding_error(times), np.diff(steps[done:]) > 1
    suspect = np.flatnonzero(several | uneven)
    first = done + int(suspect[0]) if len(suspect) else len(steps) - 2
    return first if len(suspect) and several[suspect[0]] else first - MIN_ROWS


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


def _share_signals(rows: Rows) -> bool:
    """Whether most rows have a signal of the row above: those of signals with clocks of their own alternate."""
    present = np.isfinite(np.array(list(rows.columns.values())))
    return bool(np.mean((present[:, 1:] & present[:, :-1]).any(axis=0)) > 0.5)


def _mean_square(changes: Array) -> float:
    finite = changes[np.isfinite(changes)]
    return float(np.mean(finite**2)) if len(finite) else 0.0


def _rounding_error(times: Array) -> float:
    """Return by how much equal intervals between ``times`` may differ, s."""
    return EQUAL_INTERVALS * float(np.spacing(np.abs(times).max(initial=1.0)))


def _rounded_intervals(times: Array) -> tuple[float, float] | None:
    """Return the two intervals, s, between rows whose times are rounded to steps below their interval; None if not."""
    steps = np.sort(np.diff(times))
    if not len(steps) or (steps == 0.0).any():
        return None
    steps = steps[steps > 0.0]
    edges = [0, *(np.flatnonzero(np.diff(steps) > _rounding_error(times)) + 1).tolist(), len(steps)]
    sizes = np.diff(edges)
    if len(sizes) < 2:
        return None
    first = int(np.argmax(sizes[:-1] + sizes[1:]))
    low, high = (float(steps[edges[at] : edges[at + 1]].mean()) for at in (first, first + 1))
    is_step = MIN_ROUNDING * low <= high - low <= low + _rounding_error(times)  # a longer interval is a gap
    is_whole = abs((ratio := low / (high - low)) - round(ratio)) < WHOLE  # both are whole numbers of steps
    if round(ratio) == 1 and sizes[first + 1] < MIN_STEPS:  # twice the interval: a row is lost
        return None
    return (
        (low, high) if is_step and is_whole and sizes[first : first + 2].sum() >= ROUNDED_SHARE * len(steps) else None
    )


def _clock_of(times: Array) -> CoarseClock | None:
    """Return step and interval of regular rows: the slope of a line through the first row of each step.

    Such a row comes within an interval of its step, but others anywhere in it. The step is a whole number of intervals
    if that is as near.
    """
    starts = np.flatnonzero(np.diff(times)) + 1
    numbers, since = starts - starts.mean(), times[starts] - times[0]
    step = float(np.diff(since).mean())
    interval = float(numbers @ since / (numbers @ numbers))
    if len(starts) == len(times) - 1:
        rounded = _rounded_intervals(times)
        return None if rounded is None else CoarseClock(rounded[1] - rounded[0], interval)
    if not 0.0 < interval < step:
        return None
    whole = step / round(step / interval)
    return CoarseClock(step, whole if abs(interval - whole) * len(times) < TOLERANCE * step else interval)


def _even_times(times: Array, clock: CoarseClock) -> Array | None:
    """Return even times at which the clock would show ``times``; None if there are none.

    A row that comes with a step of the clock has its time. Other choices move all signals alike.
    """
    numbers: Integers = np.arange(len(times))
    since = times - clock.interval * numbers
    starts = np.flatnonzero(np.diff(times)) + 1
    firsts, rounding = since[starts], float(np.ptp(np.diff(times[starts]))) if len(starts) > 1 else 0.0
    if clock.step < clock.interval:
        firsts, rounding = since, 0.0
    limit = min(clock.step, clock.interval)
    if np.ptp(firsts) > (1.0 + TOLERANCE) * limit + rounding:
        return None
    if limit == clock.interval and firsts.std() > MAX_SPREAD * limit + rounding:
        return None
    return np.asarray(clock.interval * numbers + 0.5 * (firsts.min() + firsts.max()))
