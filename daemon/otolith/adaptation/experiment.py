"""What move of the machine would tell two explanations apart: the one whose answers would differ most.

(Discriminating between rival models: A. C. Atkinson, V. V. Fedorov, Biometrika 62, 1975.) What new numbers of the one
could still explain of the other's answer is taken out first.
"""

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.advice import ELSE, SUBSTEPS, Move, Situation, moves, numbers_at
from otolith.adaptation.completion import plain
from otolith.adaptation.fusion import overall
from otolith.adaptation.hypothesis import Hypothesis
from otolith.adaptation.screening import CLEARLY
from otolith.twin.kernel import Excitation, kernel_of
from otolith.twin.slots import ELAPSED

ENOUGH = 2.0 * CLEARLY  # in χ² between the answers: what would decide with some certainty
HIDDEN = "no move of one input tells them apart: look at the sensors and the machine itself"


def deciding(first: Hypothesis, second: Hypothesis, situation: Situation) -> str:
    """The smallest move that would tell ``first`` from ``second``, as a sentence."""
    for move in moves(first.problem, situation):
        if _distance(first, second, situation, move) >= ENOUGH:
            return f"{move.words} would tell{ELSE}"
    return HIDDEN


def _distance(first: Hypothesis, second: Hypothesis, situation: Situation, move: Move) -> float:
    noise = np.array(first.problem.noise)
    one, slopes = _answer(first, situation, move)
    two, _ = _answer(second, situation, move)
    difference = ((one - two) / noise).ravel()
    weighted = (slopes / noise[None, :, None]).reshape(len(difference), -1)
    if not (np.isfinite(difference).all() and np.isfinite(weighted).all()):
        return 0.0
    free, states = len(first.problem.free), len(plain(first.problem).states)
    known = overall(first.belief, first.problem).covariance
    allowed = np.sqrt(np.maximum(np.diag(known)[:free], 0.0))
    rows = np.vstack([weighted, np.diag(np.concatenate([1.0 / np.maximum(allowed, 1e-30), np.zeros(states)]))])
    wanted = np.concatenate([difference, np.zeros(free + states)])
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-30)
    found, *_ = np.linalg.lstsq(rows / size, wanted, rcond=None)
    left = wanted - rows / size @ found
    return float(left @ left)


def _answer(hypothesis: Hypothesis, situation: Situation, move: Move) -> tuple[Array, Array]:
    """(records, outputs), and its derivatives (records, outputs, free + states)."""
    problem, author = hypothesis.problem, plain(hypothesis.problem)
    twin = problem.twin
    parameters, places = numbers_at(problem, overall(hypothesis.belief, problem).mean)
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
