"""The processes that the daemon starts: children of its own, and the command that runs for each event.

A child may die at any moment without harm to the daemon. A child process is spawned, not forked, because a fork copies
only part of the threads of Zenoh and Rerun. It communicates over one pipe, on which only threads wait, and ends by
itself when the daemon has died.
"""

import contextlib
import gc
import logging
import math
import multiprocessing
import multiprocessing.connection
import os
import queue
import resource
import select
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

from otolith.health.schema import EventDocument
from otolith.runtime.effort import processor_time
from otolith_drivers.grammars.json_lines import json_text

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
FIRST_RESTART_PAUSE = 0.5  # s before the second restart in a row; the first restart is immediate
MAX_RESTART_PAUSE = 30.0  # s; the pause doubles with each further restart up to this
KILL_WAIT = 1.0  # s for the kernel to end a killed process
MAX_RUNNING = 2  # commands at a time
MAX_WAITING_EVENTS = 64  # events that wait for a command; later ones are dropped and counted
COMMAND_TIMEOUT = 30.0  # s until a command is killed with all processes of its session
PRIVATE_VARIABLES = ("NOTIFY_SOCKET", "WATCHDOG_PID", "WATCHDOG_USEC")  # With them a command could notify systemd
READY_BYTES = 4096  # that are read at once of those that say that there are messages
SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


def wait_for(waitables: Sequence[Any], seconds: float) -> bool:
    """Wait for up to ``seconds`` until one of the descriptors, or of what has one, is ready; return whether one is.

    ``multiprocessing.connection.wait`` takes as much processor time for it as the main thread has for a whole window.
    """
    poll = select.poll()
    for each in waitables:
        poll.register(each, select.POLLIN)
    return bool(poll.poll(max(0.0, math.ceil(1e3 * seconds))))


def spare_collections() -> None:
    """Keep what the process has now out of all later collections of cyclic garbage.

    Python's collector otherwise looks at all objects of a hall again and again, for tenths of a second in which no
    other thread runs. What is no longer used is freed as before, unless it refers to itself.
    """
    gc.collect()
    gc.freeze()


def _run_main(connection: Any, main: str) -> None:
    module, function = main.split(":")
    try:
        with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the daemon has died
            arguments = connection.recv()
            getattr(import_module(module), function)(connection, *arguments)
    except OSError as error:  # of a disk or a file; the process is started again
        sys.exit(f"{multiprocessing.current_process().name}: {error}")


def _send_queued(arguments: bytes, outbox: queue.Queue[Any], connection: multiprocessing.connection.Connection) -> None:
    """Send the pickled arguments of a child, which nobody reads before it has started, then what is queued."""
    with connection, contextlib.suppress(OSError, ValueError):
        connection.send_bytes(arguments)
        connection.send(message := outbox.get())
        while message is not None:
            connection.send(message := outbox.get())


class _Inbox:
    """What a child sends: a thread waits for its messages, of which a child that freezes may have sent one half."""

    def __init__(self, name: str, connection: multiprocessing.connection.Connection) -> None:
        """The thread closes ``connection`` once the child has closed the other end."""
        self._messages: deque[Any] = deque()
        self.ready, self._ready = multiprocessing.connection.Pipe(duplex=False)
        """Readable as soon as there is a message, or the child has ended."""
        os.set_blocking(self.ready.fileno(), False)
        self._thread = threading.Thread(target=self._receive, args=(name, connection), name=f"from-{name}", daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        """Whether there is a message, or may be one."""
        return self._thread.is_alive() or bool(self._messages)

    def take(self) -> list[Any]:
        """Return the messages received since the last call, without waiting."""
        with contextlib.suppress(BlockingIOError):
            while os.read(self.ready.fileno(), READY_BYTES):
                pass
        return [self._messages.popleft() for _ in range(len(self._messages))]

    def _receive(self, name: str, connection: multiprocessing.connection.Connection) -> None:
        with connection, self._ready:
            try:
                while True:
                    self._messages.append(connection.recv())
                    self._ready.send_bytes(b"")
            except (EOFError, OSError):  # it has ended
                return
            except Exception as error:  # noqa: BLE001 - unpickling half a message may raise anything; its reader has a timeout
                log.warning("%s: a message that cannot be read: %s", name, error)


class RestartPauses:
    """Pauses between the restarts of what has ended: the first is immediate, then each takes twice as long."""

    def __init__(self) -> None:
        self.deaths = 0
        """How often in a row it has ended, or could not be started, before it did its work."""
        self._restart_at: float | None = None

    def is_over(self, now: float) -> bool:
        """Return whether it may be started again; ``now`` is monotonic time, s."""
        if self._restart_at is None:
            pause = FIRST_RESTART_PAUSE * 2 ** (self.deaths - 1) if self.deaths else 0.0
            self.deaths = min(self.deaths + 1, 16)
            self._restart_at = now + min(pause, MAX_RESTART_PAUSE)
        return now >= self._restart_at

    def begin(self) -> None:
        """It was started, or the restart failed: count its next end."""
        self._restart_at = None


class ChildProcess:
    """Runs ``main``, written ``module:function``, as ``function(connection, *arguments)`` in a child process.

    Only the child imports the module. At most ``room`` messages wait for it.
    """

    def __init__(self, name: str, main: str, room: int) -> None:
        self.name = name
        self.starts = 0
        self._main, self._room = main, room
        self._pauses = RestartPauses()
        self._started_at = 0.0
        self._process: Any = None
        self._inbox: _Inbox | None = None
        self._outbox: queue.Queue[Any] = queue.Queue(room)

    def widen(self, room: int) -> None:
        """Let up to ``room`` messages wait from now on."""
        self._room = room
        with self._outbox.mutex:
            self._outbox.maxsize = room

    def start(self, *arguments: Any) -> None:
        """Spawn the process; messages for an earlier one are dropped. A failure to spawn counts as a death."""
        self._release()
        self.starts += 1
        self._pauses.begin()
        self._started_at = time.monotonic()
        try:
            self._spawn(arguments)
        except (OSError, RuntimeError) as error:  # out of descriptors, processes, threads or memory: may be temporary
            log.warning("process %s cannot be started: %s", self.name, error)
            self._release()

    def _spawn(self, arguments: Sequence[Any]) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        try:
            self._outbox = queue.Queue(self._room)
            process = context.Process(target=_run_main, args=(theirs, self._main), name=self.name, daemon=True)
            pickled = bytes(ForkingPickler.dumps(tuple(arguments)))
            resource_tracker.ensure_running()  # its start unblocks signals, so it must be running before the block
            # Each thread has its own descriptor: the next pipe gets the number, and the write, of one that is closed.
            sending = pickled, self._outbox, multiprocessing.connection.Connection(os.dup(ours.fileno()))
            # Child and thread inherit the mask: only the main thread handles a signal to the whole process group.
            unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                process.start()
                self._process = process
                threading.Thread(target=_send_queued, args=sending, name=f"to-{self.name}", daemon=True).start()
                self._inbox = _Inbox(self.name, ours)
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, unblocked)
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()

    @property
    def alive(self) -> bool:
        """Whether the process runs, or has ended and left messages."""
        if self._process is None:
            return False
        return self._process.is_alive() or (self._inbox is not None and self._inbox.is_open)

    @property
    def has_finished(self) -> bool:
        """Whether the process has ended by itself, without a fault."""
        return self._process is not None and self._process.exitcode == 0

    @property
    def deaths(self) -> int:
        """How often in a row the process has ended, or could not be started, before it did its work."""
        return self._pauses.deaths

    @property
    def age(self) -> float:
        """Seconds since the process was started."""
        return time.monotonic() - self._started_at

    @property
    def processor_time(self) -> float:
        """Processor time that the process has taken, s; 0 if it does not run."""
        pid = None if self._process is None else self._process.pid
        return 0.0 if pid is None else processor_time(pid)

    @property
    def memory(self) -> int:
        """Bytes of memory that the process has, with what it shares; 0 if it does not run."""
        pid = None if self._process is None else self._process.pid
        with contextlib.suppress(OSError, ValueError, IndexError):
            return int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1]) * resource.getpagesize()
        return 0

    @property
    def waitables(self) -> list[Any]:
        """Arguments for :func:`wait_for`: ready on a reply, and when the process has died."""
        if not self.alive:
            return []
        if self._inbox is None or not self._inbox.is_open:  # a closed one would always be ready
            return [self._process.sentinel]
        return [self._process.sentinel, self._inbox.ready]

    def may_restart(self, now: float) -> bool:
        """Return whether the process is dead and its restart pause is over; ``now`` is monotonic time, s."""
        if self.alive:
            return False
        if self._process is not None and self._process.exitcode not in (0, None):
            log.warning("%s has ended with code %s, and is started again", self.name, self._process.exitcode)
            self._release()  # so that it is logged once, also if a start fails
        return self._pauses.is_over(now)

    def count_failed_start(self) -> None:
        """Count a restart that the caller could not prepare as a death, so that the pause doubles."""
        self._pauses.begin()

    def reset_backoff(self) -> None:
        """Let the next restart be immediate again, because the process has done its work."""
        self._pauses.deaths = 0

    def offer(self, message: Any) -> bool:
        """Queue a message without waiting; return False if the queue is full and the message was dropped."""
        try:
            self._outbox.put_nowait(message)
        except queue.Full:
            return False
        return True

    def replies(self) -> list[Any]:
        """Return the messages received since the last call, without waiting."""
        return [] if self._inbox is None else self._inbox.take()

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
        if self._process is not None:
            self.offer(None)  # ends the sending thread
            with contextlib.suppress(ValueError):
                self._process.close()
        if self._inbox is not None:
            self._inbox.ready.close()
        self._process = self._inbox = None


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
        document = {**self._identity, "event": event.model_dump(exclude_none=True)}
        try:
            self._texts.put_nowait(json_text(document))
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
