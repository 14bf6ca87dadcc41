"""Rows of a table through the rings and the windower of the daemon, with the data's own time as the clock.

Between two looks at the rings the daemon's thread sleeps and samples come in. Here the looks are where they can
matter: half a sample period after the end of a window, when all that is on the grid has come, and then as samples come
until the window waits no longer. So the windows depend on the rows alone, not on how they are read.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.alignment import Limits
from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Array, Window
from otolith.acquisition.windower import GRACE, Windower
from otolith_drivers.replay.readers import Integers, Rows

ROOM = 16  # windows that the rings hold
MOST_ROOM = 1 << 20  # samples of each signal, however many there are in a window
OUTAGE = 100  # windows; a longer silence is not told window by window


@dataclass(slots=True)
class PlaybackCounts:
    """What became of the rows."""

    rows: int = 0
    received: int = 0
    """Samples in them."""
    lost: int = 0
    """Samples that came too late for their window, or fell out of a full ring."""
    bad: int = 0
    """See :attr:`otolith_drivers.replay.readers.Rows.bad`, up to the last row that was taken."""
    reordered: int = 0
    """Rows with a time before that of a row above."""
    late: int = 0
    """Of these, the ones whose window was closed."""
    first_late: tuple[int, float, float] | None = None
    """Line and time (s) of the first of them, and the latest time (s) above it."""
    outages: int = 0
    """Silences that were passed over."""


def usual_step(times: Array) -> float:
    """How far (s) rows are apart, those aside that go back; infinity if time stands still."""
    steps = np.diff(times)
    onward = steps[steps > 0.0]
    return float(np.median(onward)) if len(onward) else math.inf


class Playback:
    """Times are seconds, as the rows have them; ``windower.records`` may be set between two windows."""

    def __init__(self, signals: tuple[str, ...], records: int, sample_period: float, limits: Limits) -> None:
        self.windower = Windower(signals, records, sample_period, limits)
        self.counts = PlaybackCounts()
        self._limits = limits
        self._rings = Rings(signals, 1)
        self._cut = 0
        self._clock = -math.inf  # latest time of a row that was delivered
        self._begun = self._looked = -math.inf
        self._step = math.inf

    def windows(self, rows: Rows) -> Iterator[Window]:
        """The windows that are complete once ``rows`` have come; a generator that must be exhausted."""
        clock = np.maximum.accumulate(np.maximum(rows.times, self._clock))
        self.counts.reordered += int(np.count_nonzero(rows.times < clock))
        at = 0
        while at < len(clock):
            if clock[at] - self._clock > OUTAGE * self.windower.length:
                yield from self.rest()
                self._begin(rows, at)
            look = self._next_look(float(clock[at]))
            until = at + int(np.searchsorted(clock[at:], look))
            self._deliver(rows, slice(at, until), clock)
            at = until
            if at < len(clock):
                yield from self._look(look)

    def rest(self) -> Iterator[Window]:
        """The windows that are complete if nothing more comes for a while."""
        if self._begun > -math.inf:
            yield from self._look(self._clock + 1.5 * self.windower.sample_period + GRACE)

    @property
    def left(self) -> float:
        """How many seconds of data are too few for another window."""
        return max(0.0, self._clock + self.windower.sample_period - self._start) if self._cut else 0.0

    @property
    def _start(self) -> float:
        return self.windower.next_end - self.windower.length

    def _begin(self, rows: Rows, at: int) -> None:
        """As a daemon that is started with the row ``at``."""
        self.counts.outages += self._begun > -math.inf
        old = self.windower
        self.windower = Windower(old.signals, old.records, old.sample_period, self._limits)
        if math.isinf(self._step):
            self._step = usual_step(rows.times)
        in_window = max(old.records, old.length / self._step)
        self._rings = Rings(old.signals, int(min(ROOM * in_window, MOST_ROOM)))
        self._clock = self._begun = self._looked = float(rows.times[at])

    def _next_look(self, coming: float) -> float:
        """When (s) the rings are worth a look, if the next row takes the clock to ``coming``."""
        period, end = self.windower.sample_period, self.windower.next_end
        deadline = end + GRACE
        if math.isinf(end):
            deadline = self._begun + self.windower.length
        elif self._looked < end + period / 2:
            return end + period / 2
        return max(self._looked + period, min(coming, deadline))

    def _look(self, now: float) -> Iterator[Window]:
        self._looked = now
        begun = self.windower.begin(self._rings, now, now - self._begun)
        while begun and self.windower.due(self._rings, now):
            window = self.windower.cut(self._rings, unix_offset=0.0)
            self._cut += 1
            yield replace(window, index=self._cut - 1)

    def _deliver(self, rows: Rows, part: slice, clock: Array) -> None:
        times = rows.times[part]
        if not len(times):
            return
        oldest = self._start - self.windower.sample_period / 2
        if math.isinf(oldest):
            oldest = self._begun - self.windower.length
        in_time = times >= oldest
        columns = {}
        for signal, values in rows.columns.items():
            there = np.isfinite(values[part])
            self.counts.received += int(np.count_nonzero(there))
            self.counts.lost += int(np.count_nonzero(there & ~in_time))
            columns[signal] = (times[there & in_time], values[part][there & in_time])
        fallen = self._rings.counters().overwritten
        self._rings.deliver_columns(columns)
        self.counts.lost += self._rings.counters().overwritten - fallen
        self.counts.rows += len(times)
        self.counts.bad = int(rows.bad[part][-1])
        if not in_time.all():
            self._note_late(rows, part.start + np.flatnonzero(~in_time), clock)
        self._clock = float(clock[part][-1])

    def _note_late(self, rows: Rows, late: Integers, clock: Array) -> None:
        self.counts.late += len(late)
        if self.counts.first_late is None:
            first = int(late[0])
            self.counts.first_late = (int(rows.lines[first]), float(rows.times[first]), float(clock[first]))
