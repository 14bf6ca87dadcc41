"""How likely windows are under given levels of noise, whatever their parameters and initial states are.

Windows are fitted in innovation form; the likelihood of what is left is that of the innovations (F. C. Schweppe, IEEE
Transactions on Information Theory 11, 1965), and what the fit itself takes out of the residuals is made up for by the
determinant of the information: restricted likelihood (D. A. Harville, Journal of the American Statistical Association
72, 1977). Without it noise would be found too small, the more so the shorter the windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.objective import Objective
from otolith.adaptation.polish import Polished, polish
from otolith.adaptation.problem import Problem

CENTRINGS = 3  # of the predictor around a first fit: its gain was made for parameters that may have been far off


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One window, fitted at given levels of noise."""

    window: Window
    objective: Objective
    centre: Array
    """(guess,) around which the predictor was made."""
    found: Polished

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
            residuals, jacobian = objective.linearised(fit.guess)
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
        found = polish(objective, centre)
        self.evaluations += found.evaluations
        return Fit(window, objective, centre, found)

    def _unlikelihood(self, objective: Objective, found: Polished) -> float:
        _, log_determinant = np.linalg.slogdet(self._information(found))
        return found.chi_square + objective.correction.log_determinant + float(log_determinant)

    def _information(self, found: Polished) -> Array:
        """(guess, guess) in shares of ``width``, with the bounds as what is known before: no direction is without."""
        scaled = found.jacobian * self.width
        return np.asarray(np.eye(len(self.width)) + scaled.T @ scaled)
