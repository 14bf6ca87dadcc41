"""Recorded rows through the rings and the windower of the daemon, with the time of the data as the clock.

The daemon's thread checks the rings at the moments of the wall clock. Here they are checked only when the result can
change: half a sample period after the end of a window, when all on-time samples have come, and then with each new
sample until the grace period ends. So the windows depend on the rows alone, not on how the rows are split into chunks;
:class:`PlaybackState` is all that later windows need of earlier rows.
:class:`RecordingStatistics` counts how the rows were sampled, in one pass and in bounded memory.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from otolith.acquisition.cutting import cut
from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings, RingsState
from otolith.acquisition.samples import SignalPlan, renewal
from otolith.acquisition.window import Array, Mask, Window
from otolith.acquisition.windower import Windower, WindowerState
from otolith_drivers.replay.readers import Integers, Rows

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
REPLAY_RING_WINDOWS = 16  # windows that the rings of a replay hold
MAX_RING_SAMPLES = 1 << 20  # samples of each signal, however many a window has
STEP_ROWS = 1 << 9  # rows at the begin whose median step says how many samples a window has
MAX_SILENT_WINDOWS = 1  # window lengths; a longer time without any row is skipped
CONFIRMING_ROWS = 5  # rows that must continue from an earlier time, so that one wrong time is no new recording
MAX_KEPT = 8192  # intervals and values of a signal that are kept; of more, as many are chosen at random
MAX_GAPLESS = 2.5  # median intervals; a longer interval between two samples is a gap
BINS_PER_OCTAVE = 8  # of the histogram of intervals
OCTAVES = (-40, 40)  # of that histogram, in powers of two of a second
SEED = 1


class SegmentFinder:
    """Marks the first row of each segment; the result does not depend on how the rows are split into chunks."""

    def __init__(self, step_back: float) -> None:
        """Time starts again where it steps back by more than ``step_back`` s."""
        self._step_back = step_back
        self.held: Rows | None = None  # The rows that wait for those that confirm them
        self.clock = -math.inf  # Latest time of the present segment, s

    def mark(self, rows: Rows) -> Iterator[Rows]:
        """Yield rows with their segments marked; the last few wait for those that confirm them."""
        rows = rows if self.held is None else self.held.followed_by(rows)
        ready = len(rows.times) - CONFIRMING_ROWS
        self.held = rows if ready <= 0 else rows.part(slice(ready, None))
        if ready > 0:
            yield self._marked(rows, ready)

    def rest(self) -> Iterator[Rows]:
        """Yield the rows that still wait."""
        held, self.held = self.held, None
        if held is not None and len(held.times):
            yield self._marked(held, len(held.times))

    def _marked(self, rows: Rows, count: int) -> Rows:
        begins: Mask = rows.begins.copy()
        times, at = rows.times, 0
        while at < count:
            marks = np.flatnonzero(begins[at:count])
            until = at + int(marks[0]) if len(marks) else count
            if until == at:
                self.clock = float(times[at])
                until = at + int(marks[1]) if len(marks) > 1 else count
            clock = np.maximum.accumulate(np.maximum(times[at:until], self.clock))
            behind = np.flatnonzero(times[at:until] < clock - self._step_back)
            again = next((at + int(index) for index in behind if self._starts_again(times, at + int(index))), None)
            if again is None:
                self.clock = float(clock[-1])
                at = until
            else:
                begins[again] = True
                at = again
        return rows.part(slice(None, count), begins[:count])

    def _starts_again(self, times: np.ndarray[tuple[int], np.dtype[np.float64]], row: int) -> bool:
        """Whether the rows from ``row`` on continue from there."""
        following = times[row : row + CONFIRMING_ROWS]
        return len(following) == CONFIRMING_ROWS and bool(
            (np.diff(following) >= 0.0).all() and following[-1] - following[0] <= self._step_back
        )


@dataclass(slots=True)
class PlaybackCounts:
    """What became of the rows."""

    rows: int = 0
    received: int = 0  # Finite samples in the rows
    lost: int = 0  # Samples that came after their window was closed, or were overwritten in a full ring
    bad: int = 0  # See otolith_drivers.replay.readers.Rows.bad, up to the last row delivered
    reordered: int = 0  # Rows with a time before that of an earlier row
    late: int = 0  # Reordered rows whose window was closed already
    first_late: tuple[int, float, float] | None = None  # Line and time of the first, and the latest time before it, s
    gaps: int = 0  # Times without any row, longer than a window, that were skipped
    longest_gap: float = 0.0  # The longest of them, s
    segments: int = 0  # Recordings that begin after the first one
    repeated: int = 0  # Samples at the time of another one, which were not used
    stale: int = 0  # Readings of a register that had not been renewed, which were not used


@dataclass(frozen=True, slots=True, eq=False)
class PlaybackState:
    """All that the windows of later rows need of earlier ones, so that a playback can be continued bit for bit."""

    windower: WindowerState
    rings: RingsState
    counts: PlaybackCounts
    unmarked: Rows | None  # Rows whose segments are not known yet
    segment_clock: float  # Latest time of the present segment up to them, s
    waiting: Rows | None  # The first rows, until their step is known
    step: float | None  # Median of the first rows, s
    windows: int
    clock: float  # s
    begun: float  # s
    checked: float  # s
    check: float | None  # s


def median_step(times: Array) -> float:
    """Return the median time between rows in s, without steps back; infinity if no step is positive."""
    steps = np.diff(times)
    positive = steps[steps > 0.0]
    return float(np.median(positive)) if len(positive) else math.inf


class Playback:
    """Cuts windows from rows; times are seconds of the data. ``windower.records`` may be set between two windows."""

    def __init__(
        self,
        plans: Sequence[SignalPlan],
        records: int,
        sample_period: float,
        limits: QualityLimits | None = None,
        observed: Sequence[str] = (),
    ) -> None:
        """``observed`` are the signals of :attr:`Window.observed`."""
        self.windower = Windower(plans, records, sample_period, limits)
        self.counts = PlaybackCounts()
        self._plans, self._limits, self._observed = tuple(plans), limits, tuple(observed)
        self._rings = Rings(self.windower.signals, 1, observed)
        self._segments = SegmentFinder(self.windower.length)
        self._windows = 0
        self._clock = -math.inf  # latest time of a delivered row
        self._begun = self._checked = -math.inf
        self._check: float | None = None  # When to check the rings, once all rows before are delivered
        self._step: float | None = None
        self._waiting: Rows | None = None

    @property
    def state(self) -> PlaybackState:
        """All that the windows of later rows need; between two calls of :meth:`windows`."""
        return PlaybackState(
            self.windower.state,
            self._rings.state,
            replace(self.counts),
            self._segments.held,
            self._segments.clock,
            self._waiting,
            self._step,
            self._windows,
            self._clock,
            self._begun,
            self._checked,
            self._check,
        )

    def restore(self, state: PlaybackState) -> None:
        """Continue ``state``, which must be of the same plans, limits and signals."""
        self.windower.restore(state.windower)
        self._rings.restore(state.rings)
        self.counts = replace(state.counts)
        self._segments.held, self._segments.clock = state.unmarked, state.segment_clock
        self._waiting, self._step, self._windows = state.waiting, state.step, state.windows
        self._clock, self._begun, self._checked, self._check = state.clock, state.begun, state.checked, state.check

    def windows(self, rows: Rows) -> Iterator[Window]:
        """Yield the windows that ``rows`` complete; the generator must be exhausted."""
        for part in self._segments.mark(rows):
            yield from self._windows_with_step(part, is_last=False)

    def rest(self) -> Iterator[Window]:
        """Yield the windows that are complete if no further row comes."""
        for part in self._segments.rest():
            yield from self._windows_with_step(part, is_last=True)
        yield from self._complete()

    def _windows_with_step(self, rows: Rows, *, is_last: bool) -> Iterator[Window]:
        """Yield the windows of ``rows`` once the step of the first ones is known."""
        if self._step is None:
            rows = rows if self._waiting is None else self._waiting.followed_by(rows)
            ends = np.flatnonzero(rows.begins[1:]) + 1
            count = int(ends[0]) if len(ends) else len(rows.times)
            self._waiting = rows if count < STEP_ROWS and not len(ends) and not is_last else None
            if self._waiting is not None:
                return
            self._step = median_step(rows.times[: min(count, STEP_ROWS)])
        yield from self._windows_of(rows)

    def _windows_of(self, rows: Rows) -> Iterator[Window]:
        begins = [int(row) for row in np.flatnonzero(rows.begins)]
        for first, last in pairwise([0, *begins, len(rows.times)]):
            if first in begins and self._begun > -math.inf:
                yield from self._complete()
                self.counts.segments += 1
                self._begun = self._clock = -math.inf
            if last > first:
                yield from self._windows_of_segment(rows.part(slice(first, last)))

    def _windows_of_segment(self, rows: Rows) -> Iterator[Window]:
        clock = np.maximum.accumulate(np.maximum(rows.times, self._clock))
        self.counts.reordered += int(np.count_nonzero(rows.times < clock))
        at = 0
        while at < len(clock):
            if math.isinf(self._begun):
                self._restart(rows, at)
            if self._check is None:
                if clock[at] - self._clock > MAX_SILENT_WINDOWS * self.windower.length:
                    yield from self._complete()
                    self._skip_gap(float(clock[at]))
                self._check = self._next_check(float(clock[at]))
            until = at + int(np.searchsorted(clock[at:], self._check))
            self._deliver(rows, slice(at, until), clock)
            at = until
            if at < len(clock):
                yield from self._cut_due(self._check)
                self._check = None

    def _complete(self) -> Iterator[Window]:
        if self._begun > -math.inf:
            yield from self._cut_due(self._clock + 1.5 * self.windower.sample_period + self.windower.grace)

    @property
    def unused_seconds(self) -> float:
        """Length of the data since the end of the last window, s."""
        start = self.windower.next_start
        return max(0.0, self._clock + self.windower.sample_period - start) if self._windows else 0.0

    def _restart(self, rows: Rows, at: int) -> None:
        """Begin anew with row ``at``, like a daemon that is started then."""
        old = self.windower
        self.windower = Windower(self._plans, old.records, old.sample_period, self._limits)
        step = min(old.sample_period, self._step or math.inf)
        held = REPLAY_RING_WINDOWS * old.length + max(plan.delay for plan in self._plans)
        self._rings = Rings(old.signals, int(min(held / step, MAX_RING_SAMPLES)), self._observed)
        self._clock = self._begun = self._checked = float(rows.times[at])
        self._check = None

    def _skip_gap(self, following: float) -> None:
        """Let the next window start with the row at ``following`` (s); what commands hold is kept."""
        self.counts.gaps += 1
        self.counts.longest_gap = max(self.counts.longest_gap, following - self._clock)
        self.windower.skip_to(following)
        self._clock = self._checked = following
        if math.isinf(self.windower.next_start):
            self._begun = following

    def _next_check(self, coming: float) -> float:
        """Return when to check the rings (s), if the next row moves the clock to ``coming``."""
        period, end = self.windower.sample_period, self.windower.next_end
        deadline = self.windower.deadline
        if math.isinf(end):
            deadline = self._begun + self.windower.length
        elif self._checked < end + period / 2:
            return end + period / 2
        return max(self._checked + period, min(coming, deadline))

    def _cut_due(self, now: float) -> Iterator[Window]:
        self._checked = now
        begun = self.windower.begin(self._rings, now, now - self._begun)
        while begun and self.windower.due(self._rings, now):
            raw = self.windower.take(self._rings, offset=0.0)
            window, stale = cut(raw)
            self.counts.repeated += raw.samples.repeated
            self.counts.stale += stale
            self._windows += 1
            yield replace(window, index=self._windows - 1)

    def _deliver(self, rows: Rows, part: slice, clock: Array) -> None:
        times = rows.times[part]
        if not len(times):
            return
        oldest = self.windower.next_start - self.windower.sample_period / 2
        if math.isinf(oldest):
            oldest = self._begun - self.windower.length
        on_time = times >= oldest
        columns = {}
        for signal, values in rows.columns.items():
            present = np.isfinite(values[part])
            self.counts.received += int(np.count_nonzero(present))
            self.counts.lost += int(np.count_nonzero(present & ~on_time))
            columns[signal] = (times[present & on_time], values[part][present & on_time])
        overwritten = self._rings.counters().overwritten
        self._rings.deliver_columns(columns)
        self.counts.lost += self._rings.counters().overwritten - overwritten
        self.counts.rows += len(times)
        self.counts.bad = int(rows.bad[part][-1])
        if not on_time.all():
            self._count_late(rows, part.start + np.flatnonzero(~on_time), clock)
        self._clock = float(clock[part][-1])

    def _count_late(self, rows: Rows, late: Integers, clock: Array) -> None:
        self.counts.late += len(late)
        if self.counts.first_late is None:
            first = int(late[0])
            self.counts.first_late = (int(rows.lines[first]), float(rows.times[first]), float(clock[first]))


@dataclass(frozen=True, slots=True, eq=False)
class SignalSampling:
    """How one signal was sampled."""

    samples: int  # Finite values
    blank: int  # Rows without a value of this signal
    interval_s: float | None  # Median time between two samples; None if there are not two
    jitter: float  # Standard deviation of the intervals that are no gaps, over their median
    gaps: int  # Intervals of more than MAX_GAPLESS medians, up to the resolution of a histogram (9 %)
    longest_gap_s: float | None  # The longest interval, if it is a gap
    longest_gap_start: float | None  # Time of the last sample before it, s
    longest_gap_line: int | None  # Line, frame or record of the first sample after it
    duplicates: int  # Samples with time and value of the sample before
    repeated_times: int  # Samples with the time of the sample before, but another value
    repeats: int  # Samples with the value of the sample before at a later time
    renewal: int  # Samples for which a register keeps its value, see otolith.acquisition.samples.renewal
    values: Array  # At most MAX_KEPT of the values, chosen at random


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
        self.first, self.last = math.inf, -math.inf  # Earliest and latest time, s
        self.steps_back = 0  # Rows with a time before that of the row above, in a recording
        self.first_step_back: tuple[int, float, float] | None = None  # Line, time (s), and time of the row above
        self._signals = {signal: SignalStatistics() for signal in signals}
        self._last_time = -math.inf

    def add(self, rows: Rows) -> None:
        """Add a chunk of rows, in the order of the file."""
        if not len(rows.times):
            return
        self.rows += len(rows.times)
        before = np.concatenate([[self._last_time], rows.times[:-1]])
        back = np.flatnonzero((rows.times < before) & ~rows.begins)  # another recording has a clock of its own
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
