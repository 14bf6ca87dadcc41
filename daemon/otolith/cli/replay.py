"""``otolith replay``: recorded data through the code of the daemon, and a summary of the reports."""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

import click
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table
from rich.text import Text

from otolith.cli.common import echo_warnings, progress_line
from otolith.cli.live_table import STYLES, parameter_table, title
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import ReportDocument, Status
from otolith.health.text import component_text, finding_text, value_cells
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.preview import FIGURE, computing_time_text, preview_recording, short_lines
from otolith.runtime.replay import RealTimePacer, Replay, ReplayRecorder, open_recordings
from otolith_drivers.errors import OtolithError

PLAIN_WIDTH = 110  # columns of a summary that goes into a file
MAX_REASONS = 5  # kinds of bad windows that the summary lists
UNIX_TIMES = (1e8, 1e11)  # s; between March 1973 and the year 5138 a time is a date, below it counts from zero
PREVIEWED_ROWS = 50_000  # of which a replay prints a preview


def time_text(seconds: float) -> str:
    """A time of the data: seconds, or date and time (UTC) where only Unix seconds are that large."""
    if not UNIX_TIMES[0] <= seconds < UNIX_TIMES[1]:
        return f"{round(seconds, 6) + 0.0:.12g} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%F %T}Z"


class ReplaySummary:
    """Counts reports, keeps the last one, and draws itself."""

    def __init__(self) -> None:
        self._first: ReportDocument | None = None
        self._last: ReportDocument | None = None
        self._fitted = self._explained = 0
        self._decisions: Counter[WindowDecision] = Counter()
        self._statuses: Counter[tuple[str, Status]] = Counter()
        self._seconds: list[float] = []
        self._reasons: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def add(self, document: ReportDocument) -> None:
        """Count one report."""
        self._first = self._first or document
        self._last = document
        self._decisions[document.decision] += 1
        if document.cost.seconds is not None:
            self._seconds.append(document.cost.seconds)
        if document.fit is not None:
            self._fitted += 1
            self._explained += document.fit.explained
        self._statuses.update((name, parameter.status) for name, parameter in document.parameters.items())
        for reason in document.window.quality.reasons:
            kind = FIGURE.sub("…", reason)  # "7 % missing" and "8 % missing" are the same kind
            self._reasons[kind] += 1
            self._examples.setdefault(kind, f"{reason} (window {document.window.index})")

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Parameters, components and findings of the last report, and the counts."""
        del console, options
        if self._first is None or self._last is None:
            yield Text("no window")
            return
        last = self._last
        yield title(last, f", from {time_text(self._first.window.start)} to {time_text(last.window.end)}")
        yield self._parameters(last)
        for name, parameter in last.parameters.items():
            if parameter.reason:
                yield Text(f"{name} in the last window: {parameter.reason}", style="yellow")
        for component in last.components:
            yield Text(f"{component_text(component)}, since {time_text(component.onset)}", style="bold red")
        shown = {component.id for component in last.components}
        for finding in last.findings:
            if finding.id not in shown:
                yield Text(finding_text(finding), style="red")
        yield from self._counts()

    def _parameters(self, last: ReportDocument) -> Table:
        table = parameter_table("last window", *Status)
        for name, parameter in last.parameters.items():
            status = Text(parameter.status, style=STYLES[parameter.status])
            counts = (str(self._statuses[name, kind]) for kind in Status)
            table.add_row(name, *value_cells(parameter), status, *counts)
        return table

    def _counts(self) -> Iterator[Text]:
        windows, bad = self._decisions.total(), self._decisions[WindowDecision.BAD]
        explained = f"the twin explains {self._explained} of {self._fitted} up to the noise"
        yield Text(f"{windows} windows: {windows - bad} good, {bad} bad; {explained}")
        if self._seconds and self._last is not None:
            length = self._last.window.end - self._last.window.start
            yield Text(computing_time_text(median(self._seconds), max(self._seconds), length))
        for decision, count in self._decisions.items():
            if decision not in (WindowDecision.LEARNED, WindowDecision.BAD):
                yield Text(f"  {count} good, but: {decision}", style="yellow")
        for kind, count in self._reasons.most_common(MAX_REASONS):
            yield Text(f"  {count} bad like: {self._examples[kind]}", style="red")


def replay(
    file: Path,
    data: Path,
    recording: Path | None,
    *,
    following: Sequence[Path] = (),
    as_json: bool,
    stopped: Callable[[], bool],
    real_time: bool = False,
    timing: bool = False,
) -> None:
    """Print the daemon's reports on ``data`` for the machine in ``file``: as JSON Lines, or as a summary.

    Each of the ``following`` files is another recording. With ``timing`` reports have computing times, which differ
    from run to run.

    Raises:
        OtolithError: a file that cannot be used.
    """
    machine = load_machine(file, with_driver=False)
    summary = ReplaySummary()
    with open_recordings(machine, (data, *following)) as recorded:
        if recorded.ignored:
            click.echo(f"{data}: columns not used: {', '.join(recorded.ignored)}", err=True)
        if not as_json:
            _echo_preview(machine, data, stopped)
        wait = RealTimePacer(stopped).wait if real_time else None
        run = Replay(machine, recorded, stopped, wait, timing=timing)
        with (
            ReplayRecorder(recording, machine.recorded(recorded.sampling)) as recorder,
            progress_line("reading", enabled=not as_json) as show,
        ):
            for report in run.reports():
                summary.add(report.document)
                recorder.add(report)
                show(f"window {report.document.window.index}, {run.progress:.0%} of the data")
                if as_json:
                    click.echo(report.document.to_json())
    if as_json:
        echo_warnings(data, run.warnings())
        return
    console = Console(highlight=False, width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    console.print(summary)
    for line in (run.summary(), *run.warnings()):
        console.print(line, markup=False, soft_wrap=True)


def _echo_preview(machine: LoadedMachine, data: Path, stopped: Callable[[], bool]) -> None:
    """Print to standard error what the first rows of ``data`` offer."""
    with suppress(OtolithError):  # the replay itself raises what is wrong with the file
        preview = preview_recording(machine, data, stopped, max_rows=PREVIEWED_ROWS)
        for line in short_lines(preview, PREVIEWED_ROWS):
            click.echo(line, err=True)
