"""A glance at every window: whether a search for components would be worth its time."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.claims import unexplained, with_candidate
from otolith.adaptation.completion import plain
from otolith.adaptation.flight import evaluated
from otolith.adaptation.landscape import Landscape
from otolith.adaptation.prior import Prior, vague
from otolith.adaptation.problem import Problem
from otolith.adaptation.screening import (
    CLEARLY,
    COARSE,
    LARGEST,
    Candidate,
    component_of,
    holding,
    rivals_of,
    screened,
    sought,
)
from otolith.twin.metamodels import Kind
from otolith.twin.slots import sources

LOOKED_AT = 4  # windows, in one of which families are tried that the linear picture underrates


@dataclass(frozen=True, slots=True, eq=False)
class Glance:
    """What a window would gain at most, by a coarse look."""

    gain: float
    """In -2 log evidence, over parameters only; positive for something worth a search."""
    landscape: Landscape
    lacking: bool = False
    """Whether it is worth it only if the twin has lacked it from the first window on."""


def glance(problem: Problem, window: Window, prior: Prior, start: Array) -> Glance:
    """A coarse look at what a component would gain, around ``start`` (free parameters, ...)."""
    landscape = Landscape(problem, window, prior, start[: len(problem.free)])
    # Lines of the spectrum cost most: those over time are looked at in one window, those over angles in the next.
    turn = (Kind.TIME, Kind.PLACE)[window.index % 2]
    found = [
        entry
        for entry in sought(problem, landscape.x)
        if problem.discover and (len(entry.model.phases) == 1 or sources(plain(problem))[entry.source].kind is turn)
    ]
    _, _, scores = screened(landscape, problem, found, COARSE)
    gain = float(scores.max(initial=-np.inf)) - CLEARLY
    if gain <= 0.0 and problem.discover and window.index % LOOKED_AT == 0:
        held = _held(problem, window, landscape) - CLEARLY
        return Glance(max(gain, held), landscape, lacking=held > 0.0)
    return Glance(gain, landscape)


def _held(problem: Problem, window: Window, landscape: Landscape) -> float:
    """What a family would gain that the linear picture underrates, whatever was known of the parameters."""
    found = sought(problem, landscape.x)
    rivals = rivals_of(problem, found)
    guesses = [(entry, entry.bounds[0]) for entry in found if entry.model.holds and not rivals.lies(entry)]
    gains = evaluated(landscape, guesses)
    settled = [
        (guess, pair, 0.0)
        for guess, pair in zip(guesses, gains.amplitudes, strict=True)
        if 0.0 < np.abs(pair).max() < LARGEST
    ]
    fresh, best = vague(problem), -np.inf
    for (structure, inner), pair, _ in holding(problem, settled):
        candidate = Candidate(
            component_of(problem, window, structure, inner, pair), rivals.of(structure), of_sensor=False
        )
        tried = with_candidate(problem, window, fresh, candidate)
        left = unexplained([tried.chi_square], tried.informed.count)
        price = tried.deviance(tried.informed.count, 1.0) - tried.chi_square
        price += len(problem.free) * np.log(tried.informed.count)
        best = max(best, (landscape.chi_square - tried.chi_square) / left - price)
    return best
