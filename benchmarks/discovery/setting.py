"""The estimation problem of the benchmark: R_a and D are free with a narrow prior, everything else is known."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Window
from otolith.discovery.hypotheses import FittedHypothesis
from otolith.discovery.screening import ScreeningResult, linearised
from otolith.discovery.search import screening_test, search
from otolith.estimation.evidence import discount
from otolith.estimation.information import Prior
from otolith.estimation.problem import Problem
from otolith.machine import load_machine

CONFIG = Path(__file__).parents[2] / "config" / "dc-motor.toml"
FREE = ("R_a", "D")
PRIOR_SD = np.array([0.01, 2e-6, 1e-4, 1e-8])  # Ω, N·m·s/rad, and their trends per second: standard deviations


@lru_cache(maxsize=1)
def problem() -> Problem:
    """The problem of the machine file, with both parameters free."""
    machine = load_machine(CONFIG, with_driver=False)
    free = tuple(machine.twin.parameter(name) for name in FREE)
    known = tuple(
        (parameter.name, parameter.nominal) for parameter in machine.twin.parameters if parameter.name not in FREE
    )
    return replace(machine.problem, free=free, known=known)


def prior(random: np.random.Generator) -> Prior:
    """A random prior, as far from the truth as its covariance says, so that intervals can be judged."""
    truth = np.concatenate([problem().nominal, np.zeros(len(FREE))])
    return Prior(truth + PRIOR_SD * random.standard_normal(len(truth)), np.diag(PRIOR_SD**2))


@dataclass(frozen=True, slots=True, eq=False)
class RankedHypotheses:
    """The result of a search."""

    hypotheses: tuple[FittedHypothesis, ...]
    """By increasing deviance."""
    deviances: tuple[float, ...]
    """-2 log evidence of each."""
    screening: ScreeningResult
    count: float
    """Measured values."""


def screen(problem: Problem, window: Window, known: Prior) -> ScreeningResult:
    """The screening test of one window."""
    return screening_test(linearised(problem, window, known, known.mean))


def search_and_rank(problem: Problem, window: Window, known: Prior) -> RankedHypotheses:
    """Screening test and search; hypotheses by their evidence."""
    screening = screen(problem, window, known)
    hypotheses = search(screening)
    count = screening.response.objective.count
    unexplained = discount(min(hypothesis.chi_square for hypothesis in hypotheses), count)
    deviances = (hypothesis.evidence(count, unexplained).deviance for hypothesis in hypotheses)
    pairs = sorted((deviance, index) for index, deviance in enumerate(deviances))
    return RankedHypotheses(
        tuple(hypotheses[index] for _, index in pairs),
        tuple(deviance for deviance, _ in pairs),
        screening,
        float(count),
    )
