"""Recorded files that follow one another, each a recording of its own, of which one is open at a time."""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import (
    RECORDING_HEAD,
    DamagedFileError,
    DataFile,
    Mask,
    Reader,
    Rows,
    head_of,
    of_files,
    suffix_of,
)
from otolith_drivers.replay.sample_names import RECORDING, sample_files

MAX_LISTED = 16  # files whose rows are counted one by one in a summary


@dataclass(frozen=True, slots=True)
class Position:
    """How far files were read, so that another reader can continue."""

    files: int = 0  # That were read to their end
    rows: int = 0  # Of the file after them
    bad: int = 0  # Of the files that were read to their end
    lost: int = 0  # Samples that those files lack


class JoinedReader(Reader):
    """Reads files one after the other, in the order given, of which one is open at a time."""

    def __init__(
        self,
        paths: Sequence[Path],
        open_file: Callable[[Path], Reader],
        begin: Position | None = None,
    ) -> None:
        """Try all files, or with ``begin`` open each when its turn comes: ``paths`` are those from that position on.

        Of a recording, which costs a process to open, only the first one is opened here; see :meth:`chunks`.

        Raises:
            ConfigurationError: a file cannot be opened, or its times have another meaning than those of the first one.
        """
        super().__init__(paths[0])
        self._paths, self._open_file, self._begin = tuple(paths), open_file, begin or Position()
        self._reader: Reader | None = None  # The present one, from which rows come
        self._taken = self._begin.rows  # Rows of the present file
        self._begins = False  # Whether the last rows are the first of their file
        self._rows = self._read = 0  # Rows; files that were read
        self._bad, self._lost = self._begin.bad, self._begin.lost  # In the files before the present one
        self._summaries: list[str] = []  # Of the files that were read
        self._told: list[tuple[Path, str]] = []  # Warnings of the files that were read to their end
        self._first: Reader | None = self._open_first()
        first = self._first
        self.place, self.is_table, self.sampling = f"its file's {first.place}", first.is_table, first.sampling
        self._description, ignored = first.describe(), list(first.ignored)
        try:
            for path in self._paths[1:] if begin is None else ():
                if costs_a_process(path):
                    continue
                with contextlib.suppress(DamagedFileError), open_file(path) as reader:  # told when its turn comes
                    self._check(reader)
                    ignored += reader.ignored
        except BaseException:
            self.__exit__(None, None, None)
            raise
        self.ignored = tuple(dict.fromkeys(ignored))

    def _open_first(self) -> Reader:
        """Open the first file that is not damaged; raise DamagedFileError if all are."""
        for path in self._paths:
            try:
                reader = self._open_file(path)
            except DamagedFileError:
                if path == self._paths[-1]:
                    raise
                continue
            self.path = path
            return reader
        raise AssertionError

    def _check(self, reader: Reader) -> None:
        if reader.sampling != self.sampling:
            kinds = f"{_kind(reader.sampling)} times, but {self.path} has {_kind(self.sampling)} ones"
            raise ConfigurationError(f"{reader.path}: {kinds}: replay them apart")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._first is not None:
            self._first.__exit__(kind, error, _)

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        return (self._read + (self._reader.progress if self._reader else 0.0)) / len(self._paths)

    @property
    def file(self) -> Path:
        return self._paths[min(self._read, len(self._paths) - 1)]

    @property
    def bad(self) -> int:
        return self._bad + (self._reader.bad if self._reader else 0)

    @property
    def lost(self) -> int:
        return self._lost + (self._reader.lost if self._reader else 0)

    @property
    def begins(self) -> bool:
        """Whether the last rows are the first of their file."""
        return self._begins

    @property
    def position(self) -> Position:
        """Where another reader continues after the rows so far."""
        return Position(self._begin.files + self._read, self._taken, self._bad, self._lost)

    def chunks(self) -> Iterator[Rows]:
        """See :meth:`Reader.chunks`; the first row of each file but the first is marked.

        A file that was not tried before is opened only here, so its error ends the reading.
        """
        for number, path in enumerate(self._paths, self._begin.files):
            try:
                yield from self._rows_of(number, path)
            except DamagedFileError as error:
                self._skip(path, error)

    def _rows_of(self, number: int, path: Path) -> Iterator[Rows]:
        """Yield the rows of a file; raises DamagedFileError only if there are none."""
        with self._opened(path) as reader:
            self._check(reader)
            self._reader = reader
            known = self._taken
            is_first = number > 0 and not known and bool(self._rows or self._begin.files)
            for rows in reader.chunks():
                if len(rows.times) <= known:
                    known -= len(rows.times)
                    continue
                part, known = rows.part(slice(known, None)), 0
                marks: Mask = part.begins.copy()
                marks[0] |= is_first
                self._begins, is_first = not self._taken, False
                self._rows += len(part.times)
                self._taken += len(part.times)
                yield Rows(part.times, part.columns, part.lines, part.bad + self._bad, marks)
        self._finish(reader)

    def _opened(self, path: Path) -> Reader:
        if self._first is not None and path == self.path:
            opened, self._first = self._first, None
            return opened
        return self._open_file(path)

    def _skip(self, path: Path, error: DamagedFileError) -> None:
        """Leave a damaged file out, and tell it."""
        self._summaries.append(f"{path.name}: damaged")
        self._told.append((path, f"left out: {error}"))
        self._reader, self._read, self._taken = None, self._read + 1, 0

    def _finish(self, reader: Reader) -> None:
        """Keep of a file that was read its counts and warnings alone: there may be thousands."""
        self._summaries.append(_summary(reader))
        self._told += [(reader.path, line) for line in reader.warnings()]
        self._bad, self._lost, self._reader = self._bad + reader.bad, self._lost + reader.lost, None
        self._read, self._taken = self._read + 1, 0

    def summary_lines(self) -> list[str]:
        if len(self._paths) > MAX_LISTED:
            return [f"{self._rows} rows of {self._read} of {len(self._paths)} files read", f"{self.bad} bad"]
        lines = self._summaries + ([] if self._reader is None else [_summary(self._reader)])
        return lines + [f"{path.name}: not read" for path in self._paths[len(lines) :]]

    def warnings(self) -> list[str]:
        reader = self._reader
        present = [] if reader is None else [(reader.path, line) for line in reader.warnings()]
        return of_files([*self._told, *present])

    @property
    def told(self) -> list[str]:
        """The warnings of the files that were read to their end."""
        return of_files(self._told)

    def describe(self) -> list[str]:
        return [*self._description, f"from {len(self._paths)} files, each a recording of its own"]


def _summary(reader: Reader) -> str:
    return f"{reader.path.name}: {', '.join(reader.summary_lines())}"


def costs_a_process(path: Path) -> bool:
    """Whether ``path`` is a recording without samples beside it.

    Raises ConfigurationError if it has only the name of one, or is missing.
    """
    if suffix_of(path) != RECORDING:
        return False
    if sample_files(path):
        return False
    DataFile(path).close()  # raises if it cannot be read
    if not head_of(path).startswith(RECORDING_HEAD):
        raise ConfigurationError(f"{path}: is no recording of Rerun, which its name says")
    return True


def _kind(kinds: Sampling | Mapping[str, Sampling]) -> str:
    """Return the meaning of the times of a file in words."""
    return kinds if isinstance(kinds, Sampling) else ", ".join(f"{name} {kind}" for name, kind in kinds.items())
