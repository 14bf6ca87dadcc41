"""What carries no weight: components that are hardly there (the paper's "deactivated"), explanations without content.

A window that was itself wrong, frozen for a part of it, say, may be explained by something that is not seen again.
Quiet windows after it tell for nobody, so evidence alone would never let go of such an explanation.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.claims import Reason
from otolith.adaptation.completion import places
from otolith.adaptation.fusion import Belief, overall
from otolith.adaptation.hypothesis import Hypothesis
from otolith.adaptation.problem import Problem
from otolith.adaptation.tracking import left_out

NOTICED = 4.0  # standard deviations: nearer to nothing, neither component nor change can be told from it
BETTER = 4.0  # in -2 log evidence, of one window: nearer to nothing, it told for nobody


def with_content(found: list[Hypothesis], deviances: list[float]) -> list[Hypothesis]:
    """Without those that say by now that nothing has happened, and explained the window no better than that."""
    at = next((at for at, entry in enumerate(found) if entry.reason is Reason.NOTHING), None)
    if at is None:
        return found
    calm = found[at]
    return [
        entry
        for entry, deviance in zip(found, deviances, strict=True)
        if entry is calm or deviance < deviances[at] - BETTER or not _says_nothing(entry, calm)
    ]


def pruned(entry: Hypothesis) -> Hypothesis:
    """Without components that do not carry their weight beside others (the paper's "deactivated")."""
    problem = entry.problem
    if len(problem.components) < 2:
        return entry
    carried_by = _weights(problem, entry.belief)
    weakest = int(np.argmin(carried_by))
    if carried_by[weakest] >= NOTICED:
        return entry
    problem, belief, turn = left_out(problem, entry.belief, entry.turned, weakest)
    claim = entry.claim
    if claim.reason in (Reason.COMPONENT, Reason.SENSOR):  # the others are not about what is in the twin
        claim = replace(claim, name=" and ".join(component.key for component in problem.components))
    return replace(entry, claim=claim, problem=problem, belief=belief, turned=turn)


def _weights(problem: Problem, belief: Belief) -> Array:
    """(components,) amplitudes of the components in the twin of ``problem``, in their standard deviations."""
    known = overall(belief, problem)
    deviations = np.sqrt(np.diag(known.covariance))
    amplitudes = [places(problem, slot)[0] for slot in range(len(problem.components))]
    return np.abs(known.mean[amplitudes]) / deviations[amplitudes]


def _says_nothing(entry: Hypothesis, calm: Hypothesis) -> bool:
    """Whether it is by now no different from ``calm``, in what it has added to the twin and in what it has freed."""
    known, together = ([component.key for component in each.problem.components] for each in (calm, entry))
    if together[: len(known)] != known:  # it says that one has gone
        return False
    more = _weights(entry.problem, entry.belief)[len(known) :]
    return bool((more < NOTICED).all() and (_shifts(entry, calm) < NOTICED).all())


def _shifts(entry: Hypothesis, calm: Hypothesis) -> Array:
    """(parameters,) how far its parameters, those of ``calm``, are from there, in standard deviations."""
    own, other = overall(entry.belief, entry.problem), overall(calm.belief, calm.problem)
    expected = {name: (value, 0.0) for name, value in calm.problem.known}
    for at, parameter in enumerate(calm.problem.free):
        expected[parameter.name] = float(other.mean[at]), float(other.covariance[at, at])
    found = []
    for at, parameter in enumerate(entry.problem.free):
        if parameter.name in expected:  # else of a component that it has added
            value, variance = expected[parameter.name]
            found.append(abs(own.mean[at] - value) / np.sqrt(own.covariance[at, at] + variance))
    return np.array(found)
