"""A text table as rows of numbers: one row per instant, one column per signal.

The file is read in chunks, so memory does not depend on its length. Bad rows (no time, wrong number of cells) and bad
cells (no number) are counted, and the first of them is reported with its line. A blank cell is a missing reading.

The kernels of pyarrow split and convert a chunk at once. ``pyarrow.csv`` is not used: it stops at the first bad cell
without its line, lets an open quote swallow the lines below, and knows neither comments nor rows of varying width.
"""

import codecs
import io
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, tzinfo
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import field_validator, model_validator

from otolith_drivers import keep_pandas_out
from otolith_drivers.base import Setup
from otolith_drivers.common.time_zones import zone_named
from otolith_drivers.config_files import Range, StrictModel
from otolith_drivers.errors import ConfigurationError, counted, shown
from otolith_drivers.replay.cleaning import EvenTimes, NoReadings
from otolith_drivers.replay.readers import (
    MAX_TIME,
    Array,
    DataFile,
    Integers,
    Mask,
    MergedReader,
    Reader,
    Rows,
    seen,
)
from otolith_drivers.replay.table.header import (
    BLANK,
    MAX_LINE,
    MAX_PREAMBLE,
    NUMBER,
    SECONDS,
    TIME,
    ColumnRequest,
    Header,
    TimeRequest,
    check_length,
    columns_called,
    is_number,
    read_header,
    split_quoted,
)
from otolith_drivers.replay.table.times import date_of, question_of_unit, since_1970, with_dates
from otolith_drivers.units import factor

# Engineering choice: small in memory, large against pyarrow's overhead per chunk. Guarded by test_replay.py (memory)
# and test_replay_tables.py (the result does not depend on it).
CHUNK = 1 << 19  # characters read at once

LOST_BLOCK = re.compile(rb"\0{16,}")  # what a file system leaves of a block that was not written when the power failed
DATE = "2026-03-29T01:59:58.25Z"  # an example
MIN_GROUPED = 10  # cells like 1.001, and whole numbers, from which on it is asked whether thousands are separated
LAST_SIGNS = {".": r",.*\.\d*$", ",": r"\..*,\d*$"}  # of a cell with both signs
# A number whose thousands are separated, by {} or a space: three digits alone behind the other sign may be decimals.
THOUSANDS = (
    r"^[+-]?\d{{1,3}}(?:(?:{0}\d{{3}})+\.\d+|(?:{0}\d{{3}}){{2,}}"
    r"|(?:[ '\x{{2019}}\x{{a0}}\x{{202f}}]\d{{3}})+(?:\.\d*)?)$"
)


keep_pandas_out()  # only the reader of MF4 logs needs it, which imports it itself


class TableTime(StrictModel):
    """The column of the times of a signal; its name alone stands for a table with ``column``."""

    column: str  # Of several with this name, the one before the column of the signal
    unit: str | None = None  # Of the numbers in it, if its header does not name it
    date: str | None = None  # Column of the dates, if this one has the time of the day only; one called Date is found

    @model_validator(mode="before")
    @classmethod
    def _name(cls, written: Any) -> Any:
        return {"column": written} if isinstance(written, str) else written

    @field_validator("unit")
    @classmethod
    def _unit_of_time(cls, unit: str | None) -> str | None:
        if unit is not None:
            factor(unit, SECONDS)
        return unit


class TableSource(StrictModel):
    """The column of a signal."""

    column: str | None = None  # Name of the column; without it, the name of the signal
    unit: str | None = None  # Unit of the numbers in the column, if its header does not name it
    range: Range | None = None  # In the unit of the column; a number outside is no reading
    time: TableTime | None = None  # Without it, that of the table


Source = TableSource  # for readers.Format


@dataclass(slots=True)
class TableCounts:
    """Rows and cells read so far."""

    rows: int = 0  # Rows that were used
    blank: int = 0  # Cells without a reading
    bad_cells: int = 0
    bad_rows: int = 0
    first_bad: tuple[int, str] | None = None  # Line number and cause of the first bad row or cell
    decimal: str = ""  # The decimal sign; empty until a chunk has one
    segment: str | None = None  # Text of the present segment; None until a row has one
    no_readings: dict[str, NoReadings] = field(default_factory=dict)  # Numbers of each signal that are left out

    @property
    def bad(self) -> int:
        """Number of bad rows and bad cells."""
        return self.bad_rows + self.bad_cells


def open_log(path: Path, setup: Setup, _: object = None) -> Reader:
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    signals = {signal.name: signal for signal in setup.signals}

    def open_columns(names: Sequence[str]) -> TableReader:
        units = {name: signals[name].unit for name in names}
        ordinary = {name: signals[name].ordinary for name in names}
        sources = {name: signals[name].source for name in names}
        return TableReader(path, units, sources, ordinary, zone_named(setup.timezone))

    by_time = defaultdict[str, list[str]](list)
    clocks = {signal.source.time.column for signal in signals.values() if signal.source.time is not None}
    repeated = {column for column in clocks if _are_several(path, column)}
    for name, signal in signals.items():
        time = signal.source.time
        is_own = time is not None and time.column in repeated
        by_time[f"times of {name}" if is_own else f"{time}"].append(name)
    if len(by_time) < 2:
        return open_columns(list(signals))
    return MergedReader(path, by_time, lambda time: open_columns(by_time[time]))


def _are_several(path: Path, name: str) -> bool:
    """Whether several columns of a table have the ``name``."""
    data = DataFile(path)
    try:
        text = decoded(path, data)
        lines = [text.readline(MAX_LINE) for _ in range(MAX_PREAMBLE)]
    finally:
        data.close()
    return any(columns_called(name, line) > 1 for line in lines)


class TableReader(Reader):
    """A table, whose columns were found by its header."""

    place = "line"
    is_table = True

    def __init__(
        self,
        path: Path,
        units: Mapping[str, str],
        sources: Mapping[str, TableSource] | None = None,
        ordinary: Mapping[str, Range | None] | None = None,
        zone: tzinfo = UTC,
    ) -> None:
        """``units`` has the unit of each wanted signal, ``sources`` the column of a signal that has another name.

        All of them have the times of one column.

        ``ordinary`` has the values of each input in ordinary operation, in its unit. ``zone`` is that of dates that
        name none.

        Raises:
            ConfigurationError: the file is missing or no text, or a wanted column is missing.
        """
        data = DataFile(path)
        super().__init__(path, data)
        self.counts, self._times, self._zone = TableCounts(), EvenTimes(), zone
        named = {name: (sources or {}).get(name, TableSource()) for name in units}
        self._wanted = {
            name: ColumnRequest(source.column or name, units[name], source.unit) for name, source in named.items()
        }
        try:
            self._text = decoded(path, data)
            clock = next(iter(named.values())).time if named else None
            request = None if clock is None else TimeRequest(clock.column, clock.unit, clock.date)
            self._header = read_header(path, self._text, self._wanted, request)
        except BaseException:
            data.close()
            raise
        self.ignored = tuple(name for name, _, _ in self._header.others)
        for name, source in named.items():
            limits = (ordinary or {}).get(name)
            limits = limits and self._header.columns[name].written(limits)
            self.counts.no_readings[name] = NoReadings(source.range, limits)

    @property
    def progress(self) -> float:
        """Share of the file that was read and whose times are known, 0 to 1."""
        return super().progress * (1.0 - self._times.waiting / max(self.counts.rows, 1))

    @property
    def bad(self) -> int:
        """Number of bad rows and bad cells."""
        return self.counts.bad

    def chunks(self) -> Iterator[Rows]:
        number, rest = self._header.line + 1, self._header.below
        while text := self._text.read(CHUNK):
            text, end, rest = (rest + text).rpartition("\n")
            if end:
                yield from self._rows(text, number)
                number += text.count("\n") + 1
            check_length(f"{self.path}:{number}", len(rest))
        yield from self._rows(rest, number)
        yield from self._times.rest()
        if not self.counts.rows:
            raise ConfigurationError(f"{self.path}{self._why_no_rows()}")

    def _rows(self, text: str, first: int) -> Iterator[Rows]:
        lines = pc.list_flatten(pc.split_pattern(pa.array([text]), "\n"))
        lengths = pc.utf8_length(lines).to_numpy()
        check_length(f"{self.path}:{first + int(lengths.argmax())}", int(lengths.max()))
        rows = _TableChunk(self._header, self.counts, self._zone, lines, first).rows(quoted='"' in text)
        if rows is not None:
            if not self._header.is_unit_stated and (question := question_of_unit(rows.times)):
                raise ConfigurationError(f"{self.path}: {question}")
            yield from self._times.of(rows)

    def _why_no_rows(self) -> str:
        if self.counts.first_bad is None:
            return ": no rows below the header"
        line, cause = self.counts.first_bad
        return f":{line}: {cause}; none of the {self.counts.bad_rows} rows can be used"

    def describe(self) -> list[str]:
        return [f"{name} [{wanted.unit}] from column {wanted.column!r}" for name, wanted in self._wanted.items()]

    def summary_lines(self) -> list[str]:
        counts = self.counts
        parts = [f"{counted(counts.rows, 'row')} read", counted(counts.bad_rows, "bad row")]
        return [*parts, counted(counts.bad_cells, "bad cell"), f"{counted(counts.blank, 'cell')} blank"]

    def warnings(self) -> list[str]:
        lines = self._cut_off()
        for name, no_readings in self.counts.no_readings.items():
            lines += no_readings.warnings(name)
        if (coarse := self._times.text()) is not None:
            lines.insert(0, coarse)
        if self.counts.first_bad is None:
            return lines
        line, cause = self.counts.first_bad
        bad = f"bad cells: {self.counts.bad_cells}, bad rows: {self.counts.bad_rows}"
        return [f"{bad}, the first in line {line}: {cause}", *lines]


def decoded(path: Path, data: DataFile) -> TextIO:
    """The text of a table with any line ends, in UTF-8, UTF-16 with its mark, or Windows-1252."""
    start = data.stream.peek()
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return io.TextIOWrapper(data.stream, encoding="utf-16", errors="replace")
    if b"\0" in LOST_BLOCK.sub(b"", start) or start.startswith(b"\0"):
        kind = seen(start) or "compressed, a spreadsheet or UTF-16"
        raise ConfigurationError(f"{path}: is not text ({kind}): save it as CSV in UTF-8")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
        encoding = "utf-8-sig"
    except UnicodeDecodeError:
        encoding = "utf-8-sig" if start.startswith(codecs.BOM_UTF8) else "cp1252"
    return io.TextIOWrapper(data.stream, encoding=encoding, errors="replace")


class _TableChunk:
    """Some lines of a table. What is bad in them is added to the counts."""

    def __init__(self, header: Header, counts: TableCounts, zone: tzinfo, lines: pa.Array, first: int) -> None:
        """``first`` is the number of the first of ``lines``, and ``zone`` that of dates that name none."""
        self._header, self._counts, self._lines, self._first = header, counts, lines, first
        self._zone = zone
        self._bad: Integers = np.zeros(len(lines), dtype=np.int64)  # bad rows and cells of each line

    def rows(self, *, quoted: bool) -> Rows | None:
        """The rows of the chunk, or None if it has none; ``quoted`` says that the text has quotes."""
        counts, columns = self._counts, self._header.columns
        before = counts.bad
        cells = self._split(quoted=quoted)
        kept = np.flatnonzero(self._right_width(cells))
        cells = cells if len(kept) == len(cells) else cells.take(pa.array(kept))
        texts = {name: pc.list_element(cells, column.place) for name, column in columns.items()}
        if self._header.date is not None:
            texts[TIME] = with_dates(pc.list_element(cells, self._header.date), texts[TIME])
        signs = (_decimal_sign([text for name, text in texts.items() if name != TIME]), _decimal_sign([texts[TIME]]))
        if not counts.decimal and (cell := _ambiguous_cell([text for name, text in texts.items() if name != TIME])):
            whole = cell.replace(".", "").replace(",", "")
            cause = f"{shown(cell)} may be {whole} or a number with decimals, as no other cell shows it"
            raise ConfigurationError(f"{self._header.path}: {cause}: export without separated thousands")
        counts.decimal = counts.decimal or signs[0] or signs[1]  # a date may have points and a comma
        numbers = columns[TIME].scaled(_numbers(texts[TIME], counts.decimal))
        times = since_1970(numbers, columns[TIME].scale, self._zone)
        dates = np.flatnonzero(np.isinf(times))
        times[dates] = [date_of(text, self._zone) for text in texts[TIME].take(pa.array(dates)).to_pylist()]
        own = [column.place for column in columns.values()] if self._header.is_shared else None
        timed = self._timed(times, texts.pop(TIME), _text_of(cells, own), kept)
        kept = kept[timed]
        if not len(kept):
            return None
        values = {}
        for name, text in texts.items():
            text_of_rows = text.filter(pa.array(timed))
            numbers = _numbers(text_of_rows, counts.decimal)
            values[name] = columns[name].scaled(numbers)
            self._remove_bad_cells(name, values[name], text_of_rows, kept)
            values[name][counts.no_readings[name].among(numbers)] = np.nan
        counts.rows += len(kept)
        marks = None
        if self._header.segment is not None:
            marks = self._marks(pc.list_element(cells, self._header.segment).filter(pa.array(timed)))
        return Rows(times[timed], values, kept + self._first, before + np.cumsum(self._bad)[kept], marks)

    def _marks(self, texts: pa.StringArray) -> Mask:
        """Which rows begin a segment: those with another text than the one above; a blank cell repeats that."""
        texts = pc.utf8_trim_whitespace(texts)
        texts = pc.if_else(pc.match_substring_regex(texts, BLANK), pa.scalar(None, pa.string()), texts)
        texts = pc.fill_null_forward(pa.concat_arrays([pa.array([self._counts.segment], pa.string()), texts]))
        self._counts.segment = texts[-1].as_py()
        changed: Mask = pc.fill_null(pc.not_equal(texts[1:], texts[:-1]), False).to_numpy(zero_copy_only=False)
        return changed

    def _split(self, *, quoted: bool) -> pa.ListArray:
        """The cells of each line."""
        separator = self._header.separator
        if not quoted:
            return pc.split_pattern(self._lines, separator)
        return pa.array([split_quoted(line, separator) for line in self._lines.to_pylist()], pa.list_(pa.string()))

    def _right_width(self, cells: pa.ListArray) -> Mask:
        """Which lines are rows: a cell for each column, and no text in cells beyond them. Comments are no rows."""
        least, most = self._header.widths
        widths = pc.list_value_length(cells).to_numpy()
        comment = pc.starts_with(pc.utf8_ltrim_whitespace(self._lines), "#").to_numpy(zero_copy_only=False)
        fits: Mask = (widths >= least) & ~comment
        wide = np.flatnonzero(fits & (widths > most))
        if len(wide):
            fits[wide] = ~_has_text(pc.list_slice(cells.take(pa.array(wide)), most))
        wrong = np.flatnonzero(~fits & ~comment)
        wrong = wrong[_has_text(cells.take(pa.array(wrong)))]
        if len(wrong):
            hint = " (a decimal comma needs ';' or a tab between cells)" if self._header.separator == "," else ""
            self._count_rows(wrong, f"{widths[wrong[0]]} cells, but {most} columns{hint}")
        return fits

    def _timed(self, times: Array, texts: pa.StringArray, has_text: Mask, lines: Integers) -> Mask:
        """Which of the rows have a time; ``lines`` are their lines. A row without any text is blank, not bad."""
        timed: Mask = np.abs(times) <= MAX_TIME
        wrong = np.flatnonzero(~timed & has_text)
        if len(wrong):
            first, cause = wrong[0], "a row without t"
            if not np.isnan(times[first]):
                cell = texts[int(first)].as_py()
                cause = (
                    f"t is {shown(cell)}: write seconds, relative or Unix, a date like {DATE}, or the unit: 't [ms]'"
                )
                if (other := _other_sign(cell, self._counts.decimal)) and np.isinf(times[first]):
                    cause = f"t is {shown(cell)}{other}"
            self._count_rows(lines[wrong], cause)
        return timed

    def _count_rows(self, lines: Integers, cause: str) -> None:
        """Count bad rows; ``cause`` is that of the first."""
        self._bad[lines] += 1
        self._counts.bad_rows += len(lines)
        self._note(int(lines[0]), cause)

    def _remove_bad_cells(self, name: str, values: Array, texts: pa.StringArray, lines: Integers) -> None:
        """Count the blank and the bad cells of a column; the latter become NaN."""
        wrong = np.flatnonzero(np.isinf(values))
        self._counts.blank += int(np.count_nonzero(np.isnan(values)))
        if len(wrong):
            values[wrong] = np.nan
            self._bad[lines[wrong]] += 1
            self._counts.bad_cells += len(wrong)
            cell = texts[int(wrong[0])].as_py()
            other = _other_sign(cell, self._counts.decimal)
            self._note(int(lines[wrong[0]]), f"{name} is {shown(cell)}{other or ', no number'}")

    def _note(self, index: int, cause: str) -> None:
        line = self._first + index
        if self._counts.first_bad is None or line < self._counts.first_bad[0]:
            self._counts.first_bad = (line, cause)


def _text_of(cells: pa.ListArray, places: list[int] | None) -> Mask:
    """Which of the lists of cells have a text, at one of the ``places`` if they are given."""
    if places is None:
        return _has_text(cells)
    texts = [pc.utf8_trim_whitespace(pc.list_element(cells, place)) for place in places]
    mask: Mask = pc.not_equal(pc.binary_join_element_wise(*texts, ""), "").to_numpy(zero_copy_only=False)
    return mask


def _has_text(cells: pa.ListArray) -> Mask:
    """Which of the lists of cells have a cell that is not empty."""
    text = pc.utf8_trim_whitespace(pc.binary_join(cells, ""))
    mask: Mask = pc.not_equal(text, "").to_numpy(zero_copy_only=False)
    return mask


def _decimal_sign(texts: list[pa.StringArray]) -> str:
    """The decimal sign that most of the cells use; empty if none uses any. Of two signs in a cell it is the last."""
    points, commas = (sum(pc.sum(pc.count_substring(text, sign)).as_py() or 0 for text in texts) for sign in ".,")
    if points and commas:
        last = {sign: sum(_count(text, pattern) for text in texts) for sign, pattern in LAST_SIGNS.items()}
        points, commas = (last["."], last[","]) if any(last.values()) else (points, commas)
    return "" if points == commas == 0 else "," if commas > points else "."


def _ambiguous_cell(texts: list[pa.StringArray]) -> str:
    """A cell that may have separated thousands or decimals, where whole numbers and such cells are all that there is.

    Decimals of three digits each beside whole numbers are improbable, unless there are few.
    """
    cells = pc.utf8_trim_whitespace(pa.concat_arrays(texts)) if texts else pa.array([], pa.string())
    signed = cells.filter(pc.match_substring_regex(cells, "[.,]"))
    grouped = _count(signed, r"^[+-]?[1-9]\d{0,2}[.,]\d{3}$")
    whole = _count(cells, r"^[+-]?\d{1,3}$")
    return str(signed[0]) if MIN_GROUPED <= grouped == len(signed) and whole >= MIN_GROUPED else ""


def _count(texts: pa.StringArray, pattern: str) -> int:
    return pc.sum(pc.match_substring_regex(texts, pattern)).as_py() or 0


def _numbers(texts: pa.StringArray, decimal: str) -> Array:
    """The numbers of a column: NaN for a blank cell, infinity for one that is no number.

    A cell with the other decimal sign is no number, unless that clearly separates thousands.
    """
    texts = pc.utf8_trim_whitespace(texts)
    if decimal == ",":
        texts = pc.replace_substring(pc.replace_substring(texts, ".", "\x1f"), ",", ".")
    try:
        numbers = texts.cast(pa.float64())
    except pa.ArrowInvalid:
        texts = pc.replace_substring(texts, "\u2212", "-")  # the minus of typesetters
        grouped = pc.match_substring_regex(texts, THOUSANDS.format(r"\x1f" if decimal == "," else ","))
        texts = pc.if_else(grouped, pc.replace_substring_regex(texts, r"[^\d.+-]", ""), texts)
        known = pc.if_else(pc.match_substring_regex(texts, BLANK), "nan", "inf")
        numbers = pc.if_else(pc.match_substring_regex(texts, NUMBER), texts, known).cast(pa.float64())
    array: Array = numbers.to_numpy()
    return array


def _other_sign(text: str, decimal: str) -> str:
    """A clause for a cell that is a number but for its decimal sign."""
    return f", but {decimal!r} is the decimal sign of other cells" if decimal and is_number(text) else ""
