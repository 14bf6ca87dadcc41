"""Restricted likelihood of noise levels, and the levels that maximise it.

The likelihood is that of the innovations (F. C. Schweppe, IEEE Transactions on Information Theory 11, 1965). The
determinant of the information corrects for what the fit takes out of them: restricted likelihood (D. A. Harville,
Journal of the American Statistical Association 72, 1977). Without it, short windows underestimate noise.

The deviance, minus twice the log-likelihood, is minimised by Fisher scoring (N. K. Gupta, R. K. Mehra, IEEE
Transactions on Automatic Control 19, 1974) over variances, so that a level may become zero. Each step is a non-negative
least-squares problem (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, chapter 23).
docs/explanation/noise-identification.md derives the equations, and compares SciPy's minimisers.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.evidence import LogEvidence, discount, is_explained, log_determinant
from otolith.estimation.minimisers import FitResult, gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
MAX_FIRST_COST = 1e6  # of a window's first fit, in units of the noise: beyond it, the twin cannot follow
FIRST_FITS = 3  # of a window; the predictor is remade between them, as its gain depends on the parameters
DIFFERENCE_STEP = 0.02  # of a variance, for finite differences
MIN_DIFFERENCE_SHARE = 1e-3  # of the initial variance: below it, the difference step no longer shrinks
MAX_ITERATIONS = 25  # scoring steps
MAX_TRIALS = 6  # points along one scoring step
LENGTH_TOLERANCE = 0.75  # the line search ends if its minimum is beyond this share of the last trial's length
MIN_LENGTH_RATIO = 0.1  # of two successive trials
MIN_IMPROVEMENT = 0.05  # predicted decrease of the deviance below which the search ends
# of deviance: 95 % point of ½χ²(0) + ½χ²(1), as a variance may not be negative
SIGNIFICANT_LOSS = NormalDist().inv_cdf(0.95) ** 2
MIN_EIGENVALUE = 1e-9  # of the largest one of the scaled Hessian: smaller directions do not move

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class FittedWindow:
    """One window, its parameters and initial state fitted at given noise levels."""

    window: Window
    objective: Objective
    centre: Array  # (guess,) around which the predictor was made
    result: FitResult

    @property
    def guess(self) -> Array:
        """(guess,) free parameters, then the initial state."""
        return self.result.guess

    @property
    def cost(self) -> float:
        """Root mean square of the whitened innovations: 1 if the noise levels are right."""
        return float(np.sqrt(self.result.chi_square / self.objective.count))

    @property
    def discount(self) -> float:
        """Factor on the variance of the noise for a residual larger than that; at least one."""
        return discount(self.result.chi_square, self.objective.count)

    @property
    def is_explained(self) -> bool:
        """Whether the fit leaves nothing but noise."""
        return is_explained(self.result.chi_square, self.objective.count)


Fits = Sequence[FittedWindow]


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """Near a fit's levels: half the Hessian of the deviance is approximately JᵀJ, J the Jacobian of ``whitened``."""

    deviance: float
    whitened: Array  # Projected whitened innovations of all windows, then the logarithms of their whitening factors


class Likelihood:
    """Restricted likelihood of windows by noise levels (outputs + states,), standard deviations as in a problem."""

    def __init__(self, problem: Problem) -> None:
        low, high = problem.bounds
        states = [state.high - state.low for state in problem.twin.states]
        self.width: Array = np.concatenate([high - low, states]) / np.sqrt(12.0)
        """(guess,) standard deviation of a uniform distribution between the bounds."""
        self.evaluations = 0
        self.problem = problem
        self._free = len(low)

    def fit(self, levels: Array, window: Window, starts: Sequence[Array], rounds: int = FIRST_FITS) -> FittedWindow:
        """The likeliest of the first fits from ``starts``, each (free,), with the predictor made ``rounds`` times."""
        fits = [self._first_fit(levels, window, start, rounds) for start in starts]
        return min(fits, key=lambda fit: self.deviance([fit]))

    def refit(self, levels: Array, fits: Fits) -> list[FittedWindow]:
        """The same windows at other levels; each fit starts where the last one ended."""
        return [self._fit(self._objective(levels, fit, fit.guess), fit.window, fit.guess) for fit in fits]

    def deviance(self, fits: Fits) -> float:
        """Minus twice the restricted log-likelihood, up to a constant."""
        return sum(self._deviance(fit.objective, fit.result.chi_square, fit.result.jacobian) for fit in fits)

    def linearise(self, levels: Array | None, fits: Fits) -> Linearisation:
        """At ``levels`` close to those of ``fits``, without a new fit: χ² is stationary at the fitted guess.

        None stands for the levels of ``fits``.
        """
        deviance, innovations, factors = 0.0, [], []
        for fit in fits:
            objective, residuals, jacobian = fit.objective, fit.result.residuals, fit.result.jacobian
            if levels is not None:
                objective = self._objective(levels, fit, fit.centre)
                residuals, jacobian = objective.linearise(fit.guess)
            deviance += self._deviance(objective, float(residuals @ residuals), jacobian)
            innovations.append(self.project(residuals, fit.result.jacobian))
            factors.append(np.log(np.diagonal(objective.whitening, axis1=1, axis2=2)).ravel())
        return Linearisation(deviance, np.concatenate([*innovations, *factors]))

    def _objective(self, levels: Array, fit: FittedWindow, centre: Array) -> Objective:
        """Return the objective of the window of ``fit``; other levels rarely need other sub-steps."""
        problem, substeps = with_levels(self.problem, levels), fit.objective.excitation.substeps
        return Objective(problem, fit.window, centre[: self._free], centre[self._free :], substeps)

    def _first_fit(self, levels: Array, window: Window, start: Array, rounds: int) -> FittedWindow:
        objective = Objective(with_levels(self.problem, levels), window, start)
        guess = objective.guess(start)
        for _ in range(rounds - 1):
            guess = self._fit(objective, window, guess).guess
            objective.set_predictor(guess[: self._free], guess[self._free :], objective.excitation.substeps)
        return self._fit(objective, window, guess)

    def _fit(self, objective: Objective, window: Window, centre: Array) -> FittedWindow:
        result = gauss_newton(objective, centre)
        self.evaluations += result.evaluations
        return FittedWindow(window, objective, centre, result)

    def _deviance(self, objective: Objective, chi_square: float, jacobian: Array) -> float:
        """-2 log evidence of a window: see :mod:`otolith.estimation.evidence`."""
        complexity = float(log_determinant(self._information(jacobian)))
        return LogEvidence(chi_square + objective.spread, complexity).deviance

    def project(self, residuals: Array, jacobian: Array) -> Array:
        """(residuals,) or (residuals, columns) the part that no change of the guess explains, after a new fit."""
        scaled = jacobian * self.width
        return np.asarray(residuals - scaled @ np.linalg.solve(self._information(jacobian), scaled.T @ residuals))

    def _information(self, jacobian: Array) -> Array:
        """(guess, guess) in units of ``width``; the bounds are the prior, so that it is never singular."""
        scaled = jacobian * self.width
        return np.asarray(np.eye(len(self.width)) + scaled.T @ scaled)


def with_levels(problem: Problem, levels: Array) -> Problem:
    """The problem with noise ``levels`` (outputs + states,), in innovation form."""
    count = len(problem.base_model.outputs)
    return replace(problem, noise=tuple(levels[:count]), process_noise=tuple(levels[count:]), open_loop=False)


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodPoint:
    """Noise levels, and all windows fitted at them."""

    shares: Array  # (free,) as in VarianceParametrisation
    levels: Array  # (outputs + states,)
    fits: list[FittedWindow]
    deviance: float
    sd: Array
    """(outputs + states,) standard deviation of each level, upwards if it is zero; zero until the search has ended."""


@dataclass(frozen=True, slots=True, eq=False)
class VarianceParametrisation:
    """The deviance by the free variances, each in shares of its initial value: level² = floor² + share·initial²."""

    likelihood: Likelihood
    initial: Array  # (outputs + states,) levels where the search begins, with shares of one
    floor: Array  # (outputs + states,) levels at a share of zero
    free: Mask  # (outputs + states,); a level that is not free stays at its floor

    def levels(self, shares: Array) -> Array:
        """(free,) -> (outputs + states,)."""
        variances = self.floor**2
        variances[self.free] += shares * self.initial[self.free] ** 2
        return np.asarray(np.sqrt(variances))

    def evaluate(self, shares: Array, fits: Fits) -> LikelihoodPoint:
        """The windows of ``fits``, fitted again at ``shares`` (free,)."""
        levels = self.levels(shares)
        refitted = self.likelihood.refit(levels, fits)
        return LikelihoodPoint(shares, levels, refitted, self.likelihood.deviance(refitted), np.zeros(len(levels)))

    def derivatives(self, point: LikelihoodPoint) -> tuple[Array, Array]:
        """Gradient (free,) of the deviance by the shares, to second order, and its expected Hessian (free, free)."""
        steps = DIFFERENCE_STEP * np.maximum(point.shares, MIN_DIFFERENCE_SHARE)
        here = self.likelihood.linearise(None, point.fits)
        ahead = [self.likelihood.linearise(self.levels(row), point.fits) for row in point.shares + np.diag(steps)]
        jacobian = np.array([(there.whitened - here.whitened) / step for there, step in zip(ahead, steps, strict=True)])
        hessian = 2.0 * jacobian @ jacobian.T
        differences = (np.array([there.deviance for there in ahead]) - here.deviance) / steps
        return differences - 0.5 * steps * np.diag(hessian), hessian

    def level_sd(self, levels: Array, hessian: Array) -> Array:
        """(outputs + states,) standard deviations of ``levels``; Fisher's information is half of ``hessian``."""
        variances = np.maximum(np.diag(np.linalg.pinv(0.5 * hessian, hermitian=True)), 0.0)
        sd_of_squares = np.sqrt(variances) * self.initial[self.free] ** 2
        sd = np.zeros(len(levels))
        sd[self.free] = np.sqrt(levels[self.free] ** 2 + sd_of_squares) - levels[self.free]
        return sd


def backward_elimination(variances: VarianceParametrisation, fits: Fits, progress: Progress) -> LikelihoodPoint:
    """The likeliest levels, with process noise only where its removal makes the windows significantly less likely."""
    best = maximise(variances, fits, progress)
    while (removed := _removable(variances, best)).any():
        initial = np.where(best.levels > 0.0, best.levels, variances.initial)
        variances = replace(variances, initial=initial, free=variances.free & ~removed)
        if best.levels[removed].any():
            reduced = maximise(variances, best.fits, progress)
            undetected = np.where(removed, np.hypot(best.levels, best.sd), best.sd)
            best = replace(reduced, sd=np.where(variances.free, reduced.sd, undetected))
    return best


def _removable(variances: VarianceParametrisation, best: LikelihoodPoint) -> Mask:
    """(outputs + states,) all free states at zero, or else the one whose process noise is the least significant."""
    outputs = len(best.fits[0].objective.noise.outputs)
    candidates: Mask = variances.free & (np.arange(len(best.levels)) >= outputs)
    at_zero: Mask = candidates & (best.levels == 0.0)
    if at_zero.any() or not candidates.any():
        return at_zero
    likelihood, loss = variances.likelihood, np.full(len(candidates), np.inf)
    for index in np.flatnonzero(candidates):
        levels = best.levels.copy()
        levels[index] = 0.0
        loss[index] = likelihood.deviance(likelihood.refit(levels, best.fits)) - best.deviance
    return np.asarray(candidates & (loss == loss.min()) & (loss < SIGNIFICANT_LOSS))


def maximise(variances: VarianceParametrisation, fits: Fits, progress: Progress) -> LikelihoodPoint:
    """The likeliest of all free levels by Fisher scoring; ``fits`` were made at the initial levels."""
    point = variances.evaluate(np.ones(int(variances.free.sum())), fits)
    gradient, hessian = variances.derivatives(point)
    for _ in range(MAX_ITERATIONS):
        step = _minimum_of_model(gradient, hessian, point.shares) - point.shares
        slope = float(gradient @ step)
        progress(f"log-likelihood {-0.5 * point.deviance:.2f}")
        if -(slope + 0.5 * float(step @ hessian @ step)) < MIN_IMPROVEMENT:
            break
        better = _line_search(variances, point, step, slope)
        if better is point:
            break
        point = better
        gradient, hessian = variances.derivatives(point)
    return replace(point, sd=variances.level_sd(point.levels, hessian))


def _minimum_of_model(gradient: Array, hessian: Array, shares: Array) -> Array:
    """(free,) non-negative shares that minimise the quadratic model of the deviance around ``shares``."""
    from scipy.optimize import nnls  # noqa: PLC0415 - only noise identification needs SciPy

    # With hessian = RᵀR, the model is ½‖R·x - b‖² up to a constant, where b = R·shares - R⁻ᵀ·gradient.
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    eigenvalues, directions = np.linalg.eigh(hessian / np.outer(scale, scale))
    kept = eigenvalues > MIN_EIGENVALUE * eigenvalues.max(initial=0.0)
    roots, directions = np.sqrt(eigenvalues[kept]), directions[:, kept]
    rows = roots[:, None] * directions.T
    return np.asarray(nnls(rows, rows @ (scale * shares) - (directions.T @ (gradient / scale)) / roots)[0] / scale)


def _line_search(
    variances: VarianceParametrisation, point: LikelihoodPoint, step: Array, slope: float
) -> LikelihoodPoint:
    """The best of a few points along ``step``, where the deviance has ``slope``; ``point`` if none is better.

    A parabola through a point that is much too far shows the minimum much too near, as the deviance falls slowly and
    rises steeply where a variance approaches zero. Then longer steps are tried again.
    """
    best, length, longest = point, 1.0, 1.0
    for _ in range(MAX_TRIALS):
        trial = variances.evaluate(point.shares + length * step, point.fits)
        best = min(best, trial, key=lambda candidate: candidate.deviance)
        bend = trial.deviance - point.deviance - length * slope
        minimum = -slope * length**2 / (2.0 * bend) if bend > 0.0 else np.inf
        if minimum > LENGTH_TOLERANCE * length:
            shorter, length = length, min(minimum, float(np.sqrt(length * longest)))
            if shorter >= LENGTH_TOLERANCE * length:
                break
        else:
            longest, length = length, max(minimum, MIN_LENGTH_RATIO * length)
    return best
