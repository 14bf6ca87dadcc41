"""A window: uniformly sampled signals of a machine, and the quality of their sampling."""

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Verdict(StrEnum):
    """Whether parameters may be estimated from a window."""

    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a window was sampled; each number is that of the worst signal."""

    verdict: Verdict
    missing: float
    """Share of records without a sample, 0 to 1."""
    longest_gap: float
    """Longest time without a sample, s."""
    jitter: float
    """Root mean square distance of the samples from the grid, s."""
    skew: float
    """Largest difference between two signals' median distances from the grid, s."""
    reasons: tuple[str, ...] = ()
    """Why the verdict is bad, one sentence per limit; empty if it is good."""


@dataclass(frozen=True, slots=True)
class Window:
    """Uniform records of all signals of a machine. Frozen and picklable."""

    index: int
    start: float
    """Unix seconds of the first record."""
    sample_period: float
    """Time between two records, s."""
    signals: tuple[str, ...]
    values: Array
    """(records, signals), each in the unit of its signal; gaps are interpolated."""
    missing: Mask
    """(records, signals), true where a value is interpolated and no measurement."""
    quality: Quality

    @classmethod
    def whole(cls, index: int, start: float, sample_period: float, signals: tuple[str, ...], values: Array) -> Self:
        """Return a window without gaps and jitter, as simulations and files on a grid give it."""
        missing = np.zeros(values.shape, dtype=np.bool_)
        return cls(index, start, sample_period, signals, values, missing, Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0))

    @property
    def records(self) -> int:
        """Number of records."""
        return len(self.values)

    @property
    def end(self) -> float:
        """Unix seconds at which the last record ends."""
        return self.start + self.records * self.sample_period

    def since(self, record: int) -> Self:
        """Return the part of the window from ``record`` on."""
        start = self.start + record * self.sample_period
        return replace(self, start=start, values=self.values[record:], missing=self.missing[record:])

    def until(self, record: int) -> Self:
        """Return the part of the window before ``record``."""
        return replace(self, values=self.values[:record], missing=self.missing[:record])

    def column(self, signal: str) -> Array:
        """Return the values of one signal, (records,) in its unit."""
        return self.values[:, self.signals.index(signal)]

    def missing_in(self, signal: str) -> Mask:
        """Return where one signal is missing, (records,)."""
        return self.missing[:, self.signals.index(signal)]
