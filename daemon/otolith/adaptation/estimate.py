"""Step 2 of the method: from a window to parameters with their uncertainty."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.information import ParameterEstimate, classify, information
from otolith.adaptation.polish import Polished, polish
from otolith.adaptation.problem import Objective, Problem
from otolith.adaptation.swarm import search

AT_BOUND = 1e-4  # of the width of the bounds
SURPRISING = 1.5  # cost of a warm fit beyond which the swarm looks whether there is a better valley


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


def estimate(problem: Problem, window: Window, start: Array, *, warm: bool = False) -> WindowEstimate:
    """Fit the free parameters to ``window``; ``start`` (free parameters,) is where the search begins.

    A swarm finds the valley and Gauss-Newton its floor; a ``warm`` start is taken to lie in the valley, and the swarm
    only looks for a better one if the floor does not explain the window. The same problem, window and start give the
    same estimate, bit for bit.
    """
    objective = Objective(problem, window, start)
    generations = evaluations = 0
    found = polish(objective, objective.guess(start)) if warm else None
    if found is None or not found.converged or found.chi_square > SURPRISING**2 * objective.count:
        searched = search(objective, problem.swarm, start, seed=problem.seed + window.index)
        generations, evaluations = searched.generations, searched.evaluations
        polished = polish(objective, objective.guess(searched.values))
        if found is None or polished.chi_square < found.chi_square:
            found = polished
    return _result(problem, objective, found, generations, evaluations + found.evaluations)


def _result(
    problem: Problem, objective: Objective, found: Polished, generations: int, evaluations: int
) -> WindowEstimate:
    cost = float(np.sqrt(found.chi_square / objective.count))
    width = objective.high - objective.low
    told = information(found.jacobian, width, cost)
    at_bound = (found.guess <= objective.low + AT_BOUND * width) | (found.guess >= objective.high - AT_BOUND * width)
    parameters = []
    for index, entry in enumerate(problem.free):
        allowed = problem.determined_within * max(abs(entry.nominal), 0.01 * (entry.high - entry.low))
        verdict, reason = classify(told, index, objective.names, half_width=allowed, at_bound=bool(at_bound[index]))
        parameters.append(
            ParameterEstimate(entry.name, float(found.guess[index]), float(told.sd[index]), verdict, reason)
        )
    configured = objective.guess(np.array([entry.nominal for entry in problem.free]))
    predictions = objective.predict(np.vstack([found.guess, configured]))
    return WindowEstimate(
        parameters=tuple(parameters),
        cost=cost,
        rmse_configured=tuple(map(float, objective.rmse(predictions[1]))),
        rmse_estimated=tuple(map(float, objective.rmse(predictions[0]))),
        measured=objective.measured,
        predicted=predictions[0],
        generations=generations,
        evaluations=evaluations,
    )
