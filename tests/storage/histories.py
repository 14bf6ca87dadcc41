"""Reports for tests of the history: one parameter, an event and a component finding now and then."""

from collections.abc import Iterator

from otolith.acquisition.window import Verdict
from otolith.discovery.alternatives import WindowDecision
from otolith.health.limits import Level
from otolith.health.schema import (
    CountersDocument,
    EventChange,
    EventDocument,
    EvidenceDocument,
    FindingDocument,
    FindingKind,
    ParameterDocument,
    QualityDocument,
    ReportDocument,
    Severity,
    Status,
    WindowDocument,
)

SITE, MACHINE = "hall-1", "press-3"
START = 1_700_000_000.0  # Unix s
QUALITY = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)


def event(index: int, time: float, change: EventChange) -> EventDocument:
    return EventDocument(
        id=f"limit/R_a@{time}", part="winding", state=Level.WATCH, change=change, start=time, since=time,
        condition="short circuit between turns", text="R_a 6.1 ohm",
        evidence=EvidenceDocument(windows=(index, index)),
    )  # fmt: skip


def document(
    index: int, time: float, value: float | None = 6.5, *, length: float = 2.0, change: EventChange | None = None
) -> ReportDocument:
    """The report of a window that ends at ``time`` (Unix s)."""
    parameter = ParameterDocument(
        value=value, unit="ohm", nominal=6.5, status=Status.ESTIMATED,
        **({} if value is None else {"sd": 0.01, "low": value - 0.02, "high": value + 0.02}),
    )  # fmt: skip
    finding = FindingDocument(
        id="shaft/periodic/t", kind=FindingKind.COMPONENT, subject="shaft", severity=Severity.WARNING,
        condition="unbalanced shaft", text="new torque on the shaft", since=START,
    )  # fmt: skip
    return ReportDocument(
        machine=MACHINE, site=SITE, twin="dc_motor",
        window=WindowDocument(index=index, start=time - length, end=time, records=200, quality=QUALITY),
        decision=WindowDecision.LEARNED, parameters={"R_a": parameter}, findings=(finding,) if index % 2 else (),
        events=() if change is None else (event(index, time, change),),
        counters=CountersDocument(received=100 * index, windows=index),
    )  # fmt: skip


def documents(count: int, *, start: float = START, length: float = 2.0) -> Iterator[ReportDocument]:
    """Reports of windows one after the other; every hundredth raises an event."""
    for index in range(count):
        change = EventChange.RAISED if index % 100 == 50 else None
        yield document(index, start + (index + 1) * length, 6.5 + 1e-6 * index, length=length, change=change)
