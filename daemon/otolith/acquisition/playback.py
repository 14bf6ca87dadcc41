"""Recorded rows through the rings and the windower of the daemon, with the time of the data as the clock.

The daemon's thread checks the rings at the moments of the wall clock. Here they are checked only when the result can
change: half a sample period after the end of a window, when all on-time samples have come, and then with each new
sample until the grace period ends. So the windows depend on the rows alone, not on how the rows are split into chunks.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, Mask, Window
from otolith.acquisition.windower import Windower
from otolith_drivers.replay.readers import Integers, Rows

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
REPLAY_RING_WINDOWS = 16  # windows that the rings of a replay hold
MAX_RING_SAMPLES = 1 << 20  # samples of each signal, however many a window has
MAX_SILENT_WINDOWS = 1  # window lengths; a longer time without any row is skipped
CONFIRMING_ROWS = 5  # rows that must continue from an earlier time, so that one wrong time is no new recording


class SegmentFinder:
    """Marks the first row of each segment; the result does not depend on how the rows are split into chunks."""

    def __init__(self, step_back: float) -> None:
        """Time starts again where it steps back by more than ``step_back`` s."""
        self._step_back = step_back
        self._held: Rows | None = None
        self._clock = -np.inf  # latest time of the present segment, s

    def mark(self, rows: Rows) -> Iterator[Rows]:
        """Yield rows with their segments marked; the last few wait for those that confirm them."""
        rows = rows if self._held is None else self._held.followed_by(rows)
        ready = len(rows.times) - CONFIRMING_ROWS
        self._held = rows if ready <= 0 else rows.part(slice(ready, None))
        if ready > 0:
            yield self._marked(rows, ready)

    def rest(self) -> Iterator[Rows]:
        """Yield the rows that still wait."""
        held, self._held = self._held, None
        if held is not None and len(held.times):
            yield self._marked(held, len(held.times))

    def _marked(self, rows: Rows, count: int) -> Rows:
        begins: Mask = rows.begins.copy()
        times, at = rows.times, 0
        while at < count:
            marks = np.flatnonzero(begins[at:count])
            until = at + int(marks[0]) if len(marks) else count
            if until == at:
                self._clock = float(times[at])
                until = at + int(marks[1]) if len(marks) > 1 else count
            clock = np.maximum.accumulate(np.maximum(times[at:until], self._clock))
            behind = np.flatnonzero(times[at:until] < clock - self._step_back)
            again = next((at + int(index) for index in behind if self._starts_again(times, at + int(index))), None)
            if again is None:
                self._clock = float(clock[-1])
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
    received: int = 0
    """Finite samples in the rows."""
    lost: int = 0
    """Samples that came after their window was closed, or were overwritten in a full ring."""
    bad: int = 0
    """See :attr:`otolith_drivers.replay.readers.Rows.bad`, up to the last row delivered."""
    reordered: int = 0
    """Rows with a time before that of an earlier row."""
    late: int = 0
    """Reordered rows whose window was closed already."""
    first_late: tuple[int, float, float] | None = None
    """Line and time (s) of the first late row, and the latest time (s) before it."""
    gaps: int = 0
    """Times without any row, longer than a window, that were skipped."""
    longest_gap: float = 0.0
    """The longest of them, s."""
    segments: int = 0
    """Recordings that begin after the first one."""
    repeated: int = 0
    """Samples at the time of another one, which were not used."""
    stale: int = 0
    """Readings of a register that had not been renewed, which were not used."""


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
        self._step = math.inf

    def windows(self, rows: Rows) -> Iterator[Window]:
        """Yield the windows that ``rows`` complete; the generator must be exhausted."""
        for part in self._segments.mark(rows):
            yield from self._windows_of(part)

    def rest(self) -> Iterator[Window]:
        """Yield the windows that are complete if no further row comes."""
        for part in self._segments.rest():
            yield from self._windows_of(part)
        yield from self._complete()

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
            elif clock[at] - self._clock > MAX_SILENT_WINDOWS * self.windower.length:
                yield from self._complete()
                self._skip_gap(float(clock[at]))
            check = self._next_check(float(clock[at]))
            until = at + int(np.searchsorted(clock[at:], check))
            self._deliver(rows, slice(at, until), clock)
            at = until
            if at < len(clock):
                yield from self._cut_due(check)

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
        self.windower.counts = old.counts
        if math.isinf(self._step):
            self._step = median_step(rows.times)
        step = min(old.sample_period, self._step)
        held = REPLAY_RING_WINDOWS * old.length + max(plan.delay for plan in self._plans)
        self._rings = Rings(old.signals, int(min(held / step, MAX_RING_SAMPLES)), self._observed)
        self._clock = self._begun = self._checked = float(rows.times[at])

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
            window = self.windower.cut(self._rings, unix_offset=0.0)
            self.counts.repeated, self.counts.stale = self.windower.counts.repeated, self.windower.counts.stale
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
