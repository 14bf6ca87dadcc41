"""The last digits: Gauss-Newton with the exact sensitivities, damped as by Levenberg and Marquardt, within bounds.

(J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3; bounds by the active set.)
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array

STEPS = 40
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-7, 1e-12, 1e12
DONE = 1e-6  # in χ²: the improvement that is not worth another step


class LeastSquares(Protocol):
    """Residuals whose squares are to be least, within bounds."""

    low: Array
    """(guess,)."""
    high: Array
    """(guess,)."""

    def linearised(self, guess: Array) -> tuple[Array, Array]:
        """(guess,) -> residuals (residuals,) and their derivatives (residuals, guess)."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """Where Gauss-Newton came to rest."""

    guess: Array
    """(guess,)."""
    chi_square: float
    jacobian: Array
    """(residuals, guess): of the residuals by each entry of the guess."""
    residuals: Array
    """(residuals,)."""
    evaluations: int
    converged: bool


def gauss_newton(objective: LeastSquares, start: Array, steps: int = STEPS) -> FitResult:
    """The minimum of χ² that ``start`` (guess,) leads to; ``start`` itself where no step improves it."""
    low, high = objective.low, objective.high
    guess = np.minimum(np.maximum(start, low), high)
    residuals, jacobian = objective.linearised(guess)
    chi_square, damping, evaluations, converged = float(residuals @ residuals), FIRST_DAMPING, 1, False
    for _ in range(steps):
        step = _step(residuals, jacobian, guess, objective, damping)
        trial = np.minimum(np.maximum(guess + step, low), high)
        foretold = residuals + jacobian @ (trial - guess)
        if chi_square - float(foretold @ foretold) <= DONE * max(1.0, 1e-6 * chi_square):
            cut_off = (step != 0.0) & ((trial <= low) | (trial >= high))
            converged = not cut_off.any()
            if converged or damping > MOST_DAMPING:
                break
            damping = max(100.0 * damping, FIRST_DAMPING)  # a long step that a bound cuts off may lead uphill
            continue
        new_residuals, new_jacobian = objective.linearised(trial)
        evaluations += 1
        new = float(new_residuals @ new_residuals)
        if new < chi_square:
            converged = chi_square - new <= DONE * max(1.0, 1e-6 * chi_square)
            guess, residuals, jacobian, chi_square = trial, new_residuals, new_jacobian, new
            damping = max(damping / 10.0, LEAST_DAMPING)
            if converged:
                break
        else:
            converged = float(np.abs(new - chi_square)) <= DONE
            damping = max(100.0 * damping, FIRST_DAMPING)
            if converged or damping > MOST_DAMPING:
                break
    return FitResult(guess, chi_square, jacobian, residuals, evaluations, converged)


def _step(residuals: Array, jacobian: Array, guess: Array, objective: LeastSquares, damping: float) -> Array:
    """The damped step; what leans on a bound is held there, and what would go beyond one goes as far as to it."""
    gradient = jacobian.T @ residuals
    free = ~(((guess <= objective.low) & (gradient > 0.0)) | ((guess >= objective.high) & (gradient < 0.0)))
    step = np.zeros(len(guess))
    while free.any():
        normal = jacobian[:, free].T @ jacobian[:, free]
        weight = np.maximum(np.diag(normal), 1e-30)
        root = np.sqrt(weight)
        scaled = normal / np.outer(root, root) + damping * np.eye(len(weight))
        step[free] = -np.linalg.solve(scaled, gradient[free] / root) / root
        beyond = free & ((guess + step < objective.low) | (guess + step > objective.high))
        if not beyond.any():
            break
        step[beyond] = np.clip(guess + step, objective.low, objective.high)[beyond] - guess[beyond]
        free &= ~beyond
        gradient = jacobian.T @ (residuals + jacobian[:, ~free] @ step[~free])
    return step
