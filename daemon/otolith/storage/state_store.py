"""What was learned of a machine and what its operator decided, on disk.

Each file has one writer: the daemon writes the learned state under a lock, the command line writes operator decisions.
"""

import contextlib
import fcntl
import logging
import math
import os
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from otolith.adaptation.fingerprints import (
    configuration_fingerprint,
    model_fingerprint,
    twin_fingerprint,
    values_fingerprint,
)
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import (
    AdaptationState,
    ComponentRecord,
    OperatorDecisions,
    apply_decisions,
    restore_components,
)
from otolith.health.events import HealthState
from otolith.health.labels import TimeLabels
from otolith.health.prognosis import History
from otolith.machine import LoadedMachine
from otolith.storage.decisions import REMEDY, DecisionsFile, read_model, write_model
from otolith.storage.disk import WriterThread, give_to, opened_folder, reason_of
from otolith.storage.learned_state import (
    VERSION,
    LearnedState,
    SavedClock,
    check_components,
    learned_state,
    restored,
    without_found,
)
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.user_dirs import state_directory, way_out

log = logging.getLogger(__name__)

KEPT = ".kept.json"
OTHER_VALUES = "parameters or noise in the machine file have changed since it was saved"
COMPONENTS = "components"  # the folder of the state directory with these files
# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
MAX_KEPT = 8  # files that were not used and are kept under another name
PROCESS_ID_BYTES = 20
DECISIONS_INTERVAL = 0.5  # s between two checks for decisions


class LockedError(ServiceError):
    """Another process has the lock of the state."""


class StateStore:
    """The two state files of one machine, and the lock of its daemon."""

    def __init__(
        self, site: str, machine: str, twin: Definition, folder: Path | None = None, signal_fingerprint: str = ""
    ) -> None:
        """State that was learned from signals with another ``signal_fingerprint`` is refused."""
        self._site, self._machine, self._twin = site, machine, twin
        self._signal_fingerprint = signal_fingerprint
        folder = folder or state_directory() / COMPONENTS
        self.operator = DecisionsFile(folder, site, machine)
        self.components_path, self.lock_path = self.operator.learned_path, self.operator.lock_path
        self.decisions_path = self.operator.path
        self.earlier_path = folder / f"{site}.{machine}.earlier.json"
        """What was saved before, for when the newest file is damaged."""
        self._lock: int | None = None
        self._is_late = False  # Whether the lock could not be taken at the start
        self._is_blocked = False
        self.clock: SavedClock | None = None
        """Of the times in the states that are saved; None for Unix times."""

    def lock(self) -> None:
        """Take the lock until :meth:`unlock` or the end, again if its file was removed.

        Raises LockedError if another process has it, ServiceError if its file cannot be opened.
        """
        with contextlib.suppress(OSError):
            if self._lock is not None and os.path.samestat(self.lock_path.lstat(), os.fstat(self._lock)):
                return
        handle = -1
        try:
            with opened_folder(self.lock_path.parent) as folder:
                handle = os.open(self.lock_path.name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600, dir_fd=folder)
                give_to(os.fstat(folder), handle)
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(handle, PROCESS_ID_BYTES).decode("ascii", "replace").strip()
            os.close(handle)
            used = f"machine {self._machine} at {self._site}: process {holder} of Otolith already uses its state"
            raise LockedError(f"{used}: stop it, or give this machine another name") from error
        except OSError as error:
            if handle >= 0:
                os.close(handle)
            remedy = way_out(self.lock_path)
            raise ServiceError(f"{self.lock_path}: cannot be locked: {error.strerror}{remedy}") from error
        with contextlib.suppress(OSError):  # a full disk: only the message to others lacks the process
            os.pwrite(handle, str(os.getpid()).ljust(PROCESS_ID_BYTES).encode(), 0)
        self.unlock()
        self._lock = handle

    def lock_or_later(self) -> None:
        """Take the lock, or let :meth:`lock_late` take it; raises as :meth:`lock`."""
        self._is_late = True
        self.lock()
        self._is_late = False

    def lock_late(self) -> None:
        """Take the lock that could not be taken at the start; raises as :meth:`lock`.

        What was saved may be what could not be read then, so it is kept under another name.
        """
        if self._is_late:
            self.lock()
            self._is_late = False
            if self.components_path.exists():
                log.warning(
                    "%s: could not be used at the start: kept as %s", self.components_path, self.set_aside().name
                )

    def keep_lock(self) -> None:
        """Take the lock again if this process had it; raises as :meth:`lock`."""
        if self._lock is not None:
            self.lock()

    def unlock(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep the lock meanwhile, and afterwards if this process had it before; raises as :meth:`lock`."""
        had = self._lock is not None
        self.lock()
        try:
            yield
        finally:
            if not had:
                self.unlock()

    def components(self) -> tuple[ComponentRecord, ...]:
        """Return the saved components of this twin in these signals; raise ConfigurationError for a damaged file."""
        if (learned := self._learned()) is None:
            return ()
        try:
            check_components(learned.components, self._twin)
        except ValueError as error:
            raise ConfigurationError(f"{self.components_path}: {error}: {REMEDY}") from error
        return learned.components

    def approved(self) -> tuple[ComponentRecord, ...]:
        """Return the saved components that the operator approved; raises as :meth:`components` if there are any."""
        keys = self.decisions().approved
        return tuple(row for row in self.components() if row.adopted.component.key in keys) if keys else ()

    def decided(self, state: AdaptationState) -> AdaptationState:
        """Return the state before the first window with those components, and without those that are rejected."""
        decisions = self.decisions()
        state = restore_components(state, self.approved())
        return apply_decisions(state, OperatorDecisions(decisions.approved, decisions.rejected))

    def histories(self) -> dict[str, History]:
        """Return the saved histories of parameters of this machine; none as, and raises as :meth:`components`."""
        learned = self._learned()
        return {} if learned is None else dict(learned.health.histories)

    def model(self) -> str:
        """Return the fingerprint of twin and values with which it was learned; empty if none is known.

        Raises as :meth:`components`.
        """
        learned = self._learned()
        return "" if learned is None else model_fingerprint(learned.twin_fingerprint, learned.values_fingerprint)

    def taken(self) -> tuple[str, ...]:
        """Return the ids of the notes that the daemon of this machine has taken over, whatever else it learned."""
        for path in (self.components_path, self.earlier_path):
            with contextlib.suppress(OtolithError):
                learned = read_model(path, LearnedState, VERSION)
                if learned is not None and (learned.machine, learned.site) == (self._machine, self._site):
                    return learned.health.taken
        return ()

    def labels(self) -> TimeLabels:
        """Return the Unix times of the times in the saved state."""
        clock, _ = self.saved_clock()
        return TimeLabels() if clock is None else clock.labels

    def saved_clock(self) -> tuple[SavedClock | None, float]:
        """Return the clock of the saved state, and the service time at which its last window ends, s.

        Without a state of this machine that can be read these are None and minus infinity.
        """
        for path in (self.components_path, self.earlier_path):
            with contextlib.suppress(OtolithError):
                learned = read_model(path, LearnedState, VERSION)
                if learned is not None and not self._other_origin(learned):
                    return learned.clock, -math.inf if learned.filter is None else learned.filter.end
        return None, -math.inf

    def _learned(self) -> LearnedState | None:
        try:
            learned = read_model(self.components_path, LearnedState, VERSION)
        except ConfigurationError as error:
            if not self.earlier_path.exists():
                raise
            log.warning("%s; used is what was saved before it", error)
            learned = read_model(self.earlier_path, LearnedState, VERSION)
        if learned is not None and (reason := self._other_origin(learned)):
            log.warning("%s: not used: %s", self.components_path, reason)
            return None
        return learned

    def _other_origin(self, learned: LearnedState) -> str:
        """Return why ``learned`` is about something else; empty if it is not."""
        if learned.version > 1 and (learned.machine, learned.site) != (self._machine, self._site):
            return f"it is of machine {learned.machine} at {learned.site}"
        if learned.twin != self._twin.name or learned.twin_fingerprint not in ("", twin_fingerprint(self._twin)):
            return "the twin has changed since it was saved"
        if learned.signal_fingerprint and self._signal_fingerprint not in ("", learned.signal_fingerprint):
            return "[signals] have changed since it was saved"
        return ""

    def restore(self, state: AdaptationState) -> tuple[AdaptationState, str]:
        """Return the initial ``state`` with what was saved, and why not all of it was used; empty if it was.

        A file that is not used as a whole is kept under another name. If it is damaged, what was saved before it is
        used. Events of a state that is not used are dropped. That the machine file states other values is no fault: it
        is logged. Requires the lock.
        """
        warm, reason, is_damaged = self._restored(state)
        if not reason:
            return warm, ""
        note = f"{self.components_path}: {'only components are used' if warm.adopted else 'not used'}: {reason}"
        try:
            kept = self.set_aside()
        except OtolithError as error:
            return warm, f"{note}; {error}"
        if reason == OTHER_VALUES:
            stays = "baselines, events and approved components stay"
            log.info("the machine file has new values or noise: estimates begin anew, and %s (%s)", stays, kept.name)
            return warm, ""
        note = f"{note}; the file is kept as {kept.name}"
        if not is_damaged or not self.earlier_path.exists():
            return warm, note
        try:
            self.earlier_path.rename(self.components_path)
        except OSError as error:
            return warm, f"{note}; {self.earlier_path}: cannot be renamed: {error.strerror}"
        saved = datetime.fromtimestamp(self.components_path.stat().st_mtime, UTC)
        warm, other = self.restore(state)
        return warm, f"{note}; {other or f'used is what was saved before it, at {saved:%F %T} UTC'}"

    def peek(self, state: AdaptationState) -> tuple[AdaptationState, str]:
        """Return the same as :meth:`restore`, without the lock and without a change of any file."""
        known, reason, _ = self._restored(state)
        return known, reason

    def _restored(self, state: AdaptationState) -> tuple[AdaptationState, str, bool]:
        """Return the state with what was saved, why not all of it is used, and whether the file is damaged."""
        try:
            learned = read_model(self.components_path, LearnedState, VERSION)
            if learned is None:
                return state, "", False
            if reason := self._other_origin(learned):
                if (learned.machine, learned.site) != (self._machine, self._site):
                    return state, reason, False
                events = (*learned.health.dropped, *learned.health.open_events)
                health = state.health.with_dropped(events, f"what was learned is not used: {reason}")
                # Without what was taken over, the next report would have those notes again.
                health = replace(health, notes=learned.health.notes, taken=learned.health.taken)
                return replace(state, health=health), reason, False
            if learned.configuration_fingerprint not in ("", configuration_fingerprint(state.problem)):
                reason = OTHER_VALUES
                learned = learned.model_copy(update={"filter": None, "health": learned.health.without_hints(reason)})
                if learned.values_fingerprint not in ("", values_fingerprint(state.problem)):
                    learned = without_found(learned, reason)
            return restored(learned, state), reason, False
        except (OtolithError, ValueError, ArithmeticError, LookupError) as error:
            reason = str(error).removeprefix(f"{self.components_path}: ").removesuffix(f": {REMEDY}")
            return state, reason, True

    def set_aside(self) -> Path:
        """Rename the file with what was learned, keep the newest such; raise ServiceError if it cannot be renamed."""
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
        kept = self.components_path.with_name(f"{self.components_path.stem}.{stamp}{KEPT}")
        try:
            self.components_path.rename(kept)
        except OSError as error:
            self._is_blocked = True
            raise ServiceError(f"{self.components_path}: cannot be renamed to {kept.name}: {error.strerror}") from error
        prefix = f"{self.components_path.stem}."
        names = (path for path in kept.parent.iterdir() if path.name.startswith(prefix) and path.name.endswith(KEPT))
        for old in sorted(names, key=lambda path: (path == kept, path.name))[:-MAX_KEPT]:  # whatever the clock is
            with contextlib.suppress(OSError):
                old.unlink()
        return kept

    def save(self, state: AdaptationState) -> None:
        """Write what was learned, all or nothing.

        Raises:
            ServiceError: the file cannot be written, another process has the lock, or the state is not plausible.
        """
        try:
            learned = learned_state(state, self._signal_fingerprint, self.clock)
        except (ValueError, ArithmeticError, LookupError) as error:
            raise ServiceError(f"{self.components_path}: kept as it was: {reason_of(error)}") from error
        self._write_learned(learned)

    def save_components(self, components: tuple[ComponentRecord, ...], taken: tuple[str, ...] = ()) -> None:
        """Write nothing but components and which notes were ``taken`` over; raises as :meth:`save`.

        Resets until now do not concern the components.
        """
        learned = LearnedState(
            machine=self._machine,
            site=self._site,
            twin=self._twin.name,
            signal_fingerprint=self._signal_fingerprint,
            twin_fingerprint=twin_fingerprint(self._twin),
            resets=dict(self.decisions().resets),
            components=components,
            health=HealthState(taken=taken),
        )
        self._write_learned(learned)

    def _write_learned(self, learned: LearnedState) -> None:
        if self._is_blocked:
            raise ServiceError(f"{self.components_path}: not overwritten: it was refused and could not be renamed")
        with self.locked(), self._earlier_kept():
            write_model(self.components_path, learned, f"{self.components_path.name}.new")

    @contextlib.contextmanager
    def _earlier_kept(self) -> Iterator[None]:
        """Give the present file a second name, under which it stays once it is replaced."""
        second = self.earlier_path.with_name(f"{self.earlier_path.name}.new")
        try:
            second.unlink(missing_ok=True)
            os.link(self.components_path, second, follow_symlinks=False)
        except OSError as error:  # nothing was saved yet, or a file system without links: the newest is more important
            log.debug("%s: %s", self.earlier_path, error)
        try:
            yield
            with contextlib.suppress(FileNotFoundError):
                second.replace(self.earlier_path)
        finally:
            with contextlib.suppress(OSError):
                second.unlink()

    def decisions(self) -> OperatorDecisions:
        """Return the operator's decisions; raises as :meth:`DecisionsFile.read`."""
        return self.operator.read()


class StateWriter(WriterThread):
    """Keeps only the latest value in each direction."""

    def __init__(self, store: StateStore, decisions_time: float) -> None:
        """``decisions_time`` is the :meth:`DecisionsFile.time` of the decisions that are known already."""
        super().__init__("writer", DECISIONS_INTERVAL, "what was learned is not saved")
        self._store, self._decisions_time = store, decisions_time
        self._to_save: deque[PackedState] = deque(maxlen=1)
        self._unsaved: PackedState | None = None
        self._new_decisions: deque[OperatorDecisions] = deque(maxlen=1)
        self.locked_out: LockedError | None = None
        """Another process has taken the lock that this one had: its file was removed."""

    def save(self, state: PackedState) -> None:
        """Request that ``state`` replaces what is on disk."""
        self._to_save.append(state)
        self.wake()

    def new_decisions(self) -> OperatorDecisions | None:
        """Return the operator's decisions if they have changed since the last call, otherwise None."""
        return self._new_decisions.popleft() if self._new_decisions else None

    def write(self) -> None:
        """Save the latest state; take the lock first if it could not be taken at the start."""
        try:
            self._store.lock_late()
        except LockedError as error:
            self.locked_out = error
            return
        if self._to_save:
            self._unsaved = self._to_save.popleft()
        if self._unsaved is not None:
            self._store.save(self._unsaved.unpack())
            self._unsaved = None

    def read(self) -> None:
        """Read the decisions if their file has changed; take the lock again if its file was removed."""
        try:
            self._store.keep_lock()
        except LockedError as error:
            self.locked_out = error
        except OtolithError as error:  # the next save fails as well, and is logged
            log.debug("%s", error)
        decisions_time = self._store.operator.time()
        if decisions_time == self._decisions_time:
            return
        self._decisions_time = decisions_time
        try:
            self._new_decisions.append(self._store.decisions())
        except OtolithError as error:
            log.warning("%s", error)


def is_served(site: str, machine: str) -> bool:
    """Return whether a daemon of this state directory serves a machine."""
    path = DecisionsFile(state_directory() / COMPONENTS, site, machine).lock_path
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(handle)
    return False


def store_of(machine: LoadedMachine, state: Path | None = None) -> StateStore:
    """Return the store of a machine in the state directory ``state``; in that of this user without one."""
    names, folder = machine.file.machine, None if state is None else state / COMPONENTS
    return StateStore(names.site, names.name, machine.twin, folder, signal_fingerprint=machine.signal_fingerprint)
