"""Experiments: which move of the machine would determine a parameter, or distinguish two hypotheses.

A parameter is determined best by the experiment whose Fisher information is largest (E. Walter, L. Pronzato,
Identification of Parametric Models from Experimental Data, 1997, chapter 6). Two hypotheses are distinguished best
where the expected evidence for the true one is largest, after fitting the other to what it predicts (A. C. Atkinson,
V. V. Fedorov, Biometrika 62, 1975). The moves are steps and swings of one input at a time within its range, from the
present state. A move is a window like any other: with the delays of its hypothesis, and with innovations as in a fit.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.hypotheses import TrackedHypothesis
from otolith.discovery.linear_response import chi_square_of_parameters
from otolith.discovery.screening import linearised
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.information import QUANTILE, Prior, information, required_half_widths
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.timing import shifted
from otolith.estimation.window_fit import Fit
from otolith.twin.definition import Input
from otolith_drivers.units import unit_text

MOVE_SHARES = (0.1, 0.25, 0.5, 1.0)  # of the input's range; the smallest move that suffices is advised
MAX_RECORDS = 200  # of a simulated experiment
MIN_REDUCTION = 0.5  # share of the present interval that a move must reach to be advised
MIN_DISTANCE = 2.0 * DECISIVE  # expected evidence that decides with some certainty
NEGLIGIBLE = 1e-6  # of the size of a move: an end below is zero
OTHER_INPUTS = " if the other inputs stay as they are"
NO_EXPERIMENT = "no change of a single input can tell these causes apart: inspect the sensors and the machine"


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """Where the machine is."""

    inputs: Array  # (inputs,)
    state: Array  # (states,)
    records: int
    sample_period: float  # Mean time between two records, s
    end: float = 0.0  # Service time, s


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A move of one input."""

    text: str
    inputs: Array  # (records, inputs)


def advise(problem: Problem, known: Prior, situation: Situation, wanted: list[str]) -> dict[str, str]:
    """Return a sentence for each ``wanted`` parameter that some move would determine, given what is ``known``."""
    required, present = required_half_widths(problem, known.mean[: len(problem.free)]), QUANTILE * known.sd
    best = {at: (present[at], "") for at, own in enumerate(problem.free) if own.name in wanted}
    for move in moves(problem, situation):
        searched = [at for at, (reach, _) in best.items() if reach > required[at]]
        if not searched:
            break
        reaches = _interval_after(problem, known, situation, move)
        best |= {at: (reaches[at], move.text) for at in searched if reaches[at] < best[at][0]}
    return {
        problem.free[
            at
        ].name: f"{text} would determine it to ±{reach:.2g} {unit_text(problem.free[at].unit)}{OTHER_INPUTS}"
        for at, (reach, text) in best.items()
        if text and reach <= MIN_REDUCTION * present[at]
    }


def deciding_experiment(first: TrackedHypothesis, second: TrackedHypothesis, situation: Situation) -> str:
    """Return the smallest move that would distinguish ``first`` from ``second``, whichever holds, as a sentence."""
    pairs = (first, second), (second, first)
    for move in moves(first.problem, situation):
        if all(_expected_evidence(wrong, true, situation, move) >= MIN_DISTANCE for wrong, true in pairs):
            return f"{move.text} would decide{OTHER_INPUTS}"
    return NO_EXPERIMENT


def moves(problem: Problem, situation: Situation) -> Iterator[Move]:
    """Yield steps and swings of one input at a time, the smallest first."""
    records = min(situation.records, MAX_RECORDS)
    period = situation.records * situation.sample_period / records
    share = np.arange(records) / records
    for size in MOVE_SHARES:
        for column, moved in enumerate(problem.base_model.inputs):
            low, high = _ends(moved, float(situation.inputs[column]), size)
            least, most = (_readable(end, abs(high - low)) for end in (low, high))
            step = f"a step of {moved.name} from {least} to {most} {unit_text(moved.unit)}"
            swing = f"swinging {moved.name} between {least} and {most} {unit_text(moved.unit)}"
            swing += f" twice within {records * period:.3g} s"
            for text, curve in ((step, share >= 0.25), (swing, 0.5 - 0.5 * np.cos(4.0 * np.pi * share))):
                inputs = np.tile(situation.inputs, (records, 1))
                inputs[:, column] = low + (high - low) * curve
                yield Move(text, inputs)


def _readable(end: float, move: float) -> str:
    """Return the end of a move, with three digits; what is far below the size of the ``move`` is zero."""
    return f"{0.0 if abs(end) < NEGLIGIBLE * move else end:.3g}"


def _ends(moved: Input, present: float, size: float) -> tuple[float, float]:
    """Return start and end of a move towards the farther end of the range."""
    reach = size * (moved.high - moved.low)
    target = present + reach if moved.high - present >= present - moved.low else present - reach
    return present, min(max(target, moved.low), moved.high)


def _experiment(problem: Problem, known: Prior, situation: Situation, move: Move) -> Window | None:
    """Return the window that ``problem`` predicts of a move, without noise; None if its twin diverges."""
    twin, records = problem.base_model, len(move.inputs)
    inputs, outputs = move.inputs[:, : len(twin.inputs)], np.zeros((records, len(twin.outputs)))
    period = situation.records * situation.sample_period / records
    window = Window.whole(0, situation.end, period, twin.signals, np.hstack([inputs, outputs]))
    start, initial = np.clip(known.mean[: len(problem.free)], *problem.bounds), np.zeros(len(problem.twin.states))
    initial[: len(twin.states)] = situation.state[: len(twin.states)]
    with np.errstate(over="ignore", invalid="ignore"):
        outputs = Objective(problem, window, start, initial).simulate(np.concatenate([start, initial]))
    if not np.isfinite(outputs).all():
        return None
    whole = Window.whole(0, situation.end, period, twin.signals, np.hstack([inputs, outputs]))
    return shifted(twin, whole, {signal: -delay for signal, delay in problem.delays})


def _interval_after(problem: Problem, known: Prior, situation: Situation, move: Move) -> Array:
    """Return the half-width (free,) of each 95 % interval after ``move``."""
    free, window = len(problem.free), _experiment(problem, known, situation, move)
    if window is None:
        return QUANTILE * known.sd[:free]
    fitted = linearised(problem, window, known, known.mean)
    states = (fitted.objective.high - fitted.objective.low)[free:]
    after = information(fitted.result.first[2], np.concatenate([known.sd, states]), 1.0)
    return QUANTILE * after.sd[:free]


def _expected_evidence(wrong: TrackedHypothesis, true: TrackedHypothesis, situation: Situation, move: Move) -> float:
    """Return the expected -2 log likelihood ratio of two hypotheses after ``move``, if ``true`` holds."""
    window = _experiment(true.problem, true.posterior.prior(), situation, move)
    if window is None:
        return 0.0
    priors = wrong.posterior.prior(), true.posterior.prior()
    one, other = (
        linearised(own.problem, window, prior, prior.mean) for own, prior in zip((wrong, true), priors, strict=True)
    )
    return chi_square_of_parameters(one) - chi_square_of_parameters(other) + _of_noise(one, other)


def _of_noise(wrong: Fit, true: Fit) -> float:
    """Return what the size of the innovations adds; a delay leaves it as it is."""
    if wrong.problem.delays or true.problem.delays:
        return 0.0
    whitening = wrong.objective.whitening
    whitened = whitening @ np.linalg.inv(true.objective.whitening)
    determinants = wrong.objective.spread - true.objective.spread
    return float((whitened**2).sum() - whitening.shape[0] * whitening.shape[1] + determinants)
