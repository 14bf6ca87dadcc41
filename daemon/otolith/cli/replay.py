"""What many reports come to, for people: a table of parameters, and how the windows were."""

import contextlib
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import click
from rich.console import Console, ConsoleOptions, RenderResult
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from otolith.cli.live_table import STYLES, value_cells
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import ReportDocument, Status
from otolith.machine import load_machine
from otolith.runtime.replay import RealTimePacer, Replay, ReplayRecorder, open_recorded

WIDTH = 110  # columns of a summary that goes into a file
Stopped = Callable[[], bool]
MOST_REASONS = 5  # that are told
DATES = (1e8, 1e11)  # s since 1970: what is earlier counts from a beginning of its own, what is later is no second
FIGURE = re.compile(r"(?<![\w.])\d[\d.]*")


def time_text(seconds: float) -> str:
    """A time of the data: seconds as they are, or the date where they can only be those since 1970."""
    if not DATES[0] <= seconds < DATES[1]:
        return f"{round(seconds, 6) + 0.0:.12g} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%F %T}Z"


class ReplaySummary:
    """Takes reports, keeps the last one and counts; draws itself."""

    def __init__(self) -> None:
        self._first: ReportDocument | None = None
        self._last: ReportDocument | None = None
        self._windows = self._fitted = self._explained = 0
        self._lessons: Counter[WindowDecision] = Counter()
        self._statuses: dict[str, Counter[Status]] = {}
        self._reasons: Counter[str] = Counter()
        self._examples: dict[str, str] = {}

    def add(self, document: ReportDocument) -> None:
        """Count one report."""
        self._first = self._first or document
        self._last = document
        self._windows += 1
        self._lessons[document.decision] += 1
        if document.fit is not None:
            self._fitted += 1
            self._explained += document.fit.explained
        for name, parameter in document.parameters.items():
            self._statuses.setdefault(name, Counter())[parameter.status] += 1
        for reason in document.window.quality.reasons:
            kind = FIGURE.sub("…", reason)  # one window lacks 7 %, another 8 %
            self._reasons[kind] += 1
            self._examples.setdefault(kind, f"{reason} (window {document.window.index})")

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table and the counts."""
        del console, options
        if self._first is None or self._last is None:
            yield Text("no window")
            return
        last = self._last
        span = f"from {time_text(self._first.window.start)} to {time_text(last.window.end)}"
        yield Text.assemble((last.machine, "bold"), f" at {last.site}, twin {last.twin} ({last.model}), {span}")
        yield self._parameters(last)
        for name, parameter in last.parameters.items():
            if parameter.reason:
                yield Text(f"{name} in the last window: {parameter.reason}", style="yellow")
        for entry in last.components:
            yield Text(
                f"{entry.meaning}: {entry.equation}, since {time_text(entry.onset)} ({entry.approval})",
                style="bold red",
            )
        for finding in last.findings:
            if finding.id not in {entry.id for entry in last.components}:
                yield Text(" ".join(filter(None, [finding.text, finding.advice])), style="red")
        yield from self._words()

    def _parameters(self, last: ReportDocument) -> Table:
        table = Table(expand=False)
        for column in ("parameter", "value", "± 95 %", "unit", "change", "last window", *Status):
            right = column in ("value", "± 95 %", "change", *Status)
            table.add_column(column, justify="right" if right else "left", no_wrap=True)
        for name, parameter in last.parameters.items():
            status = Text(parameter.status, style=STYLES[parameter.status])
            counts = (str(self._statuses[name][kind]) for kind in Status)
            table.add_row(name, *value_cells(parameter), status, *counts)
        return table

    def _words(self) -> Iterator[Text]:
        bad = self._lessons[WindowDecision.BAD]
        explained = f"the twin explains {self._explained} of {self._fitted} up to the noise"
        yield Text(f"{self._windows} windows: {self._windows - bad} good, {bad} bad; {explained}")
        for decision, count in self._lessons.items():
            if decision not in (WindowDecision.LEARNED, WindowDecision.BAD):
                yield Text(f"  {count} good, but: {decision}", style="yellow")
        for kind, count in self._reasons.most_common(MOST_REASONS):
            yield Text(f"  {count} bad like: {self._examples[kind]}", style="red")


def replay(
    machine: Path, data: Path, recording: Path | None, *, as_json: bool, stopped: Stopped, real_time: bool = False
) -> None:
    """Print what the daemon of ``machine`` would have said of ``data``: its reports as JSON Lines, or a summary.

    Raises:
        OtolithError: a file that cannot be used.
    """
    plan = load_machine(machine, with_driver=False)
    tally = ReplaySummary()
    with open_recorded(plan, data) as recorded:
        if recorded.ignored:
            click.echo(f"{data}: columns not used: {', '.join(recorded.ignored)}", err=True)
        run = Replay(plan, recorded, stopped, RealTimePacer(stopped).wait if real_time else None)
        with ReplayRecorder(recording, plan) as recorder, _bar(as_json=as_json) as bar:
            task = bar.add_task("", total=1.0)
            for report in run.reports():
                tally.add(report.document)
                recorder.add(report)
                bar.update(task, completed=recorded.progress, description=f"window {report.document.window.index}")
                if as_json:
                    click.echo(report.document.to_json())
    if as_json:
        for line in run.warnings():
            click.echo(f"{data}: {line}", err=True)
        return
    console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
    console.print(tally)
    for line in (run.summary(), *run.warnings()):
        console.print(line, markup=False, soft_wrap=True)


@contextlib.contextmanager
def _bar(*, as_json: bool) -> Iterator[Progress]:
    """On standard error, if somebody sees it."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=as_json or not console.is_terminal) as bar:
        yield bar
