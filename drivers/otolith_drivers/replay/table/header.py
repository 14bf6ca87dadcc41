"""The header of a text table: which column has the time and which the signals, in which units, and what is asked."""

import contextlib
import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from otolith_drivers.config_files import Range
from otolith_drivers.errors import ConfigurationError, nearest, shown
from otolith_drivers.replay.readers import Array, seen
from otolith_drivers.replay.table.times import BESIDE_NAME, TimeRequest, contradiction, date_column, rises_evenly
from otolith_drivers.units import are_equal, factor, is_unit

# Engineering choice: a thousand columns need some 20 000. Bounds the memory for a file without line ends.
MAX_LINE = 100_000  # characters
TIME, SECONDS = "t", "s"  # column of the time, and its unit if the header names none
SEGMENT = "segment"  # optional column: a change of its text begins a new recording
SEPARATORS = (";", "\t", "|", ",")  # in this order: a comma may be a decimal sign
HEADER_CELL = re.compile(r"^(.*?)\s*(?:\[(.*)\]|\((.*)\))?$", re.DOTALL)  # name and unit
# Other names of the column of the time, if none is 't'; its unit also stands behind an underscore.
TIME_NAME = re.compile(
    r"(?:t|_?time|time[ _]?(?:stamp|string)|date[ _/]*(?:and )?time|(?:datum[ _/]*(?:und )?)?(?:uhr)?zeit(?:stempel)?)"
    r"(?:_(s|ms|us))?",
    re.IGNORECASE,
)
MAX_PREAMBLE = 100  # lines above the header that are no comments; engineering choice: oscilloscopes write some twenty
NAME_IT = 'write time = "..." with its name for each signal under [signals]'
BESIDE_IT = f"if each has the times of the column behind it, {NAME_IT}"
# Names of columns in tables with one value per row, as WinCC, data loggers of PLCs and databases export them.
NAMES_NAME = re.compile(
    r"(?:var|variable|tag|signal|channel|entity|path|topic|_?field|_?measurement)[_ ]?(?:name|id)?", re.IGNORECASE
)
VALUE_NAME = re.compile(r"(?:var|tag)?[_ ]?(?:value|wert)|state", re.IGNORECASE)
WHICH_COLUMNS = 'write table = { names = "...", values = "..." } with the columns of both under [driver]'
MAX_BELOW = 5  # lines below the header among which one may have the units; engineering choice: types, units, comments
MAX_JUDGED = 100  # rows below the header, among which
MIN_RAGGED = 2  # without their last cells, from which on all may be so; one may be damaged
EXCEL_SEPARATOR = re.compile(r"sep=(.)")  # a line that Excel writes for itself
NUMBER = r"^[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?$"
BLANK = r"(?i)^(?:[+-]?nan|n/?a|null|none|unavailable|unknown)?$"

Place = tuple[int, str | None]  # position of a column in a row, from 0, and its unit if the header has it
Others = tuple[tuple[str, int, str | None], ...]  # name, position and unit of columns that no signal uses


class Column(NamedTuple):
    """Position of a signal in a row, from 0; ``scale * number + offset`` is the value in the unit of the signal."""

    place: int
    scale: float = 1.0
    offset: float = 0.0

    def scaled(self, numbers: Array) -> Array:
        """The values of ``numbers`` in the unit of the signal; infinity for one that is too large."""
        with np.errstate(over="ignore"):
            values: Array = self.scale * numbers + self.offset
        return values

    def written(self, limits: Range) -> Range:
        """The numbers in the column for ``limits`` in the unit of the signal."""
        ends = sorted((limit - self.offset) / self.scale for limit in limits)
        return ends[0], ends[1]


class ColumnRequest(NamedTuple):
    """Name of a wanted column, unit of its signal, and unit of its numbers if the machine file names it.

    The value in that unit is ``scale * number + offset``.
    """

    column: str
    unit: str
    written: str | None = None
    scale: float = 1.0
    offset: float = 0.0

    @property
    def is_scaled(self) -> bool:
        """Whether ``written`` is the unit of the value, and not of the number."""
        return (abs(self.scale), self.offset) != (1.0, 0.0)


@dataclass(frozen=True, slots=True)
class Header:
    """The line with the names of the columns."""

    path: Path
    line: int  # Line number, from 1
    separator: str
    widths: tuple[int, int]
    """Minimum and maximum number of cells in a row: columns without a name at the end may be absent."""
    columns: dict[str, Column]  # Of the time and of every signal
    segment: int | None = None  # Position of the column of segments in a row, from 0
    below: str = ""  # The lines below it that were read and may be rows
    others: tuple[tuple[str, int, str | None], ...] = ()
    """Name, position in a row and unit of the columns that no signal uses; None without a unit in the header."""
    date: int | None = None  # Position of the column of the date in a row, from 0, if that of the time has none
    clock: str = TIME  # Name of the column of the time
    is_shared: bool = False  # Whether other columns of a row may have times of their own
    is_ragged: bool = False  # Whether rows lack the cells at their end that are blank
    is_unit_stated: bool = True  # Whether that of the time is
    beside: tuple[list[str], ...] = ()  # Cells of the lines that may have units: some below it, and the one above


def check_length(place: str, length: int) -> None:
    """Raise ConfigurationError if a line at ``place`` has more characters than a table needs."""
    if length > MAX_LINE:
        raise ConfigurationError(f"{place}: longer than {MAX_LINE} characters: is this a CSV file?")


def read_header(
    path: Path, file: TextIO, wanted: Mapping[str, ColumnRequest], time: TimeRequest | None = None
) -> Header:
    """The header of ``file``, which is read to the lines below: the first line with the time and all wanted columns.

    ``time`` names the column of the time; of several with this name it is the one before the wanted columns.

    Raises:
        ConfigurationError: no header, a column that is missing or not unique, or a unit of another dimension.
    """
    clock = time or TimeRequest()
    wanted = {TIME: ColumnRequest(clock.column, SECONDS, clock.unit), **wanted}
    number, separator, faults = 0, "", list[tuple[int, int, list[str]]]()
    above, commented, rows, read = list[str](), "", list[str](), ""
    while len(faults) < MAX_PREAMBLE and (line := file.readline(MAX_LINE + 1)):
        number += 1
        check_length(f"{path}:{number}", len(line))
        is_comment = line.lstrip().startswith("#")
        if excel := EXCEL_SEPARATOR.fullmatch(line.strip(" \r\n")):
            separator = excel[1]
        if excel or not line.strip(" #\r\n"):
            continue
        sign = separator or next((sign for sign in SEPARATORS if sign in line), ",")
        cells = split_quoted(line, sign)
        if commented and all(is_number(cell) for cell in cells if cell):  # numpy writes names as a comment
            number, rows, cells = number - 1, [line], split_quoted(commented, sign)
        elif is_comment:
            commented = line.lstrip("# ")
            continue
        if (found := _found(f"{path}:{number}", above, cells, wanted)) is not None:
            cells, places, others = found
            break
        faults.append((sum(not is_number(cell) for cell in cells if cell), -number, cells))
        above, read = cells, read + line
    else:
        if not faults:
            raise ConfigurationError(f"{path}: is empty, or has only comments: a header line is needed")
        _, number, cells = max(faults)
        places, others = _places(f"{path}:{-number}", cells, wanted, seen(read.encode()))
    rows += [line for _ in range(MAX_JUDGED - len(rows)) if (line := file.readline(MAX_LINE + 1))]
    judged = [split_quoted(row, sign) for row in rows]
    split = judged[:MAX_BELOW]
    units, skipped = _units_beside(above, split, wanted, places)
    date = _place_of_date(f"{path}:{number}", clock, others)
    if date is None:
        date = date_column([name_and_unit(cell)[0] for cell in cells], split, places[clock.column][0])
    places = {name: (index, written or units.get(index)) for name, (index, written) in places.items()}
    columns, is_unit_stated = columns_of(f"{path}:{number}", cells, wanted, places, clock)
    named = max(index for index, cell in enumerate(cells) if cell) + 1
    is_wanted = SEGMENT in {request.column for request in wanted.values()}
    segment = None if is_wanted or SEGMENT not in places else places[SEGMENT][0]
    beside, below, widths = (*split, above), "".join(rows[skipped:]), (named, len(cells))
    header = Header(
        path,
        number + skipped,
        sign,
        widths,
        columns,
        segment,
        below,
        others,
        date,
        clock=name_and_unit(cells[columns[TIME].place])[0],
        is_shared=time is not None,
        is_ragged=sum(1 < len(row) < named for row in judged[skipped:]) >= MIN_RAGGED,
        is_unit_stated=is_unit_stated or clock.epoch is not None,
        beside=beside,
    )
    if time is None and (question := _question(header, cells, split[skipped:])):
        raise ConfigurationError(f"{path}:{number}: {question}")
    return header


def _found(
    place: str, above: list[str], cells: list[str], wanted: Mapping[str, ColumnRequest]
) -> tuple[list[str], dict[str, Place], Others] | None:
    """The cells of the header, if it is this line, alone or with that above, and what :func:`_places` returns."""
    for names in (cells, _names_below(above, cells, wanted[TIME].column)):
        with contextlib.suppress(ConfigurationError):
            return names, *_places(place, names, wanted)
    return None


def _names_below(above: list[str], cells: list[str], time: str) -> list[str]:
    """The names in two lines as one: that of the time in the upper, and those of the signals below; else none.

    Below that of the time stands its unit, or nothing.
    """
    for index, (upper, lower) in enumerate(zip(above, cells, strict=False)):
        name, unit = name_and_unit(upper)
        unit = unit or lower.strip("[]()")
        if (name == time or TIME_NAME.fullmatch(name)) and (not lower or measures_time(unit)):
            return [*cells[:index], f"{name} [{unit}]" if unit else name, *cells[index + 1 :]]
    return []


def measures_time(unit: str) -> bool:
    """Whether a text is a unit of time."""
    with contextlib.suppress(ValueError):
        factor(unit, SECONDS)
        return True
    return False


def _place_of_date(place: str, time: TimeRequest, others: tuple[tuple[str, int, str | None], ...]) -> int | None:
    """The position of the column with the dates; None if they are in that of the time."""
    if time.date is None:
        return None
    if (at := next((index for name, index, _ in others if name == time.date), None)) is None:
        known = [name for name, _, _ in others]
        raise ConfigurationError(f"{place}: no column {time.date!r} (dates): {nearest(time.date, known)}")
    return at


def columns_of(
    place: str,
    cells: list[str],
    wanted: Mapping[str, ColumnRequest],
    places: Mapping[str, Place],
    time: TimeRequest,
) -> tuple[dict[str, Column], bool]:
    """The column of the time and of each signal, and whether the unit of the time is stated."""
    columns: dict[str, Column] = {}
    is_stated = False
    for signal, request in wanted.items():
        index, written = places[request.column]
        unit = request.written or written
        is_stated |= signal == TIME and unit is not None
        asked = None if request.is_scaled or (signal == TIME and time.is_known) else request.written
        if asked and written and _is_contradicted(asked, written, request.unit):
            fault = f"the table says {shown(written)}, the machine file unit = {shown(request.written)}"
            remedy = f"remove unit from the {'time of the ' if signal == TIME else ''}signal, or correct the table"
            raise ConfigurationError(f"{place}: column {index + 1} ({shown(cells[index])}): {fault}: {remedy}")
        try:
            scale, offset = (1.0, 0.0) if unit is None else factor(unit, request.unit)
            columns[signal] = Column(index, scale * request.scale, scale * request.offset + offset)
        except ValueError as error:
            raise ConfigurationError(f"{place}: column {index + 1} ({shown(cells[index])}): {error}") from error
    return columns, is_stated


def _is_contradicted(written: str, stated: str, target: str) -> bool:
    """Whether a table states another unit than the machine file, for a signal in the unit ``target``.

    What is no unit of such a signal, as the phase in ``U (A)``, states nothing.
    """
    try:
        return not are_equal(written, stated, target)
    except ValueError:
        return False


def columns_called(name: str, line: str) -> int:
    """How many columns have the ``name``, if ``line`` is the header."""
    rows = (split_quoted(line, sign) for sign in SEPARATORS)
    return max(sum(name in (cell, name_and_unit(cell)[0]) for cell in row) for row in rows)


def _question(header: Header, cells: list[str], rows: list[list[str]]) -> str:
    """What is asked where another column of the first ``rows`` may have the times; empty if nothing is."""
    clock, scale, _ = header.columns[TIME]
    rows = [row for row in rows if len(row) == len(cells) and is_number(row[clock])]
    times = [scale * number for number in _numbers_in(rows, clock)]
    signals = {column.place: name for name, column in header.columns.items() if name != TIME}
    for name, index, _ in header.others:
        if question := contradiction(cells[clock], times, name, [row[index] for row in rows]):
            return question
        own, side = signals.get(index + 1), "behind"
        if clock - 1 in signals and index - 1 in signals:  # value, time, value, time
            own, side = signals[index - 1], "before"
        is_time = own is not None and index > clock and BESIDE_NAME.fullmatch(name)
        if is_time and rises_evenly(_numbers_in(rows, index)):
            either = f'time = "{name}" for {own}, or time = "{cells[clock]}" if it has not'
            return f"column {shown(name)} may have the times of the column {side} it: write {either}"
    return ""


def _numbers_in(rows: list[list[str]], index: int) -> list[float]:
    """The numbers in a column; none if a cell is no number."""
    texts = [row[index].replace(",", ".") for row in rows]
    return [float(text) for text in texts] if all(map(is_number, texts)) else []


def _places(
    place: str, cells: list[str], wanted: Mapping[str, ColumnRequest], kind: str = ""
) -> tuple[dict[str, Place], Others]:
    """The place of each wanted column, and of that of segments if there is one; name and place of the others.

    ``kind`` is the format that the file seems to have, for the error.
    """
    known, time = list(dict.fromkeys(request.column for request in wanted.values())), wanted[TIME].column
    if all(is_number(cell) for cell in cells if cell):
        raise ConfigurationError(f"{place}: numbers, but a header must name the columns: {', '.join(known)}")
    places: dict[str, Place] = {}
    others, times, clocks = list[tuple[str, int, str | None]](), list[tuple[str, Place]](), list[Place]()
    for index, cell in enumerate(cells):
        name, written = name_and_unit(cell)
        name = cell if cell in known else name
        match = TIME_NAME.fullmatch(name)
        if name == time:
            clocks.append((index, written or (match[1] and match[1].lower() if match else None)))
        elif name in places:
            raise ConfigurationError(f"{place}: column {index + 1} ({shown(cell)}): a second column {name}: remove one")
        elif name in known or name == SEGMENT:
            places[name] = (index, written)
        else:
            others += [(name, index, written)] if name else []
            times += [(name, (index, written or (match[1] and match[1].lower())))] if match else []
    if clocks:
        named = [index for index, cell in enumerate(cells) if cell]
        places[time] = _clock(place, clocks, wanted, places, (named[0], named[-1]))
    elif time == TIME and times:
        name, places[TIME] = _only(place, times, cells)
        others = [other for other in others if other[0] != name]
    for request in wanted.values():
        if request.column not in places:
            raise ConfigurationError(f"{place}: {_missing(request, [name for name, _, _ in others], cells, kind)}")
    return places, tuple(others)


def _only(place: str, times: list[tuple[str, Place]], cells: list[str]) -> tuple[str, Place]:
    """The one of ``times`` that there is; raise ConfigurationError if there are several."""
    if len(times) > 1:
        names = ", ".join(repr(cells[index]) for _, (index, _) in times)
        raise ConfigurationError(f"{place}: {names} may be the column of the time: rename one to 't [s]', or {NAME_IT}")
    return times[0]


def _clock(
    place: str,
    clocks: list[Place],
    wanted: Mapping[str, ColumnRequest],
    places: Mapping[str, Place],
    ends: tuple[int, int],
) -> Place:
    """The one of several columns with the name of the time that belongs to the wanted columns.

    It stands before them or, in a table whose last column is a time and whose first one is none, behind them; ``ends``
    are the positions of these two columns.
    """
    if len(clocks) == 1:
        return clocks[0]
    name, at = wanted[TIME].column, [places[row.column][0] for row in wanted.values() if row.column in places]
    is_first, is_last = ends[0] == clocks[0][0], ends[1] == clocks[-1][0]
    if is_first and is_last and at and name != TIME:
        both = f"the first and the last column are called {name}, so that each may belong to the column on either side"
        raise ConfigurationError(f"{place}: {both}: give them names of their own")
    if is_last and not is_first:
        own = [min((clock for clock in clocks if clock[0] > index), default=None) for index in at]
    else:
        own = [max((clock for clock in clocks if clock[0] < index), default=None) for index in at]
    found = {clock for clock in own if clock is not None} if at else set(clocks)
    if len(found) != 1 or None in own or name == TIME:
        raise ConfigurationError(
            f"{place}: {len(clocks)} columns are called {name}: remove all but one, or {BESIDE_IT}"
        )
    return found.pop()


def is_number(cell: str) -> bool:
    """Whether a cell of the header or near it is a number, with either decimal sign."""
    return re.match(NUMBER, cell.replace(",", ".")) is not None


def name_and_unit(cell: str) -> tuple[str, str | None]:
    """The name in a cell of the header, and its unit if it has one; other parentheses belong to the name."""
    name, unit, in_parentheses = HEADER_CELL.findall(cell)[0]
    if in_parentheses and (is_number(in_parentheses) or not is_unit(in_parentheses)):
        return cell, None
    return name, unit or in_parentheses or None


def _units_beside(
    above: list[str], below: list[list[str]], wanted: Mapping[str, ColumnRequest], places: Mapping[str, Place]
) -> tuple[dict[int, str], int]:
    """The units in a line below the header or above it, by the position of their columns; how many are no rows."""
    for number, cells in enumerate(below, 1):
        if units := _units_in(cells, wanted, places):
            return units, number
        if any(is_number(cells[index]) for index, _ in places.values() if index < len(cells)):
            break
    units = _units_in(above, wanted, places)
    return (units if all(map(is_unit, units.values())) else {}), 0


def _units_in(cells: list[str], wanted: Mapping[str, ColumnRequest], places: Mapping[str, Place]) -> dict[int, str]:
    """The units in a line, by the position of their columns; empty if it seems to have none."""
    texts, fitting = dict[int, str](), 0
    for request in wanted.values():
        index = places[request.column][0]
        text = cells[index].strip("[]()") if index < len(cells) else ""
        if is_number(text):
            return {}
        if re.match(BLANK, text) or (request.column == TIME and not is_unit(text)):
            continue
        texts[index] = text
        with contextlib.suppress(ValueError):
            factor(text, request.unit)
            fitting += 1
    is_sure = 2 * fitting > len(texts)  # single letters are units of something
    return texts if is_sure or (2 * fitting == len(texts) and all(map(is_unit, texts.values()))) else {}


def _missing(request: ColumnRequest, others: list[str], cells: list[str], kind: str) -> str:
    unit = "seconds, also called 'time'" if request.column == TIME else request.unit
    what = f"no column {request.column!r} ({unit})"
    if kind:
        return f"{what}; the file looks like {kind}"
    if request.column == TIME and (named := _names_of_values(cells)):
        return f"{what}; the table seems to have one value per row, named in {named!r}: {WHICH_COLUMNS}"
    twice = [name for name in dict.fromkeys(cells) if name and cells.count(name) > 1]
    if request.unit == SECONDS and twice:
        return f"{what}; {cells.count(twice[0])} columns are called {twice[0]!r}: {BESIDE_IT}"
    if len(cells) < 2:
        return f"{what}, and no ',', ';' or tab between columns"
    return f"{what}: {nearest(request.column, others) if others else 'add it'}"


def _names_of_values(cells: list[str]) -> str:
    """The column with the names of a table with one value per row; empty if it has none, or none of the values."""
    has_values = any(VALUE_NAME.fullmatch(cell) for cell in cells)
    return next((cell for cell in cells if NAMES_NAME.fullmatch(cell)), "") if has_values else ""


def split_quoted(line: str, separator: str) -> list[str]:
    """The cells of one line, without spaces around them; a quote that is not closed ends with the line."""
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]
