"""Components and operator decisions on disk, and the writer thread that accesses the disk for the daemon.

Each file has one writer: the daemon writes components, the command line writes operator decisions.
"""

import contextlib
import logging
import math
import os
import tempfile
import threading
import time
from collections import deque
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import Field, ValidationError

from otolith.adaptation.state import ComponentRecord, OperatorDecisions
from otolith.twin.augmentation import MAX_COMPONENTS, sites, sources
from otolith.twin.component_families import FAMILY_NAMES
from otolith.twin.definition import Definition
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.user_dirs import state_directory, writable

log = logging.getLogger(__name__)

VERSION = 1
# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
DECISIONS_INTERVAL = 0.5  # s between two checks for new operator decisions
WRITE_RETRY = 30.0  # s after which a failed write is tried again

StateModel = TypeVar("StateModel", bound=StrictModel)


class _ComponentsFile(StrictModel):
    """The components of one machine, written by the daemon."""

    version: int = VERSION
    twin: str
    signal_fingerprint: str = ""
    """See :attr:`otolith.machine.LoadedMachine.signal_fingerprint`."""
    components: tuple[ComponentRecord, ...] = ()


class _DecisionsFile(StrictModel):
    """The operator's decisions, written by ``otolith components`` and ``otolith commission``."""

    version: int = VERSION
    approved: tuple[str, ...] = ()
    rejected: tuple[str, ...] = ()
    forgotten: Annotated[dict[str, float], Field(default_factory=dict)]


class StateStore:
    """The two state files of one machine."""

    def __init__(
        self, site: str, machine: str, twin: Definition, folder: Path | None = None, signal_fingerprint: str = ""
    ) -> None:
        """Components found in signals with another ``signal_fingerprint`` are not loaded."""
        self._twin = twin
        self._signal_fingerprint = signal_fingerprint
        folder = folder or state_directory() / "components"
        self.components_path = folder / f"{site}.{machine}.json"
        self.decisions_path = folder / f"{site}.{machine}.decisions.json"

    def components(self) -> tuple[ComponentRecord, ...]:
        """Return the saved components that this twin can have, if they were found in the same signals.

        Raises:
            ConfigurationError: the file is unreadable or not a components file.
        """
        file = _read(self.components_path, _ComponentsFile)
        if file is None or file.twin != self._twin.name:
            return ()
        if file.signal_fingerprint and self._signal_fingerprint and file.signal_fingerprint != self._signal_fingerprint:
            log.warning("started without the saved components: [signals] have changed since they were found")
            return ()
        return tuple(record for record in file.components if self._is_possible(record))[:MAX_COMPONENTS]

    def _is_possible(self, record: ComponentRecord) -> bool:
        """Return whether this version and this twin can have the component."""
        component = record.adopted.component
        if component.family not in FAMILY_NAMES or component.amplitude == 0.0:
            return False
        numbers = 1 + (component.model.inner is not None) + component.periodic
        return (
            component.site in {site.name for site in sites(self._twin)}
            and component.source in {source.name for source in sources(self._twin)}
            and len(record.values) == len(record.deviations) == numbers
            and all(map(math.isfinite, (*record.values, *record.deviations)))
        )

    def save_components(self, components: tuple[ComponentRecord, ...]) -> None:
        """Write the components, all or nothing.

        Raises:
            ServiceError: the file cannot be written.
        """
        file = _ComponentsFile(twin=self._twin.name, signal_fingerprint=self._signal_fingerprint, components=components)
        _write(self.components_path, file)

    def decisions(self) -> OperatorDecisions:
        """Return the operator's decisions.

        Raises:
            ConfigurationError: the file is unreadable or not a decisions file.
        """
        file = _read(self.decisions_path, _DecisionsFile)
        if file is None:
            return OperatorDecisions()
        return OperatorDecisions(frozenset(file.approved), frozenset(file.rejected), file.forgotten)

    def save_decisions(self, decisions: OperatorDecisions) -> None:
        """Write the operator's decisions; a running daemon applies them with its next window.

        Raises:
            ServiceError: the file cannot be written.
        """
        approved, rejected = tuple(sorted(decisions.approved)), tuple(sorted(decisions.rejected))
        file = _DecisionsFile(approved=approved, rejected=rejected, forgotten=dict(decisions.forgotten))
        _write(self.decisions_path, file)

    def decisions_time(self) -> float:
        """Return the Unix time of the latest decision, s; 0 if there is none."""
        with contextlib.suppress(OSError):
            return self.decisions_path.stat().st_mtime
        return 0.0


def _read(path: Path, model: type[StateModel]) -> StateModel | None:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "file"
        remedy = "move the file away to start without it"
        raise ConfigurationError(f"{path}: {where}: {first['msg']}: {remedy}") from error


def _write(path: Path, model: StrictModel) -> None:
    try:
        writable(path.parent)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".new")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(model.model_dump_json(indent=2) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        if os.geteuid() == 0:  # the daemon runs as another user and must be able to read what root writes
            owner = path.parent.stat()
            os.chown(temporary, owner.st_uid, owner.st_gid)
        Path(temporary).replace(path)
    except OSError as error:
        with contextlib.suppress(OSError, UnboundLocalError):
            Path(temporary).unlink()
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error


class WriterThread:
    """Writes components and reads operator decisions in the background; its callers never wait for the disk.

    Only the latest value is kept in each direction.
    """

    def __init__(self, store: StateStore, decisions_time: float) -> None:
        """``decisions_time`` is the :meth:`StateStore.decisions_time` of the decisions that are known already."""
        self._store, self._decisions_time = store, decisions_time
        self._to_save: deque[tuple[ComponentRecord, ...]] = deque(maxlen=1)
        self._new_decisions: deque[OperatorDecisions] = deque(maxlen=1)
        self._wakeup, self._stopping = threading.Event(), threading.Event()
        self._unsaved: tuple[ComponentRecord, ...] | None = None
        self._retry_at, self._last_error = 0.0, ""
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def save(self, components: tuple[ComponentRecord, ...]) -> None:
        """Request that ``components`` replace those on disk."""
        self._to_save.append(components)
        self._wakeup.set()

    def new_decisions(self) -> OperatorDecisions | None:
        """Return the operator's decisions if they have changed since the last call, otherwise None."""
        return self._new_decisions.popleft() if self._new_decisions else None

    def stop(self, seconds: float) -> None:
        """Write what is still to be saved, for up to ``seconds``, and end the thread."""
        self._stopping.set()
        self._wakeup.set()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("components may not be saved: writing took over %.1f s: check the disk", seconds)

    def _run(self) -> None:
        while True:
            self._wakeup.wait(DECISIONS_INTERVAL)
            self._wakeup.clear()
            stopping = self._stopping.is_set()
            if self._to_save:
                self._unsaved, self._retry_at = self._to_save.popleft(), 0.0
            if self._unsaved is not None and (stopping or time.monotonic() >= self._retry_at):
                self._save(self._unsaved)
            if stopping:
                return
            self._read_decisions()

    def _save(self, components: tuple[ComponentRecord, ...]) -> None:
        try:
            self._store.save_components(components)
        except OtolithError as error:  # monitoring continues on a full disk
            if str(error) != self._last_error:
                log.warning("components are not saved: %s", error)
            self._last_error, self._retry_at = str(error), time.monotonic() + WRITE_RETRY
        else:
            self._last_error, self._unsaved = "", None

    def _read_decisions(self) -> None:
        decisions_time = self._store.decisions_time()
        if decisions_time == self._decisions_time:
            return
        self._decisions_time = decisions_time
        try:
            self._new_decisions.append(self._store.decisions())
        except OtolithError as error:
            log.warning("%s", error)
