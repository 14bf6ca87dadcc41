"""A part of a machine's recordings, replayed by a worker: what it is sent, and what it returns.

A worker opens files and writes none. Whoever keeps the outcome, with the checkpoint in it, can have it continued by any
other worker, or repeated: the reports are the same.
"""

import contextlib
import json
import os
import signal
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from otolith.adaptation.state import AdaptationState
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.replay import FileTimes, check_times, open_recorded
from otolith.runtime.segment import Player, ReplayState, Samples, first_state, replay_segment
from otolith.storage.evidence import versions
from otolith.storage.exact_json import Decoder, encoded
from otolith_drivers.base import sampling_of
from otolith_drivers.errors import ConfigurationError, OtolithError
from otolith_drivers.outside_text import visible
from otolith_drivers.replay.joined import JoinedReader, Position

VERSION = 1  # of a checkpoint: raised when it has other fields
LOADED = 64  # machines that a worker keeps loaded
MAX_REASON = 300  # characters of the error of a library
# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_CHECKPOINT_BYTES = 1 << 30  # unpacked
MAX_REPORT_BYTES = 16 << 20  # of reports in one outcome, after which the rest is another task
MAX_TASK_FILES = 500
TASK_TIMEOUT = 1800.0  # s of processor time of a task, with kernels to compile; then its worker ends
TASK_WAIT = 6 * TASK_TIMEOUT  # s; the same if it waits, also for a processor

_alone = threading.Lock()  # a worker of a cluster may have several threads


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """How far the recordings of a machine were replayed, and all that the rest needs."""

    version: int
    position: Position
    times: FileTimes
    state: ReplayState
    is_done: bool = False

    def packed(self) -> bytes:
        """Return it as bytes."""
        return zlib.compress(encoded(self).encode(), 1)


def unpacked(machine: LoadedMachine, data: bytes) -> Checkpoint:
    """Return a checkpoint of ``machine``; raise ConfigurationError if it is damaged or of another version."""
    try:
        return _unpacked(machine, data)
    except Exception as error:  # of any type, from content that is damaged or forged
        text = visible((str(error) or type(error).__name__).splitlines()[0], MAX_REASON)
        fault = f"a checkpoint of {machine.title} that is damaged, or of another version: {text}"
        raise ConfigurationError(fault) from error


def _unpacked(machine: LoadedMachine, data: bytes) -> Checkpoint:
    stream = zlib.decompressobj()
    content: dict[str, Any] = json.loads(stream.decompress(data, MAX_CHECKPOINT_BYTES))
    if (number := content["version"]) != VERSION or not stream.eof:
        raise ValueError(f"version {number!r:.20} of the format: this Otolith reads {VERSION}")
    checkpoint: Checkpoint = Decoder(machine.twin).decode(Checkpoint, content)
    return checkpoint


@dataclass(frozen=True, slots=True)
class ReplayTask:
    """A part of the recordings of a machine that begins where a checkpoint ends."""

    machine: Path
    files: tuple[Path, ...]  # From the position of the checkpoint on
    is_end: bool  # Whether no file comes after them
    checkpoint: bytes
    seconds: float  # Of computing, after which the rest is another task


@dataclass(frozen=True, slots=True)
class ReplayOutcome:
    """The reports of a task in their order, and where the next task begins."""

    reports: tuple[str, ...]  # JSON
    warnings: tuple[str, ...]  # Of the files that were read to their end, and at the end of all files of the rest
    checkpoint: bytes
    is_done: bool  # Whether all files were replayed to their end
    failure: str = ""  # Why the files cannot be replayed after these reports; empty if they can


def perform_task(task: ReplayTask) -> ReplayOutcome:
    """Return the outcome of a task.

    Raises:
        ConfigurationError: the machine file or the checkpoint cannot be used here.
    """
    with _alone, limited(TASK_TIMEOUT, TASK_WAIT):
        machine = _loaded(task.machine, task.machine.stat().st_mtime_ns)
        return _perform(machine, task, unpacked(machine, task.checkpoint))


@contextlib.contextmanager
def limited(computing: float, waiting: float) -> Iterator[None]:
    """End this process if the block takes more seconds of processor time, or in all.

    The kernel does it by signals, as no thread of Python runs while a library computes and does not let it.
    """
    timers = {signal.ITIMER_PROF: computing, signal.ITIMER_REAL: waiting}
    try:
        for timer, seconds in timers.items():
            signal.setitimer(timer, seconds)
        yield
    finally:
        for timer in timers:
            signal.setitimer(timer, 0.0)


def first_checkpoint(machine: LoadedMachine, state: AdaptationState, files: Sequence[Path]) -> Checkpoint:
    """Return the checkpoint before the first file, which is opened for what its times mean.

    Raises:
        ConfigurationError: the file cannot be used.
    """
    with open_recorded(machine, files[0]) as data:
        begin = replace(first_state(machine, data.sampling), adaptation=state)
    return Checkpoint(VERSION, Position(), FileTimes(machine.file.window.length), begin)


def libraries() -> dict[str, str]:
    """Return the versions on which the last bit of a report may depend, and whether the algebra has one thread."""
    return {**versions(), "OPENBLAS_NUM_THREADS": os.environ.get("OPENBLAS_NUM_THREADS", "")}


@lru_cache(LOADED)
def _loaded(path: Path, _: int) -> LoadedMachine:
    machine = load_machine(path, with_driver=False)
    machine.try_fmu()
    return machine


def _perform(machine: LoadedMachine, task: ReplayTask, begin: Checkpoint) -> ReplayOutcome:
    reports, warnings, checkpoint, failure = list[str](), list[str](), begin, ""
    length, deadline, is_whole = machine.file.window.length, time.monotonic() + task.seconds, False
    try:
        with JoinedReader(task.files, lambda path: open_recorded(machine, path), begin.position) as data:
            _require_sampling(machine, data, begin)
            for rows in data.chunks():
                is_first, times = data.begins, replace(checkpoint.times)
                times.add(data.file, rows, is_first=is_first)
                if is_first:
                    check_times(data, rows, length)
                done, state = replay_segment(machine, [Samples(rows, data.lost)], checkpoint.state)
                reports += [report.document.to_json() for report in done]
                checkpoint = replace(checkpoint, position=data.position, times=times, state=state)
                if time.monotonic() > deadline or sum(map(len, reports)) > MAX_REPORT_BYTES:
                    break
            else:
                checkpoint, is_whole = replace(checkpoint, position=data.position), task.is_end
            warnings += data.told
            if is_whole:
                last = replace(checkpoint.state, lost=data.lost)
                done, state = replay_segment(machine, (), last, is_last=True)
                player = Player(machine, state)
                if not state.windows:
                    raise ConfigurationError(f"{data.path}: {player.why_no_window()}")
                reports += [report.document.to_json() for report in done]
                warnings += [*checkpoint.times.warnings(), *player.warnings(data.place)]
                checkpoint = replace(checkpoint, state=state, is_done=True)
    except OtolithError as error:
        failure = str(error)
    return ReplayOutcome(tuple(reports), tuple(warnings), checkpoint.packed(), checkpoint.is_done, failure)


def _require_sampling(machine: LoadedMachine, data: JoinedReader, begin: Checkpoint) -> None:
    """Raise ConfigurationError if the times of the files mean something else than those of the files before."""
    for name, kind in begin.state.sampling.items():
        if (own := sampling_of(data.sampling, name)) != kind:
            kinds = f"{name} has {own} times, but {kind} ones in the files before"
            raise ConfigurationError(f"{data.path}: {kinds}: replay {machine.title} apart")
