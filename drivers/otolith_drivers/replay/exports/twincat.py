"""The text that TwinCAT Scope exports: keys of the export, keys of each channel, rows of times and values.

    Name                <name of the scope>
    Starttime of export <100 ns since 1601> ...

    Name          speed   Name          torque
    SampleTime[ms]    1   SampleTime[ms]     5
    Unit          rpm     Unit          Nm (Torque)

    0             100     0             0.5

A column called ``Name`` has the times of the channels behind it, in ms from the start of the export, or full: in 100 ns
since 1601. Offsets and scales are applied to the values already.
"""

import re
from collections.abc import Iterator, Mapping
from datetime import tzinfo
from pathlib import Path

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.exports.text import (
    Lines,
    Readable,
    RowForm,
    TextExport,
    header_of,
    no_variable,
    wanted_signal,
)
from otolith_drivers.replay.table.header import MAX_LINE, TIME, ColumnRequest, Header, is_number
from otolith_drivers.units import is_unit

FILETIME_STEP, FILETIME_TO_1970 = 1e-7, 11_644_473_600.0  # s
FULL = 1e15  # a number of ms this large would be 30 000 years
MAX_KEYS = 60  # lines of keys; engineering choice: the program writes some twenty
START = "Starttime of export"
KEY = "Name"  # of the line with the names of the channels; above their times
UNIT = re.compile(r"\s*(.*?)\s*(?:\([^()]*\))?\s*")  # and the quantity in parentheses


def opened(path: Path, text: Readable, wanted: Mapping[str, ColumnRequest], zone: tzinfo) -> tuple[Header, Readable]:
    """See :class:`TextExport`."""
    lines = _head(text)
    separator = next(line[len(START)] for line in lines if line.startswith(START))
    table = [[cell.strip() for cell in line.rstrip("\r\n").split(separator)] for line in lines]
    start = next(number for number, cells in enumerate(table) if cells[0] == START)
    at = next((number for number, cells in enumerate(table) if cells[0] == KEY and number > start), None)
    if at is None:
        raise ConfigurationError(f"{path}: {NAME} without columns of times: export it with Timelines = All")
    names, keys = table[at], {cells[0]: cells for cells in table[at:-1]}
    _, request = wanted_signal(wanted)
    places = [place for place, name in enumerate(names) if name == request.column and name != KEY]
    if not places:
        known = [name for name in names if name and name != KEY]
        raise no_variable(path, at + 1, request.column, known)
    if len(places) > 1:
        raise ConfigurationError(f"{path}:{at + 1}: {len(places)} channels are called {request.column!r}: rename one")
    time = max(place for place in range(places[0]) if names[place] == KEY)
    cells = keys.get("Unit", [])
    written = UNIT.fullmatch(cells[places[0]] if places[0] < len(cells) else "")
    unit = written[1] if written is not None and is_unit(written[1]) else None
    form = RowForm(len(lines) - 1, separator, len(names), (time, "ms"), (places[0], unit))
    header = header_of(path, wanted, form)
    first = table[-1][time] if time < len(table[-1]) else ""
    is_full = is_number(first) and float(first.replace(",", ".")) > FULL
    begin = _begin(path, {cells[0]: cells for cells in table[:at]})
    scale, offset = (FILETIME_STEP, -FILETIME_TO_1970) if is_full else (header.columns[TIME].scale, begin)
    header.columns[TIME] = header.columns[TIME]._replace(scale=scale, offset=offset)
    return header, Lines(_joined(lines[-1], text))


def _head(text: Readable) -> list[str]:
    """The lines to the first row, and that row; a row begins with a number, and channels may begin with blank cells."""
    lines, separator = list[str](), ""
    while len(lines) < MAX_KEYS and (line := text.readline(MAX_LINE)):
        lines.append(line.lstrip("\ufeff"))
        separator = separator or (lines[-1][len(START)] if TWINCAT.begins.match(lines[-1]) else "")
        if separator and is_number(next((cell for cell in map(str.strip, line.split(separator)) if cell), "")):
            break
    return lines


def _begin(path: Path, keys: Mapping[str, list[str]]) -> float:
    """The Unix time (s) at which the export starts."""
    written = keys[START][1]
    if not written.isdigit():
        raise ConfigurationError(f"{path}: {START!r} of {NAME} is {written!r}, not a number of 100 ns")
    return FILETIME_STEP * int(written) - FILETIME_TO_1970


def _joined(first: str, text: Readable) -> Iterator[str]:
    yield first
    while part := text.readline(MAX_LINE):
        yield part


NAME = "an export of TwinCAT Scope"
TWINCAT = TextExport(NAME, re.compile(rf"{START}[\s;,|]"), opened)
