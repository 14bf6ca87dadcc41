"""What a window can tell about the parameters: Fisher information from the sensitivities of the prediction.

How a window's search ended, each outcome a sentence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array


class Outcome(StrEnum):
    """What came of swarm and polish."""

    CONTINUED = "the polish went on from what was known"
    AGREED = "swarm and polish came to the same point"
    SWARM_WAS_BETTER = "the swarm found a better valley than the one that was known"
    POLISH_WAS_BETTER = "the swarm found nothing better than what was known"
    AMBIGUOUS = "swarm and polish disagree: different parameters explain the window equally well"
    NOTHING_TO_FIND = "the window says too little to search in"
    UNFINISHED = "neither swarm nor polish came to rest: the result is the best so far"


QUANTILE = 1.959964  # of the standard normal distribution, two-sided 95 %
SINGULAR = 1e-8  # relative singular value under which a direction is not seen at all
BLIND = 1e-4  # share in an unseen direction beyond which a parameter is not seen either
FLAT = 1e-9  # a sensitivity this far under the largest is none
PUSHED = 2.0  # times the interval asked for: a wider one does not tell on which side of a bound the value lies
LONGEST_MEMORY = 0.25  # of a window: lags over which residuals are looked at for what they have in common
LASTING = 2.0  # long-run variance over variance from which on correlation is no chance
NOTICED = 1.1  # cost from which on it is looked at all: noise alone hardly gets there
TRADED = 0.95  # correlation beyond which two parameters cannot be told apart


class Identifiability(StrEnum):
    """What the window says about a parameter."""

    DETERMINED = "determined"
    WEAK = "weak"
    TRADED = "traded"
    FLAT = "flat"
    AT_BOUND = "at bound"


@dataclass(frozen=True, slots=True)
class Information:
    """Of one window, about every entry of a guess."""

    sd: Array
    """(guess,) standard deviation; infinite where the window says nothing."""
    correlation: Array
    """(guess, guess)."""


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """What one window says about one parameter."""

    name: str
    value: float
    sd: float
    """Standard deviation; infinite where the window says nothing."""
    identifiability: Identifiability
    reason: str


def information(jacobian: Array, width: Array, grown: float) -> Information:
    """Standard deviations (guess,) from the inverse of the Fisher information ``jacobian.T @ jacobian``.

    ``jacobian`` (residuals, guess) is of whitened residuals; ``width`` (guess,) scales the entries. Where the residuals
    are larger than the noise, standard deviations are ``grown`` (see :func:`inflation`).
    """
    scaled = jacobian * width
    norms = np.linalg.norm(scaled, axis=0)
    alive = norms > FLAT * max(float(norms.max(initial=0.0)), 1.0)
    sd = np.full(len(width), np.inf)
    correlation = np.eye(len(width))
    if alive.any():
        # By singular values of the sensitivities: the normal matrix would square the condition number.
        _, singular, rows = np.linalg.svd(scaled[:, alive] / norms[alive], full_matrices=False)
        seen = singular > SINGULAR * singular[0]
        inverse = rows[seen].T / singular[seen]
        covariance = inverse @ inverse.T
        deviation = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        blind = np.abs(rows[~seen]).max(axis=0, initial=0.0) > BLIND
        sd[alive] = np.where(blind, np.inf, deviation / norms[alive] * width[alive] * grown)
        correlation[np.ix_(alive, alive)] = np.where(
            np.outer(blind, blind), 1.0, covariance / np.outer(deviation, deviation)
        )
    return Information(sd, correlation)


def inflation(residuals: Array, cost: float) -> float:
    """By what standard deviations grow with what is left unexplained; ``residuals`` (records, outputs) are whitened.

    What is left beyond noise lasts from record to record, so it does not average out: its long-run variance counts
    (W. K. Newey, K. D. West, Econometrica 55, 1987), summed until the correlation ends. White residuals seem to be
    correlated by chance, always to the same side: as long as it is no more than that, their variance alone counts.
    """
    if cost <= NOTICED:
        return max(cost, 1.0)
    records = len(residuals)
    most = max(int(LONGEST_MEMORY * records), 1)
    long_run = cost**2
    for series in residuals.T:
        variances = np.array([series[lag:] @ series[: records - lag] for lag in range(most)]) / max(records, 1)
        ends = np.flatnonzero(variances <= 0.0)
        lasting = variances[1 : int(ends[0]) if len(ends) else most]
        told = float(variances[0] + 2.0 * lasting.sum())
        long_run = max(long_run, told if told > LASTING * variances[0] else float(variances[0]))
    return float(np.sqrt(long_run)) if np.isfinite(long_run) else float(cost)


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """What is asked of one parameter, and where its best value lies."""

    half_width: float
    """Of the 95 % interval: what a determined parameter may have at most."""
    unit: str
    at_bound: bool


def classify(
    found: Information, index: int, names: Sequence[str], wanted: AccuracyTarget
) -> tuple[Identifiability, str]:
    """The verdict on parameter ``index`` and what to say of it."""
    reach = QUANTILE * found.sd[index]
    if wanted.at_bound and reach <= PUSHED * wanted.half_width:
        return Identifiability.AT_BOUND, "the best value lies at the bound: widen the bounds or doubt the twin"
    if reach <= wanted.half_width:
        return Identifiability.DETERMINED, ""
    row = np.abs(found.correlation[index]).copy()
    row[index] = 0.0
    partner = int(row.argmax())
    if not np.isfinite(reach) and row[partner] <= TRADED:
        return Identifiability.FLAT, "the window does not depend on it"
    if row[partner] > TRADED:
        return Identifiability.TRADED, f"it can be traded with {names[partner]} (correlation {row[partner]:.3f})"
    return Identifiability.WEAK, f"the window pins it to ±{reach:.3g} {wanted.unit} only: too little excitation"
