"""The arrival cost: what is known of the parameters before a window, and the window's objective together with it.

(C. V. Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for nonlinear discrete-time systems: stability and
moving horizon approximations, IEEE Transactions on Automatic Control 48, 2003.)

A window is nonlinear in its parameters. Correlated parameters lie on a long curved ridge, and the linear approximation
at its best point claims too much. The second-order change of the residuals, one standard deviation away in every
direction, therefore counts as noise (modified Gaussian second-order filter: A. H. Jazwinski, Stochastic Processes and
Filtering Theory, section 9.3).
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.information import without_input_noise
from otolith.estimation.minimisers import FitResult
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem

INITIAL_TREND_SD = 1e-3  # 1/s: standard deviation of an unknown trend, relative to the parameter's size
MOVED_TREND_SD = 1e-2  # 1/s: the same of a parameter that has moved: it may go on moving
MAX_TREND = 1.0  # 1/s: bound of a trend, relative to the parameter's size
MIN_STATE_SINGULAR = 1e-10  # relative singular value below which a window does not determine the initial state
MIN_SINGULAR = 1e-12  # relative singular value below which a direction is not determined, and has no curvature


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A normal distribution of the parameters at the end of a window, then of their trends per second."""

    mean: Array  # (2 free,)
    covariance: Array  # (2 free, 2 free)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The information of one window about parameters and trends, with the initial state eliminated.

    Square-root information form (G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, chapter V):
    ``residual + sqrt_information @ (z - point)`` has unit variance for the true ``z``.
    """

    point: Array  # (2 free,)
    sqrt_information: Array  # (2 free, 2 free)
    residual: Array  # (2 free,)


def initial_prior(problem: Problem) -> Prior:
    """Return the prior before the first window, from the values and bounds of the machine file."""
    low, high = problem.bounds
    deviations = np.concatenate([(high - low) / np.sqrt(12.0), INITIAL_TREND_SD * problem.scale])
    return Prior(np.concatenate([problem.nominal, np.zeros(len(low))]), np.diag(deviations**2))


def extend_prior(prior: Prior, problem: Problem, wider: Problem) -> Prior:
    """Return ``prior`` of ``problem`` for ``wider``, whose additional parameters have the initial prior."""
    extended, free = initial_prior(wider), len(wider.free)
    order = [parameter.name for parameter in wider.free]
    columns = [order.index(parameter.name) for parameter in problem.free]
    columns += [free + column for column in columns]
    extended.mean[columns] = prior.mean
    extended.covariance[np.ix_(columns, columns)] = prior.covariance
    return extended


def forget_parameter(prior: Prior, problem: Problem, index: int) -> Prior:
    """Return ``prior`` with the initial prior for one parameter, which may go on moving."""
    mean, covariance, fresh = prior.mean.copy(), prior.covariance.copy(), initial_prior(problem)
    trend = index + len(problem.free)
    fresh.covariance[trend, trend] = (MOVED_TREND_SD * problem.scale[index]) ** 2
    for at in (index, trend):
        mean[at] = fresh.mean[at]
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = fresh.covariance[at, at]
    return Prior(mean, covariance)


class MapObjective:
    """The objective of a window plus the prior. A guess holds parameters at the end, trends, and the initial state."""

    def __init__(self, objective: Objective, problem: Problem, prior: Prior) -> None:
        free = objective.free
        reach = MAX_TREND * problem.scale
        self.low = np.concatenate([objective.low[:free], -reach, objective.low[free:]])
        self.high = np.concatenate([objective.high[:free], reach, objective.high[free:]])
        self._objective = objective
        self._mean = prior.mean
        self._whitening = _whitening(prior.covariance)
        self._prior_jacobian = np.zeros((len(prior.mean), len(self.low)))
        self._prior_jacobian[:, : len(prior.mean)] = self._whitening

    def guess(self, parameters: Array, initial: Array) -> Array:
        """Return the guess of ``parameters`` (free,) and ``initial`` (states,) with the trends of the prior."""
        return np.concatenate([parameters, self._mean[len(parameters) :], initial])

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """Return the residuals of the window, then of the prior, and their derivatives."""
        residuals, jacobian = self._objective.linearise_with_trends(guess)
        count = len(self._mean)
        prior_residuals = self._whitening @ (guess[:count] - self._mean)
        return np.concatenate([residuals, prior_residuals]), np.concatenate([jacobian, self._prior_jacobian])

    def evidence(self, fit: FitResult, inflation: float, *, has_noisy_inputs: bool = True) -> Evidence:
        """Return the evidence of the window around ``fit``; ``inflation`` multiplies its standard deviations.

        If ``has_noisy_inputs``, it is without the bias that their noise causes.
        """
        count = len(self._mean)
        residuals, jacobian = fit.residuals[:-count], fit.jacobian[:-count]
        constant = np.concatenate([np.arange(count // 2), np.arange(count, len(fit.guess))])
        curvature = second_order_change(self._objective, fit.guess[constant], fit.jacobian[:, constant])
        of_states = jacobian[:, count:] * (self.high - self.low)[count:]
        columns = eliminate_states(np.column_stack([jacobian[:, :count], residuals, curvature]), of_states)
        basis, root = np.linalg.qr(columns[:, :count])
        rotated = basis.T @ columns[:, count:]
        residual, noise = rotated[:, 0], rotated[:, 1:]
        if has_noisy_inputs:
            moved = self._objective.changes_by_input_noise(fit.guess, residuals, jacobian)
            parts = (eliminate_states(np.delete(rows, np.s_[count:-1], axis=1), of_states) for rows in moved)
            root, residual = without_input_noise(root, residual, parts)
        root, residual = _with_noise(root / inflation, residual / inflation, noise)
        return Evidence(fit.guess[:count], root, residual)


def eliminate_states(rows: Array, slopes: Array) -> Array:
    """Return ``rows`` (residuals, columns) minus their projection on what the initial state can explain.

    ``slopes`` (residuals, states) are the derivatives by the initial state, relative to the width of its bounds.
    """
    states, singular, _ = np.linalg.svd(slopes, full_matrices=False)
    basis = states[:, singular > MIN_STATE_SINGULAR * max(singular.max(initial=0.0), 1.0)]
    return np.asarray(rows - basis @ (basis.T @ rows))


def second_order_change(objective: Objective, guess: Array, jacobian: Array) -> Array:
    """Return the second-order change (residuals, directions) of the residuals, one standard deviation from ``guess``.

    ``jacobian`` (rows, guess) includes the rows of the prior.
    """
    if not np.isfinite(jacobian).all():
        return np.zeros((len(objective.measured.ravel()), 0))
    size = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(jacobian / size, full_matrices=False)
    kept = singular > MIN_SINGULAR * singular[0]
    steps = directions[kept] / singular[kept, None] / size
    around = np.vstack([guess + steps, guess - steps, guess[None]])
    inside = np.clip(around, objective.low, objective.high)
    with np.errstate(over="ignore", invalid="ignore"):
        residuals = objective.residuals(objective.predict(inside)).reshape(len(around), -1)
        count = len(steps)
        change = 0.5 * (residuals[:count] + residuals[count : 2 * count]) - residuals[-1]
    return np.where(np.isfinite(change).all(axis=1)[:, None], change, 0.0).T


def _with_noise(root: Array, residual: Array, noise: Array) -> tuple[Array, Array]:
    """Whiten ``root`` (rows, columns) and ``residual`` (rows,) again, with additional ``noise`` (rows, directions).

    The inverse square root of the covariance I + N Nᵀ is formed from the singular values of N, so that rounding cannot
    make it singular.
    """
    basis, sizes, _ = np.linalg.svd(noise, full_matrices=False)
    share = 1.0 - 1.0 / np.hypot(1.0, sizes)
    return root - (basis * share) @ (basis.T @ root), residual - (basis * share) @ (basis.T @ residual)


def _whitening(covariance: Array) -> Array:
    """Return the matrix (n, n) that makes deviations of ``covariance`` (n, n) independent with unit variance."""
    size = np.sqrt(np.diag(covariance))
    factor = np.linalg.cholesky(covariance / np.outer(size, size))
    return np.asarray(np.linalg.inv(factor) / size)
