"""The history of a log: the reports of a replay in a database of their own, with the times of the data.

Nothing is dropped and nothing is deleted: a replay waits for the disk, and ends.
"""

import contextlib
import math
import sqlite3
from collections.abc import Iterator
from pathlib import Path

from otolith.health.labels import Numbers
from otolith.health.schema import ReportDocument
from otolith.storage.history import HistoryReader, Tables, path_in
from otolith.storage.history_schema import create
from otolith.storage.history_writer import BATCH
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import writable


class LogHistory:
    """Writes the reports of one replay."""

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.reader = HistoryReader(path)
        self.span: tuple[float, float] | None = None
        """Begin and end of the windows, in seconds of the data; None before the first report."""
        self._connection, self._numbers, self._waiting = connection, Numbers(0.0), 0
        self._tables: Tables | None = None

    def add(self, document: ReportDocument) -> None:
        """Write a report; raises as :func:`log_history`."""
        if self._tables is None:  # The counters of a log begin in it, so that none of them count as earlier ones
            self._tables = Tables(self._connection, math.ceil(document.window.start))
        numbered = self._numbers.number(document)
        self._tables.add(numbered)
        self._tables.merge([numbered])
        self.span = self.span[0] if self.span else document.window.start, document.window.end
        self._waiting += 1
        if self._waiting >= BATCH:
            self._connection.commit()
            self._waiting = 0

    def describe(self, description: str) -> None:
        """Write what :func:`otolith.storage.history.describe_machine` returns, and what was not written yet."""
        if self._tables is not None:
            self._tables.describe(description)
        self._connection.commit()


@contextlib.contextmanager
def log_history(folder: Path, site: str, machine: str) -> Iterator[LogHistory]:
    """Yield what writes a new history of a machine in ``folder``, which is created if it is missing.

    Without a report no file is left.

    Raises:
        ConfigurationError: the folder has a history of this machine.
        ServiceError: the disk refuses.
    """
    path = path_in(writable(folder), site, machine)
    if path.exists():
        raise ConfigurationError(f"{path}: exists: each log gets a history of its own: give another folder")
    history: LogHistory | None = None
    try:
        with contextlib.closing(sqlite3.connect(path)) as connection:
            create(connection, site, machine)
            connection.execute("PRAGMA synchronous = OFF")  # after a power cut it is replayed again
            yield (history := LogHistory(path, connection))
    except sqlite3.Error as error:
        raise ServiceError(f"{path}: cannot be written: {error}") from error
    finally:
        if history is None or history.span is None:
            path.unlink(missing_ok=True)
