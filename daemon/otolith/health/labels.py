"""Unix times as labels: what the clock of the computer says about times that were measured on a steady clock.

The core computes with *service time*, which only elapses: it never leaps, whatever sets the clock. A report leaves the
daemon with Unix times. If the clock turns out to have been wrong, the labels change, and service times stay.
:class:`Numbers` gives a report its sequence numbers, which rise whatever the clock says.
"""

from bisect import bisect_right
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

from otolith.health.limits import Level
from otolith.health.observations import CLOCK, DAEMON
from otolith.health.schema import (
    CrossingDocument,
    EventChange,
    EventDocument,
    EvidenceDocument,
    ForecastDocument,
    HealthDocument,
    Language,
    PerformanceDocument,
    ReportDocument,
)
from otolith.health.text import texts_in
from otolith.health.times import moment_text
from otolith_drivers.config_files import DocumentModel

CERTIFICATE, BASELINE = "certificate", "baseline"

# Thresholds: docs/reference/thresholds-health.md has the origin of each.
NUMBER_LEAP = 4000  # numbers skipped at a start: more than a daemon publishes without saving
MAX_SPANS = 200  # of different labels; of more, the two neighbours that differ least become one

Document = TypeVar("Document", bound=DocumentModel)
Span = tuple[float, float]  # Service time at which it begins, s, and Unix time minus service time from there on, s


@dataclass(frozen=True, slots=True)
class TimeLabels:
    """The Unix times of service times. Before the first span, both are the same."""

    spans: tuple[Span, ...] = ()  # Their begins rise

    @property
    def is_plausible(self) -> bool:
        """Whether the begins of the spans rise."""
        begins = [begin for begin, _ in self.spans]
        return len(begins) <= MAX_SPANS and all(before < after for before, after in pairwise(begins))

    def ahead(self, time: float) -> float:
        """Return the Unix time of a service time minus that time, s."""
        at = bisect_right(self.spans, time, key=lambda span: span[0])
        return self.spans[at - 1][1] if at else 0.0

    def unix(self, time: float) -> float:
        """Return the Unix time of a service time, s."""
        return time + self.ahead(time)

    def first(self, unix: float) -> float:
        """Return the earliest service time whose Unix time is ``unix`` or later."""
        reached = (max(begin, unix - ahead) for begin, end, ahead in self._pieces() if unix - ahead < end)
        return min(reached)

    def last(self, unix: float) -> float:
        """Return the latest service time whose Unix time is ``unix`` or earlier."""
        reached = (min(end, unix - ahead) for begin, end, ahead in self._pieces() if unix - ahead >= begin)
        return max(reached)

    def _pieces(self) -> list[tuple[float, float, float]]:
        """Return begin and end of each stretch of time with one label, and the Unix time minus the service time."""
        infinity = float("inf")
        spans = [(-infinity, 0.0), *self.spans, (infinity, 0.0)]
        return [(begin, end, ahead) for (begin, ahead), (end, _) in pairwise(spans) if begin < end]

    def since(self, time: float, ahead: float) -> "TimeLabels":
        """Return labels that are ``ahead`` s ahead from a service time on."""
        kept = [span for span in self.spans if span[0] < time]
        return TimeLabels(_bounded([*kept, (time, ahead)]))

    def shifted(self, since: float, by: float) -> "TimeLabels":
        """Return labels that are ``by`` s later from the service time ``since`` on, and those before as they are."""
        kept = [span for span in self.spans if span[0] < since]
        later = [(begin, ahead + by) for begin, ahead in self.spans if begin >= since]
        if not later or later[0][0] > since:
            later.insert(0, (since, self.ahead(since) + by))
        return TimeLabels(_bounded([*kept, *later]))

    def of_event(self, event: EventDocument) -> EventDocument:
        """Return an event with Unix times instead of service times."""
        notes = {
            name: _labelled(self, note, "at", "until")
            for name in ("acknowledged", "shelved")
            if (note := getattr(event, name)) is not None
        }
        if event.comments is not None:
            notes["comments"] = tuple(_labelled(self, note, "at") for note in event.comments)
        return _labelled(self, event, "start", "since", "end").model_copy(update=notes)

    def of_report(self, report: ReportDocument) -> ReportDocument:
        """Return a report with Unix times instead of service times."""
        if not self.spans:
            return report
        parameters = {
            name: item if item.forecast is None else item.model_copy(update={"forecast": self._forecast(item.forecast)})
            for name, item in report.parameters.items()
        }
        update = {
            "window": _labelled(self, report.window, "start", "end"),
            "parameters": parameters,
            "performance": report.performance and {name: self._figure(row) for name, row in report.performance.items()},
            "components": tuple(_labelled(self, item, "onset") for item in report.components),
            "findings": tuple(_labelled(self, item, "since") for item in report.findings),
            "events": tuple(map(self.of_event, report.events)),
            "health": report.health and self._health(report.health),
        }
        return report.model_copy(update=update)

    def _health(self, health: HealthDocument) -> HealthDocument:
        parts = {name: _labelled(self, part, "since", "shelved") for name, part in health.parts.items()}
        return _labelled(self, health, "since", "shelved").model_copy(update={"parts": parts})

    def _forecast(self, forecast: ForecastDocument) -> ForecastDocument:
        def crossing(item: CrossingDocument) -> CrossingDocument:
            return _labelled(self, item, "at", "low", "high")

        update = {
            "watch": forecast.watch and crossing(forecast.watch),
            "act": forecast.act and crossing(forecast.act),
            "figures": forecast.figures and {name: crossing(item) for name, item in forecast.figures.items()},
        }
        return _labelled(self, forecast, "computed").model_copy(update=update)

    def _figure(self, figure: PerformanceDocument) -> PerformanceDocument:
        if (own := figure.requirement) is None or own.lacks is None:
            return figure
        requirement = own.model_copy(update={"lacks": _labelled(self, own.lacks, "at", "low", "high")})
        return figure.model_copy(update={"requirement": requirement})


def _labelled(labels: TimeLabels, document: Document, *names: str) -> Document:
    """Return a document whose keys ``names`` have Unix times."""
    times = {name: getattr(document, name) for name in names}
    return document.model_copy(update={name: labels.unix(time) for name, time in times.items() if time is not None})


def _bounded(spans: list[Span]) -> tuple[Span, ...]:
    """Return spans without those that change nothing, and at most :data:`MAX_SPANS`."""
    distinct = [span for before, span in pairwise([(0.0, 0.0), *spans]) if span[1] != before[1]]
    while len(distinct) > MAX_SPANS:
        changes = [abs(after[1] - before[1]) for before, after in pairwise(distinct)]
        del distinct[1 + changes.index(min(changes))]
    return tuple(distinct)


def clock_event(time: float, by: float, window: int, language: Language) -> EventDocument:
    """Return the event that the clock was set ``by`` s, at a service time, before the window with this index."""
    text = texts_in(language)("clock_set", by=f"{by:+.0f}")
    evidence = EvidenceDocument(windows=(window, window), value=by, unit="s")
    return _noted(CLOCK, time, text, evidence, language)


def expiry_event(time: float, certificate: str, end: float, window: int, language: Language) -> EventDocument:
    """Return the event that a ``certificate`` of the daemon expires at ``end`` (Unix s), at a service time."""
    text = texts_in(language)("certificate_expires", certificate=certificate, end=moment_text(end, "UTC")[:10])
    event = _noted(CERTIFICATE, time, text, EvidenceDocument(windows=(window, window)), language)
    return event.model_copy(update={"id": f"{CERTIFICATE}/{end:.0f}@{time:.1f}", "part": DAEMON})


def baseline_event(time: float, text: str, window: int, language: Language) -> EventDocument:
    """Return the hint that baselines wait for other values, at a service time."""
    event = _noted(BASELINE, time, text, EvidenceDocument(windows=(window, window)), language)
    return event.model_copy(update={"part": DAEMON, "state": Level.HINT})


def expiry_notices(events: Iterable[EventDocument]) -> dict[float, float]:
    """Return when :func:`expiry_event` was last given, by the end of the certificate; all in Unix seconds."""
    notices: dict[float, float] = {}
    for event in events:
        if event.condition_id == CERTIFICATE:
            with suppress(ValueError):  # an earlier version gave no end
                notices[float(event.id.rpartition("@")[0].removeprefix(f"{CERTIFICATE}/"))] = event.start
    return notices


def _noted(key: str, time: float, text: str, evidence: EvidenceDocument, language: Language) -> EventDocument:
    """Return what happened at one moment."""
    return EventDocument(
        id=f"{key}@{time:.1f}", part=key, state=Level.OK, change=EventChange.NOTED,
        start=time, since=time, end=time, condition=text, condition_id=key, text=text, language=language,
        evidence=evidence,
    )  # fmt: skip


class Numbers:
    """The sequence numbers of a machine: they rise, also over restarts, whatever was not saved before."""

    def __init__(self, now: float, report: int | None = None, event: int | None = None, start: int = 0) -> None:
        """``report`` and ``event`` are the newest numbers in the history, ``start`` where the last daemon began.

        A daemon that was killed may have published numbers that are not in the history, or the history may be lost. So
        the first number is that of the Unix time ``now`` in ms, and far above the numbers in the history.
        """
        self._report, self._event = report, event
        self.start = max(max(report or 0, event or 0, start) + NUMBER_LEAP, int(now * 1e3))
        self._next = self.start

    def number(self, document: ReportDocument) -> ReportDocument:
        """Return the report with its sequence numbers, and those of the events that it changed."""
        numbers, self._report = {"sequence": self._take(), "previous": self._report}, self._next - 1
        events = tuple(event if event.change is None else self._numbered(event) for event in document.events)
        return document.model_copy(update={**numbers, "events": events})

    def _numbered(self, event: EventDocument) -> EventDocument:
        numbers, self._event = {"sequence": self._take(), "previous": self._event}, self._next - 1
        return event.model_copy(update=numbers)

    def _take(self) -> int:
        self._next += 1
        return self._next - 1
