"""The paper's method as published: pymoo's swarm of Table 2 on an explicit Euler simulation at 0.1 ms.

A particle is the parameters, its initial state the first noisy record, its cost the root of the mean square error over
both outputs in their own units (section 3.2).
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from pymoo.algorithms.soo.nonconvex.pso import PSO
from pymoo.core.problem import ElementwiseProblem
from pymoo.core.problem import Problem as PymooProblem
from pymoo.optimize import minimize

from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import KNOWN, TWIN, full, inputs_of, outputs_of
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.twin.kernel import Excitation, kernel_of

STEP = 1e-4  # s
PYTHON_GENERATIONS = 2  # generations in pure Python; each takes the same time
ADAPTIVE, FIXED, PYTHON = "paper, adaptive inertia", "paper, inertia fixed", "paper, pure Python"


def methods(budget: Budget) -> tuple[Method, ...]:
    """Compiled in both readings of Table 2, and in pure Python for its time only."""
    done = budget.generations
    cut = 1000.0 / done
    note = f"time scaled from {done} of 1000 generations" if done < 1000 else ""
    return (
        Method((ADAPTIVE,), partial(Compiled, generations=done, adaptive=True), slow=True, scale=cut, note=note),
        Method((FIXED,), partial(Compiled, generations=done, adaptive=False), slow=True, scale=cut, note=note),
        Method(
            (PYTHON,),
            Plain,
            slow=True,
            scale=1000.0 / PYTHON_GENERATIONS,
            note=f"time scaled from {PYTHON_GENERATIONS} of 1000 generations",
        ),
    )


class Compiled:
    """A whole swarm per call of a compiled simulation."""

    def __init__(self, problem: Problem, *, generations: int, adaptive: bool) -> None:
        self._bounds, self._generations, self._adaptive = problem.bounds, generations, adaptive
        self._kernel = kernel_of(TWIN)
        still = Excitation.uniform(np.zeros((2, 2)), STEP)
        self._kernel.euler(full(problem.nominal[None]), np.zeros((1, 2)), still, STEP)  # compiles: not timed

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        measured = outputs_of(window)
        excitation = Excitation.uniform(inputs_of(window), window.sample_period)

        def cost(particles: Array) -> Array:
            initial = np.repeat(measured[:1], len(particles), axis=0)
            with np.errstate(over="ignore", invalid="ignore"):
                outputs = self._kernel.euler(full(particles), initial, excitation, STEP)
                error = np.sqrt(np.mean((outputs - measured) ** 2, axis=(1, 2)))
            return np.where(np.isfinite(error), error, 1e30)

        swarm = _swarm(adaptive=self._adaptive)
        best = minimize(_Whole(cost, self._bounds), swarm, ("n_gen", self._generations), seed=window.index)
        return (Estimate(np.asarray(best.X)),)


class Plain:
    """The same in loops over Python numbers, for its time only."""

    def __init__(self, problem: Problem) -> None:
        self._bounds = problem.bounds

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        measured = outputs_of(window).tolist()
        inputs = inputs_of(window).tolist()

        def cost(particle: Array) -> float:
            return euler_rmse(tuple(particle.tolist()), inputs, measured, window.sample_period)

        minimize(_Single(cost, self._bounds), _swarm(adaptive=True), ("n_gen", PYTHON_GENERATIONS), seed=window.index)
        return (Estimate(np.full(3, np.nan)),)


def euler_rmse(
    particle: tuple[float, float, float], inputs: list[list[float]], measured: list[list[float]], period: float
) -> float:
    """Eq. 11 and 12, record by record; the load is interpolated linearly between records."""
    R_a, D, J = particle
    L_a, K_e, K_t = KNOWN["L_a"], KNOWN["K_e"], KNOWN["K_t"]
    substeps = round(period / STEP)
    (i, omega), total = measured[0], 0.0
    for record, (V_a, T_load) in enumerate(inputs):
        total += (i - measured[record][0]) ** 2 + (omega - measured[record][1]) ** 2
        if record + 1 == len(inputs):
            break
        slope = (inputs[record + 1][1] - T_load) / substeps
        for _ in range(substeps):
            i += STEP * (V_a - R_a * i - K_e * omega) / L_a
            omega += STEP * (K_t * i - T_load - D * omega) / J
            T_load += slope  # noqa: PLW2901 - runs on
    return float((total / (2 * len(inputs))) ** 0.5)


def _swarm(*, adaptive: bool) -> PSO:
    return PSO(pop_size=15, w=0.9, c1=2.0, c2=2.0, adaptive=adaptive)


class _Whole(PymooProblem):  # type: ignore[misc]  # pymoo has no types
    def __init__(self, cost: Callable[[Array], Array], bounds: tuple[Array, Array]) -> None:
        super().__init__(n_var=len(bounds[0]), n_obj=1, xl=bounds[0], xu=bounds[1])
        self._cost = cost

    def _evaluate(self, x: Array, out: dict[str, Any], *_: Any, **__: Any) -> None:
        out["F"] = self._cost(x)


class _Single(ElementwiseProblem):  # type: ignore[misc]  # pymoo has no types
    def __init__(self, cost: Callable[[Array], float], bounds: tuple[Array, Array]) -> None:
        super().__init__(n_var=len(bounds[0]), n_obj=1, xl=bounds[0], xu=bounds[1])
        self._cost = cost

    def _evaluate(self, x: Array, out: dict[str, Any], *_: Any, **__: Any) -> None:
        out["F"] = self._cost(x)
