"""A table of samples in a text file, read in stretches, so that its length does not matter.

A row is a moment, a column a signal. What is no number, or no row, is counted and left out; what is blank was never
measured.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.logs.heading import LONGEST_LINE, open_table, read_heading
from otolith_drivers.logs.rows import Rows
from otolith_drivers.logs.stretch import TableCounts, read_stretch

CHUNK = 1 << 20  # characters read at once


class Table:
    """One file, open."""

    def __init__(self, path: Path, units: Mapping[str, str]) -> None:
        """``units`` has the unit of each signal that must be there.

        Raises:
            ConfigurationError: no file, no text, or not the columns that are needed.
        """
        self.path = path
        self.counts = TableCounts()
        self._file = open_table(path)
        self._read = 0
        try:
            self._size = path.stat().st_size
            self._heading = read_heading(path, self._file, units)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> "Table":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._file.close()

    @property
    def ignored(self) -> tuple[str, ...]:
        """Columns that nobody asked for."""
        return self._heading.ignored

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return min(1.0, self._read / max(self._size, 1))

    def stretches(self) -> Iterator[Rows]:
        """All rows, some ten thousand at a time.

        Raises:
            ConfigurationError: none can be used, or a line is too long to be one.
        """
        number, rest = self._heading.line + 1, ""
        while text := self._file.read(CHUNK):
            self._read = self._file.buffer.tell()
            text, end, rest = (rest + text).rpartition("\n")
            self._check_length(text, number)
            if end:
                yield from self._rows(text, number)
                number += text.count("\n") + 1
            self._check_length(rest, number)
        yield from self._rows(rest, number)
        if not self.counts.rows:
            raise ConfigurationError(f"{self.path}{self._why_none()}")

    def _rows(self, text: str, first: int) -> Iterator[Rows]:
        rows = read_stretch(self._heading, self.counts, text, first)
        if rows is not None:
            yield rows

    def _check_length(self, text: str, first: int) -> None:
        lengths = list(map(len, text.split("\n")))
        longest = max(lengths)
        if longest > LONGEST_LINE:
            place = f"{self.path}:{first + lengths.index(longest)}"
            raise ConfigurationError(f"{place}: longer than {LONGEST_LINE} characters: is this a CSV file?")

    def _why_none(self) -> str:
        if self.counts.first_bad is None:
            return ": no rows under the names of its columns"
        line, cause = self.counts.first_bad
        return f":{line}: {cause}; none of the {self.counts.bad_rows} rows can be used"
