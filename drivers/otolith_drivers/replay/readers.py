"""The table of formats: which reader takes a file, by the end of its name.

What every reader gives: rows of numbers, and the count of what could not become one.

Opening a file of recorded data, packed by gzip or not.
"""

import gzip
import io
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer
from importlib import import_module
from typing import Any, cast

from otolith_drivers.base import Setup
from otolith_drivers.config_files import StrictModel

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]

LATEST = 1e11  # s; a time beyond is in another unit, or wrong


@dataclass(frozen=True, slots=True)
class Rows:
    """A stretch of recorded data, in the order of the file."""

    times: Array
    """(rows,) s, finite."""
    columns: dict[str, Array]
    """(rows,) of each signal in its unit, not a number where there is no reading."""
    lines: Integers
    """(rows,) numbers of their lines, frames or records, from 1."""
    bad: Integers
    """(rows,) how much of the file was bad up to and with each row."""


class Reader(Protocol):
    """A file of recorded data, open; a context that closes it."""

    @property
    def path(self) -> Path:
        """Of the file."""

    @property
    def place(self) -> str:
        """What is numbered in it: ``line``, ``frame`` or ``record``."""

    @property
    def ignored(self) -> tuple[str, ...]:
        """Columns that nobody asked for."""

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""

    @property
    def bad(self) -> int:
        """How much came that could not be used."""

    @property
    def lost(self) -> int:
        """Samples that the file shows to have been sent, and does not hold."""

    def stretches(self) -> Iterator[Rows]:
        """All rows, some ten thousand at a time; once.

        Raises:
            ConfigurationError: none can be used, or the file is something else.
        """

    def describe(self) -> list[str]:
        """What is read from where, a line per signal."""

    def summary_lines(self) -> list[str]:
        """How much was read and what was wrong with it, in a few words each; first of what, and how much."""

    def warnings(self) -> list[str]:
        """What a user should know of the file before trusting what was made of it, a line each."""

    def __enter__(self) -> "Reader": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


GZIP = ".gz"
BUFFER = 1 << 16  # bytes; what can be looked at before anything is read


class Opened:
    """The bytes of a file, how many of them were read, and whether its packing broke off."""

    def __init__(self, path: Path) -> None:
        """Open ``path``.

        Raises:
            ConfigurationError: no such file, or not to be read.
        """
        try:
            if path.exists() and not path.is_file():
                raise ConfigurationError(f"{path}: is a directory or a device, not a file")
            self._raw = io.BufferedReader(io.FileIO(path), BUFFER)
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from error
        self._size, self._read = max(path.stat().st_size, 1), 0
        self._unpacked = _Unpacked(self._raw) if path.suffix.lower() == GZIP else None
        self.stream = self._raw if self._unpacked is None else io.BufferedReader(self._unpacked, BUFFER)

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        if not self._raw.closed:
            self._read = self._raw.tell()
        return min(1.0, self._read / self._size)

    @property
    def torn(self) -> str:
        """Why the rest of a packed file cannot be had; empty if it can, or was not asked for yet."""
        return "" if self._unpacked is None else self._unpacked.torn

    def close(self) -> None:
        """Give it back."""
        _ = self.progress
        self.stream.close()
        self._raw.close()


class _Unpacked(io.RawIOBase):
    """Ends where the packing breaks off, as a file does that was cut there."""

    def __init__(self, raw: BinaryIO) -> None:
        self._file = gzip.GzipFile(fileobj=raw)
        self.torn = ""

    def readable(self) -> bool:
        return True

    def readinto(self, room: "WriteableBuffer") -> int:
        view = memoryview(room)
        try:
            found = self._file.read1(len(view))  # more at once would be lost where the packing breaks off
        except (EOFError, OSError, zlib.error) as error:
            self.torn = str(error)
            return 0
        view[: len(found)] = found
        return len(found)

    def close(self) -> None:
        self._file.close()
        super().close()


# The module is imported only when a file asks for it.
CAN_LOG = "otolith_drivers.replay.can_log"
READERS: dict[str, str] = {
    ".asc": CAN_LOG,
    ".blf": CAN_LOG,
    ".log": CAN_LOG,
    ".trc": CAN_LOG,
    ".rrd": "otolith_drivers.replay.recording",
}
TABLE = "otolith_drivers.replay.tables"
"""Everything else is text with a column per signal."""


class Format(Protocol):
    """What a row of the table points to: a module with these two names."""

    Source: type[StrictModel]
    """Where in such a file a signal is."""

    def open_log(self, path: Path, setup: Setup, can: Any | None) -> Reader:
        """The file, open; ``can`` is what ``[driver]`` says of frames, for a log of them.

        Raises:
            ConfigurationError: no such file, or not what ``setup`` asks for.
        """


def suffix_of(path: Path) -> str:
    """The end of the name that tells the format, whatever packs the file."""
    name = path.with_suffix("") if path.suffix.lower() == GZIP else path
    return name.suffix.lower()


def holds_frames(path: Path) -> bool:
    """Whether it is a log of a CAN bus, which cannot be read without what describes the frames."""
    return READERS.get(suffix_of(path)) == CAN_LOG


def format_of(path: Path) -> Format:
    """The module that reads ``path``."""
    return cast("Format", import_module(READERS.get(suffix_of(path), TABLE)))
