"""Whether a record is of one state of the machine: each window gives values of its own, which must be the same.

The estimates of the windows are compared with three models, each by χ² of what it leaves: one value in all windows, a
drift (a straight line or a saturating exponential, as of warming), and a step between two windows. The window in which
a step falls has a value of its own. A model of change is true if noise explains what it explains with less than
CHANGE_SIGNIFICANCE, by an F test times the number of models that are tried: the scatter that a model leaves counts, so
that windows which an imperfect twin explains differently are no change.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.consistency import (
    CHANGE_SIGNIFICANCE,
    MIN_REGIME,
    CommonValues,
    Estimates,
    chance_of_change,
    step_at,
    whitened,
)
from otolith.commissioning.identification import with_initial_noise
from otolith.commissioning.likelihood import Likelihood
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
LEAST_CHANGE = 0.05  # of a value: a smaller change does not matter to its limits
TIME_CONSTANTS = (1.0, 0.5, 0.25, 0.125)  # of a drift that saturates, in lengths of the record


@dataclass(frozen=True, slots=True)
class ValueChange:
    """A value that differs between both ends of a record."""

    name: str
    before: float  # In the unit of the twin; at the begin of a drift
    before_sd: float
    after: float  # At the end of a drift
    after_sd: float
    since: float | None  # s, begin of the first window with the new value; None of a drift
    until: float | None  # s, end of the last window with the old value; None of a drift

    @property
    def is_drift(self) -> bool:
        """Whether the value moves in the whole record."""
        return self.since is None


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """How the values depend on the window, and what it leaves."""

    shape: Array  # (windows, terms): the values are a linear combination of the terms
    place: int | None = None  # Of the first window after a step


def value_changes(problem: Problem, windows: Sequence[Window], names: Sequence[str]) -> tuple[ValueChange, ...]:
    """Return which parameters ``names`` of ``problem`` change in the record, by more than LEAST_CHANGE.

    Other free parameters are those of each window alone.
    """
    if len(windows) < 2 * MIN_REGIME + 1 or not names:
        return ()
    there = with_initial_noise(problem, windows)
    likelihood, levels = Likelihood(there), np.array([*there.noise, *there.process_noise])
    fits = [likelihood.fit(levels, window, [there.nominal]) for window in windows]
    places = [row.name for row in problem.free]
    own = [places.index(name) for name in names]
    rows = [whitened(fit, likelihood.width, own) for fit in fits]
    model, fitted = _best_model(rows, [window.start for window in windows])
    if model is None:
        return ()
    return tuple(_changes(model, fitted, likelihood.width[own], names, windows))


def _best_model(rows: Estimates, starts: Sequence[float]) -> tuple[_Model | None, CommonValues]:
    """Return the model of change that leaves least, if it is true; a drift unless a step explains decisively more."""
    same = CommonValues.of(rows)
    drifts = [_Model(shape) for shape in _drifts(np.array(starts))]
    steps = [_Model(_step(len(rows), at), at) for at in range(MIN_REGIME, len(rows) - MIN_REGIME + 1)]
    trials = [(model, CommonValues.of(rows, model.shape)) for model in (*drifts, *steps)]
    trials = [(model, found) for model, found in trials if 0 < found.degrees < same.degrees]
    best = min(trials, key=lambda trial: trial[1].chi_square / trial[1].degrees, default=None)
    is_true = best is not None and chance_of_change(same, best[1])[0] * len(trials) < CHANGE_SIGNIFICANCE
    return best if best is not None and is_true else (None, same)


def _drifts(starts: Array) -> Iterator[Array]:
    """Yield the terms of a value that moves in the whole record: at its begin 0, at its end 1."""
    share = (starts - starts[0]) / max(float(starts[-1] - starts[0]), np.finfo(float).tiny)
    yield np.column_stack([np.ones(len(starts)), share])
    for constant in TIME_CONSTANTS:
        curve = -np.expm1(-share / constant) / -np.expm1(-1.0 / constant)
        yield np.column_stack([np.ones(len(starts)), curve])


def _step(count: int, at: int) -> Array:
    """Return the terms of a value that is another from window ``at`` on, in which the change may fall."""
    return np.column_stack([step_at(at, count), np.arange(count) == at])


def _changes(
    model: _Model, fitted: CommonValues, width: Array, names: Sequence[str], windows: Sequence[Window]
) -> Iterator[ValueChange]:
    """Yield the parameters whose change is beyond its interval and LEAST_CHANGE."""
    count, at = len(names), model.place
    covariance = np.linalg.pinv(fitted.stacked.T @ fitted.stacked, hermitian=True)
    variance = max(fitted.chi_square / fitted.degrees, 1.0) * covariance
    for place, name in enumerate(names):
        ends = [place, count + place]
        before, change = (float(value) for value in fitted.values[:2, place] * width[place])
        own = variance[np.ix_(ends, ends)]
        before_sd, change_sd, after_sd = (np.sqrt([own[0, 0], own[1, 1], own.sum()]) * width[place]).tolist()
        least = LEAST_CHANGE * min(abs(before), abs(before + change))
        if abs(change) <= max(QUANTILE * change_sd, least):
            continue
        if at is None:
            yield ValueChange(name, before, before_sd, before + change, after_sd, None, None)
        else:
            yield ValueChange(
                name, before, before_sd, before + change, after_sd, windows[at + 1].start, windows[at - 1].end
            )
