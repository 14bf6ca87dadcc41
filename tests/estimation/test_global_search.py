"""The global search: the contract of pymoo's algorithms, and the global optimum from cold starts."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from benchmarks.estimators.cases import Case, cases, start, windows
from pymoo.algorithms.soo.nonconvex.pso import PSO

from otolith.acquisition.window import Array, Window
from otolith.estimation.global_search import GlobalMinimum, SearchScale, search_window
from otolith.estimation.information import Outcome
from otolith.estimation.minimisers import ALGORITHMS, PopulationMinimum, gauss_newton, latin_hypercube, minimise
from otolith.estimation.objective import Objective
from otolith.estimation.problem import AlgorithmName, Problem, SwarmOptions
from tests.variants import often

NAMES: tuple[AlgorithmName, ...] = get_args(AlgorithmName)
BEST = np.array([0.3, 0.8, 0.5])  # Of the cost below
OPTIONS = SwarmOptions()
COLD_STARTS = ("dc_motor", "two_mass", "pmsm", "servo_axis", "resonator", "eccentric")


class Valleys:
    """Rastrigin's function about :data:`BEST`, with a dozen local minima in each dimension; it records its calls."""

    def __init__(self) -> None:
        self.calls: list[Array] = []

    def __call__(self, positions: Array) -> Array:
        self.calls.append(positions)
        x = 12.0 * (positions - BEST[: positions.shape[1]])
        return np.asarray(np.sqrt((x**2 - 3.0 * np.cos(2.0 * np.pi * x) + 3.0).sum(axis=1)))


def minimum_of(
    cost: Callable[[Array], Array], name: AlgorithmName, seed: int = 1, generations: int = 1000
) -> PopulationMinimum:
    random, options = np.random.default_rng(seed), SwarmOptions(algorithm=name, generations=generations)
    return minimise(cost, latin_hypercube(options.size, 3, random), options, random)


def test_every_algorithm_of_a_machine_file_is_one() -> None:
    assert set(ALGORITHMS) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_population_stays_within_bounds_and_budget(name: AlgorithmName) -> None:
    cost = Valleys()
    found, every = minimum_of(cost, name, generations=12), np.vstack(cost.calls)
    assert found.generations == len(cost.calls) <= 12
    assert {call.shape for call in cost.calls[1:]} == {(15, 3)}  # a whole population in each call of the kernel
    assert found.evaluations == len(every)
    assert ((every >= 0.0) & (every <= 1.0)).all()
    assert cost(found.position[None]) == found.cost == cost(every).min()


@pytest.mark.parametrize("name", NAMES)
def test_a_seed_gives_the_same_positions_whatever_numpy_drew_before(name: AlgorithmName) -> None:
    runs = []
    for seed, other in ((1, 5), (1, 6), (2, 5)):
        np.random.seed(other)  # noqa: NPY002 - the global numbers are what must not matter
        before, cost = np.random.get_state(), Valleys()  # noqa: NPY002
        minimum_of(cost, name, seed, generations=8)
        assert np.array_equal(np.random.get_state()[1], before[1])  # type: ignore[index]  # noqa: NPY002
        runs.append(np.vstack(cost.calls))
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("size", "dimensions"), [(3, 3), (15, 1), (40, 2)])
def test_a_population_of_any_size_falls_into_the_valley(name: AlgorithmName, size: int, dimensions: int) -> None:
    def bowl(positions: Array) -> Array:
        return np.asarray(np.linalg.norm(positions - BEST[:dimensions], axis=1))

    random, options = np.random.default_rng(3), SwarmOptions(algorithm=name, size=size)
    found = minimise(bowl, latin_hypercube(size, dimensions, random), options, random)
    assert found.position == pytest.approx(BEST[:dimensions], abs=0.1)


def of_pymoo(first: Array, _: SwarmOptions) -> Any:
    """The swarm of pymoo itself, with its particles as objects."""
    return PSO(pop_size=len(first), sampling=first, w=0.9, c1=2.0, c2=2.0, adaptive=True)


def corner(positions: Array) -> Array:
    """Least in a corner of the cube, in steps: many places have equal costs."""
    return np.asarray(1.0 + np.floor(8.0 * positions).sum(axis=1))


@pytest.mark.parametrize("cost", [Valleys(), corner], ids=["valleys", "corner"])
@pytest.mark.parametrize(("size", "dimensions"), [(15, 1), (3, 3), (15, 3), (40, 2), (15, 9)])
def test_the_swarm_moves_as_pymoos_to_the_last_bit(
    cost: Callable[[Array], Array], size: int, dimensions: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(seed: int) -> list[Array]:
        calls, random, options = list[Array](), np.random.default_rng(seed), SwarmOptions(generations=150)

        def recorded(positions: Array) -> Array:
            calls.append(positions.copy())
            return cost(np.clip(positions[:, :3], 0.0, 1.0))

        minimise(recorded, latin_hypercube(size, dimensions, random), options, random)
        return calls

    ours = [run(seed) for seed in range(3)]
    monkeypatch.setitem(ALGORITHMS, "pso", of_pymoo)
    for own, seed in zip(ours, range(3), strict=True):
        pymoos = run(seed)
        assert len(own) == len(pymoos) > 10
        assert all(map(np.array_equal, own, pymoos))


@pytest.mark.parametrize("name", NAMES)
def test_a_cost_without_slope_ends_the_population(name: AlgorithmName) -> None:
    def flat(positions: Array) -> Array:
        return np.full(len(positions), 7.0)

    assert minimum_of(flat, name).generations < 50


def test_positions_cover_each_order_of_magnitude() -> None:
    scale = SearchScale(np.array([1e-6, -1.0, -8.0, 5.0]), np.array([1.0, 1.0, -0.5, 5.0]))
    cube = latin_hypercube(12, 4, np.random.default_rng(1))
    values = scale.values(cube)
    assert np.sort(np.floor(2.0 * np.log10(values[:, 0]))).tolist() == list(range(-12, 0))
    assert np.sort(np.floor(6.0 * (values[:, 1] + 1.0))).tolist() == list(range(12))
    assert np.sort(np.floor(3.0 * np.log2(-values[:, 2]))).tolist() == list(range(-3, 9))
    assert (values[:, 3] == 5.0).all()
    assert [scale.position(row)[:3] for row in values] == [pytest.approx(row[:3]) for row in cube]


def case_of(name: str, factor: float) -> Case:
    (case,) = (case for case in cases(factor) if case.name == name)
    return case


def motor() -> tuple[Problem, Window, Array]:
    """A motor with R_a and J unknown, a window, and the true values."""
    case = case_of("dc_motor", 3.0)
    ((truth, window),) = windows(case, 1, seed=4)
    return case.problem, window, truth


def searched(problem: Problem, window: Window, options: SwarmOptions = OPTIONS) -> GlobalMinimum:
    return search_window(replace(problem, swarm=options), window, problem.bounds[1], np.random.default_rng(1))


@pytest.mark.parametrize("name", NAMES)
def test_each_algorithm_recovers_the_parameters_from_a_corner_of_the_bounds(name: AlgorithmName) -> None:
    problem, window, truth = motor()
    found, again = (searched(problem, window, SwarmOptions(algorithm=name)) for _ in range(2))
    assert found.parameters == pytest.approx(truth, rel=0.02)
    assert found.has_repeated
    assert found.chi_square < 1.3 * 2 * window.records
    assert np.array_equal(found.parameters, again.parameters)
    assert (found.generations, found.evaluations) == (again.generations, again.evaluations)


def test_the_rounds_share_the_generations_of_the_machine_file() -> None:
    problem, window, _ = motor()
    found = searched(problem, window, SwarmOptions(generations=2))
    assert found.generations <= 2
    assert not found.has_repeated


def test_a_window_that_nothing_explains_ends_the_search_as_well() -> None:
    problem, window, _ = motor()
    values = np.random.default_rng(1).standard_normal(window.values.shape)
    found = searched(problem, replace(window, values=values))
    assert found.generations < problem.swarm.generations
    low, high = problem.bounds
    assert ((low <= found.parameters) & (found.parameters <= high)).all()


@pytest.mark.parametrize("name", often(("servo_axis",), COLD_STARTS))
def test_cold_starts_reach_the_global_optimum(name: str) -> None:
    """From random points within three times the bounds of the library, of a position alone or of an eccentric load."""
    case, random = case_of(name, 3.0), np.random.default_rng(7)
    for truth, window in windows(case, 5, seed=7):
        objective = Objective(case.problem, window, truth)
        best = gauss_newton(objective, objective.guess(truth)).chi_square
        found = search_window(case.problem, window, start(case.problem, random), np.random.default_rng(window.index))
        assert found.chi_square < best + max(3.0, 0.01 * best), (truth, found.parameters)
        assert found.has_repeated


@pytest.mark.full
def test_an_angle_is_found_beyond_the_end_of_its_bounds() -> None:
    """The phase is 3.1 rad: Gauss-Newton passes 3.1416 rad, the bound, and turns back to the same angle."""
    case = case_of("eccentric", 3.0)
    nominal = tuple(replace(free, nominal=3.1 if free.name == "phi" else free.nominal) for free in case.problem.free)
    turned = replace(case, problem=replace(case.problem, free=nominal))
    for seed in range(5):
        ((truth, window),) = windows(turned, 1, seed)
        found = search_window(turned.problem, window, turned.problem.bounds[0], np.random.default_rng(seed))
        assert np.sin(found.parameters[2] - truth[2]) == pytest.approx(0.0, abs=0.1)
        assert found.parameters[:2] == pytest.approx(truth[:2], rel=0.05)


def test_an_outcome_of_an_earlier_version_is_understood() -> None:
    former = "the particle swarm found a better minimum than the prediction led to"
    assert Outcome(former) is Outcome.SEARCH_WAS_BETTER
    assert Outcome("particle swarm and Gauss-Newton reached the same point") is Outcome.AGREED
    with pytest.raises(ValueError, match="no such"):
        Outcome("no such outcome")


FOUND = """
import sys
from tests.estimation.test_global_search import Valleys, minimum_of
if sys.argv[1] == "scipy":
    from scipy.spatial.distance import cdist
    from otolith.estimation import minimisers
    minimisers._distances = cdist
print(*(minimum_of(Valleys(), name, seed, 60).position.tobytes().hex() for name in ("pso", "de") for seed in (1, 2)))
print(*(name for name in ("scipy.spatial", "scipy.sparse", "scipy.special") if name in sys.modules))
"""


def test_a_population_loads_no_tree_of_neighbours_and_moves_as_with_one() -> None:
    """Pymoo leaves out repeated positions by SciPy's distances, whose package takes 7 MB of each worker."""
    own, of_scipy = (
        subprocess.run([sys.executable, "-c", FOUND, name], capture_output=True, text=True, check=True).stdout
        for name in ("own", "scipy")
    )
    positions, loaded = own.split("\n")[:2]
    assert (positions, loaded) == (of_scipy.split("\n")[0], "")
