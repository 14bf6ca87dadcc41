"""What move of the machine would pin a parameter down: the experiment whose Fisher information says most.

(E. Walter, L. Pronzato, Identification of Parametric Models from Experimental Data, 1997, chapter 6.) Moves are steps
and swings of one input at a time, within its ordinary range, from where the machine is now.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.completion import plain
from otolith.adaptation.information import QUANTILE
from otolith.adaptation.prior import Prior
from otolith.adaptation.problem import Problem
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
        for column, entry in enumerate(plain(problem).inputs):
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
