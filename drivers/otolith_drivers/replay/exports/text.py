"""What a text in a form of its own is made of: its name, how it begins, and the plain rows of one variable in it."""

import re
from collections.abc import Callable, Iterator, Mapping
from datetime import tzinfo
from pathlib import Path
from typing import NamedTuple, Protocol

from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.replay.table.header import TIME, ColumnRequest, Header, Place, columns_of
from otolith_drivers.replay.table.times import TimeRequest


class Readable(Protocol):
    """What is read of a text."""

    def read(self, size: int = -1, /) -> str:
        """Return the next characters, some ``size``; none at the end."""

    def readline(self, size: int = -1, /) -> str:
        """Return the next line, or the next ``size`` characters of it."""


class TextExport(NamedTuple):
    """A form of text; ``begins`` matches one of its first lines."""

    name: str
    begins: re.Pattern[str]
    opened: Callable[[Path, Readable, Mapping[str, ColumnRequest], tzinfo], tuple[Header, Readable]]
    """Header and rows of the one signal that is wanted; TIME is wanted if the machine file states its unit.

    Raises ConfigurationError: the text does not have it.
    """
    has_dates: bool = False  # Whether its times count from dates on the clock of the plant


class Lines:
    """Lines that are made while they are read."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines

    def read(self, size: int = -1, /) -> str:
        """See :class:`Readable`."""
        taken, length = list[str](), 0
        while (size < 0 or length < size) and (line := next(self._lines, "")):
            taken.append(line)
            length += len(line)
        return "".join(taken)

    def readline(self, _: int = -1, /) -> str:
        """See :class:`Readable`."""
        return next(self._lines, "")


def wanted_signal(wanted: Mapping[str, ColumnRequest]) -> tuple[str, ColumnRequest]:
    """Return the one signal that is wanted."""
    return next((name, request) for name, request in wanted.items() if name != TIME)


class RowForm(NamedTuple):
    """How the rows behind a line are written."""

    line: int  # The one above them
    separator: str
    width: int  # Cells of a whole row
    time: Place
    signal: Place


def header_of(path: Path, wanted: Mapping[str, ColumnRequest], form: RowForm) -> Header:
    """Return the header above rows of a form."""
    name, request = wanted_signal(wanted)
    cells = [""] * form.width
    cells[form.time[0]], cells[form.signal[0]] = TIME, request.column
    time = wanted.get(TIME, ColumnRequest(TIME, "s"))
    columns, _ = columns_of(
        f"{path}:{form.line}",
        cells,
        {TIME: time, name: request},
        {time.column: form.time, request.column: form.signal},
        TimeRequest(is_known=True),
    )
    return Header(path, form.line, form.separator, (form.width, form.width), columns, is_shared=True)


def no_variable(path: Path, line: int, name: str, known: list[str]) -> ConfigurationError:
    """The error for a variable that a file does not have."""
    return ConfigurationError(f"{path}:{line}: no variable {name!r}: {nearest(name, known)}")
