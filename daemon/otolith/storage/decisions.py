"""What the operator decided about a machine, on disk: components, resets, baselines, and notes on events.

The command line writes the file, and a running daemon reads it. State files are read and written by the same functions.
"""

import contextlib
import fcntl
import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TypeVar

from pydantic import Field

from otolith.adaptation.state import OperatorDecisions
from otolith.health.notes import OperatorNote
from otolith.health.prognosis import Baseline
from otolith.storage.disk import opened_folder, reason_of, replace_file
from otolith.storage.learned_state import VERSION, LearnedState, check_version
from otolith_drivers.config_files import StrictModel, content
from otolith_drivers.errors import ConfigurationError, ServiceError

DECISIONS_VERSION = 4
LOCKS = Path("/proc/locks")
REMEDY = "move the file away to start without it"
MAX_WAITING_NOTES = 100  # notes that no daemon has taken over; docs/reference/thresholds-storage.md has the origin
MAX_STATE_BYTES = 8 * 1024 * 1024  # docs/reference/thresholds-storage.md has the origin

Decide = Callable[[OperatorDecisions], OperatorDecisions]
StateModel = TypeVar("StateModel", bound=StrictModel)


def unchanged(decisions: OperatorDecisions) -> OperatorDecisions:
    """Return the decisions."""
    return decisions


class _DecisionsContent(StrictModel):
    """The operator's decisions, written by the command line. Times are Unix times, but those of ended events."""

    version: int = DECISIONS_VERSION
    approved: tuple[str, ...] = ()
    rejected: tuple[str, ...] = ()
    forgotten: dict[str, float] = Field(default_factory=dict)
    resets: dict[str, float] = Field(default_factory=dict)
    baselines: dict[str, Baseline] = Field(default_factory=dict)
    notes: tuple[OperatorNote, ...] = ()


class DecisionsFile:
    """The decisions about one machine, and what its daemon has made of them."""

    def __init__(self, folder: Path, site: str, machine: str) -> None:
        self.path = folder / f"{site}.{machine}.decisions.json"
        self.learned_path = folder / f"{site}.{machine}.json"
        """What the daemon has learned, with the events that it saved."""
        self.lock_path = folder / f"{site}.{machine}.lock"
        """The daemon has its lock while it runs."""

    def read(self) -> OperatorDecisions:
        """Return the operator's decisions; raise ConfigurationError if the file is unreadable or damaged."""
        file = read_model(self.path, _DecisionsContent, DECISIONS_VERSION) or _DecisionsContent()
        return OperatorDecisions(
            frozenset(file.approved), frozenset(file.rejected), file.forgotten, file.resets, file.baselines, file.notes
        )

    def write(self, decisions: OperatorDecisions) -> None:
        """Write the decisions, which a running daemon applies with its next window; raise ServiceError if it cannot."""
        keys = {"approved": sorted(decisions.approved), "rejected": sorted(decisions.rejected)}
        file = _DecisionsContent.model_validate({**asdict(decisions), **keys})
        write_model(self.path, file, f"{self.path.name}.{os.getpid()}.new")

    def change(self, changed: Decide) -> None:
        """Write what ``changed`` returns for the decisions; two commands at once do not lose what the other wrote.

        Raises as :meth:`read` and :meth:`write`.
        """
        try:
            with opened_folder(self.path.parent) as folder:
                fcntl.flock(folder, fcntl.LOCK_EX)  # until it is closed
                self.write(changed(self.read()))
        except OSError as error:
            raise ServiceError(f"{self.path.parent}: cannot be used: {error.strerror}") from error

    def note(
        self,
        noted: Callable[[Sequence[OperatorNote]], OperatorNote],
        taken: Collection[str],
        decided: Decide = unchanged,
    ) -> None:
        """Add the note that ``noted`` returns for those that wait for the daemon; it has taken over those ``taken``.

        With it, what ``decided`` returns for the decisions is written. Raises as :meth:`change`, and ConfigurationError
        if too many notes wait.
        """

        def changed(decisions: OperatorDecisions) -> OperatorDecisions:
            waiting = tuple(each for each in decisions.notes if each.id not in taken)
            if len(waiting) >= MAX_WAITING_NOTES:
                raise ConfigurationError(f"{self.path}: {MAX_WAITING_NOTES} notes wait for the daemon: start it")
            return replace(decided(decisions), notes=(*waiting, noted(waiting)))

        self.change(changed)

    def learned(self) -> LearnedState | None:
        """Return what the daemon has learned, None without a file; raises as :meth:`read`."""
        return read_model(self.learned_path, LearnedState, VERSION)

    def is_obeyed(self) -> bool:
        """Whether a daemon runs for the machine; asking does not keep one from starting."""
        with contextlib.suppress(OSError):
            inode, locks = self.lock_path.stat().st_ino, LOCKS.read_text(encoding="ascii", errors="replace")
            return any(f":{inode} " in line and " FLOCK " in line for line in locks.splitlines())
        return False

    def time(self) -> float:
        """Return the Unix time of the latest decision, s; 0 if there is none."""
        with contextlib.suppress(OSError):
            return self.path.stat().st_mtime
        return 0.0


def read_model(path: Path, model: type[StateModel], newest: int) -> StateModel | None:
    """Return the content of a file; None without a file.

    Raises:
        ConfigurationError: it is unreadable, damaged, or of a version after the ``newest``.
    """
    try:
        if not path.exists():
            return None
        text = content(path, MAX_STATE_BYTES).decode()
        check_version(text, newest)
        return model.model_validate_json(text)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ConfigurationError(f"{path}: {reason_of(error)}: {REMEDY}") from error


def write_model(path: Path, model: StrictModel, temporary: str) -> None:
    """Replace a file as :func:`replace_file` does."""
    data = (model.model_dump_json() + "\n").encode()
    if len(data) > MAX_STATE_BYTES:
        raise ServiceError(f"{path}: not written: larger than {MAX_STATE_BYTES} bytes")
    replace_file(path, data, temporary)
