"""Which columns a table has beside that of the time, and which units its header or a line beside it states for them.

Of a table with one value per row they are its variables, of a file of arrays the arrays beside the times.
"""

import contextlib
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.exports.registry import export_of
from otolith_drivers.replay.readers import DataFile, Reader, format_of, holds_arrays
from otolith_drivers.replay.table.header import SEGMENT, TIME, TIME_NAME, is_number, name_and_unit, read_header
from otolith_drivers.replay.table.layout import TableLayout, layout_of
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import TableForm, TableReader, decoded, first_lines
from otolith_drivers.units import is_unit

NO_NAME = "\0"  # that no column has
SAMPLE_PERIOD = 0.01  # s; of a set-up, which no table asks for
ANY_UNIT = "1"  # of a column whose numbers are read as they stand


class OfferedColumn(NamedTuple):
    """A column that a signal may name."""

    name: str
    unit: str | None  # None if none is stated, or none that is known


def offered_columns(path: Path) -> list[OfferedColumn]:
    """The columns of the table at ``path`` whose names are unique; raise ConfigurationError if it has no header."""
    if holds_arrays(path):
        return _offered_arrays(path)
    lines = first_lines(path)
    if (export := export_of(lines)) is not None:
        remedy = "write a machine file that names its variables, as docs/replay.md says, or export a row per instant"
        raise ConfigurationError(f"{path}: {export.name} does not list its variables as columns: {remedy}")
    layout = layout_of(path, lines, [NO_NAME], None)
    return _offered_variables(path, layout) if layout.is_long else _offered_in_header(path)


def _offered_arrays(path: Path) -> list[OfferedColumn]:
    """Those of each table of the file that has times, with the name of its group where others have the column."""
    from otolith_drivers.replay.exports.arrays import tables_of  # noqa: PLC0415 - few files need it

    with ExitStack() as opened:
        tables = tables_of(path, opened)
    names = [name for table in tables for name in table.columns]
    return [
        OfferedColumn(
            name if names.count(name) == 1 else f"{table.name}/{name}", _known(unit or name_and_unit(name)[1])
        )
        for table in tables
        if table.times or any(map(_is_time, table.columns))
        for name, unit in table.columns.items()
        if (name in table.times if table.times else not (_is_time(name) or name == SEGMENT))
    ]


def _is_time(name: str) -> bool:
    own = name_and_unit(name)[0]
    return own == TIME or TIME_NAME.fullmatch(own) is not None


def _offered_variables(path: Path, layout: TableLayout) -> list[OfferedColumn]:
    """Those of a table with one value per row."""
    reader = TableReader(path, {NO_NAME: ANY_UNIT}, form=TableForm(layout))
    with reader, contextlib.suppress(ConfigurationError):  # no row is of that name
        for _ in reader.chunks():
            pass
    return [OfferedColumn(name, None) for name in sorted(reader.counts.names - {layout.names})]


def _offered_in_header(path: Path) -> list[OfferedColumn]:
    data = DataFile(path)
    try:
        text = decoded(path, data)  # closed with the file: alone it would close it with a warning
        header = read_header(path, text, {})
    finally:
        data.close()
    beside = next((units for units in map(_units_of, header.beside) if units), {})
    names = [name for name, _, _ in header.others]
    return [
        OfferedColumn(name, _known(written) or _known(beside.get(index)))
        for name, index, written in header.others
        if names.count(name) == 1
    ]


def read_columns(path: Path, columns: list[OfferedColumn]) -> Reader:
    """A reader of ``columns`` by their names, in their own units."""
    signals = tuple(
        Signal(name=name, unit=unit, source=TableSource(column=name, unit=unit))
        for name, unit in ((column.name, column.unit or ANY_UNIT) for column in columns)
    )
    return format_of(path).open_log(path, Setup(signals, path.parent, SAMPLE_PERIOD), None)


def _known(unit: str | None) -> str | None:
    return unit if unit and is_unit(unit) else None


def _units_of(cells: list[str]) -> dict[int, str]:
    """The units in a line, by the position of their columns; empty if a cell is anything else."""
    texts = {index: text for index, cell in enumerate(cells) if (text := cell.strip("[]()"))}
    if any(is_number(text) or not is_unit(text) for text in texts.values()):
        return {}
    return texts
