"""A recording of Otolith as rows of numbers: the measured records of its windows.

The samples are in Parquet files beside the ``.rrd`` file (:mod:`otolith_drivers.replay.sample_files`). Recordings of
earlier versions have them in the ``.rrd`` file itself: its entity ``samples`` has a row for each window, packed.

A record that is missing is no reading in the replay. The records of a cyclic source have the times of its clock, not
those of the arrivals; a window may have been bad because of when its samples came. So the records of bad windows are
left out. Delays that the machine file declared are added again, because a replay subtracts them.

Packed records are the count of records and whether the window was good (5 bytes, little endian), then a zlib stream:
the differences of the times in ns, then each signal, the bytes of equal weight of all records next to each other.
"""

import contextlib
import json
import os
import struct
import subprocess
import sys
import zlib
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from otolith_drivers.base import Sampling, Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.replay import recording_child
from otolith_drivers.replay.readers import Array, DamagedFileError, DataFile, Integers, Mask, Reader, Rows
from otolith_drivers.replay.recording_child import END, FAULT, OPENED, PART, TIMES, TIMES_ENTITY, WINDOW
from otolith_drivers.replay.sample_files import TimesRecord, first_line, meaning_of, rows_of
from otolith_drivers.replay.sample_names import parts_folder, sample_files, viewing_file, whole_file
from otolith_drivers.units import factor

CHUNK = 50_000  # readings of all signals together; engineering choice, guarded by test_recorder.py
MAX_NS = np.iinfo(np.int64).max

APPLICATION = "otolith"  # as otolith.publishing.recorder names it
READ_IN_CHILD = [sys.executable, "-P", recording_child.__file__]
MAX_RECORDS = 1_000_000  # as many as a window of a machine file may have
HEADER = struct.Struct("<I?")
BEING_WRITTEN = "still being written: its last minutes are not in it yet"
NEVER_CLOSED = "never closed by the recorder: its last records may be missing"


def unpacked(data: bytes, signals: int) -> tuple[bool, Integers, Array]:
    """Return good or not, times (ns) and values (signals, records), bit for bit; raise ValueError for other data."""
    if len(data) < HEADER.size:
        raise ValueError("too short")
    count, good = HEADER.unpack_from(data)
    if count > MAX_RECORDS:
        raise ValueError(f"{count} records")
    size = 8 * count * (signals + 1)
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data[HEADER.size :], size + 1)  # the bound protects from a stream that expands
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(content) != size or not stream.eof:
        raise ValueError(f"{len(content)} bytes instead of {size}")
    words = np.frombuffer(content, dtype=np.uint8).reshape(signals + 1, 8, count).transpose(0, 2, 1)
    numbers = np.ascontiguousarray(words).reshape(signals + 1, count * 8)
    times = np.cumsum(numbers[0].view("<i8"), dtype=np.int64)
    return good, times, numbers[1:].view("<f8").astype(np.float64).reshape(signals, count)


class NoOptions(StrictModel):
    """Nothing is stated of a whole recording."""


class RecordingSource(StrictModel):
    """No keys: a recording has the signals under their own names."""


Source, Options = RecordingSource, NoOptions  # for readers.Format


def open_log(path: Path, setup: Setup, _: object = None) -> "RecordingReader":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    return open_recording(path, {signal.name: signal.unit for signal in setup.signals})


def open_recording(path: Path, units: Mapping[str, str]) -> "RecordingReader":
    """Open a recording, by its own path or by that of its samples; ``units`` has the unit of each wanted signal.

    Raises:
        DamagedFileError: none of its samples can be read.
        ConfigurationError: the file is missing, of another program, or lacks a wanted signal.
    """
    if sample_files(path):
        return SamplesReader(path, units)
    return PackedReader(path, units)


class _Parts:
    """The parts that a child process sends of a recording, which it reads once."""

    def __init__(self, path: Path) -> None:
        self.progress = 0.0  # Share of the file that was read, 0 to 1
        # In a process group of its own: Ctrl-C would end it, which does not mean that the file is damaged.
        self._child = subprocess.Popen(  # noqa: S603 - our own interpreter
            [*READ_IN_CHILD, str(path)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, process_group=0
        )

    def __iter__(self) -> Iterator[tuple[bytes, bytes]]:
        """Yield letter and content of each part; the last one is FAULT, without content if the child has aborted."""
        pipe = self._child.stdout
        assert pipe is not None  # noqa: S101 - for the type checker
        while len(head := pipe.read(PART.size)) == PART.size:
            letter, size, self.progress = PART.unpack(head)
            if len(content := pipe.read(size)) < size:
                break
            yield letter, content
            if letter in (END, FAULT):
                return
        yield FAULT, b""

    def close(self) -> None:
        """End the child."""
        self._child.kill()
        self._child.communicate()


class RecordingReader(Reader):
    """An open recording."""

    place = "record"
    bad = 0

    def __init__(self, path: Path, units: Mapping[str, str]) -> None:
        """``units`` has the unit of each wanted signal."""
        super().__init__(path)
        self._records = self._records_bad = 0
        self._delays: dict[str, int] = {}  # ns; subtracted from the recorded times, so that the readings came later
        self._units = units
        self._closed = True
        self._places: dict[str, int] = {}  # Of each recorded signal among the values
        self._scales: dict[str, tuple[float, float]] = {}

    @abstractmethod
    def _windows(self) -> Iterator[tuple[Integers, Array, Mask]]:
        """Yield times in ns, values (signals, records) and which records are of good windows, some at a time."""

    def _note_times(self, written: TimesRecord, *, has_windows: bool) -> None:
        """Note what the records mean."""
        self.sampling = written.sampling
        self._delays = {name: round(1e9 * delay) for name, delay in written.delays.items()}
        self._places = {name: place for place, name in enumerate(written.signals)}
        self._scales = {
            name: self._scale(name, unit, written.signals, has_windows=has_windows)
            for name, unit in self._units.items()
        }

    def _scale(self, name: str, unit: str, written: Mapping[str, str], *, has_windows: bool) -> tuple[float, float]:
        """Scale and offset from the recorded unit of a signal, in ``written``, to ``unit``."""
        if name in written and not has_windows:
            when = "its daemon ended before the first one" if self._closed else "some minutes are written at a time"
            raise ConfigurationError(f"{self.path}: no window is in it: {when}")
        if name not in written:
            others = [other for other in written if other not in self._units]
            known = nearest(name, others) if others else f"it has {', '.join(sorted(written)) or 'none'}"
            raise ConfigurationError(f"{self.path}: no signal {name!r} ({unit}) was recorded: {known}")
        try:
            return factor(written[name], unit)
        except ValueError as error:
            raise ConfigurationError(f"{self.path}: signal {name!r}: {error}") from error

    def chunks(self) -> Iterator[Rows]:
        buffers = {name: _SignalBuffer() for name in self._units}
        fresh, until = 0, 0
        for times, values, good in self._windows():
            if not len(times):
                continue
            self._records_bad += int(np.count_nonzero(~good))
            values[:, ~good] = np.nan
            for name, buffer in buffers.items():
                scale, offset = self._scales[name]
                buffer.add(times + self._delays.get(name, 0), scale * values[self._places[name]] + offset)
            fresh, until = fresh + values.size, times[-1] + min(self._delays.get(name, 0) for name in buffers)
            if fresh >= CHUNK:
                fresh = 0
                yield from self._rows(buffers, until)
        yield from self._rows(buffers, MAX_NS)
        if not self._records:
            raise DamagedFileError("; ".join([f"{self.path}: no records can be read", *self.warnings()]))

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

    def describe(self) -> list[str]:
        return [f"{name} [{unit}] from the samples" for name, unit in self._units.items()]

    def summary_lines(self) -> list[str]:
        return [f"{self._records} records read", f"{self.bad} bad"]

    def warnings(self) -> list[str]:
        lines = [] if self._closed else [BEING_WRITTEN if self._is_being_written() else NEVER_CLOSED]
        if self._records_bad:
            lines.append(f"records of windows that were bad when they were recorded, left out: {self._records_bad}")
        return lines

    def _is_being_written(self) -> bool:
        path = viewing_file(self.path)
        return path.exists() and is_being_written(path)


class SamplesReader(RecordingReader):
    """A recording whose samples are in Parquet files, of which one is open at a time; damaged ones are left out."""

    def __init__(self, path: Path, units: Mapping[str, str]) -> None:
        """Read what the records mean; raises as :func:`open_recording`."""
        super().__init__(path, units)
        self._files = sample_files(path)
        for file in self._files:
            DataFile(file).close()  # raises if it cannot be read
        self._closed = self._files == [whole_file(path)]
        self._damages: dict[Path, str] = {}
        self._read = 0  # Files that were read
        meanings, rows = list[TimesRecord](), 0
        for file in self._files:
            try:
                meaning, count = meaning_of(file)
            except (ValueError, OSError) as error:
                self._damages[file] = first_line(error)
                continue
            meanings, rows = [*meanings[:1], meaning], rows + count
            if meanings[0] != meaning:
                raise ConfigurationError(f"{file}: its times have another meaning than those of the files before it")
        if not meanings:
            raise DamagedFileError(f"{path}: its samples are damaged: {next(iter(self._damages.values()))}")
        self._note_times(meanings[0], has_windows=rows > 0)

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        return self._read / len(self._files)

    def _windows(self) -> Iterator[tuple[Integers, Array, Mask]]:
        count = len(self._places)
        for file in self._files:
            for part in () if file in self._damages else rows_of(file, count, CHUNK // max(1, count)):
                if isinstance(part, str):
                    self._damages[file] = part
                    self.bad += 1
                else:
                    yield part
            self._read += 1

    def warnings(self) -> list[str]:
        what = "is damaged, and left out or ends early"
        return [*super().warnings(), *(f"{file.name} {what}: {why}" for file, why in self._damages.items())]


class PackedReader(RecordingReader):
    """A recording of an earlier version, which a child process reads while it is replayed."""

    def __init__(self, path: Path, units: Mapping[str, str]) -> None:
        """Read the file as far as its first window; raises as :func:`open_recording`."""
        super().__init__(path, units)
        self._written: TimesRecord | None = None  # None until the file tells it
        self._ended = False
        DataFile(path).close()  # raises if it cannot be read
        self._child = _Parts(path)
        self._parts = iter(self._child)
        try:
            self._waiting = self._read_first_windows()
            self._note_times(self._stated(), has_windows=bool(self._waiting))
        except BaseException:
            self._child.close()
            raise

    def __exit__(self, *error: object) -> None:
        self._child.close()

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return 1.0 if self._ended else self._child.progress

    def _stated(self) -> TimesRecord:
        if self._written is None:
            own = f"{whole_file(self.path).name}, or in the folder {parts_folder(self.path).name}"
            raise ConfigurationError(f"{self.path}: has no samples: they are in {own}: put them beside it")
        return self._written

    def _read_first_windows(self) -> list[bytes]:
        """Read what the records mean, and return the windows up to there, one at least unless the file has none."""
        windows: list[bytes] = []
        while not self._ended and (self._written is None or not windows):
            windows += self._next_window()
        return windows

    def _next_window(self) -> list[bytes]:
        """Return the next window, or nothing if the next part is none; raise ConfigurationError for a damaged file."""
        letter, content = next(self._parts)
        if letter == WINDOW:
            return [content]
        if letter == OPENED:
            self._note_opened(json.loads(content))
        elif letter == TIMES:
            self._written = self._meaning(content.decode())
        elif letter == END:
            self._ended = True
        else:
            cause = content.decode(errors="replace") or "its reader aborts"
            raise ConfigurationError(f"{self.path}: damaged, or no recording ({cause}); {self._repair}")
        return []

    @property
    def _repair(self) -> str:
        return f"'rerun rrd optimize --continue-on-error {self.path} -o whole.rrd' saves what is whole"

    def _note_opened(self, opened: dict[str, Any]) -> None:
        applications = opened["applications"]
        if len(applications) != 1:
            raise ConfigurationError(f"{self.path}: {len(applications)} recordings in it: one of Otolith is needed")
        if applications[0] != APPLICATION:
            raise ConfigurationError(f"{self.path}: of application {applications[0]!r}: one of Otolith is needed")
        self._closed = opened["is_closed"]

    def _meaning(self, text: str) -> TimesRecord:
        try:
            return TimesRecord.model_validate_json(text)
        except ValueError as error:
            known = ", ".join(Sampling)
            remedy = f"it needs sampling ({known}), delays and signals: was it written by another version of Otolith?"
            raise ConfigurationError(
                f"{self.path}: {TIMES_ENTITY} does not state what the times mean: {remedy}"
            ) from error

    def _windows(self) -> Iterator[tuple[Integers, Array, Mask]]:
        windows = self._waiting
        while windows or not self._ended:
            for data in windows:
                try:
                    good, times, values = unpacked(data, len(self._places))
                except ValueError:
                    self.bad += 1
                    continue
                yield times, values, np.full(len(times), good)
            windows = [] if self._ended else self._next_window()


def is_being_written(path: Path) -> bool:
    """Whether a process has ``path`` open for writing, as far as this user may see the processes of this computer."""
    file = path.stat()
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError, ValueError, IndexError):  # it has ended, or is of another user
            opened = link.stat()
            if (opened.st_dev, opened.st_ino) == (file.st_dev, file.st_ino):
                information = (link.parents[1] / "fdinfo" / link.name).read_text(encoding="ascii")
                flags = int(information.partition("flags:")[2].split()[0], 8)
                if flags & os.O_ACCMODE != os.O_RDONLY:
                    return True
    return False


class _SignalBuffer:
    """Readings of one signal that wait for those of the same time of signals with another delay."""

    def __init__(self) -> None:
        self._times: list[Integers] = []
        self._values: list[Array] = []

    def add(self, times: Integers, values: Array) -> None:
        self._times.append(times)
        self._values.append(values)

    def take(self, until: int) -> tuple[Integers, Array]:
        """The readings up to ``until`` (ns), which are removed."""
        if not self._times:
            return np.zeros(0, dtype=np.int64), np.zeros(0)
        times, values = np.concatenate(self._times), np.concatenate(self._values)
        ready = times <= until
        self._times, self._values = [times[~ready]], [values[~ready]]
        return times[ready], values[ready]
