"""Some lines of a table as rows of numbers. What is bad in them is counted, with line and cause of the first."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.replay.cleaning import NoReadings
from otolith_drivers.replay.readers import MAX_TIME, Array, Integers, Mask, Rows
from otolith_drivers.replay.table.cells import (
    ambiguous_cell,
    changes,
    decimal_sign,
    has_text,
    numbers,
    other_sign,
    text_of,
)
from otolith_drivers.replay.table.header import TIME, Header, split_quoted
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.times import DATE, Clock, with_dates

NO_ROW = r"^\s*(?:#|EOF\s*$|//END)"  # begin of a comment, and of the mark that exports write at their end
NO_VARIABLE = frozenset({"", "$RT_OFF$", "$RT_DIS$", "$RT_COUNT$"})  # in the column of names: marks of WinCC
MAX_NAMES = 50  # of variables that a message lists; engineering choice


class LongVariable(NamedTuple):
    """Which rows of a table with one value per row are those of a signal; positions of their columns, from 0."""

    names: int
    name: str | None  # None if the column of values is read whichever variable it has: then it must be one
    validity: int | None = None
    series: int | None = None
    others: frozenset[str] = frozenset()  # Names of other columns: a header between the rows has them in another order


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
    ends_short: bool = False  # Whether the last line so far lacks its last cells
    short: int = 0  # Rows without their last cells that were used
    first_short: int | None = None  # Line of the first of them
    names: set[str] = field(default_factory=set)  # Variables of a table with one value per row
    series: str | None = None  # The one that the rows of the variable have; None until a row has one
    no_readings: dict[str, NoReadings] = field(default_factory=dict)  # Numbers of each signal that are left out

    @property
    def bad(self) -> int:
        """Number of bad rows and bad cells."""
        return self.bad_rows + self.bad_cells


class TableChunk:
    """Some lines of a table. What is bad in them is added to the counts."""

    def __init__(
        self,
        header: Header,
        counts: TableCounts,
        clock: Clock,
        sources: dict[str, TableSource],
        variable: LongVariable | None = None,
    ) -> None:
        self._header, self._counts, self._clock, self._sources = header, counts, clock, sources
        self._variable = variable

    def rows(self, lines: pa.Array, first: int, *, quoted: bool, is_cut: bool = False) -> Rows | None:
        """Return the rows in ``lines``, the first of which has the number ``first``, or None if there are none.

        ``quoted`` says that the text has quotes, ``is_cut`` that the last line has no end.
        """
        self._lines, self._first = lines, first
        self._bad: Integers = np.zeros(len(lines), dtype=np.int64)  # bad rows and cells of each line
        counts, columns = self._counts, self._header.columns
        before = counts.bad
        cells = self._split(quoted=quoted, is_cut=is_cut)
        kept = np.flatnonzero(self._right_width(cells))
        cells = cells if len(kept) == len(cells) else cells.take(pa.array(kept))
        texts = {name: pc.list_element(cells, column.place) for name, column in columns.items()}
        if self._header.date is not None:
            texts[TIME] = with_dates(pc.list_element(cells, self._header.date), texts[TIME])
        self._find_decimal_sign(texts)
        of_all = self._seconds(texts[TIME]) if self._variable is None or self._clock.counts_midnights else None
        if self._variable is not None:
            own = self._of_variable(cells, self._variable)
            kept, cells = kept[own], cells.filter(pa.array(own))
            of_all = None if of_all is None else of_all[own]
            texts = {name: text.filter(pa.array(own)) for name, text in texts.items()}
            texts = self._valid(texts, cells, self._variable)
        times = self._seconds(texts[TIME]) if of_all is None else of_all
        places = [column.place for column in columns.values()] if self._header.is_shared else None
        timed = self._timed(times, texts.pop(TIME), text_of(cells, places), kept)
        kept = kept[timed]
        if not len(kept):
            return None
        values = {}
        for name, text in texts.items():
            text_of_rows = text.filter(pa.array(timed))
            written = numbers(text_of_rows, counts.decimal)
            values[name] = columns[name].scaled(written)
            self._remove_bad_cells(name, values[name], text_of_rows, kept)
            values[name][self._no_readings(name, written)] = np.nan
        counts.rows += len(kept)
        marks = None
        if self._header.segment is not None:
            marks = self._marks(pc.list_element(cells, self._header.segment).filter(pa.array(timed)))
        return Rows(times[timed], values, kept + self._first, before + np.cumsum(self._bad)[kept], marks)

    def _no_readings(self, name: str, written: Array) -> Mask:
        """Which of the numbers in the column of a signal are no readings."""
        source = self._sources[name]
        return self._counts.no_readings[name].among(written if source.range is None else source.value(written))

    def _find_decimal_sign(self, texts: dict[str, pa.StringArray]) -> None:
        others = [text for name, text in texts.items() if name != TIME]
        signs = (decimal_sign(others), decimal_sign([texts[TIME]]))
        if not self._counts.decimal and (cell := ambiguous_cell(others)):
            whole = cell.replace(".", "").replace(",", "")
            cause = f"{shown(cell)} may be {whole} or a number with decimals, as no other cell shows it"
            raise ConfigurationError(f"{self._header.path}: {cause}: export without separated thousands")
        self._counts.decimal = self._counts.decimal or signs[0] or signs[1]  # a date may have points and a comma

    def _seconds(self, texts: pa.StringArray) -> Array:
        """The times of all lines, s: NaN for a blank cell, infinity for one that is none."""
        column = self._header.columns[TIME]
        return self._clock.times(column.scaled(numbers(texts, self._counts.decimal)), texts)

    def _of_variable(self, cells: pa.ListArray, variable: LongVariable) -> Mask:
        """Which lines have the value of the variable; the names of all are kept for messages."""
        names = pc.utf8_trim_whitespace(pc.list_element(cells, variable.names))
        known = self._counts.names
        if moved := variable.others & set(pc.unique(names).to_pylist()):
            line = self._first + int(np.flatnonzero(pc.equal(names, min(moved)).to_numpy(zero_copy_only=False))[0])
            fault = "another header between the rows has its columns in another order: export the tables apart"
            raise ConfigurationError(f"{self._header.path}: near line {line}: {fault}")
        known |= set(pc.unique(names).to_pylist()[: MAX_NAMES - len(known)]) - NO_VARIABLE
        if variable.name is not None:
            own: Mask = pc.equal(names, variable.name).to_numpy(zero_copy_only=False)
        else:
            own = ~np.isin(np.array(names.to_pylist(), dtype=object), list(NO_VARIABLE))
            if len(known) > 1:
                several = ", ".join(sorted(known)[:MAX_NAMES])
                raise ConfigurationError(
                    f"{self._header.path}: its values are those of several variables ({several}): name one as column"
                )
        if variable.series is not None:
            for series in pc.unique(pc.list_element(cells, variable.series).filter(pa.array(own))).to_pylist():
                if series != (self._counts.series or series):
                    both = f"{shown(variable.name)} is in several series ({self._counts.series} and {series})"
                    raise ConfigurationError(f"{self._header.path}: {both}: export one of them, with a filter")
                self._counts.series = series
        return own

    @staticmethod
    def _valid(
        texts: dict[str, pa.StringArray], cells: pa.ListArray, variable: LongVariable
    ) -> dict[str, pa.StringArray]:
        """The texts with blank ones where the format says that the value is none."""
        if variable.validity is None:
            return texts
        is_none = pc.equal(pc.utf8_trim_whitespace(pc.list_element(cells, variable.validity)), "0")
        return {name: text if name == TIME else pc.if_else(is_none, "", text) for name, text in texts.items()}

    def _marks(self, texts: pa.StringArray) -> Mask:
        """Which rows begin a segment."""
        marks, self._counts.segment = changes(texts, self._counts.segment)
        return marks

    def _split(self, *, quoted: bool, is_cut: bool) -> pa.ListArray:
        """The cells of each line; those that a row lacks at its end are blank, but not in a line that is cut off."""
        cells = self._cells_of(self._lines, quoted=quoted)
        widths = pc.list_value_length(cells).to_numpy()
        places = [column.place for column in self._header.columns.values()]
        least = 0 if self._header.is_shared else max(places[0], min(places[1:], default=0))
        short: Mask = (widths < self._header.widths[0]) & (widths > least) & ~self._no_row()
        short[-1:] &= not is_cut
        if not (self._header.is_shared or self._header.is_ragged):  # one alone is damaged: its last cell may be cut
            alone = short & ~np.concatenate([[self._counts.ends_short], short[:-1]])
            self._counts.ends_short = bool(short[-1:].any())
            short &= ~alone
        if short.any():
            counts = self._counts
            if not self._header.is_shared:
                counts.short += int(np.count_nonzero(short))
                counts.first_short = counts.first_short or self._first + int(np.flatnonzero(short)[0])
            blank = self._header.separator * self._header.widths[1]
            longer = pc.binary_join_element_wise(self._lines, blank, "")
            cells = self._cells_of(pc.if_else(pa.array(short), longer, self._lines), quoted=quoted)
        return cells

    def _cells_of(self, lines: pa.Array, *, quoted: bool) -> pa.ListArray:
        separator = self._header.separator
        if not quoted:
            return pc.split_pattern(lines, separator)
        return pa.array([split_quoted(line, separator) for line in lines.to_pylist()], pa.list_(pa.string()))

    def _no_row(self) -> Mask:
        """Which lines are comments, or mark the end."""
        mask: Mask = pc.match_substring_regex(self._lines, NO_ROW).to_numpy(zero_copy_only=False)
        return mask

    def _right_width(self, cells: pa.ListArray) -> Mask:
        """Which lines are rows: a cell for each column, and no text in cells beyond them. Comments are no rows."""
        least, most = self._header.widths
        widths = pc.list_value_length(cells).to_numpy()
        comment = self._no_row()
        fits: Mask = (widths >= least) & ~comment
        wide = np.flatnonzero(fits & (widths > most))
        if len(wide):
            fits[wide] = ~has_text(pc.list_slice(cells.take(pa.array(wide)), most))
        wrong = np.flatnonzero(~fits & ~comment)
        wrong = wrong[has_text(cells.take(pa.array(wrong)))]
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
                if (other := other_sign(cell, self._counts.decimal)) and np.isinf(times[first]):
                    cause = f"t is {shown(cell)}{other}"
                if question := self._clock.question(cell):
                    cause = f"t: {question}"
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
            other = other_sign(cell, self._counts.decimal)
            self._note(int(lines[wrong[0]]), f"{name} is {shown(cell)}{other or ', no number'}")

    def _note(self, index: int, cause: str) -> None:
        line = self._first + index
        if self._counts.first_bad is None or line < self._counts.first_bad[0]:
            self._counts.first_bad = (line, cause)
