"""A process of our own beside the daemon that may die at any moment without taking anything with it.

The only place where the daemon starts processes. A companion is spawned (forked children would inherit Zenoh's and
Rerun's threads half), talks over one pipe, is never waited for, and ends by itself when the daemon is gone.
"""

import contextlib
import logging
import multiprocessing
import multiprocessing.connection
import queue
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any

log = logging.getLogger(__name__)

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 30.0  # s before the second start after deaths in a row, and before any later one
SIGNALS = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """A child inherits the mask: on a signal to the whole group only the daemon acts, and ends the others."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _enter(connection: Any, main: str, arguments: Sequence[Any]) -> None:
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the daemon is gone
        module, function = main.split(":")
        getattr(import_module(module), function)(connection, *arguments)


class ChildProcess:
    """Runs ``main``, written ``module:function``, as ``function(connection, *arguments)`` in a process.

    Only the companion imports the module. At most ``room`` messages wait for it.
    """

    def __init__(self, name: str, main: str, room: int) -> None:
        self.name = name
        self.starts = 0
        self._main, self._room = main, room
        self._deaths = 0
        self._started_at = 0.0
        self._start_again_at: float | None = None
        self._process: Any = None
        self._connection: Any = None
        self._outbox: queue.Queue[Any] = queue.Queue(room)

    def start(self, *arguments: Any) -> None:
        """Spawn the process; what waited for an earlier one is gone. A failure to spawn counts as a death."""
        self._release()
        self.starts += 1
        self._start_again_at, self._started_at = None, time.monotonic()
        try:
            self._spawn(arguments)
        except OSError as error:  # no descriptors, no processes, no memory left: perhaps in a while
            log.warning("%s cannot be started: %s", self.name, error)
            self._release()

    def _spawn(self, arguments: Sequence[Any]) -> None:
        context = multiprocessing.get_context("spawn")
        self._connection, theirs = context.Pipe()
        try:
            self._outbox = queue.Queue(self._room)
            process = context.Process(target=_enter, args=(theirs, self._main, arguments), name=self.name, daemon=True)
            resource_tracker.ensure_running()  # it unblocks the signals when it starts, so not among those below
            with _signals_blocked():
                process.start()
                self._process = process
                sender = threading.Thread(
                    target=_send, args=(self._outbox, self._connection), name=f"to-{self.name}", daemon=True
                )
                sender.start()
        finally:
            theirs.close()

    @property
    def pid(self) -> int | None:
        """Of the running process."""
        return None if self._process is None else self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process is not None and self._process.is_alive()

    @property
    def waitables(self) -> list[Any]:
        """For :func:`multiprocessing.connection.wait`: ready when there is a reply, or when the process has died."""
        return [self._connection, self._process.sentinel] if self.alive else []

    def may_start_again(self, now: float) -> bool:
        """Whether it is dead and its pause is over: none at first, then doubled with every death in a row."""
        if self.alive:
            return False
        if self._start_again_at is None:
            pause = FIRST_PAUSE * 2 ** (self._deaths - 1) if self._deaths else 0.0
            self._deaths = min(self._deaths + 1, 16)
            self._start_again_at = now + min(pause, LONGEST_PAUSE)
        return now >= self._start_again_at

    def postpone(self) -> None:
        """A start was given up before it began: the next pause is as after a death."""
        self._start_again_at = None

    @property
    def age(self) -> float:
        """Seconds since the process was started."""
        return time.monotonic() - self._started_at

    def has_thrived(self) -> None:
        """It did its work: the next death is the first in a row again."""
        self._deaths = 0

    def offer(self, message: Any) -> bool:
        """Hand a message over without waiting; False if there is no room and it was dropped."""
        try:
            self._outbox.put_nowait(message)
        except queue.Full:
            return False
        return True

    def replies(self) -> list[Any]:
        """What it has said since; waits only for the rest of a message that has begun to come."""
        said = []
        with contextlib.suppress(EOFError, OSError):
            while self._connection is not None and self._connection.poll():
                said.append(self._connection.recv())
        return said

    def kill(self) -> None:
        """End the process now; :meth:`start` makes a new one."""
        if self._process is not None:
            self._process.kill()
            self._process.join(timeout=1.0)
        self._release()

    def stop(self, seconds: float) -> None:
        """Let it finish what it has for up to ``seconds``, then end it."""
        if self._process is not None:
            with contextlib.suppress(queue.Full):
                self._outbox.put_nowait(None)
            self._process.join(timeout=seconds)
        self.kill()

    def _release(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(queue.Full):
                self._outbox.put_nowait(None)  # ends the sender's thread
            self._connection.close()
        if self._process is not None:
            with contextlib.suppress(ValueError):
                self._process.close()
        self._process = self._connection = None


def _send(outbox: queue.Queue[Any], connection: Any) -> None:
    with contextlib.suppress(OSError, ValueError):
        while True:
            message = outbox.get()
            connection.send(message)
            if message is None:
                return
