"""Step 2 of the method: from a window to parameters with their uncertainty."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.information import ParameterEstimate, classify, information
from otolith.adaptation.problem import Objective, Problem
from otolith.adaptation.swarm import search

AT_BOUND = 1e-4  # of the width of the bounds


@dataclass(frozen=True, slots=True)
class WindowEstimate:
    """What one window says. The traces are (records, outputs) in the units of the twin."""

    parameters: tuple[ParameterEstimate, ...]
    cost: float
    """RMSE in units of the noise."""
    rmse_configured: tuple[float, ...]
    rmse_estimated: tuple[float, ...]
    measured: Array
    predicted: Array
    generations: int
    evaluations: int


def estimate(problem: Problem, window: Window, start: Array) -> WindowEstimate:
    """Fit the free parameters to ``window``, the search warm-started from ``start`` (free parameters,).

    The same problem, window and start give the same estimate, bit for bit.
    """
    objective = Objective(problem, window)
    found = search(objective, problem.swarm, objective.guess(start), seed=problem.seed + window.index)
    told = information(objective, found.values, found.cost)
    margin = AT_BOUND * (objective.high - objective.low)
    at_bound = (found.values <= objective.low + margin) | (found.values >= objective.high - margin)
    parameters = []
    for index, entry in enumerate(problem.free):
        allowed = problem.determined_within * max(abs(entry.nominal), 0.01 * (entry.high - entry.low))
        verdict, reason = classify(told, index, objective.names, half_width=allowed, at_bound=bool(at_bound[index]))
        parameters.append(
            ParameterEstimate(entry.name, float(found.values[index]), float(told.sd[index]), verdict, reason)
        )
    configured = objective.guess(np.array([entry.nominal for entry in problem.free]))
    predictions = objective.predict(np.vstack([found.values, configured]))
    return WindowEstimate(
        parameters=tuple(parameters),
        cost=found.cost,
        rmse_configured=tuple(map(float, objective.rmse(predictions[1]))),
        rmse_estimated=tuple(map(float, objective.rmse(predictions[0]))),
        measured=objective.measured,
        predicted=predictions[0],
        generations=found.generations,
        evaluations=found.evaluations,
    )
