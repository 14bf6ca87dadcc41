"""The recorder process under supervision: restarted when it has died or hangs, and paused while the disk is full.

Its folder is looked at, and older recordings deleted, by a thread: the main thread waits for no disk.
"""

import logging
import math
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from otolith.health.schema import Report
from otolith.runtime.effort import Effort
from otolith.runtime.hall.recorder_process import RECORDER_ROOM, RecorderProcess
from otolith.storage.recording_files import (
    DAY,
    GIGABYTE,
    MEGABYTE,
    RESUME_FACTOR,
    Opened,
    RecordingBudget,
    RecordingFolder,
)
from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import writable

if TYPE_CHECKING:  # slow to import
    from otolith.machine import LoadedMachine

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
RECORDER_HEALTHY_AGE = 60.0  # s after which the restart pause of the recorder is reset
RECORDER_TIMEOUT = 60.0  # s of effort without an answer, while windows wait, after which the recorder hangs
FOLDER_TIMEOUT = 60.0  # s without an answer of the disk after which it hangs
MIN_DEATHS = 4  # of the recorder in a row, from which it is out of order and not restarted by chance
MIN_FILES = 8  # files that the budget has room for at least
FORBIDDEN = {"0", "false", "off"}  # values of RERUN that switch its logging off


class _Preparation:
    """Makes room for a new file in a thread of its own."""

    def __init__(self, prepare: Callable[[], tuple[Path, int]], now: float) -> None:
        self.begun = now
        self.path: Path | None = None
        self.problem = ""
        self._prepare = prepare
        self._thread = threading.Thread(target=self._run, name="recorder-folder", daemon=True)
        self._thread.start()

    @property
    def is_done(self) -> bool:
        """Whether there is a path, or a problem."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            path, missing = self._prepare()
        except (OtolithError, OSError) as error:
            self.problem = f"no recording: {error}"
            return
        if missing > 0:
            self.problem = f"recording pauses until {path.parent} has {math.ceil(missing / 1e6)} MB more free"
        else:
            self.path = path


class RecorderSupervisor:
    """The recorder of one machine. Times are monotonic, s."""

    def __init__(
        self, machine: "LoadedMachine", path: Path | None = None, process: RecorderProcess | None = None
    ) -> None:
        """The first recording is ``path`` instead of files in the folder of the machine.

        Several machines may share a ``process``.
        """
        self._machine, self._path = machine, path
        self._whole = RecorderProcess() if process is None else process
        identity = machine.file.machine
        self._process = self._whole.share(f"{identity.site}.{identity.name}")
        self._preparation: _Preparation | None = None
        self._early: list[Report] = []  # Windows since the start of the preparation of the first file
        self._unanswered = self._unwritten = 0
        self._planned_starts = 1
        self._effort = Effort()  # since the last answer
        self._problem = ""
        self._first: Opened | None = None  # What the process is started with, until it is spawned
        self.dropped = 0  # Windows that were not recorded

    @property
    def is_enabled(self) -> bool:
        """Whether the machine file wants recordings, and Rerun's variable of the environment does not forbid them."""
        return self._machine.file.recording.enabled and os.environ.get("RERUN", "").lower() not in FORBIDDEN

    @property
    def outage(self) -> str:
        """Why nothing is recorded; empty if something is, or should not be.

        A recorder that always dies also lives for a moment each time: it works again once its pause is reset.
        """
        ended = f"the recorder has ended {self._process.deaths} times" if self._process.deaths >= MIN_DEATHS else ""
        return (self._problem or ended) if self.is_enabled else ""

    @property
    def restarts(self) -> int:
        """How often the recorder was started again."""
        return max(0, self._process.starts - self._planned_starts)

    def start(self, now: float) -> None:
        """Start the recorder with a new file, if the disk has room; raise ServiceError for a file the caller named.

        The first process is spawned for the first window: it would take time from the worker, which starts as well.
        A folder that refuses is logged and tried again: monitoring goes on without recordings.
        """
        if self._path is not None and not self._process.starts:  # a restarted recorder must not overwrite it
            writable(self._path.parent)
            self._launch(self._path, None, now)
            return
        folder, factor = self._folder(), RESUME_FACTOR if self._process.starts or self._problem else 1.0

        def prepare() -> tuple[Path, int]:
            path = folder.new_path(time.time())
            missing = folder.make_room(time.time(), factor=factor)
            writable(path.parent)
            return path, missing

        self._preparation = _Preparation(prepare, now)

    def reload(self, machine: "LoadedMachine", now: float) -> None:
        """Go on with a new file and the changed machine file; the old one is finished."""
        self._process.finish()
        self._unanswered = self._unwritten = 0
        self._machine, self._first, self._preparation = machine, None, None
        if self.is_enabled:
            self._planned_starts += self._process.starts >= self._planned_starts
            self.start(now)

    def offer(self, report: Report, now: float) -> None:
        """Give the recorder a window, without waiting."""
        self._take_preparation(now)
        if self._preparation is not None and not self._problem and len(self._early) < RECORDER_ROOM:
            self._early.append(report)
            return
        if self._first is not None:
            self._process.start(self._first)
            self._first = None
        self._give(report, now)

    def poll(self, now: float) -> None:
        """Read answers, kill a recorder that hangs, and restart one that has ended."""
        if self._take_preparation(now) or self._first is not None:
            return
        for waiting in self._process.replies():
            self._unanswered, self._unwritten = max(0, self._unanswered - 1), waiting
            self._effort.begin(now, self._process.processor_time)
        if self._process.alive and self._unanswered:
            seconds = self._effort.seconds(now, self._process.processor_time)
            if seconds > RECORDER_TIMEOUT:
                what = "the recorder has not answered in"
                log.warning("%s %g s of processor time and waiting, and is killed", what, seconds)
                self._process.kill()
        if self._process.alive:
            if self._process.age > RECORDER_HEALTHY_AGE:
                self._process.reset_backoff()
            return
        self.dropped += self._unanswered + self._unwritten
        self._unanswered = self._unwritten = 0
        if self._process.may_restart(now):
            self.start(now)

    def finish(self) -> None:
        """Record no more; what waits is written."""
        self._process.finish()

    def stop(self, seconds: float) -> None:
        """Let the recorder write what it has for up to ``seconds``."""
        self._whole.stop(seconds)

    def _give(self, report: Report, now: float) -> None:
        if not (self._process.alive and self._process.offer(report)):
            self.dropped += 1
            return
        if not self._unanswered:
            self._effort.begin(now, self._process.processor_time)
        self._unanswered += 1

    def _take_preparation(self, now: float) -> bool:
        """Go on with the folder once it is prepared; return whether it is still awaited."""
        if (done := self._preparation) is None:
            return False
        if not done.is_done:
            if now - done.begun > FOLDER_TIMEOUT:
                self._complain(f"no recording: {self._machine.recording_folder}: the disk does not answer")
            return True
        self._preparation = None
        if done.path is None:
            self._complain(done.problem)
            self._process.count_failed_start()
        else:
            self._launch(done.path, self._folder(), now)
        return False

    def _launch(self, path: Path, folder: RecordingFolder | None, now: float) -> None:
        arguments = Opened(path, self._machine.recorded(self._machine.driver.sampling), folder)
        self._effort.begin(now, self._process.processor_time)
        if self._problem:  # its deaths were failures of the disk, which works again
            self._process.reset_backoff()
        self._problem = ""
        log.info("recording to %s", path)
        if self._process.starts or self._early:
            self._process.start(arguments)
        else:
            self._first = arguments
        early, self._early = self._early, []
        for report in early:
            self._give(report, now)

    def _complain(self, problem: str) -> None:
        """Note a problem, and log it once while there is one."""
        if not self._problem:
            log.warning("%s", problem)
        self._problem = problem
        self.dropped += len(self._early)
        self._early = []

    def _folder(self) -> RecordingFolder:
        identity, table = self._machine.file.machine, self._machine.file.recording
        largest = table.max_gigabytes * GIGABYTE
        budget = RecordingBudget(
            max_bytes=largest,
            max_age=table.max_days * DAY,
            rotate_bytes=min(table.rotate_megabytes * MEGABYTE, largest / MIN_FILES),
            rotate_age=table.rotate_minutes * 60.0,
        )
        key = f"{identity.site}.{identity.name}"
        return RecordingFolder(self._machine.recording_folder, key, budget, set_mode=table.folder is None)
