"""Which columns a table has beside that of the time, and which units its header or a line beside it states for them."""

from pathlib import Path
from typing import NamedTuple

from otolith_drivers.replay.readers import DataFile
from otolith_drivers.replay.table.header import is_number, read_header
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import TableReader, decoded
from otolith_drivers.units import is_unit

ANY_UNIT = "1"  # of a column whose numbers are read as they stand


class OfferedColumn(NamedTuple):
    """A column that a signal may name."""

    name: str
    unit: str | None  # None if none is stated, or none that is known


def offered_columns(path: Path) -> list[OfferedColumn]:
    """The columns of the table at ``path`` whose names are unique; raise ConfigurationError if it has no header."""
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


def read_columns(path: Path, columns: list[OfferedColumn]) -> TableReader:
    """A reader of ``columns`` by their names, in their own units."""
    signals = {column.name: column.unit or ANY_UNIT for column in columns}
    sources = {name: TableSource(column=name, unit=unit) for name, unit in signals.items()}
    return TableReader(path, signals, sources)


def _known(unit: str | None) -> str | None:
    return unit if unit and is_unit(unit) else None


def _units_of(cells: list[str]) -> dict[int, str]:
    """The units in a line, by the position of their columns; empty if a cell is anything else."""
    texts = {index: text for index, cell in enumerate(cells) if (text := cell.strip("[]()"))}
    if any(is_number(text) or not is_unit(text) for text in texts.values()):
        return {}
    return texts
