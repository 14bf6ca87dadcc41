"""Otolith: the whole heart, warm over consecutive windows and cold on each."""

import numpy as np

from benchmarks.estimators.base import Budget, Rival, Said
from benchmarks.estimators.data import FREE
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.estimation.problem import Problem
from otolith.health.schema import ParameterDocument

PUBLISHED, ALONE, COLD = "Otolith warm, published", "Otolith warm, window alone", "Otolith cold"


def rivals(_: Budget) -> tuple[Rival, ...]:
    """Both."""
    return (Rival((PUBLISHED, ALONE), Warm, remembers=True), Rival((COLD,), Cold))


class Warm:
    """State carried from window to window: what is published, and what the window alone says."""

    def __init__(self, problem: Problem) -> None:
        self._state = _fresh(problem)

    def fit(self, window: Window) -> tuple[Said, ...]:
        self._state, report = adapt(self._state, window)
        found = [report.document.parameters[name] for name in FREE]
        published = Said(
            np.array([_number(entry.value) for entry in found]), np.array([_number(entry.sd) for entry in found])
        )
        return published, _alone(found)


class Cold:
    """Each window as if it were a machine's first."""

    def __init__(self, problem: Problem) -> None:
        self._state = _fresh(problem)

    def fit(self, window: Window) -> tuple[Said, ...]:
        _, report = adapt(self._state, window)
        return (_alone([report.document.parameters[name] for name in FREE]),)


def _fresh(problem: Problem) -> AdaptationState:
    return initial_state("motor", "bench", problem)


def _alone(found: list[ParameterDocument]) -> Said:
    return Said(np.array([_number(entry.raw) for entry in found]), np.array([_number(entry.raw_sd) for entry in found]))


def _number(value: float | None) -> float:
    return np.nan if value is None else value
