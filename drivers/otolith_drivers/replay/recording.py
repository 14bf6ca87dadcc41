"""Our own recordings, ``.rrd``: what was measured, record for record, as the windows had it.

Where a record was missing when it was recorded, the file has not a number, and the replay has no reading either. A
record stands on the grid, whenever its sample came. So a window that was bad then, perhaps for when its samples came,
is left out: nothing was estimated from it.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from otolith_drivers.base import Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.replay.readers import Array, Integers, Mask, Rows
from otolith_drivers.units import factor

APPLICATION, TIMELINE = "otolith", "time"
BATCH = 50_000  # readings, of all signals together
VALUES, NAMES = "Scalars:scalars", "SeriesLines:names"
FOLDER, WINDOWS = "/signals/", "/windows"
NAME = re.compile(r".* measured \[(.*)\]")


class Source(StrictModel):
    """Signals are found under their own names."""


def open_log(path: Path, setup: Setup, _: object = None) -> "Recorded":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    return Recorded(path, {signal.name: signal.unit for signal in setup.signals})


class Recorded:
    """Implements :class:`otolith_drivers.replay.readers.Reader`."""

    place = "record"
    ignored = ()
    lost = 0

    def __init__(self, path: Path, units: dict[str, str]) -> None:
        """Look through the file for what is in it; ``units`` has the unit of each signal that must be there.

        Raises:
            ConfigurationError: no such file, no whole one, not ours, or without a signal that is needed.
        """
        self.path = path
        self.bad = 0
        self.progress = 0.0
        self._records = 0
        if not path.is_file():
            raise ConfigurationError(f"{path}: cannot be read: {'is no file' if path.exists() else 'No such file'}")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", RerunWarning)
            self._file = self._guarded(RrdReader, path)
        self._closed = not said
        self._bad_windows: list[tuple[float, float]] = []  # ns; from the first record to before the next window
        self._units, self._chunks = units, dict.fromkeys(units, 0)
        written = self._look_through()
        self._scales = {name: self._scale(name, unit, written) for name, unit in units.items()}

    def __enter__(self) -> "Recorded":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """The library keeps no file open."""

    def _guarded(self, step: Any, *arguments: Any) -> Any:
        try:
            return step(*arguments)
        except (RuntimeError, ValueError, OSError) as error:
            cause = str(error).rpartition(": ")[2] or str(error)
            way_out = f"'rerun rrd optimize --continue-on-error {self.path} -o whole.rrd' saves what is whole"
            raise ConfigurationError(f"{self.path}: torn, or no recording ({cause}); {way_out}") from error

    def _stream(self) -> Iterator[Any]:
        chunks = iter(self._guarded(self._file.stream))
        while (chunk := self._guarded(next, chunks, None)) is not None:
            yield chunk

    def _look_through(self) -> dict[str, str]:
        """Count the chunks of each wanted signal; the unit of every signal there is."""
        found = self._guarded(self._file.recordings)
        if len(found) != 1 or found[0].application_id != APPLICATION:
            what = (
                f"{len(found)} recordings in it" if len(found) != 1 else f"of application {found[0].application_id!r}"
            )
            raise ConfigurationError(f"{self.path}: {what}: one of Otolith is needed")
        units: dict[str, str] = {}
        for chunk in self._stream():
            name = _signal_of(chunk)
            if name and chunk.is_static:
                written = NAME.fullmatch(_first_name(chunk.to_record_batch()))
                units[name] = written[1] if written else ""
            elif name in self._chunks:
                self._chunks[name] += 1
            elif str(chunk.entity_path) == WINDOWS and not chunk.is_static:
                self._note_windows(chunk.to_record_batch().column(VALUES).to_pylist())
        return units

    def _note_windows(self, windows: list[Any]) -> None:
        for entry in windows:
            good, start, end, records = entry if len(entry) == 4 else (1.0, 0.0, 0.0, 1.0)
            if not good:
                early = 0.5 * (end - start) / records
                self._bad_windows.append((1e9 * (start - early), 1e9 * (end - early)))

    def _scale(self, name: str, unit: str, written: dict[str, str]) -> tuple[float, float]:
        if name not in written or not self._chunks[name]:
            others = [entry for entry in written if entry not in self._chunks]
            known = nearest(name, others) if others else f"it has {', '.join(sorted(written)) or 'none'}"
            raise ConfigurationError(f"{self.path}: no signal {name!r} ({unit}) was recorded: {known}")
        try:
            return factor(written[name], unit)
        except ValueError as error:
            raise ConfigurationError(f"{self.path}: signal {name!r}: {error}") from error

    def stretches(self) -> Iterator[Rows]:
        """See :meth:`otolith_drivers.replay.readers.Reader.stretches`."""
        waiting = {name: _Waiting(count) for name, count in self._chunks.items()}
        total, read, fresh = sum(self._chunks.values()), 0, 0
        for chunk in self._stream():
            name = _signal_of(chunk)
            if name not in waiting or chunk.is_static:
                continue
            read += 1
            self.progress = read / total
            times, values = self._values(name, chunk)
            waiting[name].add(times, values)
            fresh += len(times)
            if fresh >= BATCH and all(entry.is_begun for entry in waiting.values()):
                fresh = 0
                yield from self._rows(waiting, min(entry.known_until for entry in waiting.values()))
        yield from self._rows(waiting, np.iinfo(np.int64).max)
        if not self._records:
            raise ConfigurationError(f"{self.path}: no records")

    def _values(self, name: str, chunk: Any) -> tuple[Integers, Array]:
        batch = chunk.to_record_batch()
        times = batch.column(TIMELINE).cast(pa.int64()).to_numpy()
        lists = batch.column(VALUES)
        numbers = lists.flatten().to_numpy(zero_copy_only=False)
        width = len(numbers) // max(len(times), 1)
        if lists.null_count or not width or len(numbers) % len(times):
            self.bad += len(times)
            return times[:0], numbers[:0]
        scale, offset = self._scales[name]
        return times, scale * numbers.reshape(len(times), width)[:, 0] + offset

    def _rows(self, waiting: dict[str, "_Waiting"], until: int) -> Iterator[Rows]:
        parts = {name: entry.take(until) for name, entry in waiting.items()}
        moments = np.unique(np.concatenate([times for times, _ in parts.values()]))
        if not len(moments):
            return
        left_out = self._left_out(moments)
        columns = {}
        for name, (times, values) in parts.items():
            column = np.full(len(moments), np.nan)
            column[np.searchsorted(moments, times)] = values
            columns[name] = np.where(left_out, np.nan, column)
        first = self._records + 1
        self._records += len(moments)
        yield Rows(
            moments / 1e9, columns, np.arange(first, self._records + 1), np.full(len(moments), self.bad, dtype=np.int64)
        )

    def _left_out(self, moments: Integers) -> Mask:
        first, last = float(moments[0]), float(moments[-1])
        outside: Mask = np.zeros(len(moments), dtype=np.bool_)
        for begin, end in self._bad_windows:
            if begin <= last and end > first:
                outside |= (moments >= begin) & (moments < end)
        return outside

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.describe`."""
        return [f"{name} [{unit}] from {FOLDER}{name}" for name, unit in self._units.items()]

    def summary_lines(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.found`."""
        return [f"{self._records} records read", f"{self.bad} bad"]

    def warnings(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.complaints`."""
        lines = [] if self._closed else ["never closed by the recorder: its last moments may be missing"]
        if self._bad_windows:
            lines.append(f"windows that were bad when they were recorded, left out: {len(self._bad_windows)}")
        return lines


class _Waiting:
    """What has come of one signal and cannot be handed on before the others are as far."""

    def __init__(self, chunks: int) -> None:
        self._left = chunks
        self._times: list[Integers] = []
        self._values: list[Array] = []
        self._latest = np.iinfo(np.int64).min

    def add(self, times: Integers, values: Array) -> None:
        self._left -= 1
        if len(times):
            self._times.append(times)
            self._values.append(values)
            self._latest = max(self._latest, int(times.max()))

    @property
    def known_until(self) -> int:
        """Nanoseconds up to which all of it is here, if it comes in order."""
        return np.iinfo(np.int64).max if not self._left else self._latest

    @property
    def is_begun(self) -> bool:
        return bool(self._times) or not self._left

    def take(self, until: int) -> tuple[Integers, Array]:
        if not self._times:
            return np.zeros(0, dtype=np.int64), np.zeros(0)
        times, values = np.concatenate(self._times), np.concatenate(self._values)
        ready = times <= until
        self._times, self._values = [times[~ready]], [values[~ready]]
        return times[ready], values[ready]


def _signal_of(chunk: Any) -> str:
    path = str(chunk.entity_path)
    return path.removeprefix(FOLDER) if path.startswith(FOLDER) else ""


def _first_name(batch: Any) -> str:
    if NAMES not in batch.schema.names:
        return ""
    names = batch.column(NAMES).to_pylist()
    return str(names[0][0]) if names and names[0] else ""
