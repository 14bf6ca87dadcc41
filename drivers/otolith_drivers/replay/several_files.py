"""Several recorded files as one: one after the other, or merged by the times of their rows."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np

from otolith_drivers.base import Sampling, sampling_of
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Array, Mask, Reader, Rows


class ReaderGroup(Reader):
    """Several files as one; a file that cannot be opened is named before any is read."""

    def __init__(self, path: Path, opening: Iterable[tuple[str, Callable[[], Reader]]]) -> None:
        """``opening`` has a title for each file and what opens it; ``path`` stands for all files in messages."""
        super().__init__(path)
        with ExitStack() as opened:
            self._readers = [(title, opened.enter_context(open_file())) for title, open_file in opening]
            self._opened = opened.pop_all()
        self.place = f"its file's {self._readers[0][1].place}"
        self.ignored = tuple(dict.fromkeys(name for _, reader in self._readers for name in reader.ignored))

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        return sum(reader.progress for _, reader in self._readers) / len(self._readers)

    @property
    def bad(self) -> int:
        return sum(reader.bad for _, reader in self._readers)

    @property
    def lost(self) -> int:
        return sum(reader.lost for _, reader in self._readers)

    def summary_lines(self) -> list[str]:
        return [f"{title}: {', '.join(reader.summary_lines())}" for title, reader in self._readers]

    def warnings(self) -> list[str]:
        return [f"{reader.path}: {line}" for _, reader in self._readers for line in reader.warnings()]


class JoinedReader(ReaderGroup):
    """Reads files one after the other, in the order given."""

    def __init__(self, paths: Sequence[Path], open_file: Callable[[Path], Reader]) -> None:
        """Open all files; raise ConfigurationError if one cannot be opened, or their times have different meanings."""
        super().__init__(paths[0], ((path.name, partial(open_file, path)) for path in paths))
        readers = [reader for _, reader in self._readers]
        first = readers[0]
        for reader in readers:
            if reader.sampling != first.sampling:
                self._opened.close()
                kinds = f"{_kind(reader)} times, but {first.path} has {_kind(first)} ones"
                raise ConfigurationError(f"{reader.path}: {kinds}: replay them apart")
        self.is_table, self.sampling = first.is_table, first.sampling
        self._finished = 0

    @property
    def file(self) -> Path:
        return self._readers[min(self._finished, len(self._readers) - 1)][1].path

    def chunks(self) -> Iterator[Rows]:
        """See :meth:`Reader.chunks`; the first row of each file but the first is marked."""
        bad_before = 0
        for number, (_, reader) in enumerate(self._readers):
            is_first = number > 0
            for rows in reader.chunks():
                marks: Mask = rows.begins.copy()
                marks[0] |= is_first
                is_first = False
                yield Rows(rows.times, rows.columns, rows.lines, rows.bad + bad_before, marks)
            bad_before += reader.bad
            self._finished += 1

    def describe(self) -> list[str]:
        return [*self._readers[0][1].describe(), f"from {len(self._readers)} files, each a recording of its own"]


def _kind(reader: Reader) -> str:
    """Return the meaning of the times of a file."""
    kinds = reader.sampling
    return kinds if isinstance(kinds, Sampling) else ", ".join(f"{name} {kind}" for name, kind in kinds.items())


class _Feed:
    """The rows of a file that are not merged yet."""

    def __init__(self, reader: Reader, signals: Sequence[str]) -> None:
        self.path = reader.path
        self._chunks, self._signals = reader.chunks(), signals
        self._clock: Array = np.zeros(0)
        self._latest = -math.inf
        self._bad = 0
        self._rows: Rows | None = None
        self.end = -math.inf  # Time of the latest row that was read, s; infinity at the end of the file
        self.read()
        self.begin = float(self._clock[0]) if len(self._clock) else math.inf

    def read(self) -> None:
        """Read another chunk."""
        rows = next(self._chunks, None)
        if rows is None:
            self.end = math.inf
            return
        self._rows = rows if self._rows is None else self._rows.followed_by(rows)
        clock = np.maximum.accumulate(np.maximum(rows.times, self._latest))
        self._clock = np.concatenate([self._clock, clock])
        self.end = self._latest = float(clock[-1])

    def take(self, until: float) -> tuple[Array, Rows] | None:
        """Return and remove the rows up to ``until`` (s): their times, none of which decreases, and the rows.

        A signal that the file does not have is NaN; a row has its own number of bad lines instead of the sum.
        """
        count = int(np.searchsorted(self._clock, until, side="right"))
        if self._rows is None or not count:
            return None
        taken, clock = self._rows.part(slice(0, count)), self._clock[:count]
        self._rows, self._clock = self._rows.part(slice(count, None)), self._clock[count:]
        bad, self._bad = np.diff(taken.bad, prepend=self._bad), int(taken.bad[-1])
        blank = np.full(count, np.nan)
        columns = {name: taken.columns.get(name, blank) for name in self._signals}
        return clock, Rows(taken.times, columns, taken.lines, bad, taken.begins)

    @property
    def is_empty(self) -> bool:
        """Whether all rows that were read have been taken."""
        return not len(self._clock)


class MergedReader(ReaderGroup):
    """Reads the files of all sources at the same time; their times must be those of one clock."""

    def __init__(self, path: Path, signals: Mapping[str, Sequence[str]], open_source: Callable[[str], Reader]) -> None:
        """Open the file of each source; ``signals`` has those of each; ``path`` stands for all files in messages."""
        super().__init__(path, ((name, partial(open_source, name)) for name in signals))
        self._signals = [signal for names in signals.values() for signal in names]
        self.sampling = {
            signal: sampling_of(reader.sampling, signal) for name, reader in self._readers for signal in signals[name]
        }
        self._bad = 0

    def chunks(self) -> Iterator[Rows]:
        """The rows of all files by time; raise ConfigurationError also if one file ends before another begins."""
        feeds = [_Feed(reader, self._signals) for _, reader in self._readers]
        last = max(feeds, key=lambda feed: feed.begin)
        for feed in feeds:
            before = feed.end
            while feed.end < last.begin:
                before = feed.end
                feed.read()
            if math.isinf(feed.end) and before < last.begin:
                theirs = f"{last.path} begins at t = {last.begin:.12g} s"
                text = f"ends at t = {before:.12g} s, but {theirs}: both must have the times of one clock"
                raise ConfigurationError(f"{feed.path}: {text}")
        while not all(feed.is_empty and math.isinf(feed.end) for feed in feeds):
            until = min(feed.end for feed in feeds)
            parts = [part for feed in feeds if (part := feed.take(until)) is not None]
            for feed in feeds:
                if feed.end <= until and not math.isinf(feed.end):
                    feed.read()
            if parts:
                yield self._merged(parts)

    def _merged(self, parts: Sequence[tuple[Array, Rows]]) -> Rows:
        """Return the rows of all parts in the order of their times."""
        order = np.argsort(np.concatenate([clock for clock, _ in parts]), kind="stable")
        rows = parts[0][1]
        for _, others in parts[1:]:
            rows = rows.followed_by(others)
        columns = {name: values[order] for name, values in rows.columns.items()}
        bad = self._bad + np.cumsum(rows.bad[order])
        self._bad = int(bad[-1])
        return Rows(rows.times[order], columns, rows.lines[order], bad, rows.begins[order])

    def describe(self) -> list[str]:
        return [
            line for name, reader in self._readers for line in (f"source {name}: {reader.path}", *reader.describe())
        ]
