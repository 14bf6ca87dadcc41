"""Bounded Gauss-Newton with exact sensitivities, damped as by Levenberg and Marquardt.

(J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3; bounds by the active set.)
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array

MAX_STEPS = 40
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-7, 1e-12, 1e12
MIN_IMPROVEMENT = 1e-6  # least decrease of χ²; above χ² = 1e6, the share 1e-12 of χ²


class LeastSquares(Protocol):
    """Residuals whose sum of squares is minimised within bounds."""

    low: Array
    """(guess,)."""
    high: Array
    """(guess,)."""

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """Return residuals (residuals,) and their derivatives (residuals, guess) at ``guess`` (guess,)."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """Where Gauss-Newton stopped."""

    guess: Array
    """(guess,)."""
    chi_square: float
    jacobian: Array
    """(residuals, guess) derivatives of the residuals."""
    residuals: Array
    """(residuals,)."""
    evaluations: int
    converged: bool
    first: tuple[Array, Array, Array]
    """Guess, residuals and Jacobian at the start."""


def gauss_newton(objective: LeastSquares, start: Array, max_steps: int = MAX_STEPS) -> FitResult:
    """Return the minimum of χ² reached from ``start`` (guess,), or ``start`` itself where no step improves it."""
    low, high = objective.low, objective.high
    guess = np.minimum(np.maximum(start, low), high)
    residuals, jacobian = objective.linearise(guess)
    first = (guess, residuals, jacobian)
    chi_square, damping, evaluations, converged = float(residuals @ residuals), FIRST_DAMPING, 1, False
    for _ in range(max_steps):
        step = _bounded_step(residuals, jacobian, guess, objective, damping)
        trial = np.minimum(np.maximum(guess + step, low), high)
        linear = residuals + jacobian @ (trial - guess)
        if _is_negligible(chi_square, float(linear @ linear)):
            truncated = (step != 0.0) & ((trial <= low) | (trial >= high))
            converged = not truncated.any()
            if converged or damping > MAX_DAMPING:
                break
            damping = _increased(damping)  # a long step that a bound truncates may lead uphill
            continue
        new_residuals, new_jacobian = objective.linearise(trial)
        evaluations += 1
        new = float(new_residuals @ new_residuals)
        if new < chi_square:
            converged = _is_negligible(chi_square, new)
            guess, residuals, jacobian, chi_square = trial, new_residuals, new_jacobian, new
            damping = max(damping / 10.0, MIN_DAMPING)
            if converged:
                break
        else:
            converged = float(np.abs(new - chi_square)) <= MIN_IMPROVEMENT
            damping = _increased(damping)
            if converged or damping > MAX_DAMPING:
                break
    return FitResult(guess, chi_square, jacobian, residuals, evaluations, converged, first)


def _is_negligible(before: float, after: float) -> bool:
    return before - after <= MIN_IMPROVEMENT * max(1.0, 1e-6 * before)


def _increased(damping: float) -> float:
    return max(100.0 * damping, FIRST_DAMPING)


def _bounded_step(residuals: Array, jacobian: Array, guess: Array, objective: LeastSquares, damping: float) -> Array:
    """Return the damped step within the bounds.

    Entries at a bound that the gradient pushes outward stay there. Entries that the step would carry beyond a bound go
    to the bound, and the others are solved for again.
    """
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
