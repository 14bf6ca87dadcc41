"""The form of a table: a row per instant, or a value per row whose variable is named in another column.

Formats that are known by the names of their columns are rows of :data:`KNOWN`.
"""

from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.table.header import (
    NAMES_NAME,
    SEPARATORS,
    TIME_NAME,
    VALUE_NAME,
    name_and_unit,
    split_quoted,
)
from otolith_drivers.replay.table.times import TimeRequest

SPREADSHEET_EPOCH = datetime.fromisoformat("1899-12-30")


class TableLayout(NamedTuple):
    """Where a table has what; None where its header and the machine file say it."""

    format: str = ""  # Its name in a description; empty for a plain table
    time: TimeRequest | None = None  # If the format defines it
    names: str | None = None  # Column with the names of variables
    values: str | None = None  # Column with their values; only with ``names``
    validity: str | None = None  # Column whose 0 says that the value is none
    series: str | None = None  # Column whose text must be the same in all rows of a variable

    @property
    def is_long(self) -> bool:
        """Whether each row has one value."""
        return self.values is not None


class KnownTable(NamedTuple):
    """A format that is recognised by its columns."""

    columns: frozenset[str]
    layout: TableLayout


KNOWN = (
    KnownTable(
        frozenset({"VarName", "TimeString", "VarValue", "Validity", "Time_ms"}),
        TableLayout(
            "a tag log of WinCC",
            # Despite its name: days of a spreadsheet, times a million, on the clock of the panel.
            TimeRequest("Time_ms", "microday", epoch=SPREADSHEET_EPOCH, is_known=True),
            names="VarName",
            values="VarValue",
            validity="Validity",
        ),
    ),
    KnownTable(
        frozenset({"Record", "Date", "UTC Time"}),
        TableLayout(
            "a data log of S7",
            TimeRequest("UTC Time", date="Date", format="%m/%d/%Y %H:%M:%S", zone=UTC, is_known=True),
        ),
    ),
    KnownTable(
        frozenset({"_time", "_value", "_field"}),
        TableLayout("an export of InfluxDB", TimeRequest("_time"), names="_field", values="_value", series="table"),
    ),
    KnownTable(
        frozenset({"entity_id", "state", "last_changed"}),
        TableLayout("a history of Home Assistant", TimeRequest("last_changed"), names="entity_id", values="state"),
    ),
)


def layout_of(path: Path, lines: Sequence[str], wanted: Collection[str], stated: tuple[str, str] | None) -> TableLayout:
    """Return the layout of the table that begins with ``lines``, of which columns are ``wanted``.

    ``stated`` has the columns of the names and of the values, if the machine file says so.
    """
    for line in lines:
        for separator in SEPARATORS:
            cells = split_quoted(line, separator)
            names = [name_and_unit(cell)[0] for cell in cells]
            known = next((row.layout for row in KNOWN if row.columns <= set(names)), None)
            if known is not None:
                return _for(known, names, wanted, stated)
            if stated is not None and set(stated) <= set(names):
                return TableLayout(names=stated[0], values=stated[1])
            if stated is None and (long := _long(names, wanted)) is not None:
                return long
    if stated is not None:
        raise ConfigurationError(
            f"{path}: no line has the columns {stated[0]!r} and {stated[1]!r}: correct table.names and table.values"
        )
    return TableLayout()


def _for(
    known: TableLayout, names: Collection[str], wanted: Collection[str], stated: tuple[str, str] | None
) -> TableLayout:
    """The layout of a known format; columns that are wanted by their own names are read as they stand."""
    series = known.series if known.series in names else None
    if stated is not None:
        return known._replace(names=stated[0], values=stated[1], series=None)
    if known.is_long and all(name in names for name in wanted):
        return known._replace(values=None, series=None)
    return known._replace(series=series)


def _long(names: Sequence[str], wanted: Collection[str]) -> TableLayout | None:
    """The layout of a table with one column of names, one of values and one of times, if no wanted one is there."""
    variables, values = ([name for name in names if pattern.fullmatch(name)] for pattern in (NAMES_NAME, VALUE_NAME))
    times = [name for name in names if name == "t" or TIME_NAME.fullmatch(name)]
    if not times or len(variables) != 1 or len(values) != 1 or any(name in names for name in wanted):
        return None
    return TableLayout(names=variables[0], values=values[0])
