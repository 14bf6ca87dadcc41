"""A thread that writes to disk for the main thread, which never waits for it; after an error it tries again."""

import logging
import sqlite3
import threading
import time
from abc import ABC, abstractmethod

log = logging.getLogger(__name__)

WRITE_RETRY = 30.0  # s from an error to the next try; docs/reference/thresholds-storage.md has its origin


class WriterThread(ABC):
    """Calls :meth:`write` when something is to be written, and once per interval."""

    def __init__(self, name: str, interval: float, loss: str) -> None:
        """``interval`` in s; ``loss`` names for the log what an error keeps from being written."""
        self._interval, self._loss = interval, loss
        self._wakeup, self._stopping = threading.Event(), threading.Event()
        self._retry_at, self._last_error = 0.0, ""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self, seconds: float) -> None:
        """Write what is waiting, for up to ``seconds``, and end the thread."""
        self._stopping.set()
        self._wakeup.set()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("%s: writing took over %.1f s: check the disk", self._loss, seconds)

    @abstractmethod
    def write(self) -> None:
        """Write what is waiting; after an exception the next call comes ``WRITE_RETRY`` later, or from :meth:`stop`."""

    def read(self) -> None:  # noqa: B027 - what has nothing to read does nothing
        """Read what other processes have written; called as often as :meth:`write`, and after its errors as well."""

    def fail(self, error: Exception) -> None:
        """Log an error, once while it stays the same."""
        text = str(error) or type(error).__name__
        if isinstance(error, OSError | sqlite3.Error):
            text += ": check the disk and its permissions"
        if text != self._last_error:
            log.warning("%s: %s", self._loss, text)
        self._last_error, self._retry_at = text, time.monotonic() + WRITE_RETRY

    def _run(self) -> None:
        while True:
            self._wakeup.wait(self._interval)
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
                return
            self.read()
