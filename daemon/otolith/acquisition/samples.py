"""The samples of one signal: cleaned, how often they come, and at the times of the clock that took them.

Cleaned, they are in order, one for each time, without stale repeats.

A source of cyclic signals samples on a clock of its own; only the arrival jitters, late but never early. A signal whose
period is that of the grid of the window is assigned to the slots of the grid: late samples move to earlier slots, and
values are not changed. A signal with another period has slots of its own, whose times are estimated from the arrivals;
they are slots of the grid if that period is a whole multiple of the grid's. Nothing is interpolated.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array, GridSpan, Mask
from otolith_drivers.base import Sampling

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
MAX_VALUE = 1e100  # in any unit; a larger number is no reading, and its square would overflow
SAME_INSTANT = 1e-9  # s between two times that are one: no logger resolves less
REGULAR_SHARE = 0.9  # of the intervals that must be whole multiples of the usual one where samples of a clock are lost
MULTIPLE_TOLERANCE = 0.2  # of the usual interval: how far a multiple may be off
SHORT_QUANTILES = (0.5, 0.25, 0.1, 0.0)  # of the intervals: tried for an interval without a loss
LONG_QUANTILE = 0.9  # of the intervals of a signal without a clock: longer ones, by LONG_FACTOR, are gaps
LONG_FACTOR = 3.0
REFINED_INTERVALS = 5.5  # usual intervals: longer ones do not refine it, because they may be off by one
LOST_INTERVAL = 1.5  # usual intervals above which a sample of a clock is lost
MIN_STALE_RUNS = 10  # runs of equal values that show how often a register is renewed
STALE_SHARE = 0.8  # of these runs that must be equally long
COARSE_STEPS = 2.0  # least steps by which a coarse sensor usually moves: then equal values are measurements
SAME_PERIOD = 0.02  # share by which the mean interval of a signal may differ from the period of the grid
MEDIAN_SD = 1.2533  # standard deviation of a median over that of the mean, for normal deviates
MAD_TO_SD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
PERIOD_DEVIATIONS = 4.0  # standard deviations by which the median interval may differ from the period of the grid
MAX_DROPPED_SAMPLES = 20  # surplus samples per window that are dropped; more of them show as jitter
PUNCTUAL_QUANTILE = 0.1  # of lateness: stands for the samples that the computer's load did not delay
MAX_CLOCK_JITTER = 0.25  # of its period: standard deviation of the arrivals about a clock, above which there is none
MAX_PHASE_ERROR = 0.05  # sample periods by which a delayed signal may be off the grid and still count as on it
MIN_CLOCK_SAMPLES = 4  # samples from which the clock of a signal with another period can be estimated
MAX_CLOCK_SLOTS = 100  # per sample: with more of them the arrivals have no clock
ON_GRID = 1e-3  # sample periods: distance of a true time from the grid that is rounding
EARLY = 2.0 * ON_GRID  # sample periods before the window that belong to its first record: rounding on both sides
LAG_DEVIATIONS = 3.0  # standard deviations by which neighbouring intervals must be correlated to show a second sender

Indices = NDArray[np.int64]


class Check(StrEnum):
    """A check of the data of a signal."""

    SPIKES = "spikes"
    FROZEN = "frozen"
    STALE = "stale"


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """How a signal is sampled, and what it is in the twin."""

    name: str
    hold: str | None = None  # Of an input: zoh for a command, foh for a measured quantity; None for an output
    sampling: Sampling = Sampling.TRUE
    delay: float = 0.0  # Time by which the signal is late, s; it is subtracted from the time of each sample
    on_change: bool | None = None  # Whether a command is recorded only when it changes; None: the record shall show it
    noise: float = 0.0  # Standard deviation of the noise of a sample, in the unit of the signal
    checks: frozenset[Check] = frozenset(Check)  # What its samples are checked for
    source: str = ""  # Which of several sources of the machine it comes from: sources have clocks of their own

    @property
    def is_cyclic(self) -> bool:
        """Whether the time of a sample is an arrival time."""
        return self.sampling is Sampling.CYCLIC

    @property
    def needs_next_sample(self) -> bool:
        """Whether its value between two samples depends on the second one."""
        return self.hold == "foh" or (self.hold == "zoh" and self.sampling is Sampling.POLLED and not self.on_change)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples of one signal, increasing in time."""

    times: Array
    values: Array
    repeated: int = 0  # Samples that were dropped because another one has the same time
    differing: int = 0  # Those of them with another value

    def within(self, start: float, end: float) -> "Series":
        """Return the samples with ``start <= time < end``."""
        first, last = self.times.searchsorted((start, end))
        return Series(self.times[first:last], self.values[first:last])


def finite_samples(times: Array, values: Array) -> tuple[Array, Array]:
    """Return the samples that are numbers, none of them beyond ``MAX_VALUE``."""
    finite = np.abs(values) <= MAX_VALUE
    return (times, values) if finite.all() else (times[finite], values[finite])


def has_equal_times(times: Array) -> bool:
    """Whether any of ``times`` (n,), s, in order, are equal."""
    return not bool((np.diff(times) > SAME_INSTANT).all())


def merge_equal_times(times: Array, values: Array, hold: str | None) -> Series:
    """Return one sample for each time: the last one of a command, the mean of a measured quantity.

    Two values at one time are one reading that was recorded twice, or two that a coarse clock stamped alike. Neither
    is worth more than one.
    """
    if not has_equal_times(times):
        return Series(times, values)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(times) > SAME_INSTANT]))
    ends = np.append(starts[1:], len(times))
    if hold == "zoh":
        merged = values[ends - 1]
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            merged = np.add.reduceat(values, starts) / (ends - starts)
        equal = np.maximum.reduceat(values, starts) == np.minimum.reduceat(values, starts)
        merged = np.where(equal | ~np.isfinite(merged), values[starts], merged)
    differing = int(np.count_nonzero((np.diff(times) <= SAME_INSTANT) & (values[1:] != values[:-1])))
    return Series(times[starts], merged, len(times) - len(starts), differing)


def renewal(lengths: Array, steps: Array) -> int:
    """Return the number of samples for which a register keeps its value; 1 if it is renewed for each.

    ``lengths`` are those of its runs of bit-identical values, ``steps`` the changes between them. The runs of a slow
    register are all equally long. So are those of a coarse sensor at a constant rate, but it moves by single steps.
    """
    if len(lengths) < MIN_STALE_RUNS:
        return 1
    usual, sizes = int(np.median(lengths)), np.abs(steps)
    is_regular = (np.abs(lengths - usual) <= usual // 3).mean() >= STALE_SHARE
    is_coarse = float(np.median(sizes)) <= COARSE_STEPS * float(sizes.min())
    return usual if usual > 1 and is_regular and not is_coarse else 1


def stale_repeats(values: Array) -> Mask:
    """Return which of ``values`` (n,) repeat the value of a register that was not renewed since it was read."""
    stale: Mask = np.zeros(len(values), dtype=np.bool_)
    steps = np.diff(values)
    changed = np.flatnonzero(steps)
    lengths = np.diff(changed).astype(np.float64)  # without the first and the last run, which the window cuts
    if renewal(lengths, steps[changed]) > 1:
        stale[1:] = steps == 0.0
    return stale


@dataclass(frozen=True, slots=True)
class Interval:
    """How often samples come."""

    usual: float  # Time between two samples without a loss, s; infinity for fewer than two samples
    longest: float  # Time between two samples above which a sample was lost, s


def interval_of(times: Array) -> Interval:
    """Return how often samples come at ``times`` (n,), s, increasing.

    Samples of a clock are whole multiples of one interval apart, however many are lost. Without a clock only an
    interval that is long against most others shows a loss.
    """
    intervals = np.diff(times)
    if not len(intervals):
        return Interval(np.inf, np.inf)
    for short in np.quantile(intervals, SHORT_QUANTILES):
        usual = float(np.median(intervals[intervals <= LOST_INTERVAL * short]))
        near = intervals[intervals < REFINED_INTERVALS * usual]
        usual = float(near.sum() / np.rint(near / usual).sum())
        multiples = intervals / usual
        off = np.abs(multiples - np.rint(multiples))
        if float((off <= MULTIPLE_TOLERANCE).mean()) >= REGULAR_SHARE:
            return Interval(usual, LOST_INTERVAL * usual)
    long = float(np.quantile(intervals, LONG_QUANTILE))
    return Interval(float(np.median(intervals)), LONG_FACTOR * long)


def lies_on_grid(times: Array, start: float, period: float) -> bool:
    """Whether all ``times`` (n,), s, are on the grid ``start + k * period`` up to rounding."""
    slots = (times - start) / period
    return bool((np.abs(slots - np.rint(slots)) <= ON_GRID).all())


def phase_of_grid(times: Array, start: float, period: float) -> float | None:
    """Return by how much the grid must move so that all ``times`` (n,), s, are on it; None if they are on no grid."""
    if len(times) < 2:
        return None
    turns = (times - start) / period
    phase = float(np.angle(np.exp(2j * np.pi * turns).mean())) / (2.0 * np.pi)
    return phase * period if lies_on_grid(times, start + phase * period, period) else None


@dataclass(frozen=True, slots=True, eq=False)
class CyclicSeries:
    """The samples of a cyclic signal at the times of its clock."""

    series: Series
    lateness: Array  # Arrival of each sample minus the time of its slot, s
    on_grid: bool  # Whether the slots are those of the grid of the window
    surplus: int = 0  # Samples dropped because there was no slot for them
    irregularity: float = 0.0
    """Standard deviation of the interval over its mean, of a signal with a period of its own; zero if samples were lost
    at random only."""


def has_period(times: Array, period: float) -> bool:
    """Whether samples that arrive at ``times`` (n,), s, come every ``period`` s, some lost and some late."""
    intervals = np.diff(times)
    if not len(intervals):
        return True
    if abs(float(intervals.mean()) / period - 1.0) <= SAME_PERIOD:
        return True
    median = float(np.median(intervals))
    spread = MAD_TO_SD * float(np.median(np.abs(intervals - median)))
    allowed = max(SAME_PERIOD * period, PERIOD_DEVIATIONS * MEDIAN_SD * spread / np.sqrt(len(intervals)))
    return bool(abs(median - period) <= allowed)


def align(samples: Series, span: GridSpan, grace: float) -> CyclicSeries:
    """Return the samples of a cyclic signal in the slots ``start + k * period``, or in slots of its own.

    A sample belongs to the slots of the window if it comes from ``grace`` s before until ``grace`` s after it. The
    lateness is that of the slots ``k < records``. The other samples keep their times.
    """
    if not has_period(samples.within(span.start - grace, span.end + grace).times, span.period):
        return _own_clock(samples, span, grace)
    return align_to_grid(samples, span, grace)


def align_delayed(
    samples: Series, delay: float, span: GridSpan, grace: float, arrivals: Array | None = None
) -> CyclicSeries:
    """Return the samples of a cyclic signal at the times of their arrival, without lateness, minus ``delay`` (s).

    Slots of the grid would take away a part of the delay: that by which this signal arrives later than the others. The
    lateness beyond the delay stays, so that the grid can follow the clock of the source. ``arrivals`` are the times of
    all signals with the clock of this one, if there are others.
    """
    phase = _arrival_phase(samples.times if arrivals is None else arrivals, span)
    slots = round((delay - phase) / span.period)
    own = replace(span, start=span.start + phase + slots * span.period)
    aligned = align(samples, own, grace)
    times = aligned.series.times - delay
    off_grid = own.start - delay - span.start
    if not aligned.on_grid or abs(off_grid) > MAX_PHASE_ERROR * span.period:
        return replace(aligned, series=Series(times, aligned.series.values), on_grid=False)
    series = Series(times - off_grid, aligned.series.values)
    return replace(aligned, series=series, lateness=aligned.lateness + off_grid)


def _arrival_phase(times: Array, span: GridSpan) -> float:
    """Return when the punctual samples arrive after the slots of the grid, s: between zero and a period."""
    if not len(times):
        return 0.0
    turns = (times - span.start) / span.period
    middle = float(np.angle(np.exp(2j * np.pi * turns).mean())) / (2.0 * np.pi)
    deviations = (turns - middle + 0.5) % 1.0 - 0.5
    return (middle + float(np.quantile(deviations, PUNCTUAL_QUANTILE))) % 1.0 * span.period


def align_to_grid(samples: Series, span: GridSpan, grace: float) -> CyclicSeries:
    """Return the samples of a signal in the slots ``start + k * period``, as :func:`align` does."""
    return SlotsOnGrid.of(samples.times, span, grace).filled(samples.values)


@dataclass(frozen=True, slots=True, eq=False)
class SlotsOnGrid:
    """The slots of samples with these times: the same for all signals that were sampled together."""

    chosen: Indices  # The samples that have a slot, or are before or after those
    times: Array  # Of their slots
    is_rising: bool  # Whether no two of these are equal
    lateness: Array  # As in CyclicSeries, like what follows
    surplus: int

    @classmethod
    def of(cls, times: Array, span: GridSpan, grace: float) -> Self:
        """Return the slots for ``times`` (samples,), as :func:`align_to_grid` does."""
        start, period = span.start, span.period
        first, last = times.searchsorted((start - grace, span.end + grace)).tolist()
        near = times[first:last]
        kept, slots = _assign_slots(near, np.rint((near - start) / period))
        at: Array = np.asarray(start + slots * period)
        inside = (slots >= 0) & (slots < span.records)
        until = times.searchsorted(min(start - grace, float(at[0]) if len(at) else np.inf))
        since = times.searchsorted(max(span.end + grace, float(at[-1]) + period / 2 if len(at) else -np.inf))
        every = np.concatenate([times[:until], at, times[since:]])
        chosen = np.concatenate([np.arange(until), first + kept, np.arange(since, len(times))])
        return cls(chosen, every, not has_equal_times(every), (near[kept] - at)[inside], len(near) - len(kept))

    def filled(self, values: Array) -> CyclicSeries:
        """Return the samples with these values (samples,) in their slots."""
        own = values[self.chosen]
        # Those before and after the window may have equal times.
        series = Series(self.times, own) if self.is_rising else merge_equal_times(self.times, own, "zoh")
        return CyclicSeries(series, self.lateness, on_grid=True, surplus=self.surplus)


def _own_clock(samples: Series, span: GridSpan, grace: float) -> CyclicSeries:
    """Return the samples in slots whose period and phase are estimated from the arrivals.

    Where the arrivals are too irregular for a clock, each sample keeps the time of its arrival.
    """
    times, values, irregularity = samples.times, samples.values, irregularity_of(samples.times)
    last_of_each = merge_equal_times(times, values, "zoh")
    as_arrived = CyclicSeries(last_of_each, np.zeros(0), on_grid=False, irregularity=irregularity)
    if len(last_of_each.times) < MIN_CLOCK_SAMPLES:
        return as_arrived
    nearest = np.rint(np.diff(times, prepend=times[0]) / interval_of(last_of_each.times).usual).cumsum()
    for _ in range(2):  # from interval to interval, then on the clock that this gives
        if float(np.abs(nearest).max()) > MAX_CLOCK_SLOTS * len(times):
            return as_arrived
        kept, slots = _assign_slots(times, nearest)
        if len(kept) < MIN_CLOCK_SAMPLES:
            return as_arrived
        arrivals, slots = times[kept], slots - slots[0]
        period, start = (float(number) for number in np.polyfit(slots, arrivals, 1))
        if period <= 0.0:
            return as_arrived
        nearest = np.rint((times - start) / period)
    lateness = arrivals - (start + slots * period)
    if float(lateness.std()) > MAX_CLOCK_JITTER * period:
        return as_arrived
    start += float(np.quantile(lateness, PUNCTUAL_QUANTILE))
    multiple = round(period / span.period)
    on_grid = multiple > 0 and abs(period / (multiple * span.period) - 1.0) * float(slots[-1]) * multiple < 0.5
    if on_grid and multiple == 1:
        return align_to_grid(samples, span, grace)
    if on_grid:
        slots = round((start - span.start) / span.period) + slots * multiple
        start, period = span.start, span.period
    at: Array = np.asarray(start + slots * period)
    return CyclicSeries(Series(at, values[kept]), arrivals - at, on_grid, len(times) - len(kept), irregularity)


def quantile_of(values: Array, share: float) -> float:
    """Return what ``np.quantile`` does, for a ``share`` from 0 to 1 of finite ``values``, in a tenth of the time."""
    last = len(values) - 1
    first = int(place := share * last)
    ordered, part = np.partition(values, (first, min(first + 1, last))), place - first
    low, high = float(ordered[first]), float(ordered[min(first + 1, last)])
    return high - (high - low) * (1.0 - part) if part >= 0.5 else low + (high - low) * part


def irregularity_of(times: Array) -> float:
    """Return the standard deviation of the intervals between ``times`` (n,) over their mean.

    It is zero if neighbouring intervals are independent, as where samples are lost at random. With a second sender, or
    with late samples, a short interval follows a long one.
    """
    intervals = np.diff(times)
    count, deviations = len(intervals), intervals - intervals.mean() if len(intervals) else intervals
    variance = float(np.mean(deviations**2)) if count else 0.0
    if count < 2 or variance <= 0.0:
        return 0.0
    correlation = float(np.sum(deviations[1:] * deviations[:-1])) / (count * variance)
    alternating = correlation < -LAG_DEVIATIONS / np.sqrt(count)
    return float(np.sqrt(variance) / intervals.mean()) if alternating else 0.0


def _assign_slots(times: Array, nearest: Array) -> tuple[Indices, Indices]:
    """Return the indices of the samples to keep, and the slot of each; ``nearest`` is the slot nearest to each sample.

    A sample takes the nearest slot, or an earlier one where several came in a burst. If the samples of a burst find no
    free slot before them, one sample is surplus: the one closest to its predecessor is dropped. After
    ``MAX_DROPPED_SAMPLES`` dropped samples the rest keep their late slots.
    """
    kept, wanted = np.arange(len(times)), nearest.astype(np.int64)
    for droppable in range(MAX_DROPPED_SAMPLES, -1, -1):
        order = np.arange(len(kept))
        slots = np.minimum.accumulate((wanted[kept] - order)[::-1])[::-1] + order
        moved = wanted[kept] > slots
        if not len(kept) or not moved[0] or not droppable:
            break
        burst = len(moved) if moved.all() else int(np.argmin(moved))
        surplus = int(np.argmin(np.diff(times[kept][: burst + 1]))) + 1 if burst > 0 and len(kept) > 1 else 0
        kept = np.delete(kept, surplus)
    return kept, slots
