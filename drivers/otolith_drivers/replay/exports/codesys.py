"""A trace of CODESYS or ctrlX: keys with values, and a block of rows ``; time; value`` for each variable.

    [key]; [value]
    0.Variable; GVL.rSpeed
    0.Data;
    ; 2; 24.0

The times are milliseconds, unless the machine file states another unit.
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
from otolith_drivers.replay.table.header import MAX_LINE, ColumnRequest, Header

VARIABLE = re.compile(r"(\d+)\.Variable\s*;\s*(.*?)\s*;?\s*$")
DATA = re.compile(r"(\d+)\.Data\s*;")


def opened(path: Path, text: Readable, wanted: Mapping[str, ColumnRequest], zone: tzinfo) -> tuple[Header, Readable]:
    """See :class:`TextExport`."""
    _, request = wanted_signal(wanted)
    known, number, own = list[str](), 0, ""
    while line := text.readline(MAX_LINE):
        number += 1
        if (variable := VARIABLE.match(line)) is not None:
            known.append(variable[2])
            own = variable[1] if variable[2] == request.column else own
        elif (data := DATA.match(line)) is not None and data[1] == own:
            return header_of(path, wanted, RowForm(number, ";", 3, (1, "ms"), (2, None))), Lines(_rows(text))
    if own:
        raise ConfigurationError(f"{path}:{number}: variable {request.column!r} has no rows")
    raise no_variable(path, number, request.column, known)


def _rows(text: Readable) -> Iterator[str]:
    """The rows of a block, to the next key."""
    while (line := text.readline(MAX_LINE)) and line.lstrip()[:1] in ("", ";"):
        yield line


CODESYS = TextExport("a trace of CODESYS (times in ms)", re.compile(r"\[key\]\s*;\s*\[value\]|0\.Variable\s*;"), opened)
