"""What a window can tell about the parameters: Fisher information from the sensitivities of the prediction."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array

QUANTILE = 1.959964  # of the standard normal distribution, two-sided 95 %
SINGULAR = 1e-8  # relative singular value under which a direction is not seen at all
BLIND = 1e-4  # share in an unseen direction beyond which a parameter is not seen either
FLAT = 1e-9  # a sensitivity this far under the largest is none
TRADED = 0.98  # correlation beyond which two parameters cannot be told apart


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


def information(jacobian: Array, width: Array, cost: float) -> Information:
    """Standard deviations (guess,) from the inverse of the Fisher information ``jacobian.T @ jacobian``.

    ``jacobian`` (residuals, guess) is of whitened residuals; ``width`` (guess,) scales the entries. Where the residuals
    are larger than the noise (``cost`` above one), the standard deviations grow with them.
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
        sd[alive] = np.where(blind, np.inf, deviation / norms[alive] * width[alive] * max(cost, 1.0))
        correlation[np.ix_(alive, alive)] = np.where(
            np.outer(blind, blind), 1.0, covariance / np.outer(deviation, deviation)
        )
    return Information(sd, correlation)


def classify(
    found: Information, index: int, names: Sequence[str], *, half_width: float, at_bound: bool
) -> tuple[Identifiability, str]:
    """The verdict on parameter ``index``, and what to say of it; ``half_width`` is what its 95 % interval may have."""
    reach = QUANTILE * found.sd[index]
    if at_bound:
        return Identifiability.AT_BOUND, "the best value lies at the bound: widen the bounds or doubt the twin"
    if reach <= half_width:
        return Identifiability.DETERMINED, ""
    row = np.abs(found.correlation[index]).copy()
    row[index] = 0.0
    partner = int(row.argmax())
    if not np.isfinite(reach) and row[partner] <= TRADED:
        return Identifiability.FLAT, "the window does not depend on it"
    if row[partner] > TRADED:
        return Identifiability.TRADED, f"it can be traded with {names[partner]} (correlation {row[partner]:.3f})"
    return Identifiability.WEAK, f"the window pins it to ±{reach:.3g} only: too little excitation"
