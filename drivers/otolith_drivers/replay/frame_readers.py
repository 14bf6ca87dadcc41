"""Frames of the CAN logs that python-can does not read, or reads without checks: text of tools, and databases."""

import heapq
import logging
import re
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from otolith_drivers.canbus import can
from otolith_drivers.canbus.database import EXTENDED_LIMIT, STANDARD_LIMIT
from otolith_drivers.canbus.options import CLASSIC_LENGTH
from otolith_drivers.common.message_times import unix_time
from otolith_drivers.errors import ConfigurationError, installation_of, some_names
from otolith_drivers.replay.readers import GZIP, seen

STANDARD_DIGITS = 3  # of an identifier of 11 bits
ERROR_FLAG = 1 << 29  # in the identifier that candump prints for an error frame
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
CANDUMP_LINE = re.compile(
    r"\((?P<time>[^)]+)\)\s+(?P<channel>\S+)\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s+\[(?P<length>\d{1,2})\](?P<rest>.*)"
)
MF4_FRAME = "CAN_DataFrame"  # channel of the frames (ASAM MDF bus logging)
MF4_CHUNK = 20_000  # frames that are read at once
SQLITE_COLUMNS = ("ts", "arbitration_id", "extended", "remote", "error", "dlc", "data")


class CandumpLines:
    """The frames in what ``candump -ta`` or ``-tA`` prints; raises ValueError on a line that has none."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines

    def __iter__(self) -> Iterator[can.Message]:
        for line in self._lines:
            text = COLOUR.sub("", line).strip()
            if not text:
                continue
            match = CANDUMP_LINE.match(text)
            if match is None:
                raise ValueError("no line of candump")
            identifier, length, rest = int(match["id"], 16), int(match["length"]), match["rest"]
            is_remote = rest.strip().startswith("remote")
            data = b"" if is_remote else bytes.fromhex("".join(rest.split()[:length]))
            if len(data) != length and not is_remote:  # too few, or bits (candump -i)
                raise ValueError("not as many bytes as it says")
            is_long, is_error = len(match["id"]) > STANDARD_DIGITS, bool(identifier & ERROR_FLAG)
            yield can.Message(
                timestamp=_candump_time(match["time"]),
                channel=match["channel"],
                arbitration_id=identifier & EXTENDED_LIMIT,
                is_extended_id=is_long and not is_error,
                is_error_frame=is_error,
                is_remote_frame=is_remote,
                is_fd=len(match["length"]) > 1,
                dlc=length,
                data=data,
            )


def _candump_time(written: str) -> float:
    """Seconds; a date has no time zone, and counts as UTC."""
    return unix_time(datetime.fromisoformat(written)) if "-" in written else float(written)


class SavvyCanLines:
    """The frames in a CSV of SavvyCAN, whose times are in µs; raises ValueError on a line that has none."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines = lines
        self._columns: dict[str, int] = {}

    def __iter__(self) -> Iterator[can.Message]:
        for line in self._lines:
            cells = [cell.strip().strip('"') for cell in line.split(",")]
            if not self._columns:
                self._columns = {name.casefold(): index for index, name in enumerate(cells)}
                continue
            if not any(cells):
                continue
            row = {name: cells[index] for name, index in self._columns.items() if index < len(cells)}
            first, length = self._columns["d1"], int(row["len"])
            data = bytes(int(cell, 16) for cell in cells[first : first + length])
            if len(data) < length:
                raise ValueError("too few bytes")
            yield can.Message(
                timestamp=float(row["time stamp"]) * 1e-6,
                channel=row.get("bus"),
                arbitration_id=int(row["id"], 16),
                is_extended_id=row["extended"].casefold() in {"true", "1"},
                is_fd=length > CLASSIC_LENGTH,
                dlc=length,
                data=data,
            )


class SqliteFrames:
    """The frames in a database of python-can."""

    place = "record"
    passed = 0
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, head: bytes) -> None:
        if not head.startswith(b"SQLite format 3"):
            kind = seen(head)
            raise ConfigurationError(f"{path}: is not a database of SQLite{f' but {kind}' if kind else ''}")
        if path.suffix.lower() == GZIP:
            raise ConfigurationError(f"{path}: a database cannot be read while it is compressed: unpack it")
        self._path = path

    def frames(self) -> Iterator[tuple[int, can.Message | str]]:
        """Number of each frame with the frame, or with the reason why it has none; can be iterated once."""
        number = 0
        with closing(sqlite3.connect(f"{self._path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            try:
                for row in database.execute(f"SELECT {', '.join(SQLITE_COLUMNS)} FROM messages"):  # noqa: S608 - constants
                    number += 1
                    yield number, _frame_of_row(row)
            except sqlite3.Error as error:
                yield number + 1, f"no table of frames by python-can, or a damaged one: reading ends ({error})"


def _frame_of_row(row: tuple[Any, ...]) -> can.Message | str:
    """The frame in a row of a database, or why it has none."""
    time, identifier, extended, remote, error, length, data = row
    try:
        return can.Message(
            timestamp=float(time),
            arbitration_id=int(identifier),
            is_extended_id=bool(extended),
            is_remote_frame=bool(remote),
            is_error_frame=bool(error),
            dlc=int(length),
            data=data,
            is_fd=int(length) > CLASSIC_LENGTH,
            check=True,
        )
    except (TypeError, ValueError) as fault:
        return f"no frame: {fault}"


class Mf4Frames:
    """The frames in an MF4 file that a bus logger wrote (ASAM MDF 4)."""

    place = "frame"
    passed = 0
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, head: bytes) -> None:
        if not head.startswith(b"MDF ") or path.suffix.lower() == GZIP:
            kind = seen(head)
            raise ConfigurationError(f"{path}: is not an unpacked MF4 file{f' but {kind}' if kind else ''}")
        if find_spec("asammdf") is None:
            raise ConfigurationError(f"{path}: an MF4 file needs the extra 'mf4': {installation_of('mf4')}")
        self._path = path

    def frames(self) -> Iterator[tuple[int, can.Message | str]]:
        """Number of each frame with the frame, or with the reason why there is none; can be iterated once."""
        from asammdf import MDF  # noqa: PLC0415 - slow to import

        logging.getLogger("asammdf").setLevel(logging.CRITICAL)
        number = 0
        try:
            with MDF(self._path) as file:
                begun = file.header.start_time.timestamp()
                names = [[channel.name for channel in group.channels] for group in file.groups]
                groups = [index for index, group in enumerate(names) if MF4_FRAME in group]
                if not groups:
                    signals = [name for group in names for name in group if name not in {"t", "time"}]
                    yield 1, f"signals ({some_names(signals)}) and no CAN frames: export them as CSV"
                frames = (_mf4_frames(file, index, begun) for index in groups)
                for frame in heapq.merge(*frames, key=lambda frame: frame.timestamp):
                    number += 1
                    yield number, frame
        except Exception as error:  # noqa: BLE001 - the library raises anything on damaged data
            yield number + 1, f"the file is damaged or cut off here: reading ends ({error or type(error).__name__})"


def _mf4_frames(file: Any, group: int, begun: float) -> Iterator[can.Message]:
    """The frames of a channel group; ``begun`` is the Unix time (s) from which its times count."""
    count = file.groups[group].channel_group.cycles_nr
    for first in range(0, count, MF4_CHUNK):
        part = file.get(MF4_FRAME, group, record_offset=first, record_count=min(MF4_CHUNK, count - first))
        fields = part.samples.dtype.names
        channels = part[f"{MF4_FRAME}.BusChannel"] if f"{MF4_FRAME}.BusChannel" in fields else None
        wide = part[f"{MF4_FRAME}.IDE"] if f"{MF4_FRAME}.IDE" in fields else None
        identifiers, lengths = part[f"{MF4_FRAME}.ID"], part[f"{MF4_FRAME}.DataLength"]
        data = part[f"{MF4_FRAME}.DataBytes"]
        for index, time in enumerate(part.timestamps):
            identifier, length = int(identifiers[index]), int(lengths[index])
            extended = bool(wide[index]) if wide is not None else identifier > STANDARD_LIMIT
            yield can.Message(
                timestamp=begun + float(time),
                channel=None if channels is None else int(channels[index]),
                arbitration_id=identifier & EXTENDED_LIMIT,
                is_extended_id=extended,
                is_fd=length > CLASSIC_LENGTH,
                dlc=length,
                data=data[index][:length].tobytes(),
            )
