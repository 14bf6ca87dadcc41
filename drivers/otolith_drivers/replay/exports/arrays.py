"""A file of arrays (Parquet, Feather, HDF5, MATLAB, TDMS) as rows of numbers.

The names of its columns are the header of a table, so the times are found, and asked about, as in a text.
"""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from datetime import tzinfo
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from otolith_drivers import keep_pandas_out
from otolith_drivers.base import Setup
from otolith_drivers.common.time_zones import stated_zone
from otolith_drivers.config_files import Range
from otolith_drivers.errors import ConfigurationError, counted, nearest, shown
from otolith_drivers.replay.cleaning import EvenTimes, NoReadings
from otolith_drivers.replay.exports.stores import STORES, ArrayTable, Moments
from otolith_drivers.replay.readers import GZIP, MAX_TIME, Array, DataFile, Mask, MergedReader, Reader, Rows, head_of
from otolith_drivers.replay.table.cells import changes, numbers
from otolith_drivers.replay.table.header import TIME, Column, ColumnRequest, read_header
from otolith_drivers.replay.table.options import TableOptions, TableSource
from otolith_drivers.replay.table.times import Clock, TimeRequest, on_wall_clock, question_of_unit, with_dates

MIN_UNIX = 1e8  # s: Unix times since 1973; no recording is so long
JUDGED = 5  # first rows, of which the times are judged
ROWS = 50_000  # read at once; engineering choice: as a chunk of a text table

keep_pandas_out()

Source, Options = TableSource, TableOptions  # for readers.Format


def open_log(path: Path, setup: Setup, options: TableOptions | None = None) -> Reader:
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    if options is not None and options.names is not None:
        raise ConfigurationError(f"{path}: 'names' and 'values' are for text tables: this file has a column each")
    DataFile(path).close()  # raises if it cannot be read
    signals = {signal.name: signal for signal in setup.signals}
    sources = {name: signal.source for name, signal in signals.items()}
    if options is not None and options.time is not None:
        time = options.time
        sources = {name: source if source.time else source.model_copy(update={"time": time})
                   for name, source in sources.items()}  # fmt: skip
    with ExitStack() as opened:
        tables = tables_of(path, opened)
    by_clock, begins = dict[str, list[str]](), dict[str, float]()
    for name, source in sources.items():
        table, column = found(path, tables, source.column or name)
        clock = f"{table.name} {table.length} {source.time} {table.times.get(column)}"
        by_clock.setdefault(clock, []).append(name)
        if source.time is None and column in table.times:
            begins[name] = table.times[column][0]

    def open_columns(names: Sequence[str]) -> ArrayReader:
        units = {name: (signals[name].unit, signals[name].ordinary) for name in names}
        return ArrayReader(path, units, {name: sources[name] for name in names}, stated_zone(setup.timezone))

    if len({begin >= MIN_UNIX for begin in begins.values()}) > 1:
        with_date, without = max(begins, key=lambda name: begins[name]), min(begins, key=lambda name: begins[name])
        both = f"{without} has no wf_start_time, but {with_date} has one"
        raise ConfigurationError(f"{path}: {both}, so that their times cannot be compared: set it for both")
    if len(by_clock) < 2:
        return open_columns(list(signals))
    by_clock = {f"times of {names[0]}": names for names in by_clock.values()}
    return MergedReader(path, by_clock, lambda clock: open_columns(by_clock[clock]), is_one_file=True)


def tables_of(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The tables of a file; raise ConfigurationError if it is damaged, or has none."""
    head = head_of(path)
    if path.suffix.lower() == GZIP:
        raise ConfigurationError(f"{path}: a compressed file of arrays: unpack it")
    name, tables = next((store for start, store in STORES.items() if head.startswith(start)), ("", None))
    if tables is None:
        raise ConfigurationError(f"{path}: is not what its name says: unpack it if it is compressed")
    try:
        read = tables(path, opened)
    except ConfigurationError:
        raise
    except Exception as error:  # the libraries raise anything on damaged data
        raise ConfigurationError(f"{path}: {name} that is damaged: {_cause(error)}") from error
    if not read:
        raise ConfigurationError(f"{path}: {name} without columns of numbers")
    return read


def found(path: Path, tables: Sequence[ArrayTable], written: str) -> tuple[ArrayTable, str]:
    """The table with a column of a name, in front of which may be the one of its group, and its own name."""
    places = [
        (table, own)
        for table in tables
        for own in table.columns
        if written in (own, f"{table.name}/{own}", f"{table.name}.{own}")
    ]
    if len(places) > 1:
        several = ", ".join(f"{table.name}/{own}" for table, own in places)
        raise ConfigurationError(f"{path}: several columns are {written!r}: write the one that is meant: {several}")
    if not places:
        known = [own for table in tables for own in table.columns]
        raise ConfigurationError(f"{path}: no column {written!r}: {nearest(written, known)}")
    return places[0]


class ArrayReader(Reader):
    """Columns of one table of the file."""

    place = "row"
    is_table = True

    def __init__(
        self,
        path: Path,
        units: Mapping[str, tuple[str, Range | None]],
        sources: Mapping[str, TableSource],
        zone: tzinfo | None = None,
    ) -> None:
        """``units`` has the unit of each signal, and the range of an input in ordinary operation."""
        super().__init__(path)
        self._zone, self._opened = zone, ExitStack()
        self._segment: str | None = None  # Text of the present one; None until a row has one
        self._read = self._rows = self._bad = self._blank = 0
        try:
            self._open(units, sources)
        except BaseException:
            self._opened.close()
            raise
        self._times = EvenTimes()

    def _open(self, units: Mapping[str, tuple[str, Range | None]], sources: Mapping[str, TableSource]) -> None:
        tables = tables_of(self.path, self._opened)
        places = {name: found(self.path, tables, source.column or name) for name, source in sources.items()}
        self._table = next(iter(places.values()))[0]
        self._columns = {name: column for name, (_, column) in places.items()}
        self._sources = sources
        stated = next(iter(sources.values())).time
        request = None if stated is None else stated.request
        self._even = None if stated is not None else self._table.times.get(next(iter(self._columns.values())))
        names = list(self._table.columns)
        wanted = {
            name: ColumnRequest(_in_line(self._columns[name]), units[name][0], source.unit, *source.scaling)
            for name, source in sources.items()
        }
        if self._even is None and len(names) == 1:
            rows = counted(self._table.length, "row")
            raise ConfigurationError(f"{self.path}: {shown(names[0])} has {rows}, but no column of times has: add it")
        text = self._text(names)
        if self._even is not None:  # its times are in no column
            names, request = [TIME, *(name for name in names if name != TIME)], TimeRequest(TIME, "s", is_known=True)
            text = _as_text([[TIME, *map(self._cell, names[1:])]])
        self._header = read_header(self.path, io.StringIO(text), wanted, request)
        self._names = names
        scale, has_dates = self._header.columns[TIME].scale, self._header.date is not None
        self._clock = Clock(request or TimeRequest(), scale, self._zone, has_dates=has_dates)
        self.ignored = tuple(name for name, _, _ in self._header.others)
        self._no_readings = {}
        for name, source in sources.items():
            limits = units[name][1]
            limits = limits and self._header.columns[name].written(limits)
            self._no_readings[name] = NoReadings(source.range, limits)

    def _text(self, names: Sequence[str]) -> str:
        """The header of the table as a text, with its first rows, of which the times are judged."""
        lines = [list(map(self._cell, names))]
        if self._even is None:
            part = next(self._parts(names, JUDGED), {})
            columns = [list(map(str, _shown(part[name]).tolist())) for name in names] if part else []
            lines += map(list, zip(*columns, strict=True))
        return _as_text(lines)

    def _cell(self, name: str) -> str:
        unit = self._table.columns[name]
        return f"{name} [{unit}]" if unit else name

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the rows that were read, 0 to 1."""
        return self._read / max(self._table.length, 1)

    @property
    def bad(self) -> int:
        """Number of rows without a time."""
        return self._bad

    def chunks(self) -> Iterator[Rows]:
        columns = {name: self._names[column.place] for name, column in self._header.columns.items()}
        read = list(dict.fromkeys(name for key, name in columns.items() if key != TIME or self._even is None))
        beside = [place for place in (self._header.date, self._header.segment) if place is not None]
        read = list(dict.fromkeys((*read, *(self._names[place] for place in beside))))
        for part in self._parts(read, ROWS):
            count = len(part[read[0]])
            rows = self._rows_of(part, columns, count)
            self._read += count
            if len(rows.times):
                if not self._header.is_unit_stated and (question := question_of_unit(rows.times)):
                    raise ConfigurationError(f"{self.path}: {question}")
                self._rows += len(rows.times)
                yield from self._times.of(rows)
        yield from self._times.rest()
        if not self._read:
            raise ConfigurationError(f"{self.path}: {shown(self._names[-1])} and its other columns have no rows")
        if not self._rows:
            name = self._names[self._header.columns[TIME].place]
            remedy = f"correct {shown(name)}, or write its unit or another column: table.time under [driver]"
            raise ConfigurationError(f"{self.path}: none of its {self._read} rows has a time: {remedy}")

    def _parts(self, names: Sequence[str], rows: int) -> Iterator[Mapping[str, NDArray[Any]]]:
        parts = self._table.parts(names, rows)
        while True:
            try:
                part = next(parts, None)
            except Exception as error:  # the libraries raise anything on damaged data
                raise ConfigurationError(f"{self.path}: damaged behind row {self._read}: {_cause(error)}") from error
            if part is None:
                return
            yield part

    def _rows_of(self, part: Mapping[str, NDArray[Any]], columns: Mapping[str, str], count: int) -> Rows:
        lines = np.arange(self._read, self._read + count) + 1
        if self._even is not None:
            times: Array = np.asarray(self._even[0] + self._even[1] * (lines - 1.0))
        else:
            times = self._seconds(part[columns[TIME]], self._header.columns[TIME], self._dates(part))
        timed = np.abs(times) <= MAX_TIME
        bad = self._bad + np.cumsum(~timed)
        self._bad = int(bad[-1]) if count else self._bad
        values = {}
        for name, source in self._sources.items():
            written = _floats(part[columns[name]])[timed]
            written[np.isinf(written)] = np.nan
            self._blank += int(np.count_nonzero(np.isnan(written)))
            values[name] = self._header.columns[name].scaled(written)
            asked = written if source.range is None else source.value(written)
            values[name][self._no_readings[name].among(asked)] = np.nan
        return Rows(times[timed], values, lines[timed], bad[timed], self._marks(part, timed))

    def _marks(self, part: Mapping[str, NDArray[Any]], timed: Mask) -> Mask | None:
        if self._header.segment is None:
            return None
        marks, self._segment = changes(_texts(part[self._names[self._header.segment]][timed]), self._segment)
        return marks

    def _dates(self, part: Mapping[str, NDArray[Any]]) -> pa.StringArray | None:
        """The cells of the column with the dates, if that of the time has none."""
        return None if self._header.date is None else _texts(part[self._names[self._header.date]])

    def _seconds(self, cells: NDArray[Any], column: Column, dates: pa.StringArray | None) -> Array:
        if dates is not None:
            texts = with_dates(dates, _texts(cells))
            return self._clock.times(column.scaled(numbers(texts, ".")), texts)
        if cells.dtype.kind == "M":
            known = np.abs(np.asarray(cells).astype("datetime64[s]").astype(np.float64)) <= MAX_TIME
            times: Array = np.full(len(cells), np.nan)
            times[known] = np.asarray(cells)[known].astype("datetime64[us]").astype(np.float64) * 1e-6
            if not (isinstance(cells, Moments) and cells.has_zone):
                times[known] = on_wall_clock(times[known], self._clock.dates)
            return times
        if cells.dtype == object:
            texts = _texts(cells)
            return self._clock.times(column.scaled(numbers(texts, ".")), texts)
        written = _floats(cells)
        return self._clock.times(column.scaled(written), pa.array([""] * len(written)))

    def describe(self) -> list[str]:
        group = f" of {self._table.name!r}" if self._table.name else ""
        return [
            f"{name} [{self._header_unit(name)}] from column {column!r}{group}"
            for name, column in self._columns.items()
        ]

    def _header_unit(self, name: str) -> str:
        return self._sources[name].unit or self._table.columns[self._columns[name]] or "unit of the twin"

    def summary_lines(self) -> list[str]:
        rows = [f"{counted(self._rows, 'row')} read", counted(self._bad, "bad row")]
        return [*rows, f"{counted(self._blank, 'cell')} blank"]

    def assumptions(self) -> list[str]:
        return self._clock.dates.warnings()

    def warnings(self) -> list[str]:
        lines = [] if (coarse := self._times.text()) is None else [coarse]
        lines += self.assumptions()
        if self._bad:
            lines.append(f"bad rows: {self._bad} have no time")
        for name, no_readings in self._no_readings.items():
            lines += no_readings.warnings(name)
        return lines


def _floats(cells: NDArray[Any]) -> Array:
    if cells.dtype == object:
        return numbers(_texts(cells), ".")
    return np.asarray(cells).astype(np.float64)


def _shown(cells: NDArray[Any]) -> NDArray[Any]:
    """The cells with times of any unit as dates."""
    return np.asarray(cells).astype("datetime64[us]") if cells.dtype.kind == "M" else cells


def _texts(cells: NDArray[Any]) -> pa.StringArray:
    return pa.array([str(cell) for cell in _shown(cells).tolist()], pa.string())


def _in_line(name: str) -> str:
    """A name as a cell of a header has it."""
    return " ".join(name.split())


def _as_text(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a text table, whatever characters they have."""
    text = io.StringIO()
    csv.writer(text, delimiter="\t", quoting=csv.QUOTE_ALL, lineterminator="\n").writerows(
        map(_in_line, row) for row in rows
    )
    return "sep=\t\n" + text.getvalue()


def _cause(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
