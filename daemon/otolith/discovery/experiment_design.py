"""What move of the machine would pin a parameter down: the experiment whose Fisher information says most.

(E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data, 1997, chapter 6.) Moves are steps
and swings of one input at a time, within its ordinary range, from where the machine is now.

What move of the machine would tell two explanations apart: the one whose answers would differ most.

(Discriminating between rival models: A. C. Atkinson, V. V. Fedorov, Biometrika 62, 1975.) What new numbers of the one
could still explain of the other's answer is taken out first.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.candidates import CLEARLY
from otolith.discovery.hypotheses import TrackedHypothesis
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import base_model
from otolith.estimation.imm_filter import moment_match
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.twin.augmentation import ELAPSED
from otolith.twin.definition import Input
from otolith.twin.kernel import Excitation, kernel_of

SHARES = (0.1, 0.25, 0.5, 1.0)  # of the input's range, the smallest move that suffices is advised
RECORDS = 200  # at most, of a trial
WORTH = 0.5  # of the interval that is known: what a move must bring it down to, to be worth a word
SUBSTEPS = 4
TINY = 1e-12
ELSE = " if the other inputs stay as they are"


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """Where the machine is."""

    inputs: Array
    """(inputs,)."""
    state: Array
    """(states,)."""
    records: int
    sample_period: float
    """s."""


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """A trial of one input."""

    words: str
    inputs: Array
    """(records, inputs)."""


def advise(problem: Problem, known: Prior, situation: Situation, wanted: list[str]) -> dict[str, str]:
    """A sentence for each ``wanted`` parameter that some move would pin down, given what is ``known`` of all."""
    tried = list(moves(problem, situation))
    reaches = np.array([_reaches(problem, known, situation, move) for move in tried]).reshape(len(tried), -1)
    allowed = problem.determined_within * problem.scale
    deviations = QUANTILE * np.sqrt(np.diag(known.covariance))
    advice = {}
    for index, entry in enumerate(problem.free):
        if entry.name not in wanted or not tried:
            continue
        reach = reaches[:, index]
        enough = np.flatnonzero(reach <= allowed[index])
        best = int(enough[0]) if len(enough) else int(np.argmin(reach))
        if reach[best] <= WORTH * deviations[index]:
            advice[entry.name] = f"{tried[best].words} would pin it down to ±{reach[best]:.2g} {entry.unit}{ELSE}"
    return advice


def moves(problem: Problem, situation: Situation) -> Iterator[Move]:
    """Steps and swings of one input at a time, the smallest first."""
    records = min(situation.records, RECORDS)
    period = situation.records * situation.sample_period / records
    share = np.arange(records) / records
    for size in SHARES:
        for column, entry in enumerate(base_model(problem).inputs):
            here, there = _ends(entry, float(situation.inputs[column]), size)
            step = f"a step of {entry.name} from {here:.3g} to {there:.3g} {entry.unit}"
            swing = f"swinging {entry.name} between {here:.3g} and {there:.3g} {entry.unit}"
            swing += f" twice within {records * period:.3g} s"
            for words, curve in ((step, share >= 0.25), (swing, 0.5 - 0.5 * np.cos(4.0 * np.pi * share))):
                inputs = np.tile(situation.inputs, (records, 1))
                inputs[:, column] = here + (there - here) * curve
                yield Move(words, inputs)


def _ends(entry: Input, here: float, size: float) -> tuple[float, float]:
    """From where to where: towards the end of the range that is farther away."""
    reach = size * (entry.high - entry.low)
    there = here + reach if entry.high - here >= here - entry.low else here - reach
    return here, min(max(there, entry.low), entry.high)


def numbers_at(problem: Problem, mean: Array) -> tuple[Array, list[int]]:
    """All parameters of the twin (parameters,), the free ones as in ``mean`` (free, ...), and where those are."""
    order, given = [entry.name for entry in problem.twin.parameters], dict(problem.known)
    parameters = np.array([given.get(entry.name, entry.nominal) for entry in problem.twin.parameters])
    places = [order.index(entry.name) for entry in problem.free]
    parameters[places] = np.clip(mean[: len(places)], *problem.bounds)
    return parameters, places


def _reaches(problem: Problem, known: Prior, situation: Situation, move: Move) -> Array:
    """(free,) half of the 95 % interval of each parameter after ``move``; the initial state is estimated along."""
    twin, kernel, free = problem.twin, kernel_of(problem.twin), len(problem.free)
    parameters, columns = numbers_at(problem, known.mean)
    records = len(move.inputs)
    period = situation.records * situation.sample_period / records
    with np.errstate(over="ignore", invalid="ignore"):
        slopes = kernel.sensitivities(parameters, situation.state, Excitation(move.inputs, period, SUBSTEPS)).slopes
        base = len(twin.parameters) - twin.settings
        columns += range(base, base + len(twin.states))
        jacobian = (slopes[:, :, columns] / np.array(problem.noise)[None, :, None]).reshape(-1, len(columns))
        information = jacobian.T @ jacobian
    deviations = np.sqrt(np.diag(known.covariance)[:free])
    if not np.isfinite(information).all():
        return QUANTILE * deviations
    prior = np.zeros(information.shape)
    scaled = known.covariance[:free, :free] / np.outer(deviations, deviations)
    prior[:free, :free] = np.linalg.inv(scaled + TINY * np.eye(free)) / np.outer(deviations, deviations)
    whole = information + prior
    size = np.sqrt(np.maximum(np.diag(whole), TINY))
    covariance = np.linalg.pinv(whole / np.outer(size, size), hermitian=True) / np.outer(size, size)
    found: Array = QUANTILE * np.sqrt(np.maximum(np.diag(covariance)[:free], 0.0))
    return np.minimum(found, QUANTILE * deviations)


ENOUGH = 2.0 * CLEARLY  # in χ² between the answers: what would decide with some certainty
HIDDEN = "no move of one input tells them apart: look at the sensors and the machine itself"


def deciding_experiment(first: TrackedHypothesis, second: TrackedHypothesis, situation: Situation) -> str:
    """The smallest move that would tell ``first`` from ``second``, as a sentence."""
    for move in moves(first.problem, situation):
        if _distance(first, second, situation, move) >= ENOUGH:
            return f"{move.words} would tell{ELSE}"
    return HIDDEN


def _distance(first: TrackedHypothesis, second: TrackedHypothesis, situation: Situation, move: Move) -> float:
    noise = np.array(first.problem.noise)
    one, slopes = _answer(first, situation, move)
    two, _ = _answer(second, situation, move)
    difference = ((one - two) / noise).ravel()
    weighted = (slopes / noise[None, :, None]).reshape(len(difference), -1)
    if not (np.isfinite(difference).all() and np.isfinite(weighted).all()):
        return 0.0
    free, states = len(first.problem.free), len(base_model(first.problem).states)
    known = moment_match(first.belief, first.problem).covariance
    allowed = np.sqrt(np.maximum(np.diag(known)[:free], 0.0))
    rows = np.vstack([weighted, np.diag(np.concatenate([1.0 / np.maximum(allowed, 1e-30), np.zeros(states)]))])
    wanted = np.concatenate([difference, np.zeros(free + states)])
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-30)
    found, *_ = np.linalg.lstsq(rows / size, wanted, rcond=None)
    left = wanted - rows / size @ found
    return float(left @ left)


def _answer(hypothesis: TrackedHypothesis, situation: Situation, move: Move) -> tuple[Array, Array]:
    """(records, outputs), and its derivatives (records, outputs, free + states)."""
    problem, author = hypothesis.problem, base_model(hypothesis.problem)
    twin = problem.twin
    parameters, places = numbers_at(problem, moment_match(hypothesis.belief, problem).mean)
    records, own = len(move.inputs), len(author.inputs)
    period = situation.records * situation.sample_period / records
    inputs = np.zeros((records, len(twin.inputs)))
    inputs[:, :own] = move.inputs[:, :own]
    for column, entry in enumerate(twin.inputs):
        if entry.name == ELAPSED:
            inputs[:, column] = period * np.arange(records, dtype=np.float64)
    states = len(author.states)
    initial = np.zeros(len(twin.states))
    initial[:states] = situation.state[:states]
    with np.errstate(over="ignore", invalid="ignore"):
        found = kernel_of(twin).sensitivities(parameters, initial, Excitation(inputs, period, SUBSTEPS))
    base = len(twin.parameters) - twin.settings
    columns = [*places, *range(base, base + states)]
    return found.outputs, found.slopes[:, :, columns]
