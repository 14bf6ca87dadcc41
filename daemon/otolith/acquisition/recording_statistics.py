"""How a recording was sampled: rate, jitter, gaps, repeats of each signal, in one pass and in bounded memory."""

import math
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.samples import renewal
from otolith.acquisition.window import Array
from otolith_drivers.replay.readers import Integers, Rows

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
MAX_KEPT = 8192  # intervals and values of a signal that are kept; of more, as many are chosen at random
MAX_GAPLESS = 2.5  # median intervals; a longer interval between two samples is a gap
BINS_PER_OCTAVE = 8  # of the histogram of intervals
OCTAVES = (-40, 40)  # of that histogram, in powers of two of a second
SEED = 1


@dataclass(frozen=True, slots=True, eq=False)
class SignalSampling:
    """How one signal was sampled."""

    samples: int
    """Finite values."""
    blank: int
    """Rows without a value of this signal."""
    interval_s: float | None
    """Median time between two samples; None if there are not two."""
    jitter: float
    """Standard deviation of the intervals that are no gaps, over their median."""
    gaps: int
    """Intervals of more than ``MAX_GAPLESS`` medians, up to the resolution of a histogram (9 %)."""
    longest_gap_s: float | None
    """The longest interval, if it is a gap."""
    longest_gap_start: float | None
    """Time of the last sample before it, s."""
    longest_gap_line: int | None
    """Line, frame or record of the first sample after it."""
    duplicates: int
    """Samples with time and value of the sample before."""
    repeated_times: int
    """Samples with the time of the sample before, but another value."""
    repeats: int
    """Samples with the value of the sample before at a later time."""
    renewal: int
    """Samples for which a register keeps its value, see :func:`otolith.acquisition.samples.renewal`."""
    values: Array
    """At most ``MAX_KEPT`` of the values, chosen at random."""


class RandomChoice:
    """A random choice of the numbers that were added: at most ``MAX_KEPT``, each with the same probability."""

    def __init__(self) -> None:
        self.kept: Array = np.zeros(0)
        self._random = np.random.default_rng(SEED)
        self._share = 1.0

    def add(self, numbers: Array) -> None:
        """Add numbers (n,)."""
        if self._share < 1.0:
            numbers = numbers[self._random.random(len(numbers)) < self._share]
        self.kept = np.concatenate([self.kept, numbers])
        while len(self.kept) > MAX_KEPT:
            self.kept = self.kept[self._random.random(len(self.kept)) < 0.5]
            self._share /= 2.0


class SignalStatistics:
    """Counters of one signal."""

    def __init__(self) -> None:
        self.samples = self.blank = self.duplicates = self.repeated_times = self.repeats = 0
        self._values, self._intervals = RandomChoice(), RandomChoice()
        self._histogram = np.zeros((OCTAVES[1] - OCTAVES[0]) * BINS_PER_OCTAVE, dtype=np.int64)
        self._longest = (0.0, math.nan, 0)  # gap (s), its start (s) and the line after it
        self._runs, self._steps = RandomChoice(), RandomChoice()
        self._run: int | None = None  # samples since the last change; None before the first one
        self._last: tuple[float, float] | None = None

    def add(self, times: Array, values: Array, lines: Integers) -> None:
        """Add samples (s, value), NaN where there is none, with their lines, in the order of the file."""
        present = np.isfinite(values)
        self.blank += len(values) - int(np.count_nonzero(present))
        times, values, lines = times[present], values[present], lines[present]
        if not len(times):
            return
        self.samples += len(times)
        self._values.add(values)
        last_time, last_value = self._last or (math.nan, math.nan)
        before = np.concatenate([[last_time], times[:-1]])
        intervals, same = times - before, values == np.concatenate([[last_value], values[:-1]])
        self._last = (float(times[-1]), float(values[-1]))
        at_once, forward = intervals == 0.0, intervals > 0.0
        self.duplicates += int(np.count_nonzero(at_once & same))
        self.repeated_times += int(np.count_nonzero(at_once & ~same))
        self.repeats += int(np.count_nonzero(forward & same))
        self._add_runs(np.concatenate([[last_value], values])[np.concatenate([[True], ~(at_once & same)])])
        self._add_intervals(intervals[forward], before[forward], lines[forward])

    def _add_runs(self, values: Array) -> None:
        """Add the runs of one value that end in ``values`` (n,), of which the first is the last one before, or NaN."""
        with np.errstate(over="ignore"):
            steps = np.diff(values)
        changes = np.flatnonzero(np.nan_to_num(steps, nan=0.0))
        ends = changes if self._run is None else np.concatenate([[-self._run], changes])
        self._runs.add(np.diff(ends).astype(np.float64))
        self._steps.add(steps[changes])
        if len(ends):
            self._run = len(steps) - int(ends[-1])

    def _add_intervals(self, intervals: Array, before: Array, lines: Integers) -> None:
        if not len(intervals):
            return
        self._intervals.add(intervals)
        bins = np.floor((np.log2(intervals) - OCTAVES[0]) * BINS_PER_OCTAVE).astype(np.int64)
        bins = np.clip(bins, 0, len(self._histogram) - 1)
        self._histogram += np.bincount(bins, minlength=len(self._histogram))
        longest = int(np.argmax(intervals))
        if intervals[longest] > self._longest[0]:
            self._longest = float(intervals[longest]), float(before[longest]), int(lines[longest])

    def summary(self) -> SignalSampling:
        """Return what was counted so far."""
        intervals = self._intervals.kept
        median = float(np.median(intervals)) if len(intervals) else math.inf
        gapless = intervals[intervals <= MAX_GAPLESS * median]
        edges = np.exp2(np.arange(len(self._histogram)) / BINS_PER_OCTAVE + OCTAVES[0])
        gap = self._longest if self._longest[0] > MAX_GAPLESS * median else (None, None, None)
        return SignalSampling(
            samples=self.samples,
            blank=self.blank,
            interval_s=median if len(intervals) else None,
            jitter=float(gapless.std() / median) if len(gapless) else 0.0,
            gaps=max(int(self._histogram[edges > MAX_GAPLESS * median].sum()), int(gap[0] is not None)),
            longest_gap_s=gap[0],
            longest_gap_start=gap[1],
            longest_gap_line=gap[2],
            duplicates=self.duplicates,
            repeated_times=self.repeated_times,
            repeats=self.repeats,
            renewal=renewal(self._runs.kept, self._steps.kept),
            values=self._values.kept,
        )


class RecordingStatistics:
    """Counters of all rows and of each signal."""

    def __init__(self, signals: tuple[str, ...]) -> None:
        self.rows = 0
        self.first, self.last = math.inf, -math.inf
        """Earliest and latest time, s."""
        self.steps_back = 0
        """Rows with a time before that of the row above."""
        self.first_step_back: tuple[int, float, float] | None = None
        """Line and time (s) of the first of them, and the time (s) of the row above."""
        self._signals = {signal: SignalStatistics() for signal in signals}
        self._last_time = -math.inf

    def add(self, rows: Rows) -> None:
        """Add a chunk of rows, in the order of the file."""
        if not len(rows.times):
            return
        self.rows += len(rows.times)
        before = np.concatenate([[self._last_time], rows.times[:-1]])
        back = np.flatnonzero(rows.times < before)
        self.steps_back += len(back)
        if len(back) and self.first_step_back is None:
            first = int(back[0])
            self.first_step_back = (int(rows.lines[first]), float(rows.times[first]), float(before[first]))
        self._last_time = float(rows.times[-1])
        self.first = min(self.first, float(rows.times.min()))
        self.last = max(self.last, float(rows.times.max()))
        for signal, statistics in self._signals.items():
            statistics.add(rows.times, rows.columns[signal], rows.lines)

    def signals(self) -> dict[str, SignalSampling]:
        """Return how each signal was sampled so far."""
        return {signal: statistics.summary() for signal, statistics in self._signals.items()}
