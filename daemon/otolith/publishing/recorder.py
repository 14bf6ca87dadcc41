"""The recorder process: writes reports and their traces into Rerun recordings.

It runs beside the daemon, so that neither disk nor viewer can delay acquisition. Some windows are written together, in
one ``send_columns`` call per entity, because each call costs a kilobyte. All measured records are in Parquet files
beside the recording; its curves in ``signals`` are for the viewer, and most of the time they have the extremes only.
"""

import math
import re
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from otolith.acquisition.window import Array, Verdict
from otolith.exchange.identifiers import identifiers
from otolith.health.limits import Level, MonitoredQuantity
from otolith.health.schema import EventDocument, Report, ReportDocument, Status
from otolith.health.text import (
    Texts,
    announcements,
    approval_text,
    event_text,
    headline,
    note_texts,
    probability_text,
    texts_in,
    undecided_advice,
    undecided_text,
    unknown_text,
    value_text,
    zone_of,
)
from otolith.health.times import clock_in, in_local_time, moment_text
from otolith.machine import RecordedMachine
from otolith.publishing.recording_layout import APPLICATION, TIMELINE, layout_file, named_with_unit
from otolith.storage.recording_files import (
    EVENT_MARGIN,
    FILE_MODE,
    MIN_FREE_SHARE,
    Ended,
    Opened,
    RecordingFolder,
    shortage_of,
    size_of,
)
from otolith_drivers import keep_pandas_out
from otolith_drivers.grammars.markdown import markdown_text
from otolith_drivers.outside_text import visible
from otolith_drivers.replay.sample_files import GOOD, TIME, SampleWriter, TimesRecord, unite
from otolith_drivers.replay.sample_names import parts_folder
from otolith_drivers.units import equation_text, quantity_text

LOG, EVENTS, REPORT, OPERATOR = "log", "events", "report", "operator"  # entities
Times = NDArray[np.int64]  # ns
INTERVAL, ESTIMATE_WIDTHS = ["95 %", "95 %"], [1.0, 1.0, 2.5]  # names; widths of the three lines, points

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
CHECK_INTERVAL = 60.0  # s between two checks of the budget; the disk is checked for each window
BATCH_WINDOWS, BATCH_SECONDS = 30, 300.0  # windows that are written together, and s after which fewer are
FULL_CURVES = 15  # windows with all records in their curves, at the begin of a file and after a change of an event
CURVE_BUCKET = 40  # records of which a curve has the smallest and the largest otherwise
FLUSH_TIMEOUT = 30.0  # s
NEAR_LIMITS = 3.0  # times the distance of the nearest limit from the nominal value, up to which others are shown
NEAR_VALUES = 2.0  # times the distance of the value from the nominal value, the same
MEASURED, TWIN, LIMIT = [90, 160, 255], [255, 140, 0], [150, 150, 150]  # colours, RGB
STATES = {
    Level.OK: [46, 125, 50],
    Level.HINT: [60, 110, 160],
    Level.NO_DATA: [110, 110, 110],
    Level.WATCH: [200, 140, 0],
    Level.ACT: [198, 40, 40],
}


def main(connection: Any) -> None:
    """Record reports of several machines until None comes or the connection closes.

    Each message has the name and number of a recording, and what is to be done: :class:`Opened`, a report, or None at
    its end. Each report is answered with the number of windows that are not yet written, a recording that ends with
    :class:`Ended`: a disk that fails concerns no other recording.
    """
    keep_pandas_out()
    recordings: dict[str, RotatedRecording] = {}
    try:
        while (message := connection.recv()) is not None:
            name, number, content = message
            try:
                answer = _recorded(recordings, name, content)
            except OSError as error:
                recordings.pop(name, None)
                answer = Ended(str(error))
            if answer is not None:
                connection.send((name, number, answer))
    finally:
        with ExitStack() as closing:
            for recording in recordings.values():
                closing.callback(recording.close)
            for recording in recordings.values():  # before any is closed, which takes longer
                closing.callback(recording.write)


def _recorded(
    recordings: "dict[str, RotatedRecording]", name: str, content: Opened | Report | None
) -> int | Ended | None:
    """Do what a message asks for, and return the answer, if there is one."""
    if isinstance(content, Opened) or content is None:
        if name in recordings:
            recordings.pop(name).close()
        if content is None:
            return None
        if not has_room(content.path):
            return Ended("")
        phase = len(recordings) / BATCH_WINDOWS % 1.0  # else those that began together always write together
        recordings[name] = RotatedRecording(content.path, content.source, content.folder, time.time(), phase)
        return None
    if name not in recordings:
        return None  # it has ended, which was answered before
    if not recordings[name].has_room(time.time()):
        recordings.pop(name).close()
        return Ended("")
    recordings[name].add(content, time.time())
    return recordings[name].waiting


def has_room(path: Path) -> bool:
    """Return whether the disk of ``path`` has room for any recording."""
    return shortage_of(path.parent) <= 0


class RotatedRecording:
    """A recording in one file, or in a folder with a new file when one is full. Times are Unix seconds."""

    def __init__(
        self, path: Path, source: RecordedMachine, folder: RecordingFolder | None, now: float, phase: float = 0.0
    ) -> None:
        """``phase`` as of :class:`Recording`."""
        self.path = path
        self._folder = folder
        self._begin = self._checked_at = now
        self._marked_until = -math.inf
        self._unite_others()
        self._recording = Recording(path, source, None if folder is None else FILE_MODE, phase)
        self._set_mode()

    @property
    def waiting(self) -> int:
        """Number of windows that are not yet written."""
        return self._recording.waiting

    def add(self, report: Report, now: float) -> None:
        """Append a window, in a new file if the present one is full."""
        if self._folder is None:
            self._recording.add(report)
            return
        if self._folder.budget.is_full(now - self._begin, size_of(self.path)):
            is_marked = now < self._marked_until <= now + EVENT_MARGIN  # not if the clock was set back meanwhile
            self.path, self._begin = self._folder.new_path(now, marked=is_marked), now
            self._recording.open(self.path)
            self._set_mode()
        if announcements(report.document):
            self._marked_until = now + EVENT_MARGIN
            self.path = self._folder.mark(now, self.path)
            self._recording.renamed(self.path)
        self._recording.add(report)

    def has_room(self, now: float) -> bool:
        """Return whether the disk has room, after deleting files that the budget does not allow."""
        if self._folder is None:
            return has_room(self.path)
        is_due = abs(now - self._checked_at) >= CHECK_INTERVAL
        if not is_due and shortage_of(self.path.parent, MIN_FREE_SHARE) <= 0:
            return True
        self._checked_at = now
        return self._folder.make_room(now, self.path) <= 0

    def write(self) -> None:
        """Write the windows that wait."""
        self._recording.write()

    def close(self) -> None:
        """Write everything out."""
        self._recording.close()

    def _unite_others(self) -> None:
        """Make one file each of the samples that a recorder left which was killed."""
        for file in () if self._folder is None else self._folder.files():
            if file.path != self.path and parts_folder(file.path).exists():
                with suppress(OSError):  # the disk is full: they can be read as they are
                    unite(file.path)

    def _set_mode(self) -> None:
        if self._folder is not None:
            self.path.chmod(FILE_MODE)


class Recording:
    """A stream of windows into ``.rrd`` files, one after the other, and their samples into Parquet files."""

    def __init__(self, path: Path, source: RecordedMachine, mode: int | None = None, phase: float = 0.0) -> None:
        """``mode`` is that of the files with samples; ``phase`` the share of a batch by which the first is shorter."""
        self._source, self._mode = source, mode
        self._batch = BATCH_WINDOWS - round(phase * BATCH_WINDOWS)  # Windows that are written together
        self._samples: SampleWriter | None = None
        self._stream = rr.RecordingStream(APPLICATION, recording_id=re.sub(r"\W+", "_", source.title))
        self._stream.set_log_time_enabled(False)
        self._rows: defaultdict[str, list[tuple[Times, Any]]] = defaultdict(list)
        self._limits: dict[str, MonitoredQuantity] = {}
        self._states: dict[str, str] = {}
        self._styled: set[str] = set()
        self._latest: ReportDocument | None = None
        self.waiting = 0  # Number of windows that are not yet written
        self.open(path)

    def open(self, path: Path) -> None:
        """Finish the present file, and go on in the file ``path``."""
        self._close_samples()
        self._stream.save(path)
        self._samples = self._new_samples(path)
        self._stream.log_file_from_path(layout_file(self._source))
        self._log_static()
        self.waiting, self._full_curves = 0, FULL_CURVES
        self._written_at = time.monotonic()
        self._lines: set[str] = set()
        self._statuses: object = None
        self._states, self._styled = {}, set()

    def _new_samples(self, path: Path) -> SampleWriter:
        source, twin = self._source, self._source.twin
        units = {name: twin.unit_of(name) for name in twin.signals}
        meaning = TimesRecord(sampling=source.sampling, delays=dict(source.delays), signals=units)
        headers = identifiers(units, str, {TIME, GOOD})  # a temperature may have any name
        return SampleWriter(path, meaning, list(headers.values()), {"title": source.title}, self._mode)

    def renamed(self, path: Path) -> None:
        """Go on with the present file under another name."""
        if self._samples is not None:
            self._samples.recording = path

    def _log_static(self) -> None:
        """Log what each file must have: names, units, and what the times mean."""
        source, twin = self._source, self._source.twin
        self._stream.send_recording_name(source.title)
        for signal in twin.inputs:
            self._style(f"signals/{signal.name}", [named_with_unit(f"{signal.name} measured", signal.unit)], [MEASURED])
        for output in twin.outputs:
            names = [named_with_unit(f"{output.name} {kind}", output.unit) for kind in ("measured", "twin")]
            self._style(f"signals/{output.name}", names, [MEASURED, TWIN])
        self._style("residual", [f"{output.name} / noise" for output in twin.outputs], None)
        for parameter in source.parameters:
            names = [*INTERVAL, named_with_unit(parameter.name, parameter.unit)]  # the last is drawn on top
            self._style(f"parameters/{parameter.name}", names, [LIMIT, LIMIT, MEASURED])
            quantity = source.plan.parameters.get(parameter.name, MonitoredQuantity(nominal=parameter.nominal))
            self._limits[parameter.name], lines = quantity, limit_lines(quantity, source.plan.texts)
            self._style(f"limits/{parameter.name}", [name for name, _, _ in lines], [colour for _, _, colour in lines])
        self._style("windows", ["is good", "start [s]", "end [s]", "records"], None)

    def add(self, report: Report) -> None:
        """Append a window; it is written with those that follow, but at once if it changes an event."""
        document = report.document
        if announcements(document):
            self._full_curves = max(self._full_curves, FULL_CURVES)
        self._add_traces(report)
        self._add_document(document)
        self.waiting += 1
        age = time.monotonic() - self._written_at
        if self.waiting >= self._batch or age >= BATCH_SECONDS or announcements(document):
            self.write()
            self._batch = BATCH_WINDOWS

    def write(self) -> None:
        """Write the windows that wait."""
        if self._samples is not None:
            self._samples.save()
        self._add_texts()
        for entity, rows in self._rows.items():
            times = np.concatenate([times for times, _ in rows]).astype("datetime64[ns]")
            self._stream.send_columns(entity, [rr.TimeColumn(TIMELINE, timestamp=times)], _columns(entity, rows))
        self._rows.clear()
        self.waiting, self._written_at = 0, time.monotonic()
        self._stream.flush(timeout_sec=FLUSH_TIMEOUT)

    def close(self) -> None:
        """Write everything out."""
        self._close_samples()
        self._stream.disconnect()

    def _close_samples(self) -> None:
        self.write()
        if self._samples is not None:
            self._samples.close()

    def _add_document(self, document: ReportDocument) -> None:
        window = document.window
        end = np.array([round(window.end * 1e9)])
        good = float(window.quality.verdict is Verdict.GOOD)
        self._add_row("windows", end, good, window.start, window.end, float(window.records))
        self._add_estimates(document, end)
        self._add_state(document, end)
        lines = dict(_log_lines(document))
        for text, level in lines.items():
            if text not in self._lines:  # what continues is logged once
                self._rows[LOG].append((end, (f"window {window.index}: {text}", level)))
        self._lines = set(lines)
        self._latest = document
        if (statuses := _statuses(document)) != self._statuses:
            self._add_texts()
        self._statuses = statuses

    def _add_texts(self) -> None:
        """Append the texts about the latest window, if it has none yet."""
        if (document := self._latest) is not None:
            end = np.array([round(document.window.end * 1e9)])
            self._rows[REPORT].append((end, report_text(document)))
            self._rows[OPERATOR].append((end, operator_text(document)))
        self._latest = None

    def _add_row(self, entity: str, end: Times, *values: float) -> None:
        self._rows[entity].append((end, np.array([values])))

    def _add_estimates(self, document: ReportDocument, end: Times) -> None:
        """Append parameters and amplitudes with their intervals, and the limits of the parameters."""
        for name, parameter in document.parameters.items():
            if parameter.value is not None and parameter.low is not None and parameter.high is not None:
                self._add_row(f"parameters/{name}", end, parameter.low, parameter.high, parameter.value)
            quantity = self._limits.get(name, MonitoredQuantity(nominal=parameter.nominal))
            value = quantity.nominal if parameter.value is None else parameter.value
            self._add_row(f"limits/{name}", end, *near_values(quantity, value))
        for component in document.components:
            amplitude = component.values["amplitude"]
            # '/' and brackets have a meaning in the path of an entity.
            entity = "components/" + re.sub(r"\W+", "_", component.id)
            if entity not in self._styled:
                what = named_with_unit(f"{component.meaning}, {component.family}", amplitude.unit)
                self._style(entity, [*INTERVAL, what], [LIMIT, LIMIT, MEASURED])
                self._styled.add(entity)
            self._add_row(entity, end, amplitude.low, amplitude.high, amplitude.value)

    def _add_state(self, document: ReportDocument, end: Times) -> None:
        """Append events and states of the operator's tab, where they have changed."""
        for event in announcements(document):
            if event.is_hint:
                continue  # the log of the engineer's tab has it
            self._rows[EVENTS].append((end, (event_text(event), _severity(event))))
        health = document.health
        parts = {} if health is None else {"": health, **health.parts}
        for part, row in parts.items():
            lane = "state/" + re.sub(r"\W+", "_", self._source.plan.texts.part(part))
            if lane not in self._states:
                names, colours = [str(level) for level in STATES], list(STATES.values())
                labels = [texts_in(health.language).translated(name) for name in names] if health else names
                configuration = rr.StateConfiguration(values=names, labels=labels, colors=colours)
                self._stream.log(lane, configuration, static=True)
            if self._states.get(lane) != row.state:
                self._rows[lane].append((end, str(row.state)))
                self._states[lane] = row.state

    def _add_traces(self, report: Report) -> None:
        window, traces = report.document.window, report.traces
        times = round(window.start * 1e9) + np.rint(traces.offsets * 1e9).astype(np.int64)  # ns
        measured = {name: traces.driving[:, column] for column, name in enumerate(traces.inputs)}
        measured |= {name: traces.measured[:, column] for column, name in enumerate(traces.outputs)}
        good = window.quality.verdict is Verdict.GOOD
        assert self._samples is not None  # noqa: S101 - for mypy
        self._samples.add(times, [measured[name] for name in self._source.twin.signals], good=good)

        predicted = np.full(traces.measured.shape, math.nan) if traces.predicted is None else traces.predicted
        is_full, self._full_curves = self._source.all_curves or self._full_curves > 0, max(0, self._full_curves - 1)
        for name, values in measured.items():
            kept = slice(None) if is_full else extremes(values, CURVE_BUCKET)
            twin = [predicted[:, traces.outputs.index(name)]] if name in traces.outputs else []
            if len(times[kept]):
                self._rows[f"signals/{name}"].append((times[kept], np.column_stack([values, *twin])[kept]))
        if traces.predicted is not None and len(times):
            squares = ((traces.measured - traces.predicted) / np.asarray(traces.noise)) ** 2
            counts = np.maximum(np.isfinite(squares).sum(axis=0), 1)
            rms = np.sqrt(np.nansum(squares, axis=0) / counts)
            self._rows["residual"].append((times[-1:], rms[None]))

    def _style(self, entity: str, names: list[str], colors: list[list[int]] | None) -> None:
        widths = ESTIMATE_WIDTHS if names[:2] == INTERVAL else None
        self._stream.log(entity, rr.SeriesLines(names=names, colors=colors, widths=widths), static=True)


def extremes(values: Array, bucket: int) -> Times:
    """Return the indices, in order, of the smallest and the largest value of every ``bucket`` values."""
    kept: set[int] = set()
    for begin in range(0, len(values), bucket):
        part = values[begin : begin + bucket]
        if np.isfinite(part).any():
            kept |= {begin + int(np.nanargmin(part)), begin + int(np.nanargmax(part))}
    return np.array(sorted(kept), dtype=np.int64)


def _columns(entity: str, rows: list[tuple[Times, Any]]) -> Any:
    """Return the columns of an entity in Rerun's form."""
    values = [value for _, value in rows]
    if entity in (LOG, EVENTS):
        texts, levels = zip(*values, strict=True)
        return rr.TextLog.columns(text=list(map(visible, texts)), level=list(levels))
    if entity.startswith("state/"):
        return rr.StateChange.columns(state=values)
    if entity in (REPORT, OPERATOR):
        return rr.TextDocument.columns(text=values, media_type=[rr.MediaType.MARKDOWN] * len(values))
    scalars = np.concatenate(values)
    if entity.startswith("limits/"):
        scalars = scalars[:, ~np.isnan(scalars).all(axis=0)]  # far limits come last: what is not drawn is not named
    return rr.Scalars.columns(scalars=scalars)


def _statuses(document: ReportDocument) -> object:
    """Return what the texts about a report show beside values."""
    rows = [(row.status, row.reason) for row in document.parameters.values()]
    events = [(event.id, event.state, event.end) for event in document.events]
    components = [(row.id, row.status, row.approval) for row in document.components]
    return rows, components, events, None if document.health is None else document.health.state


def _log_lines(document: ReportDocument) -> Iterator[tuple[str, str]]:
    """Yield the lines of the log, each with its level."""
    reasons = document.window.quality.reasons
    zone = zone_of(document)
    yield from ((in_local_time(reason, zone), "WARN") for reason in reasons)
    for name, parameter in document.parameters.items():
        if parameter.status is not Status.ESTIMATED and not reasons:
            yield f"{name} {parameter.status}: {in_local_time(parameter.reason, zone)}", "INFO"
    for event in announcements(document):
        yield event_text(event, details=True), _severity(event)
    if document.fit is not None and not document.fit.explained:
        yield "the twin does not explain the window up to the noise", "INFO"


# What the viewer shows: a tab for the operator, one for the engineer, and their texts.


def limit_lines(quantity: MonitoredQuantity, texts: Texts) -> list[tuple[str, float, list[int]]]:
    """Return name, value and colour of the lines beside a parameter: nominal value and limits, the nearest first."""
    limits = sorted(quantity.limits, key=lambda row: abs(row.value - quantity.nominal))
    rows = [("nominal", quantity.nominal, LIMIT), *((str(row.level), row.value, STATES[row.level]) for row in limits)]
    say, unit = texts.translated, quantity.unit
    shown = [(f"{say(name)} {quantity_text(value, unit)}", value, colour) for name, value, colour in rows]
    return [(texts.decimals(text), value, colour) for text, value, colour in shown]


def near_values(quantity: MonitoredQuantity, value: float) -> list[float]:
    """Return nominal value and limits of a parameter at ``value``; not a number for each that is too far to be shown.

    A limit far beyond the others would make the curve flat.
    """
    nominal = quantity.nominal
    limits = sorted((row.value for row in quantity.limits), key=lambda limit: abs(limit - nominal))
    nearest = abs(limits[0] - nominal) if limits else 0.0
    reach = max(NEAR_LIMITS * nearest, NEAR_VALUES * abs(value - nominal))
    return [nominal, *(limit if abs(limit - nominal) <= reach else math.nan for limit in limits)]


def _severity(event: EventDocument) -> str:
    """Return the level of an event in a log of Rerun, as the log of the daemon has it."""
    return "INFO" if event.is_silent else "ERROR" if event.is_urgent else "WARN"


def operator_text(document: ReportDocument) -> str:
    """Return in Markdown the state, what is the matter, since when, how sure, and what to do."""
    if (health := document.health) is None:
        return f"# {document.machine}"
    texts = texts_in(health.language)
    current, undecided = document.open_events, undecided_text(document)
    lines = [f"# {texts.translated(health.state)}"]
    if all(event.state is not health.state for event in current):  # otherwise the first event says since when
        lines[0] += f"\n{texts('since', time=moment_text(health.since, health.timezone))}"
        why = health.reason or ("" if undecided else texts("all_well"))
        lines += [markdown_text(why)] if why and not current else []
    lines += [markdown_text(unknown)] if (unknown := unknown_text(health, current)) else []
    lines += [_paragraph(event, health.state) for event in current]
    lines += [f"**{markdown_text(undecided)}**"] if undecided else []
    if undecided and (advice := undecided_advice(document)):
        lines += [f"**{texts('what_to_do')}: {markdown_text(advice)}**"]
    return texts.decimals("\n\n".join(lines))


def _paragraph(event: EventDocument, worst: Level) -> str:
    """Return what is the matter, since when, how sure, and what to do; the state unless it is the ``worst``."""
    say = texts_in(event.language)
    sure = f" ({probability})" if (probability := probability_text(event)) else ""
    state = "" if event.state is worst else f"{say.translated(event.state)}: "
    written = in_local_time(event.text, event.timezone)
    what = markdown_text(f"{state}{say.part(event.part)}: {event.condition}")
    what = f"## {what}\n{say('since', time=moment_text(event.since, event.timezone))}"
    advice = f"**{say('what_to_do')}: {markdown_text(event.advice)}**" if event.advice else ""
    notes = map(markdown_text, note_texts(event, clock_in(event.timezone)))
    return "  \n".join(filter(None, [what, advice, markdown_text(f"{written}{sure}"), *notes]))


def report_text(document: ReportDocument) -> str:
    """Return the report as tables in Markdown."""
    texts = texts_in("en" if document.health is None else document.health.language)
    rows = [f"# {document.machine}, {document.site}", ""]
    current = document.open_events
    rows += [] if document.health is None else [markdown_text(headline(document.health, events=current)), ""]
    say, columns = texts.translated, "| {} | {} | {} |\n|---|---|---|"
    rows += [columns.format(say("parameter"), say("value"), say("status"))]
    parameters = document.parameters.items()
    rows += [
        f"| {markdown_text(name)} | {markdown_text(say(value_text(row)))} | "
        f"{markdown_text(f'{say(row.status)} {row.reason}')} |"
        for name, row in parameters
    ]
    if document.components:
        rows += ["", columns.format(say("component"), say("equation"), say("status"))]
        rows += [
            f"| {markdown_text(say(row.meaning))} | {markdown_text(equation_text(row.equation))} | "
            f"{markdown_text(f'{say(row.status)}, {approval_text(row, texts)}')} |"
            for row in document.components
        ]
    rows += [f"\n{markdown_text(event_text(event, details=True))}" for event in (*current, *document.hints)]
    return texts.decimals("\n".join(rows))
