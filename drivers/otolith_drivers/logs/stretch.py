"""Some lines of a table as columns of numbers. What is no row or no number is counted, and said where it is."""

from collections.abc import Iterable
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from otolith_drivers.logs.cells import decimal_sign, is_blank, numbers, split_lines
from otolith_drivers.logs.heading import TIME, Heading
from otolith_drivers.logs.rows import LATEST, Array, Integers, Mask, Rows


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
