"""What adaptation works on: a window of uniformly sampled signals, and the verdict on how well they were sampled."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Verdict(StrEnum):
    """Whether a window may be estimated from."""

    GOOD = "good"
    BAD = "bad"


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a window was sampled; the worst signal counts."""

    verdict: Verdict
    missing: float
    """Share of records without a sample, 0 to 1."""
    longest_gap: float
    """s without a sample."""
    jitter: float
    """Root mean square distance of the samples from the grid, s."""
    skew: float
    """Largest difference between two signals' median distances from the grid, s."""
    reasons: tuple[str, ...] = ()
    """Why the verdict is not good, in words."""


@dataclass(frozen=True, slots=True)
class Window:
    """Uniform records of all signals of a machine. Plain and frozen: it pickles, and a replay gives the same."""

    index: int
    start: float
    """Unix seconds of the first record."""
    sample_period: float
    """s."""
    signals: tuple[str, ...]
    values: Array
    """(records, signals), each in the unit of its signal; gaps are bridged."""
    missing: Mask
    """(records, signals), true where a value was bridged and is no measurement."""
    quality: Quality

    @classmethod
    def whole(cls, index: int, start: float, sample_period: float, signals: tuple[str, ...], values: Array) -> "Window":
        """Without gaps and sampled to perfection, as simulations and files on a grid are."""
        missing = np.zeros(values.shape, dtype=np.bool_)
        return cls(index, start, sample_period, signals, values, missing, Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0))

    @property
    def records(self) -> int:
        """How many."""
        return len(self.values)

    @property
    def end(self) -> float:
        """Unix seconds at which the last record ends."""
        return self.start + self.records * self.sample_period

    def since(self, record: int) -> "Window":
        """What is left of the window from a record on."""
        start = self.start + record * self.sample_period
        return replace(self, start=start, values=self.values[record:], missing=self.missing[record:])

    def until(self, record: int) -> "Window":
        """The window up to a record."""
        return replace(self, values=self.values[:record], missing=self.missing[:record])

    def column(self, signal: str) -> Array:
        """(records,) of one signal."""
        return self.values[:, self.signals.index(signal)]

    def missing_in(self, signal: str) -> Mask:
        """(records,) of one signal."""
        return self.missing[:, self.signals.index(signal)]
