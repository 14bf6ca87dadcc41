"""Recorded files: the rows that every reader returns, the file under it, and the formats, by name and first bytes."""

import gzip
import io
import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.base import Sampling, Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]

# Seconds since 1970 reach 1e11 in the year 5138; milliseconds since 1970 passed it in 1973, so a column of them without
# its unit is refused. Guarded by tests/golden/replays/nanoseconds.
MAX_TIME = 1e11  # s
BUFFER = 1 << 16  # bytes; the start of the file from which its encoding is recognised

# Formats by the end of the file name. The module is imported only when a file asks for it.
CAN_LOG = "otolith_drivers.replay.can_log"
READERS = dict.fromkeys((".asc", ".blf", ".db", ".log", ".mf4", ".trc"), CAN_LOG)
READERS[".rrd"] = "otolith_drivers.replay.recording"
TABLE = "otolith_drivers.replay.tables"  # all other files

# Formats by the first bytes: text logs of a CAN bus, and what a refusal names.
GZIP = ".gz"
HEAD = 1 << 14  # bytes; some hundred lines of a log
MAX_LINES = 20  # of a log, of which one must have its format; the first may be cut off
MIN_STEPS = 4  # times of a log, of which
DIFFERENCE_SHARE = 0.2  # go back, or all are equal: then they are differences

CANDUMP = "candump -ta"
CANDUMP_LOG = "candump -L"
PYTHON_CAN = "CSV of python-can"
SAVVYCAN = "CSV of SavvyCAN"
DIFFERENCES = "candump -td, whose times are differences"
TEXT_LOGS = {
    CANDUMP_LOG: re.compile(r"\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}##?"),
    CANDUMP: re.compile(r"(?:\x1b\[\d*m)*\s*\((?:\d+|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.\d+\)\s.*\[\d+\]"),
    PYTHON_CAN: re.compile(r"timestamp,arbitration_id,extended,remote,error,dlc,data\s*$"),
    SAVVYCAN: re.compile(r"\"?Time Stamp\"?,\"?ID\"?,\"?Extended\"?,", re.IGNORECASE),
}
"""By name: how a line of a text log, or its header, begins."""
OTHERS = {
    "Vector BLF": rb"LOGG",
    "MDF (MF4)": rb"MDF ",
    "SQLite": rb"SQLite format 3\x00",
    "a recording of Rerun": rb"RRF",
    "a spreadsheet or another ZIP archive": rb"PK\x03\x04",
    "HDF5 or MATLAB 7.3": rb"\x89HDF",
    "MATLAB 5": rb"MATLAB 5",
    "Parquet": rb"PAR1",
    "LabVIEW TDMS": rb"TDSm",
    "gzip": rb"\x1f\x8b",
    "a capture of network packets (pcap)": rb"(?:\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x0a\x0d\x0d\x0a)",
    "UTF-16 text": rb"(?:\xff\xfe|\xfe\xff)",
    "PEAK TRC": rb";\$FILEVERSION|;\s*\$STARTTIME",
    "Vector ASC": rb"date .*\n(?:base|internal)",
    "BUSMASTER log": rb"\*\*\*BUSMASTER",
    "candump without times: log with candump -L": rb"\w+\s+(?:[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[\d+\]\s",
    "a CAN log of another tool: export it as candump -L writes": (
        rb"(?i)(?>[^\n]*?\b(?:can[ _]?)?id(?:entifier)?\b)[^\n]*\b(?:dlc|length|data\w*|d0)\b"
    ),
    "JSON": rb"[\[{]\s*[\"{\[]",
    "XML": rb"<\?xml",
}
"""By name: how a file of another format begins."""


def head_of(path: Path) -> bytes:
    """Return the first bytes, decompressed if the name ends in ``.gz``; none of a file that cannot be read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            data = file.read(HEAD)
    except OSError:
        return b""
    if path.suffix.lower() != GZIP:
        return data
    try:
        return zlib.decompressobj(wbits=31).decompress(data, HEAD)
    except zlib.error:
        return b""


def text_log(head: bytes) -> str:
    """Return which of ``TEXT_LOGS`` a file is that begins with ``head``; empty if it is none of them."""
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    names = (name for line in lines[:MAX_LINES] for name, pattern in TEXT_LOGS.items() if pattern.match(line.strip()))
    name = next(names, "")
    return DIFFERENCES if name == CANDUMP and _has_differences(lines) else name


def _has_differences(lines: list[str]) -> bool:
    """Whether the times of ``candump`` are those from frame to frame."""
    written = [match[1] for line in lines if (match := re.match(r"\s*\((\d+\.\d+)\)", line))]
    times = list(map(float, written))
    steps = [after - before for before, after in pairwise(times)]
    back = sum(step < 0.0 for step in steps) > DIFFERENCE_SHARE * len(steps)
    return len(steps) >= MIN_STEPS and (back or len(set(times[1:])) == 1)


def seen(head: bytes) -> str:
    """Return the name of the format that begins with ``head``; empty if it is not known."""
    other = next((name for name, start in OTHERS.items() if re.match(start, head.lstrip(b" \r\n"))), "")
    return other or text_log(head)


@dataclass(frozen=True, slots=True)
class Rows:
    """A chunk of recorded data, in the order of the file."""

    times: Array  # (rows,) s, finite
    columns: dict[str, Array]  # (rows,) of each signal in its unit, NaN where there is no reading
    lines: Integers  # (rows,) numbers of their lines, frames or records, from 1
    bad: Integers  # (rows,) number of bad lines, cells or frames up to and with each row
    marks: Mask | None = None
    """(rows,) true for the first row of each recording, in a file with several of them; None for a file without marks.
    """

    @property
    def begins(self) -> Mask:
        """(rows,) true for the first row of each recording but the first."""
        return np.zeros(len(self.times), dtype=np.bool_) if self.marks is None else self.marks

    def part(self, rows: slice, marks: Mask | None = None) -> "Rows":
        """Return some of the rows, if given with other marks."""
        columns = {name: values[rows] for name, values in self.columns.items()}
        kept = self.marks[rows] if marks is None and self.marks is not None else marks
        return Rows(self.times[rows], columns, self.lines[rows], self.bad[rows], kept)

    def followed_by(self, other: "Rows") -> "Rows":
        """Return these rows and those of ``other``."""
        columns = {name: np.concatenate([values, other.columns[name]]) for name, values in self.columns.items()}
        times, lines = np.concatenate([self.times, other.times]), np.concatenate([self.lines, other.lines])
        bad, marked = np.concatenate([self.bad, other.bad]), self.marks is not None or other.marks is not None
        return Rows(times, columns, lines, bad, np.concatenate([self.begins, other.begins]) if marked else None)


class Reader(ABC):
    """An open file of recorded data; a context manager that closes it."""

    place: str  # What Rows.lines numbers: line, frame or record
    is_table = False  # Whether the file is a text table, whose times may be in a unit that it does not name
    sampling: Sampling | Mapping[str, Sampling] = Sampling.TRUE
    """Meaning of the times of the file, the same for all signals or by signal."""
    ignored: tuple[str, ...] = ()  # Names of the columns that no signal uses

    def __init__(self, path: Path, data: "DataFile | None" = None) -> None:
        self.path = path
        self._data = data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._data is not None:
            self._data.close()

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return 0.0 if self._data is None else self._data.progress

    @property
    def file(self) -> Path:
        """The file that the last rows are from."""
        return self.path

    @property
    @abstractmethod
    def bad(self) -> int:
        """Number of rows, cells, frames or records that could not be used."""

    @property
    def lost(self) -> int:
        """Samples that were sent but are not in the file, as its counters show."""
        return 0

    @abstractmethod
    def chunks(self) -> Iterator[Rows]:
        """All rows, some ten thousand at a time; can be iterated once.

        Raises:
            ConfigurationError: no row can be used, or the file has another format.
        """

    @abstractmethod
    def describe(self) -> list[str]:
        """The source of each signal, a line per signal."""

    @abstractmethod
    def summary_lines(self) -> list[str]:
        """Counts of what was read and of what was bad, a few words each; the number of rows first."""

    @abstractmethod
    def warnings(self) -> list[str]:
        """What limits the trust in the data, a line each."""

    def _cut_off(self) -> list[str]:
        """The warning for a compressed file that ends too early."""
        return [f"cut off: {self._data.truncation}"] if self._data is not None and self._data.truncation else []


class Format(Protocol):
    """What a module of the table of formats has."""

    Source: type[StrictModel]  # The place of a signal in such a file

    def open_log(self, path: Path, setup: Setup, can: Any | None) -> Reader:
        """The open file; ``can`` describes the frames of a CAN log; raise ConfigurationError if it lacks a signal."""


def suffix_of(path: Path) -> str:
    """The suffix that names the format, in lower case; ``.gz`` is removed first."""
    name = path.with_suffix("") if path.suffix.lower() == GZIP else path
    return name.suffix.lower()


def holds_frames(path: Path) -> bool:
    """Whether the file is a CAN log, which cannot be read without a description of its frames."""
    return _module_of(path) == CAN_LOG


def _module_of(path: Path) -> str:
    """The module that reads ``path``: by its suffix, and for a text by its first line."""
    module = READERS.get(suffix_of(path))
    return module or (CAN_LOG if text_log(head_of(path)) else TABLE)


def format_of(path: Path) -> Format:
    """The module that reads ``path``."""
    return cast("Format", import_module(_module_of(path)))


class DataFile:
    """The bytes of a file, decompressed if its name ends in ``.gz``."""

    def __init__(self, path: Path) -> None:
        """Open ``path``; raise ConfigurationError if the file is missing or cannot be read."""
        try:
            if path.exists() and not path.is_file():
                raise ConfigurationError(f"{path}: is a directory or a device, not a file")
            self._raw = io.BufferedReader(io.FileIO(path), BUFFER)
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from error
        self._size, self._read = max(path.stat().st_size, 1), 0
        self._gzip = _TruncatedGzip(self._raw) if path.suffix.lower() == GZIP else None
        self.stream = self._raw if self._gzip is None else io.BufferedReader(self._gzip, BUFFER)

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        if not self._raw.closed:
            self._read = self._raw.tell()
        return min(1.0, self._read / self._size)

    @property
    def truncation(self) -> str:
        """Why the rest of a compressed file cannot be read; empty if it can, or was not reached yet."""
        return "" if self._gzip is None else self._gzip.truncation

    def close(self) -> None:
        """Close the file; its progress stays known."""
        _ = self.progress
        self.stream.close()
        self._raw.close()


class _TruncatedGzip(io.RawIOBase):
    """A gzip stream that ends where the compressed data end or are damaged, instead of raising."""

    def __init__(self, raw: BinaryIO) -> None:
        self._file = gzip.GzipFile(fileobj=raw)
        self.truncation = ""

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: "WriteableBuffer") -> int:
        view = memoryview(buffer)
        try:
            data = self._file.read1(len(view))  # read() would lose what comes before the damage
        except (EOFError, OSError, zlib.error) as error:
            self.truncation = str(error)
            return 0
        view[: len(data)] = data
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
