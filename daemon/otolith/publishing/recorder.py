"""The recorder process: writes reports and their curves into a Rerun recording.

It runs beside the daemon, so that no disk and no viewer can hold acquisition up. One ``send_columns`` per entity and
window; an entity carries a vector, measured and twin side by side. All signals are in it, so that it can be replayed.
"""

import logging
import math
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from otolith.acquisition.window import Array, Verdict
from otolith.estimation.information import QUANTILE
from otolith.health.schema import Report, ReportDocument, Status, Traces
from otolith.twin.definition import Definition, Parameter

log = logging.getLogger(__name__)

APPLICATION = "otolith"
TIMELINE = "time"
LEAST_FREE = 100 << 20  # bytes
MEASURED, TWIN, LIMIT = [90, 160, 255], [255, 140, 0], [150, 150, 150]


def main(connection: Any, path: Path, title: str, twin: Definition, parameters: Sequence[Parameter]) -> None:
    """Record what comes until None comes or the connection closes."""
    if not has_room(path):
        return
    recording = Recording(path, title, twin, parameters)
    try:
        while (report := connection.recv()) is not None and has_room(path):
            recording.add(report)
    finally:
        recording.close()


def has_room(path: Path) -> bool:
    """Rerun's writer ends without a word on a full disk, so who records ends before."""
    free = shutil.disk_usage(path.parent).free
    if free < LEAST_FREE:
        log.warning("recording stopped: %d MB free in %s, %d MB are kept", free >> 20, path.parent, LEAST_FREE >> 20)
    return free >= LEAST_FREE


class Recording:
    """One ``.rrd`` file."""

    def __init__(self, path: Path, title: str, twin: Definition, parameters: Sequence[Parameter]) -> None:
        self._stream = rr.RecordingStream(APPLICATION, recording_id=path.stem)
        self._stream.set_log_time_enabled(False)
        self._stream.save(path, default_blueprint=blueprint(twin, parameters))
        self._stream.send_recording_name(title)
        for driving in twin.inputs:
            self._style(f"signals/{driving.name}", [f"{driving.name} measured [{driving.unit}]"], [MEASURED])
        for output in twin.outputs:
            names = [f"{output.name} measured [{output.unit}]", f"{output.name} twin [{output.unit}]"]
            self._style(f"signals/{output.name}", names, [MEASURED, TWIN])
        self._style("residual", [f"{output.name} / noise" for output in twin.outputs], None)
        for parameter in parameters:
            names = ["95 % low", "95 % high", f"{parameter.name} [{parameter.unit}]"]  # the last is drawn on top
            self._style(f"parameters/{parameter.name}", names, [LIMIT, LIMIT, TWIN])
        self._style("windows", ["is good", "start [s]", "end [s]", "records"], None)

    def add(self, report: Report) -> None:
        """Append a window."""
        document, traces = report.document, report.traces
        window = document.window
        offsets = (window.end - window.start) * np.arange(window.records) / window.records
        moments = round(window.start * 1e9) + np.rint(offsets * 1e9).astype(np.int64)
        when = [rr.TimeColumn(TIMELINE, timestamp=moments.astype("datetime64[ns]"))]
        for index, name in enumerate(traces.inputs):
            self._columns(f"signals/{name}", when, traces.driving[:, index : index + 1])
        for index, name in enumerate(traces.outputs):
            self._columns(f"signals/{name}", when, _side_by_side(traces, index))
        if traces.predicted is not None:
            self._columns("residual", when, (traces.measured - traces.predicted) / np.asarray(traces.noise))
        self._stream.set_time(TIMELINE, timestamp=window.end)
        good = window.quality.verdict is Verdict.GOOD
        self._stream.log("windows", rr.Scalars([float(good), window.start, window.end, float(window.records)]))
        for name, parameter in document.parameters.items():
            if parameter.value is not None and parameter.low is not None and parameter.high is not None:
                self._stream.log(f"parameters/{name}", rr.Scalars([parameter.low, parameter.high, parameter.value]))
        for entry in document.components:
            amplitude = entry.values["amplitude"]
            bare = re.sub(r"\W+", "_", entry.id)  # an entity's path has signs of its own
            self._stream.log(f"components/{bare}", rr.Scalars([amplitude.low, amplitude.high, amplitude.value]))
        for text, level in _sentences(document):
            self._stream.log("log", rr.TextLog(text, level=level))
        self._stream.log("report", rr.TextDocument(_table(document), media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Write everything out."""
        self._stream.flush(timeout_sec=2.0)
        self._stream.disconnect()

    def _columns(self, entity: str, when: list[rr.TimeColumn], values: Array) -> None:
        self._stream.send_columns(entity, indexes=when, columns=rr.Scalars.columns(scalars=values))

    def _style(self, entity: str, names: list[str], colors: list[list[int]] | None) -> None:
        self._stream.log(entity, rr.SeriesLines(names=names, colors=colors), static=True)


def _side_by_side(traces: Traces, index: int) -> Array:
    """(records, 2): measured and twin; the twin is not a number where nothing was estimated."""
    measured = traces.measured[:, index]
    twin = np.full(len(measured), math.nan) if traces.predicted is None else traces.predicted[:, index]
    return np.column_stack([measured, twin])


def _sentences(document: ReportDocument) -> list[tuple[str, str]]:
    """What is worth a line in the log, with its level."""
    window = document.window
    lines = [(f"window {window.index}: {reason}", "WARN") for reason in window.quality.reasons]
    for name, parameter in document.parameters.items():
        if parameter.status is not Status.ESTIMATED and not window.quality.reasons:
            lines.append((f"window {window.index}: {name} {parameter.status}: {parameter.reason}", "INFO"))
    for finding in document.findings:
        advice = f" ({finding.advice})" if finding.advice else ""
        lines.append((f"window {window.index}: {finding.text}{advice}", "WARN"))
    if document.fit is not None and not document.fit.explained:
        lines.append((f"window {window.index}: the twin does not explain the window up to the noise", "INFO"))
    return lines


def _table(document: ReportDocument) -> str:
    """The report as a Markdown table."""
    rows = [f"# {document.machine} at {document.site}", "", "| parameter | value | status |", "|---|---|---|"]
    for name, parameter in document.parameters.items():
        value = "unknown"
        if parameter.value is not None and parameter.sd is not None:
            value = f"{parameter.value:.5g} {parameter.unit} ± {QUANTILE * parameter.sd:.2g}"
        rows.append(f"| {name} | {value} | {parameter.status} {parameter.reason} |")
    if document.components:
        rows += ["", "| component | equation | status |", "|---|---|---|"]
        rows += [
            f"| {entry.meaning} | {entry.equation} | {entry.status} {entry.approval} |" for entry in document.components
        ]
    rows += [f"\n**{finding.severity}**: {finding.text} {finding.advice}" for finding in document.findings]
    return "\n".join(rows)


def blueprint(twin: Definition, parameters: Sequence[Parameter]) -> rrb.Blueprint:
    """What an operator sees: parameters first, then measured against twin, what is left, and the words."""
    parameter_views = [
        rrb.TimeSeriesView(origin=f"/parameters/{entry.name}", name=f"{entry.meaning} {entry.name} [{entry.unit}]")
        for entry in parameters
    ]
    signal_views = [
        rrb.TimeSeriesView(origin=f"/signals/{entry.name}", name=f"{entry.meaning} [{entry.unit}]: measured and twin")
        for entry in twin.outputs
    ]
    input_views = [
        rrb.TimeSeriesView(origin=f"/signals/{entry.name}", name=f"{entry.meaning} [{entry.unit}]")
        for entry in twin.inputs
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                *parameter_views,
                rrb.TimeSeriesView(origin="/components", name="components that the twin lacked: amplitudes"),
                rrb.TimeSeriesView(origin="/residual", name="residual in units of the noise"),
            ),
            rrb.Vertical(*signal_views, *input_views),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/report", name="report"), rrb.TextLogView(origin="/log", name="log")
            ),
            column_shares=[3, 3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
