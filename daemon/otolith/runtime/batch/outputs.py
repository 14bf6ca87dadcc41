"""What a replay of many machines leaves in its folder: of each machine the reports, the warnings and a checkpoint.

Reports and warnings are appended first, and the checkpoint, which says how much of them is whole, is replaced last. So
whenever the process is killed, what it has appended since the checkpoint is cut off, and computed again.
"""

import contextlib
import fcntl
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from otolith.health.schema import ReportDocument
from otolith.runtime.batch.task import ReplayOutcome
from otolith.storage.disk import replace_file
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import writable

LOCK = "replay.lock"
CHECKPOINT, WARNINGS = ".checkpoint", ".warnings"
MAX_HEAD = 1 << 16  # bytes of the first line of a checkpoint


class OutputFormat(StrEnum):
    """How reports are written."""

    JSONL = "jsonl"
    PARQUET = "parquet"


@contextlib.contextmanager
def opened_output(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which is created; raise ServiceError if another process has it."""
    try:
        handle = os.open(writable(folder) / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    except OSError as error:
        raise ServiceError(f"{folder / LOCK}: cannot be opened: {error.strerror}") from error
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise ServiceError(
            f"{folder}: another replay writes into it: wait for its end, or name another folder"
        ) from error
    finally:
        os.close(handle)


class _Sink(ABC):
    """Where the reports of a machine are appended."""

    @abstractmethod
    def append(self, reports: Sequence[str], kept: int) -> int:
        """Append reports after what is ``kept``, and return what is kept with them."""


class _JsonLines(_Sink):
    """A file with a line for each report; kept are its bytes."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def append(self, reports: Sequence[str], kept: int) -> int:
        return _append(self._path, "".join(f"{line}\n" for line in reports).encode(), kept)


class _Parquet(_Sink):
    """A folder of Parquet files with a row for each report; kept is their number."""

    def __init__(self, folder: Path, parameters: Sequence[str]) -> None:
        self._folder, self._parameters = folder, tuple(parameters)

    def append(self, reports: Sequence[str], kept: int) -> int:
        import pyarrow as pa  # noqa: PLC0415 - slow to import
        import pyarrow.parquet as pq  # noqa: PLC0415

        self._folder.mkdir(exist_ok=True)
        for path in self._folder.glob("part-*.parquet"):
            if not path.stem[5:].isdigit() or int(path.stem[5:]) >= kept:
                path.unlink()
        if not reports:
            return kept
        numbers = [f"{name}{end}" for name in self._parameters for end in ("", ".low", ".high")]
        texts = ["machine", "site", "decision", "state", *(f"{name}.status" for name in self._parameters), "report"]
        kinds = dict.fromkeys(texts, pa.string()) | dict.fromkeys(["start", "end", *numbers], pa.float64())
        rows = [self._row(ReportDocument.from_json(text), text) for text in reports]
        schema = pa.schema([(name, kinds.get(name, pa.int64())) for name in rows[0]])
        table = pa.Table.from_pylist(rows, schema=schema)
        buffer = pa.BufferOutputStream()
        pq.write_table(table, buffer, compression="zstd")
        replace_file(self._folder / f"part-{kept:06d}.parquet", buffer.getvalue().to_pybytes(), ".part.new", 0o644)
        return kept + 1

    def _row(self, document: ReportDocument, text: str) -> dict[str, Any]:
        """Return the columns of a report: numbers that tables need, and all of it as JSON."""
        window = document.window
        row: dict[str, Any] = {
            "machine": document.machine,
            "site": document.site,
            "index": window.index,
            "start": window.start,
            "end": window.end,
            "decision": str(document.decision),
            "state": None if document.health is None else str(document.health.state),
        }
        for name in self._parameters:
            item = document.parameters.get(name)
            values = (None, None, None, None) if item is None else (item.value, item.low, item.high, str(item.status))
            row |= dict(zip((name, f"{name}.low", f"{name}.high", f"{name}.status"), values, strict=True))
        return {**row, "report": text}


class MachineOutput:
    """The files of one machine."""

    def __init__(self, folder: Path, key: str, kind: OutputFormat, origin: str, parameters: Sequence[str]) -> None:
        """``key`` is its site and name, and ``origin`` a hash of all that its reports depend on.

        ``parameters`` have columns of their own in a table.

        Raises:
            ConfigurationError: its checkpoint is damaged, or of another origin.
        """
        self.path = folder / f"{key}.{kind}"
        self.warnings_path = folder / f"{key}{WARNINGS}"
        self._checkpoint_path, self._temporary = folder / f"{key}{CHECKPOINT}", f"{key}.new"
        self._sink: _Sink = _JsonLines(self.path) if kind is OutputFormat.JSONL else _Parquet(self.path, parameters)
        self._head: dict[str, Any] = {"origin": origin, "format": kind, "kept": 0, "warned": 0, "is_done": False}
        self._head |= {"reports": 0, "warnings": 0}
        self.checkpoint: bytes | None = self._read()

    @property
    def is_done(self) -> bool:
        """Whether all was replayed."""
        return bool(self._head["is_done"])

    @property
    def reports(self) -> int:
        """Reports that were kept."""
        return int(self._head["reports"])

    @property
    def warnings(self) -> int:
        """Warnings that were kept."""
        return int(self._head["warnings"])

    def keep(self, outcome: ReplayOutcome) -> None:
        """Append an outcome, and keep its checkpoint.

        Raises:
            ServiceError: a file cannot be written.
        """
        head = dict(self._head)
        try:
            head["kept"] = self._sink.append(outcome.reports, head["kept"])
            lines = "".join(f"{line}\n" for line in outcome.warnings)
            if lines or head["warned"]:
                head["warned"] = _append(self.warnings_path, lines.encode(), head["warned"])
        except OSError as error:
            raise ServiceError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        head |= {"reports": head["reports"] + len(outcome.reports), "is_done": outcome.is_done}
        head["warnings"] += len(outcome.warnings)
        text = json.dumps(head).encode()
        replace_file(self._checkpoint_path, text + b"\n" + outcome.checkpoint, self._temporary)
        self._head, self.checkpoint = head, outcome.checkpoint

    def _read(self) -> bytes | None:
        """Return the checkpoint in the folder; None if there is none."""
        path = self._checkpoint_path
        remedy = "name another folder, or remove the files of this machine in it"
        try:
            with path.open("rb") as stream:
                head, content = json.loads(stream.readline(MAX_HEAD)), stream.read()
        except FileNotFoundError:
            if self.path.exists():
                raise ConfigurationError(f"{self.path}: exists, and no checkpoint says what it is: {remedy}") from None
            return None
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"{path}: cannot be read, or is damaged: {remedy}") from error
        kinds = {name: type(value) for name, value in self._head.items()}
        if not isinstance(head, dict) or {name: type(value) for name, value in head.items()} != kinds | {"format": str}:
            raise ConfigurationError(f"{path}: is damaged, or of another version: {remedy}")
        for name, what in {"origin": "machine file, decisions, data or version", "format": "format"}.items():
            if head[name] != self._head[name]:
                raise ConfigurationError(f"{path}: of another {what} than now: {remedy}")
        self._head = head
        return content


def _append(path: Path, data: bytes, kept: int) -> int:
    """Write ``data`` after the first ``kept`` bytes of a file, which ends with them, and return its size."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    with os.fdopen(handle, "r+b") as stream:
        stream.truncate(kept)
        stream.seek(kept)
        stream.write(data)
        stream.flush()
        os.fsync(stream.fileno())
    return kept + len(data)
