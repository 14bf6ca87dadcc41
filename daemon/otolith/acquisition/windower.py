"""Take the samples of consecutive windows out of the rings, without gap or overlap between them.

This follows the clocks of the sources only, which is quick. Records are made where the window is cut
(:mod:`otolith.acquisition.cutting`), in another process.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import (
    EARLY,
    ON_GRID,
    PUNCTUAL_QUANTILE,
    CyclicSeries,
    Series,
    SignalPlan,
    SlotsOnGrid,
    align,
    align_delayed,
    finite_samples,
    has_equal_times,
    has_period,
    lies_on_grid,
    merge_equal_times,
    phase_of_grid,
    quantile_of,
)
from otolith.acquisition.window import Array, GridSpan

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
GRACE_PERIOD = 0.1  # s after its end that a window waits for late samples, at least,
SLOW_GRACE = 1.5  # or so many intervals of the slowest input that needs its next sample, at most a window's length
NO_SAMPLES = Series(np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class AlignedSamples:
    """The samples of each signal by its name, for a window."""

    series: Mapping[str, Series]
    cyclic: Mapping[str, CyclicSeries]  # Of the signals on the grid or with a clock
    repeated: int  # Samples of the window at the time of another one, which no record has
    ambiguous: Mapping[str, float]
    """Share of the samples of the window that have the time, but not the value of another one."""


@dataclass(frozen=True, slots=True, eq=False)
class RawWindow:
    """The samples in and around a stretch of time, each with the time of its clock: a window that is not cut yet.

    Frozen and picklable.
    """

    index: int
    span: GridSpan  # In monotonic time
    offset: float  # Time of windows minus monotonic time, s
    ahead: float  # Unix time minus the time of windows, s
    samples: AlignedSamples
    plans: Mapping[str, SignalPlan]
    limits: QualityLimits
    observed: Mapping[str, float]
    """Mean over the window of each signal that only the judgement of the estimates needs."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowerState:
    """All of a windower but its plans and limits, so that it can be continued."""

    records: int
    sample_period: float  # s
    latency: float  # s
    grace: float  # s
    intervals: Mapping[str, float]  # By signal, s
    start: float  # s
    index: int


class Windower:
    """Tracks where the next window begins. Times are seconds on the monotonic clock, given by the caller."""

    def __init__(
        self, plans: Sequence[SignalPlan], records: int, sample_period: float, limits: QualityLimits | None = None
    ) -> None:
        """``records`` and ``sample_period`` (s) are those of the grid: together the length of a window."""
        self.plans = {plan.name: plan for plan in plans}
        self.signals = tuple(self.plans)
        self.records = records
        self.sample_period = sample_period
        self.latency = 0.0  # s; by which samples arrive after their times because the source sends many at once
        self._limits = limits or QualityLimits()
        self._source_of_grid = next((plan.source for plan in plans if plan.is_cyclic), None)
        self.grace = GRACE_PERIOD  # Time after its end that the next window waits for late samples, s
        self._intervals: dict[str, float] = {}
        self._start = math.inf
        self._index = 0

    @property
    def state(self) -> WindowerState:
        """All but plans and limits."""
        grid = self.records, self.sample_period, self.latency, self.grace
        return WindowerState(*grid, dict(self._intervals), self._start, self._index)

    def restore(self, state: WindowerState) -> None:
        """Continue ``state``, which must be of the same plans and limits."""
        self.records, self.sample_period = state.records, state.sample_period
        self.latency, self.grace, self._intervals = state.latency, state.grace, dict(state.intervals)
        self._start, self._index = state.start, state.index

    @property
    def length(self) -> float:
        """Length of a window, s."""
        return self.records * self.sample_period

    @property
    def next_start(self) -> float:
        """Time at which the next window starts, s; infinity before the first window has begun."""
        return self._start

    @property
    def next_end(self) -> float:
        """Time at which the last record of the next window ends, s; infinity before the first window has begun."""
        return self._start + self.length

    @property
    def deadline(self) -> float:
        """Time after which the next window no longer waits for late samples, s."""
        return self.next_end + max(plan.delay for plan in self.plans.values()) + self.grace + self.latency

    def begin(self, rings: Rings, now: float, waited: float) -> bool:
        """Return whether the first window has begun.

        It begins when every signal has a sample, or after ``waited`` >= one window length without.
        """
        if math.isinf(self._start):
            first = [time - self.plans[name].delay for name, time in rings.first_times().items()]
            if all(map(math.isfinite, first)):
                self._start = max(first)
            elif waited >= self.length:
                self._start = now - self.length
        return math.isfinite(self._start)

    def due(self, rings: Rings, now: float) -> bool:
        """Return whether the next window is complete, or the time to wait for late samples has passed.

        A signal is complete when the first sample of the following window is there. That of a cyclic signal is the one
        that is closer to its first slot than to the last one of this window.
        """
        complete = all(
            time - plan.delay >= self.next_end - (0.5 if plan.is_cyclic else EARLY) * self.sample_period
            for plan, time in ((self.plans[name], time) for name, time in rings.last_times().items())
        )
        return complete or now >= self.deadline

    def take(self, rings: Rings, offset: float, ahead: float = 0.0) -> RawWindow:
        """Return the samples of the next window.

        ``offset`` is the time of windows minus monotonic time, and ``ahead`` Unix time minus the time of windows, s.
        """
        samples = self._align(rings)
        if self._index == 0:  # the grid was laid through a single sample, which may have been late
            self._start += self._grid_shift(samples.cyclic, first=True)
            samples = self._align(rings)
        observed = rings.observed_means(self._start, self.next_end)
        raw = RawWindow(self._index, self._span(), offset, ahead, samples, self.plans, self._limits, observed)
        self.grace = self._next_grace(samples.series)
        self._index += 1
        self._start = self._start + self.length + self._grid_shift(samples.cyclic, first=False)
        return raw

    def _grid_shift(self, aligned: Mapping[str, CyclicSeries], *, first: bool) -> float:
        """Return by how much to move the grid, s: it follows one clock."""
        followed = {name: item for name, item in aligned.items() if self._has_clock_of_grid(self.plans[name])}
        return _grid_shift(followed, first=first, period=self.sample_period)

    def regrid(self, records: int, sample_period: float) -> None:
        """From the next window on, cut ``records`` records, ``sample_period`` s apart."""
        self.records, self.sample_period = records, sample_period

    def _span(self) -> GridSpan:
        """Return the next window."""
        return GridSpan(self._start, self.records, self.sample_period)

    def skip_to(self, start: float) -> None:
        """Let the next window start at ``start`` (s), after a time without samples."""
        if math.isfinite(self._start):
            self._start = max(self._start, start)

    def _align(self, rings: Rings) -> AlignedSamples:
        series, repeated, ambiguous = dict[str, Series](), 0, dict[str, float]()
        latest: Array | None = None  # Times without equal ones
        for name, plan in self.plans.items():
            series[name], merged = self._samples(rings, plan, latest)
            if not plan.is_cyclic and merged is NO_SAMPLES:
                latest = series[name].times
            repeated += merged.repeated
            if merged.differing:
                ambiguous[name] = merged.differing / (len(merged.times) + merged.repeated)
        true = [name for name, plan in self.plans.items() if not plan.is_cyclic and self._has_clock_of_grid(plan)]
        self._adopt_phase([series[name] for name in true])
        aligned: dict[str, CyclicSeries] = {}
        # By the array of times, which signals that come together share; each array lives until its signals are aligned
        slots: dict[int, SlotsOnGrid | None] = {}
        for name, plan in self.plans.items():
            if plan.is_cyclic and not self._has_clock_of_grid(plan):
                arrivals = self._arrivals(plan, series)
                aligned[name] = align_delayed(series[name], plan.delay, self._span(), GRACE_PERIOD, arrivals)
            elif plan.is_cyclic and plan.delay:
                aligned[name] = align_delayed(series[name], plan.delay, self._span(), GRACE_PERIOD)
            elif plan.is_cyclic:
                aligned[name] = align(series[name], self._span(), GRACE_PERIOD)
            else:
                times = series[name].times
                if id(times) not in slots:
                    is_on_grid = self._is_on_grid(series[name])
                    slots[id(times)] = SlotsOnGrid.of(times, self._span(), GRACE_PERIOD) if is_on_grid else None
                if (own := slots[id(times)]) is not None:
                    aligned[name] = own.filled(series[name].values)
            series[name] = aligned[name].series if name in aligned else series[name]
        return AlignedSamples(series, aligned, repeated, ambiguous)

    def _has_clock_of_grid(self, plan: SignalPlan) -> bool:
        """Whether a signal comes from the source whose clock the grid follows: the first with cyclic signals."""
        return self._source_of_grid in (None, plan.source)

    def _arrivals(self, plan: SignalPlan, series: dict[str, Series]) -> Array | None:
        """Return the times at which signals arrive that were sampled together with this one; None if it is alone."""
        together = [
            series[name].times
            for name, other in self.plans.items()
            if (other.is_cyclic, other.source, other.delay) == (True, plan.source, plan.delay)
            and has_period(series[name].times, self.sample_period)
        ]
        return np.sort(np.concatenate(together)) if together else None

    def _samples(self, rings: Rings, plan: SignalPlan, latest: Array | None) -> tuple[Series, Series]:
        """Return the samples of a signal from one window before this one until after it, and the one before them.

        The second series has those of this window alone, if some have equal times; it is empty otherwise. Times like
        the ``latest`` ones of another signal, none of which are equal, are the same array.
        """
        start, end = self._start - self.length + plan.delay, self.next_end + max(self.grace, self.length) + plan.delay
        times, values = finite_samples(*rings.around(plan.name, start, end, self.next_end + plan.delay))
        if plan.is_cyclic:  # the alignment subtracts the delay
            return Series(times, values), NO_SAMPLES
        times = times - plan.delay if plan.delay else times
        if latest is not None and np.array_equal(times, latest):
            return Series(latest, values), NO_SAMPLES
        if not has_equal_times(times):
            return Series(times, values), NO_SAMPLES
        here = slice(*np.searchsorted(times, (self._start, self.next_end)))
        return merge_equal_times(times, values, plan.hold), merge_equal_times(times[here], values[here], plan.hold)

    def _is_on_grid(self, series: Series) -> bool:
        times = self._within(series).times
        return len(times) > 0 and lies_on_grid(times, self._start, self.sample_period)

    def _within(self, series: Series) -> Series:
        """Return the samples of the next window at true times; none of them is in the window before."""
        early = EARLY * self.sample_period
        return series.within(self._start - early, self.next_end - early)

    def _adopt_phase(self, series: list[Series]) -> None:
        """Move the start to where true times are, if they are on a grid: after a pause it may have another phase.

        It moves forward, by less than a sample period, so that no sample is in two windows.
        """
        if not series:
            return
        times = np.concatenate([self._within(item).times for item in series])
        phase = phase_of_grid(times, self._start, self.sample_period)
        if phase is not None and abs(phase) > ON_GRID * self.sample_period:
            self._start += phase if phase >= -EARLY * self.sample_period else phase + self.sample_period

    def _next_grace(self, series: Mapping[str, Series]) -> float:
        """Return how long to wait for the sample after the end of a window, s: a bridge needs both of its ends.

        A signal without two samples in sight has its last known interval.
        """
        usual: dict[int, float] = {}  # As the slots of _align
        for name, samples in series.items():
            if self.plans[name].needs_next_sample and len(times := samples.times) > 1:
                if id(times) not in usual:
                    usual[id(times)] = float(np.median(np.diff(times)))
                self._intervals[name] = usual[id(times)]
        slowest = max(self._intervals.values(), default=0.0)
        return float(np.clip(SLOW_GRACE * slowest, GRACE_PERIOD, max(self.length, GRACE_PERIOD)))


def _grid_shift(aligned: Mapping[str, CyclicSeries], *, first: bool, period: float) -> float:
    """Return by how much to move the grid, in s, at most half a sample period.

    The clock of the source drifts against the monotonic clock. The lateness of the two halves of a window gives its
    slope; a straight line through both gives the lateness in the middle of the next window, or of the first window
    itself, which is aligned twice.
    """
    lateness = [item.lateness for item in aligned.values() if item.on_grid and len(item.lateness) > 1]
    halves = [(len(late) // 2, late) for late in lateness]
    if not halves:
        return 0.0
    early = quantile_of(np.concatenate([late[:half] for half, late in halves]), PUNCTUAL_QUANTILE)
    late = quantile_of(np.concatenate([late[half:] for half, late in halves]), PUNCTUAL_QUANTILE)
    shift = late + (0.5 * (early - late) if first else 1.5 * (late - early))
    return float(np.clip(shift, -period / 2, period / 2))
