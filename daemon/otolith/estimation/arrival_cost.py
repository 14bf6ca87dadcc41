"""What is believed of the parameters before a window: the arrival cost of moving-horizon estimation.

(C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for nonlinear discrete-time systems: stability and
moving horizon approximations, IEEE Transactions on Automatic Control 48, 2003.)

How far the linear picture of a window holds: what bends within the interval is not known to the last digit.

Parameters that are traded lie on a long ridge, and a ridge bends. Around its best point the window seems to know some
combination of them far better than it does, because the combination changes along the ridge. The second-order change of
the residuals, one standard deviation away in every direction, is therefore counted as noise (the modified Gaussian
second-order filter: A. H. Jazwinski, Stochastic Processes and Filtering Theory, section 9.3).
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.gauss_newton import FitResult
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem

SLIGHT = 1e-12  # relative eigenvalue of a direction that is not uncertain at all


def bends(objective: Objective, guess: Array, jacobian: Array) -> Array:
    """(residuals, directions) second-order change of the residuals, one standard deviation from ``guess`` (guess,).

    ``jacobian`` (rows, guess) is of everything that holds the guess in place, the prior included.
    """
    if not np.isfinite(jacobian).all():
        return np.zeros((len(objective.measured.ravel()), 0))
    size = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(jacobian / size, full_matrices=False)
    seen = singular > SLIGHT * singular[0]
    steps = directions[seen] / singular[seen, None] / size
    around = np.vstack([guess + steps, guess - steps, guess[None]])
    inside = np.clip(around, objective.low, objective.high)
    with np.errstate(over="ignore", invalid="ignore"):
        found = objective.residuals(objective.predict(inside)).reshape(len(around), -1)
        count = len(steps)
        change = 0.5 * (found[:count] + found[count : 2 * count]) - found[-1]
    return np.where(np.isfinite(change).all(axis=1)[:, None], change, 0.0).T


def discounted(root: Array, rest: Array, bent: Array) -> tuple[Array, Array]:
    """``root`` (rows, columns) and ``rest`` (rows,) with ``bent`` (rows, directions) as noise beside the unit one."""
    # The inverse root of the whole covariance: whatever the size of what bends, rounding does not make it singular.
    along, sizes, _ = np.linalg.svd(bent, full_matrices=False)
    share = 1.0 - 1.0 / np.hypot(1.0, sizes)
    return root - (along * share) @ (along.T @ root), rest - (along * share) @ (along.T @ rest)


FASTEST = 1e-3  # 1/s: standard deviation of a trend that nothing is known of, in shares of the parameter's size
TREND_REACH = 1.0  # 1/s: no parameter changes by more than its own size in a second
UNSEEN = 1e-10  # relative singular value under which the initial state is not seen


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A normal distribution of the parameters at the end of a window, then of their trends per second."""

    mean: Array
    """(2 free,)."""
    covariance: Array
    """(2 free, 2 free)."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a window says of parameters and trends: residuals of unit variance, linear around ``point``.

    They are ``rest + root @ (z - point)``: the square-root information form (G. J. Bierman, Factorization Methods for
    Discrete Sequential Estimation, chapter V), the initial state eliminated.
    """

    point: Array
    """(2 free,)."""
    root: Array
    """(2 free, 2 free)."""
    rest: Array
    """(2 free,)."""


def initial_prior(problem: Problem) -> Prior:
    """All that is known before the first window: the machine file's values and bounds."""
    low, high = problem.bounds
    deviations = np.concatenate([(high - low) / np.sqrt(12.0), FASTEST * problem.scale])
    return Prior(np.concatenate([problem.nominal, np.zeros(len(low))]), np.diag(deviations**2))


def whitening(covariance: Array) -> Array:
    """(n, n) what makes deviations of this ``covariance`` (n, n) independent and of unit variance."""
    size = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(size, size))
    return np.asarray(np.linalg.inv(factor) / size)


def eliminate_states(rows: Array, slopes: Array) -> Array:
    """``rows`` (residuals, columns) less all that the initial state could make of them.

    ``slopes`` (residuals, states) are of the residuals by the initial state, in shares of what it may be.
    """
    states, singular, _ = np.linalg.svd(slopes, full_matrices=False)
    seen = states[:, singular > UNSEEN * max(singular.max(initial=0.0), 1.0)]
    return np.asarray(rows - seen @ (seen.T @ rows))


class MapObjective:
    """The objective of a window together with the prior; a guess is parameters at the end, trends, initial state."""

    def __init__(self, objective: Objective, problem: Problem, prior: Prior) -> None:
        free = objective.free
        reach = TREND_REACH * problem.scale
        self.low = np.concatenate([objective.low[:free], -reach, objective.low[free:]])
        self.high = np.concatenate([objective.high[:free], reach, objective.high[free:]])
        self._objective = objective
        self._mean = prior.mean
        self._root = whitening(prior.covariance)

    def guess(self, parameters: Array, initial: Array) -> Array:
        """(guess,) from (free,) and (states,), with the trends of the prior."""
        return np.concatenate([parameters, self._mean[len(parameters) :], initial])

    def linearised(self, guess: Array) -> tuple[Array, Array]:
        """(guess,) -> residuals of the window, then of the prior, and their derivatives."""
        residuals, jacobian = self._objective.drifting(guess)
        count = len(self._mean)
        believed = np.zeros((count, len(guess)))
        believed[:, :count] = self._root
        off = self._root @ (guess[:count] - self._mean)
        return np.concatenate([residuals, off]), np.vstack([jacobian, believed])

    def chi_square(self, fit: FitResult) -> float:
        """Of the window alone."""
        own = fit.residuals[: -len(self._mean)]
        return float(own @ own)

    @property
    def count(self) -> float:
        """Measured records of all outputs."""
        return self._objective.count

    def whitened(self, fit: FitResult) -> Array:
        """(records, outputs) what is left of the window, in units of the noise."""
        return fit.residuals[: -len(self._mean)].reshape(self._objective.measured.shape)

    def last_state(self, fit: FitResult) -> Array:
        """(states,) at the last record."""
        return self._objective.followed(fit.guess)[1]

    def evidence(self, fit: FitResult, grown: float) -> Evidence:
        """What the window says around ``fit``, with standard deviations ``grown`` by what is left unexplained."""
        count = len(self._mean)
        residuals, jacobian = fit.residuals[:-count], fit.jacobian[:-count]
        both = np.column_stack([jacobian[:, :count], residuals, self._bends(fit)])
        both = eliminate_states(both, jacobian[:, count:] * (self.high - self.low)[count:])
        directions, triangle = np.linalg.qr(both[:, :count])
        rest = directions.T @ both[:, count:]
        root, rest = discounted(triangle / grown, rest[:, 0] / grown, rest[:, 1:])
        return Evidence(fit.guess[:count], root, rest)

    def _bends(self, fit: FitResult) -> Array:
        """(residuals, directions) how the window bends away from the linear picture around ``fit``."""
        count = len(self._mean)
        free = count // 2
        still = np.concatenate([np.arange(free), np.arange(count, len(fit.guess))])
        return bends(self._objective, fit.guess[still], fit.jacobian[:, still])
