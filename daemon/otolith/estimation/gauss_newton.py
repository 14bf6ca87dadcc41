"""Bounded Gauss-Newton with exact sensitivities, damped as by Levenberg and Marquardt.

(J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., section 10.3; bounds by the active set.)
"""

from dataclasses import dataclass, replace
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
    residuals: Array
    """(residuals,)."""
    jacobian: Array
    """(residuals, guess) derivatives of the residuals."""
    chi_square: float
    evaluations: int
    converged: bool
    first: tuple[Array, Array, Array]
    """Guess, residuals and Jacobian at the start."""


def gauss_newton(objective: LeastSquares, start: Array, max_steps: int = MAX_STEPS) -> FitResult:
    """Return the minimum of χ² reached from ``start`` (guess,), or ``start`` itself where no step improves it."""
    guess = np.minimum(np.maximum(start, objective.low), objective.high)
    residuals, jacobian = objective.linearise(guess)
    first = (guess, residuals, jacobian)
    return continued(objective, FitResult(*first, float(residuals @ residuals), 1, False, first), max_steps)


def continued(objective: LeastSquares, reached: FitResult, max_steps: int) -> FitResult:
    """Return the result after up to ``max_steps`` more steps, with the damping of a new start."""
    damping, evaluations, converged = FIRST_DAMPING, reached.evaluations, False
    for _ in range(max_steps):
        step = _bounded_step(objective, reached, damping)
        trial = np.minimum(np.maximum(reached.guess + step, objective.low), objective.high)
        linear = reached.residuals + reached.jacobian @ (trial - reached.guess)
        if _is_negligible(reached.chi_square, float(linear @ linear)):
            truncated = (step != 0.0) & ((trial <= objective.low) | (trial >= objective.high))
            converged = not truncated.any()
            if converged or damping > MAX_DAMPING:
                break
            damping = _increased(damping)  # a long step that a bound truncates may lead uphill
            continue
        residuals, jacobian = objective.linearise(trial)
        evaluations += 1
        chi_square = float(residuals @ residuals)
        if chi_square < reached.chi_square:
            converged = _is_negligible(reached.chi_square, chi_square)
            reached = replace(reached, guess=trial, residuals=residuals, jacobian=jacobian, chi_square=chi_square)
            damping = max(damping / 10.0, MIN_DAMPING)
        else:
            converged = chi_square - reached.chi_square <= MIN_IMPROVEMENT
            damping = _increased(damping)
        if converged or damping > MAX_DAMPING:
            break
    return replace(reached, evaluations=evaluations, converged=converged)


def _is_negligible(before: float, after: float) -> bool:
    return before - after <= MIN_IMPROVEMENT * max(1.0, 1e-6 * before)


def _increased(damping: float) -> float:
    return max(100.0 * damping, FIRST_DAMPING)


def _bounded_step(objective: LeastSquares, reached: FitResult, damping: float) -> Array:
    """Return the damped step within the bounds.

    Entries at a bound that the gradient pushes outward stay there. Entries that the step would carry beyond a bound go
    to the bound, and the others are solved for again.
    """
    guess, residuals, jacobian = reached.guess, reached.residuals, reached.jacobian
    gradient = jacobian.T @ residuals
    free = ~(((guess <= objective.low) & (gradient > 0.0)) | ((guess >= objective.high) & (gradient < 0.0)))
    step = np.zeros(len(guess))
    while free.any():
        normal = jacobian[:, free].T @ jacobian[:, free]
        root = np.sqrt(np.maximum(normal.diagonal(), 1e-30))
        scaled = normal / (root[:, None] * root)
        scaled.flat[:: len(root) + 1] += damping
        step[free] = -np.linalg.solve(scaled, gradient[free] / root) / root
        beyond = free & ((guess + step < objective.low) | (guess + step > objective.high))
        if not beyond.any():
            break
        step[beyond] = np.clip(guess + step, objective.low, objective.high)[beyond] - guess[beyond]
        free &= ~beyond
        gradient = jacobian.T @ (residuals + jacobian[:, ~free] @ step[~free])
    return step
