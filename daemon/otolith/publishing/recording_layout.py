"""What the viewer shows of a recording: a tab for the operator, one for the engineer, and their texts."""

import math
import re

import rerun as rr
import rerun.blueprint as rrb

from otolith.health.language import Texts, texts_in
from otolith.health.limits import Level, MonitoredQuantity
from otolith.health.schema import EventDocument, ReportDocument
from otolith.health.text import event_text, headline, moment_text, number_text, probability_text, state_word, value_text
from otolith.machine import RecordedMachine
from otolith.twin.definition import Input, Output
from otolith_drivers.units import equation_text, unit_text

TIMELINE = "time"
NEAR_LIMITS = 3.0  # times the distance of the nearest limit from the nominal value, up to which others are shown
NEAR_VALUES = 2.0  # times the distance of the value from the nominal value, the same
MEASURED, TWIN, LIMIT = [90, 160, 255], [255, 140, 0], [150, 150, 150]  # colours, RGB
STATES = {
    Level.OK: [46, 125, 50],
    Level.NO_DATA: [110, 110, 110],
    Level.WATCH: [200, 140, 0],
    Level.ACT: [198, 40, 40],
}


def limit_lines(quantity: MonitoredQuantity, texts: Texts) -> list[tuple[str, float, list[int]]]:
    """Return name, value and colour of the lines beside a parameter: its nominal value and its limits."""
    rows = [("nominal", quantity.nominal, LIMIT)]
    rows += [(str(row.level), row.value, STATES[row.level]) for row in quantity.limits]
    return [(f"{texts.translated(name)} {number_text(value, 4)}", value, colour) for name, value, colour in rows]


def quantity_text(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit in brackets, if it has one."""
    return f"{name} [{symbol}]" if (symbol := unit_text(unit)) else name


def near_values(quantity: MonitoredQuantity, value: float) -> list[float]:
    """Return nominal value and limits of a parameter at ``value``; not a number for each that is too far to be shown.

    A limit far beyond the others would make the curve flat.
    """
    nominal, limits = quantity.nominal, [row.value for row in quantity.limits]
    nearest = min((abs(limit - nominal) for limit in limits), default=0.0)
    reach = max(NEAR_LIMITS * nearest, NEAR_VALUES * abs(value - nominal))
    return [nominal, *(limit if abs(limit - nominal) <= reach else math.nan for limit in limits)]


def operator_text(document: ReportDocument) -> str:
    """Return in Markdown the state, what is the matter, since when, how sure, and what to do."""
    health = document.health
    if health is None:
        return f"# {document.machine}"
    texts = texts_in(health.language)
    lines = [f"# {texts.translated(state_word(health))}\n{texts('since', time=moment_text(health.since))}"]
    lines += [_paragraph(event) for event in document.events if event.end is None]
    if len(lines) == 1:
        lines.append(_plain(health.reason or texts("all_well")))
    return "\n\n".join(lines)


def _paragraph(event: EventDocument) -> str:
    """Return what is the matter, since when, how sure, and what to do."""
    say = texts_in(event.language)
    sure = f" ({probability})" if (probability := probability_text(event)) else ""
    what = _plain(f"{say.translated(event.state)}: {say.translated(event.part)}: {event.condition}")
    what = f"## {what}\n{say('since', time=moment_text(event.since))}"
    advice = f"**{say('what_to_do')}: {_plain(event.advice)}**" if event.advice else ""
    return "  \n".join(filter(None, [what, advice, _plain(f"{event.text}{sure}")]))


def _plain(text: str) -> str:
    """Return text that is not Markdown, as ``N*m`` would be, in Markdown."""
    return re.sub(r"([\\`*_<>#|\[\]])", r"\\\1", text)


def report_text(document: ReportDocument) -> str:
    """Return the report as tables in Markdown."""
    texts = texts_in("en" if document.health is None else document.health.language)
    rows = [f"# {document.machine}, {document.site}", ""]
    rows += [] if document.health is None else [headline(document.health), ""]
    say, columns = texts.translated, "| {} | {} | {} |\n|---|---|---|"
    rows += [columns.format(say("parameter"), say("value"), say("status"))]
    rows += [
        f"| {name} | {say(value_text(parameter))} | {say(parameter.status)} {parameter.reason} |"
        for name, parameter in document.parameters.items()
    ]
    if document.components:
        rows += ["", columns.format(say("component"), say("equation"), say("status"))]
        rows += [
            f"| {say(row.meaning)} | {equation_text(row.equation)} | {say(row.status)} {say(row.approval)} |"
            for row in document.components
        ]
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
    texts = source.plan.texts
    say = texts.translated
    estimates = [
        rrb.TimeSeriesView(
            contents=[f"/parameters/{row.name}", f"/limits/{row.name}"],
            name=f"{quantity_text(row.name, row.unit)}: {say(row.meaning)}",
            axis_x=whole,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )
        for row in source.parameters
    ]
    estimates.append(
        rrb.TimeSeriesView(origin="/components", name=texts("components"), axis_x=whole),
    )
    columns = rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"])
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/operator", name=source.title),
            rrb.StateTimelineView(origin="/state", name=texts("state_over_time"), time_view=whole),
            column_shares=[1, 1],
        ),
        rrb.Grid(*estimates),
        rrb.TextLogView(origin="/events", name=texts("events"), columns=columns),
        row_shares=[6, 4, 2],
        name=texts("state"),
    )


def _engineer(source: RecordedMachine) -> rrb.Container:
    """Curves of signals and twin, residuals, the report and the log."""
    series, twin, texts = rrb.TimeSeriesView, source.twin, source.plan.texts
    signals: tuple[Output | Input, ...] = (*twin.outputs, *twin.inputs)
    names = {row.name: quantity_text(texts.translated(row.meaning), row.unit) for row in signals}
    outputs = [
        series(origin=f"/signals/{row.name}", name=f"{names[row.name]}: {texts('measured_and_twin')}")
        for row in twin.outputs
    ]
    inputs = [series(origin=f"/signals/{row.name}", name=names[row.name]) for row in twin.inputs]
    residual = series(origin="/residual", name=texts("residuals"))
    words = (
        rrb.TextDocumentView(origin="/report", name=texts("report")),
        rrb.TextLogView(origin="/log", name=texts("log")),
    )
    return rrb.Horizontal(
        rrb.Vertical(*outputs, *inputs, residual), rrb.Vertical(*words), column_shares=[3, 2], name=texts("curves")
    )
