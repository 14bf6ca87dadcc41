"""The two minimisers of an objective: Gauss-Newton from a guess, and a particle swarm if nothing is known.

Gauss-Newton is bounded, has exact sensitivities, and is damped as by Levenberg and Marquardt (J. Nocedal, S. J. Wright,
Numerical Optimization, 2nd ed., section 10.3; bounds by the active set).

The particle swarm is that of the paper (Eq. 1-2). A generation costs one call of a compiled kernel. A swarm library's
bookkeeping per generation costs ten times as much, so the update rule is written out here;
``tests/estimation/test_particle_swarm.py`` compares it with pymoo's. The inertia weight falls from the paper's value:
held fixed at 0.9, a swarm does not converge.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.objective import Objective
from otolith.estimation.problem import SwarmOptions

MAX_STEPS = 40
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-7, 1e-12, 1e12
MIN_IMPROVEMENT = 1e-6  # least decrease of χ²; above χ² = 1e6, the share 1e-12 of χ²
FINAL_INERTIA = 0.3  # benchmarks.estimators: smaller loses valleys, larger does not converge
INERTIA_GENERATIONS = 60  # over which the inertia weight falls
MAX_INTEGRATOR_STEPS = 300_000_000  # in one search: some seconds
LOG_SCALE_RATIO = 10.0  # ratio of the bounds above which a start is drawn by order of magnitude


class LeastSquares(Protocol):
    """Residuals whose sum of squares is minimised within bounds."""

    low: Array  # (guess,)
    high: Array  # (guess,)

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """Return residuals (residuals,) and their derivatives (residuals, guess) at ``guess`` (guess,)."""


@dataclass(frozen=True, slots=True, eq=False)
class FitResult:
    """Where Gauss-Newton stopped."""

    guess: Array  # (guess,)
    residuals: Array  # (residuals,)
    jacobian: Array  # (residuals, guess) derivatives of the residuals
    chi_square: float
    evaluations: int
    converged: bool
    first: tuple[Array, Array, Array]  # Guess, residuals and Jacobian at the start


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
            reached = FitResult(trial, residuals, jacobian, chi_square, evaluations, converged, reached.first)
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
    jacobian, low, high = reached.jacobian, objective.low - reached.guess, objective.high - reached.guess
    first, normal = jacobian.T @ reached.residuals, jacobian.T @ jacobian
    size = np.sqrt(np.maximum(normal.diagonal(), 1e-30))
    damped = normal + np.diag(damping * size**2)
    free = ~(((low >= 0.0) & (first > 0.0)) | ((high <= 0.0) & (first < 0.0)))
    step, gradient = np.zeros(len(first)), first
    while free.any():
        root = size[free]
        scaled = damped[free][:, free] / (root[:, None] * root)
        step[free] = -np.linalg.solve(scaled, gradient[free] / root) / root
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step, free = np.where(beyond, np.minimum(np.maximum(step, low), high), step), free & ~beyond
        gradient = first + normal[:, ~free] @ step[~free]
    return step


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Where the swarm stopped."""

    positions: Array  # (particles, dimensions) best position of each particle, the best particle first
    costs: Array  # (particles,)
    generations: int
    evaluations: int
    converged: bool


def particle_swarm(  # noqa: PLR0913 - the parts of an optimisation
    cost: Callable[[Array], Array],
    positions: Array,
    bounds: tuple[Array, Array],
    options: SwarmOptions,
    random: np.random.Generator,
    *,
    is_converged: Callable[[Array], bool] = lambda _: False,
) -> SwarmResult:
    """Minimise ``cost`` from the first ``positions`` (particles, dimensions) within ``bounds``, each (dimensions,).

    ``cost`` returns (particles,) for positions. ``is_converged`` is called with the best costs (particles,) after each
    of the generations, of which ``options`` has the largest number.
    """
    velocity = np.zeros_like(positions)
    best, best_cost = positions.copy(), np.full(len(positions), np.inf)
    last = INERTIA_GENERATIONS - 1
    generations, converged = 0, False
    while generations < options.generations and not converged:
        current = cost(positions)
        better = current < best_cost
        best = np.where(better[:, None], positions, best)
        best_cost = np.where(better, current, best_cost)
        leader = best[best_cost.argmin()]
        inertia = options.inertia + (FINAL_INERTIA - options.inertia) * min(generations, last) / last
        own, common = random.random(positions.shape), random.random(positions.shape)
        velocity = (
            inertia * velocity
            + options.cognitive * own * (best - positions)
            + options.social * common * (leader - positions)
        )
        positions = np.clip(positions + velocity, *bounds)
        generations += 1
        converged = is_converged(best_cost)
    order = np.argsort(best_cost, kind="stable")
    return SwarmResult(best[order], best_cost[order], generations, generations * len(positions), converged)


def search_parameters(objective: Objective, options: SwarmOptions, start: Array, seed: int) -> SwarmResult:
    """Return where the swarm stops within the bounds of the free parameters; ``start`` (free,) is a first position.

    Every particle starts its simulation at the first record; Gauss-Newton fits the initial state afterwards.
    """
    free = objective.free
    low, high = objective.low[:free], objective.high[:free]
    random = np.random.default_rng(seed)
    others = low + (high - low) * _latin_hypercube(options.size - 1, free, random)
    first = np.clip(np.vstack([start, others]), low, high)

    def is_converged(best_cost: Array) -> bool:
        chi_square = objective.count * best_cost**2
        return bool(np.ptp(chi_square) <= options.tolerance * max(float(chi_square.min()), 1.0))

    affordable = MAX_INTEGRATOR_STEPS // (options.size * max(objective.integrator_steps, 1))
    limited = replace(options, generations=max(1, min(options.generations, affordable)))
    return particle_swarm(objective.cost_of_parameters, first, (low, high), limited, random, is_converged=is_converged)


def _latin_hypercube(count: int, dimensions: int, random: np.random.Generator) -> Array:
    """Return (count, dimensions) points in the unit cube, one in each of ``count`` slices of every dimension."""
    slices = np.argsort(random.random((dimensions, count)), axis=1).T
    return (slices + random.random((count, dimensions))) / max(count, 1)


def spread_starts(low: Array, high: Array, count: int, seed: int) -> Array:
    """Return (count, free) starts over all of the bounds, by order of magnitude where both bounds have one sign."""
    share = _latin_hypercube(count, len(low), np.random.default_rng(seed))
    small, large = np.minimum(np.abs(low), np.abs(high)), np.maximum(np.abs(low), np.abs(high))
    by_magnitude = (low * high > 0.0) & (large > LOG_SCALE_RATIO * small)
    ratio = np.where(by_magnitude, large / np.where(by_magnitude, small, 1.0), 1.0)
    starts: Array = np.where(by_magnitude, np.sign(high) * small * ratio**share, low + (high - low) * share)
    return starts
