"""What carries no weight: components that are hardly there (the paper's "deactivated"), explanations without content.

A window that was itself wrong, frozen for a part of it, say, may be explained by something that is not seen again.
Quiet windows after it tell for nobody, so evidence alone would never let go of such an explanation.
"""

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.completion import places
from otolith.adaptation.fusion import Belief, overall
from otolith.adaptation.problem import Problem

NOTICED = 4.0  # standard deviations: nearer to nothing, neither component nor change can be told from it


def weights(problem: Problem, belief: Belief) -> Array:
    """(components,) amplitudes of the components in the twin of ``problem``, in their standard deviations."""
    known = overall(belief, problem)
    deviations = np.sqrt(np.diag(known.covariance))
    amplitudes = [places(problem, slot)[0] for slot in range(len(problem.components))]
    return np.abs(known.mean[amplitudes]) / deviations[amplitudes]


def says_nothing(problem: Problem, belief: Belief, calm: Problem, before: Belief) -> bool:
    """Whether a twin with other components or other free parameters than ``calm`` is by now no different from it.

    Args:
        problem: with what may have appeared or moved.
        belief: of that.
        calm: as if nothing had happened.
        before: what is known of that.
    """
    more = weights(problem, belief)[len(calm.components) :]
    return bool((more < NOTICED).all() and (_shifts(problem, belief, calm, before) < NOTICED).all())


def _shifts(problem: Problem, belief: Belief, calm: Problem, before: Belief) -> Array:
    """(parameters,) how far the parameters that are free in ``problem`` are from ``calm``, in standard deviations."""
    own, other = overall(belief, problem), overall(before, calm)
    given = dict(calm.known)
    places_of = {entry.name: at for at, entry in enumerate(calm.free)}
    found = []
    for at, entry in enumerate(problem.free):
        if entry.name.startswith("_"):  # of a component
            continue
        where = places_of.get(entry.name)
        value, variance = (
            (given[entry.name], 0.0) if where is None else (other.mean[where], other.covariance[where, where])
        )
        found.append(abs(own.mean[at] - value) / np.sqrt(own.covariance[at, at] + variance))
    return np.array(found)
