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
from otolith.commissioning.consistency import CHANGE_SIGNIFICANCE, MIN_INFORMATION, MIN_REGIME
from otolith.commissioning.identification import with_initial_noise
from otolith.commissioning.likelihood import FittedWindow, Likelihood
from otolith.estimation.evidence import Elimination
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


@dataclass(frozen=True, slots=True, eq=False)
class _Explained:
    """The least squares of a model."""

    chi_square: float
    degrees: int  # Of freedom that are left
    values: Array  # (terms, values) in units of width
    covariance: Array  # (terms * values, terms * values)


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
    rows = [_whitened(fit, likelihood.width, own) for fit in fits]
    model, fitted = _best_model(rows, [window.start for window in windows])
    if model is None:
        return ()
    return tuple(_changes(model, fitted, likelihood.width[own], names, windows))


def _whitened(fit: FittedWindow, width: Array, own: Sequence[int]) -> tuple[Array, Array]:
    """Return the square root of the information of a window about the values, and that times their estimates."""
    others = [place for place in range(len(width)) if place not in own]
    left = Elimination.of(fit.result.jacobian[:, others], width[others]).left(fit.result.jacobian[:, own] * width[own])
    _, singular, directions = np.linalg.svd(left, full_matrices=False)
    singular = singular / np.sqrt(fit.discount)
    determined = singular > MIN_INFORMATION
    root = singular[determined, None] * directions[determined]
    return root, root @ (fit.guess[own] / width[own])


def _best_model(rows: Sequence[tuple[Array, Array]], starts: Sequence[float]) -> "tuple[_Model | None, _Explained]":
    """Return the model of change that leaves least, if it is true; a drift unless a step explains decisively more."""
    from scipy.special import fdtrc  # noqa: PLC0415 - only commissioning needs SciPy

    same = _explained(rows, np.ones((len(rows), 1)))
    drifts = [_Model(shape) for shape in _drifts(np.array(starts))]
    steps = [_Model(_step(len(rows), at), at) for at in range(MIN_REGIME, len(rows) - MIN_REGIME + 1)]
    trials = [(model, _explained(rows, model.shape)) for model in (*drifts, *steps)]
    trials = [(model, found) for model, found in trials if found.degrees > 0 and same.degrees > found.degrees]

    def left(trial: tuple[_Model, _Explained]) -> float:
        return trial[1].chi_square / trial[1].degrees

    best = min(trials, key=left, default=None)
    if best is None:
        return None, same
    model, found = best
    more, reduced = same.degrees - found.degrees, max(left(best), 1.0)
    chance = float(fdtrc(more, found.degrees, (same.chi_square - found.chi_square) / more / reduced))
    return (model, found) if chance * len(trials) < CHANGE_SIGNIFICANCE else (None, same)


def _drifts(starts: Array) -> Iterator[Array]:
    """Yield the terms of a value that moves in the whole record: at its begin 0, at its end 1."""
    share = (starts - starts[0]) / max(float(starts[-1] - starts[0]), np.finfo(float).tiny)
    yield np.column_stack([np.ones(len(starts)), share])
    for constant in TIME_CONSTANTS:
        curve = -np.expm1(-share / constant) / -np.expm1(-1.0 / constant)
        yield np.column_stack([np.ones(len(starts)), curve])


def _step(count: int, at: int) -> Array:
    """Return the terms of a value that is another from window ``at`` on, in which the change may fall."""
    places = np.arange(count)
    return np.column_stack([np.ones(count), places >= at, places == at]).astype(np.float64)


def _explained(rows: Sequence[tuple[Array, Array]], shape: Array) -> _Explained:
    stacked = np.vstack([np.kron(terms, root) for (root, _), terms in zip(rows, shape, strict=True)])
    estimates = np.concatenate([estimate for _, estimate in rows])
    found, _, rank, _ = np.linalg.lstsq(stacked, estimates, rcond=None)
    errors = stacked @ found - estimates
    covariance = np.linalg.pinv(stacked.T @ stacked, hermitian=True)
    return _Explained(float(errors @ errors), len(estimates) - int(rank), found.reshape(shape.shape[1], -1), covariance)


def _changes(
    model: _Model, fitted: _Explained, width: Array, names: Sequence[str], windows: Sequence[Window]
) -> Iterator[ValueChange]:
    """Yield the parameters whose change is beyond its interval and LEAST_CHANGE."""
    count, at = len(names), model.place
    variance = max(fitted.chi_square / fitted.degrees, 1.0) * fitted.covariance
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
