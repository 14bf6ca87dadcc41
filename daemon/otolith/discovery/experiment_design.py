"""Experiments: which move of the machine would determine a parameter, or distinguish two hypotheses.

A parameter is determined best by the experiment whose Fisher information is largest (E. Walter, L. Pronzato,
Identification of Parametric Models from Experimental Data, 1997, chapter 6). Two hypotheses are distinguished best
where their predictions differ most, after fitting the one to the other's prediction (A. C. Atkinson, V. V. Fedorov,
Biometrika 62, 1975). The moves are steps and swings of one input at a time within its range, from the present state.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, TimeGrid
from otolith.discovery.hypotheses import TrackedHypothesis
from otolith.discovery.screening import DECISIVE
from otolith.estimation.information import QUANTILE, Prior
from otolith.estimation.problem import Problem
from otolith.twin.components import ELAPSED
from otolith.twin.definition import Input
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.units import unit_text

MOVE_SHARES = (0.1, 0.25, 0.5, 1.0)  # of the input's range; the smallest move that suffices is advised
MAX_RECORDS = 200  # of a simulated experiment
MIN_REDUCTION = 0.5  # share of the present interval that a move must reach to be advised
MIN_DISTANCE = 2.0 * DECISIVE  # χ² between two predictions that decides with some certainty
SUBSTEPS = 4
REGULARISATION = 1e-12
OTHER_INPUTS = " if the other inputs stay as they are"
NO_EXPERIMENT = "no change of a single input can tell these causes apart: inspect the sensors and the machine"


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """Where the machine is."""

    inputs: Array  # (inputs,)
    state: Array  # (states,)
    records: int
    sample_period: float  # Mean time between two records, s


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A move of one input."""

    text: str
    inputs: Array  # (records, inputs)


def advise(problem: Problem, known: Prior, situation: Situation, wanted: list[str]) -> dict[str, str]:
    """Return a sentence for each ``wanted`` parameter that some move would determine, given what is ``known``."""
    tried = list(moves(problem, situation))
    reaches = np.array([_interval_after(problem, known, situation, move) for move in tried]).reshape(len(tried), -1)
    required = problem.determined_within * problem.scale
    present = QUANTILE * known.sd
    advice = {}
    for index, parameter in enumerate(problem.free):
        if parameter.name not in wanted or not tried:
            continue
        reach = reaches[:, index]
        enough = np.flatnonzero(reach <= required[index])
        best = int(enough[0]) if len(enough) else int(np.argmin(reach))
        if reach[best] <= MIN_REDUCTION * present[index]:
            result = f"±{reach[best]:.2g} {unit_text(parameter.unit)}{OTHER_INPUTS}"
            advice[parameter.name] = f"{tried[best].text} would determine it to {result}"
    return advice


def deciding_experiment(first: TrackedHypothesis, second: TrackedHypothesis, situation: Situation) -> str:
    """Return the smallest move that would distinguish ``first`` from ``second``, as a sentence."""
    for move in moves(first.problem, situation):
        if _distance(first, second, situation, move) >= MIN_DISTANCE:
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
            step = f"a step of {moved.name} from {low:.3g} to {high:.3g} {unit_text(moved.unit)}"
            swing = f"swinging {moved.name} between {low:.3g} and {high:.3g} {unit_text(moved.unit)}"
            swing += f" twice within {records * period:.3g} s"
            for text, curve in ((step, share >= 0.25), (swing, 0.5 - 0.5 * np.cos(4.0 * np.pi * share))):
                inputs = np.tile(situation.inputs, (records, 1))
                inputs[:, column] = low + (high - low) * curve
                yield Move(text, inputs)


def _grid(situation: Situation, records: int) -> TimeGrid:
    """Return the times of an experiment as long as the window."""
    return TimeGrid.uniform(records, situation.records * situation.sample_period / records)


def _ends(moved: Input, present: float, size: float) -> tuple[float, float]:
    """Return start and end of a move towards the farther end of the range."""
    reach = size * (moved.high - moved.low)
    target = present + reach if moved.high - present >= present - moved.low else present - reach
    return present, min(max(target, moved.low), moved.high)


def _parameter_values(problem: Problem, mean: Array) -> tuple[Array, list[int]]:
    """Return all parameters of the twin (parameters,) and the columns of the free ones, which take ``mean``."""
    order, given = [parameter.name for parameter in problem.twin.parameters], dict(problem.known)
    values = np.array([given.get(parameter.name, parameter.nominal) for parameter in problem.twin.parameters])
    columns = [order.index(parameter.name) for parameter in problem.free]
    values[columns] = np.clip(mean[: len(columns)], *problem.bounds)
    return values, columns


def _interval_after(problem: Problem, known: Prior, situation: Situation, move: Move) -> Array:
    """Return the half-width (free,) of each 95 % interval after ``move``.

    The initial state is estimated as well; trends are not, and what is unknown of them widens the intervals.
    """
    twin, kernel, free = problem.twin, kernel_of(problem.twin), len(problem.free)
    parameters, columns = _parameter_values(problem, known.mean)
    grid = _grid(situation, len(move.inputs))
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = kernel.sensitivities(parameters, situation.state, Excitation(move.inputs, grid, SUBSTEPS)).slopes
        base = len(twin.parameters) - twin.settings
        columns += range(base, base + len(twin.states))
        jacobian = (slopes[:, :, columns] / np.array(problem.noise)[None, :, None]).reshape(-1, len(columns))
        information = jacobian.T @ jacobian
    deviations = known.sd[:free]
    if not np.isfinite(information).all():
        return QUANTILE * deviations
    prior = np.zeros(information.shape)
    scaled = known.covariance[:free, :free] / np.outer(deviations, deviations)
    prior[:free, :free] = np.linalg.inv(scaled + REGULARISATION * np.eye(free)) / np.outer(deviations, deviations)
    total = information + prior
    size = np.sqrt(np.maximum(np.diag(total), REGULARISATION))
    covariance = np.linalg.pinv(total / np.outer(size, size), hermitian=True) / np.outer(size, size)
    drift = 0.5 * grid.length * known.sd[free:]  # from the middle of the window to its end
    reach: Array = QUANTILE * np.sqrt(np.maximum(np.diag(covariance)[:free], 0.0) + drift**2)
    return np.minimum(reach, QUANTILE * deviations)


def _distance(first: TrackedHypothesis, second: TrackedHypothesis, situation: Situation, move: Move) -> float:
    """Return χ² between the predictions after fitting ``first`` to the prediction of ``second``."""
    noise = np.array(first.problem.noise)
    prior = first.posterior.prior()
    own, slopes = _prediction(first.problem, prior, situation, move)
    other, _ = _prediction(second.problem, second.posterior.prior(), situation, move)
    difference = ((own - other) / noise).ravel()
    weighted = (slopes / noise[None, :, None]).reshape(len(difference), -1)
    if not (np.isfinite(difference).all() and np.isfinite(weighted).all()):
        return 0.0
    free, states = len(first.problem.free), len(first.problem.base_model.states)
    allowed = np.sqrt(np.maximum(np.diag(prior.covariance)[:free], 0.0))
    rows = np.vstack([weighted, np.diag(np.concatenate([1.0 / np.maximum(allowed, 1e-30), np.zeros(states)]))])
    target = np.concatenate([difference, np.zeros(free + states)])
    with np.errstate(over="ignore"):
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-30)
        if not np.isfinite(size).all():
            return 0.0
        solution, *_ = np.linalg.lstsq(rows / size, target, rcond=None)
        remainder = target - rows / size @ solution
        distance = float(remainder @ remainder)
    return distance if np.isfinite(distance) else 0.0


def _prediction(problem: Problem, known: Prior, situation: Situation, move: Move) -> tuple[Array, Array]:
    """Return the prediction (records, outputs) and its derivatives (records, outputs, free + states)."""
    twin, base = problem.twin, problem.base_model
    parameters, columns = _parameter_values(problem, known.mean)
    records, own = len(move.inputs), len(base.inputs)
    grid = _grid(situation, records)
    inputs = np.zeros((records, len(twin.inputs)))
    inputs[:, :own] = move.inputs[:, :own]
    for column, source in enumerate(twin.inputs):
        if source.name == ELAPSED:
            inputs[:, column] = grid.offsets
    states = len(base.states)
    initial = np.zeros(len(twin.states))
    initial[:states] = situation.state[:states]
    with np.errstate(over="ignore", invalid="ignore"):
        prediction = kernel_of(twin).sensitivities(parameters, initial, Excitation(inputs, grid, SUBSTEPS))
    first_state = len(twin.parameters) - twin.settings
    return prediction.outputs, prediction.slopes[:, :, [*columns, *range(first_state, first_state + states)]]
