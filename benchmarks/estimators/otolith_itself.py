"""Otolith: the whole core, warm over consecutive windows, and cold on each window."""

import numpy as np

from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import FREE
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.estimation.problem import Problem
from otolith.health.schema import ParameterDocument

PUBLISHED, ALONE, COLD = "Otolith warm, published", "Otolith warm, window alone", "Otolith cold"


def methods(_: Budget) -> tuple[Method, ...]:
    """Warm and cold."""
    return (Method((PUBLISHED, ALONE), Warm, stateful=True), Method((COLD,), Cold))


class Warm:
    """State carried from window to window: published values, and those of the window alone."""

    def __init__(self, problem: Problem) -> None:
        self._state = _fresh(problem)

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        self._state, report = adapt(self._state, window)
        parameters = [report.document.parameters[name] for name in FREE]
        published = Estimate(
            np.array([_number(parameter.value) for parameter in parameters]),
            np.array([_number(parameter.sd) for parameter in parameters]),
        )
        return published, _alone(parameters)


class Cold:
    """Each window as the first of its machine."""

    def __init__(self, problem: Problem) -> None:
        self._state = _fresh(problem)

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        _, report = adapt(self._state, window)
        return (_alone([report.document.parameters[name] for name in FREE]),)


def _fresh(problem: Problem) -> AdaptationState:
    return initial_state("motor", "bench", problem)


def _alone(parameters: list[ParameterDocument]) -> Estimate:
    return Estimate(
        np.array([_number(parameter.raw) for parameter in parameters]),
        np.array([_number(parameter.raw_sd) for parameter in parameters]),
    )


def _number(value: float | None) -> float:
    return np.nan if value is None else value
