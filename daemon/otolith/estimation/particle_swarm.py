"""Particle swarm optimisation (Eq. 1-2 of the paper), many swarms side by side.

A generation of all swarms costs one call of a compiled kernel. A swarm library's bookkeeping per generation costs ten
times as much, so the update rule is written out here; ``tests/estimation/test_particle_swarm.py`` compares it with
pymoo's. The inertia weight falls from the paper's value: held fixed at 0.9, a swarm does not converge.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.objective import Objective
from otolith.estimation.problem import SwarmOptions

FINAL_INERTIA = 0.3  # benchmarks.estimators: smaller loses valleys, larger does not converge
INERTIA_GENERATIONS = 60  # over which the inertia weight of a parameter search falls
MAX_INTEGRATOR_STEPS = 300_000_000  # in one search: some seconds
LOG_SCALE_RATIO = 10.0  # ratio of the bounds above which a start is drawn by order of magnitude


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Where the swarms stopped."""

    positions: Array
    """(swarms, particles, dimensions) best position of each particle, the best particle of a swarm first."""
    costs: Array
    """(swarms, particles)."""
    generations: int
    evaluations: int
    converged: bool


@dataclass(frozen=True, slots=True)
class SwarmRule:
    """How the swarms move and when they stop."""

    options: SwarmOptions
    inertia_generations: int
    """Generations over which the inertia weight falls."""
    max_generations: int
    is_converged: Callable[[Array], bool] = lambda _: False
    """Called after each generation with the best costs (swarms, particles)."""


def particle_swarm(
    cost: Callable[[Array], Array],
    positions: Array,
    bounds: tuple[Array, Array],
    rule: SwarmRule,
    random: np.random.Generator,
) -> SwarmResult:
    """Minimise ``cost`` from the first ``positions`` (swarms, particles, dimensions).

    ``cost`` returns (swarms, particles) for positions; ``bounds`` broadcast to positions. The swarms share nothing.
    """
    options = rule.options
    velocity = np.zeros_like(positions)
    best, best_cost = positions.copy(), np.full(positions.shape[:2], np.inf)
    swarms = np.arange(len(positions))
    last = max(rule.inertia_generations - 1, 1)
    generations, converged = 0, False
    while generations < rule.max_generations and not converged:
        current = cost(positions)
        better = current < best_cost
        best = np.where(better[..., None], positions, best)
        best_cost = np.where(better, current, best_cost)
        leader = best[swarms, best_cost.argmin(axis=1)][:, None]
        inertia = options.inertia + (FINAL_INERTIA - options.inertia) * min(generations, last) / last
        own, common = random.random(positions.shape), random.random(positions.shape)
        velocity = (
            inertia * velocity
            + options.cognitive * own * (best - positions)
            + options.social * common * (leader - positions)
        )
        positions = np.clip(positions + velocity, *bounds)
        generations += 1
        converged = rule.is_converged(best_cost)
    order = np.argsort(best_cost, axis=1, kind="stable")
    evaluations = generations * best_cost.size
    return SwarmResult(
        np.take_along_axis(best, order[..., None], axis=1),
        np.take_along_axis(best_cost, order, axis=1),
        generations,
        evaluations,
        converged,
    )


def search_parameters(objective: Objective, options: SwarmOptions, start: Array, seed: int) -> SwarmResult:
    """Return where one swarm stops within the bounds of the free parameters; ``start`` (free,) is a first position.

    Every particle starts its simulation at the first record; Gauss-Newton fits the initial state afterwards.
    """
    free = objective.free
    low, high = objective.low[:free], objective.high[:free]
    random = np.random.default_rng(seed)
    others = low + (high - low) * _latin_hypercube(options.size - 1, free, random)
    first = np.clip(np.vstack([start, others]), low, high)[None]

    def is_converged(best_cost: Array) -> bool:
        chi_square = objective.count * best_cost[0] ** 2
        return bool(np.ptp(chi_square) <= options.tolerance * max(float(chi_square.min()), 1.0))

    affordable = MAX_INTEGRATOR_STEPS // (options.size * max(objective.integrator_steps, 1))
    max_generations = max(1, min(options.generations, affordable))
    rule = SwarmRule(options, INERTIA_GENERATIONS, max_generations, is_converged)
    return particle_swarm(
        lambda positions: objective.cost_of_parameters(positions[0])[None], first, (low, high), rule, random
    )


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
