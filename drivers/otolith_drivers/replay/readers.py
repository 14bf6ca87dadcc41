"""Recorded files: the rows that every reader returns, the file under it, the formats, and files merged by time."""

import gzip
import io
import math
import re
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.base import Sampling, Setup, sampling_of
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.sample_names import RECORDING, SAMPLES

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]

# Seconds since 1970 reach 1e11 in the year 5138; milliseconds since 1970 passed it in 1973, so a column of them without
# its unit is refused. Guarded by tests/golden/replays/nanoseconds.
MAX_TIME = 1e11  # s
MAX_FILES = 3  # names of files beside a warning; engineering choice, guarded by test_joined.py
BUFFER = 1 << 16  # bytes; the start of the file from which its encoding is recognised

# Formats by the end of the file name. The module is imported only when a file asks for it.
CAN_LOG = "otolith_drivers.replay.can_log"
READERS = dict.fromkeys((".asc", ".blf", ".db", ".log", ".mf4", ".trc"), CAN_LOG)
RECORDING_HEAD = b"RRF"
READERS[RECORDING] = "otolith_drivers.replay.recording"
ARRAYS = "otolith_drivers.replay.exports.arrays"  # files that begin so
ARRAY_HEADS = (b"PAR1", b"ARROW1", b"\x89HDF", b"MATLAB 5.0", b"MATLAB 7.3", b"TDSm")
TABLE = "otolith_drivers.replay.table.reader"  # all other files

# Formats by the first bytes: text logs of a CAN bus, and what a refusal names.
GZIP = ".gz"
HEAD = 1 << 14  # bytes; some hundred lines of a log
MAX_LINES = 20  # of a log, of which one must have its format; the first may be cut off
MIN_STEPS = 4  # times of a log, of which
DIFFERENCE_SHARE = 0.2  # go back, or all are equal: then they are differences
MAX_DIFFERENCE = 1e8  # s: three years; times since 1970 are longer

CANDUMP = "candump -ta"
CANDUMP_LOG = "candump -L"
PYTHON_CAN = "CSV of python-can"
SAVVYCAN = "CSV of SavvyCAN"
ASC, TRC = "Vector ASC", "PEAK TRC"
DIFFERENCES = "candump -td, whose times are differences"
TEXT_LOGS = {
    CANDUMP_LOG: re.compile(r"\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}##?"),
    CANDUMP: re.compile(r"(?:\x1b\[\d*m)*\s*\((?:\d+|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.\d+\)\s.*\[\d+\]"),
    PYTHON_CAN: re.compile(r"timestamp,arbitration_id,extended,remote,error,dlc,data\s*$"),
    SAVVYCAN: re.compile(r"\"?Time Stamp\"?,\"?ID\"?,\"?Extended\"?,", re.IGNORECASE),
    ASC: re.compile(r"base\s+(?:hex|dec)\s+timestamps\s"),
    TRC: re.compile(r";\$FILEVERSION="),
}
"""By name: how a line of a text log, or its header, begins."""
ANOTHER_TOOL = "a CAN log of another tool: export it as candump -L writes"
OTHERS = {
    "Vector BLF": rb"LOGG",
    "MDF (MF4)": rb"MDF ",
    "SQLite": rb"SQLite format 3\x00",
    "a recording of Rerun": RECORDING_HEAD,
    "a spreadsheet or another ZIP archive": rb"PK\x03\x04",
    "HDF5 or MATLAB 7.3": rb"\x89HDF",
    "MATLAB 5": rb"MATLAB 5",
    "Parquet": rb"PAR1",
    "LabVIEW TDMS": rb"TDSm",
    "gzip": rb"\x1f\x8b",
    "a capture of network packets (pcap)": rb"(?:\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x0a\x0d\x0d\x0a)",
    "UTF-16 text": rb"(?:\xff\xfe|\xfe\xff)",
    "BUSMASTER log": rb"\*\*\*BUSMASTER",
    "candump without times: log with candump -L": rb"\w+\s+(?:[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[\d+\]\s",
    ANOTHER_TOOL: (
        rb"(?i)(?>[^\n]*?\b(?:can[ _]?)?id(?:entifier)?\b)[^\n]*\b(?:dlc|length|data\w*|[db][01])\b"
        rb"|\d+\.\d+ \d?[rt](?:11|29) |t[0-9a-f]{3}[0-8](?:[0-9a-f]{2})*\s|\d+\s+[0-9a-f]{8}\s+\d(?:\s+[0-9a-f]{2}\b)+"
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
    back, equal = _differences(lines)
    is_difference = (name in (CANDUMP, CANDUMP_LOG) and back) or (name == CANDUMP and equal)
    return DIFFERENCES if is_difference else name


def _differences(lines: list[str]) -> tuple[bool, bool]:
    """Whether so many times of ``candump`` go back that they are those from frame to frame; whether all are equal."""
    written = [match[1] for line in lines if (match := re.match(r"\s*\((\d+\.\d+)\)", line))]
    times = list(map(float, written))
    steps = [after - before for before, after in pairwise(times)]
    if len(steps) < MIN_STEPS or max(times) > MAX_DIFFERENCE:
        return False, False
    back = sum(step < 0.0 for step in steps)
    return back > DIFFERENCE_SHARE * len(steps), len(set(times[1:])) == 1


def seen(head: bytes) -> str:
    """Return the name of the format that begins with ``head``; empty if it is not known."""
    begins = (head, head.lstrip(b" \r\n"))
    other = next((name for name, start in OTHERS.items() if any(re.match(start, begin) for begin in begins)), "")
    if not other and any(re.match(OTHERS[ANOTHER_TOOL], line.strip()) for line in head.splitlines()[:MAX_LINES]):
        other = ANOTHER_TOOL  # its header may stand below a title
    return other or text_log(head)


class DamagedFileError(ConfigurationError):
    """Nothing of a recording can be read; among several it is left out."""


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

    def assumptions(self) -> list[str]:
        """What was assumed of the dates."""
        return []

    @abstractmethod
    def warnings(self) -> list[str]:
        """What limits the trust in the data, a line each."""

    def _cut_off(self) -> list[str]:
        """The warning for a compressed file that ends too early."""
        return [f"cut off: {self._data.truncation}"] if self._data is not None and self._data.truncation else []


class Format(Protocol):
    """What a module of the table of formats has."""

    Source: type[StrictModel]  # The place of a signal in such a file
    Options: type[StrictModel]  # What is stated of the whole file

    def open_log(self, path: Path, setup: Setup, options: Any | None) -> Reader:
        """The open file; raise ConfigurationError if it lacks a signal."""


def suffix_of(path: Path) -> str:
    """The suffix that names the format, in lower case; ``.gz`` is removed first."""
    name = path.with_suffix("") if path.suffix.lower() == GZIP else path
    return name.suffix.lower()


def holds_frames(path: Path) -> bool:
    """Whether the file is a CAN log, which cannot be read without a description of its frames."""
    return _module_of(path) == CAN_LOG


def holds_arrays(path: Path) -> bool:
    """Whether the file has arrays instead of a text."""
    return _module_of(path) == ARRAYS


def is_recording(path: Path) -> bool:
    """Whether the name is that of a recording of Otolith, or of its samples."""
    return suffix_of(path) == RECORDING or path.name.lower().endswith(SAMPLES)


def _module_of(path: Path) -> str:
    """The module that reads ``path``: by its suffix, and for a text by its first line."""
    if is_recording(path):
        return READERS[RECORDING]
    if (module := READERS.get(suffix_of(path))) is not None:
        return module
    head = head_of(path)
    return CAN_LOG if text_log(head) else ARRAYS if head.startswith(ARRAY_HEADS) else TABLE


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


class _Feed:
    """The rows of a file that are not merged yet."""

    def __init__(self, reader: Reader, signals: Sequence[str]) -> None:
        self.path = reader.path
        self._chunks, self._signals = reader.chunks(), signals
        self._clock: Array = np.zeros(0)
        self._latest = -math.inf
        self._bad = 0
        self._rows: Rows | None = None
        self.end = -math.inf  # Time of the latest row that was read, s; infinity at the end of the file
        self.read()
        self.begin = float(self._clock[0]) if len(self._clock) else math.inf

    def read(self) -> None:
        """Read another chunk."""
        rows = next(self._chunks, None)
        if rows is None:
            self.end = math.inf
            return
        self._rows = rows if self._rows is None else self._rows.followed_by(rows)
        clock = np.maximum.accumulate(np.maximum(rows.times, self._latest))
        self._clock = np.concatenate([self._clock, clock])
        self.end = self._latest = float(clock[-1])

    def take(self, until: float) -> tuple[Array, Rows] | None:
        """Return and remove the rows up to ``until`` (s): their times, none of which decreases, and the rows.

        A signal that the file does not have is NaN; a row has its own number of bad lines instead of the sum.
        """
        count = int(np.searchsorted(self._clock, until, side="right"))
        if self._rows is None or not count:
            return None
        taken, clock = self._rows.part(slice(0, count)), self._clock[:count]
        self._rows, self._clock = self._rows.part(slice(count, None)), self._clock[count:]
        bad, self._bad = np.diff(taken.bad, prepend=self._bad), int(taken.bad[-1])
        blank = np.full(count, np.nan)
        columns = {name: taken.columns.get(name, blank) for name in self._signals}
        return clock, Rows(taken.times, columns, taken.lines, bad, taken.begins)

    @property
    def is_empty(self) -> bool:
        """Whether all rows that were read have been taken."""
        return not len(self._clock)


class MergedReader(Reader):
    """Reads the files of all sources at the same time; their times must be those of one clock."""

    def __init__(
        self,
        path: Path,
        signals: Mapping[str, Sequence[str]],
        open_source: Callable[[str], Reader],
        *,
        is_one_file: bool = False,
    ) -> None:
        """Open the file of each source; ``signals`` has those of each; ``path`` stands for all files in messages.

        ``is_one_file`` says that all sources are parts of one file, whose times are those of one clock for sure.
        """
        super().__init__(path)
        self._is_one_file = is_one_file
        with ExitStack() as opened:
            self._readers = [(name, opened.enter_context(open_source(name))) for name in signals]
            self._opened = opened.pop_all()
        self.place = f"its file's {self._readers[0][1].place}"
        self.ignored = tuple(dict.fromkeys(name for _, reader in self._readers for name in reader.ignored))
        self._signals = [signal for names in signals.values() for signal in names]
        self.sampling = {
            signal: sampling_of(reader.sampling, signal) for name, reader in self._readers for signal in signals[name]
        }
        self._bad = 0

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the files that was read, 0 to 1."""
        return sum(reader.progress for _, reader in self._readers) / len(self._readers)

    @property
    def bad(self) -> int:
        return sum(reader.bad for _, reader in self._readers)

    @property
    def lost(self) -> int:
        return sum(reader.lost for _, reader in self._readers)

    def summary_lines(self) -> list[str]:
        return [f"{title}: {', '.join(reader.summary_lines())}" for title, reader in self._readers]

    def warnings(self) -> list[str]:
        return of_files((reader.path, line) for _, reader in self._readers for line in reader.warnings())

    def chunks(self) -> Iterator[Rows]:
        """The rows of all files by time; raise ConfigurationError also if one file ends before another begins."""
        feeds = [_Feed(reader, self._signals) for _, reader in self._readers]
        last = max(feeds, key=lambda feed: feed.begin)
        for feed in feeds:
            before = feed.end
            while feed.end < last.begin:
                before = feed.end
                feed.read()
            if math.isinf(feed.end) and before < last.begin and not self._is_one_file:
                theirs = f"{last.path} begins at t = {last.begin:.12g} s"
                text = f"ends at t = {before:.12g} s, but {theirs}: both must have the times of one clock"
                raise ConfigurationError(f"{feed.path}: {text}")
        while not all(feed.is_empty and math.isinf(feed.end) for feed in feeds):
            until = min(feed.end for feed in feeds)
            parts = [part for feed in feeds if (part := feed.take(until)) is not None]
            for feed in feeds:
                if feed.end <= until and not math.isinf(feed.end):
                    feed.read()
            if parts:
                yield self._merged(parts)

    def _merged(self, parts: Sequence[tuple[Array, Rows]]) -> Rows:
        """Return the rows of all parts in the order of their times."""
        order = np.argsort(np.concatenate([clock for clock, _ in parts]), kind="stable")
        rows = parts[0][1]
        for _, others in parts[1:]:
            rows = rows.followed_by(others)
        columns = {name: values[order] for name, values in rows.columns.items()}
        bad = self._bad + np.cumsum(rows.bad[order])
        self._bad = int(bad[-1])
        return Rows(rows.times[order], columns, rows.lines[order], bad, rows.begins[order])

    def describe(self) -> list[str]:
        return [
            line for name, reader in self._readers for line in (f"source {name}: {reader.path}", *reader.describe())
        ]


def of_files(told: Iterable[tuple[Path, str]]) -> list[str]:
    """Return each line that was told of files once, with the files."""
    files: dict[str, list[Path]] = {}
    for path, line in told:
        files.setdefault(line, []).append(path)
    return [f"{_some(paths)}: {line}" for line, paths in files.items()]


def _some(paths: Sequence[Path]) -> str:
    more = len(paths) - MAX_FILES
    return ", ".join(map(str, paths[:MAX_FILES])) + (f" and {more} more" if more > 0 else "")
