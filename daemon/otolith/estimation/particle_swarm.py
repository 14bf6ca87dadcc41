"""Particle swarm optimisation (Eq. 1-2 of the paper).

A generation costs one call of a compiled kernel. A swarm library's bookkeeping per generation costs ten
times as much, so the update rule is written out here; ``tests/estimation/test_particle_swarm.py`` compares it with
pymoo's. The inertia weight falls from the paper's value: held fixed at 0.9, a swarm does not converge.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.objective import Objective
from otolith.estimation.problem import SwarmOptions

FINAL_INERTIA = 0.3  # benchmarks.estimators: smaller loses valleys, larger does not converge
INERTIA_GENERATIONS = 60  # over which the inertia weight falls
MAX_INTEGRATOR_STEPS = 300_000_000  # in one search: some seconds
LOG_SCALE_RATIO = 10.0  # ratio of the bounds above which a start is drawn by order of magnitude


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Where the swarm stopped."""

    positions: Array
    """(particles, dimensions) best position of each particle, the best particle first."""
    costs: Array
    """(particles,)."""
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
