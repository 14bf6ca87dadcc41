"""A text table as rows of numbers: one row per instant, one column per signal.

The file is read in chunks, so memory does not depend on its length. Bad rows (no time, wrong number of cells) and bad
cells (no number) are counted, and the first of them is reported with its line. A blank cell is a missing reading.

Of a table with one value per row, or with a block per variable, a reader reads one signal; several are merged.
"""

import codecs
import io
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, tzinfo
from pathlib import Path
from typing import NamedTuple, TextIO

import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers import keep_pandas_out
from otolith_drivers.base import Setup
from otolith_drivers.common.time_zones import stated_zone
from otolith_drivers.config_files import Range
from otolith_drivers.errors import ConfigurationError, counted, nearest
from otolith_drivers.replay.cleaning import EvenTimes, NoReadings
from otolith_drivers.replay.exports.registry import export_of
from otolith_drivers.replay.exports.text import Readable, TextExport
from otolith_drivers.replay.readers import DataFile, MergedReader, Reader, Rows, seen
from otolith_drivers.replay.table.chunk import LongVariable, TableChunk, TableCounts
from otolith_drivers.replay.table.header import (
    MAX_LINE,
    MAX_PREAMBLE,
    TIME,
    ColumnRequest,
    check_length,
    columns_called,
    read_header,
)
from otolith_drivers.replay.table.layout import TableLayout, layout_of
from otolith_drivers.replay.table.options import TableOptions, TableSource
from otolith_drivers.replay.table.times import Clock, TimeRequest, question_of_unit

# Engineering choice: small in memory, large against pyarrow's overhead per chunk. Guarded by test_replay.py (memory)
# and test_replay_tables.py (the result does not depend on it).
CHUNK = 1 << 17  # characters read at once

LOST_BLOCK = re.compile(rb"\0{16,}")  # what a file system leaves of a block that was not written when the power failed


keep_pandas_out()  # only the reader of MF4 logs needs it, which imports it itself


Source, Options = TableSource, TableOptions  # for readers.Format


def open_log(path: Path, setup: Setup, options: TableOptions | None = None) -> Reader:
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    signals = {signal.name: signal for signal in setup.signals}
    sources = {name: _with_time(signal.source, options) for name, signal in signals.items()}
    lines = first_lines(path)
    stated = None if options is None or options.names is None else (options.names, options.values or "")
    layout = layout_of(path, lines, [source.column or name for name, source in sources.items()], stated)
    export = None if stated else export_of(lines)

    def open_columns(names: Sequence[str]) -> TableReader:
        units = {name: signals[name].unit for name in names}
        ordinary = {name: signals[name].ordinary for name in names}
        own = {name: sources[name] for name in names}
        return TableReader(path, units, own, ordinary, TableForm(layout, export, stated_zone(setup.timezone)))

    by_time = defaultdict[str, list[str]](list)
    clocks = {source.time.column for source in sources.values() if source.time is not None}
    repeated = {column for column in clocks if any(columns_called(column, line) > 1 for line in lines)}
    for name, source in sources.items():
        is_own = layout.is_long or export is not None or (source.time is not None and source.time.column in repeated)
        by_time[f"times of {name}" if is_own else f"{source.time}"].append(name)
    if len(by_time) < 2:
        return open_columns(list(signals))
    return MergedReader(path, by_time, lambda time: open_columns(by_time[time]), is_one_file=True)


def _with_time(source: TableSource, options: TableOptions | None) -> TableSource:
    """The source with the time of the table, if it has none of its own."""
    if options is None or options.time is None or source.time is not None:
        return source
    return source.model_copy(update={"time": options.time})


def first_lines(path: Path) -> list[str]:
    """The lines of a table among which its header is."""
    data = DataFile(path)
    try:
        text = decoded(path, data)
        return [text.readline(MAX_LINE) for _ in range(MAX_PREAMBLE)]
    finally:
        data.close()


class TableForm(NamedTuple):
    """What is known of a table before it is opened."""

    layout: TableLayout = TableLayout()
    export: TextExport | None = None
    zone: tzinfo | None = None  # Of dates that name none


PLAIN = TableForm()


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
        form: TableForm = PLAIN,
    ) -> None:
        """``units`` has the unit of each wanted signal, ``sources`` the column of a signal that has another name.

        All of them have the times of one column. Of a table with one value per row, or a block per variable, it reads
        one signal.

        ``ordinary`` has the values of each input in ordinary operation, in its unit.

        Raises:
            ConfigurationError: the file is missing or no text, or a wanted column is missing.
        """
        data = DataFile(path)
        super().__init__(path, data)
        self.counts, self._times = TableCounts(), EvenTimes()
        named = {name: (sources or {}).get(name, TableSource()) for name in units}
        self._wanted = {
            name: ColumnRequest(form.layout.values or source.column or name, units[name], source.unit, *source.scaling)
            for name, source in named.items()
        }
        self._layout, self._export, zone = form
        self._variables = {name: source.column or name for name, source in named.items()}
        try:
            self._decoded = decoded(path, data)  # kept: alone it would close the file with a warning
            self._text: Readable = self._decoded
            time = next(iter(named.values())).time if named else None
            request = form.layout.time if time is None else time.request
            if form.export is None:
                self._header = read_header(path, self._text, self._wanted, request)
            else:
                self._header, self._text = form.export.opened(path, self._text, self._wanted, zone or UTC)
            variable = self._variable()
        except BaseException:
            data.close()
            raise
        scale, has_dates = self._header.columns[TIME].scale, self._header.date is not None
        clock = Clock(request or TimeRequest(self._header.clock), scale, zone, has_dates=has_dates)
        self._dates = clock.dates
        self._dates.assumed(1 if form.export is not None and form.export.has_dates else 0)
        self._chunk = TableChunk(self._header, self.counts, clock, named, variable)
        self.ignored = tuple(name for name, _, _ in self._header.others)
        for name, source in named.items():
            limits = (ordinary or {}).get(name)
            limits = limits and self._header.columns[name].written(limits)
            self.counts.no_readings[name] = NoReadings(source.range, limits)

    def _variable(self) -> LongVariable | None:
        """Which rows are those of the signal, in a table with one value per row."""
        layout = self._layout
        if layout.names is None:
            return None
        places = {name: index for name, index, _ in self._header.others}
        name = next(iter(self._variables.values())) if layout.is_long else None
        if layout.names not in places:  # a signal is read from it
            return None
        validity = places.get(layout.validity or "") if layout.is_long else None
        others = frozenset({layout.values or "", self._header.clock}) if layout.series else frozenset[str]()
        return LongVariable(places[layout.names], name, validity, places.get(layout.series or ""), others)

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
        yield from self._rows(rest, number, is_cut=True)
        yield from self._times.rest()
        if not self.counts.rows:
            raise ConfigurationError(f"{self.path}{self._why_no_rows()}")

    def _rows(self, text: str, first: int, *, is_cut: bool = False) -> Iterator[Rows]:
        lines = pc.list_flatten(pc.split_pattern(pa.array([text]), "\n"))
        lengths = pc.utf8_length(lines).to_numpy()
        check_length(f"{self.path}:{first + int(lengths.argmax())}", int(lengths.max()))
        rows = self._chunk.rows(lines, first, quoted='"' in text, is_cut=is_cut)
        if rows is not None:
            if not self._header.is_unit_stated and (question := question_of_unit(rows.times)):
                raise ConfigurationError(f"{self.path}: {question}")
            yield from self._times.of(rows)

    def _why_no_rows(self) -> str:
        if self.counts.first_bad is None and self._layout.is_long:
            name, known = next(iter(self._variables.values())), sorted(self.counts.names)
            return f": no row has {name!r} in column {self._layout.names!r}: {nearest(name, known)}"
        if self.counts.first_bad is None:
            return ": no rows below the header"
        line, cause = self.counts.first_bad
        return f":{line}: {cause}; none of the {self.counts.bad_rows} rows can be used"

    def describe(self) -> list[str]:
        form = f" of {self._layout.format}" if self._layout.format else ""
        form = f" of {self._export.name}" if self._export is not None else form
        if self._layout.is_long:
            form = f" in column {self._layout.names!r}{form}"
        return [
            f"{name} [{wanted.unit}] from {'' if self._layout.is_long else 'column '}{self._variables[name]!r}{form}"
            for name, wanted in self._wanted.items()
        ]

    def summary_lines(self) -> list[str]:
        counts = self.counts
        parts = [f"{counted(counts.rows, 'row')} read", counted(counts.bad_rows, "bad row")]
        return [*parts, counted(counts.bad_cells, "bad cell"), f"{counted(counts.blank, 'cell')} blank"]

    def assumptions(self) -> list[str]:
        return self._dates.warnings()

    def warnings(self) -> list[str]:
        lines, counts = [*self.assumptions(), *self._cut_off()], self.counts
        if counts.short:
            what = f"{counted(counts.short, 'row')} without last cells, the first in line {counts.first_short}"
            lines.append(f"{what}: those cells count as blank")
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
