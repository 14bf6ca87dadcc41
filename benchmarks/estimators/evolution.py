"""scipy.optimize.differential_evolution on the compiled Runge-Kutta simulation, a whole generation per call."""

import numpy as np
from scipy.optimize import differential_evolution

from benchmarks import handwritten
from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import NOISE, full, inputs_of, outputs_of
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem

INITIAL_STATE_REACH = 5.0  # standard deviations around the first record within which the initial state is estimated


def methods(_: Budget) -> tuple[Method, ...]:
    """SciPy's defaults: 15 members per unknown, up to 1000 generations, refined by L-BFGS-B."""
    return (Method(("differential_evolution",), Evolution),)


class Evolution:
    """Over parameters and initial state; nothing is carried on."""

    def __init__(self, problem: Problem) -> None:
        self._low, self._high = problem.bounds
        handwritten.simulate(full(problem.nominal[None]), np.zeros((1, 2)), np.zeros((2, 2)), 0.01)  # compiles

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        inputs, measured = inputs_of(window), outputs_of(window)

        def cost(guesses: Array) -> Array:
            members = np.atleast_2d(guesses.T)
            result = handwritten.simulate(full(members[:, :-2]), members[:, -2:], inputs, window.sample_period)
            return np.asarray((((result - measured) / NOISE) ** 2).sum(axis=(1, 2)))

        low = np.concatenate([self._low, measured[0] - INITIAL_STATE_REACH * NOISE])
        high = np.concatenate([self._high, measured[0] + INITIAL_STATE_REACH * NOISE])
        bounds = list(zip(low, high, strict=True))
        result = differential_evolution(cost, bounds, vectorized=True, updating="deferred", rng=window.index)
        return (Estimate(np.asarray(result.x[:-2])),)
