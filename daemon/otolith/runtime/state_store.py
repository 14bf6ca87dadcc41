"""Components on disk: what the daemon knows of them, and what the specialist has said; each file has one writer.

The thread that waits for the disk, so that no other does: it keeps components, and hears the specialist.
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

from pydantic import Field, TypeAdapter, ValidationError

from otolith.adaptation.state import ComponentRecord, OperatorDecisions
from otolith.twin.augmentation import MAX_COMPONENTS, sites, sources
from otolith.twin.component_families import FAMILY_NAMES
from otolith.twin.definition import Definition
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.user_dirs import state_directory, writable

log = logging.getLogger(__name__)

VERSION = 1
Page = TypeVar("Page", bound=StrictModel)


class _StateFile(StrictModel):
    """The daemon's file."""

    version: int = VERSION
    twin: str
    signal_fingerprint: str = ""
    """See :attr:`otolith.machine.LoadedMachine.signal_fingerprint`."""
    components: tuple[ComponentRecord, ...] = ()


class _Said(StrictModel):
    """The specialist's file."""

    version: int = VERSION
    approved: tuple[str, ...] = ()
    rejected: tuple[str, ...] = ()
    forgotten: Annotated[dict[str, float], Field(default_factory=dict)]


class StateStore:
    """The two files of one machine."""

    def __init__(
        self, site: str, machine: str, twin: Definition, folder: Path | None = None, signal_fingerprint: str = ""
    ) -> None:
        """``heard`` is how the signals are: what was found in others is none of this machine's."""
        self._signal_fingerprint = signal_fingerprint
        folder = folder or state_directory() / "components"
        self._twin = twin
        self.known = folder / f"{site}.{machine}.json"
        self.said = folder / f"{site}.{machine}.specialist.json"

    def components(self) -> tuple[ComponentRecord, ...]:
        """Those that are kept and that this twin can have, found in signals that are said as they are now.

        Raises:
            ConfigurationError: the file is not one of ours.
        """
        file = _read(self.known, _StateFile)
        if file is None or file.twin != self._twin.name:
            return ()
        if file.signal_fingerprint and self._signal_fingerprint and file.signal_fingerprint != self._signal_fingerprint:
            log.warning("begun without the components of earlier runs: since then [signals] have changed")
            return ()
        usable = [entry for entry in file.components if self._is_possible(entry)]
        return tuple(usable[:MAX_COMPONENTS])

    def _is_possible(self, kept: ComponentRecord) -> bool:
        """Whether this version and this twin can have such a component."""
        component = kept.adopted.component
        if component.family not in FAMILY_NAMES or component.amplitude == 0.0:
            return False
        numbers = 1 + (component.model.inner is not None) + component.periodic
        return (
            component.site in {entry.name for entry in sites(self._twin)}
            and component.source in {entry.name for entry in sources(self._twin)}
            and len(kept.values) == len(kept.deviations) == numbers
            and all(map(math.isfinite, (*kept.values, *kept.deviations)))
        )

    def keep(self, components: tuple[ComponentRecord, ...]) -> None:
        """Write what is known of components, all or nothing.

        Raises:
            ServiceError: the disk does not take it.
        """
        _write(
            self.known,
            _StateFile(twin=self._twin.name, signal_fingerprint=self._signal_fingerprint, components=components),
        )

    def decisions(self) -> OperatorDecisions:
        """What the specialist has said.

        Raises:
            ConfigurationError: the file is not one of ours.
        """
        file = _read(self.said, _Said)
        if file is None:
            return OperatorDecisions()
        return OperatorDecisions(frozenset(file.approved), frozenset(file.rejected), file.forgotten)

    def decide(self, decisions: OperatorDecisions) -> None:
        """Write what the specialist says; a running daemon hears it with its next window.

        Raises:
            ServiceError: the disk does not take it.
        """
        _write(self.said, _Said(
            approved=tuple(sorted(decisions.approved)), rejected=tuple(sorted(decisions.rejected)),
            forgotten=dict(decisions.forgotten),
        ))  # fmt: skip

    def stamp(self) -> float:
        """When the specialist last said something; 0 for never."""
        with contextlib.suppress(OSError):
            return self.said.stat().st_mtime
        return 0.0


def _read(path: Path, kind: type[Page]) -> Page | None:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read: {error}") from error
    try:
        return TypeAdapter(kind).validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "file"
        raise ConfigurationError(
            f"{path}: {where}: {first['msg']}: move it away to begin without components"
        ) from error


def _write(path: Path, page: StrictModel) -> None:
    try:
        writable(path.parent)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".new")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(page.model_dump_json(indent=2) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        if os.geteuid() == 0:  # the daemon has a user of its own, and must be able to read what root says
            owner = path.parent.stat()
            os.chown(temporary, owner.st_uid, owner.st_gid)
        Path(temporary).replace(path)
    except OSError as error:
        with contextlib.suppress(OSError, UnboundLocalError):
            Path(temporary).unlink()
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error


EVERY = 0.5  # s between two looks at the specialist's file
AGAIN = 30.0  # s after which what the disk did not take is tried once more


class WriterThread:
    """Of one machine. Others exchange values with it and never wait; a newer value takes the place of an older one."""

    def __init__(self, keeper: StateStore, stamp: float) -> None:
        """``stamp`` is of the specialist's word that is known already."""
        self._keeper, self._stamp = keeper, stamp
        self._to_keep: deque[tuple[ComponentRecord, ...]] = deque(maxlen=1)
        self._decisions: deque[OperatorDecisions] = deque(maxlen=1)
        self._wake, self._ends = threading.Event(), threading.Event()
        self._unsaved: tuple[ComponentRecord, ...] | None = None
        self._try_at, self._complaint = 0.0, ""
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def keep(self, components: tuple[ComponentRecord, ...]) -> None:
        """Have ``components`` written in place of those that are on disk."""
        self._to_keep.append(components)
        self._wake.set()

    def new_decisions(self) -> OperatorDecisions | None:
        """What the specialist has said since this was last asked; None for nothing."""
        return self._decisions.popleft() if self._decisions else None

    def stop(self, seconds: float) -> None:
        """Have what is to be kept written for up to ``seconds``, and end the thread."""
        self._ends.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("components may not be kept: the disk has not answered in %.1f s", seconds)

    def _run(self) -> None:
        while True:
            self._wake.wait(EVERY)
            self._wake.clear()
            ends = self._ends.is_set()
            if self._to_keep:
                self._unsaved, self._try_at = self._to_keep.popleft(), 0.0
            if self._unsaved is not None and (ends or time.monotonic() >= self._try_at):
                self._write(self._unsaved)
            if ends:
                return
            self._listen()

    def _write(self, components: tuple[ComponentRecord, ...]) -> None:
        try:
            self._keeper.keep(components)
        except OtolithError as error:  # a full disk must not end the watching
            if str(error) != self._complaint:  # once, however often it is tried
                log.warning("components are not kept: %s", error)
            self._complaint, self._try_at = str(error), time.monotonic() + AGAIN
        else:
            self._complaint, self._unsaved = "", None

    def _listen(self) -> None:
        stamp = self._keeper.stamp()
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._decisions.append(self._keeper.decisions())
        except OtolithError as error:
            log.warning("%s", error)
