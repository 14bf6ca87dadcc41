"""The processes that the daemon starts: children of its own, the recorder, and the command that runs for each event.

A child may die at any moment without harm to the daemon. A child process is spawned, not forked, because a fork copies
only part of the threads of Zenoh and Rerun. It communicates over one pipe, on which the daemon never waits, and ends by
itself when the daemon has died. The recorder is supervised: restarted when it has died or hangs, and paused while the
disk is full.
"""

import contextlib
import json
import logging
import math
import multiprocessing
import multiprocessing.connection
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from otolith.health.schema import EventDocument, Report
from otolith.storage.recording_files import DAY, GIGABYTE, MEGABYTE, RESUME_FACTOR, RecordingBudget, RecordingFolder
from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import writable

if TYPE_CHECKING:  # each child imports this module
    from otolith.machine import LoadedMachine

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
FIRST_RESTART_PAUSE = 0.5  # s before the second restart in a row; the first restart is immediate
MAX_RESTART_PAUSE = 30.0  # s; the pause doubles with each further restart up to this
KILL_WAIT = 1.0  # s for the kernel to end a killed process
MAX_RUNNING = 2  # commands at a time
MAX_WAITING_EVENTS = 64  # events that wait for a command; later ones are dropped and counted
COMMAND_TIMEOUT = 30.0  # s until a command is killed with all processes of its session
RECORDER_ROOM = 32  # windows that wait for the recorder
RECORDER_HEALTHY_AGE = 60.0  # s after which the restart pause of the recorder is reset
RECORDER_TIMEOUT = 60.0  # s without an answer, while windows wait, after which the recorder hangs
MIN_DEATHS = 4  # of the recorder in a row, from which it is out of order and not restarted by chance
FORBIDDEN = {"0", "false", "off"}  # values of RERUN that switch its logging off
MIN_FILES = 8  # files that the budget has room for at least
PRIVATE_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")  # With them a command could notify systemd
SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


def _run_main(connection: Any, main: str, arguments: Sequence[Any]) -> None:
    module, function = main.split(":")
    try:
        with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the daemon has died
            getattr(import_module(module), function)(connection, *arguments)
    except OSError as error:  # of a disk or a file; the process is started again
        sys.exit(f"{multiprocessing.current_process().name}: {error}")


def _send_queued(outbox: queue.Queue[Any], connection: multiprocessing.connection.Connection) -> None:
    with connection, contextlib.suppress(OSError, ValueError):
        connection.send(message := outbox.get())
        while message is not None:
            connection.send(message := outbox.get())


class ChildProcess:
    """Runs ``main``, written ``module:function``, as ``function(connection, *arguments)`` in a child process.

    Only the child imports the module. At most ``room`` messages wait for it.
    """

    def __init__(self, name: str, main: str, room: int) -> None:
        self.name = name
        self.starts = 0
        self._main, self._room = main, room
        self._deaths = 0
        self._started_at = 0.0
        self._restart_at: float | None = None
        self._process: Any = None
        self._connection: Any = None
        self._outbox: queue.Queue[Any] = queue.Queue(room)

    def start(self, *arguments: Any) -> None:
        """Spawn the process; messages for an earlier one are dropped. A failure to spawn counts as a death."""
        self._release()
        self.starts += 1
        self._restart_at, self._started_at = None, time.monotonic()
        try:
            self._spawn(arguments)
        except (OSError, RuntimeError) as error:  # out of descriptors, processes, threads or memory: may be temporary
            log.warning("process %s cannot be started: %s", self.name, error)
            self._release()

    def _spawn(self, arguments: Sequence[Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        try:
            self._outbox = queue.Queue(self._room)
            process = context.Process(
                target=_run_main, args=(theirs, self._main, arguments), name=self.name, daemon=True
            )
            resource_tracker.ensure_running()  # its start unblocks signals, so it must be running before the block
            # Its own descriptor for the thread: the next pipe gets the number, and the write, of one that is closed.
            sending = self._outbox, multiprocessing.connection.Connection(os.dup(self._connection.fileno()))
            # Child and thread inherit the mask: only the main thread handles a signal to the whole process group.
            unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                process.start()
                self._process = process
                threading.Thread(target=_send_queued, args=sending, name=f"to-{self.name}", daemon=True).start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        finally:
            theirs.close()

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.is_alive()

    @property
    def deaths(self) -> int:
        """How often in a row the process has ended, or could not be started, before it did its work."""
        return self._deaths

    @property
    def age(self) -> float:
        """Seconds since the process was started."""
        return time.monotonic() - self._started_at

    @property
    def waitables(self) -> list[Any]:
        """Arguments for :func:`multiprocessing.connection.wait`: ready on a reply, and when the process has died."""
        return [self._connection, self._process.sentinel] if self.alive else []

    def may_restart(self, now: float) -> bool:
        """Return whether the process is dead and its restart pause is over; ``now`` is monotonic time, s."""
        if self.alive:
            return False
        if self._restart_at is None:
            if self._process is not None and self._process.exitcode != 0:
                log.warning("%s has ended with code %s, and is started again", self.name, self._process.exitcode)
                self._release()  # so that a start that fails does not log this again
            pause = FIRST_RESTART_PAUSE * 2 ** (self._deaths - 1) if self._deaths else 0.0
            self._deaths = min(self._deaths + 1, 16)
            self._restart_at = now + min(pause, MAX_RESTART_PAUSE)
        return now >= self._restart_at

    def count_failed_start(self) -> None:
        """Count a restart that the caller could not prepare as a death, so that the pause doubles."""
        self._restart_at = None

    def reset_backoff(self) -> None:
        """Let the next restart be immediate again, because the process has done its work."""
        self._deaths = 0

    def offer(self, message: Any) -> bool:
        """Queue a message without waiting; return False if the queue is full and the message was dropped."""
        try:
            self._outbox.put_nowait(message)
        except queue.Full:
            return False
        return True

    def replies(self) -> list[Any]:
        """Return the messages received since the last call; wait only for the rest of a message that has begun."""
        messages = []
        with contextlib.suppress(EOFError, OSError):
            while self._connection is not None and self._connection.poll():
                messages.append(self._connection.recv())
        return messages

    def kill(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join(timeout=KILL_WAIT)
        self._release()

    def stop(self, seconds: float) -> None:
        """Let the process handle its queued messages for up to ``seconds``, then kill it."""
        if self._process is not None:
            self.offer(None)
            self._process.join(timeout=seconds)
        self.kill()

    def _release(self) -> None:
        if self._connection is not None:
            self.offer(None)  # ends the sending thread
            self._connection.close()
        if self._process is not None:
            with contextlib.suppress(ValueError):
                self._process.close()
        self._process = self._connection = None


class EventCommand:
    """Runs ``command`` for each event of a machine, with the event as JSON on its standard input; or no command.

    Commands run in threads of their own, at most ``MAX_RUNNING`` at a time: the main thread never waits for one. One
    that fails or hangs is counted; it is logged once, until one succeeds again.
    """

    def __init__(self, command: Sequence[str], machine: str, site: str, timeout: float = COMMAND_TIMEOUT) -> None:
        self.failed = 0  # Events for which no command succeeded
        self._command, self._identity, self._timeout = tuple(command), {"machine": machine, "site": site}, timeout
        self._texts: queue.Queue[str] = queue.Queue(MAX_WAITING_EVENTS)
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self.outage = ""  # Why the last command failed; empty if it succeeded
        self._is_stopped = False
        self._threads: list[threading.Thread] = []

    def run(self, event: EventDocument) -> None:
        """Request a run of the command, without waiting."""
        if not self._command:
            return
        if len(self._threads) < MAX_RUNNING:
            self._threads.append(threading.Thread(target=self._work, name="event-command", daemon=True))
            self._threads[-1].start()
        document = {**self._identity, "event": event.model_dump(mode="json", exclude_none=True)}
        try:
            self._texts.put_nowait(json.dumps(document))
        except queue.Full:
            self._fail(f"{MAX_WAITING_EVENTS} events wait for it: an event is dropped")

    def stop(self, seconds: float) -> None:
        """Give the commands up to ``seconds`` to end, then kill them; events that still wait are dropped."""
        deadline = time.monotonic() + seconds
        while self._texts.unfinished_tasks and time.monotonic() < deadline:
            time.sleep(0.01)
        with self._lock:
            self._is_stopped, running = True, tuple(self._running)
        for process in running:
            _kill_session(process)
        if left := self._texts.qsize():
            log.warning("on_event: %d events without a command: the daemon ends", left)

    def _work(self) -> None:
        while not self._is_stopped:
            text = self._texts.get()
            failure = self._perform(text)
            self._texts.task_done()
            if failure:
                self._fail(failure)
            else:
                self.outage = ""

    def _perform(self, text: str) -> str:
        """Run the command once; return why it failed, or an empty text."""
        environment = {name: value for name, value in os.environ.items() if name not in PRIVATE_VARIABLES}
        try:
            with self._lock:
                if self._is_stopped:
                    return "the daemon ends"
                process = subprocess.Popen(  # noqa: S603 - the operator's own command
                    self._command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    env=environment,
                    start_new_session=True,
                )
                self._running.add(process)
        except (OSError, ValueError) as error:
            return getattr(error, "strerror", None) or str(error)
        try:
            process.communicate(text.encode(), timeout=self._timeout)
        except subprocess.TimeoutExpired:
            return f"not finished in {self._timeout:g} s: killed"
        finally:
            _kill_session(process)
            with self._lock:
                self._running.discard(process)
        return f"exit code {process.returncode}" if process.returncode else ""

    def _fail(self, reason: str) -> None:
        with self._lock:
            self.failed += 1
            is_first, self.outage = not self.outage, f"{self._command[0]}: {reason}"
        if is_first:
            log.warning("on_event: %s; further failures are only counted", self.outage)


def _kill_session(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process that still runs, with all that it has started in its session."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class RecorderSupervisor:
    """The recorder of one machine. Times are monotonic, s."""

    def __init__(self, machine: "LoadedMachine", path: Path | None = None) -> None:
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
    def outage(self) -> str:
        """Why nothing is recorded; empty if something is, or should not be."""
        if not self.is_enabled or self._process.alive or self._first is not None:
            return ""
        ended = f"the recorder has ended {self._process.deaths} times" if self._process.deaths >= MIN_DEATHS else ""
        return self._problem or ended

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

    def reload(self, machine: "LoadedMachine", now: float, seconds: float) -> None:
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
