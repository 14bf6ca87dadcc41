"""The optional command that runs for each event, with the event as JSON on its standard input.

Commands run in threads of their own, at most ``MAX_RUNNING`` at a time: the main thread never waits for one. A command
that fails or hangs is counted; it is logged once, until one succeeds again.
"""

import contextlib
import json
import logging
import os
import queue
import signal
import subprocess
import threading
import time
from collections.abc import Sequence

from otolith.health.schema import EventDocument

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_RUNNING = 2  # commands at a time
MAX_WAITING_EVENTS = 64  # events that wait for a command; later ones are dropped and counted
COMMAND_TIMEOUT = 30.0  # s until a command is killed with all processes of its session
PRIVATE_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")
"""Of the environment: with them a command could send systemd notifications as the daemon."""


class EventCommand:
    """Runs ``command`` for each event of a machine; without a command it does nothing."""

    def __init__(self, command: Sequence[str], machine: str, site: str, timeout: float = COMMAND_TIMEOUT) -> None:
        self.failed = 0
        """Events for which no command succeeded."""
        self._command, self._identity, self._timeout = tuple(command), {"machine": machine, "site": site}, timeout
        self._texts: queue.Queue[str] = queue.Queue(MAX_WAITING_EVENTS)
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self.is_failing = False
        """Whether the last command failed."""
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
                self.is_failing = False

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
            is_first, self.is_failing = not self.is_failing, True
        if is_first:
            log.warning("on_event: %s: %s; further failures are only counted", self._command[0], reason)


def _kill_session(process: "subprocess.Popen[bytes]") -> None:
    """Kill a process that still runs, with all that it has started in its session."""
    if process.poll() is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
