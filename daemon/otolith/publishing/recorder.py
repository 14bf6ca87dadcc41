"""The recorder process: writes reports and their traces into a Rerun recording.

It runs beside the daemon, so that neither disk nor viewer can delay acquisition. It makes one ``send_columns`` call per
entity and window; an output's entity carries measured and predicted side by side. The recording contains all signals,
so that it can be replayed.
"""

import json
import logging
import math
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from otolith.acquisition.window import Array, Verdict
from otolith.health.schema import Report, ReportDocument, Status
from otolith.health.text import announcements, event_text, headline, value_text
from otolith.machine import RecordedMachine
from otolith.twin.definition import Definition, Parameter

log = logging.getLogger(__name__)

APPLICATION = "otolith"
TIMELINE = "time"
TIMES = "times"  # entity with the meaning of the times, for otolith_drivers.replay.recording
MIN_FREE_BYTES = 100 << 20  # kept free on the disk, see docs/reference/thresholds-runtime.md
MEASURED, TWIN, LIMIT = [90, 160, 255], [255, 140, 0], [150, 150, 150]  # colours, RGB


def main(connection: Any, path: Path, source: RecordedMachine) -> None:
    """Record reports until None comes, the connection closes or the disk is full."""
    if not has_room(path):
        return
    recording = Recording(path, source)
    try:
        while (report := connection.recv()) is not None and has_room(path):
            recording.add(report)
    finally:
        recording.close()


def has_room(path: Path) -> bool:
    """Return whether the disk of ``path`` has room: Rerun's writer ends without an error on a full disk."""
    free = shutil.disk_usage(path.parent).free
    if free < MIN_FREE_BYTES:
        bounds = f"{free >> 20} MB free in {path.parent}, at least {MIN_FREE_BYTES >> 20} MB are kept free"
        log.warning("recording stopped: %s", bounds)
    return free >= MIN_FREE_BYTES


class Recording:
    """One ``.rrd`` file."""

    def __init__(self, path: Path, source: RecordedMachine) -> None:
        twin, parameters = source.twin, source.parameters
        self._stream = rr.RecordingStream(APPLICATION, recording_id=path.stem)
        self._stream.set_log_time_enabled(False)
        self._stream.save(path, default_blueprint=blueprint(twin, parameters))
        self._stream.send_recording_name(source.title)
        times = json.dumps({"sampling": source.sampling, "delays": dict(source.delays)})
        self._stream.log(TIMES, rr.TextDocument(times), static=True)
        for signal in twin.inputs:
            self._style(f"signals/{signal.name}", [f"{signal.name} measured [{signal.unit}]"], [MEASURED])
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
        self._add_traces(report)
        document = report.document
        window = document.window
        self._stream.set_time(TIMELINE, timestamp=window.end)
        good = window.quality.verdict is Verdict.GOOD
        self._scalars("windows", float(good), window.start, window.end, float(window.records))
        for name, parameter in document.parameters.items():
            if parameter.value is not None and parameter.low is not None and parameter.high is not None:
                self._scalars(f"parameters/{name}", parameter.low, parameter.high, parameter.value)
        for component in document.components:
            amplitude = component.values["amplitude"]
            path = re.sub(r"\W+", "_", component.id)  # '/' and brackets have a meaning in the path of an entity
            self._scalars(f"components/{path}", amplitude.low, amplitude.high, amplitude.value)
        for text, level in _log_lines(document):
            self._stream.log("log", rr.TextLog(f"window {window.index}: {text}", level=level))
        self._stream.log("report", rr.TextDocument(_table(document), media_type=rr.MediaType.MARKDOWN))

    def close(self) -> None:
        """Write everything out."""
        self._stream.flush(timeout_sec=2.0)
        self._stream.disconnect()

    def _add_traces(self, report: Report) -> None:
        window, traces = report.document.window, report.traces
        times = round(window.start * 1e9) + np.rint(traces.offsets * 1e9).astype(np.int64)  # ns
        index = [rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))]

        def send(entity: str, values: Array) -> None:
            self._stream.send_columns(entity, indexes=index, columns=rr.Scalars.columns(scalars=values))

        predicted = np.full(traces.measured.shape, math.nan) if traces.predicted is None else traces.predicted
        for column, name in enumerate(traces.inputs):
            send(f"signals/{name}", traces.driving[:, column : column + 1])
        for column, name in enumerate(traces.outputs):
            send(f"signals/{name}", np.column_stack([traces.measured[:, column], predicted[:, column]]))
        if traces.predicted is not None:
            send("residual", (traces.measured - traces.predicted) / np.asarray(traces.noise))

    def _scalars(self, entity: str, *values: float) -> None:
        self._stream.log(entity, rr.Scalars(list(values)))

    def _style(self, entity: str, names: list[str], colors: list[list[int]] | None) -> None:
        self._stream.log(entity, rr.SeriesLines(names=names, colors=colors), static=True)


def _log_lines(document: ReportDocument) -> Iterator[tuple[str, str]]:
    """Yield the lines of the log, each with its level."""
    reasons = document.window.quality.reasons
    yield from ((reason, "WARN") for reason in reasons)
    for name, parameter in document.parameters.items():
        if parameter.status is not Status.ESTIMATED and not reasons:
            yield f"{name} {parameter.status}: {parameter.reason}", "INFO"
    for event in announcements(document):
        yield event_text(event), "ERROR" if event.is_urgent else "WARN"
    if document.fit is not None and not document.fit.explained:
        yield "the twin does not explain the window up to the noise", "INFO"


def _table(document: ReportDocument) -> str:
    """Return the report as a Markdown table."""
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


def blueprint(twin: Definition, parameters: Sequence[Parameter]) -> rrb.Blueprint:
    """Return the layout of the viewer: parameters and residual, then signals, then report and log."""
    series = rrb.TimeSeriesView
    estimates = [
        series(origin=f"/parameters/{row.name}", name=f"{row.meaning} {row.name} [{row.unit}]") for row in parameters
    ]
    outputs = [
        series(origin=f"/signals/{row.name}", name=f"{row.meaning} [{row.unit}]: measured and twin")
        for row in twin.outputs
    ]
    inputs = [series(origin=f"/signals/{row.name}", name=f"{row.meaning} [{row.unit}]") for row in twin.inputs]
    components = series(origin="/components", name="components that the twin lacked: amplitudes")
    residual = series(origin="/residual", name="residual in units of the noise")
    texts = rrb.TextDocumentView(origin="/report", name="report"), rrb.TextLogView(origin="/log", name="log")
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*estimates, components, residual),
            rrb.Vertical(*outputs, *inputs),
            rrb.Vertical(*texts),
            column_shares=[3, 3, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
    )
