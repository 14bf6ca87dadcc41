"""Writing to disk: a thread does it for the main thread, which never waits; files are replaced as a whole.

After an error the thread tries again. What root writes belongs to the owner of the folder.
"""

import contextlib
import heapq
import logging
import os
import sqlite3
import threading
import time
import zlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from otolith_drivers.errors import ServiceError
from otolith_drivers.user_dirs import writable

log = logging.getLogger(__name__)

WRITE_RETRY = 30.0  # s from an error to the next try; docs/reference/thresholds-storage.md has its origin


def phase_of(name: str) -> float:
    """Return by what share of its interval a machine does earlier what it does once in each: from 0 to 1.

    Machines that began together would otherwise always do it together, while reports wait.
    """
    return zlib.crc32(name.encode()) / 2**32


class WriterThread(ABC):
    """Calls :meth:`write` when something is to be written, and once per interval."""

    def __init__(self, name: str, interval: float, loss: str) -> None:
        """``interval`` in s; ``loss`` names for the log what an error keeps from being written."""
        self.interval, self._loss = interval, loss
        self._wakeup, self._stopping = threading.Event(), threading.Event()
        self._retry_at, self._last_error = 0.0, ""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._shared: StorageThread | None = None
        self._is_started = False
        self._ended = threading.Event()

    @property
    def outage(self) -> str:
        """Why the last try wrote nothing; empty if it did."""
        return f"{self._loss}: {self._last_error}" if self._last_error else ""

    def share(self, thread: "StorageThread") -> None:
        """Let :meth:`start` take a thread that several writers share, instead of one of its own."""
        self._shared = thread

    def start(self) -> None:
        """Start the thread."""
        self._is_started = True
        if self._shared is None:
            self._thread.start()
        else:
            self._shared.add(self)

    def wake(self) -> None:
        """Let the thread write soon."""
        self._wakeup.set()
        if self._shared is not None and self._is_started:
            self._shared.wake(self)

    def stop(self, seconds: float) -> None:
        """Write what is waiting, for up to ``seconds``, and end the thread; a shared one is stopped by its owner."""
        self._stopping.set()
        self.wake()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("%s: writing took over %.1f s: check the disk", self._loss, seconds)

    def wait(self, seconds: float) -> bool:
        """Wait up to ``seconds`` for the last turn after :meth:`stop`; return whether nothing is written any more."""
        return not self._is_started or self._ended.wait(seconds)

    @abstractmethod
    def write(self) -> None:
        """Write what is waiting; after an exception the next call comes ``WRITE_RETRY`` later, or from :meth:`stop`."""

    def read(self) -> None:  # noqa: B027 - what has nothing to read does nothing
        """Read what other processes have written; called as often as :meth:`write`, and after its errors as well."""

    def fail(self, error: Exception) -> None:
        """Log an error, once while it stays the same."""
        text = str(error) or type(error).__name__
        if isinstance(error, OSError | sqlite3.Error):
            is_locked = isinstance(error, sqlite3.OperationalError) and "locked" in text
            text += f": {'end the other process that uses it' if is_locked else 'check the disk and its permissions'}"
        if text != self._last_error:
            log.warning("%s: %s", self._loss, text)
        self._last_error, self._retry_at = text, time.monotonic() + WRITE_RETRY

    def turn(self) -> bool:
        """Write and read once; return whether it was the last time."""
        self._wakeup.clear()
        is_last = self._stopping.is_set()
        if is_last or time.monotonic() >= self._retry_at:
            try:
                self.write()
            except Exception as error:  # noqa: BLE001 - OSError, sqlite3.Error, OtolithError, or a bug: none ends it
                self.fail(error)
            else:
                self._last_error, self._retry_at = "", 0.0
        if is_last:
            self._ended.set()
        else:
            self.read()
        return is_last

    def _run(self) -> None:
        is_last = False
        while not is_last:
            self._wakeup.wait(self.interval)
            is_last = self.turn()


class StorageThread:
    """A thread that several writers share: the machines of a hall have one."""

    def __init__(self) -> None:
        self._wakeup, self._woken = threading.Event(), deque[WriterThread]()
        self._due: list[tuple[float, int, WriterThread]] = []  # Only this thread uses it, as the next line
        self._running: dict[WriterThread, float] = {}  # When each has its next turn without being woken, monotonic s
        self._added = 0
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="storage", daemon=True)

    def add(self, writer: WriterThread) -> None:
        """Let it write for a further writer, from now on."""
        self.wake(writer)
        if self._thread.ident is None:
            self._thread.start()

    def wake(self, writer: WriterThread) -> None:
        """Let a writer write soon."""
        self._woken.append(writer)
        self._wakeup.set()

    def stop(self, seconds: float) -> None:
        """Wait up to ``seconds`` until all writers, which were stopped before, have written what is waiting."""
        self._is_stopping = True
        self._wakeup.set()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("writing took over %.1f s: check the disk", seconds)

    def _run(self) -> None:
        while not self._is_stopping or self._woken:
            rest = self._due[0][0] - time.monotonic() if self._due else None
            self._wakeup.wait(rest if rest is None or rest > 0.0 else 0.0)
            self._wakeup.clear()
            woken = [self._woken.popleft() for _ in range(len(self._woken))]
            for writer in dict.fromkeys([*woken, *self._expired()]):
                if writer.turn():
                    self._running.pop(writer, None)
                else:
                    self._plan(writer)

    def _plan(self, writer: WriterThread) -> None:
        self._running[writer] = time.monotonic() + writer.interval
        self._added += 1
        heapq.heappush(self._due, (self._running[writer], self._added, writer))

    def _expired(self) -> Iterator[WriterThread]:
        """Yield the writers whose interval is over; one that wrote meanwhile has a later turn."""
        now = time.monotonic()
        while self._due and self._due[0][0] <= now:
            due, _, writer = heapq.heappop(self._due)
            if self._running.get(writer) == due:
                yield writer


def reason_of(error: Exception) -> str:
    """Return the text of an error in one line; of a document that does not fit its schema, the first fault."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}"


def replace_file(
    path: Path, data: bytes, temporary: str, mode: int = 0o600, owner: os.stat_result | None = None
) -> None:
    """Replace a file, all or nothing, also if the computer loses power meanwhile; raise ServiceError if that fails.

    ``temporary`` is a name beside it. All names are relative to the open folder: its owner could replace a path while
    root writes there. The file gets the user and the group of ``owner``; without one, those of the folder if root
    writes.
    """
    try:
        with opened_folder(path.parent) as folder:
            try:
                os.unlink(temporary, dir_fd=folder)  # left by a process that was killed
            except FileNotFoundError:
                pass
            except IsADirectoryError as error:
                text = f"{path}: cannot be written: {temporary} beside it is a folder: remove or rename it"
                raise ServiceError(text) from error
            try:
                handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600, dir_fd=folder)
                with os.fdopen(handle, "wb") as stream:
                    stream.write(data)
                    stream.flush()
                    if owner is None:
                        give_to(os.fstat(folder), handle)
                    else:
                        _keep_owner(path, owner, handle)
                    os.fchmod(handle, mode)
                    os.fsync(handle)
                os.replace(temporary, path.name, src_dir_fd=folder, dst_dir_fd=folder)
                os.fsync(folder)
            except (OSError, ServiceError):
                with contextlib.suppress(OSError):
                    os.unlink(temporary, dir_fd=folder)
                raise
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error


@contextlib.contextmanager
def opened_folder(folder: Path) -> Iterator[int]:
    """Descriptor of ``folder``, which is created if it is missing."""
    is_new = not folder.exists()
    handle = os.open(writable(folder), os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if is_new:
            give_to(folder.parent.stat(), handle)
        yield handle
    finally:
        os.close(handle)


def _keep_owner(path: Path, owner: os.stat_result, handle: int) -> None:
    """Give the open successor of ``path`` to its owner; raise ServiceError if this user may not."""
    status = os.fstat(handle)
    if (status.st_uid, status.st_gid) == (owner.st_uid, owner.st_gid):
        return
    try:
        os.fchown(handle, owner.st_uid, owner.st_gid)
    except PermissionError as error:
        remedy = "repeat the command as that user or as root"
        fault = f"it belongs to user {owner.st_uid} and group {owner.st_gid}, which this user cannot give to a file"
        raise ServiceError(f"{path}: not written: {fault}: {remedy}") from error


def give_to(owner: os.stat_result, handle: int) -> None:
    """Give what root has opened to an owner: the daemon runs as another user and must be able to use it."""
    if os.geteuid() == 0:
        os.fchown(handle, owner.st_uid, owner.st_gid)
