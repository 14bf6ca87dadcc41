"""A history made of the reports and events of a machine that were received, for a report page without its database."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

from otolith.health.diagnosis import Rule
from otolith.health.limits import Level
from otolith.health.schema import EventDocument, Language, PartDocument, ReportDocument
from otolith.health.text import event_in, report_in
from otolith.publishing.html_report import html_report
from otolith.storage.history import HOUR, HistorySample, PartState


class ReceivedHistory:
    """What a report page reads. Between two reports nothing is known, so a state is that of the last one."""

    def __init__(
        self, site: str, machine: str, reports: Sequence[ReportDocument], events: Sequence[EventDocument],
        reader: tuple[Language | None, str | None] = (None, None),
    ) -> None:  # fmt: skip
        """``reports`` and ``events`` are the oldest first; ``reader`` has a language and a zone.

        By default they are those of the machine.
        """
        self.site, self.machine, self._reader = site, machine, reader
        self._reports = [report_in(row, *reader) for row in reports]
        self._events = [event_in(row, *reader) for row in events]

    def language_and_zone(self) -> tuple[Language | None, str | None]:
        """Return in which language and zone the page is; None if neither the reader nor the machine has one."""
        health = self._reports[-1].health if self._reports else None
        machine, zone = (None, None) if health is None else (health.language, health.timezone)
        return self._reader[0] or machine, self._reader[1] or zone

    def latest(self, count: int) -> list[ReportDocument]:
        """Return the last reports, the newest first."""
        return list(reversed(self._reports[-count:]))

    def states(self, since: float) -> list[PartState]:
        """Return the states of the parts in the order in which they were entered.

        Between two reports there may be others: a state was entered after the one without it.
        """
        known: dict[str, Level] = {}
        entered = []
        before = math.inf  # End of the report before
        for report in self._reports:
            parts: dict[str, PartDocument] = {"": report.health, **report.health.parts} if report.health else {}
            shown = {name: (part.state, part.since) for name, part in parts.items()}
            shown |= {name: (Level.OK, report.window.end) for name in known.keys() - shown.keys() if parts}
            for name, (state, begun) in shown.items():
                if known.get(name) is not state:
                    known[name] = state
                    first = min(max(before, begun), report.window.end)
                    entered.append(PartState(name, first, begun, state))
            before = report.window.end
        return [row for row in entered if row.entered >= since]

    def events(self, since: float) -> list[EventDocument]:
        """Return the changes of events since a time, in their order."""
        return [event for event in self._events if max(event.since, event.end or event.since) >= since]

    def findings(self, since: float) -> list[dict[str, Any]]:
        """Return the findings since a time: ``first``, ``last``, ``count`` of windows, and the latest document."""
        found: dict[str, dict[str, Any]] = {}
        for report in self._reports:
            for finding in report.findings if report.window.end >= since else ():
                before = found.get(finding.id, {"first": report.window.end, "count": 0})
                times = {"first": before["first"], "last": report.window.end, "count": before["count"] + 1}
                found[finding.id] = {**finding.model_dump(mode="json"), **times}
        return sorted(found.values(), key=lambda row: row["first"])

    def counters(self, since: float) -> list[dict[str, Any]]:
        """Return the last counters of each hour and start of the daemon since a time."""
        rows: dict[tuple[int, float], dict[str, Any]] = {}
        run, before = 0, -1
        for report in self._reports:
            if (counters := report.counters) is not None:
                run += counters.windows < before
                before, hour = counters.windows, report.window.end // HOUR * HOUR
                rows[run, hour] = {**counters.model_dump(), "hour": hour, "run": run}
        return [row for row in rows.values() if row["hour"] + HOUR >= since]

    def description(self) -> dict[str, Any]:
        """Return the limits that reports have; equations and meanings are in the database of the daemon only."""
        parameters = self._reports[-1].parameters.items() if self._reports else ()
        limits = {}
        for name, row in parameters:
            healthy = row.nominal if row.baseline is None else row.baseline
            if row.limit is not None:
                limits[name] = [(Level.ACT, row.limit, row.limit < healthy)]
        return {"limits": limits} if limits else {}

    def own_rules(self) -> tuple[Rule, ...]:
        """Return none: reports have the texts of such rules, and not the rules."""
        return ()

    def samples(self) -> Iterator[HistorySample]:
        """Yield the values of parameters and the amplitudes of components, in the order of time."""
        for report in self._reports:
            end, values = report.window.end, dict[str, tuple[float, float | None, float | None, str, str]]()
            for name, row in report.parameters.items():
                if row.value is not None:
                    values[name] = row.value, row.low, row.high, row.status, row.unit
            for component in report.components:
                own = component.values["amplitude"]
                values[component.id] = own.value, own.low, own.high, component.status, own.unit
            for name, (value, low, high, status, unit) in values.items():
                yield HistorySample(name, unit, end, 1, value, value, value, value, low, high, status)


def received_page(history: ReceivedHistory, since: float, now: float) -> str:
    """Return the report page of received reports from ``since`` to ``now``.

    Raises:
        ValueError: a document cannot be shown.
    """
    return html_report(history, history.samples(), "window", since, now)
