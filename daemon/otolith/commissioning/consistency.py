"""Whether windows of one healthy machine agree: do they scatter about their common parameters as much as they claim?

White process noise, fitted to fast innovations, misses an error of the twin that is slow against the records. Each
window then claims to know more than it does, and only other windows can tell.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.commissioning.likelihood import Fit, Likelihood
from otolith.estimation.arrival_cost import eliminate_states
from otolith.twin.definition import Definition

SEEN = 2.0  # a window sees a direction in which it knows that many times more than the bounds of the parameters say
CHANCE = 0.05  # probability of a scatter beyond which it is no longer called chance
MOST = 1e4  # by which process noise is inflated at most
STEP = 2.0  # from one factor to the next until they enclose the right one
CLOSE = 0.01  # of the factor's logarithm


@dataclass(frozen=True, slots=True)
class Agreement:
    """Of windows with each other."""

    reduced: float
    """Chi-square of the windows about their common weighted mean, per degree of freedom; one if all is well."""
    degrees: int
    """How many numbers the windows compare; none if each sees something else."""

    @property
    def by_chance(self) -> bool:
        """Whether a scatter like this happens to honest windows."""
        if not self.degrees:
            return True
        from scipy.special import chdtri  # noqa: PLC0415 - SciPy is loaded by those who learn noise only

        return bool(self.reduced <= chdtri(self.degrees, CHANCE) / self.degrees)


def consistency_test(fits: Sequence[Fit], width: Array) -> Agreement:
    """Of ``fits``, with ``width`` (guess,) as in :class:`Likelihood`."""
    free = fits[0].objective.free
    rows = [root(fit, width) for fit in fits]
    roots = np.vstack(rows)
    if not len(roots):
        return Agreement(float("nan"), 0)
    told = np.concatenate([row @ (fit.guess[:free] / width[:free]) for row, fit in zip(rows, fits, strict=True)])
    common, _, rank, _ = np.linalg.lstsq(roots, told, rcond=None)
    degrees = len(roots) - int(rank)
    off = roots @ common - told
    return Agreement(float(off @ off) / degrees if degrees else float("nan"), degrees)


def root(fit: Fit, width: Array) -> Array:
    """(seen, free) square root of the information about the parameters, in shares of ``width``, as far as it is seen.

    The initial state is eliminated; residuals beyond the noise make the window say less.
    """
    free = fit.objective.free
    scaled = fit.found.jacobian * width
    _, singular, rows = np.linalg.svd(eliminate_states(scaled[:, :free], scaled[:, free:]), full_matrices=False)
    singular = singular / max(fit.cost, 1.0)
    seen = singular > SEEN
    return np.asarray(singular[seen, None] * rows[seen])


@dataclass(frozen=True, slots=True, eq=False)
class Inflated:
    """What a factor on process noise makes of windows."""

    factor: float
    fits: list[Fit]
    reached: Agreement


def inflated(likelihood: Likelihood, levels: Callable[[float], Array], fits: Sequence[Fit]) -> Inflated:
    """The factor on process noise that makes ``fits`` agree, or the last one tried if none does.

    ``levels`` gives the levels of noise (outputs + states,) for a factor.
    """
    from scipy.optimize import brentq  # noqa: PLC0415 - as above

    tried = {0.0: Inflated(1.0, list(fits), consistency_test(fits, likelihood.width))}

    def excess(logarithm: float) -> float:
        if logarithm not in tried:
            factor = float(np.exp(logarithm))
            refitted = likelihood.refitted(levels(factor), list(tried.values())[-1].fits)
            tried[logarithm] = Inflated(factor, refitted, consistency_test(refitted, likelihood.width))
        reached = tried[logarithm].reached
        return float(np.log(reached.reduced)) if reached.degrees else -1.0

    low, high = 0.0, float(np.log(STEP))
    while excess(high) > 0.0:
        if high > np.log(MOST):
            return tried[high]
        low, high = high, high + float(np.log(STEP))
    best = float(brentq(excess, low, high, xtol=CLOSE, rtol=CLOSE))
    excess(best)
    return tried[best]


def observable_states(twin: Definition) -> Mask:
    """(states,) those that an output shows, or an input drives, without another state in between."""
    definitions = {name: expression for name, expression, _ in twin.definitions}
    right = dict(twin.equations)

    def names(expression: str) -> set[str]:
        found = set(re.findall(r"[A-Za-z_]\w*", expression))
        return found.union(*(names(definitions[name]) for name in found & definitions.keys()))

    shown = set().union(*(names(right.get(entry.name, entry.name)) for entry in twin.outputs))
    inputs = {entry.name for entry in twin.inputs}
    return np.array([entry.name in shown or bool(names(right[f"der({entry.name})"]) & inputs) for entry in twin.states])
