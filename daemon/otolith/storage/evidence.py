"""Evidence of events: bundles with all that is needed to compute the reports around an event again, bit for bit.

A bundle is a ZIP archive with a :class:`Bundle` as JSON, the twin, and the machine file without secrets.
The JSON is that of :mod:`otolith.storage.exact_json`: the same to the last bit, and without a twin.
Learned states (``learned_state.py``) are written by other means: they must survive a new version, and be plausible.

The main thread of the daemon only keeps what it has anyway, and a thread of its own writes: a disk that is full or slow
costs evidence, never monitoring.
"""

import contextlib
import io
import json
import logging
import platform
import re
import zipfile
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from otolith.acquisition.window import Window
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import AdaptationState
from otolith.health.events import OF_DATA
from otolith.health.schema import EventChange, EventDocument, Report
from otolith.health.text import announcements
from otolith.machine import FINGERPRINT_KEYS, LIBRARY, LoadedMachine
from otolith.machine_file import OwnTables
from otolith.storage.disk import WRITE_RETRY, WriterThread, reason_of, replace_file
from otolith.storage.exact_json import Decoder, encoded
from otolith.storage.recording_files import STAMP
from otolith.twin.language import read_twin
from otolith.twin.unmeasured import UnmeasuredInput, without_sensor
from otolith_drivers.config_files import FILE_SIZE_LIMIT, Context, SourceFile, parse, read, validate
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.grammars.toml_lines import toml_key, toml_value
from otolith_drivers.outside_text import visible
from otolith_drivers.user_dirs import state_directory

log = logging.getLogger(__name__)

VERSION = 9  # of the bundles: raised when a state has other fields
EVIDENCE, TWIN, MACHINE = "evidence.json", "twin.toml", "machine.toml"
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # that are unpacked by parts
FMU = "fmu.txt"  # in place of the twin: which FMU has its equations
NAME = re.compile(r"(?P<key>[^/]+)-(?P<number>\d{6,})-(?P<stamp>\d{8}T\d{6})\.zip")
LIBRARIES = ("otolith", "numpy", "scipy", "sympy", "numba", "llvmlite")  # on which the last bit of a report may depend
PUBLIC_KEYS = {"driver": ("type", "name", *FINGERPRINT_KEYS), "machine": ("name", "site"), "zenoh": (), "outlets": ()}
"""Keys of tables of a machine file that bundles have; others may be secrets."""
COMPUTED = frozenset({EventChange.RAISED, EventChange.CHANGED, EventChange.CLEARED})  # Changes that windows made
# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
MAX_EVIDENCE_BYTES = 64 << 20  # of a bundle, packed and unpacked
MAX_BUNDLES = 1000  # of a machine
MIN_WINDOWS = 16  # before a change of an event that its bundle has, and at most twice as many
MAX_WINDOW_BYTES = 8 << 20  # of windows after which fewer are enough
MAX_ENTRIES = 32  # files of a bundle; it has three, and packed data may have the mark of one by chance
MAX_VALUES = 1 << 20  # of a bundle's JSON: each takes some 60 bytes of memory for the 3 that it may take in the file
MAX_REASON = 300  # characters of the error of a library
MAX_WAITING_BUNDLES = 4  # for the disk; more are dropped
ENTRY = b"PK\x01\x02"  # before each file in the directory of an archive


@dataclass(frozen=True, slots=True)
class EvidenceWindow:
    """A window with the report of it."""

    state: AdaptationState | None  # The state before it; None if it is the one after the window before
    window: Window
    report: str  # JSON, without what the daemon adds: numbers, counters, connection and computing time


@dataclass(frozen=True, slots=True)
class Bundle:
    """The evidence of the events that the last of its windows changed."""

    version: int
    versions: Mapping[str, str]
    unmeasured: tuple[UnmeasuredInput, ...]  # Inputs without a sensor, by which the twin was rewritten
    events: tuple[EventDocument, ...]
    state: AdaptationState  # The state before the first window
    windows: tuple[EvidenceWindow, ...]


def versions() -> dict[str, str]:
    """Return the versions of what computes here."""
    processor = platform.machine()
    with contextlib.suppress(OSError, IndexError):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        processor = re.findall(r"^model name\s*: (.+)$", text, re.MULTILINE)[0]
    return {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}, "processor": processor}


def pack(bundle: Bundle, files: Mapping[str, str]) -> bytes:
    """Return a bundle as an archive with ``files``, by name; raise ValueError if it is larger than what is read."""
    is_small = 2 * sum(_bytes(item.window) for item in bundle.windows) <= MAX_EVIDENCE_BYTES  # as text they take more
    text = encoded(bundle) if is_small else ""
    if not 0 < len(text) <= MAX_EVIDENCE_BYTES:
        raise ValueError(f"its windows and state take more than {MAX_EVIDENCE_BYTES} bytes")
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {**files, EVIDENCE: text}.items():
            archive.writestr(name, content)
    return packed.getvalue()


def _bytes(window: Window) -> int:
    return window.values.nbytes * (1 if window.bridge_error is None else 5)


def read_bundle(path: Path) -> Bundle:
    """Return the bundle in a file, unpacked in memory only; raise ConfigurationError if it cannot be used."""
    try:
        return _read_bundle(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # of any type, from archives and values that are damaged or forged
        text = visible((reason_of(error) or type(error).__name__).splitlines()[0], MAX_REASON)
        raise ConfigurationError(f"{path}: no evidence that this Otolith can use, or damaged: {text}") from error


def _read_bundle(path: Path) -> Bundle:
    with path.open("rb") as stream:
        packed = _limited(stream, MAX_EVIDENCE_BYTES)
    if (count := packed.count(ENTRY)) > MAX_ENTRIES:
        raise ValueError(f"{count} files in it: at most {MAX_ENTRIES}")
    archive = zipfile.ZipFile(io.BytesIO(packed))
    if FMU in archive.namelist():
        raise ValueError("its equations are in an FMU, which is a program: a bundle has none")
    if other := [row.filename for row in archive.infolist() if row.compress_type not in PACKINGS]:
        raise ValueError(f"{other[0]} is not packed by deflate, as bundles are: other methods unpack without a bound")
    with archive.open(EVIDENCE) as evidence:
        written = _limited(evidence, MAX_EVIDENCE_BYTES)
        if (count := written.count(b",") + written.count(b"[") + written.count(b"{")) > MAX_VALUES:
            raise ValueError(f"{count} values in it: at most {MAX_VALUES}")
    content = json.loads(written)
    if (number := content["version"]) != VERSION:
        raise ValueError(f"version {number!r:.20} of the format: this Otolith reads {VERSION}")
    machine = _text_in(archive, MACHINE)
    tables = {key: table for key, table in parse(machine).items() if key in OwnTables.model_fields}
    own = validate(tables, OwnTables, machine)
    twin = own.applied_to(read_twin(_text_in(archive, TWIN)), Context(machine))
    for item in Decoder(twin).decode(tuple[UnmeasuredInput, ...], content["unmeasured"]):
        twin = without_sensor(twin, item)
    bundle: Bundle = Decoder(twin).decode(Bundle, content)
    if not bundle.windows:
        raise ValueError("it has no windows")
    return bundle


def _text_in(archive: zipfile.ZipFile, name: str) -> SourceFile:
    with archive.open(name) as text:
        return SourceFile(Path(name), _limited(text, FILE_SIZE_LIMIT).decode())


def _limited(stream: Any, limit: int) -> bytes:
    if len(content := stream.read(limit + 1)) > limit:
        raise ValueError(f"larger than {limit} bytes")
    return bytes(content)


def files_of(machine: LoadedMachine) -> dict[str, str]:
    """Return the texts of twin and machine file, as bundles have them; raise ConfigurationError if one is missing."""
    table, public = machine.file.twin, public_text(parse(read(machine.path)))
    if (fmu := machine.twin.fmu) is not None:
        return {FMU: f"The equations are in {Path(fmu.path).name}, SHA-256 {fmu.digest}\n", MACHINE: public}
    source = read(LIBRARY / f"{table.name}.toml" if table.file is None else machine.path.parent / table.file)
    return {TWIN: source.text, MACHINE: public}


def public_text(tables: Mapping[str, Any]) -> str:
    """Return the tables of a machine file as TOML, without comments and secrets."""
    lines: list[str] = []
    for name, content in tables.items():
        for table in content if isinstance(content, list) else [content]:
            own = {"file": TWIN} if name == "twin" and "fmu" not in table else table
            lines.append(f"[[{toml_key(name)}]]" if isinstance(content, list) else f"[{toml_key(name)}]")
            keys = [key for key in own if key in PUBLIC_KEYS.get(name, own)]
            lines += [f"{toml_key(key)} = {toml_value(own[key])}" for key in keys]
    return "\n".join([*lines, ""])


def has_evidence(event: EventDocument) -> bool:
    """Whether windows and twin led to the change of an event, so that computing them again shows why.

    What says that data or an output are missing is no result of them, and neither is what a person did.
    """
    return event.change in COMPUTED and not event.id.startswith(OF_DATA)


def bundles_of(site: str, machine: str) -> dict[str, Path]:
    """Return the bundles of a machine in the state directory, by the time in their names: see :func:`stamp_of`."""
    named = ((NAME.fullmatch(path.name), path) for path in sorted((state_directory() / "evidence").glob("*.zip")))
    return {match["stamp"]: path for match, path in named if match and match["key"] == f"{site}.{machine}"}


def stamp_of(end: float) -> str:
    """Return the time in the name of the bundle of a window that ends at ``end`` (service time, s)."""
    return datetime.fromtimestamp(end, UTC).strftime(STAMP)


@dataclass(frozen=True, slots=True, eq=False)
class _KeptWindow:
    """A window that may become evidence, with the report of it."""

    state: PackedState | None  # As in EvidenceWindow
    window: Window
    report: str

    def evidence(self) -> EvidenceWindow:
        return EvidenceWindow(None if self.state is None else self.state.unpack(), self.window, self.report)


@dataclass(frozen=True, slots=True, eq=False)
class _Wanted:
    """What a bundle is made of that was asked for: :meth:`EvidenceWriter.write` makes it."""

    events: tuple[EventDocument, ...]
    state: PackedState
    windows: tuple[_KeptWindow, ...]

    def bundle(self, of: Mapping[str, str], unmeasured: tuple[UnmeasuredInput, ...]) -> Bundle:
        windows = tuple(each.evidence() for each in self.windows)
        return Bundle(VERSION, of, unmeasured, self.events, self.state.unpack(), windows)


class EvidenceWriter(WriterThread):
    """The bundles of one machine while its daemon runs; the oldest are deleted for new ones."""

    def __init__(self, machine: LoadedMachine) -> None:
        """Raise ServiceError if the state directory is not writable, and ConfigurationError as :func:`files_of`."""
        self.folder = state_directory() / "evidence"
        super().__init__("evidence", WRITE_RETRY, f"{self.folder}: no evidence of events is kept")
        self.files, self.max_bytes = files_of(machine), machine.file.evidence.max_megabytes * 1_000_000
        self.dropped = 0  # changes of events without a bundle
        self._unmeasured = machine.unmeasured
        self._key, self._versions = f"{machine.file.machine.site}.{machine.file.machine.name}", versions()
        self._older: tuple[_KeptWindow, ...] = ()
        self._newer: tuple[_KeptWindow, ...] = ()
        self._states: tuple[PackedState, ...] = ()  # before the first of the older and of the newer windows
        self._after: PackedState | None = None
        self._waiting: deque[_Wanted] = deque()

    def add(self, before: PackedState, window: Window, report: Report, after: PackedState, text: str = "") -> None:
        """Keep the last finished windows with reports and states; request a bundle if this one changed an event.

        ``text`` is the JSON of the report, if it was made already.
        """
        if not self.max_bytes:
            return
        size = sum(_bytes(item.window) for item in self._newer)
        if not self._states or len(self._newer) >= MIN_WINDOWS or size >= MAX_WINDOW_BYTES:
            self._older, self._newer, self._states = self._newer, (), (*self._states[-1:], before)
        state = None if before is self._after else before
        self._newer, self._after = (*self._newer, _KeptWindow(state, window, text or report.document.to_json())), after
        if events := tuple(filter(has_evidence, announcements(report.document))):
            is_full = len(self._waiting) >= MAX_WAITING_BUNDLES
            self.dropped += is_full
            wanted = _Wanted(events, self._states[0], (*self._older, *self._newer))
            self._waiting += [] if is_full else [wanted]
            self.wake()

    def write(self) -> None:
        """Write the bundles that wait."""
        while self._waiting:
            wanted = self._waiting[0]
            names = ", ".join(event.id for event in wanted.events)
            try:
                data = pack(wanted.bundle(self._versions, self._unmeasured), self.files)
                path = self._path(wanted.windows[-1].window.end, len(data))
            except (TypeError, ValueError) as error:
                self.dropped += 1
                log.warning("%s: no evidence of %s: %s", self.folder, names, error)
            else:
                replace_file(path, data, f"{self._key}.new")
                log.info("evidence of %s: %s", names, path)
            self._waiting.popleft()

    def _path(self, end: float, size: int) -> Path:
        """Return the path of a bundle after deleting the oldest ones for it; raise ValueError if it is too large."""
        if size > self.max_bytes:
            raise ValueError(f"it takes {size} bytes, more than all may take")
        named = ((NAME.fullmatch(path.name), path) for path in self.folder.glob("*.zip"))
        own = sorted((int(match["number"]), path) for match, path in named if match and match["key"] == self._key)
        number, total = own[-1][0] + 1 if own else 1, size + sum(path.stat().st_size for _, path in own)
        while own and (total > self.max_bytes or len(own) >= MAX_BUNDLES):
            _, oldest = own.pop(0)
            total -= oldest.stat().st_size
            oldest.unlink()
        return self.folder / f"{self._key}-{number:06d}-{stamp_of(end)}.zip"
