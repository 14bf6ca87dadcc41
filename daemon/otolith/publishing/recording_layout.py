"""What the viewer shows of a recording: a tab for the operator, one for the engineer, and their texts."""

import re

import rerun as rr
import rerun.blueprint as rrb

from otolith.acquisition.quality import time_text
from otolith.health.language import texts_in
from otolith.health.limits import Level, MonitoredQuantity
from otolith.health.schema import EventDocument, ReportDocument
from otolith.health.text import event_text, headline, probability_text, value_text
from otolith.machine import RecordedMachine

TIMELINE = "time"
MEASURED, TWIN, LIMIT = [90, 160, 255], [255, 140, 0], [150, 150, 150]  # colours, RGB
STATES = {
    Level.OK: [46, 125, 50],
    Level.NO_DATA: [110, 110, 110],
    Level.WATCH: [200, 140, 0],
    Level.ACT: [198, 40, 40],
}


def limit_lines(quantity: MonitoredQuantity) -> list[tuple[str, float, list[int]]]:
    """Return name, value and colour of the lines beside a parameter: its nominal value and its limits."""
    lines = [(f"nominal {quantity.nominal:.4g}", quantity.nominal, LIMIT)]
    return lines + [(f"{row.level} {row.value:.4g}", row.value, STATES[row.level]) for row in quantity.limits]


def operator_text(document: ReportDocument) -> str:
    """Return in Markdown the state, what is the matter, since when, how sure, and what to do."""
    health = document.health
    if health is None:
        return f"# {document.machine}\n\nno state yet"
    texts = texts_in(health.language)
    lines = [f"# {texts.translated(health.state)}\n{texts('since', time=time_text(health.since))}"]
    lines += [_paragraph(event) for event in document.events if event.end is None]
    if health.reason and len(lines) == 1:
        lines.append(_plain(health.reason))
    return "\n\n".join(lines)


def _paragraph(event: EventDocument) -> str:
    """Return what is the matter, since when, how sure, and what to do."""
    say = texts_in(event.language)
    sure = f" ({probability})" if (probability := probability_text(event)) else ""
    what = _plain(f"{say.translated(event.state)}: {say.translated(event.part)}: {event.condition}")
    what = f"**{what}**, {say('since', time=time_text(event.since))}"
    advice = f"**{_plain(event.advice)}**" if event.advice else ""
    return "  \n".join(filter(None, [what, _plain(f"{event.text}{sure}"), advice]))


def _plain(text: str) -> str:
    """Return text that is not Markdown, as ``N*m`` would be, in Markdown."""
    return re.sub(r"([\\`*_<>#|\[\]])", r"\\\1", text)


def report_text(document: ReportDocument) -> str:
    """Return the report as tables in Markdown."""
    rows = [f"# {document.machine} at {document.site}", ""]
    rows += [] if document.health is None else [headline(document.health), ""]
    rows += ["| parameter | value | status |", "|---|---|---|"]
    rows += [
        f"| {name} | {value_text(parameter)} | {parameter.status} {parameter.reason} |"
        for name, parameter in document.parameters.items()
    ]
    if document.components:
        rows += ["", "| component | equation | status |", "|---|---|---|"]
        rows += [f"| {row.meaning} | {row.equation} | {row.status} {row.approval} |" for row in document.components]
    rows += [f"\n{event_text(event)}" for event in document.events if event.end is None]
    return "\n".join(rows)


def blueprint(source: RecordedMachine) -> rrb.Blueprint:
    """Return the layout of the viewer."""
    return rrb.Blueprint(
        rrb.Tabs(_operator(source), _engineer(source), active_tab=0),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )


def _operator(source: RecordedMachine) -> rrb.Container:
    """The state in words and as lanes, each parameter with its limits over the whole recording, and the events."""
    whole = rrb.TimeAxis(
        link="Independent",
        view_range=rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()),
    )
    estimates = [
        rrb.TimeSeriesView(
            contents=[f"/parameters/{row.name}", f"/limits/{row.name}"],
            name=f"{row.meaning} {row.name} [{row.unit}] with 95 % interval, nominal value and limits",
            axis_x=whole,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )
        for row in source.parameters
    ]
    estimates.append(
        rrb.TimeSeriesView(origin="/components", name="what the twin lacked: amplitudes", axis_x=whole),
    )
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/operator", name=f"{source.title}: what matters now"),
            rrb.StateTimelineView(origin="/state", name="state over time", time_view=whole),
            column_shares=[1, 1],
        ),
        rrb.Grid(*estimates),
        rrb.TextLogView(origin="/events", name="events, on change only", columns=columns),
        row_shares=[5, 4, 2],
        name="state",
    )


def _engineer(source: RecordedMachine) -> rrb.Container:
    """Curves of signals and twin, residuals, the report and the log."""
    series, twin = rrb.TimeSeriesView, source.twin
    outputs = [
        series(origin=f"/signals/{row.name}", name=f"{row.meaning} [{row.unit}]: measured and twin")
        for row in twin.outputs
    ]
    inputs = [series(origin=f"/signals/{row.name}", name=f"{row.meaning} [{row.unit}]") for row in twin.inputs]
    residual = series(origin="/residual", name="root mean square of the residuals in units of the noise")
    texts = rrb.TextDocumentView(origin="/report", name="report"), rrb.TextLogView(origin="/log", name="log")
    return rrb.Horizontal(
        rrb.Vertical(*outputs, *inputs, residual), rrb.Vertical(*texts), column_shares=[3, 2], name="curves"
    )
