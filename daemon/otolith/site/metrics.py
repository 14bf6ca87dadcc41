"""What is known of the machines as metrics of Prometheus, in its text format and by its conventions of names.

The lines of a machine are written once after each change of it; a scrape only puts them together.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

from otolith.health.limits import LEVELS, Level
from otolith.health.schema import CountersDocument
from otolith.site.known import MAX_MACHINES, MAX_PARAMETERS, KnownMachine, RefusedFor
from otolith.site.outlets.base import Machines, OutletStatus
from otolith.site.serving.counts import REASONS, Counts

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
GAUGES = {
    "otolith_machine_state": "1 for the state that a machine is in, 0 for the others.",
    "otolith_machine_up": "Whether reports of the machine come.",
    "otolith_report_timestamp_seconds": "End of the window of the latest report, Unix time.",
    "otolith_events_open": "Events that are not cleared.",
    "otolith_report_latency_seconds": "From the end of a window to its report.",
    "otolith_source_up": "Whether the connection to the machine is up.",
    "otolith_parameter_value": "Estimate of a parameter.",
    "otolith_parameter_low": "Lower end of the 95 % interval of a parameter.",
    "otolith_parameter_high": "Upper end of the 95 % interval of a parameter.",
    "otolith_parameter_limit": "Limit of a parameter that is nearest to its healthy value.",
}
VALUES = ("value", "low", "high", "limit")
COUNTERS = {f"otolith_daemon_{name}_total": name for name in CountersDocument.model_fields}
OUTLETS = {
    "failures": "Tries of an outlet that failed.",
    "sent": "Notices of events that an outlet passed on.",
    "lost": "Notices that were dropped: above the limit per hour, after a failure, or refused.",
}
STATES = tuple((level, level.name.lower()) for level in LEVELS if level is not Level.HINT)
ESCAPES = str.maketrans({"\\": r"\\", '"': r"\"", "\n": r"\n"})

Lines = dict[str, str]
"""Lines of a machine, by the name of their metric."""


class Metrics:
    """Writes metrics; the caller holds the lock of the knowledge."""

    def __init__(self, knowledge: Machines) -> None:
        self._knowledge = knowledge
        self._written: dict[tuple[str, str], tuple[object, Lines]] = {}  # With what they depend on

    def exposition(
        self, dropped: Mapping[str, int], outlets: Iterable[OutletStatus], now: float, hindered: Counts | None = None
    ) -> bytes:
        """Return the metrics as text; a machine of which nothing is known has a state, and no values."""
        machines, parts = [self._lines(machine, now) for machine in self._knowledge], list[str]()
        for name, text in GAUGES.items():
            parts += (_head(name, "gauge", text), *(lines[name] for lines in machines if name in lines))
        for name, counter in COUNTERS.items():
            parts.append(_head(name, "counter", f"Counter {counter} of the daemon since its start."))
            parts += (lines[name] for lines in machines if name in lines)
        refused = {each.value: self._knowledge.refused[each] for each in RefusedFor}
        parts += _counts("otolith_site_documents_refused_total", "Documents that were refused.", "reason", refused)
        text = "Documents that came faster than they could be read."
        parts += _counts("otolith_site_documents_dropped_total", text, "reason", {"queue": 0} | dict(dropped))
        for name, (text, reasons) in REASONS.items():
            counted = {each.value: 0 if hindered is None else hindered[each] for each in reasons}
            parts += _counts(name, text, "reason", counted)
        parts += _outlets(tuple(outlets))
        return "".join(parts).encode(errors="replace")

    def _lines(self, machine: KnownMachine, now: float) -> Lines:
        basis, key = (machine.revision, machine.is_silent(now)), (machine.site, machine.name)
        before = self._written.get(key)
        if before is None or before[0] != basis:
            if len(self._written) >= 2 * MAX_MACHINES:  # machines are forgotten, too
                self._written.clear()
            before = self._written[key] = basis, _written(machine, now)
        return before[1]


def _written(machine: KnownMachine, now: float) -> Lines:
    """Return the lines of a machine."""
    own, site = f'machine="{_escaped(machine.name)}"', f'site="{_escaped(machine.site)}"'
    report, state, is_silent = machine.report, machine.state(now), machine.is_silent(now)
    labels, rows = f"{{{own},{site}}}", dict[str, list[str]]()

    def add(name: str, value: float | None, where: str = labels) -> None:
        if value is not None:
            rows.setdefault(name, []).append(f"{name}{where} {_number(value)}\n")

    for level, word in STATES:
        add("otolith_machine_state", level is state, f'{{{own},{site},state="{word}"}}')
    add("otolith_machine_up", not is_silent)
    add("otolith_report_timestamp_seconds", report.window.end if report else None)
    if report is not None and not is_silent:
        add("otolith_events_open", len(report.open_events))
        add("otolith_report_latency_seconds", report.cost.latency_s)
        add("otolith_source_up", report.driver.up if report.driver else None)
        for parameter, row in islice(report.parameters.items(), MAX_PARAMETERS):
            where = f'{{{own},parameter="{_escaped(parameter)}",{site},unit="{_escaped(row.unit)}"}}'
            for value in VALUES:
                add(f"otolith_parameter_{value}", getattr(row, value), where)
        for name, counter in COUNTERS.items() if report.counters else ():
            add(name, getattr(report.counters, counter))
    return {name: "".join(lines) for name, lines in rows.items()}


def _outlets(outlets: tuple[OutletStatus, ...]) -> Iterator[str]:
    yield _head("otolith_outlet_up", "gauge", "Whether the last try of an outlet succeeded.")
    for outlet in outlets:
        if outlet.is_tried:
            yield f'otolith_outlet_up{{outlet="{_escaped(outlet.name)}"}} {_number(outlet.is_up)}\n'
    for name, text in OUTLETS.items():
        values = {outlet.name: getattr(outlet, name) for outlet in outlets}
        yield from _counts(f"otolith_outlet_{name}_total", text, "outlet", values)


def _counts(name: str, text: str, label: str, values: Mapping[str, int]) -> Iterator[str]:
    yield _head(name, "counter", text)
    for key, value in sorted(values.items()):
        yield f'{name}{{{label}="{_escaped(key)}"}} {_number(value)}\n'


def _head(name: str, kind: str, text: str) -> str:
    return f"# HELP {name} {text}\n# TYPE {name} {kind}\n"


def _escaped(text: str) -> str:
    """Return the value of a label."""
    return str(text).translate(ESCAPES)


def _number(value: float) -> str:
    if math.isfinite(value):
        return repr(float(value))
    return "NaN" if math.isnan(value) else "+Inf" if value > 0.0 else "-Inf"
