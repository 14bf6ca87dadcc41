"""From what is known of a parameter to what is published of it: status with hysteresis, progress, reason."""

import math
from dataclasses import dataclass

from otolith.discovery.sequential_test import ACCEPTED, WindowDecision
from otolith.estimation.information import QUANTILE, Identifiability, ParameterEstimate
from otolith.health.schema import ParameterDocument, Status
from otolith.twin.definition import Parameter

CONTRIBUTES = 0.98  # of its variance must be left at most, if a window that does not pin a parameter estimates it
STILL_CONTRIBUTES = 0.995  # the same for a parameter that the window before estimated
STILL_DETERMINED = 2.0  # times the interval that is asked for: what a window may leave to one estimated before
INVALID_AFTER = 2  # windows in a row that contradict the twin
FORGOTTEN = 0.5  # of the width of the bounds: an interval this wide is no knowledge
HOUR = 3600.0


@dataclass(frozen=True, slots=True)
class MarginalPosterior:
    """What all windows together say of a parameter at the end of the last."""

    value: float
    sd: float
    trend: float
    """Per second."""
    trend_sd: float
    kept: float = 1.0
    """Share of its variance that this window left."""


@dataclass(frozen=True, slots=True)
class PreviousStatus:
    """What was said of a parameter last."""

    known: bool = False
    """Whether it has been determined."""
    status: Status = Status.UNESTIMATED


@dataclass(frozen=True, slots=True)
class WindowEvidence:
    """What a window brought."""

    estimate: ParameterEstimate | None = None
    """What it alone says; None for one that was not estimated from."""
    decision: WindowDecision = WindowDecision.BAD
    """What was made of it."""
    contradictions: int = 0
    """Windows in a row that contradict twin or belief, this one included."""
    variance_ratio: float = 1.0
    """How much more windows differ from each other than each of them says (variance)."""
    reason: str = ""
    """What there is to say of the window as a whole."""

    @property
    def at_bound(self) -> bool:
        """Whether the window wants a value beyond the bounds."""
        return self.estimate is not None and self.estimate.identifiability is Identifiability.AT_BOUND

    @property
    def taught(self) -> bool:
        """Whether what is known has changed by it."""
        return self.estimate is not None and self.decision in ACCEPTED


def publish(
    parameter: Parameter, allowed: float, fused: MarginalPosterior, heard: WindowEvidence, before: PreviousStatus
) -> tuple[PreviousStatus, ParameterDocument]:
    """What is said of a parameter, whose 95 % interval is to reach ``allowed`` to each side at most."""
    reach = QUANTILE * fused.sd
    width = parameter.high - parameter.low
    known = reach <= allowed or (before.known and reach <= FORGOTTEN * width)
    status = _status(known, allowed, fused, heard, before)
    estimate, reason = heard.estimate, heard.reason
    identifiability = None if estimate is None else estimate.identifiability
    if estimate is not None and (heard.taught or heard.at_bound):
        reason = "; ".join(filter(None, (estimate.reason, reason)))
    alone = estimate if estimate is not None and _says_something(estimate, width) else None
    value = min(max(fused.value, parameter.low), parameter.high)
    shown = known and math.isfinite(value + reach + HOUR * (fused.trend + fused.trend_sd))
    return PreviousStatus(known, status), ParameterDocument(
        value=value if shown else None,
        unit=parameter.unit,
        sd=fused.sd if shown else None,
        low=value - reach if shown else None,
        high=value + reach if shown else None,
        nominal=parameter.nominal,
        raw=None if alone is None else alone.value,
        raw_sd=None if alone is None else alone.sd * math.sqrt(heard.variance_ratio),
        trend_per_hour=HOUR * fused.trend if shown else None,
        trend_sd_per_hour=HOUR * fused.trend_sd if shown else None,
        status=status,
        progress=_progress(reach, allowed, width),
        identifiability=identifiability,
        reason=reason or _why(status),
    )


def _status(
    known: bool, allowed: float, fused: MarginalPosterior, heard: WindowEvidence, before: PreviousStatus
) -> Status:
    if heard.contradictions >= INVALID_AFTER and heard.decision in (WindowDecision.SUSPECTED, WindowDecision.REFUSED):
        return Status.INVALID
    estimate = heard.estimate
    if heard.at_bound:
        return Status.INVALID
    if not known:
        return Status.UNESTIMATED
    if not heard.taught or estimate is None:
        return Status.HELD
    if not before.known:
        return Status.ESTIMATED
    stays = before.status is Status.ESTIMATED
    pinned = QUANTILE * estimate.sd <= allowed * (STILL_DETERMINED if stays else 1.0)
    helped = fused.kept <= (STILL_CONTRIBUTES if stays else CONTRIBUTES)
    return Status.ESTIMATED if pinned or helped else Status.HELD


def _says_something(estimate: ParameterEstimate, width: float) -> bool:
    return math.isfinite(estimate.value) and QUANTILE * estimate.sd < width


def _progress(reach: float, allowed: float, width: float) -> float:
    """How far the interval has come from the bounds to what is asked for: 0 to 1, in orders of magnitude."""
    ignorance = QUANTILE * width / math.sqrt(12.0)
    if reach <= allowed:
        return 1.0
    if not math.isfinite(reach) or reach >= ignorance or allowed >= ignorance:
        return 0.0
    return math.log(ignorance / reach) / math.log(ignorance / allowed)


def _why(status: Status) -> str:
    if status is Status.HELD:
        return "this window adds nothing to what is known"
    return "no window has determined it yet" if status is Status.UNESTIMATED else ""
