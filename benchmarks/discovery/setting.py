"""The motor as the daemon knows it after a while: R_a and D free and well known, everything else given."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.hypotheses import FittedHypothesis
from otolith.discovery.search import ScreeningResult, screening_test, search
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.machine import load_machine

CONFIG = Path(__file__).parents[2] / "config" / "dc-motor.toml"
FREE = ("R_a", "D")
KNOWN_TO = np.array([0.01, 2e-6, 1e-4, 1e-8])  # Ω, N·m·s/rad, and their trends per second: standard deviations


@lru_cache(maxsize=1)
def problem() -> Problem:
    """Of the machine file, with both parameters free."""
    plan = load_machine(CONFIG, with_driver=False)
    free = tuple(plan.twin.parameter(name) for name in FREE)
    known = tuple((entry.name, entry.nominal) for entry in plan.twin.parameters if entry.name not in FREE)
    return replace(plan.problem, free=free, known=known)


def prior(random: np.random.Generator) -> Prior:
    """What was learned before, off the truth by as much as it says that it may be: else intervals would look wide."""
    truth = np.concatenate([problem().nominal, np.zeros(len(FREE))])
    return Prior(truth + KNOWN_TO * random.standard_normal(len(truth)), np.diag(KNOWN_TO**2))


def beginning(asked: Problem, window: Window, known: Prior) -> Array:
    """(guess,) parameters and trends as known, and the initial state of the first record."""
    free = len(asked.free)
    objective = Objective(asked, window, known.mean[:free])
    return np.concatenate([known.mean, objective.guess(known.mean[:free])[free:]])


@dataclass(frozen=True, slots=True, eq=False)
class Ranked:
    """What a search found."""

    explanations: tuple[FittedHypothesis, ...]
    """The best first."""
    deviances: tuple[float, ...]
    """-2 log evidence of each."""
    glance: ScreeningResult
    count: float
    """Values that were measured."""


def looked(asked: Problem, window: Window, known: Prior) -> ScreeningResult:
    """A glance at one window."""
    return screening_test(asked, window, known, beginning(asked, window, known))


def ranked(asked: Problem, window: Window, known: Prior) -> Ranked:
    """A glance and a search, and its explanations by their evidence."""
    seen = looked(asked, window, known)
    found = search(asked, window, known, seen)
    count = seen.landscape.objective.count
    unexplained = max(1.0, min(entry.chi_square for entry in found) / count)
    pairs = sorted(((entry.deviance(count, unexplained), place) for place, entry in enumerate(found)))
    return Ranked(
        tuple(found[place] for _, place in pairs), tuple(deviance for deviance, _ in pairs), seen, float(count)
    )
