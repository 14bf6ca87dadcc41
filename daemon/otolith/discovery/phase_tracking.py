"""From window to window with components: a phase runs on by what has been turned, or is lost where nobody has seen it.

Phases are at the first record of a window. To the next one a phase runs on by frequency times time, or by order times
angle, so that a component that is tracked stays coherent and its frequency is known ever better.
"""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.augmented import base_model, indices, source_of, without
from otolith.estimation.imm_filter import ImmPosterior, remap_parameters, reset_marginal
from otolith.estimation.problem import Component, Problem

HALF = 0.5  # of a sampling period: what a window may begin late or early and follow its predecessor
HARDLY = 1.0  # rad: standard deviation of a phase from which on several are tried
LONGEST_RUN = 600.0  # s for which a component over time is followed that does not repeat itself
UNKNOWN = np.pi / np.sqrt(3.0)  # rad: standard deviation of a phase of which nothing is known


@dataclass(frozen=True, slots=True)
class PhaseAdvance:
    """What the sources of components have done from the first record of a window to that of the next."""

    start: float
    """Unix seconds of the first record."""
    next_start: float
    """Unix seconds of the next window's first record, if none is left out."""
    by: tuple[float, ...]
    """Of each slot, in the unit of its source."""


Turn = TypeVar("Turn", PhaseAdvance, PhaseAdvance | None)


def phase_advance(problem: Problem, window: Window, last_state: Array) -> PhaseAdvance:
    """``last_state`` (states,) is that at the last record."""
    names = [entry.name for entry in problem.twin.states]
    found = []
    for component in problem.components:
        symbol = source_of(base_model(problem), component.source).symbol
        if component.source == "t":
            found.append(window.records * window.sample_period)
        elif component.repeats and symbol.startswith("_"):
            speed = last_state[names.index(symbol.removeprefix("_angle_"))]
            found.append(float(last_state[names.index(symbol)] + speed * window.sample_period))
        else:
            found.append(0.0)
    return PhaseAdvance(window.start, window.end, tuple(found))


def propagate_phases(
    belief: ImmPosterior, problem: Problem, before: PhaseAdvance | None, window: Window
) -> ImmPosterior:
    """The belief with phases at the first record of ``window``."""
    if before is None:
        return belief
    follows = abs(window.start - before.next_start) <= HALF * window.sample_period
    for slot, (component, by) in enumerate(zip(problem.components, before.by, strict=True)):
        if not component.repeats:
            continue
        if component.source == "t" and _is_known(belief, problem, indices(problem, slot), window.start - before.start):
            belief = _turned_by(belief, problem, indices(problem, slot), window.start - before.start)
        elif component.source == "t":
            belief = phase_unknown(belief, problem, indices(problem, slot)[-1])
        elif follows:
            belief = _turned_by(belief, problem, indices(problem, slot), by)
        elif source_of(base_model(problem), component.source).symbol.startswith("_"):
            belief = phase_unknown(belief, problem, indices(problem, slot)[-1])
    return belief


def _turned_by(belief: ImmPosterior, problem: Problem, where: list[int], by: float) -> ImmPosterior:
    _, inner, phase = where
    free = len(problem.free)
    move = np.eye(2 * free)
    move[phase, inner] = move[free + phase, free + inner] = by * problem.scale[inner] / problem.scale[phase]
    mean = belief.mean @ move.T
    turn = 2.0 * np.pi / problem.scale[phase]
    mean[:, phase] -= turn * np.rint(mean[0, phase] / turn)
    return replace(belief, mean=mean, covariance=move @ belief.covariance @ move.T)


def _is_known(belief: ImmPosterior, problem: Problem, where: list[int], by: float) -> bool:
    """Whether a phase can still be told after so much time; not if the clock has been set back."""
    inner = where[1]
    sd = float(np.sqrt(belief.covariance[:, inner, inner].max())) * problem.scale[inner]
    return by >= 0.0 and sd * by < UNKNOWN


def unknown_phases(belief: ImmPosterior, problem: Problem) -> list[int]:
    """Where in a guess the phases are of which nothing is known."""
    phases = [indices(problem, slot)[-1] for slot, entry in enumerate(problem.components) if entry.repeats]
    known = np.sqrt(belief.covariance[0].diagonal()[: len(problem.free)]) * problem.scale
    return [phase for phase in phases if known[phase] > HARDLY]


def phase_unknown(belief: ImmPosterior, problem: Problem, phase: int) -> ImmPosterior:
    """The belief where nothing is known of a phase any more."""
    return reset_marginal(belief, phase, UNKNOWN / problem.scale[phase])


def without_slot(problem: Problem, belief: ImmPosterior, turn: Turn, slot: int) -> tuple[Problem, ImmPosterior, Turn]:
    """Twin, knowledge and turns without the component of a slot; what stays keeps its numbers."""
    fewer = without(problem, problem.components[slot])
    rest = remap_parameters(belief, problem, fewer)
    if turn is not None:
        turn = replace(turn, by=tuple(by for index, by in enumerate(turn.by) if index != slot))
    return fewer, rest, turn


def expired(problem: Problem, window: Window) -> list[Component]:
    """Components that ran away with time: what goes on for longer is a trend of a parameter, and a clock may be set."""
    return [
        entry
        for entry in problem.components
        if entry.source == "t" and not entry.repeats and not 0.0 <= window.start - entry.origin <= LONGEST_RUN
    ]
