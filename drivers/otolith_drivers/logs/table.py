"""A table of samples in a text file, read in stretches, so that its length does not matter.

A row is a moment, a column a signal. What is no number, or no row, is counted and left out; what is blank was never
measured.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from types import TracebackType

from otolith_drivers.base import Setup
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.logs.files import Opened
from otolith_drivers.logs.heading import LONGEST_LINE, Wanted, as_text, read_heading
from otolith_drivers.logs.rows import Rows
from otolith_drivers.logs.stretch import TableCounts, read_stretch
from otolith_drivers.toml_files import Closed

CHUNK = 1 << 20  # characters read at once


class Source(Closed):
    """Which column a signal is."""

    column: str | None = None
    """Its name; without it, that of the signal."""
    unit: str | None = None
    """Of the numbers in it, where the name of the column does not say it."""


def open_log(path: Path, setup: Setup, _: object = None) -> "Table":
    """See :meth:`otolith_drivers.logs.readers.Format.open_log`."""
    units = {signal.name: signal.unit for signal in setup.signals}
    return Table(path, units, {signal.name: signal.source for signal in setup.signals})


class Table:
    """Implements :class:`otolith_drivers.logs.rows.Reader`."""

    place = "line"
    lost = 0

    def __init__(self, path: Path, units: Mapping[str, str], sources: Mapping[str, Source] | None = None) -> None:
        """``units`` has the unit of each signal that must be there, ``sources`` where it is if not under its name.

        Raises:
            ConfigurationError: no file, no text, or not the columns that are needed.
        """
        self.path = path
        self.counts = TableCounts()
        self._opened = Opened(path)
        found = {name: (sources or {}).get(name, Source()) for name in units}
        self._wanted = {name: Wanted(source.column or name, units[name], source.unit) for name, source in found.items()}
        try:
            self._file = as_text(path, self._opened)
            self._heading = read_heading(path, self._file, self._wanted)
        except BaseException:
            self._opened.close()
            raise

    def __enter__(self) -> "Table":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._opened.close()

    @property
    def ignored(self) -> tuple[str, ...]:
        """Columns that nobody asked for."""
        return self._heading.ignored

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return self._opened.progress

    @property
    def bad(self) -> int:
        """Rows and cells."""
        return self.counts.bad_rows + self.counts.bad_cells

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.describe`."""
        return [f"{name} [{entry.unit}] from column {entry.column!r}" for name, entry in self._wanted.items()]

    def found(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.found`."""
        counts = self.counts
        parts = [f"{counts.rows} rows read", f"{counts.bad_rows} bad rows", f"{counts.bad_cells} bad cells"]
        return [*parts, f"{counts.blank} cells blank"]

    def complaints(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.complaints`."""
        counts, lines = self.counts, []
        if counts.first_bad is not None:
            line, cause = counts.first_bad
            lines.append(
                f"bad cells: {counts.bad_cells}, bad rows: {counts.bad_rows}, the first in line {line}: {cause}"
            )
        return lines + ([f"cut off: {self._opened.torn}"] if self._opened.torn else [])

    def stretches(self) -> Iterator[Rows]:
        """All rows, some ten thousand at a time.

        Raises:
            ConfigurationError: none can be used, or a line is too long to be one.
        """
        number, rest = self._heading.line + 1, ""
        while text := self._file.read(CHUNK):
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
