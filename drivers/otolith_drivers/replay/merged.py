"""Several files of one recording, one for each source of the machine, merged by the times of their rows."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

import numpy as np

from otolith_drivers.base import sampling_of
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Array, Reader, Rows


class _Feed:
    """The rows of a file that are not merged yet."""

    def __init__(self, reader: Reader, signals: Sequence[str]) -> None:
        self._chunks, self._signals = reader.chunks(), signals
        self._clock: Array = np.zeros(0)
        self._latest = -math.inf
        self._bad = 0
        self._rows: Rows | None = None
        self.end = -math.inf
        """Time of the latest row that was read, s; infinity at the end of the file."""
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


class MergedReader(Reader):
    """Reads the files of all sources at the same time; their times must be those of one clock."""

    def __init__(self, path: Path, signals: Mapping[str, Sequence[str]], open_source: Callable[[str], Reader]) -> None:
        """Open the file of each source; ``signals`` has those of each, and ``path`` stands for all files in messages.

        Raises:
            ConfigurationError: a file cannot be opened.
        """
        super().__init__(path)
        with ExitStack() as opened:
            self._readers = {name: opened.enter_context(open_source(name)) for name in signals}
            self._opened = opened.pop_all()
        self._signals = [signal for names in signals.values() for signal in names]
        self.place = f"its file's {next(iter(self._readers.values())).place}"
        self.sampling = {
            signal: sampling_of(reader.sampling, signal)
            for name, reader in self._readers.items()
            for signal in signals[name]
        }
        self.ignored = tuple(name for reader in self._readers.values() for name in reader.ignored)
        self._bad = 0

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        return sum(reader.progress for reader in self._readers.values()) / len(self._readers)

    @property
    def bad(self) -> int:
        """See :attr:`Reader.bad`."""
        return sum(reader.bad for reader in self._readers.values())

    @property
    def lost(self) -> int:
        """See :attr:`Reader.lost`."""
        return sum(reader.lost for reader in self._readers.values())

    def chunks(self) -> Iterator[Rows]:
        """See :meth:`Reader.chunks`; the rows of all files in the order of their times.

        Raises:
            ConfigurationError: also if one file ends before another one begins.
        """
        feeds = {name: _Feed(reader, self._signals) for name, reader in self._readers.items()}
        last = max(feeds, key=lambda name: feeds[name].begin)
        for name, feed in feeds.items():
            before = feed.end
            while feed.end < feeds[last].begin:
                before = feed.end
                feed.read()
            if math.isinf(feed.end) and before < feeds[last].begin:
                theirs = f"{self._readers[last].path} begins at t = {feeds[last].begin:.12g} s"
                text = f"ends at t = {before:.12g} s, but {theirs}: both must have the times of one clock"
                raise ConfigurationError(f"{self._readers[name].path}: {text}")
        while not all(feed.is_empty and math.isinf(feed.end) for feed in feeds.values()):
            until = min(feed.end for feed in feeds.values())
            parts = [part for feed in feeds.values() if (part := feed.take(until)) is not None]
            for feed in feeds.values():
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
        """See :meth:`Reader.describe`."""
        return [
            line
            for name, reader in self._readers.items()
            for line in (f"source {name}: {reader.path}", *reader.describe())
        ]

    def summary_lines(self) -> list[str]:
        """See :meth:`Reader.summary_lines`."""
        return [f"{name}: {', '.join(reader.summary_lines())}" for name, reader in self._readers.items()]

    def warnings(self) -> list[str]:
        """See :meth:`Reader.warnings`."""
        return [f"{reader.path}: {line}" for reader in self._readers.values() for line in reader.warnings()]
