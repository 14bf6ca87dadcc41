"""What is known of the machines as metrics of Prometheus, in its text format and by its conventions of names."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from otolith.health.limits import LEVELS, Level
from otolith.health.schema import CountersDocument, ReportDocument
from otolith.site.known import MAX_PARAMETERS, Knowledge, KnownMachine, RefusedFor
from otolith.site.outlets.runner import OutletStatus

CONTENT_TYPE = CONTENT_TYPE_LATEST
MACHINE = ("site", "machine")
PARAMETER = (*MACHINE, "parameter", "unit")
VALUES = {
    "value": "Estimate of a parameter.",
    "low": "Lower end of the 95 % interval of a parameter.",
    "high": "Upper end of the 95 % interval of a parameter.",
    "limit": "Limit of a parameter that is nearest to its healthy value.",
}


def exposition(knowledge: Knowledge, dropped: Mapping[str, int], outlets: Iterable[OutletStatus], now: float) -> bytes:
    """Return the metrics as text; a machine of which nothing is known has a state, and no values."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Source(knowledge, dropped, outlets, now))
    return generate_latest(registry)


class _Source:
    """What prometheus_client asks for metrics."""

    def __init__(
        self, knowledge: Knowledge, dropped: Mapping[str, int], outlets: Iterable[OutletStatus], now: float
    ) -> None:
        self._knowledge, self._dropped, self._outlets, self._now = knowledge, dropped, tuple(outlets), now

    def describe(self) -> Iterable[Metric]:
        """Return nothing: the names are not checked against other collectors."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics."""
        machines = list(self._knowledge)
        speaking = [(machine, machine.report) for machine in machines
                    if machine.report is not None and not machine.is_silent(self._now)]  # fmt: skip
        yield self._states(machines)
        yield _gauge("otolith_machine_up", "Whether reports of the machine come.", (
            (_own(machine), float(not machine.is_silent(self._now))) for machine in machines))  # fmt: skip
        yield _gauge("otolith_report_timestamp_seconds", "End of the window of the latest report, Unix time.", (
            (_own(machine), machine.report.window.end) for machine in machines if machine.report))  # fmt: skip
        yield _gauge("otolith_events_open", "Events that are not cleared.", (
            (_own(machine), float(len(report.open_events))) for machine, report in speaking))  # fmt: skip
        yield _gauge("otolith_report_latency_seconds", "From the end of a window to its report.", (
            (_own(machine), latency) for machine, report in speaking
            if (latency := report.cost.latency_s) is not None))  # fmt: skip
        yield _gauge("otolith_source_up", "Whether the connection to the machine is up.", (
            (_own(machine), float(report.driver.up)) for machine, report in speaking if report.driver))  # fmt: skip
        yield from _parameters(speaking)
        yield from _counters(speaking)
        for name, help_text, counts in (
            ("refused", "Documents that were refused.", dict.fromkeys(RefusedFor, 0) | self._knowledge.refused),
            ("dropped", "Documents that came faster than they could be read.", {"queue": 0} | dict(self._dropped)),
        ):
            metric = CounterMetricFamily(f"otolith_site_documents_{name}", help_text, labels=("reason",))
            for reason, count in sorted(Counter(counts).items()):
                metric.add_metric((str(reason),), float(count))
            yield metric
        yield from _outlets(self._outlets)

    def _states(self, machines: Iterable[KnownMachine]) -> Metric:
        metric = GaugeMetricFamily(
            "otolith_machine_state",
            "1 for the state that a machine is in, 0 for the others.",
            labels=(*MACHINE, "state"),
        )
        for machine in machines:
            state = machine.state(self._now)
            for level in LEVELS:
                if level is not Level.HINT:
                    metric.add_metric((*_own(machine), level.name.lower()), float(level is state))
        return metric


def _outlets(outlets: Iterable[OutletStatus]) -> Iterator[Metric]:
    up = GaugeMetricFamily("otolith_outlet_up", "Whether the last try of an outlet succeeded.", labels=("outlet",))
    rows = {name: CounterMetricFamily(f"otolith_outlet_{name}", text, labels=("outlet",)) for name, text in (
        ("failures", "Tries of an outlet that failed."), ("sent", "Notices of events that an outlet passed on."),
        ("lost", "Notices that were dropped: above the limit per hour, after a failure, or refused."))}  # fmt: skip
    for outlet in outlets:
        if outlet.is_tried:
            up.add_metric((outlet.name,), float(outlet.is_up))
        for name, metric in rows.items():
            metric.add_metric((outlet.name,), float(getattr(outlet, name)))
    yield from (up, *rows.values())


def _own(machine: KnownMachine) -> tuple[str, str]:
    return machine.site, machine.name


def _gauge(name: str, help_text: str, rows: Iterable[tuple[tuple[str, ...], float]]) -> Metric:
    metric = GaugeMetricFamily(name, help_text, labels=MACHINE)
    for labels, value in rows:
        metric.add_metric(labels, value)
    return metric


def _parameters(speaking: Iterable[tuple[KnownMachine, ReportDocument]]) -> Iterator[Metric]:
    rows = [((*_own(machine), name, row.unit), row)
            for machine, report in speaking
            for name, row in islice(report.parameters.items(), MAX_PARAMETERS)]  # fmt: skip
    for key, help_text in VALUES.items():
        metric = GaugeMetricFamily(f"otolith_parameter_{key}", help_text, labels=PARAMETER)
        for labels, row in rows:
            if (value := getattr(row, key)) is not None:
                metric.add_metric(labels, value)
        yield metric


def _counters(speaking: Iterable[tuple[KnownMachine, ReportDocument]]) -> Iterator[Metric]:
    rows = [(_own(machine), report.counters) for machine, report in speaking if report.counters is not None]
    for name in CountersDocument.model_fields:
        metric = CounterMetricFamily(
            f"otolith_daemon_{name}", f"Counter {name} of the daemon since its start.", labels=MACHINE
        )
        for labels, counters in rows:
            metric.add_metric(labels, float(getattr(counters, name)))
        yield metric
