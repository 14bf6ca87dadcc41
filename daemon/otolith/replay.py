"""``otolith replay``: recorded data through the very code of the daemon, as fast as the computer can or in real time.

    file -> rings -> windower -> heart -> report

The clock is the data's own, so two runs over the same files say the same, byte for byte.
"""

import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from otolith.acquisition.playback import OUTAGE, Playback, usual_step
from otolith.acquisition.window import Array, Verdict, Window
from otolith.errors import ConfigurationError, ServiceError
from otolith.health.report import CountersDocument, Report
from otolith.pace import Pace
from otolith.paths import writable
from otolith.plan import Plan, load_plan
from otolith.recorded import open_recorded
from otolith.state import State, begin
from otolith.tally import Tally
from otolith.worker import Task, perform
from otolith_drivers.logs.rows import Reader
from otolith_drivers.logs.table import Table

if TYPE_CHECKING:
    from otolith.outlets.recorder import Recording

FEWEST_ROWS = 5  # in a window, for data that is meant in seconds
WIDTH = 110  # columns of a summary that goes into a file
Stopped = Callable[[], bool]


def replay(  # noqa: PLR0913 - the command has an option for each
    machine: Path, data: Path, recording: Path | None, *, as_json: bool, stopped: Stopped, real_time: bool = False
) -> None:
    """Print what the daemon of ``machine`` would have said of ``data``: its reports as JSON Lines, or a summary.

    Raises:
        OtolithError: a file that cannot be used.
    """
    plan = load_plan(machine, with_driver=False)
    tally = Tally()
    with open_recorded(plan, data) as recorded:
        if recorded.ignored:
            click.echo(f"{data}: columns not used: {', '.join(recorded.ignored)}", err=True)
        run = Replay(plan, recorded, stopped, Pace(stopped).wait if real_time else None)
        with _Recorder(recording, plan) as recorder, _bar(as_json=as_json) as bar:
            task = bar.add_task("", total=1.0)
            for report in run.reports():
                tally.add(report.document)
                recorder.add(report)
                bar.update(task, completed=recorded.progress, description=f"window {report.document.window.index}")
                if as_json:
                    click.echo(report.document.to_json())
    if as_json:
        for line in run.complaints():
            click.echo(f"{data}: {line}", err=True)
        return
    console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
    console.print(tally)
    for line in (run.summary(), *run.complaints()):
        console.print(line, markup=False, soft_wrap=True)


class Replay:
    """One file through rings, windower and heart; ``stopped`` ends it early, ``wait`` holds each window up."""

    def __init__(
        self,
        plan: Plan,
        data: Reader,
        stopped: Stopped = lambda: False,
        wait: Callable[[Window], None] | None = None,
    ) -> None:
        machine, window = plan.file.machine, plan.file.window
        self._data = data
        self._stopped = stopped
        self._wait = wait
        self._length = window.length
        self._playback = Playback(plan.twin.signals, plan.records, window.sample_period, plan.limits)
        self._state = begin(machine.name, machine.site, plan.problem)
        self._windows = self._windows_bad = self._missed = 0

    def reports(self) -> Iterator[Report]:
        """Of every window, in order, with the counters of the daemon as they were at its end.

        Raises:
            ConfigurationError: the file has no row that can be used, runs backwards, or makes no window.
        """
        for window in self.windows():
            if self._wait is not None:
                self._wait(window)
                if self._stopped():
                    return
            report = self._adapt(window)
            if report is not None:
                yield report
            if self._stopped():
                return
        if not self._windows and not self._stopped():
            raise ConfigurationError(f"{self._data.path}: {self._why_none()}")

    def windows(self) -> Iterator[Window]:
        """The windows of the file as the daemon would cut them; see :meth:`reports`."""
        for rows in self._data.stretches():
            if self._stopped():
                return
            if isinstance(self._data, Table) and not self._playback.counts.rows:
                self._check_pace(rows.times)
            yield from self._playback.windows(rows)
        counts = self._playback.counts
        if counts.rows > 2 and counts.reordered == counts.rows - 1:
            raise ConfigurationError(f"{self._data.path}: time runs backwards, from row to row: sort the rows by t")
        yield from self._playback.rest()

    def _check_pace(self, times: Array) -> None:
        step = usual_step(times)
        if math.isfinite(step) and step * FEWEST_ROWS > self._length:
            pace = f"a row every {step:.6g} s, but windows of {self._length:g} s"
            raise ConfigurationError(
                f"{self._data.path}: {pace}: if t is no second, name the column 't [ms]' or the like"
            )

    def _adapt(self, window: Window) -> Report | None:
        """The report of a window; None if the heart failed, which costs the daemon no more than that window either."""
        self._windows += 1
        self._windows_bad += window.quality.verdict is Verdict.BAD
        result = perform(Task(self._state, window))
        self._state = result.state
        self._playback.windower.records = result.state.records
        if result.report is None:
            self._missed += 1
            return None
        document = result.report.document.model_copy(update={"counters": self._counters()})
        return Report(document, result.report.traces)

    def _counters(self) -> CountersDocument:
        counts = self._playback.counts
        return CountersDocument(
            received=counts.received,
            bad=counts.bad,
            lost=counts.lost + self._data.lost,
            windows=self._windows,
            windows_bad=self._windows_bad,
            windows_missed=self._missed,
        )

    @property
    def state(self) -> State:
        """After the last window."""
        return self._state

    def summary(self) -> str:
        """How much was read."""
        counts = self._playback.counts
        first, *rest = self._data.found()
        parts = ", ".join([first, f"{counts.reordered} reordered", *rest])
        return f"{parts}; {counts.received} samples, {counts.lost + self._data.lost} lost"

    def complaints(self) -> list[str]:
        """What a user should know of the file before trusting the reports, a line each."""
        counts, place = self._playback.counts, self._data.place
        lines = []
        if self._stopped():
            lines.append(f"interrupted after {self._data.progress:.0%} of the file")
        lines += self._data.complaints()
        if counts.first_late is not None:
            line, time, latest = counts.first_late
            first = f"the first in {place} {line}, with t = {time:.12g} after t = {latest:.12g} above"
            lines.append(f"rows that came after their window was closed: {counts.late}, {first}")
        if counts.outages:
            lines.append(f"silences of more than {OUTAGE} windows, passed over: {counts.outages}")
        if self._missed:
            lines.append(f"windows that could not be computed: {self._missed}")
        if self._playback.left >= self._length / 2:
            lines.append(f"the last {self._playback.left:.3g} s make no window of {self._length:g} s")
        return lines

    def _why_none(self) -> str:
        rows = self._playback.counts.rows
        what = f"{rows} {'row makes' if rows == 1 else 'rows make'} no window of {self._length:g} s"
        return "; ".join([f"{what}: record for longer, or shorten [window] length", *self.complaints()])


class _Recorder:
    """The ``.rrd`` file, begun with the first report; nothing without a path."""

    def __init__(self, path: Path | None, plan: Plan) -> None:
        self._path = path
        self._plan = plan
        self._recording: Recording | None = None

    def __enter__(self) -> "_Recorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._recording is not None:
            self._recording.close()

    def add(self, report: Report) -> None:
        """Append a window.

        Raises:
            ServiceError: no room for it, or no such folder.
        """
        if self._path is None:
            return
        from otolith.outlets.recorder import Recording, has_room  # noqa: PLC0415 - nobody else needs Rerun

        if self._recording is None:
            writable(self._path.parent)
        if not has_room(self._path):
            raise ServiceError(f"{self._path}: too little room is left on its disk")
        if self._recording is None:
            plan, machine = self._plan, self._plan.file.machine
            title = f"{machine.name} at {machine.site}"
            self._recording = Recording(self._path, title, plan.twin, plan.problem.free)
        self._recording.add(report)


@contextlib.contextmanager
def _bar(*, as_json: bool) -> Iterator[Progress]:
    """On standard error, if somebody sees it."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=as_json or not console.is_terminal) as bar:
        yield bar
