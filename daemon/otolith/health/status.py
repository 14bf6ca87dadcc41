"""From what a window says about a parameter to what is published of it."""

import math
from dataclasses import dataclass

from otolith.adaptation.information import QUANTILE, Identifiability, ParameterEstimate
from otolith.health.report import ParameterDocument, Status
from otolith.twin.definition import Parameter


@dataclass(frozen=True, slots=True)
class Known:
    """The last value of a parameter that a window determined."""

    value: float
    sd: float


def publish(
    parameter: Parameter,
    estimate: ParameterEstimate | None,
    known: Known | None,
    reason: str = "",
    *,
    refused: bool = False,
) -> tuple[Known | None, ParameterDocument]:
    """What is known from now on, and what is said.

    ``estimate`` is None for a window that was not estimated from; ``refused`` is a window that contradicts the twin:
    nothing is learned from it.
    """
    identifiability = None if estimate is None else estimate.identifiability
    status = Status.UNESTIMATED if known is None else Status.HELD
    if estimate is not None:
        reason = estimate.reason or reason
        if refused or identifiability is Identifiability.AT_BOUND:
            status = Status.INVALID
        elif identifiability is Identifiability.DETERMINED and math.isfinite(abs(estimate.value) + 2 * estimate.sd):
            known, status = Known(estimate.value, estimate.sd), Status.ESTIMATED
    return known, ParameterDocument(
        value=None if known is None else known.value,
        unit=parameter.unit,
        sd=None if known is None else known.sd,
        low=None if known is None else known.value - QUANTILE * known.sd,
        high=None if known is None else known.value + QUANTILE * known.sd,
        nominal=parameter.nominal,
        raw=estimate.value if estimate is not None and math.isfinite(estimate.value) else None,
        status=status,
        identifiability=identifiability,
        reason=reason,
    )
