"""A window: the samples of a machine in a stretch of time, each at its own time, and the quality of their sampling.

The times of its records are uniform, or those at which the samples were taken.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)  # no slots: times before the last record are computed once
class TimeGrid:
    """The records of a window in time. A uniform grid gives the same numbers, bit for bit, wherever it starts."""

    offsets: Array  # (records,) time since the first record, s; increasing from zero
    steps: Array  # (records,) time to the next record, s; from the last record to the end of the window
    period: float | None = None  # Time between any two records, s; None if the records are not uniform

    @classmethod
    def uniform(cls, records: int, period: float) -> Self:
        """Return the grid of ``records`` that are ``period`` s apart."""
        return cls(period * np.arange(records, dtype=np.float64), np.full(records, period), period)

    @classmethod
    def at(cls, offsets: Array, length: float) -> Self:
        """Return the grid of records at ``offsets`` s, the first of which is zero, in a window of ``length`` s."""
        return cls(offsets, np.diff(offsets, append=length))

    @property
    def records(self) -> int:
        """Number of records."""
        return len(self.offsets)

    @property
    def length(self) -> float:
        """Time from the first record to the end of the window, s."""
        if self.period is not None:
            return self.records * self.period
        return float(self.offsets[-1] + self.steps[-1]) if self.records else 0.0

    @property
    def mean_step(self) -> float:
        """Mean time between two records, s."""
        return self.period if self.period is not None else self.length / max(self.records, 1)

    @cached_property
    def before_last(self) -> Array:
        """(records,) time since the last record, s; zero or negative."""
        if self.period is not None:
            return np.asarray((np.arange(self.records) - self.records + 1) * self.period)
        return self.offsets - self.offsets[-1:]

    def since(self, record: int) -> "TimeGrid":
        """Return the grid from ``record`` on."""
        if self.period is not None:
            return TimeGrid.uniform(self.records - record, self.period)
        return TimeGrid(self.offsets[record:] - self.offsets[record], self.steps[record:])

    def until(self, record: int) -> "TimeGrid":
        """Return the grid before ``record``."""
        if self.period is not None:
            return TimeGrid.uniform(record, self.period)
        return TimeGrid(self.offsets[:record], self.steps[:record])


@dataclass(frozen=True, slots=True)
class GridSpan:
    """The stretch of time of a window, and the grid that is laid through it."""

    start: float  # s
    records: int  # Of the grid
    period: float  # Of the grid, s

    @property
    def length(self) -> float:
        """Length, s."""
        return self.records * self.period

    @property
    def end(self) -> float:
        """Time at which the last record of the grid ends, s."""
        return self.start + self.length


class Verdict(StrEnum):
    """Whether parameters may be estimated from a window."""

    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a window was sampled; each number is that of the worst signal."""

    verdict: Verdict
    missing: float  # Share of records without a sample, 0 to 1
    longest_gap: float  # Longest time without a sample, s
    jitter: float  # Root mean square distance of the samples from the grid, s
    skew: float  # Largest difference between two signals' median distances from the grid, s
    reasons: tuple[str, ...] = ()  # Why the verdict is bad, one sentence per limit; empty if it is good


@dataclass(frozen=True, slots=True, eq=False)
class BridgeError:
    """How far the inputs of a window may be from the truth between their samples; (records, signals) each.

    An error that lasts longer than a step disturbs the states more than one that is independent from record to record.
    ``noise_ratio`` and ``held_variance`` are those of the independent error with the same effect on the states.
    """

    noise_ratio: Array
    """Variance of the independent noise of a record over that of the noise of a sample; one where each record has one.
    """
    variance: Array  # Variance of the value of a record beside that noise, in the squared unit of the signal
    held_variance: Array
    """Variance of the independent error of a record beside that noise, in the squared unit of the signal."""
    expected_change: Array
    """What the value of a record has beside its reading: the change that is expected before the next reading."""

    def rows(self, part: slice) -> "BridgeError":
        """Return the same for some of the records."""
        return BridgeError(
            self.noise_ratio[part], self.variance[part], self.held_variance[part], self.expected_change[part]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Records of all signals of a machine. Frozen and picklable; equal to itself only."""

    index: int
    start: float  # Seconds of the first record, on the clock of the windows: service time, or the time of a log
    grid: TimeGrid
    signals: tuple[str, ...]
    values: Array  # (records, signals), each in the unit of its signal; an input is bridged between its samples
    missing: Mask  # (records, signals), true where a value is no measurement
    quality: Quality
    bridge_error: BridgeError | None = None  # None if every record has a sample of every input
    observed: Mapping[str, float] = field(default_factory=dict)
    """Mean over the window of each signal that only the judgement of the estimates needs, as a temperature."""
    absent: Mapping[str, str] = field(default_factory=dict)
    """Of several sources, those that are down or gave no sample: in words, by name."""
    outages: Mapping[str, str] = field(default_factory=dict)
    """Outputs of the daemon that fail for long, and why, by name."""
    ahead: float = 0.0  # Unix time minus that clock, s; only texts have Unix times

    @classmethod
    def whole(cls, index: int, start: float, sample_period: float, signals: tuple[str, ...], values: Array) -> Self:
        """Return a window without gaps and jitter, as simulations and files on a grid give it."""
        missing = np.zeros(values.shape, dtype=np.bool_)
        grid = TimeGrid.uniform(len(values), sample_period)
        return cls(index, start, grid, signals, values, missing, Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0))

    @property
    def records(self) -> int:
        """Number of records."""
        return len(self.values)

    @property
    def sample_period(self) -> float:
        """Mean time between two records, s."""
        return self.grid.mean_step

    @property
    def end(self) -> float:
        """Seconds at which the last record ends, on the clock of ``start``."""
        return self.start + self.grid.length

    def since(self, record: int) -> Self:
        """Return the part of the window from ``record`` on."""
        start = self.start + self.grid.offsets[record]
        return self._rows(slice(record, None), float(start), self.grid.since(record))

    def until(self, record: int) -> Self:
        """Return the part of the window before ``record``."""
        return self._rows(slice(None, record), self.start, self.grid.until(record))

    def _rows(self, part: slice, start: float, grid: TimeGrid) -> Self:
        error = None if self.bridge_error is None else self.bridge_error.rows(part)
        values, missing = self.values[part], self.missing[part]
        return replace(self, start=start, grid=grid, values=values, missing=missing, bridge_error=error)

    def column(self, signal: str) -> Array:
        """Return the values of one signal, (records,) in its unit."""
        return self.values[:, self.signals.index(signal)]

    def readings(self, signal: str) -> Array:
        """Return one signal as it was measured, (records,) in its unit; where it is missing, of no meaning."""
        values = self.column(signal)
        error = self.bridge_error
        return values if error is None else values - error.expected_change[:, self.signals.index(signal)]

    def measured(self, names: Sequence[str]) -> Array:
        """Return the readings (records, names) of signals, not-a-number where nothing was measured."""
        columns = np.array([self.signals.index(name) for name in names], dtype=np.int64)
        readings = self.values if self.bridge_error is None else self.values - self.bridge_error.expected_change
        return np.where(self.missing.take(columns, axis=1), np.nan, readings.take(columns, axis=1))

    def missing_in(self, signal: str) -> Mask:
        """Return where one signal is missing, (records,)."""
        return self.missing[:, self.signals.index(signal)]


def runs_of(mask: Mask) -> list[tuple[int, int]]:
    """Return begin and end of each run of true records."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def larger_sizes(sizes: Mapping[str, float], window: Window) -> dict[str, float]:
    """Return the largest root mean square of each signal, also in ``window``."""
    present = ~window.missing
    values, counts = np.where(present, window.values, 0.0), present.sum(axis=0)
    means = np.sqrt(np.einsum("rs,rs->s", values, values) / np.maximum(counts, 1)).tolist()
    own = {name: mean for name, mean, count in zip(window.signals, means, counts.tolist(), strict=True) if count}
    return {name: max(own.get(name, 0.0), sizes.get(name, 0.0)) for name in {**sizes, **own}}
