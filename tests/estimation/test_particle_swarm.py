"""The particle swarm: its update rule, and its minima compared with those of pymoo on the same objectives."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pymoo.algorithms.soo.nonconvex.pso import PSO
from pymoo.core.problem import Problem as PymooProblem
from pymoo.optimize import minimize

from otolith.acquisition.window import Array, Window
from otolith.estimation.minimisers import particle_swarm, search_parameters, spread_starts
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem, SwarmOptions
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
NOMINAL = {parameter.name: parameter.nominal for parameter in TWIN.parameters}
OPTIONS = SwarmOptions()
SEEDS = range(10)
NOISE = np.array([0.005, 0.02])  # A, rad/s


def sphere(x: Array) -> Array:
    return np.asarray(((x - 0.3) ** 2).sum(axis=-1))


def rosenbrock(x: Array) -> Array:
    """Rosenbrock's function: a narrow, curved valley."""
    return np.asarray(100.0 * (x[..., 1] - x[..., 0] ** 2) ** 2 + (1.0 - x[..., 0]) ** 2)


def rastrigin(x: Array) -> Array:
    """Rastrigin's function: a local minimum at every integer, the global one at zero."""
    return np.asarray((x**2 - 10.0 * np.cos(2.0 * np.pi * x) + 10.0).sum(axis=-1))


def otolith_minimum(cost: Callable[[Array], Array], seed: int, generations: int) -> float:
    random = np.random.default_rng(seed)
    positions, options = random.uniform(-2.0, 2.0, (OPTIONS.size, 2)), replace(OPTIONS, generations=generations)
    return float(particle_swarm(cost, positions, (np.full(2, -2.0), np.full(2, 2.0)), options, random).costs[0])


def pymoo_minimum(cost: Callable[[Array], Array], seed: int, generations: int) -> float:
    class Bounded(PymooProblem):  # type: ignore[misc]  # pymoo has no types
        def __init__(self) -> None:
            super().__init__(n_var=2, n_obj=1, xl=-2.0, xu=2.0)

        def _evaluate(self, x: Array, out: dict[str, Array], *_: object, **__: object) -> None:
            out["F"] = cost(x)

    swarm = PSO(pop_size=OPTIONS.size, w=OPTIONS.inertia, c1=OPTIONS.cognitive, c2=OPTIONS.social, adaptive=True)
    return float(minimize(Bounded(), swarm, ("n_gen", generations), seed=seed).F[0])


@pytest.mark.full
@pytest.mark.parametrize("cost", [sphere, rosenbrock, rastrigin])
def test_particle_swarm_is_no_worse_than_pymoo(cost: Callable[[Array], Array]) -> None:
    """Medians over ten seeds, with 120 generations each."""
    medians = [np.median([swarm(cost, seed, 120) for seed in SEEDS]) for swarm in (otolith_minimum, pymoo_minimum)]
    assert medians[0] <= max(medians[1], 1e-3)


def test_particle_swarm_follows_equations_1_and_2() -> None:
    start = np.array([[0.0], [1.0], [-1.0]])
    bounds = (np.array([-10.0]), np.array([10.0]))
    result = particle_swarm(sphere, start, bounds, replace(OPTIONS, generations=2), np.random.default_rng(4))
    random = np.random.default_rng(4)
    own, common = random.random(start.shape), random.random(start.shape)
    velocity = OPTIONS.cognitive * own * 0.0 + OPTIONS.social * common * (0.0 - start)
    second = start + velocity
    best = np.minimum(sphere(start), sphere(second))
    assert result.costs == pytest.approx(np.sort(best))


@pytest.mark.parametrize(("low", "high", "best"), [(-2.0, 2.0, 0.3), (-1.0, 0.0, 0.0), (0.5, 2.0, 0.5)])
def test_particle_swarm_stays_within_its_bounds(low: float, high: float, best: float) -> None:
    random = np.random.default_rng(1)
    starts, bounds = random.uniform(low, high, (OPTIONS.size, 1)), (np.array([low]), np.array([high]))
    result = particle_swarm(sphere, starts, bounds, replace(OPTIONS, generations=60), random)
    assert result.positions[0] == pytest.approx(best, abs=1e-2)
    assert ((low <= result.positions) & (result.positions <= high)).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_cold_start_converges_near_the_true_parameters(seed: int) -> None:
    random = np.random.default_rng(seed)
    inputs = np.column_stack([np.repeat(random.uniform(5.0, 20.0, 20), 10), np.full(200, 0.03)])
    outputs = kernel_of(TWIN).simulate(
        np.array([list(NOMINAL.values())]), np.zeros((1, 2)), Excitation.uniform(inputs, 0.01, 8)
    )
    values = np.column_stack([inputs, outputs[0] + random.normal(size=(200, 2)) * NOISE])
    window = Window.whole(0, 0.0, 0.01, TWIN.signals, values)
    free = tuple(parameter for parameter in TWIN.parameters if parameter.name in ("R_a", "J"))
    known = tuple(pair for pair in NOMINAL.items() if pair[0] not in ("R_a", "J"))
    problem = Problem(TWIN, known, free, tuple(NOISE))
    objective = Objective(problem, window, np.array([parameter.high for parameter in free]))
    result = search_parameters(objective, OPTIONS, np.array([parameter.high for parameter in free]), seed)
    assert result.converged
    assert result.positions[0] == pytest.approx([NOMINAL["R_a"], NOMINAL["J"]], rel=0.1)


def test_spread_starts_cover_each_order_of_magnitude() -> None:
    starts = spread_starts(np.array([1e-6, -1.0]), np.array([1.0, 1.0]), 12, seed=1)
    assert np.sort(np.floor(2.0 * np.log10(starts[:, 0]))).tolist() == list(range(-12, 0))
    assert np.sort(np.floor(6.0 * (starts[:, 1] + 1.0))).tolist() == list(range(12))
