"""A LabVIEW measurement file (LVM): tags of the file, and segments with tags of each channel above their rows.

The times are in the first column, in one before each channel, or in none: then they follow from ``X0`` and
``Delta_X``. They count from ``Date`` and ``Time`` of the segment. Each segment has the same channels.
"""

import math
import re
from collections.abc import Iterator, Mapping
from datetime import datetime, tzinfo
from pathlib import Path

from otolith_drivers.common.message_times import unix_time
from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.replay.exports.text import (
    Lines,
    Readable,
    RowForm,
    TextExport,
    header_of,
    no_variable,
    wanted_signal,
)
from otolith_drivers.replay.table.header import MAX_LINE, ColumnRequest, Header, is_number
from otolith_drivers.units import is_unit

END = "***End_of_Header***"
SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";"}
MAX_TAGS = 200  # lines of one header; engineering choice
FIRST_CELL = "X_Value"


def opened(path: Path, text: Readable, wanted: Mapping[str, ColumnRequest], zone: tzinfo) -> tuple[Header, Readable]:
    """See :class:`TextExport`."""
    _, request = wanted_signal(wanted)
    reader = _LvmText(path, text, request.column, zone)
    unit = reader.unit if reader.unit and is_unit(reader.unit) else None
    return header_of(path, wanted, RowForm(reader.number, "\t", 2, (0, "s"), (1, unit))), Lines(reader.rows())


class _LvmText:
    """One channel of a file as lines of time and value, and an empty line for each that is no row."""

    def __init__(self, path: Path, text: Readable, channel: str, zone: tzinfo) -> None:
        """Read to the first row."""
        self._path, self._text, self._channel, self._zone = path, text, channel, zone
        self.number = 0  # of the last line that was read
        self.unit: str | None = None  # of the channel, empty if none is stated; None before the first segment
        self._separator = "\t"
        file = self._tags({})
        self._separator = SEPARATORS.get(file.get("Separator", [""])[0].casefold(), "\t")
        self._decimal = file.get("Decimal_Separator", ["."])[0] or "."
        self._columns = file.get("X_Columns", ["One"])[0].casefold()
        self._file = file
        self._begin_segment(self._tags({}))

    def _line(self) -> list[str] | None:
        line = self._text.readline(MAX_LINE)
        self.number += bool(line)
        return [cell.strip() for cell in line.rstrip("\r\n").split(self._separator)] if line else None

    def _tags(self, tags: dict[str, list[str]]) -> dict[str, list[str]]:
        """The tags to the next end of a header."""
        for _ in range(MAX_TAGS):
            cells = self._line()
            if cells is None or cells[0] == END:
                return tags
            if cells[0]:
                tags[cells[0]] = cells[1:]
        raise ConfigurationError(f"{self._path}:{self.number}: no {END} in {MAX_TAGS} lines")

    def _begin_segment(self, tags: Mapping[str, list[str]]) -> None:
        names = self._line() or []
        if names[:1] != [FIRST_CELL]:
            raise ConfigurationError(f"{self._path}:{self.number}: no line of names, which begins with {FIRST_CELL}")
        channels = [name for name in names[1:] if name not in ("", FIRST_CELL, "Comment")]
        if channels.count(self._channel) != 1:
            if self._channel in channels:
                raise ConfigurationError(f"{self._path}:{self.number}: several channels are {self._channel!r}: rename")
            raise no_variable(self._path, self.number, self._channel, channels)
        self._value, channel = names.index(self._channel), channels.index(self._channel)
        self._time = self._value - 1 if self._columns == "multi" else 0

        def tag(name: str, default: str) -> str:
            cells = tags.get(name, [])
            return (cells[channel] if channel < len(cells) else "") or default

        dimension = tag("X_Dimension", "Time")
        if dimension.casefold() != "time":
            raise ConfigurationError(f"{self._path}: X of {self._channel!r} is {dimension}, not Time")
        unit = tag("Y_Unit_Label", "")
        if self.unit is not None and unit not in ("", self.unit):
            units = f"{shown(self._channel)} is in {shown(unit)} here, but in {shown(self.unit)} above"
            raise ConfigurationError(f"{self._path}:{self.number}: {units}: export the segments apart")
        self.unit = unit or self.unit or ""
        day, clock = (tag(name, self._file.get(name, [""])[0]) for name in ("Date", "Time"))
        self._begin, self._row = self._moment(day, clock), 0
        self._first, self._step = (self._float(tag(name, text)) for name, text in (("X0", "0"), ("Delta_X", "0")))
        if self._columns == "no" and not self._step > 0.0:
            raise ConfigurationError(f"{self._path}:{self.number}: no times of {self._channel!r}: Delta_X is missing")

    def _moment(self, day: str, clock: str) -> float:
        """The Unix time (s) from which the times count; 0 if the file does not say."""
        if not day or not clock:
            return 0.0
        try:
            whole, _, fraction = clock.replace(",", ".").partition(".")
            moment = datetime.strptime(f"{day.replace('-', '/')} {whole} +0000", "%Y/%m/%d %H:%M:%S %z")
            return unix_time(moment.replace(tzinfo=None), self._zone) + float(f"0.{fraction or 0}")
        except ValueError as error:
            text = f"{self._path}:{self.number}: Date {day!r} and Time {clock!r} are no 2026/03/29 and 01:59:58.25"
            raise ConfigurationError(text) from error

    def _float(self, text: str) -> float:
        number = text.replace(self._decimal, ".")
        return float(number) if is_number(number) else float("nan")

    def rows(self) -> Iterator[str]:
        """The rows of all segments; an empty line for each line that is none."""
        while (cells := self._line()) is not None:
            if cells[0] in ("Channels", "Samples"):  # the tags of the next segment
                before = self.number
                self._begin_segment(self._tags({cells[0]: cells[1:]}))
                yield "\n" * (self.number - before + 1)
                continue
            value = cells[self._value] if self._value < len(cells) else ""
            if not any(cells):
                yield "\n"
                continue
            time = self._first + self._row * self._step
            written = ""
            if self._columns != "no":
                written = cells[self._time] if self._time < len(cells) else ""
                time = self._float(written)
            self._row += 1
            written = written if math.isnan(time) else repr(self._begin + time)
            yield f"{written}\t{value.replace(self._decimal, '.')}\n"


LVM = TextExport("a LabVIEW measurement file (LVM)", re.compile(r"LabVIEW Measurement\s*"), opened, has_dates=True)
