"""A batch of replays: the recordings of each machine in their order, and several machines at the same time.

The recordings of a machine are a chain of tasks, of which each begins at the checkpoint of the one before. If a worker
ends, its task is computed again; a batch that is started again begins at the checkpoints in its folder.
"""

import hashlib
import json
import logging
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from otolith.adaptation.fingerprints import twin_fingerprint
from otolith.adaptation.state import AdaptationState
from otolith.machine import LoadedMachine
from otolith.runtime.batch.outputs import MachineOutput, OutputFormat
from otolith.runtime.batch.task import MAX_TASK_FILES, ReplayOutcome, ReplayTask, first_checkpoint, libraries, unpacked
from otolith.storage.exact_json import encoded
from otolith_drivers.errors import ConfigurationError, OtolithError

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
TASK_SECONDS = 10.0  # s of computing in a task, at the end of which a checkpoint is kept
MAX_ATTEMPTS = 3  # of a task whose worker ends


class Workers(Protocol):
    """What computes tasks: processes of this computer, or a cluster."""

    @property
    def room(self) -> int:
        """Number of tasks that can be submitted now."""

    def submit(self, key: str, task: ReplayTask) -> None:
        """Let a worker compute a task."""

    def finished(self) -> list[tuple[str, ReplayOutcome | None, str]]:
        """Wait for a moment, and return what was finished: key, outcome, and why there is none."""

    def close(self) -> None:
        """Let all tasks go."""


@dataclass(slots=True)
class MachineReplay:
    """The recordings of one machine, and how far they are replayed."""

    machine: LoadedMachine
    files: tuple[Path, ...]
    output: MachineOutput
    read: int = 0  # Files that were read to their end
    attempts: int = 0  # Of the present task
    failure: str = ""
    begin: bytes = field(default=b"", repr=False)

    @property
    def key(self) -> str:
        """Site and name of the machine."""
        return key_of_machine(self.machine)

    @property
    def is_over(self) -> bool:
        """Whether nothing more is to be computed."""
        return self.output.is_done or bool(self.failure)

    def task(self, seconds: float) -> ReplayTask:
        """Return the next task."""
        files = self.files[self.read : self.read + MAX_TASK_FILES]
        is_end = self.read + len(files) == len(self.files)
        return ReplayTask(self.machine.path.absolute(), files, is_end, self.begin, seconds)

    def take(self, outcome: ReplayOutcome) -> None:
        """Keep an outcome; raise as :meth:`MachineOutput.keep`."""
        self.output.keep(outcome)
        self.attempts, self.failure, self.begin = 0, outcome.failure, outcome.checkpoint
        self.read = unpacked(self.machine, outcome.checkpoint).position.files


def key_of_machine(machine: LoadedMachine) -> str:
    """Return site and name of a machine, with a point between."""
    return f"{machine.file.machine.site}.{machine.file.machine.name}"


def machine_replay(
    machine: LoadedMachine, state: AdaptationState, files: Sequence[Path], folder: Path, kind: OutputFormat
) -> MachineReplay:
    """Return the replay of ``files`` from ``state`` on, or from the checkpoint in ``folder``.

    Raises:
        ConfigurationError: a file cannot be used, or the checkpoint is of other files, another state or version.
    """
    whole = tuple(path.absolute() for path in files)
    estimated = [parameter.label for parameter in machine.problem.free]
    output = MachineOutput(folder, key_of_machine(machine), kind, _origin(machine, state, whole), estimated)
    if output.checkpoint is None:
        begin = first_checkpoint(machine, state, whole)
        return MachineReplay(machine, whole, output, begin=begin.packed())
    position = unpacked(machine, output.checkpoint).position
    return MachineReplay(machine, whole, output, position.files, begin=output.checkpoint)


def _origin(machine: LoadedMachine, state: AdaptationState, files: Sequence[Path]) -> str:
    """Return a hash of all that the reports depend on."""
    found = []
    for path in files:
        try:
            status = path.stat()
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from error
        found.append((str(path), status.st_size, status.st_mtime_ns))
    known = {name: version for name, version in libraries().items() if name != "processor"}
    parts = [encoded(state), twin_fingerprint(machine.twin), machine.signal_fingerprint, found, known]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def run_batch(
    replays: Sequence[MachineReplay],
    workers: Workers,
    stopped: Callable[[], bool],
    show: Callable[[Sequence[MachineReplay]], None],
    seconds: float = TASK_SECONDS,
) -> None:
    """Replay all machines, in the order of ``replays`` and then in turns; ``show`` is called after each task.

    Raises:
        OtolithError: the output cannot be written, or the workers are gone.
    """
    waiting = deque(item for item in replays if not item.is_over)
    computed = dict[str, MachineReplay]()
    while (waiting or computed) and not stopped():
        while waiting and workers.room:
            item = waiting.popleft()
            computed[item.key] = item
            item.attempts += 1
            workers.submit(item.key, item.task(seconds))
        for key, outcome, reason in workers.finished():
            item = computed.pop(key)
            if outcome is not None:
                item.take(outcome)
            elif item.attempts >= MAX_ATTEMPTS:
                item.failure = f"{reason}, {item.attempts} times"
            else:
                log.warning("%s: %s: a part of its recordings is computed again", key, reason)
            if not item.is_over:
                waiting.append(item)
            show(replays)


def raise_failures(replays: Sequence[MachineReplay]) -> None:
    """Raise an error that names each machine whose recordings could not be replayed to their end."""
    failures = [f"{item.key}: {item.failure}" for item in replays if item.failure]
    if failures:
        raise OtolithError("\n".join(failures))
