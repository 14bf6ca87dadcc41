"""The times of the records of a window: uniform, or those at which the samples were taken."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TimeGrid:
    """The records of a window in time. A uniform grid gives the same numbers, bit for bit, wherever it starts."""

    offsets: Times
    """(records,) time since the first record, s; increasing from zero."""
    steps: Times
    """(records,) time to the next record, s; from the last record to the end of the window."""
    period: float | None = None
    """Time between any two records, s; None if the records are not uniform."""

    @classmethod
    def uniform(cls, records: int, period: float) -> Self:
        """Return the grid of ``records`` that are ``period`` s apart."""
        return cls(period * np.arange(records, dtype=np.float64), np.full(records, period), period)

    @classmethod
    def at(cls, offsets: Times, length: float) -> Self:
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

    @property
    def before_last(self) -> Times:
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

    start: float
    """s."""
    records: int
    """Of the grid."""
    period: float
    """Of the grid, s."""

    @property
    def length(self) -> float:
        """Length, s."""
        return self.records * self.period

    @property
    def end(self) -> float:
        """Time at which the last record of the grid ends, s."""
        return self.start + self.length
