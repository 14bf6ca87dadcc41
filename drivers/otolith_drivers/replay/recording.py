"""A recording of Otolith (``.rrd``) as rows of numbers: the measured records of its windows.

A missing record is NaN in the file and no reading in the replay. The records of a cyclic source have the times of its
clock, not those of the arrivals; a window may have been bad because of when its samples came. So the records of bad
windows are left out. Delays that the machine file declared are added again, because a replay subtracts them.
"""

import re
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from otolith_drivers.base import Sampling, Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.replay.readers import Array, Integers, Mask, Reader, Rows
from otolith_drivers.units import factor

CHUNK = 50_000  # readings of all signals together; engineering choice, guarded by test_recorder.py
ROUNDING = 1e3  # ns: the end of a window and the start of the next one differ by the rounding of Unix seconds
MAX_NS, MIN_NS = np.iinfo(np.int64).max, np.iinfo(np.int64).min

# The layout of otolith.publishing.recorder.
APPLICATION, TIMELINE = "otolith", "time"
VALUES, NAMES = "Scalars:scalars", "SeriesLines:names"
FOLDER, WINDOWS, TIMES = "/signals/", "/windows", "/times"
TEXT = "TextDocument:text"
READ_ALL = "import sys; from rerun.chunk import RrdReader; [None for _ in RrdReader(sys.argv[1]).stream()]"
NAME = re.compile(r".* measured \[(.*)\]")  # of a series; the group is the unit


class TimesRecord(StrictModel):
    """What the times of a recording mean, as the recorder writes it."""

    sampling: Sampling | dict[str, Sampling]
    """Of all signals, or by signal."""
    delays: dict[str, float]
    """By signal, s."""


class RecordingSource(StrictModel):
    """No keys: a recording has the signals under their own names."""


Source = RecordingSource  # for readers.Format


def open_log(path: Path, setup: Setup, _: object = None) -> "RecordingReader":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    return RecordingReader(path, {signal.name: signal.unit for signal in setup.signals})


class RecordingReader(Reader):
    """A recording, read by Rerun; the library keeps no file open."""

    place = "record"
    bad = 0
    progress = 0.0

    def __init__(self, path: Path, units: dict[str, str]) -> None:
        """Read the file once for its signals; ``units`` has the unit of each wanted signal.

        Raises:
            ConfigurationError: the file is missing, damaged, of another program, or lacks a wanted signal.
        """
        super().__init__(path)
        self._records = 0
        if not path.is_file():
            raise ConfigurationError(f"{path}: cannot be read: {'is no file' if path.exists() else 'No such file'}")
        self._check_in_a_child()
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always", RerunWarning)
            self._file = self._guarded(RrdReader, path)
        self._closed = not raised
        self._bad_windows: list[tuple[float, float]] = []  # ns; from the first record to before the next window
        self._delays: dict[str, int] = {}  # ns; subtracted from the recorded times, so that the readings came later
        self._units, self._chunks = units, dict.fromkeys(units, 0)
        written = self._scan()
        self._bad_begins, self._bad_ends = np.array(sorted(self._bad_windows)).reshape(-1, 2).T
        self._scales = {name: self._scale(name, unit, written) for name, unit in units.items()}

    def _check_in_a_child(self) -> None:
        """Read the file once in a child process: the library's native code aborts on some damaged files.

        Raises:
            ConfigurationError: the child was killed by a signal.
        """
        command = [sys.executable, "-c", READ_ALL, str(self.path)]
        child = subprocess.run(command, capture_output=True, check=False)  # noqa: S603 - our own interpreter
        if child.returncode < 0:
            raise ConfigurationError(f"{self.path}: damaged, or no recording (its reader aborts); {self._repair}")

    @property
    def _repair(self) -> str:
        return f"'rerun rrd optimize --continue-on-error {self.path} -o whole.rrd' saves what is whole"

    def _guarded(self, step: Any, *arguments: Any) -> Any:
        """The result of a call of Rerun, which raises several types for a damaged file."""
        try:
            return step(*arguments)
        except (RuntimeError, ValueError, OSError) as error:
            cause = str(error).rpartition(": ")[2] or str(error)
            raise ConfigurationError(f"{self.path}: damaged, or no recording ({cause}); {self._repair}") from error

    def _stream(self) -> Iterator[Any]:
        chunks = iter(self._guarded(self._file.stream))
        while (chunk := self._guarded(next, chunks, None)) is not None:
            yield chunk

    def _scan(self) -> dict[str, str]:
        """The unit of every signal in the file. Counts the chunks of each wanted signal and notes the bad windows."""
        recordings = self._guarded(self._file.recordings)
        if len(recordings) != 1:
            raise ConfigurationError(f"{self.path}: {len(recordings)} recordings in it: one of Otolith is needed")
        if (application := recordings[0].application_id) != APPLICATION:
            raise ConfigurationError(f"{self.path}: of application {application!r}: one of Otolith is needed")
        units: dict[str, str] = {}
        for chunk in self._stream():
            name = _signal_of(chunk)
            if name and chunk.is_static:
                written = NAME.fullmatch(_series_name(chunk.to_record_batch()))
                units[name] = written[1] if written else ""
            elif name in self._chunks:
                self._chunks[name] += 1
            elif str(chunk.entity_path) == TIMES:
                self._note_times(self._guarded(chunk.to_record_batch).column(TEXT).to_pylist()[0][0])
            elif str(chunk.entity_path) == WINDOWS and not chunk.is_static:
                self._note_windows(chunk.to_record_batch().column(VALUES).to_pylist())
        return units

    def _note_times(self, text: str) -> None:
        """Note what the times mean."""
        try:
            written = TimesRecord.model_validate_json(text)
        except ValueError as error:
            known = ", ".join(Sampling)
            remedy = f"it needs sampling ({known}) and delays: was it written by a newer Otolith?"
            raise ConfigurationError(f"{self.path}: {TIMES} does not state what the times mean: {remedy}") from error
        self.sampling = written.sampling
        self._delays = {name: round(1e9 * delay) for name, delay in written.delays.items()}

    def _note_windows(self, windows: list[Any]) -> None:
        for window in windows:
            good, start, end, _ = window if len(window) == 4 else (1.0, 0.0, 0.0, 1.0)
            if not good:
                self._bad_windows.append((1e9 * start - ROUNDING, 1e9 * end - ROUNDING))

    def _scale(self, name: str, unit: str, written: dict[str, str]) -> tuple[float, float]:
        """Scale and offset from the recorded unit of a signal to ``unit``."""
        if name not in written or not self._chunks[name]:
            others = [other for other in written if other not in self._chunks]
            known = nearest(name, others) if others else f"it has {', '.join(sorted(written)) or 'none'}"
            raise ConfigurationError(f"{self.path}: no signal {name!r} ({unit}) was recorded: {known}")
        try:
            return factor(written[name], unit)
        except ValueError as error:
            raise ConfigurationError(f"{self.path}: signal {name!r}: {error}") from error

    def chunks(self) -> Iterator[Rows]:
        """See :meth:`otolith_drivers.replay.readers.Reader.chunks`."""
        buffers = {name: _SignalBuffer(count) for name, count in self._chunks.items()}
        total, read, fresh = sum(self._chunks.values()), 0, 0
        for chunk in self._stream():
            name = _signal_of(chunk)
            if name not in buffers or chunk.is_static:
                continue
            read += 1
            self.progress = read / total
            times, values = self._values(name, chunk)
            buffers[name].add(times, values)
            fresh += len(times)
            if fresh >= CHUNK and all(buffer.has_data for buffer in buffers.values()):
                fresh = 0
                yield from self._rows(buffers, min(buffer.complete_until for buffer in buffers.values()))
        yield from self._rows(buffers, MAX_NS)
        if not self._records:
            raise ConfigurationError(f"{self.path}: no records")

    def _values(self, name: str, chunk: Any) -> tuple[Integers, Array]:
        """Times in ns and values of a chunk in the unit of the signal; the measured series is the first of several."""
        batch = chunk.to_record_batch()
        times = batch.column(TIMELINE).cast(pa.int64()).to_numpy()
        lists = batch.column(VALUES)
        numbers = lists.flatten().to_numpy(zero_copy_only=False)
        width = len(numbers) // max(len(times), 1)
        if lists.null_count or not width or len(numbers) % len(times):
            self.bad += len(times)
            return times[:0], numbers[:0]
        scale, offset = self._scales[name]
        values = scale * numbers.reshape(len(times), width)[:, 0] + offset
        values[self._in_bad_window(times)] = np.nan
        return times + self._delays.get(name, 0), values

    def _rows(self, buffers: dict[str, "_SignalBuffer"], until: int) -> Iterator[Rows]:
        """The rows up to ``until`` (ns), one for each time at which any signal has a reading."""
        parts = {name: buffer.take(until) for name, buffer in buffers.items()}
        grid = np.unique(np.concatenate([times for times, _ in parts.values()]))
        if not len(grid):
            return
        columns = {}
        for name, (times, values) in parts.items():
            column = np.full(len(grid), np.nan)
            column[np.searchsorted(grid, times)] = values
            columns[name] = column
        first = self._records + 1
        self._records += len(grid)
        numbers = np.arange(first, self._records + 1)
        yield Rows(grid / 1e9, columns, numbers, np.full(len(grid), self.bad, dtype=np.int64))

    def _in_bad_window(self, times: Integers) -> Mask:
        if not self._bad_windows:
            return np.zeros(len(times), dtype=np.bool_)
        at = np.searchsorted(self._bad_begins, times, side="right") - 1
        inside: Mask = (at >= 0) & (times < self._bad_ends[at])
        return inside

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.describe`."""
        return [f"{name} [{unit}] from {FOLDER}{name}" for name, unit in self._units.items()]

    def summary_lines(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.summary_lines`."""
        return [f"{self._records} records read", f"{self.bad} bad"]

    def warnings(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.warnings`."""
        lines = [] if self._closed else ["never closed by the recorder: its last records may be missing"]
        if self._bad_windows:
            lines.append(f"windows that were bad when they were recorded, left out: {len(self._bad_windows)}")
        return lines


class _SignalBuffer:
    """Readings of one signal that wait for the other signals to reach their time."""

    def __init__(self, chunks: int) -> None:
        self._chunks_left = chunks
        self._times: list[Integers] = []
        self._values: list[Array] = []
        self._latest = MIN_NS

    def add(self, times: Integers, values: Array) -> None:
        self._chunks_left -= 1
        if len(times):
            self._times.append(times)
            self._values.append(values)
            self._latest = max(self._latest, int(times.max()))

    @property
    def complete_until(self) -> int:
        """Time in ns up to which all readings are here, if they come in order."""
        return MAX_NS if not self._chunks_left else self._latest

    @property
    def has_data(self) -> bool:
        return bool(self._times) or not self._chunks_left

    def take(self, until: int) -> tuple[Integers, Array]:
        """The readings up to ``until`` (ns), which are removed."""
        if not self._times:
            return np.zeros(0, dtype=np.int64), np.zeros(0)
        times, values = np.concatenate(self._times), np.concatenate(self._values)
        ready = times <= until
        self._times, self._values = [times[~ready]], [values[~ready]]
        return times[ready], values[ready]


def _signal_of(chunk: Any) -> str:
    path = str(chunk.entity_path)
    return path.removeprefix(FOLDER) if path.startswith(FOLDER) else ""


def _series_name(batch: Any) -> str:
    if NAMES not in batch.schema.names:
        return ""
    names = batch.column(NAMES).to_pylist()
    return str(names[0][0]) if names and names[0] else ""
