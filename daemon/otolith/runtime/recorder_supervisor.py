"""The recorder process, supervised: restarted when it has died or hangs, and paused while the disk is full."""

import logging
import math
import os
import time
from pathlib import Path

from otolith.health.schema import Report
from otolith.machine import LoadedMachine
from otolith.runtime.process import ChildProcess
from otolith.storage.recording_files import DAY, GIGABYTE, MEGABYTE, RESUME_FACTOR, RecordingBudget, RecordingFolder
from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import writable

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
RECORDER_ROOM = 32  # windows that wait for the recorder
RECORDER_HEALTHY_AGE = 60.0  # s after which the restart pause of the recorder is reset
RECORDER_TIMEOUT = 60.0  # s without an answer, while windows wait, after which the recorder hangs
FORBIDDEN = {"0", "false", "off"}  # values of RERUN that switch its logging off
MIN_FILES = 8  # files that the budget has room for at least


class RecorderSupervisor:
    """The recorder of one machine. Times are monotonic, s."""

    def __init__(self, machine: LoadedMachine, path: Path | None = None) -> None:
        """The first recording is ``path`` instead of files in the folder of the machine."""
        self._machine, self._path = machine, path
        self._process = ChildProcess("otolith-recorder", "otolith.publishing.recorder:main", RECORDER_ROOM)
        self._unanswered = self._unwritten = 0
        self._planned_starts = 1
        self._progress_at = 0.0
        self._problem = ""
        self._first: tuple[object, ...] | None = None  # arguments of the process, until it is spawned
        self.dropped = 0  # Windows that were not recorded

    @property
    def is_enabled(self) -> bool:
        """Whether the machine file wants recordings, and Rerun's variable of the environment does not forbid them."""
        return self._machine.file.recording.enabled and os.environ.get("RERUN", "").lower() not in FORBIDDEN

    @property
    def restarts(self) -> int:
        """How often the recorder was started again."""
        return max(0, self._process.starts - self._planned_starts)

    def start(self, now: float) -> None:
        """Start the recorder with a new file, if the disk has room; raise ServiceError for a file the caller named.

        The first process is spawned for the first window: it would take time from the worker, which starts as well.
        A folder that refuses is logged and tried again: monitoring goes on without recordings.
        """
        try:
            self._start(now)
        except (OtolithError, OSError) as error:
            if self._path is not None and not self._process.starts:
                raise
            self._pause(f"no recording: {error}")

    def _start(self, now: float) -> None:
        path, folder = self._path, None
        if path is None or self._process.starts:  # a restarted recorder must not overwrite its first file
            folder = self._folder()
            path = folder.new_path(time.time())
            is_first = not self._process.starts and not self._problem
            missing = folder.make_room(time.time(), factor=1.0 if is_first else RESUME_FACTOR)
            if missing > 0:
                self._pause(f"recording pauses until {path.parent} has {math.ceil(missing / 1e6)} MB more free")
                return
        writable(path.parent)
        arguments = (path, self._machine.recorded(self._machine.driver.sampling), folder)
        if self._process.starts:
            self._process.start(*arguments)
        else:
            self._first = arguments
        self._progress_at, self._problem = now, ""
        log.info("recording to %s", path)

    def reload(self, machine: LoadedMachine, now: float, seconds: float) -> None:
        """Go on with a new file and the changed machine file; the old one is finished in up to ``seconds``."""
        self._process.stop(seconds)
        self._unanswered = self._unwritten = 0
        self._machine, self._first = machine, None
        if self.is_enabled:
            self._planned_starts += self._process.starts >= self._planned_starts
            self.start(now)

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

    def offer(self, report: Report, now: float) -> None:
        """Give the recorder a window, without waiting."""
        if self._first is not None:
            self._process.start(*self._first)
            self._first = None
        if not (self._process.alive and self._process.offer(report)):
            self.dropped += 1
            return
        if not self._unanswered:
            self._progress_at = now
        self._unanswered += 1

    def poll(self, now: float) -> None:
        """Read answers, kill a recorder that hangs, and restart one that has ended."""
        if self._first is not None:
            return
        for waiting in self._process.replies():
            self._unanswered, self._unwritten, self._progress_at = max(0, self._unanswered - 1), waiting, now
        if self._process.alive and self._unanswered and now - self._progress_at > RECORDER_TIMEOUT:
            log.warning("the recorder has not answered for %g s and is killed", now - self._progress_at)
            self._process.kill()
        if self._process.alive:
            if self._process.age > RECORDER_HEALTHY_AGE:
                self._process.reset_backoff()
            return
        self.dropped += self._unanswered + self._unwritten
        self._unanswered = self._unwritten = 0
        if self._process.may_restart(now):
            self.start(now)

    def stop(self, seconds: float) -> None:
        """Let the recorder write what it has for up to ``seconds``."""
        self._process.stop(seconds)

    def _pause(self, problem: str) -> None:
        """Wait for the restart pause; a problem that continues is logged once."""
        if not self._problem:
            log.warning("%s", problem)
        self._problem = problem
        self._process.count_failed_start()
