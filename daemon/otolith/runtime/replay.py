"""``otolith replay``: recorded data through the code of the daemon, as fast as possible or in real time.

    file -> rings -> windower -> adaptation core -> report

The clock is that of the data, so two runs over the same files give the same reports, byte for byte.
"""

import contextlib
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from otolith.acquisition.playback import MAX_SILENT_WINDOWS, RecordingStatistics, median_step
from otolith.acquisition.quality import is_of_calendar, time_text
from otolith.acquisition.window import Window
from otolith.adaptation.state import AdaptationState
from otolith.health.schema import Report
from otolith.health.times import moment_text
from otolith.machine import LoadedMachine, RecordedMachine
from otolith.machine_file import DriverConfig, driver_configs, signal_units
from otolith.runtime.segment import Player, first_state
from otolith.storage.recording_files import MIN_FREE_BYTES, recordings_in, shortage_of
from otolith_drivers.base import Setup, Signal
from otolith_drivers.config_files import read
from otolith_drivers.errors import ConfigurationError, ServiceError, counted
from otolith_drivers.replay.joined import JoinedReader
from otolith_drivers.replay.readers import MergedReader, Reader, Rows, format_of, holds_frames
from otolith_drivers.replay.span import SpanReader
from otolith_drivers.user_dirs import writable

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_SLEEP = 0.1  # s; bounds the reaction time to a stop signal
MIN_ROWS_PER_WINDOW = 5  # fewer rows than this suggest that the time column is not in seconds

Stopped = Callable[[], bool]


def open_recorded(machine: LoadedMachine, data: Path) -> Reader:
    """Open ``data`` as the signals of the twin of ``machine``.

    A log of a CAN bus is decoded by ``[driver]`` and ``[signals]``. A table or a recording needs only the names of
    the signals, and uses the columns of ``[signals]`` if the machine file has ``type = "replay"``. The logs of several
    sources are one recording, written as ``drive=monday.log,encoder=monday.csv``.

    Raises:
        ConfigurationError: a file or a signal is missing, or the machine file does not describe the frames.
    """
    names = [str(table.get("name")) for table in machine.file.drivers if "name" in table]
    if files := _files_of_sources(names, data):
        return _open_sources(machine, data, files)
    has_frames, tables = holds_frames(data), machine.file.drivers
    if has_frames and len(tables) > 1:
        needed = ",".join(f"{name}=FILE" for name in names)
        raise ConfigurationError(f"{data}: a log of one bus, but {machine.path} has {len(tables)} sources: {needed}")
    kind = tables[0].get("type") if len(tables) == 1 else None
    if has_frames and kind not in ("can", "replay"):
        needed = '[driver] with type = "can" and [signals] must describe its frames'
        raise ConfigurationError(f"{data}: a log of a CAN bus, and in {machine.path} {needed}")
    if not has_frames and kind != "replay":
        return open_by_name(machine, data, (*machine.twin.signals, *machine.observed))
    (config,) = driver_configs(machine.file, machine.twin, read(machine.path))
    return _open_as(machine, data, config)


def _files_of_sources(names: Sequence[str], data: Path) -> dict[str, Path]:
    """Return the file of each source that ``data`` names; empty if it is a file."""
    if data.exists() or not names:
        return {}
    parts = re.split(rf"(?:^|,)({'|'.join(map(re.escape, names))})=", str(data))
    return {} if parts[0] else dict(zip(parts[1::2], map(Path, parts[2::2]), strict=True))


def _open_sources(machine: LoadedMachine, data: Path, files: Mapping[str, Path]) -> Reader:
    """Open a file for each source as one recording; raise ConfigurationError if one is missing or unusable."""
    configs = {item.name: item for item in driver_configs(machine.file, machine.twin, read(machine.path))}
    for name in configs:
        if name not in files:
            raise ConfigurationError(f"{data}: no file of source {name!r}: append ,{name}=FILE")
    signals = {name: config.signals for name, config in configs.items()}
    return MergedReader(data, signals, lambda name: _open_as(machine, files[name], configs[name]))


def _open_as(machine: LoadedMachine, data: Path, config: DriverConfig) -> Reader:
    """Open ``data`` as what the driver of ``config`` reads."""
    has_frames, kind = holds_frames(data), config.kind
    if kind == "can" and has_frames:
        with config.located_errors():
            return format_of(data).open_log(data, config.setup, config.options)
    if has_frames and kind != "replay":
        raise ConfigurationError(f"{data}: a log of a CAN bus, but source {config.name!r} has type = {kind!r}")
    if kind != "replay" or (not has_frames and format_of(data).Source is not format_of(config.options.file).Source):
        return open_by_name(machine, data, config.signals)
    from otolith_drivers.replay.driver import opener  # noqa: PLC0415 - only for a machine file that names it

    with config.located_errors():
        return opener(data, config.options, config.setup)()


def open_recordings(machine: LoadedMachine, files: Sequence[Path]) -> Reader:
    """Open one file, or several recordings; see, and raises as, :func:`open_recorded`."""
    if len(files) == 1:
        return open_recorded(machine, files[0])
    return JoinedReader(files, lambda path: open_recorded(machine, path))


def open_span(machine: LoadedMachine, begin: float, end: float) -> Reader:
    """Open what the daemon of ``machine`` has recorded from ``begin`` to ``end`` (Unix s).

    Raises:
        ConfigurationError: nothing of that time was kept, or a recording cannot be used.
    """
    names, folder = machine.file.machine, machine.recording_folder
    own = [file for file in recordings_in(folder) if file.key == f"{names.site}.{names.name}"]
    files = [(file.begin, file.path) for file in own if file.begin <= end and file.end >= begin]
    if not files:
        when = partial(moment_text, zone=machine.plan.timezone)
        newest = max((file.end for file in own), default=None)
        until = "there is none of it" if newest is None else f"what is written ends at {when(newest)}"
        remedy = "some minutes are written at a time, and [recording] says for how long they are kept"
        span = f"from {when(begin)} to {when(end)}"
        raise ConfigurationError(f"{folder}: no recording of {names.name} {span}: {until}: {remedy}")
    return SpanReader(open_recordings(machine, [path for _, path in sorted(files)]), begin, end)


def open_by_name(machine: LoadedMachine, data: Path, names: Sequence[str]) -> Reader:
    """Open a table or recording whose columns have the ``names`` of signals; observed ones may be missing.

    Raises:
        ConfigurationError: the file cannot be used, or lacks one of the signals.
    """
    data_format, units = format_of(data), signal_units(machine.file, machine.twin)

    def opened(wanted: Sequence[str]) -> Reader:
        ordinary = machine.twin.ordinary_range
        signals = tuple(Signal(name, units[name], data_format.Source(), ordinary(name)) for name in wanted)
        period, zone = machine.file.window.sample_period, machine.file.machine.timezone
        return data_format.open_log(data, Setup(signals, machine.path.parent, period, zone), None)

    needed = [name for name in names if name not in machine.observed]
    if len(needed) < len(names):
        with contextlib.suppress(ConfigurationError):
            return opened(names)
    return opened(needed)


class RealTimePacer:
    """Delays each window until it would have ended; long silences are skipped."""

    def __init__(self, stopped: Stopped) -> None:
        self._stopped = stopped
        self._offset: float | None = None  # s; monotonic time minus time of the data
        self._end = 0.0

    def wait(self, window: Window) -> None:
        """Wait until the end of ``window``, or until the replay is stopped."""
        if self._offset is None:
            self._offset = time.monotonic() - window.start
        elif window.start - self._end > MAX_SILENT_WINDOWS * (window.end - window.start):
            self._offset -= window.start - self._end
        self._end = window.end
        while (left := window.end + self._offset - time.monotonic()) > 0.0 and not self._stopped():
            time.sleep(min(left, MAX_SLEEP))


@dataclass(slots=True)
class FileTimes:
    """Compares the times of files that are replayed one after the other."""

    gap: float  # Time without data between two files above which it is counted, s
    name: str = ""  # Of the present file
    begin: float = -math.inf  # Of the present file, s
    end: float = -math.inf  # s
    gaps: int = 0
    longest: float = 0.0  # s
    behind_gap: str = ""  # The file after the longest gap
    overlaps: int = 0
    first_overlap: str = ""

    def add(self, path: Path, rows: Rows, *, is_first: bool) -> None:
        """Note some rows of a file, which may be its first ones."""
        if is_first:
            if self.name:
                self._compare(float(rows.times[0]), path)
            self.name, self.begin, self.end = path.name, float(rows.times[0]), -math.inf
        self.end = max(self.end, float(rows.times.max()))

    def _compare(self, begin: float, path: Path) -> None:
        """Compare the ``begin`` of a file (s) with the end of the file before."""
        if begin - self.end > self.gap:
            self.gaps += 1
            if begin - self.end > self.longest:
                self.longest, self.behind_gap = begin - self.end, path.name
        own_clock = begin <= self.begin and not is_of_calendar(begin)  # it counts from its own start
        if begin <= self.end and not own_clock:
            self.overlaps += 1
            begins = f"{path.name} begins at {time_text(begin)}"
            self.first_overlap = self.first_overlap or f"{begins}, {self.name} ends at {time_text(self.end)}"

    def warnings(self) -> list[str]:
        """Return gaps and overlaps, one sentence each."""
        lines = []
        if self.gaps:
            longest = f"the longest of {self.longest:.6g} s, before {self.behind_gap}"
            lines.append(f"times without data between two files: {self.gaps}, {longest}")
        if self.overlaps:
            first = f"{self.first_overlap}: give the files in the order of their times"
            lines.append(f"files that begin before the one above ends: {self.overlaps}: {first}")
        return lines


class Replay:
    """One file through rings, windower and adaptation core."""

    def __init__(
        self,
        machine: LoadedMachine,
        data: Reader,
        stopped: Stopped = lambda: False,
        wait: Callable[[Window], None] | None = None,
        *,
        timing: bool = False,
    ) -> None:
        """``stopped`` ends the replay early; ``wait`` is called with each window before it is adapted to.

        With ``timing`` the reports have computing times, so that they differ from run to run.
        """
        self.statistics = RecordingStatistics(machine.twin.signals)  # Of the rows that were read so far
        self.progress = 0.0  # Share of the data in the windows so far, 0 to 1
        self._data = data
        self._stopped = stopped
        self._wait = wait
        self._length = machine.file.window.length
        self._files = FileTimes(self._length)
        self._player = Player(machine, first_state(machine, data.sampling), timing=timing)

    @property
    def state(self) -> AdaptationState:
        """What was learned up to the last window."""
        return self._player.adaptation

    @state.setter
    def state(self, state: AdaptationState) -> None:
        self._player.adaptation = state

    def reports(self) -> Iterator[Report]:
        """Yield the report of every window in order, with the counters at its end.

        Raises:
            ConfigurationError: the file has no usable row, its time runs backwards, or it is too short for a window.
        """
        for window in self.windows():
            if self._wait is not None:
                self._wait(window)
                if self._stopped():
                    return
            report = self._player.adapt(window, self._data.lost)
            if report is not None:
                yield report
            if self._stopped():
                return
        if not self._player.windows and not self._stopped():
            raise ConfigurationError(f"{self._data.path}: {self._why_no_window()}")

    def windows(self) -> Iterator[Window]:
        """Yield the windows of the file as the daemon would cut them; raises as :meth:`reports`."""
        before, begun, rows = 0.0, 0.0, None  # the shares of the file above the next and the present chunk
        file: Path | None = None
        for rows in self._data.chunks():
            if self._stopped():
                return
            is_first, file = self._data.file != file, self._data.file
            self._files.add(file, rows, is_first=is_first)
            if is_first:
                check_times(self._data, rows, self._length)
            self.statistics.add(rows)
            begun, before = before, self._data.progress
            yield from self._with_progress(self._player.playback.windows(rows), rows, begun)
        if rows is not None:
            yield from self._with_progress(self._player.playback.rest(), rows, begun)
        if not self._stopped():
            self.progress = 1.0

    def _with_progress(self, windows: Iterator[Window], rows: Rows, before: float) -> Iterator[Window]:
        """Yield ``windows``, each after the progress to its end; ``before`` is the share of the file above ``rows``."""
        after = max(self._data.progress, before)
        for window in windows:
            done = np.count_nonzero(rows.times < window.end) / max(len(rows.times), 1)
            self.progress = max(self.progress, before + (after - before) * float(done))
            yield window

    def summary(self) -> str:
        """Return in one line how much was read."""
        counts = self._player.playback.counts
        first, *rest = self._data.summary_lines()
        parts = ", ".join([first, f"{counts.reordered} reordered", *rest])
        return f"{parts}; {counted(counts.received, 'sample')}, {counts.lost + self._data.lost} lost"

    def warnings(self) -> list[str]:
        """Return what a user must know of the file before trusting the reports, one sentence each."""
        lines = [f"interrupted after {self.progress:.0%} of the data"] if self._stopped() else []
        return [*lines, *self._data.warnings(), *self._files.warnings(), *self._player.warnings(self._data.place)]

    def _why_no_window(self) -> str:
        rows = self._player.playback.counts.rows
        if rows > 1 and self.statistics.first == self.statistics.last:
            return (
                f"all {rows} rows have the same time, {time_text(self.statistics.first)}: write t with all its digits"
            )
        return "; ".join([self._player.why_no_window(), *self.warnings()])


def check_times(data: Reader, rows: Rows, length: float) -> None:
    """Raise ConfigurationError if the first rows of a file show that its times cannot be meant.

    ``length`` is that of a window, s. Time runs backwards if most rows that differ from the row above are before it,
    and the last before the first.
    """
    times, steps = rows.times, np.diff(rows.times)
    if len(times) > 2 and times[-1] < times[0] and 2 * np.count_nonzero(steps < 0.0) > np.count_nonzero(steps):
        raise ConfigurationError(f"{data.file}: time decreases from row to row: sort the rows by t")
    step = median_step(times)
    if not data.is_table or math.isinf(step) or step * MIN_ROWS_PER_WINDOW <= length:
        return
    mean = float(steps[steps > 0.0].sum()) / len(steps)  # smaller if times repeat
    if mean * MIN_ROWS_PER_WINDOW <= length:
        remedy = "write t with all its digits, or remove rows that repeat"
        raise ConfigurationError(f"{data.file}: {_standstill(rows)}: {remedy}")
    rate = f"one row every {step:.6g} s, but windows of {length:g} s"
    remedy = "if t is not in seconds, name the column 't [ms]' or the like"
    if 2 * np.count_nonzero(steps == 0.0) > len(steps):
        remedy += f"; {_standstill(rows)}, so write t with all its digits"
    raise ConfigurationError(f"{data.file}: {rate}: {remedy}")


def _standstill(rows: Rows) -> str:
    """Return where most rows in a row have the same time."""
    begins = np.flatnonzero(np.diff(rows.times, prepend=np.nan, append=np.nan))
    longest = int(np.argmax(np.diff(begins)))
    first, last = int(begins[longest]), int(begins[longest + 1]) - 1
    time = time_text(float(rows.times[first]))
    return f"the time is {time} from line {rows.lines[first]} to line {rows.lines[last]}"


@contextlib.contextmanager
def replay_recorder(path: Path | None, source: RecordedMachine) -> Iterator[Callable[[Report], None]]:
    """Yield what records a report into the ``.rrd`` file ``path``, which the first one creates; nothing without a path.

    It raises ServiceError if the folder cannot be written, or its disk is full.
    """
    if path is None:
        yield lambda _: None
        return
    from otolith.publishing.recorder import Recording  # noqa: PLC0415 - takes 0.5 s

    recording: Recording | None = None

    def add(report: Report) -> None:
        nonlocal recording
        if recording is None:
            writable(path.parent)
        if shortage_of(path.parent) > 0:
            raise ServiceError(f"{path}: less than {MIN_FREE_BYTES >> 20} MB are free on its disk")
        recording = recording or Recording(path, source)
        recording.add(report)

    try:
        yield add
    finally:
        if recording is not None:
            recording.close()
