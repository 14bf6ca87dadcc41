"""The layout in which the viewer shows a recording, as a file that the recordings of alike machines share.

Rerun keeps two threads and a megabyte for each layout that it writes, until the process ends.
"""

import pickle
import tempfile
from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from otolith.health.limits import MonitoredQuantity
from otolith.machine import RecordedMachine
from otolith.twin.definition import Input, Output
from otolith_drivers.units import unit_text

APPLICATION, TIMELINE = "otolith", "time"

_files: dict[bytes, Path] = {}
_folder: list[tempfile.TemporaryDirectory[str]] = []  # Removed when the process ends


def layout_file(source: RecordedMachine) -> Path:
    """Return the file with the layout of a machine, which is written once for all machines with an equal one."""
    parameters = [
        (row.name, row.unit, row.meaning, _legend_corner(_quantity(source, row.name))) for row in source.parameters
    ]
    rows: tuple[Output | Input, ...] = (*source.twin.outputs, *source.twin.inputs)
    signals = [(row.name, row.unit, row.meaning) for row in rows]
    key = pickle.dumps((source.plan.language, parameters, len(source.twin.outputs), signals))
    if key not in _files:
        if not _folder:
            _folder.append(tempfile.TemporaryDirectory(prefix="otolith-"))
        path = Path(_folder[0].name) / f"layout-{len(_files)}.rbl"
        blueprint(source).save(APPLICATION, path)
        _files[key] = path
    return _files[key]


def _quantity(source: RecordedMachine, name: str) -> MonitoredQuantity:
    return source.plan.parameters.get(name, MonitoredQuantity())


def blueprint(source: RecordedMachine) -> rrb.Blueprint:
    """Return the layout of the viewer, which has nothing of the machine but what others may have as well."""
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
            name=f"{named_with_unit(row.name, row.unit)}: {say(row.meaning)}",
            axis_x=whole,
            plot_legend=rrb.PlotLegend(_legend_corner(_quantity(source, row.name))),
        )
        for row in source.parameters
    ]
    estimates.append(
        rrb.TimeSeriesView(origin="/components", name=texts("components"), axis_x=whole),
    )
    columns = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(TIMELINE, visible=False)],  # too narrow for a date, which the text has
        text_log_columns=["LogLevel", "Body"],
    )
    return rrb.Vertical(
        rrb.Horizontal(
            rrb.TextDocumentView(origin="/operator", name=texts("report")),
            rrb.StateTimelineView(origin="/state", name=texts("state_over_time"), time_view=whole),
            column_shares=[1, 1],
        ),
        rrb.Grid(*estimates),
        rrb.TextLogView(origin="/events", name=texts("events"), columns=columns),
        row_shares=[6, 4, 2],
        name=texts("state"),
    )


def _legend_corner(quantity: MonitoredQuantity) -> rrb.Corner2D:
    """Return where the legend hides the healthy value least: on the side of the nearest limit."""
    nearest = min(quantity.limits, key=lambda row: abs(row.value - quantity.nominal), default=None)
    return rrb.Corner2D.LeftBottom if nearest is not None and nearest.is_lower else rrb.Corner2D.LeftTop


def _engineer(source: RecordedMachine) -> rrb.Container:
    """Curves of signals and twin, residuals, the report and the log."""
    series, twin, texts = rrb.TimeSeriesView, source.twin, source.plan.texts
    signals: tuple[Output | Input, ...] = (*twin.outputs, *twin.inputs)
    names = {row.name: named_with_unit(texts.translated(row.meaning), row.unit) for row in signals}
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


def named_with_unit(name: str, unit: str) -> str:
    """Return the name of a quantity with its unit in brackets, if it has one."""
    return f"{name} [{symbol}]" if (symbol := unit_text(unit)) else name
