"""Particle swarm optimisation by pymoo (Eq. 1-2 of the paper), a whole swarm per call of the objective."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pymoo.algorithms.soo.nonconvex.pso import PSO
from pymoo.core.problem import Problem as PymooProblem
from pymoo.core.termination import NoTermination
from pymoo.operators.sampling.lhs import LHS

from otolith.acquisition.window import Array
from otolith.estimation.objective import Objective
from otolith.estimation.problem import SwarmOptions

MOST_WORK = 300_000_000  # steps of the integrator in one search: seconds, where the data is absurd or the window huge
WIDE = 10.0  # ratio of the bounds from which on a parameter is searched for by its order of magnitude


@dataclass(frozen=True, slots=True)
class SwarmResult:
    """Where a swarm came to rest."""

    places: Array
    """(particles, free parameters), the best first."""
    cost: float
    """Of the best."""
    generations: int
    evaluations: int
    converged: bool


class _Bounded(PymooProblem):  # type: ignore[misc]  # pymoo has no types
    def __init__(self, objective: Objective) -> None:
        self._objective = objective
        count = objective.free
        super().__init__(n_var=count, n_obj=1, xl=objective.low[:count], xu=objective.high[:count])

    def _evaluate(self, x: Array, out: dict[str, Any], *_: Any, **__: Any) -> None:
        out["F"] = self._objective.cost_of_parameters(x)


def particle_swarm(objective: Objective, options: SwarmOptions, start: Array, seed: int) -> SwarmResult:
    """Where a swarm comes to rest within the bounds; ``start`` (free parameters,) is one of the first particles.

    The initial state is left to the polish: here every particle starts at the first record. The inertia weight adapts
    from the given one: held fixed at the paper's 0.9, the swarm does not converge.
    """
    problem = _Bounded(objective)
    others = LHS()(problem, options.size - 1, random_state=np.random.default_rng(seed)).get("X")
    first = np.clip(np.vstack([start, others]), problem.xl, problem.xu)
    algorithm = PSO(
        pop_size=options.size, sampling=first, w=options.inertia, c1=options.cognitive, c2=options.social, adaptive=True
    )
    algorithm.setup(problem, termination=NoTermination(), seed=seed)
    generations, converged = 0, False
    most = max(1, min(options.generations, MOST_WORK // (options.size * max(objective.work, 1))))
    while generations < most and not converged:
        algorithm.next()
        generations += 1
        chi_square = objective.count * algorithm.pop.get("F")[:, 0] ** 2
        converged = bool(np.ptp(chi_square) <= options.tolerance * max(float(chi_square.min()), 1.0))
    costs = algorithm.pop.get("F")[:, 0]  # pymoo's population is each particle's best so far
    order = np.argsort(costs, kind="stable")
    places: Array = algorithm.pop.get("X")[order].copy()
    return SwarmResult(places, float(costs[order[0]]), generations, algorithm.evaluator.n_eval, converged)


def scattered(low: Array, high: Array, count: int, seed: int) -> Array:
    """(count, free) starts all over the bounds, evenly in orders of magnitude where both bounds have the same sign."""
    random = np.random.default_rng(seed)
    share = (np.argsort(random.random((len(low), count)), axis=1).T + random.random((count, len(low)))) / count
    small, large = np.minimum(np.abs(low), np.abs(high)), np.maximum(np.abs(low), np.abs(high))
    by_order = (low * high > 0.0) & (large > WIDE * small)
    ratio = np.where(by_order, large / np.where(by_order, small, 1.0), 1.0)
    found: Array = np.where(by_order, np.sign(high) * small * ratio**share, low + (high - low) * share)
    return found
