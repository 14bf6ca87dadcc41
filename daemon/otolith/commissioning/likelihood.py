"""How likely windows are under given levels of noise, whatever their parameters and initial states are.

Windows are fitted in innovation form; the likelihood of what is left is that of the innovations (F. C. Schweppe, IEEE
Transactions on Information Theory 11, 1965), and what the fit itself takes out of the residuals is made up for by the
determinant of the information: restricted likelihood (D. A. Harville, Journal of the American Statistical Association
72, 1977). Without it noise would be found too small, the more so the shorter the windows.

The levels of noise under which windows are likeliest, found along Fisher's information.

In variances, so that a level may become zero, and one that was begun far off comes back at once (scoring: N. K. Gupta,
R. K. Mehra, IEEE Transactions on Automatic Control 19, 1974; steps that stay above zero: C. L. Lawson, R. J. Hanson,
Solving Least Squares Problems, chapter 23).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.gauss_newton import FitResult, gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem

CENTRINGS = 3  # of the predictor around a first fit: its gain was made for parameters that may have been far off


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One window, fitted at given levels of noise."""

    window: Window
    objective: Objective
    centre: Array
    """(guess,) around which the predictor was made."""
    found: FitResult

    @property
    def guess(self) -> Array:
        """(guess,) free parameters, then the initial state."""
        return self.found.guess

    @property
    def cost(self) -> float:
        """RMSE in units of the noise."""
        return float(np.sqrt(self.found.chi_square / self.objective.count))


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """What given levels make of windows that were fitted at others nearby."""

    unlikelihood: float
    spread: Array
    """Whitened innovations that no parameter explains, then logarithms of what whitens them: half of the curvature of
    the unlikelihood is the squared length of how it moves with a level, as Fisher's information is."""


def noisy(problem: Problem, levels: Array) -> Problem:
    """The problem with noise ``levels`` (outputs + states,)."""
    count = len(problem.twin.outputs)
    return replace(problem, noise=tuple(levels[:count]), process_noise=tuple(levels[count:]), open_loop=False)


class Likelihood:
    """Of windows, by the levels of noise (outputs + states,), each a standard deviation as in a problem."""

    def __init__(self, problem: Problem) -> None:
        low, high = problem.bounds
        states = [entry.high - entry.low for entry in problem.twin.states]
        self.width: Array = np.concatenate([high - low, states]) / np.sqrt(12.0)
        """(guess,) what is known of each entry before any window: the standard deviation between its bounds."""
        self.evaluations = 0
        self._problem = problem
        self._free = len(low)

    def fit(self, levels: Array, window: Window, starts: Sequence[Array]) -> Fit:
        """The best of several first fits; a start is (free,), or a guess with an initial state."""
        found = [self._first(levels, window, start) for start in starts]
        return min(found, key=lambda fit: self._unlikelihood(fit.objective, fit.found))

    def refitted(self, levels: Array, fits: Sequence[Fit]) -> list[Fit]:
        """The same windows at other levels, each from its last fit."""
        return [self._fit(self._objective(levels, fit.window, fit.guess), fit.window, fit.guess) for fit in fits]

    def unlikelihood(self, fits: Sequence[Fit]) -> float:
        """Minus twice the logarithm of the likelihood, up to a constant."""
        return sum(self._unlikelihood(fit.objective, fit.found) for fit in fits)

    def sight(self, levels: Array, fits: Sequence[Fit]) -> Sight:
        """Nothing is fitted: at its minimum χ² does not change with the guess."""
        total, innovations, scales = 0.0, [], []
        for fit in fits:
            objective = self._objective(levels, fit.window, fit.centre)
            residuals, jacobian = objective.linearise(fit.guess)
            found = replace(fit.found, residuals=residuals, jacobian=jacobian, chi_square=float(residuals @ residuals))
            total += self._unlikelihood(objective, found)
            scaled = fit.found.jacobian * self.width
            innovations.append(residuals - scaled @ np.linalg.solve(self._information(fit.found), scaled.T @ residuals))
            scales.append(np.log(np.diagonal(objective.whitening, axis1=1, axis2=2)).ravel())
        return Sight(total, np.concatenate([*innovations, *scales]))

    def _objective(self, levels: Array, window: Window, centre: Array) -> Objective:
        return Objective(noisy(self._problem, levels), window, centre[: self._free], centre[self._free :])

    def _first(self, levels: Array, window: Window, start: Array) -> Fit:
        objective = Objective(noisy(self._problem, levels), window, start[: self._free])
        guess = start if len(start) > self._free else objective.guess(start)
        for _ in range(CENTRINGS - 1):
            guess = self._fit(objective, window, guess).guess
            objective.centre(guess[: self._free], guess[self._free :])
        return self._fit(objective, window, guess)

    def _fit(self, objective: Objective, window: Window, centre: Array) -> Fit:
        found = gauss_newton(objective, centre)
        self.evaluations += found.evaluations
        return Fit(window, objective, centre, found)

    def _unlikelihood(self, objective: Objective, found: FitResult) -> float:
        _, log_determinant = np.linalg.slogdet(self._information(found))
        return found.chi_square + objective.correction.log_determinant + float(log_determinant)

    def _information(self, found: FitResult) -> Array:
        """(guess, guess) in shares of ``width``, with the bounds as what is known before: no direction is without."""
        scaled = found.jacobian * self.width
        return np.asarray(np.eye(len(self.width)) + scaled.T @ scaled)


HIDDEN = 0.02  # of the noise that a signal shows: a sensor that is better than that is not looked into further
NUDGE = 0.02  # of a variance, for differences
LEAST_NUDGE = 1e-3  # of the variance where the search begins
ROUNDS, TRIALS = 25, 6
NEAR, SHORTEST = 0.75, 0.1  # of a trial's length: how near is near enough, and the shortest after it
DONE = 0.05  # of the unlikelihood: an improvement that is not worth another step
ZERO = 2.706  # of the unlikelihood: the 95 % point for a variance at its bound, half of χ² of one degree
Told = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Ladder:
    """Levels (outputs + states,) by the shares of variances that are sought."""

    base: Array
    """(outputs + states,) where the search begins: shares of one."""
    least: Array
    """(outputs + states,) what a share of zero leaves."""
    sought: Mask
    """(outputs + states,); what is not sought stays at ``least``."""

    def levels(self, shares: Array) -> Array:
        """(sought,) -> (outputs + states,)."""
        found = self.least**2
        found[self.sought] += shares * self.base[self.sought] ** 2
        return np.asarray(np.sqrt(found))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Windows, fitted at some levels."""

    shares: Array
    """(sought,)."""
    levels: Array
    """(outputs + states,)."""
    fits: list[Fit]
    unlikelihood: float


@dataclass(frozen=True, slots=True, eq=False)
class Likeliest:
    """The end of a search."""

    levels: Array
    """(outputs + states,)."""
    deviations: Array
    """(outputs + states,) standard deviation of each level, of one at zero upwards; zero for what was not sought."""
    fits: list[Fit]
    unlikelihood: float


def fewest(likelihood: Likelihood, ladder: Ladder, fits: Sequence[Fit], told: Told) -> Likeliest:
    """The likeliest levels, with process noise only of states without whose noise the windows are less likely."""
    found = likeliest(likelihood, ladder, fits, told)
    while (idle := _idle(likelihood, ladder, found)).any():
        again = found.levels[idle].any()
        ladder = replace(
            ladder, base=np.where(found.levels > 0.0, found.levels, ladder.base), sought=ladder.sought & ~idle
        )
        if again:
            left = likeliest(likelihood, ladder, found.fits, told)
            hidden = np.where(idle, np.hypot(found.levels, found.deviations), found.deviations)
            found = replace(left, deviations=np.where(ladder.sought, left.deviations, hidden))
    return found


def _idle(likelihood: Likelihood, ladder: Ladder, found: Likeliest) -> Mask:
    """(outputs + states,) the states at zero, or else the one whose noise is hardly missed."""
    outputs = len(found.fits[0].objective.noise.outputs)
    candidates: Mask = ladder.sought & (np.arange(len(found.levels)) >= outputs)
    idle: Mask = candidates & (found.levels == 0.0)
    if idle.any() or not candidates.any():
        return idle
    missed = np.full(len(idle), np.inf)
    for index in np.flatnonzero(candidates):
        levels = found.levels.copy()
        levels[index] = 0.0
        missed[index] = likelihood.unlikelihood(likelihood.refitted(levels, found.fits)) - found.unlikelihood
    return np.asarray(candidates & (missed == missed.min()) & (missed < ZERO))


def likeliest(likelihood: Likelihood, ladder: Ladder, fits: Sequence[Fit], told: Told) -> Likeliest:
    """Of all levels that ``ladder`` seeks; ``fits`` were made at its base."""
    point = _at(likelihood, ladder, np.ones(int(ladder.sought.sum())), fits)
    for _ in range(ROUNDS):
        slope, curvature = _turn(likelihood, ladder, point)
        step = _aim(slope, curvature, point.shares) - point.shares
        promised = -float(slope @ step + 0.5 * step @ curvature @ step)
        told(f"log-likelihood {-0.5 * point.unlikelihood:.2f}")
        if promised < DONE:
            break
        better = _along(likelihood, ladder, point, step, float(slope @ step))
        if better is point:
            break
        point = better
    else:
        slope, curvature = _turn(likelihood, ladder, point)
    return Likeliest(point.levels, _deviations(ladder, point, curvature), point.fits, point.unlikelihood)


def _along(likelihood: Likelihood, ladder: Ladder, point: Point, step: Array, descent: float) -> Point:
    """The best of a few points along ``step``: where innovations are not normal, Fisher's step is often too long."""
    best, length = point, 1.0
    for _ in range(TRIALS):
        found = _at(likelihood, ladder, point.shares + length * step, point.fits)
        best = min(best, found, key=lambda entry: entry.unlikelihood)
        bend = found.unlikelihood - point.unlikelihood - length * descent
        lowest = -descent * length**2 / (2.0 * bend) if bend > 0.0 else np.inf
        if lowest > NEAR * length:
            break
        length = max(lowest, SHORTEST * length)
    return best


def _at(likelihood: Likelihood, ladder: Ladder, shares: Array, fits: Sequence[Fit]) -> Point:
    levels = ladder.levels(shares)
    refitted = likelihood.refitted(levels, fits)
    return Point(shares, levels, refitted, likelihood.unlikelihood(refitted))


def _turn(likelihood: Likelihood, ladder: Ladder, point: Point) -> tuple[Array, Array]:
    """Slope (sought,) of the unlikelihood by the shares, and curvature (sought, sought): twice Fisher's information."""
    nudges = NUDGE * np.maximum(point.shares, LEAST_NUDGE)
    still = likelihood.sight(point.levels, point.fits)
    nudged = [likelihood.sight(ladder.levels(row), point.fits) for row in point.shares + np.diag(nudges)]
    moved = np.array([(entry.spread - still.spread) / by for entry, by in zip(nudged, nudges, strict=True)])
    curvature = 2.0 * moved @ moved.T
    slope = (np.array([entry.unlikelihood for entry in nudged]) - still.unlikelihood) / nudges
    return slope - 0.5 * nudges * np.diag(curvature), curvature


def _aim(slope: Array, curvature: Array, shares: Array) -> Array:
    """(sought,) where the parabola is lowest among shares that are not negative."""
    from scipy.optimize import nnls  # noqa: PLC0415 - SciPy is loaded by those who learn noise only

    size = np.sqrt(np.maximum(np.diag(curvature), np.finfo(float).tiny))
    bends, directions = np.linalg.eigh(curvature / np.outer(size, size))
    seen = bends > 1e-9 * bends.max(initial=0.0)
    rows = np.sqrt(bends[seen])[:, None] * directions[:, seen].T
    lowest = rows @ (size * shares) - (directions[:, seen].T @ (slope / size)) / np.sqrt(bends[seen])
    return np.asarray(nnls(rows, lowest)[0] / size)


def _deviations(ladder: Ladder, point: Point, curvature: Array) -> Array:
    """From the variances' to the levels', of which one may be zero."""
    found = np.zeros(len(point.levels))
    variances = np.maximum(np.diag(np.linalg.pinv(0.5 * curvature, hermitian=True)), 0.0)
    by = np.sqrt(variances) * ladder.base[ladder.sought] ** 2
    levels = point.levels[ladder.sought]
    found[ladder.sought] = np.sqrt(levels**2 + by) - levels
    return found
