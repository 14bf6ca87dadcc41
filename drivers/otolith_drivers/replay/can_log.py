"""A CAN log as rows of numbers: one row per frame with wanted signals, decoded by the code of the CAN driver.

python-can parses most formats. Its readers of text stop at the first line that they cannot parse: they are started
again behind it, and the line is counted. Its BLF reader hangs on some damaged files: its input is checked before.
Formats that it does not read, or reads without checks, are read here: text of tools, and databases.
"""

import io
import logging
import math
import re
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Self, TextIO, cast

import numpy as np

from otolith_drivers.base import Sample, Sampling, Setup
from otolith_drivers.canbus import can
from otolith_drivers.canbus import driver as can_driver
from otolith_drivers.canbus.database import EXTENDED_LIMIT
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.options import CLASSIC_LENGTH
from otolith_drivers.common.time_zones import LocalDates, stated_zone
from otolith_drivers.errors import ConfigurationError, counted
from otolith_drivers.replay import readers
from otolith_drivers.replay.mf4 import Mf4Frames
from otolith_drivers.replay.readers import GZIP, MAX_TIME, DataFile, Reader, Rows, head_of, seen, suffix_of, text_log

# Engineering choices, guarded by the tests with garbage and damaged logs in test_can_log.py.
MAX_LINE = 4096  # characters; a CAN FD frame with 64 bytes needs some 300
MAX_BLOCK = 1 << 24  # bytes; Vector's tools write blocks of some 100 kB, and a damaged size would fill the memory
CHUNK = 20_000  # frames; some 5 s of a fully loaded 500 kbit/s bus
MAX_CHANNELS = 16  # named in a warning

STANDARD_DIGITS = 3  # of an identifier of 11 bits
ERROR_FLAG = 1 << 29  # in the identifier that candump prints for an error frame
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
CANDUMP_LINE = re.compile(
    r"\((?P<time>[^)]+)\)\s+(?P<channel>\S+)\s+(?:[RT]X\s+\S\s+\S\s+)?(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"\s+\[(?P<length>\d{1,2})\](?P<rest>.*)"
)
SQLITE_COLUMNS = ("ts", "arbitration_id", "extended", "remote", "error", "dlc", "data")
BLF_OBJECT = struct.Struct("<4sHHLL")  # signature, size and version of the header, size, type

Source, Options = can_driver.Source, can_driver.Options  # for readers.Format

logging.getLogger("can.io").setLevel(logging.ERROR)  # it warns of each bad line; bad lines are counted here


class CandumpLines:
    """The frames in what ``candump -ta`` or ``-tA`` prints; raises ValueError on a line that has none."""

    def __init__(self, lines: Iterator[str]) -> None:
        self._lines, self.dates = lines, LocalDates()

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
                timestamp=_candump_time(match["time"], self.dates),
                channel=match["channel"],
                arbitration_id=identifier & EXTENDED_LIMIT,
                is_extended_id=is_long and not is_error,
                is_error_frame=is_error,
                is_remote_frame=is_remote,
                is_fd=len(match["length"]) > 1,
                dlc=length,
                data=data,
            )


def _candump_time(written: str, dates: LocalDates) -> float:
    """Seconds; a date has no time zone, and is the next of the ``dates``."""
    return dates.seconds(datetime.fromisoformat(written)) if "-" in written else float(written)


class SavvyCanLines:
    """The frames in a CSV of SavvyCAN; raises ValueError on a line that has none.

    SavvyCAN writes whole µs. Other programs write this format with seconds, which have decimals.
    """

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
                timestamp=float(row["time stamp"]) * (1.0 if "." in row["time stamp"] else 1e-6),
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


def open_log(path: Path, setup: Setup, can: Any | None) -> "CanLogReader":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    if can is None:
        raise ConfigurationError(f"{path}: a CAN log: its frames need a description, like that of type = 'can'")
    names = tuple(signal.name for signal in setup.signals)
    return CanLogReader(path, names, decoder_of(can, setup), setup.timezone)


def frames_in(path: Path) -> Iterator[can.Message]:
    """The frames of a log; raise ConfigurationError as :class:`CanLogReader` does, or if it has none."""
    data, count = DataFile(path), 0
    with closing(data):
        source = _frames_of(path, data, LocalDates())
        for _, frame in source.frames():
            if not isinstance(frame, str) and abs(frame.timestamp) <= MAX_TIME:
                count += 1
                yield frame
    if not count:
        raise ConfigurationError(f"{path}: no frames")


class CanLogReader(Reader):
    """A CAN log of any format that python-can reads."""

    sampling = Sampling.CYCLIC

    def __init__(self, path: Path, signals: tuple[str, ...], decoder: FrameDecoder, zone: str = "") -> None:
        """Open ``path``; raise ConfigurationError if the file is missing, or its format cannot be read.

        ``zone`` names that of dates that name none.
        """
        data = DataFile(path)
        super().__init__(path, data)
        try:
            self._dates = LocalDates(stated_zone(zone))
            self._source = _frames_of(path, data, self._dates)
        except BaseException:
            data.close()
            raise
        self.place = self._source.place
        self._signals, self._decoder = signals, decoder
        self._channels = set[str]()
        self._first_bad: tuple[int, str] | None = None
        self._frames = self._others = self._unreadable = self._undecoded = 0
        self._latest = -math.inf  # s; time of the latest frame with samples

    @property
    def bad(self) -> int:
        """Number of lines that are no frames, and of frames or values that cannot be decoded."""
        return self._unreadable + self._decoder.counters.bad

    @property
    def lost(self) -> int:
        return self._decoder.counters.lost

    def chunks(self) -> Iterator[Rows]:
        wants = self._decoder.wants
        chunk = _FrameChunk(self._signals)
        for place, frame in self._source.frames():
            if isinstance(frame, str):
                self._count_unreadable(place, frame)
                continue
            if not self._frames:
                self._decoder.begin(frame.timestamp)
            self._frames += 1
            is_wanted = wants(frame.arbitration_id, extended=frame.is_extended_id)
            if not is_wanted or frame.is_error_frame or frame.is_remote_frame:
                self._others += 1
                self._decoder.note_other(frame.arbitration_id, extended=frame.is_extended_id)
            elif samples := self._samples(place, frame):
                chunk.add(place, samples, self._unreadable + self._undecoded)
            if len(chunk) >= CHUNK:
                yield chunk.rows()
                chunk = _FrameChunk(self._signals)
        if len(chunk):
            yield chunk.rows()
        if math.isinf(self._latest):
            raise ConfigurationError(f"{self.path}{self._why_no_rows()}")

    def _samples(self, place: int, frame: can.Message) -> list[Sample]:
        time = frame.timestamp
        if not abs(time) <= MAX_TIME:
            self._count_unreadable(place, f"its time is {time:g} s")
            return []
        samples = self._decoder.decode(frame, time)
        if not samples or any(math.isnan(sample.value) for sample in samples):
            bad = self._decoder.counters.bad
            if bad > self._undecoded:
                what = f"frame 0x{frame.arbitration_id:X} with data {bytes(frame.data).hex(' ') or 'of no length'}"
                if self._first_bad is None:
                    self._note(place, f"{what}: {self._decoder.latest_rejection() or 'cannot be decoded'}")
            self._undecoded = bad
        if samples:
            self._latest = max(self._latest, time)
            if len(self._channels) < MAX_CHANNELS:
                self._channels.add(str(frame.channel))
        return samples

    def _count_unreadable(self, place: int, cause: str) -> None:
        self._unreadable += 1
        self._note(place, cause)

    def _note(self, place: int, cause: str) -> None:
        if self._first_bad is None:
            self._first_bad = (place, cause)

    def _why_no_rows(self) -> str:
        kind = seen(head_of(self.path))
        hint = f" (it looks like {kind})" if kind not in ("", SUFFIXES.get(suffix_of(self.path))) else ""
        if self._first_bad is not None:
            place, cause = self._first_bad
            return f": {self.place} {place}: {cause}; no frame can be used{hint}"
        if not self._frames:
            return "".join([f": no frames{hint}", *(f": {line}" for line in self._cut_off())])
        wanted = ", ".join(f"0x{identifier:X}" for identifier, _ in self._decoder.identifiers())
        return f": none of its {self._frames} frames is one of {wanted}{self._decoder.other_sources()}"

    def describe(self) -> list[str]:
        return self._decoder.describe()

    def summary_lines(self) -> list[str]:
        lines = [f"{counted(self._frames, 'frame')} read", f"{self._others} of other messages", f"{self.bad} bad"]
        passed = self._source.passed
        return lines + ([f"{counted(passed, self.place)} without a frame"] if passed else [])

    def warnings(self) -> list[str]:
        lines = []
        if self._first_bad is not None:
            place, cause = self._first_bad
            lines.append(f"bad: {self.bad}, the first in {self.place} {place}: {cause}")
        if len(self._channels) > 1:
            names = ", ".join(sorted(self._channels))
            lines.append(f"frames of these messages come from channels {names}: are two machines mixed?")
        lines += [*self._dates.warnings(), *self._cut_off(), *self._source.notes]
        # Frames that could not be used are already in the first line, with their place in the file.
        lines += self._decoder.warnings(self._latest, unused=False) if self._frames else []
        return [*lines, *filter(None, [self._decoder.defect(self._latest)])]


class _FrameChunk:
    """Rows of frames; keeps numbers only, as many live samples would slow down the garbage collector."""

    def __init__(self, signals: tuple[str, ...]) -> None:
        self._frames: list[tuple[float, int, int]] = []
        self._values: dict[str, tuple[list[int], list[float]]] = {signal: ([], []) for signal in signals}

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, place: int, samples: list[Sample], bad: int) -> None:
        """Append the samples of a frame; ``bad`` counts the bad frames up to it."""
        row = len(self._frames)
        self._frames.append((samples[0].time, place, bad))
        for sample in samples:
            rows, values = self._values[sample.signal]
            rows.append(row)
            values.append(sample.value)

    def rows(self) -> Rows:
        columns = {signal: np.full(len(self), np.nan) for signal in self._values}
        for signal, (rows, values) in self._values.items():
            columns[signal][rows] = values
        times, places, bad = (np.array(column) for column in zip(*self._frames, strict=True))
        return Rows(times, columns, places, bad)


@dataclass(frozen=True, slots=True)
class TextFormat:
    """How python-can reads a text format."""

    reader: type[Any]
    title: str
    line: re.Pattern[str] | None = None  # How each line with a frame begins, if the reader does not check that
    prelude: str = ""  # A line that the reader skips when it is started again in the middle of the file
    ends_header: bool = False  # Whether that line must be above the first frame, which the reader else skips


class _TrcReader(can.TRCReader):
    """Raises on a line that is cut short; python-can skips it silently."""

    def _parse_line(self, line: str) -> can.Message | None:
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


TEXT_FORMATS = {
    readers.ASC: TextFormat(can.ASCReader, readers.ASC, prelude="\n", ends_header=True),
    readers.TRC: TextFormat(_TrcReader, readers.TRC),
    readers.CANDUMP_LOG: TextFormat(
        can.CanutilsLogReader, "candump, as 'candump -L' writes it", readers.TEXT_LOGS[readers.CANDUMP_LOG]
    ),
    readers.CANDUMP: TextFormat(CandumpLines, "candump, as 'candump -ta' writes it"),
    readers.SAVVYCAN: TextFormat(SavvyCanLines, readers.SAVVYCAN),
    readers.PYTHON_CAN: TextFormat(can.CSVReader, readers.PYTHON_CAN, prelude="\n"),
}
SUFFIXES = {".asc": readers.ASC, ".trc": readers.TRC}  # of texts whose first lines may not show the format


def _frames_of(path: Path, data: DataFile, dates: LocalDates) -> "TextFrames | BlfFrames | SqliteFrames | Mf4Frames":
    """The frames of a log, by first line or suffix; raise ConfigurationError, with the format, for another one."""
    suffix, head = suffix_of(path), head_of(path)
    if suffix == ".mf4":
        return Mf4Frames(path, head)
    if suffix == ".db":
        return SqliteFrames(path, head)
    if suffix == ".blf":
        return BlfFrames(path, data.stream)
    name = text_log(head) or SUFFIXES.get(suffix, readers.CANDUMP_LOG)
    if name == readers.DIFFERENCES:
        cause = f"{path}: is of {name}, of which a lost line would shift the rest: log with candump -L"
        raise ConfigurationError(cause)
    text = io.TextIOWrapper(data.stream, encoding="utf-8-sig", errors="replace")
    return TextFrames(path, TEXT_FORMATS[name], text, dates)


class _NumberedLines:
    """The file object that python-can reads from: an iterator over lines that counts them."""

    def __init__(self, text: TextIO) -> None:
        self.number = 0
        self.line = self.prelude = ""
        self.above_frames = ""  # A line that is put above the first one that begins with a number
        self._text = text
        self._next = text.readline(MAX_LINE)

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        if self.prelude:
            prelude, self.prelude = self.prelude, ""
            return prelude
        if self.above_frames and self._next.lstrip()[:1].isdigit():
            above, self.above_frames = self.above_frames, ""
            return above
        if not self._next:
            raise StopIteration
        self.line, self._next = self._next, self._text.readline(MAX_LINE)
        self.number += 1
        return self.line

    @property
    def is_last(self) -> bool:
        """Whether the current line is the last one."""
        return not self._next

    def close(self) -> None:
        """Called by python-can; the reader closes the file."""


class TextFrames:
    """The frames of a log with a frame per line."""

    place = "line"
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, kind: TextFormat, text: TextIO, dates: LocalDates) -> None:
        self._path, self._kind, self._dates = path, kind, dates
        self._lines = _NumberedLines(text)
        self._lines.above_frames = kind.prelude if kind.ends_header else ""
        self._taken = 0

    @property
    def passed(self) -> int:
        """Number of lines that are neither frames nor bad, like comments."""
        return self._lines.number - self._taken

    def frames(self) -> Iterator[tuple[int, can.Message | str]]:
        """Number of each line with its frame, or with the reason why it has none; can be iterated once."""
        lines = self._lines
        reader = self._kind.reader(lines)
        if isinstance(reader, CandumpLines):
            reader.dates = self._dates
        while True:
            try:
                for frame in reader:
                    if not self._taken:
                        self._refuse_relative_times(reader)
                    self._taken += 1
                    # Every writer ends its lines, so a last line without an end was cut.
                    cut = lines.is_last and not lines.line.endswith("\n")
                    if cut or not self._is_whole(lines.line):
                        what = "is cut off" if cut else f"is no frame of {self._kind.title}"
                        yield lines.number, self._quoted(what)
                    else:
                        yield lines.number, frame
                break
            except ConfigurationError:
                raise
            except Exception:  # noqa: BLE001 - python-can raises anything on a damaged line
                if lines.number:
                    self._taken += 1
                    yield lines.number, self._quoted(f"is no frame of {self._kind.title}")
            if lines.is_last:
                break
            lines.prelude = self._kind.prelude

    def _is_whole(self, line: str) -> bool:
        return self._kind.line is None or self._kind.line.match(line.strip()) is not None

    def _refuse_relative_times(self, reader: Any) -> None:
        """Only ASC may have time differences; python-can would take them for times."""
        if getattr(reader, "timestamps_format", None) == "relative":
            text = f"{self._path}: its times count from frame to frame ('timestamps relative'): export them absolute"
            raise ConfigurationError(text)

    def _quoted(self, what: str) -> str:
        text = self._lines.line.strip()
        return f"{text[:60] + '...' if len(text) > 60 else text!r} {what}"


class BlfFrames:
    """The frames of a BLF file."""

    place = "frame"
    passed = 0

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.notes: tuple[str, ...] = ()
        self._blocks = _CheckedBlocks(file)
        try:
            self._reader = _BlfReader(cast("BinaryIO", self._blocks))
        except (can.io.blf.BLFParseError, struct.error) as error:
            if (kind := seen(head_of(path))) and "BLF" not in kind:
                raise ConfigurationError(f"{path}: is not a BLF file but {kind}: give it the name of that") from error
            raise ConfigurationError(
                f"{path}: is not a BLF file, or its writer was killed before it wrote the file header: "
                "nothing can be read; a candump log (.log) would keep its frames"
            ) from error

    def frames(self) -> Iterator[tuple[int, can.Message | str]]:
        """Number of each frame with the frame, or with the reason why reading ends there; can be iterated once."""
        number = 0
        try:
            for frame in self._reader:
                number += 1
                yield number, frame
        except Exception as error:  # noqa: BLE001 - python-can raises anything on damaged data
            yield number + 1, f"the file is damaged or cut off here: reading ends ({error or type(error).__name__})"
            return
        size, read = self._reader.file_size, self._blocks.bytes_read
        if size > read:
            self.notes = (f"cut off: {read} of {size} bytes are there",)
        elif size < read:
            self.notes = ("never closed by its writer: the last frames are missing, and times count from the start",)


class _CheckedBlocks:
    """The bytes of a BLF file; refuses to read a block of an impossible size."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.bytes_read = 0

    def read(self, size: int) -> bytes:
        if not 0 <= size <= MAX_BLOCK:
            raise can.io.blf.BLFParseError(f"a block of {size} bytes")
        data = self._file.read(size)
        self.bytes_read += len(data)
        return data

    def close(self) -> None:
        """Called by python-can; the reader closes the file."""


class _BlfReader(can.BLFReader):
    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        """Refuse objects that are smaller than their header: python-can would read them for ever."""
        at = 0
        while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and at + BLF_OBJECT.size <= len(data):
            size = BLF_OBJECT.unpack_from(data, at)[3]
            if size < BLF_OBJECT.size:
                raise can.io.blf.BLFParseError(f"an object of {size} bytes")
            at += size
        yield from super()._parse_data(data)
