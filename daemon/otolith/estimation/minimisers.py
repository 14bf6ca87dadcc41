"""The two minimisers of an objective: Gauss-Newton from a guess, and a population of pymoo's if nothing is known.

Gauss-Newton is bounded, has exact sensitivities, and is damped as by Levenberg and Marquardt (J. Nocedal, S. J. Wright,
Numerical Optimization, 2nd ed., section 10.3; bounds by the active set).

The populations are pymoo's: particle swarm, differential evolution, CMA-ES, genetic algorithm (J. Blank, K. Deb, pymoo:
multi-objective optimization in Python, IEEE Access 8, 2020). A generation is one call of a compiled kernel.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.problem import AlgorithmName, SwarmOptions

MAX_STEPS = 40
FIRST_DAMPING, MIN_DAMPING = 1e-7, 1e-12
MIN_IMPROVEMENT = 1e-6  # least decrease of χ²; above χ² = 1e6, the share 1e-12 of χ²
STALLED = 20  # generations without improvement after which a population ends
IMPROVED = 0.9  # ratio of two squared costs, as of χ², that counts as an improvement
FIRST_SIGMA = 0.3  # of the unit cube: standard deviation of the first population of CMA-ES, as its authors advise
REDRAWN = 20  # times that pymoo draws the velocity of a particle anew which would leave the cube
MIN_DIMENSIONS = 2  # CMA-ES needs two; a further one has no effect on the cost


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
            if converged or damping > 1.0 / MIN_DAMPING:
                break
            damping = _increased(damping)  # a long step that a bound truncates may lead uphill
            continue
        residuals, jacobian = objective.linearise(trial)
        evaluations += 1
        with np.errstate(over="ignore", invalid="ignore"):  # where the twin diverges, which is no better
            chi_square = float(residuals @ residuals)
        if chi_square < reached.chi_square:
            converged = _is_negligible(reached.chi_square, chi_square)
            reached = FitResult(trial, residuals, jacobian, chi_square, evaluations, converged, reached.first)
            damping = max(damping / 10.0, MIN_DAMPING)
        else:
            converged = chi_square - reached.chi_square <= MIN_IMPROVEMENT
            damping = _increased(damping)
        if converged or damping > 1.0 / MIN_DAMPING:
            break
    guess, residuals, jacobian, chi_square = reached.guess, reached.residuals, reached.jacobian, reached.chi_square
    return FitResult(guess, residuals, jacobian, chi_square, evaluations, converged, reached.first)


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
    damped = normal.copy()
    damped.flat[:: len(first) + 1] += damping * size**2
    free = ~(((low >= 0.0) & (first > 0.0)) | ((high <= 0.0) & (first < 0.0)))
    step, gradient = np.zeros(len(first)), first
    while count := np.count_nonzero(free):
        root, system, right = size, damped, gradient
        if count < len(free):
            root, system, right = size[free], damped[free][:, free], gradient[free]
        step[free] = -np.linalg.solve(system / (root[:, None] * root), right / root) / root
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step, free = np.where(beyond, np.minimum(np.maximum(step, low), high), step), free & ~beyond
        gradient = first + normal[:, ~free] @ step[~free]
    return step


@dataclass(frozen=True, slots=True, eq=False)
class PopulationMinimum:
    """Where a population stopped."""

    position: Array  # (dimensions,) the best of all generations
    cost: float
    generations: int
    evaluations: int


Cost = Callable[[Array], Array]
"""Costs (members,) of positions (members, dimensions), each finite: with pymoo, NaN would be the best."""


class _Record:
    """A cost that records the best position, and counts the positions."""

    def __init__(self, cost: Cost) -> None:
        self._cost = cost
        self.best, self.position, self.evaluations = np.inf, np.zeros(0), 0

    def __call__(self, positions: Array) -> Array:
        costs = self._cost(positions)
        self.evaluations += len(positions)
        index = int(costs.argmin())
        if costs[index] < self.best:
            self.best, self.position = float(costs[index]), positions[index].copy()
        return costs


def minimise(cost: Cost, first: Array, options: SwarmOptions, random: np.random.Generator) -> PopulationMinimum:
    """Minimise ``cost`` within the unit cube from the ``first`` positions (members, dimensions).

    It ends when the best cost has stalled, or with the generations of ``options``. Each generation is one call of
    ``cost``. All random numbers follow from ``random``.
    """
    recorded = _Record(cost)
    algorithm = _set_up(recorded, first, options, random)
    generations, since, reference = 0, 0, np.inf
    while generations < options.generations and since < STALLED and algorithm.has_next():
        algorithm.next()
        generations, since = generations + 1, since + 1
        if recorded.best**2 < IMPROVED * reference:
            reference, since = recorded.best**2, 0
    return PopulationMinimum(recorded.position, recorded.best, generations, recorded.evaluations)


def _distances(first: Array, second: Array) -> Array:
    """Return the distance of each of the ``first`` positions from each of the ``second`` ones."""
    return np.asarray(np.linalg.norm(first[:, None] - second[None], axis=-1))


def _set_up(cost: Cost, first: Array, options: SwarmOptions, random: np.random.Generator) -> Any:
    """Return the algorithm of ``options``, which begins with the ``first`` positions.

    pymoo is imported here and nowhere else, as a window with a prediction needs no search. The import takes 0.15 s and
    5 MB; that of CMA-ES, which loads Matplotlib, 3 s and 94 MB.
    """
    from pymoo.config import Config  # noqa: PLC0415
    from pymoo.core import duplicate  # noqa: PLC0415
    from pymoo.core.problem import Problem as PymooProblem  # noqa: PLC0415
    from pymoo.core.termination import NoTermination  # noqa: PLC0415

    duplicate.cdist = _distances  # SciPy's needs packages that nothing else of a worker uses
    Config.warnings["not_compiled"] = False  # it would be printed, and nothing here is slower without
    used = first.shape[1]
    if used < MIN_DIMENSIONS:
        first = np.hstack([first, random.random((len(first), MIN_DIMENSIONS - used))])

    class UnitCube(PymooProblem):  # type: ignore[misc]  # pymoo has no types
        def __init__(self) -> None:
            super().__init__(n_var=first.shape[1], n_obj=1, xl=0.0, xu=1.0)

        def cost(self, x: Array) -> Array:
            return cost(x[:, :used])

        def _evaluate(self, x: Array, out: dict[str, Array], *_: object, **__: object) -> None:
            out["F"] = self.cost(x)

    algorithm = ALGORITHMS[options.algorithm](first, options)
    algorithm.setup(UnitCube(), termination=NoTermination(), seed=int(random.integers(2**31)))
    if options.algorithm == "cmaes":  # its seed would be that of all random numbers of NumPy
        algorithm.options |= {"seed": np.nan, "randn": lambda *shape: random.standard_normal(shape)}
    return algorithm


@dataclass(slots=True, eq=False)
class _Places:
    """Positions (members, dimensions) and their costs (members, 1), which pymoo asks a population for by these keys."""

    positions: Array
    costs: Array

    def __len__(self) -> int:
        return len(self.positions)

    def get(self, *keys: str) -> Any:
        arrays = [{"X": self.positions, "F": self.costs}[key] for key in keys]
        return arrays if len(arrays) > 1 else arrays[0]


class _Swarm:
    """pymoo's particle swarm, moved by pymoo's functions: the same positions, to the last bit.

    pymoo keeps each particle as an object with dictionaries, which costs several times what the kernel does. Here the
    particles are rows of arrays.
    """

    def __init__(self, pymoo: Any, first: Array) -> None:
        self._pymoo, self._positions = pymoo, first.copy()
        self._velocities = np.zeros(first.shape)
        self._own = _Places(first, np.zeros((0, 1)))  # The best place of each particle

    def setup(self, problem: Any, **keys: object) -> None:
        self._pymoo.setup(problem, **keys)

    def has_next(self) -> bool:
        return True

    def next(self) -> None:
        pymoo = self._pymoo
        if not len(self._own.costs):
            self._own = _Places(self._positions.copy(), self._cost())
            self._velocities = pymoo.random_state.random(self._positions.shape) * pymoo.V_max[None, :]
            return
        best = int(self._own.costs.argmin())
        pymoo.sbest = _Places(np.repeat(self._own.positions[best : best + 1], len(self._own), axis=0), np.zeros((0, 1)))
        self._move(best)
        self._keep(self._cost())
        pymoo.pop = self._own
        pymoo._adapt()

    def _cost(self) -> Array:
        return np.asarray(self._pymoo.problem.cost(self._positions))[:, None]

    def _move(self, best: int) -> None:
        """Move all particles, by other random numbers where one would leave the cube; change the best place a little.

        As in ``PSO._infill`` of pymoo.
        """
        from pymoo.algorithms.soo.nonconvex.pso import pso_equation, repair_random_init  # noqa: PLC0415
        from pymoo.core.individual import Individual  # noqa: PLC0415
        from pymoo.core.population import Population  # noqa: PLC0415
        from pymoo.operators.mutation.pm import PM  # noqa: PLC0415

        pymoo, random = self._pymoo, self._pymoo.random_state
        before, velocities, own, social = self._positions, self._velocities, self._own.positions, pymoo.sbest.positions
        settings = (pymoo.V_max, pymoo.w, pymoo.c1, pymoo.c2)
        moved, changed = pso_equation(before, own, social, velocities, *settings, random_state=random)
        for _ in range(REDRAWN):
            out = np.flatnonzero(((moved < 0.0) | (moved > 1.0)).any(axis=1))
            if not len(out):
                break
            states = (before[out], own[out], social[out], velocities[out])
            moved[out], changed[out] = pso_equation(*states, *settings, random_state=random)
        moved = repair_random_init(moved, before, *pymoo.problem.bounds(), random_state=random)
        mutation = PM(prob=0.9, eta=random.uniform(5, 30), at_least_once=False)
        place = Population(Individual(X=own[best]))
        moved[best] = mutation(pymoo.problem, place, random_state=random)[0].X
        self._positions, self._velocities = moved, changed

    def _keep(self, costs: Array) -> None:
        """Keep the places that are better than a particle's own, except one that another particle has or had."""
        own = self._own
        better = (costs < own.costs)[:, 0]
        for row in np.flatnonzero(better):
            place = self._positions[row]
            better[row] = not (
                (self._positions[:row] == place).all(axis=1).any() or (own.positions == place).all(axis=1).any()
            )
        self._own = _Places(
            np.where(better[:, None], self._positions, own.positions), np.where(better[:, None], costs, own.costs)
        )


def _particle_swarm(first: Array, options: SwarmOptions) -> Any:
    """Return the swarm of the paper (Eq. 1-2). The inertia weight adapts, as a swarm with a fixed 0.9 stays in motion.

    Z.-H. Zhan, J. Zhang, Y. Li, H. S.-H. Chung, Adaptive particle swarm optimization, IEEE Transactions on Systems,
    Man, and Cybernetics B 39, 2009.
    """
    from pymoo.algorithms.soo.nonconvex.pso import PSO  # noqa: PLC0415

    pymoo = PSO(
        pop_size=len(first), sampling=first, w=options.inertia, c1=options.cognitive, c2=options.social, adaptive=True
    )
    return _Swarm(pymoo, first)


def _differential_evolution(first: Array, _: SwarmOptions) -> Any:
    from pymoo.algorithms.soo.nonconvex.de import DE  # noqa: PLC0415

    return DE(pop_size=len(first), sampling=first)


def _covariance_matrix_adaptation(first: Array, _: SwarmOptions) -> Any:
    """Return CMA-ES from the first of the positions; it draws the others itself."""
    from pymoo.algorithms.soo.nonconvex.cmaes import CMAES  # noqa: PLC0415

    return CMAES(x0=first[0], sigma=FIRST_SIGMA, pop_size=len(first))


def _genetic(first: Array, _: SwarmOptions) -> Any:
    from pymoo.algorithms.soo.nonconvex.ga import GA  # noqa: PLC0415

    return GA(pop_size=len(first), sampling=first)


ALGORITHMS: dict[AlgorithmName, Callable[[Array, SwarmOptions], Any]] = {
    "pso": _particle_swarm,
    "de": _differential_evolution,
    "cmaes": _covariance_matrix_adaptation,
    "ga": _genetic,
}


def latin_hypercube(count: int, dimensions: int, random: np.random.Generator) -> Array:
    """Return (count, dimensions) points in the unit cube, one in each of ``count`` slices of every dimension."""
    slices = np.argsort(random.random((dimensions, count)), axis=1).T
    return (slices + random.random((count, dimensions))) / max(count, 1)
