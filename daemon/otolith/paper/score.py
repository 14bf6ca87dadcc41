"""How far what was published lies from what was true, in numbers."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.health.report import Status
from otolith.paper.rows import PEAK, Row
from otolith.paper.tracking import Curves, Track


@dataclass(frozen=True, slots=True)
class Spread:
    """Of relative errors, over every window from the first excited one on; None where no window said anything."""

    median: float | None
    p99: float | None
    maximum: float | None
    missing: int
    """Windows without a value."""

    def meets(self, target: float) -> bool:
        """Whether the 99th percentile is within it, and the largest error within five times as much."""
        return self.p99 is not None and self.maximum is not None and self.p99 <= target >= self.maximum / PEAK


@dataclass(frozen=True, slots=True)
class Score:
    """What a track comes to."""

    length: float
    """Of a window, s."""
    windows: int
    begun: int
    """The first excited window."""
    first: int | None
    """The first window that estimated the parameter."""
    published: Spread
    raw: Spread
    """Of each window alone, as the paper reports it."""
    worst: int | None
    """The window with the largest published error."""
    coverage: float | None
    """Share of the published 95 % intervals that hold the truth."""
    statuses: dict[str, int]
    """Windows of each status, from the first excited one on."""
    alone: int
    """Windows that determine the parameter alone."""
    rmse: dict[str, float]
    """Of the predicted outputs, from the first excited window on, each in its unit."""


def score(found: Track, curves: Curves) -> Score:
    """Judge a track and the curves that belong to it."""
    begun = found.begun
    value, truth = found.value[begun:], found.truth[begun:]
    off, said = errors(value, truth), np.isfinite(value)
    inside = (found.low[begun:] <= truth) & (truth <= found.high[begun:])
    statuses = Counter(found.statuses[begun:])
    return Score(
        length=found.length,
        windows=len(found.value),
        begun=begun,
        first=found.first,
        published=_spread(off),
        raw=_spread(errors(found.raw[begun:], truth)),
        worst=begun + int(np.nanargmax(off)) if said.any() else None,
        coverage=float(inside[said].mean()) if said.any() else None,
        statuses={status.value: statuses[status] for status in Status},
        alone=int(found.determined[begun:].sum()),
        rmse=_rmse(curves, len(curves.times) // max(len(found.value), 1) * begun),
    )


def errors(values: Array, truth: Array) -> Array:
    """Relative; not a number where there is no value."""
    return np.asarray(np.abs(values / truth - 1.0))


def verdict(row: Row, found: Score) -> bool:
    """Whether the row's targets are met."""
    return found.published.meets(row.target)


def _spread(off: Array) -> Spread:
    said = off[np.isfinite(off)]
    if not said.size:
        return Spread(None, None, None, len(off))
    middle, p99 = np.percentile(said, (50.0, 99.0)).tolist()
    return Spread(middle, p99, float(said.max()), len(off) - len(said))


def _rmse(curves: Curves, first: int) -> dict[str, float]:
    off = (curves.predicted - curves.measured)[first:]
    found = {}
    for index, name in enumerate(curves.outputs):
        said = off[np.isfinite(off[:, index]), index]
        if said.size:
            found[name] = float(np.sqrt(np.mean(said**2)))
    return found
