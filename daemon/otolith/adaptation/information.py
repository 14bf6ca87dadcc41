"""What a window can tell about the parameters: Fisher information from the sensitivities of the prediction."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.problem import Objective

RELATIVE_STEP = 1e-4  # of the width of the bounds, for the central difference
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


def information(objective: Objective, values: Array, cost: float) -> Information:
    """Standard deviations at ``values`` (guess,) from the inverse of the Fisher information.

    Residuals are in units of the noise; where they are larger than it (``cost`` above one), the standard deviations
    grow with them.
    """
    sensitivities = _sensitivities(objective, values)
    width = objective.high - objective.low
    scaled = sensitivities * width
    norms = np.linalg.norm(scaled, axis=0)
    alive = norms > FLAT * max(float(norms.max(initial=0.0)), 1.0)
    sd = np.full(len(values), np.inf)
    correlation = np.eye(len(values))
    if alive.any():
        covariance = np.linalg.pinv(scaled[:, alive].T @ scaled[:, alive], hermitian=True)
        deviation = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        sd[alive] = deviation * width[alive] * max(cost, 1.0)
        correlation[np.ix_(alive, alive)] = covariance / np.outer(deviation, deviation)
    return Information(sd, correlation)


def _sensitivities(objective: Objective, values: Array) -> Array:
    """(records * outputs, guess): change of the residuals per unit of each entry of the guess."""
    step = RELATIVE_STEP * (objective.high - objective.low)
    guesses = np.vstack([values + np.diag(step), values - np.diag(step)])
    residuals = objective.residuals(objective.predict(guesses)).reshape(2 * len(values), -1)
    change: Array = (residuals[: len(values)] - residuals[len(values) :]) / (2 * step[:, None])
    return np.nan_to_num(change, nan=0.0, posinf=0.0, neginf=0.0).T


def classify(
    found: Information, index: int, names: Sequence[str], *, half_width: float, at_bound: bool
) -> tuple[Identifiability, str]:
    """The verdict on parameter ``index``, and what to say of it; ``half_width`` is what its 95 % interval may have."""
    reach = 1.96 * found.sd[index]
    if at_bound:
        return Identifiability.AT_BOUND, "the best value lies at the bound: widen the bounds or doubt the twin"
    if not np.isfinite(reach):
        return Identifiability.FLAT, "the window does not depend on it"
    if reach <= half_width:
        return Identifiability.DETERMINED, ""
    row = np.abs(found.correlation[index]).copy()
    row[index] = 0.0
    partner = int(row.argmax())
    if row[partner] > TRADED:
        return Identifiability.TRADED, f"it can be traded with {names[partner]} (correlation {row[partner]:.3f})"
    return Identifiability.WEAK, f"the window pins it to ±{reach:.3g} only: too little excitation"
