"""The published status of a parameter: from what is known to value, interval, status with hysteresis, and reason.

A source that is down or silent is named in the reason. The connection to the machine has a document of its own.
"""

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass

from otolith.acquisition.window import Window
from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.estimation.information import (
    QUANTILE,
    WIDEN_BOUNDS,
    Identifiability,
    ParameterEstimate,
    at_its_bound,
)
from otolith.estimation.window_fit import AT_BOUND
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.schema import (
    DriverDocument,
    KeptDocument,
    LackDocument,
    ParameterDocument,
    PerformanceDocument,
    ReportDocument,
    RequirementDocument,
    SourceDocument,
    Status,
)
from otolith.simulation.performance import FigureValue, ReferenceValues
from otolith.twin.definition import Parameter
from otolith_drivers.base import Link

MAX_VARIANCE_LEFT = 0.98  # share of the variance that a window may leave and still count as estimating the parameter
MAX_VARIANCE_LEFT_AFTER = 0.995  # the same for a parameter that the window before estimated
REQUIRED_FACTOR_AFTER = 2.0  # times the required interval: what a window may leave to one estimated before
INVALID_AFTER = 2  # consecutive windows that contradict the twin
FORGOTTEN = 0.5  # share of the width of the bounds: a half-width beyond which nothing is known any more
HOUR = 3600.0  # s


@dataclass(frozen=True, slots=True)
class MarginalPosterior:
    """The estimate of a parameter from all windows, at the end of the last one."""

    value: float
    sd: float
    trend: float  # Per second
    trend_sd: float
    variance_left: float = 1.0  # Share of the variance before the window that is left after it


@dataclass(frozen=True, slots=True)
class PreviousStatus:
    """The status of a parameter in the report before."""

    known: bool = False  # Whether it has been determined
    status: Status = Status.UNESTIMATED


def some_parameter_is_determined(previous: Mapping[str, PreviousStatus]) -> bool:
    """Whether any parameter has been determined, by the status of each in the report before."""
    return any(status.known for status in previous.values())


@dataclass(frozen=True, slots=True)
class WindowEvidence:
    """What one window adds about a parameter."""

    estimate: ParameterEstimate | None = None  # None for a window that was not estimated from
    decision: WindowDecision = WindowDecision.BAD
    contradictions: int = 0  # Windows in a row, with this one, that did not update the posterior; no bad data
    variance_ratio: float = 1.0  # Variance between windows over the variance that they state
    is_mixture: bool = False  # Whether what is known is the mixture of several hypotheses
    is_explained: bool = True  # Whether the best of these explains the window up to the noise
    reason: str = ""  # About the window as a whole

    @property
    def at_bound(self) -> bool:
        """Whether the best value of the window lies at a bound."""
        return self.estimate is not None and self.estimate.identifiability is Identifiability.AT_BOUND

    @property
    def accepted(self) -> bool:
        """Whether the window updated the posterior."""
        return self.estimate is not None and self.decision in ACCEPTED


def publish(
    parameter: Parameter, required: float, known_now: MarginalPosterior, window: WindowEvidence, before: PreviousStatus
) -> tuple[PreviousStatus, ParameterDocument]:
    """Return status and document of a parameter; ``required`` is the half-width of a determined 95 % interval."""
    reach = QUANTILE * known_now.sd
    width = parameter.high - parameter.low
    known = reach <= required or (before.known and reach <= FORGOTTEN * width)
    value = min(max(known_now.value, parameter.low), parameter.high)
    at_bound = known and min(value - parameter.low, parameter.high - value) <= AT_BOUND * width
    status = Status.INVALID if at_bound else _status(known_now, window, before, known=known, required=required)
    estimate, reason = window.estimate, window.reason
    if at_bound and not window.at_bound:
        reason = "; ".join(filter(None, (at_its_bound(value, parameter.unit), reason)))
    elif estimate is not None and (window.accepted or (window.at_bound and status is Status.INVALID)):
        reason = "; ".join(filter(None, (estimate.reason, reason)))
    identifiability = None if estimate is None else estimate.identifiability
    alone = estimate if estimate is not None and _is_informative(estimate, width) else None
    shown = known and math.isfinite(value + reach + HOUR * (known_now.trend + known_now.trend_sd))
    return PreviousStatus(known, status), ParameterDocument(
        value=value if shown else None,
        unit=parameter.unit,
        sd=known_now.sd if shown else None,
        low=max(value - reach, 0.0 if parameter.low >= 0.0 else -math.inf) if shown else None,
        high=value + reach if shown else None,
        nominal=parameter.nominal,
        raw=None if alone is None else alone.value,
        raw_sd=None if alone is None else alone.sd * math.sqrt(window.variance_ratio),
        trend_per_hour=HOUR * known_now.trend if shown else None,
        trend_sd_per_hour=HOUR * known_now.trend_sd if shown else None,
        status=status,
        progress=_progress(reach, required, width),
        identifiability=Identifiability.AT_BOUND if at_bound else identifiability,
        reason=reason or _default_reason(status),
    )


def without_traded_at_a_bound(
    documents: Mapping[str, ParameterDocument], estimates: Iterable[ParameterEstimate]
) -> dict[str, ParameterDocument]:
    """Return the documents; what the window trades with a parameter at its bound is invalid.

    What the other parameter lacks beyond its bound is then part of this one, which the interval does not show.
    """
    at_bound = {
        name
        for name, item in documents.items()
        if item.status is Status.INVALID and item.identifiability is Identifiability.AT_BOUND
    }
    result = dict(documents)
    for item in estimates:
        names = ", ".join(name for name in item.traded_with if name in at_bound)
        is_shown = item.name in result and result[item.name].status in (Status.ESTIMATED, Status.HELD)
        if names and is_shown and item.identifiability is Identifiability.TRADED:
            changes = {
                "status": Status.INVALID,
                "reason": f"it can be traded with {names} at its bound: {WIDEN_BOUNDS}",
            }
            result[item.name] = result[item.name].model_copy(update=changes)
    return result


def _status(
    known_now: MarginalPosterior, window: WindowEvidence, before: PreviousStatus, *, known: bool, required: float
) -> Status:
    refused = window.decision is WindowDecision.REFUSED
    is_agreed = window.is_mixture and window.is_explained and QUANTILE * known_now.sd <= required
    # A bound that only the twin alone reaches does not count where the hypotheses that explain the window agree.
    if (window.contradictions >= INVALID_AFTER and refused) or (window.at_bound and not is_agreed):
        return Status.INVALID
    if not known:
        return Status.UNESTIMATED
    if window.is_mixture:
        return Status.ESTIMATED if is_agreed else Status.AMBIGUOUS
    if not window.accepted or window.estimate is None:
        return Status.HELD
    if not before.known:
        return Status.ESTIMATED
    stays = before.status is Status.ESTIMATED
    determined = QUANTILE * window.estimate.sd <= required * (REQUIRED_FACTOR_AFTER if stays else 1.0)
    contributes = known_now.variance_left <= (MAX_VARIANCE_LEFT_AFTER if stays else MAX_VARIANCE_LEFT)
    return Status.ESTIMATED if determined or contributes else Status.HELD


def _is_informative(estimate: ParameterEstimate, width: float) -> bool:
    return math.isfinite(estimate.value) and QUANTILE * estimate.sd < width


def _progress(reach: float, required: float, width: float) -> float:
    """Return how far the interval has come from the bounds to what is required: 0 to 1, in orders of magnitude."""
    uninformed = QUANTILE * width / math.sqrt(12.0)
    if reach <= required:
        return 1.0
    if not math.isfinite(reach) or reach >= uninformed or required >= uninformed:
        return 0.0
    return math.log(uninformed / reach) / math.log(uninformed / required)


def _default_reason(status: Status) -> str:
    if status is Status.HELD:
        return "this window adds nothing to what is known"
    return "no window has determined it yet" if status is Status.UNESTIMATED else ""


def driver_document(link: Link) -> DriverDocument:
    """Return the document of a connection."""
    sources = {
        state.name: SourceDocument(
            signals=state.signals,
            up=state.link.up,
            reason=state.link.reason,
            warnings=state.link.warnings,
            **asdict(state.counters),
        )
        for state in link.sources
    }
    return DriverDocument(up=link.up, reason=link.reason, warnings=link.warnings, plan=link.plan, sources=sources)


def absent_sources(link: Link, window: Window, outputs: Collection[str]) -> dict[str, str]:
    """Return by name which of several sources are down or gave no sample in the window, or have a defect, in words.

    A source that only has commands may be silent: none of them has changed.
    """
    absent = {}
    for state in link.sources:
        is_expected = bool(state.link.warnings) or not set(state.signals).isdisjoint(outputs)
        what = f"source {state.name!r} ({', '.join(state.signals)})"
        if not state.link.up:
            absent[state.name] = f"{what} is down: {state.link.reason}"
        elif is_expected and all(window.missing_in(name).all() for name in state.signals if name in window.signals):
            silent = f"is silent: {state.link.warnings[0]}" if state.link.warnings else "sent nothing in this window"
            absent[state.name] = f"{what} {silent}"
        elif state.link.defect:
            absent[state.name] = f"{what} is defective: {state.link.defect}"
    return absent


def with_absent_sources(
    parameters: Mapping[str, ParameterDocument], absent: Mapping[str, str] | None
) -> dict[str, ParameterDocument]:
    """Return ``parameters``; each that this window did not estimate names the absent sources in its reason."""
    return {
        name: parameter
        if parameter.status is Status.ESTIMATED or not absent
        else parameter.model_copy(update={"reason": "; ".join([*absent.values(), parameter.reason])})
        for name, parameter in parameters.items()
    }


NO_LACK = "the trend does not lead to the required value"
NOT_KNOWN = "not determined yet: {}"  # Parameters on which a figure of performance depends


def reference_values(
    plan: Mapping[str, MonitoredQuantity], documents: Mapping[str, ParameterDocument], observed: Mapping[str, float]
) -> dict[str, ReferenceValues]:
    """Return healthy values and ACT limits of parameters as they would be at the present temperature."""
    found = {}
    for name, quantity in plan.items():
        referred = quantity.referred(1.0, 0.0, observed)
        if name not in documents or referred is None:
            continue
        healthy = None if quantity.is_example or (quantity.waiting and not quantity.has_baseline) else quantity.nominal
        limits = tuple(item.value / referred[0] for item in quantity.limits if item.level is Level.ACT)
        found[name] = ReferenceValues(None if healthy is None else healthy / referred[0], limits)
    return found


def publish_performance(
    values: Iterable[FigureValue], documents: Mapping[str, ParameterDocument]
) -> dict[str, PerformanceDocument] | None:
    """Return the documents of figures of performance, each as trustworthy as the parameters that it depends on."""
    return {item.figure.name: _performance_document(item, documents) for item in values} or None


def _performance_document(item: FigureValue, documents: Mapping[str, ParameterDocument]) -> PerformanceDocument:
    figure, value, sd = item.figure, item.value, item.sd
    status, reason = Status.ESTIMATED if value is not None else Status.UNESTIMATED, item.reason
    for worse in (Status.HELD, Status.AMBIGUOUS, Status.INVALID, Status.UNESTIMATED):
        names = [name for name in item.parameters if documents[name].status is worse]
        if names and value is not None:
            known = f"as {', '.join(names)}"
            status, reason = worse, NOT_KNOWN.format(", ".join(names)) if worse is Status.UNESTIMATED else known
    if status is Status.UNESTIMATED or value is None or sd is None:
        value = sd = None
    limit_unit = documents[item.limited].unit if item.limited else None
    is_known = value is not None
    document = PerformanceDocument(
        meaning=figure.meaning,
        value=value,
        unit=figure.unit,
        sd=sd,
        low=None if value is None or sd is None else value - QUANTILE * sd,
        high=None if value is None or sd is None else value + QUANTILE * sd,
        better=figure.better,
        at=dict(figure.at) or None,
        over="window" if item.is_mean else "point",
        status=status,
        reason=reason,
        parameters=item.parameters,
        baseline=item.healthy if is_known else None,
        at_limit=item.at_limit if is_known else None,
        limited=(item.limited or None) if is_known else None,
        limit=item.limit if is_known else None,
        limit_unit=limit_unit if is_known else None,
    )
    return document.model_copy(update={"requirement": _requirement(item, document, documents)})


def _requirement(
    item: FigureValue, document: PerformanceDocument, documents: Mapping[str, ParameterDocument]
) -> RequirementDocument | None:
    """Return whether a figure has its required value; None if nothing is required."""
    figure = item.figure
    if figure.required is None:
        return None
    low, high, baseline, at_limit = document.low, document.high, document.baseline, document.at_limit
    if low is None or high is None:
        return RequirementDocument(value=figure.required)
    kept = {
        name: KeptDocument(low=low, high=high, unit=documents[name].unit) for name, (low, high) in item.kept.items()
    }
    return RequirementDocument(
        value=figure.required,
        met=figure.meets(low) if figure.meets(low) == figure.meets(high) else None,
        met_at_baseline=None if baseline is None else figure.meets(baseline),
        met_at_limit=None if at_limit is None else figure.meets(at_limit),
        kept=kept or None,
    )


def required_limits(
    report: ReportDocument, plan: Mapping[str, MonitoredQuantity], name: str
) -> dict[str, tuple[Limit, ...]]:
    """Return where a parameter leads figures to their required values, by figure, at the reference temperature."""
    quantity, found = plan[name], {}
    for figure, row in (report.performance or {}).items():
        kept = ((row.requirement and row.requirement.kept) or {}).get(name)
        if kept is None:
            continue
        ends = ((kept.low, True), (kept.high, False))
        referred = [
            (quantity.referred(end, 0.0, report.window.observed or {}), below) for end, below in ends if end is not None
        ]
        found[figure] = tuple(Limit(Level.WATCH, end[0], below) for end, below in referred if end is not None)
    return {figure: limits for figure, limits in found.items() if limits}


def with_lacks(report: ReportDocument) -> ReportDocument:
    """Return the report; each figure that has its required value says from when on it will lack it.

    That is by the forecast of the parameter that leads there first. Otherwise it says of each parameter why not.
    """
    changed = {}
    for figure, row in (report.performance or {}).items():
        if (own := row.requirement) is None or own.met is False or row.value is None:
            continue
        first, reasons = None, []
        for name in row.parameters:
            if (forecast := report.parameters[name].forecast) is None:
                continue
            crossing = (forecast.figures or {}).get(figure)
            if crossing is None or crossing.at <= report.window.end:
                reasons.append(f"{name}: {forecast.reason or NO_LACK}")
            elif first is None or crossing.at < first.at:
                first = LackDocument(parameter=name, unit=report.parameters[name].unit, **dict(crossing))
        reason = "" if first is not None else "; ".join(reasons)
        requirement = own.model_copy(update={"lacks": first, "reason": reason})
        changed[figure] = row.model_copy(update={"requirement": requirement})
    return report.model_copy(update={"performance": {**(report.performance or {}), **changed}}) if changed else report
