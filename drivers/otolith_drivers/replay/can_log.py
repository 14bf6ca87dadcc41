"""A log of a CAN bus as rows: each frame that has a wanted signal is one, decoded as the driver would have.

Frames out of the log of a CAN bus, by python-can, whatever state the file is in.

A reader of python-can ends with the first line that it cannot read. Here it is started again behind that line, which is
counted. What is read from a binary log is checked before python-can sees it: some garbage would keep it busy for ever.
"""

import io
import logging
import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, Protocol, TextIO, cast

import can
import numpy as np
from can.io.blf import BLFParseError

from otolith_drivers.base import Sample, Setup
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.driver import Source
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import LATEST, Opened, Rows, suffix_of

LONGEST_LINE = 4096  # characters; of a frame with 64 bytes of data some 300
LARGEST_BLOCK = 1 << 24  # bytes, packed; Vector's own are of some 100 kB
OBJECT = struct.Struct("<4sHHLL")  # of a BLF file: signature, size of header, version of header, size, type

logging.getLogger("can.io").setLevel(logging.ERROR)  # what it would say of single lines is counted here


class LogFault(NamedTuple):
    """Where a frame should have been, and what was there."""

    place: int
    cause: str


class FrameSource(Protocol):
    """Frames with the numbers of their places, and what was there instead of some."""

    place: str
    notes: list[str]
    """What is to be said of the whole file once it was read."""

    @property
    def passed(self) -> int:
        """Lines that are no frames, and no faults either, like comments."""

    def frames(self) -> Iterator[tuple[int, can.Message | LogFault]]:
        """All of them, in the order of the file; once."""


@dataclass(frozen=True, slots=True)
class TextFormat:
    """How python-can reads a format of lines."""

    reader: type[Any]
    title: str
    prelude: str = ""
    """A line that its reader swallows when it is started behind a line that it could not read."""


class _Trc(can.TRCReader):
    """Says of a line that is cut short that it is, instead of passing over it."""

    def _parse_line(self, line: str) -> can.Message | None:
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


TEXTS = {
    ".log": TextFormat(can.CanutilsLogReader, "candump, as 'candump -L' writes it"),
    ".asc": TextFormat(can.ASCReader, "Vector ASC", prelude="\n"),
    ".trc": TextFormat(_Trc, "PEAK TRC"),
}


def source_of(path: Path, suffix: str, opened: Opened) -> FrameSource:
    """The frames of ``opened``, a file at ``path`` that is written as its ``suffix`` says.

    Raises:
        ConfigurationError: no such log, or one that was never finished.
    """
    if suffix in TEXTS:
        return TextFrames(path, TEXTS[suffix], io.TextIOWrapper(opened.stream, encoding="utf-8", errors="replace"))
    return BinaryFrames(path, opened.stream)


class _Lines:
    """What python-can takes for its file: one line after the other, numbered."""

    def __init__(self, text: TextIO) -> None:
        self.number = 0
        self.line = self.prelude = ""
        self._text = text
        self._next = text.readline(LONGEST_LINE)

    def __iter__(self) -> "_Lines":
        return self

    def __next__(self) -> str:
        if self.prelude:
            prelude, self.prelude = self.prelude, ""
            return prelude
        if not self._next:
            raise StopIteration
        self.line, self._next = self._next, self._text.readline(LONGEST_LINE)
        self.number += 1
        return self.line

    @property
    def is_torn(self) -> bool:
        """Whether the line at hand breaks off: every program that writes one ends it."""
        return not self.line.endswith("\n") and not self._next

    @property
    def is_last(self) -> bool:
        """Whether nothing comes after the line at hand."""
        return not self._next

    def close(self) -> None:
        """The file is closed by who opened it."""


class TextFrames:
    """A log with a frame per line."""

    place = "line"

    def __init__(self, path: Path, kind: TextFormat, text: TextIO) -> None:
        self._path = path
        self.notes: list[str] = []
        self._kind = kind
        self._lines = _Lines(text)
        self._taken = 0

    @property
    def passed(self) -> int:
        """See :class:`FrameSource`."""
        return self._lines.number - self._taken

    def frames(self) -> Iterator[tuple[int, can.Message | LogFault]]:
        """See :class:`FrameSource`."""
        lines = self._lines
        reader = self._kind.reader(lines)
        while True:
            try:
                for frame in reader:
                    if not self._taken:
                        self._refuse_differences(reader)
                    self._taken += 1
                    torn = lines.is_torn
                    yield lines.number, self._fault("breaks off") if torn else frame
                break
            except ConfigurationError:
                raise
            except Exception:  # noqa: BLE001 - a torn line can make it raise anything
                if lines.number:
                    self._taken += 1
                    yield lines.number, self._fault(f"is no frame of {self._kind.title}")
            if lines.is_last:
                break
            lines.prelude = self._kind.prelude

    def _refuse_differences(self, reader: Any) -> None:
        """Which only ASC has; python-can would take them for times."""
        if getattr(reader, "timestamps_format", None) == "relative":
            raise ConfigurationError(
                f"{self._path}: its times count from frame to frame ('timestamps relative'): export them absolute"
            )

    def _fault(self, what: str) -> LogFault:
        text = self._lines.line.strip()
        return LogFault(self._lines.number, f"{text[:60] + '...' if len(text) > 60 else text!r} {what}")


class BinaryFrames:
    """A BLF file."""

    place = "frame"
    passed = 0

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.notes: list[str] = []
        self._blocks = _Blocks(file)
        try:
            self._reader = _Blf(cast("BinaryIO", self._blocks))
        except (BLFParseError, struct.error) as error:
            raise ConfigurationError(
                f"{path}: no BLF file, or one whose writer was killed before it wrote the head of it: "
                "nothing can be read; a candump (.log) does not lose what was written"
            ) from error

    def frames(self) -> Iterator[tuple[int, can.Message | LogFault]]:
        """See :class:`FrameSource`."""
        number = 0
        try:
            for frame in self._reader:
                number += 1
                yield number, frame
        except Exception as error:  # noqa: BLE001 - what is damaged can make it raise anything
            place = number + 1
            yield (
                place,
                LogFault(
                    place,
                    f"the file is damaged or cut off here, and not read any further ({error or type(error).__name__})",
                ),
            )
            return
        said, read = self._reader.file_size, self._blocks.read_so_far
        if said > read:
            self.notes.append(f"cut off: {read} of {said} bytes are there")
        elif said < read:
            self.notes.append(
                "never closed by who wrote it: its last frames are missing, its times count from the start"
            )


class _Blocks:
    """The bytes of a BLF file, as far as what is asked for makes sense."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.read_so_far = 0

    def read(self, size: int) -> bytes:
        if not 0 <= size <= LARGEST_BLOCK:
            raise BLFParseError(f"a block of {size} bytes")
        found = self._file.read(size)
        self.read_so_far += len(found)
        return found

    def close(self) -> None:
        """The file is closed by who opened it."""


class _Blf(can.BLFReader):
    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        """Refuse objects that are smaller than their own header: python-can would read them again and again."""
        at = 0
        while (at := data.find(b"LOBJ", at, at + 8)) >= 0 and at + OBJECT.size <= len(data):
            size = OBJECT.unpack_from(data, at)[3]
            if size < OBJECT.size:
                raise BLFParseError(f"an object of {size} bytes")
            at += size
        yield from super()._parse_data(data)


__all__ = ["CanLog", "Source", "open_log"]

BATCH = 20_000  # frames
MOST_CHANNELS = 16


def open_log(path: Path, setup: Setup, can: Any | None) -> "CanLog":
    """See :meth:`otolith_drivers.replay.readers.Format.open_log`."""
    if can is None:
        raise ConfigurationError(f"{path}: a log of a CAN bus: what is in its frames must be said as for the bus")
    return CanLog(path, tuple(signal.name for signal in setup.signals), decoder_of(can, setup))


class CanLog:
    """Implements :class:`otolith_drivers.replay.readers.Reader`."""

    ignored = ()

    def __init__(self, path: Path, signals: tuple[str, ...], decoder: FrameDecoder) -> None:
        """Open ``path``.

        Raises:
            ConfigurationError: no such file, or one that cannot be read at all.
        """
        self.path = path
        self._decoder = decoder
        self._opened = Opened(path)
        try:
            self._source = source_of(path, suffix_of(path), self._opened)
        except BaseException:
            self._opened.close()
            raise
        self.place = self._source.place
        self._signals = signals
        self._channels = set[str]()
        self._first_bad: LogFault | None = None
        self._frames = self._others = self._unreadable = self._undecoded = 0
        self._latest = -math.inf

    def __enter__(self) -> "CanLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return self._opened.progress

    @property
    def bad(self) -> int:
        """Lines that are no frames, frames that cannot be decoded, values out of their range."""
        return self._unreadable + self._decoder.counters.bad

    @property
    def lost(self) -> int:
        """Samples of frames that a counter in them says were sent, and that are not there."""
        return self._decoder.counters.lost

    def stretches(self) -> Iterator[Rows]:
        """See :meth:`otolith_drivers.replay.readers.Reader.stretches`."""
        wanted = set(self._decoder.identifiers())
        batch = _Batch(self._signals)
        for place, frame in self._source.frames():
            if isinstance(frame, LogFault):
                self._unreadable += 1
                self._note(frame)
                continue
            if not self._frames:
                self._decoder.begin(frame.timestamp)
            self._frames += 1
            key = (frame.arbitration_id, frame.is_extended_id)
            if key not in wanted or frame.is_error_frame or frame.is_remote_frame:
                self._others += 1
            elif samples := self._samples(place, frame):
                batch.add(place, samples, self._unreadable + self._undecoded)
            if len(batch) >= BATCH:
                yield batch.rows()
                batch = _Batch(self._signals)
        if len(batch):
            yield batch.rows()
        if math.isinf(self._latest):
            raise ConfigurationError(f"{self.path}{self._why_none()}")

    def _samples(self, place: int, frame: can.Message) -> list[Sample]:
        time = frame.timestamp
        if not abs(time) <= LATEST:
            self._unreadable += 1
            self._note(LogFault(place, f"its time is {time:g} s"))
            return []
        samples = self._decoder.decode(frame, time)
        if not samples or any(math.isnan(sample.value) for sample in samples):
            bad = self._decoder.counters.bad
            if bad > self._undecoded:
                what = f"frame 0x{frame.arbitration_id:X} with data {bytes(frame.data).hex(' ') or 'of no length'}"
                self._note(LogFault(place, f"{what} is too short, or has a value out of its range"))
            self._undecoded = bad
        if samples:
            self._latest = max(self._latest, time)
            if len(self._channels) < MOST_CHANNELS:
                self._channels.add(str(frame.channel))
        return samples

    def _note(self, fault: LogFault) -> None:
        if self._first_bad is None:
            self._first_bad = fault

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.describe`."""
        return self._decoder.describe()

    def summary_lines(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.found`."""
        parts = [f"{self._frames} frames read", f"{self._others} of other messages", f"{self.bad} bad"]
        return parts + ([f"{self._source.passed} {self.place}s without a frame"] if self._source.passed else [])

    def warnings(self) -> list[str]:
        """See :meth:`otolith_drivers.replay.readers.Reader.complaints`."""
        lines = []
        if self._first_bad is not None:
            lines.append(f"bad: {self.bad}, the first in {self.place} {self._first_bad.place}: {self._first_bad.cause}")
        if len(self._channels) > 1:
            names = ", ".join(sorted(self._channels))
            lines.append(f"frames of these messages come from channels {names}: are two machines mixed?")
        lines += [f"cut off: {self._opened.torn}"] if self._opened.torn else []
        lines += self._source.notes
        # What could not be used is told above, by its place in the file.
        return lines + (self._decoder.warnings(self._latest, unused=False) if self._frames else [])

    def _why_none(self) -> str:
        if self._first_bad is not None:
            return f": {self.place} {self._first_bad.place}: {self._first_bad.cause}; no frame can be used"
        if not self._frames:
            return ": no frames" if not self._opened.torn else f": no frames: cut off: {self._opened.torn}"
        wanted = ", ".join(f"0x{identifier:X}" for identifier, _ in self._decoder.identifiers())
        return f": none of its {self._frames} frames is one of {wanted}"


class _Batch:
    """Samples as they come, until they are enough for a stretch."""

    def __init__(self, signals: tuple[str, ...]) -> None:
        self._times: list[float] = []
        self._places: list[int] = []
        self._bad: list[int] = []
        self._values: dict[str, tuple[list[int], list[float]]] = {signal: ([], []) for signal in signals}

    def __len__(self) -> int:
        return len(self._times)

    def add(self, place: int, samples: list[Sample], bad: int) -> None:
        row = len(self._times)
        self._times.append(samples[0].time)
        self._places.append(place)
        self._bad.append(bad)
        for sample in samples:
            rows, values = self._values[sample.signal]
            rows.append(row)
            values.append(sample.value)

    def rows(self) -> Rows:
        columns = {}
        for signal, (rows, values) in self._values.items():
            column = np.full(len(self._times), np.nan)
            column[rows] = values
            columns[signal] = column
        return Rows(np.array(self._times), columns, np.array(self._places), np.array(self._bad))
