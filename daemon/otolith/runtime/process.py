"""A child process that may die at any moment without harm to the daemon.

This is the only module that starts processes of Otolith. A child process is spawned, not forked, because a fork copies
only part of the threads of Zenoh and Rerun. It communicates over one pipe, on which the daemon never waits, and ends by
itself when the daemon has died.
"""

import contextlib
import logging
import multiprocessing
import multiprocessing.connection
import queue
import signal
import threading
import time
from collections.abc import Sequence
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
FIRST_RESTART_PAUSE = 0.5  # s before the second restart in a row; the first restart is immediate
MAX_RESTART_PAUSE = 30.0  # s; the pause doubles with each further restart up to this
KILL_WAIT = 1.0  # s for the kernel to end a killed process
SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


def _run_main(connection: Any, main: str, arguments: Sequence[Any]) -> None:
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the daemon has died
        module, function = main.split(":")
        getattr(import_module(module), function)(connection, *arguments)


def _send_queued(outbox: queue.Queue[Any], connection: Any) -> None:
    # The main thread may close the connection during a write, whose descriptor is then None: a TypeError.
    with contextlib.suppress(OSError, ValueError, TypeError):
        while True:
            message = outbox.get()
            connection.send(message)
            if message is None:
                return


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
        except OSError as error:  # out of file descriptors, processes or memory: may be temporary
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
            # Child and thread inherit the mask: only the main thread handles a signal to the whole process group.
            unblocked = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                process.start()
                self._process = process
                sending = self._outbox, self._connection
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
