"""``otolith replay``: recorded data through the very code of the daemon, as fast as the computer can or in real time.

    file -> rings -> windower -> heart -> report

The clock is the data's own, so two runs over the same files say the same, byte for byte.

Opening recorded data for a machine: a table, a log of its bus or one of our recordings.

Recorded windows in real time: each comes when it would have ended.
"""

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from otolith.acquisition.playback import OUTAGE, Playback, usual_step
from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.health.schema import CountersDocument, Report
from otolith.machine import LoadedMachine, NamedDriver, named_driver
from otolith.runtime.worker import Task, perform
from otolith_drivers.base import Setup, Signal
from otolith_drivers.config_files import read
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.replay.readers import Reader, format_of, holds_frames
from otolith_drivers.user_dirs import writable

if TYPE_CHECKING:
    from otolith.publishing.recorder import Recording


def open_recorded(plan: LoadedMachine, data: Path) -> Reader:
    """The signals of the twin of ``plan`` in ``data``.

    A log of a bus is decoded by what the machine file says of it; a table and a recording need no more than the names
    of the signals, but columns are looked for where a machine file with ``type = "replay"`` says that they are.

    Raises:
        ConfigurationError: no such file, not the signals that are needed, or nothing that tells what is in the frames.
    """
    kind = plan.file.driver.get("type")
    if kind == "replay":
        return _as_replayed(named_driver(plan.file, plan.twin, read(plan.path)), plan, data)
    if not holds_frames(data):
        return _by_name(plan, data)
    if kind != "can":
        needed = '[driver] with type = "can" and [signals] must say what is in its frames'
        raise ConfigurationError(f"{data}: a log of a CAN bus, and in {plan.path} {needed}")
    driver = named_driver(plan.file, plan.twin, read(plan.path))
    with driver.faults_placed():
        return format_of(data).open_log(data, driver.setup, driver.options)


def _by_name(plan: LoadedMachine, data: Path) -> Reader:
    format_ = format_of(data)
    signals = tuple(Signal(name, plan.twin.unit_of(name), format_.Source()) for name in plan.twin.signals)
    return format_.open_log(data, Setup(signals, plan.path.parent, plan.file.window.sample_period), None)


def _as_replayed(driver: NamedDriver, plan: LoadedMachine, data: Path) -> Reader:
    from otolith_drivers.replay.driver import opener  # noqa: PLC0415 - only for a machine file that names it

    if format_of(data) is not format_of(driver.options.file) and not holds_frames(data):
        return _by_name(plan, data)
    with driver.faults_placed():
        return opener(data, driver.options, driver.setup)()


TICK = 0.1  # s; how late a stop can be noticed


class RealTimePacer:
    """The data's clock beside the computer's. A long silence is passed over here, too."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped
        self._ahead: float | None = None  # s; how far the computer's clock is ahead of the data's
        self._end = 0.0

    def wait(self, window: Window) -> None:
        """Until the end of ``window``, or until it is stopped."""
        length = window.end - window.start
        if self._ahead is None:
            self._ahead = time.monotonic() - window.start
        elif window.start - self._end > OUTAGE * length:
            self._ahead -= window.start - self._end
        self._end = window.end
        while (left := window.end + self._ahead - time.monotonic()) > 0.0 and not self._stopped():
            time.sleep(min(left, TICK))


FEWEST_ROWS = 5  # in a window, for data that is meant in seconds
Stopped = Callable[[], bool]


class Replay:
    """One file through rings, windower and heart; ``stopped`` ends it early, ``wait`` holds each window up."""

    def __init__(
        self,
        plan: LoadedMachine,
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
        self._state = initial_state(machine.name, machine.site, plan.problem)
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
        for rows in self._data.chunks():
            if self._stopped():
                return
            if self._data.is_table and not self._playback.counts.rows:
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
    def state(self) -> AdaptationState:
        """After the last window."""
        return self._state

    def summary(self) -> str:
        """How much was read."""
        counts = self._playback.counts
        first, *rest = self._data.summary_lines()
        parts = ", ".join([first, f"{counts.reordered} reordered", *rest])
        return f"{parts}; {counts.received} samples, {counts.lost + self._data.lost} lost"

    def warnings(self) -> list[str]:
        """What a user should know of the file before trusting the reports, a line each."""
        counts, place = self._playback.counts, self._data.place
        lines = []
        if self._stopped():
            lines.append(f"interrupted after {self._data.progress:.0%} of the file")
        lines += self._data.warnings()
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
        return "; ".join([f"{what}: record for longer, or shorten [window] length", *self.warnings()])


class ReplayRecorder:
    """The ``.rrd`` file, begun with the first report; nothing without a path."""

    def __init__(self, path: Path | None, plan: LoadedMachine) -> None:
        self._path = path
        self._plan = plan
        self._recording: Recording | None = None

    def __enter__(self) -> "ReplayRecorder":
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
        from otolith.publishing.recorder import Recording, has_room  # noqa: PLC0415 - nobody else needs Rerun

        if self._recording is None:
            writable(self._path.parent)
        if not has_room(self._path):
            raise ServiceError(f"{self._path}: too little room is left on its disk")
        if self._recording is None:
            plan, machine = self._plan, self._plan.file.machine
            title = f"{machine.name} at {machine.site}"
            self._recording = Recording(self._path, title, plan.twin, plan.problem.free)
        self._recording.add(report)
