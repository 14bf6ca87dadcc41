"""The first lines of a table: how it is written, and which column is which signal in which unit."""

import codecs
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TextIO

from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.logs.cells import NUMBER, split_line
from otolith_drivers.logs.files import Opened
from otolith_drivers.quantities import factor

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


class Wanted(NamedTuple):
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


def read_heading(path: Path, file: TextIO, wanted: Mapping[str, Wanted]) -> Heading:
    """The heading of ``file``, read up to the end of that line.

    Raises:
        ConfigurationError: no heading, a column that is missing or twice there, a unit that does not fit.
    """
    number, line, separator = _heading_line(path, file)
    cells = [cell.strip() for cell in split_line(line, separator)]
    place = f"{path}:{number}"
    wanted = {TIME: Wanted(TIME, SECONDS), **wanted}
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


def _missing(entry: Wanted, others: list[str], cells: list[str]) -> str:
    what = f"no column {entry.column!r} ({'seconds' if entry.column == TIME else entry.unit})"
    if len(cells) < 2:
        return f"{what}, and no ',', ';' or tab between columns"
    return f"{what}: {nearest(entry.column, others) if others else 'add it'}"
