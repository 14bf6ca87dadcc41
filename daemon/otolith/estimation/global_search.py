"""The global search of a window: a population over all of the bounds, polished, and again until the best repeats.

In open loop a wrong twin is soon far from the machine, so that the cost has many valleys. A round therefore begins in
innovation form with process noise as large as the motion itself: each record corrects the state, and the cost is that
of short predictions, which is smooth. From the best position of the population Gauss-Newton follows the minimum while
the assumed process noise falls in steps to that of the machine (continuation: E. L. Allgower, K. Georg, Introduction to
Numerical Continuation Methods, section 1.2). It fits the initial state as well.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.evidence import is_explained
from otolith.estimation.minimisers import FitResult, gauss_newton, latin_hypercube, minimise
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.twin.definition import StateVariable

LEVELS = (1.0, 0.1, 0.01)  # process noise of the steps, in that by which a state moves as far as it does in the window
MAX_ROUNDS = 8
ROUNDS_IF_EXPLAINED, ROUNDS_IF_NOT = 2, 3  # rounds that must reach the best minimum
SAME_MINIMUM = 0.01  # share of χ² between two results of one minimum
MAX_INTEGRATOR_STEPS = 300_000_000  # in one search: some seconds
LOG_SCALE_RATIO = 10.0  # ratio of the bounds above which a parameter is searched by order of magnitude
TURN = math.tau  # rad
MAX_TURNS = 10  # by which Gauss-Newton may turn an angle beyond its bounds


@dataclass(frozen=True, slots=True, eq=False)
class GlobalMinimum:
    """The best minimum of a search."""

    parameters: Array  # (free,)
    initial: Array  # (states,)
    chi_square: float  # Of the window alone
    has_repeated: bool  # Whether as many rounds as are asked for reached it
    generations: int
    evaluations: int


@dataclass(frozen=True, slots=True, eq=False)
class SearchScale:
    """Free parameters as positions in the unit cube: by order of magnitude where both bounds have one sign."""

    low: Array
    high: Array

    def values(self, cube: Array) -> Array:
        """Return the parameters (..., free) at positions in the cube."""
        by_magnitude = self._by_magnitude()
        ratio = np.where(by_magnitude, self.high / np.where(by_magnitude, self.low, 1.0), 1.0)
        values = np.where(by_magnitude, self.low * ratio**cube, self.low + (self.high - self.low) * cube)
        return np.clip(values, self.low, self.high)

    def position(self, values: Array) -> Array:
        """Return the position (free,) of parameters within their bounds (free,)."""
        by_magnitude = self._by_magnitude()
        low, high = np.where(by_magnitude, self.low, 1.0), np.where(by_magnitude, self.high, math.e)
        width = np.where(self.high > self.low, self.high - self.low, 1.0)
        logarithm = np.log(np.where(by_magnitude, values, low) / low) / np.log(high / low)
        return np.clip(np.where(by_magnitude, logarithm, (values - self.low) / width), 0.0, 1.0)

    def _by_magnitude(self) -> Mask:
        small, large = np.minimum(np.abs(self.low), np.abs(self.high)), np.maximum(np.abs(self.low), np.abs(self.high))
        return np.asarray((self.low * self.high > 0.0) & (large > LOG_SCALE_RATIO * small))


@dataclass(frozen=True, slots=True, eq=False)
class _Round:
    """One population, and its best position polished."""

    parameters: Array  # (free,)
    initial: Array  # (states,)
    chi_square: float  # Of the window alone
    is_explained: bool
    generations: int
    evaluations: int
    integrator_steps: int  # Of the population


def search_window(
    problem: Problem, window: Window, start: Array, random: np.random.Generator, max_rounds: int = MAX_ROUNDS
) -> GlobalMinimum:
    """Return the best minimum of ``window`` alone within the bounds; ``start`` (free,) is one of the first positions.

    The rounds end when enough of them have reached the best minimum, or with the generations of the machine file.
    """
    rounds: list[_Round] = []
    while len(rounds) < max_rounds and not _has_repeated(rounds):
        further = _further_round(problem, window, start, random, rounds)
        if further is None:
            break
        rounds.append(further)
    best = _best(rounds)
    return GlobalMinimum(
        parameters=best.parameters,
        initial=best.initial,
        chi_square=best.chi_square,
        has_repeated=_has_repeated(rounds),
        generations=sum(item.generations for item in rounds),
        evaluations=sum(item.evaluations for item in rounds),
    )


def _further_round(
    problem: Problem, window: Window, start: Array, random: np.random.Generator, rounds: Sequence[_Round]
) -> _Round | None:
    """Return the round after ``rounds``, which begins at the next level; None if they have left no generation for it.

    Its predictor is made at the best parameters so far. Those of ``start`` may be far from any machine, and so stiff
    that the integrator would need a thousand times as many steps.
    """
    steps = (*_corrected(problem, window), problem)[len(rounds) % len(LEVELS) :]
    objective = Objective(steps[0], window, _best(rounds).parameters if rounds else problem.nominal)
    generations = _affordable(problem, objective, rounds)
    if rounds and generations < 1:
        return None
    scale, first = SearchScale(*problem.bounds), latin_hypercube(problem.swarm.size, len(start), random)
    if not rounds:
        first[0] = scale.position(start)
    options = replace(problem.swarm, generations=max(generations, 1))
    found = minimise(partial(_cost, objective, scale), first, options, random)
    polished, evaluations = _polished(steps, window, scale.values(found.position))
    return _Round(
        parameters=polished.guess[: len(start)],
        initial=polished.guess[len(start) :],
        chi_square=polished.chi_square,
        is_explained=is_explained(polished.chi_square, objective.count),
        generations=found.generations,
        evaluations=found.evaluations + evaluations,
        integrator_steps=found.evaluations * objective.integrator_steps,
    )


def _best(rounds: Sequence[_Round]) -> _Round:
    return min(rounds, key=lambda item: item.chi_square)


def _has_repeated(rounds: Sequence[_Round]) -> bool:
    """Whether enough rounds have reached the best minimum so far; more are asked for if it explains nothing."""
    if not rounds:
        return False
    best = _best(rounds)
    same = best.chi_square + SAME_MINIMUM * max(best.chi_square, 1.0)
    reached = sum(item.chi_square <= same for item in rounds)
    return reached >= (ROUNDS_IF_EXPLAINED if best.is_explained else ROUNDS_IF_NOT)


def _affordable(problem: Problem, objective: Objective, rounds: Sequence[_Round]) -> int:
    """Return the generations that the rounds so far have left."""
    generations = problem.swarm.generations - sum(item.generations for item in rounds)
    integrator_steps = MAX_INTEGRATOR_STEPS - sum(item.integrator_steps for item in rounds)
    return min(generations, integrator_steps // (problem.swarm.size * max(objective.integrator_steps, 1)))


def _cost(objective: Objective, scale: SearchScale, cube: Array) -> Array:
    """Return the cost (members,) of positions in the unit cube (members, free)."""
    return objective.cost_of_parameters(scale.values(cube))


def _polished(steps: Sequence[Problem], window: Window, parameters: Array) -> tuple[FitResult, int]:
    """Return where Gauss-Newton from ``parameters`` (free,) ends after all ``steps``, and its evaluations."""
    initial, evaluations = None, 0
    for step in steps:
        parameters = _turned_back(step, parameters)
        objective = Objective(step, window, parameters, initial)
        result = gauss_newton(objective, np.concatenate([parameters, objective.initial]))
        parameters, initial = result.guess[: objective.free], result.guess[objective.free :]
        evaluations += result.evaluations
    return result, evaluations


def _corrected(problem: Problem, window: Window) -> list[Problem]:
    """Return the problem with much process noise, then less. Gauss-Newton may turn its angles beyond their bounds."""
    motion = [_motion(state, problem, window) for state in problem.base_model.states]
    diffusion = np.array(motion) / np.sqrt(max(window.grid.length, window.sample_period))
    own, reach = np.array(problem.process_noise or [0.0] * len(motion)), MAX_TURNS * TURN
    free = tuple(
        replace(parameter, low=parameter.low - reach, high=parameter.high + reach) if turns else parameter
        for parameter, turns in zip(problem.free, _turning(problem), strict=True)
    )
    return [
        replace(problem, free=free, open_loop=False, process_noise=tuple(np.maximum(own, level * diffusion).tolist()))
        for level in LEVELS
    ]


def _motion(state: StateVariable, problem: Problem, window: Window) -> float:
    """Return how far a state moves within the window, in its unit; if it is not measured, how far it may move."""
    if state.name in (output.name for output in problem.base_model.outputs):
        measured = window.column(state.name)[~window.missing_in(state.name)]
        if len(measured):
            return float(np.ptp(measured))
    return state.high - state.low


def _turning(problem: Problem) -> Mask:
    """Return which free parameters (free,) are angles whose bounds are at least a turn wide."""
    is_angle = np.array([parameter.unit == "rad" for parameter in problem.free], dtype=np.bool_)
    low, high = problem.bounds
    return is_angle & (np.round((high - low) / TURN, 3) >= 1.0)  # -3.1416 to 3.1416 is a turn


def _turned_back(problem: Problem, parameters: Array) -> Array:
    """Return ``parameters`` (free,) with angles turned back between their bounds, as far as whole turns lead there."""
    low, high = problem.bounds
    turns = np.maximum(np.ceil((parameters - high) / TURN), 0.0) - np.maximum(np.ceil((low - parameters) / TURN), 0.0)
    return np.clip(np.where(_turning(problem), parameters - TURN * turns, parameters), low, high)
