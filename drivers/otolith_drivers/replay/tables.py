"""A table of samples in a text file, read in stretches, so that its length does not matter.

A row is a moment, a column a signal. What is no number, or no row, is counted and left out; what is blank was never
measured.

Cells of a text table as numbers, a column at a time.

The first lines of a table: how it is written, and which column is which signal in which unit.

Some lines of a table as columns of numbers. What is no row or no number is counted, and said where it is.
"""

import codecs
import contextlib
import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter, methodcaller
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, TextIO

import numpy as np

from otolith_drivers.base import Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.replay.readers import LATEST, Array, Integers, Mask, Opened, Rows
from otolith_drivers.units import factor

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
BLANK = re.compile(r"^[ \t]*(?:[+-]?nan|n/?a|null|none)?[ \t]*$", re.IGNORECASE | re.MULTILINE)


def split_line(line: str, separator: str) -> list[str]:
    """The cells of one line; a quote that is never closed reaches to its end."""
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])


def split_lines(lines: Sequence[str], separator: str, *, quoted: bool) -> list[list[str]]:
    """The cells of each line; ``quoted`` says that there are quotes, which must not reach into the next line."""
    if quoted:
        return [split_line(line, separator) for line in lines]
    return list(map(methodcaller("split", separator), lines))


def is_blank(cell: str) -> bool:
    """Whether a cell says that there is no reading: empty, NaN, NA, null."""
    return BLANK.fullmatch(cell) is not None


def decimal_sign(texts: Collection[str]) -> str:
    """The one that most of ``texts`` use, empty if none uses any."""
    points, commas = (sum(text.count(sign) for text in texts) for sign in ".,")
    return "" if points == commas == 0 else "," if commas > points else "."


def numbers(text: str, decimal: str) -> Array:
    """One number per line of ``text``: not a number where the cell is blank, infinite where it is no number.

    A decimal sign other than ``decimal`` makes no number, as it may stand between thousands.
    """
    if decimal == ",":
        text = text.replace(".", "?").replace(",", ".")
    if "_" not in text:  # which Python takes for a part of a number
        with contextlib.suppress(ValueError):
            return np.array(text.split("\n"), dtype=np.float64)
        with contextlib.suppress(ValueError):
            return np.array(BLANK.sub("nan", text).split("\n"), dtype=np.float64)
    return np.array([_number(cell.strip()) for cell in text.split("\n")])


def _number(cell: str) -> float:
    if is_blank(cell):
        return math.nan
    return float(cell) if NUMBER.fullmatch(cell) else math.inf


TIME, SECONDS = "t", "s"
SEPARATORS = (";", "\t", ",")
LONGEST_LINE = 100_000  # characters
CELL = re.compile(r"(.*?)\s*(?:\[(.*)\])?")
EXCEL = re.compile(r"sep=(.)")  # a line by which Excel tells itself the separator


class Column(NamedTuple):
    """Which cell of a row a signal is, from 0, and how its numbers become its unit: ``scale * number + offset``."""

    place: int
    scale: float = 1.0
    offset: float = 0.0


class ColumnRequest(NamedTuple):
    """A signal that is to be found: its column, its unit, and the one of the column if somebody else said it."""

    column: str
    unit: str
    written: str | None = None


@dataclass(frozen=True, slots=True)
class Heading:
    """What the line with the names of the columns says."""

    line: int
    """Its number, from 1."""
    separator: str
    widths: tuple[int, int]
    """Cells in a row, at least and at most: columns without a name at the end need not be there."""
    columns: dict[str, Column]
    """Of time and of every signal."""
    ignored: tuple[str, ...]
    """Columns that nobody asked for."""


def as_text(path: Path, file: Opened) -> TextIO:
    """The text of a table, whatever its line ends: UTF-8, or what older exports write.

    Raises:
        ConfigurationError: no text.
    """
    head = file.stream.peek()
    if b"\0" in head:
        raise ConfigurationError(f"{path}: is no text (packed, a spreadsheet or UTF-16): save it as CSV in UTF-8")
    return io.TextIOWrapper(file.stream, encoding=_encoding(head), errors="replace")


def _encoding(head: bytes) -> str:
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "utf-8-sig" if head.startswith(codecs.BOM_UTF8) else "cp1252"
    return "utf-8-sig"


def read_heading(path: Path, file: TextIO, wanted: Mapping[str, ColumnRequest]) -> Heading:
    """The heading of ``file``, read up to the end of that line.

    Raises:
        ConfigurationError: no heading, a column that is missing or twice there, a unit that does not fit.
    """
    number, line, separator = _heading_line(path, file)
    cells = [cell.strip() for cell in split_line(line, separator)]
    place = f"{path}:{number}"
    wanted = {TIME: ColumnRequest(TIME, SECONDS), **wanted}
    known = list(dict.fromkeys(entry.column for entry in wanted.values()))
    if any(cells) and all(NUMBER.fullmatch(cell.replace(",", ".")) for cell in cells if cell):
        raise ConfigurationError(f"{place}: numbers, where the names of the columns must stand: {', '.join(known)}")
    places: dict[str, tuple[int, str | None]] = {}
    others = []
    for index, cell in enumerate(cells):
        name, written = _name_and_unit(cell)
        if name not in known:
            others += [name] if name else []
        elif name in places:
            raise ConfigurationError(f"{place}: column {index + 1} ({cell!r}): {name} is there twice: leave one out")
        else:
            places[name] = (index, written)
    columns: dict[str, Column] = {}
    for signal, entry in wanted.items():
        if entry.column not in places:
            raise ConfigurationError(f"{place}: {_missing(entry, others, cells)}")
        index, written = places[entry.column]
        where = f"{place}: column {index + 1} ({cells[index]!r})"
        columns[signal] = _column(index, entry.written or written, entry.unit, where)
    named = max(index for index, cell in enumerate(cells) if cell) + 1
    return Heading(number, separator, (named, len(cells)), columns, tuple(others))


def _heading_line(path: Path, file: TextIO) -> tuple[int, str, str]:
    """Number, text and separator of the first line that is neither blank nor a comment."""
    number, told = 0, ""
    while line := file.readline(LONGEST_LINE):
        number += 1
        if len(line) == LONGEST_LINE:
            raise ConfigurationError(f"{path}:{number}: longer than {LONGEST_LINE} characters: is this a CSV file?")
        line = line.strip("\n")
        if excel := EXCEL.fullmatch(line.strip()):
            told = excel[1]
        elif line.strip() and not line.lstrip().startswith("#"):
            return number, line, told or next((sign for sign in SEPARATORS if sign in line), ",")
    raise ConfigurationError(f"{path}: {'has only comments' if number else 'is empty'}: a line with names is needed")


def _name_and_unit(cell: str) -> tuple[str, str | None]:
    match = CELL.fullmatch(cell)
    return (match[1], match[2]) if match else (cell, None)


def _column(index: int, unit: str | None, target: str, place: str) -> Column:
    if unit is None:
        return Column(index)
    try:
        return Column(index, *factor(unit, target))
    except ValueError as error:
        raise ConfigurationError(f"{place}: {error}") from error


def _missing(entry: ColumnRequest, others: list[str], cells: list[str]) -> str:
    what = f"no column {entry.column!r} ({'seconds' if entry.column == TIME else entry.unit})"
    if len(cells) < 2:
        return f"{what}, and no ',', ';' or tab between columns"
    return f"{what}: {nearest(entry.column, others) if others else 'add it'}"


@dataclass(slots=True)
class TableCounts:
    """What was found so far."""

    rows: int = 0
    """That could be used."""
    blank: int = 0
    """Cells without a reading."""
    bad_cells: int = 0
    bad_rows: int = 0
    """Of another number of cells than the heading has, or without a time."""
    first_bad: tuple[int, str] | None = None
    """Line and cause of the first of either."""
    decimal: str = ""
    """The decimal sign, as soon as there was one."""


def read_stretch(heading: Heading, counts: TableCounts, text: str, first: int) -> Rows | None:
    """The rows in ``text``, of which the first line has the number ``first``; None if there are none."""
    return _Stretch(heading, counts, text, first).rows()


class _Stretch:
    def __init__(self, heading: Heading, counts: TableCounts, text: str, first: int) -> None:
        self._heading = heading
        self._counts = counts
        self._first = first
        self._has_remarks = "#" in text
        self._lines = text.split("\n")
        self._cells = split_lines(self._lines, heading.separator, quoted='"' in text)
        self._bad = np.zeros(len(self._lines), dtype=np.int64)

    def rows(self) -> Rows | None:
        before = self._counts.bad_rows + self._counts.bad_cells
        kept = np.flatnonzero(self._shaped())
        if not len(kept):
            return None
        read = self._read(kept)
        timed = self._timed(read[TIME], kept)
        kept, read = kept[timed], {name: values[timed] for name, values in read.items()}
        if not len(kept):
            return None
        times = read.pop(TIME)
        for name, values in read.items():
            self._judge(name, values, kept)
        self._counts.rows += len(kept)
        return Rows(times, read, kept + self._first, before + np.cumsum(self._bad)[kept])

    def _shaped(self) -> Mask:
        """Which lines have a cell for each column; comments and blank lines are passed over."""
        least, most = self._heading.widths
        widths = np.fromiter(map(len, self._cells), np.int64, len(self._cells))
        shaped: Mask = (widths >= least) & (widths <= most)
        for index in np.flatnonzero(~shaped).tolist():
            cells = self._cells[index]
            if len(cells) > most and not any(cell.strip() for cell in cells[most:]):
                shaped[index] = True
            elif any(cell.strip() for cell in cells) and not self._is_remark(index):
                self._note_row(index, f"{len(cells)} cells, but {most} columns{self._hint()}")
        if self._has_remarks:
            shaped[[index for index in np.flatnonzero(shaped).tolist() if self._is_remark(index)]] = False
        return shaped

    def _is_remark(self, index: int) -> bool:
        return self._lines[index].lstrip().startswith("#")

    def _hint(self) -> str:
        return " (a decimal comma needs ';' or a tab between cells)" if self._heading.separator == "," else ""

    def _read(self, kept: Integers) -> dict[str, Array]:
        cells: Iterable[list[str]] = self._cells
        if len(kept) < len(self._cells):
            cells = [self._cells[index] for index in kept]
        columns = self._heading.columns
        texts = {name: "\n".join(map(itemgetter(column.place), cells)) for name, column in columns.items()}
        counts = self._counts
        counts.decimal = counts.decimal or decimal_sign(texts.values())
        with np.errstate(over="ignore"):  # beyond all numbers is no number
            return {
                name: columns[name].scale * numbers(text, counts.decimal) + columns[name].offset
                for name, text in texts.items()
            }

    def _timed(self, times: Array, kept: Integers) -> Mask:
        """Which of the rows ``kept`` have a time."""
        timed: Mask = np.abs(times) <= LATEST
        for index in kept[~timed].tolist():
            cell = self._cells[index][self._heading.columns[TIME].place]
            if not is_blank(cell):
                self._note_row(index, f"t is {cell!r}: write seconds, relative or Unix, or name the unit like 't [ms]'")
            elif any(cell.strip() for cell in self._cells[index]):
                self._note_row(index, "a row without t")
        return timed

    def _judge(self, name: str, values: Array, kept: Integers) -> None:
        """Count what a column lacks; what is no number becomes not a number."""
        wrong = np.isinf(values)
        self._counts.blank += int(np.count_nonzero(np.isnan(values)))
        if not wrong.any():
            return
        values[wrong] = np.nan
        self._bad[kept[wrong]] += 1
        self._counts.bad_cells += int(np.count_nonzero(wrong))
        index = int(kept[wrong][0])
        cell = self._cells[index][self._heading.columns[name].place]
        self._note(index, f"{name} is {cell!r}, no number")

    def _note_row(self, index: int, cause: str) -> None:
        self._bad[index] += 1
        self._counts.bad_rows += 1
        self._note(index, cause)

    def _note(self, index: int, cause: str) -> None:
        line = self._first + index
        if self._counts.first_bad is None or line < self._counts.first_bad[0]:
            self._counts.first_bad = (line, cause)


CHUNK = 1 << 20  # characters read at once


class Source(StrictModel):
    """Which column a signal is."""

    column: str | None = None
    """Its name; without it, that of the signal."""
    unit: str | None = None
    """Of the numbers in it, where the name of the column does not say it."""


def open_log(path: Path, setup: Setup, _: object = None) -> "Table":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    units = {signal.name: signal.unit for signal in setup.signals}
    return Table(path, units, {signal.name: signal.source for signal in setup.signals})


class Table:
    """Implements :class:`otolith_drivers.replay.readers.Reader`."""

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
        self._wanted = {
            name: ColumnRequest(source.column or name, units[name], source.unit) for name, source in found.items()
        }
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
        """See :meth:`otolith_drivers.replay.readers.Reader.describe`."""
        return [f"{name} [{entry.unit}] from column {entry.column!r}" for name, entry in self._wanted.items()]

    def summary_lines(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.found`."""
        counts = self.counts
        parts = [f"{counts.rows} rows read", f"{counts.bad_rows} bad rows", f"{counts.bad_cells} bad cells"]
        return [*parts, f"{counts.blank} cells blank"]

    def warnings(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.complaints`."""
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
