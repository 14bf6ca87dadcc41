"""The samples of one signal, cleaned: in order, one for each time, without stale repeats; and how often they come."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array, Mask
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
        first, last = np.searchsorted(self.times, (start, end))
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
