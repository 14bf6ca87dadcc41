"""The daemon's side of the history: numbers the reports, writes them in the background, and deletes old ones.

The main thread only appends to a queue. A disk that is full or slow costs history, never monitoring: what does not fit
into the queue is dropped and counted.
"""

import contextlib
import logging
import math
import os
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from pydantic import ValidationError

from otolith.health.labels import Numbers, TimeLabels
from otolith.health.schema import EventDocument, ReportDocument
from otolith.machine_file import MachineFile
from otolith.storage.disk import WriterThread, give_to, opened_folder, phase_of
from otolith.storage.history import (
    BUSY_TIMEOUT,
    CHECKPOINT_BYTES,
    DAY,
    HOUR,
    KEPT,
    MINUTE,
    WINDOW,
    HistoryReader,
    Tables,
    history_path,
)
from otolith.storage.history_schema import NewerVersionError, check, create, upgrade
from otolith.storage.recording_files import LEAP_PATIENCE, MAX_AHEAD, MAX_LEAP
from otolith_drivers.errors import OtolithError, ServiceError

log = logging.getLogger(__name__)

DAMAGED = frozenset({sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB})
"""Primary codes of a database that cannot be used as it is; most others are faults of disk and permissions."""
# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
MAX_WAITING = 256  # reports that wait for the disk
BATCH = 64  # reports in one transaction, and from which on their values are written
MERGE_INTERVAL = 60.0  # s from the first report to the transaction with its values
PRUNE_INTERVAL = 60.0  # s between two deletions by age
MAX_LOG_BYTES = 32 << 20  # of the write-ahead log, which a reader that never ends keeps from being merged
QUERY_WAIT = 1.0  # s that a query waits for what is not yet written
AGES = {WINDOW: 1.0 * DAY, MINUTE: 14.0 * DAY, HOUR: 366.0 * DAY}  # s; of days, events and findings the machine file
HARD_SHARE, PRUNED_SHARE = 0.9, 0.8  # of the size limit: never exceeded, and kept by deleting
MIN_REPORTS = 1800  # that are kept before coarser values go
CHUNK = 1000  # rows of a table in one transaction
LAST_STATE = "SELECT max(sequence) FROM state AS other WHERE other.part = state.part"  # It is never deleted
PAGES_AT_ONCE = 1000  # that are given back to the file system in one transaction


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the history of a machine may take."""

    max_bytes: int  # Of all its files
    days: float  # Age of what is kept longest
    resend_hours: float  # Age of whole reports


class Retention:
    """Deletes what is older or more than the bounds allow."""

    def __init__(self, connection: sqlite3.Connection, bounds: Bounds) -> None:
        self._connection, self._bounds = connection, bounds
        self.labels = TimeLabels()  # Of the service times in the tables
        (self._page_size,) = connection.execute("PRAGMA page_size").fetchone()
        self._limit()

    def by_age(self, now: float, elapsed: float) -> None:
        """Delete what is too old at the Unix time ``now``, ``elapsed`` s of operation after the last call."""
        clock, longest, first = self._clock(now, elapsed), self._bounds.days * DAY, self.labels.first
        for resolution in (*AGES, DAY):
            oldest = first(clock - min(AGES.get(resolution, longest), longest))
            while self._delete_samples(resolution, oldest):
                pass
        # By sequence: reports with the time of a wrong clock, ahead or behind, go with those around them.
        resend = first(clock - min(self._bounds.resend_hours * HOUR, longest))
        recent = "coalesce((SELECT min(+sequence) FROM report WHERE time BETWEEN ?1 AND ?2), 9e18)"  # '+': by time
        latest = f"(SELECT max(+sequence) FROM report WHERE time < ?1 AND +sequence < {recent})"  # noqa: S608 - our own names
        while self._delete_reports(f"sequence <= {latest}", resend, first(clock + MAX_AHEAD)):
            pass
        for table, column in (("event", "time"), ("finding", "last"), ("counters", "hour")):
            self._delete(f"DELETE FROM {table} WHERE {column} < ?", first(clock - longest))  # noqa: S608 - our own names
        self._delete(f"DELETE FROM state WHERE sequence < ({LAST_STATE} AND entered < ?)", first(clock - longest))  # noqa: S608 - our own names

    def by_size(self, now: float) -> None:
        """Delete the oldest details, then the oldest rest, until the size is within its bound."""
        if not self._is_too_large():
            return
        self._delete("DELETE FROM sample WHERE time > ?", self.labels.first(now + MAX_AHEAD))
        steps = (
            partial(self._delete_details, MIN_REPORTS, self.labels.first(now - HOUR)),
            partial(self._delete_samples, MINUTE),
            partial(self._delete_details, 1, math.inf),
            self._delete_rest,
        )
        for step in steps:
            while self._is_too_large() and step():
                pass
        self._give_back()

    def _limit(self) -> int:
        """Set the size that SQLite never exceeds; a file that is larger keeps its size. Returns it in pages."""
        pages = int(HARD_SHARE * self._bounds.max_bytes / self._page_size)
        self._connection.execute(f"PRAGMA max_page_count = {pages}").fetchone()
        return pages

    def _clock(self, now: float, elapsed: float) -> float:
        """Return ``now``, or the time without a leap of the clock until it is used: a wrong clock deletes nothing."""
        row = self._connection.execute("SELECT retention, waited FROM clock").fetchone()
        clock, waited = row or (now, 0.0)
        if now - clock <= MAX_LEAP + elapsed or waited + elapsed >= LEAP_PATIENCE:
            clock, waited = now, 0.0
        else:
            clock, waited = clock + elapsed, waited + elapsed
        with self._connection:
            self._connection.execute("DELETE FROM clock")
            self._connection.execute("INSERT INTO clock VALUES (?, ?)", (clock, waited))
        return float(clock)

    def _is_too_large(self) -> bool:
        (pages,) = self._connection.execute("PRAGMA page_count").fetchone()
        (free,) = self._connection.execute("PRAGMA freelist_count").fetchone()
        return bool((pages - free) * self._page_size > PRUNED_SHARE * self._bounds.max_bytes)

    def _delete_samples(self, resolution: int, before: float = math.inf) -> int:
        """Delete at most ``CHUNK`` of the oldest values of a resolution."""
        chosen = "SELECT time, series FROM sample WHERE resolution = ?1 AND time < ?2 ORDER BY time LIMIT ?3"
        query = f"DELETE FROM sample WHERE resolution = ?1 AND (time, series) IN ({chosen})"  # noqa: S608 - our own names
        return self._delete(query, resolution, before, CHUNK)

    def _delete_details(self, keep: int, latest: float) -> int:
        """Delete the oldest reports, but not the newest ``keep``, and values of their windows before ``latest``."""
        execute = self._connection.execute
        first = execute("SELECT sequence FROM report ORDER BY sequence DESC LIMIT 1 OFFSET ?", (keep - 1,)).fetchone()
        query = "SELECT sequence, time FROM report WHERE sequence < ? ORDER BY sequence LIMIT ?"
        oldest = execute(query, (first[0] if first else 0, CHUNK)).fetchall()
        if not oldest:
            return self._delete_samples(WINDOW, latest)
        count, before = len(oldest), min(latest, max(time for _, time in oldest))
        self._delete("DELETE FROM report WHERE sequence <= ?", oldest[-1][0])
        while deleted := self._delete_samples(WINDOW, before):
            count += deleted
        return count

    def _delete_reports(self, condition: str, *values: float) -> int:
        """Delete at most ``CHUNK`` of the oldest reports; the newest stays, as the next one refers to it."""
        newest = "sequence < (SELECT max(sequence) FROM report)"
        chosen = f"SELECT sequence FROM report WHERE {newest} AND {condition} ORDER BY sequence LIMIT {CHUNK}"  # noqa: S608 - our own names
        return self._delete(f"DELETE FROM report WHERE sequence IN ({chosen})", *values)  # noqa: S608 - our own names

    def _delete_rest(self) -> int:
        count = sum(map(self._delete_samples, (HOUR, DAY)))
        keys = {"event": "sequence", "finding": "(id, first)", "counters": "(hour, run)", "state": "(part, sequence)"}
        orders = {"event": "sequence", "finding": "last", "counters": "run, hour", "state": "sequence"}
        for table, key in keys.items():
            rest = f"WHERE sequence < ({LAST_STATE})" if table == "state" else ""
            chosen = f"SELECT {key.strip('()')} FROM {table} {rest} ORDER BY {orders[table]} LIMIT {CHUNK}"  # noqa: S608 - our own names
            count += self._delete(f"DELETE FROM {table} WHERE {key} IN ({chosen})")  # noqa: S608 - our own names
        return count

    def _delete(self, query: str, *values: float) -> int:
        with self._connection:
            return self._connection.execute(query, values).rowcount

    def _give_back(self) -> None:
        """Make the file smaller if it is larger than it may be: the limit was lowered."""
        (pages,) = self._connection.execute("PRAGMA page_count").fetchone()
        for _ in range(0, pages - self._limit(), PAGES_AT_ONCE):
            # Not by execute, which would stop after the first page.
            self._connection.executescript(f"PRAGMA incremental_vacuum({PAGES_AT_ONCE})")
        self._limit()


class HistoryWriter(WriterThread):
    """The history of one machine while its daemon runs."""

    def __init__(self, path: Path, bounds: Bounds) -> None:
        """``path`` as :func:`otolith.storage.history.history_path` returns it."""
        super().__init__("history", PRUNE_INTERVAL, f"{path}: no history is written")
        self.reader = HistoryReader(path)
        self._path, self._bounds = path, bounds
        self._connection: sqlite3.Connection | None = None
        self._waiting: deque[tuple[ReportDocument, str]] = deque()  # With its JSON
        # Reports that are written, without their values, by their numbers: as JSON, which takes a tenth of the memory
        self._unmerged: dict[int | None, str] = {}
        self._is_urgent = False  # Whether one of them has changed an event
        self._merged_at = 0.0
        self._lock, self._written = threading.Lock(), threading.Event()
        self._pruned_at, self._read_error = 0.0, ""
        self.description = ""
        """As :func:`otolith.storage.history.describe_machine` returns it; it is written with the next report."""
        self.labels = TimeLabels()  # Of service times; they are written with the next report
        self.dropped = 0  # Reports that were not written

    def open(self, now: float) -> tuple[Numbers, str]:
        """Open or create the database, and return where its numbers continue, and why it begins anew; empty if not.

        ``now`` in Unix s. A disk that refuses is no error here: the thread tries again.
        """
        numbers, note = Numbers(now), ""
        try:
            note = self._open()
            numbers = self._begin_numbers(now)
        except (sqlite3.Error, OtolithError, OSError) as error:
            self.fail(error)
        return numbers, note

    def start(self) -> None:
        """Start the thread that writes."""
        phase = 0.0 if self._shared is None else phase_of(self._path.name)
        self._merged_at, self._pruned_at = (
            time.monotonic() - phase * interval for interval in (MERGE_INTERVAL, PRUNE_INTERVAL)
        )
        super().start()

    def add(self, document: ReportDocument, text: str = "") -> None:
        """Request that a report is written; if too many wait, the oldest is dropped.

        ``text`` is its JSON, if it was made already.
        """
        with self._lock:
            if len(self._waiting) >= MAX_WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((document, text or document.to_json()))
            if not self._last_error:
                self._written.clear()
        self.wake()

    def last_changes(self) -> dict[str, EventDocument]:
        """Return what :meth:`HistoryReader.last_changes` does; nothing without a database."""
        if self._connection is None:
            return {}
        try:
            return self.reader.last_changes()
        except OtolithError as error:
            self.fail(error)
            return {}

    def messages(
        self, kind: str, limit: int, after: int = 0, start: float | None = None, end: float | None = None
    ) -> list[str]:
        """Return what :meth:`HistoryReader.messages` does, after what is waiting was written; none on an error."""
        self._written.wait(QUERY_WAIT)
        try:
            return self.reader.messages(kind, limit, after, start, end)
        except OtolithError as error:
            if str(error) != self._read_error:
                log.warning("queries are not answered: %s", error)
            self._read_error = str(error)
            return []

    def write(self) -> None:
        """Write what is waiting, and delete what is too old or too much; the last call closes the database.

        Reports and events are written at once: they are exactly what was published, also after a kill. Values, states,
        findings and counters follow once in ``MERGE_INTERVAL``, with an event and at the end. They follow from the
        reports, so those of a daemon that was killed are written by the next one.
        """
        try:
            self._work(time.monotonic())
        finally:
            if self._stopping.is_set():
                self._close()

    def fail(self, error: Exception) -> None:
        """Log an error, once while it stays the same; queries do not wait meanwhile."""
        super().fail(error)
        self._written.set()

    def _work(self, now: float) -> None:
        if self._connection is not None and not self._is_in_place():
            self._close()
            if not self._path.parent.parent.is_dir():
                raise ServiceError("the state directory was removed: restart the daemon")
        if self._connection is None:
            self._open()
        self._limit_log()
        self._retention.labels = self.labels
        try:
            self._write_waiting(now)
        except sqlite3.Error as error:
            if _code(error) in DAMAGED:
                log.warning("%s", self._begin_anew(str(error)))
            elif _code(error) == sqlite3.SQLITE_FULL:
                self._retention.by_size(time.time())
            else:
                raise
            self._write_waiting(now)
        self._retention.by_size(time.time())
        if now - self._pruned_at >= PRUNE_INTERVAL:
            self._retention.by_age(time.time(), now - self._pruned_at)
            self._pruned_at = now

    def _write_waiting(self, now: float = math.inf) -> None:
        """Write what is waiting, and the values of what is written if they are due at ``now`` (monotonic, s)."""
        self._write_reports()
        is_urgent = self._is_urgent or self._stopping.is_set()
        is_due = len(self._unmerged) >= BATCH or now - self._merged_at >= MERGE_INTERVAL
        if self._unmerged and (is_urgent or is_due):
            self._merge()
            self._merged_at = time.monotonic()

    def _merge(self) -> None:
        assert self._connection is not None  # noqa: S101 - for mypy
        try:
            with self._connection:
                self._tables.merge(self._written_reports())
        except BaseException:
            self._tables.forget_series()
            raise
        self._unmerged, self._is_urgent = {}, False
        # Else the pages that were written stay in memory, of each machine of a hall up to 2 MB.
        self._connection.execute("PRAGMA shrink_memory").fetchall()

    def _written_reports(self) -> Iterator[ReportDocument]:
        """Yield the reports whose values are not written yet; without those that no reader would accept."""
        for text in self._unmerged.values():
            with contextlib.suppress(ValidationError):
                yield ReportDocument.from_json(text)

    def _write_reports(self) -> None:
        assert self._connection is not None  # noqa: S101 - for mypy
        while True:
            with self._lock:
                batch = [self._waiting[index] for index in range(min(BATCH, len(self._waiting)))]
                if not batch:
                    self._written.set()
                    return
            try:
                with self._connection:
                    self._tables.describe(self.description)
                    self._tables.label(self.labels)
                    for document, text in batch:
                        self._tables.add(document, text)
            except BaseException:
                self._tables.forget_series()
                raise
            self._unmerged |= {document.sequence: text for document, text in batch}
            self._is_urgent |= any(event.change for document, _ in batch for event in document.events)
            with self._lock:
                written = set(map(id, batch))
                while self._waiting and id(self._waiting[0]) in written:
                    self._waiting.popleft()

    def _is_in_place(self) -> bool:
        """Return whether the file was neither deleted nor moved by somebody: what is written there would be lost."""
        with contextlib.suppress(OSError):
            return os.path.samestat(self._path.stat(), self._file)
        return False

    def _limit_log(self) -> None:
        """Raise ServiceError if a process that reads keeps the write-ahead log from being merged."""
        assert self._connection is not None  # noqa: S101 - for mypy
        file = self._path.with_name(f"{self._path.name}-wal")
        if file.exists() and file.stat().st_size > MAX_LOG_BYTES:
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            if file.stat().st_size > MAX_LOG_BYTES:
                raise ServiceError("another process keeps it open for reading: end it")

    def _open(self) -> str:
        """Open the database; one that cannot be used is kept under another name. Returns why, or nothing."""
        try:
            self._connect()
        except NewerVersionError as error:
            raise ServiceError(str(error)) from error
        except (sqlite3.Error, ValueError) as error:
            if isinstance(error, sqlite3.Error) and _code(error) not in {*DAMAGED, sqlite3.SQLITE_ERROR}:
                raise
            note = self._begin_anew(str(error))
            log.warning("%s", note)
            return note
        return ""

    def _begin_anew(self, reason: str) -> str:
        """Keep the database under another name, and open a new one. Returns what was done and why."""
        self._close()
        stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S%f")
        kept = self._path.with_name(f"{self.reader.site}.{self.reader.machine}.{stamp}{KEPT}")
        for suffix in ("-wal", ""):  # the log belongs to it
            with contextlib.suppress(FileNotFoundError):
                self._path.with_name(f"{self._path.name}{suffix}").rename(kept.with_name(f"{kept.name}{suffix}"))
        self._path.with_name(f"{self._path.name}-shm").unlink(missing_ok=True)
        self._limit_kept(kept)
        self._connect()
        return f"{self._path}: begun anew: {reason}; the file is kept as {kept.name}"

    def _limit_kept(self, latest: Path) -> None:
        """Delete the oldest kept databases beyond the size of a history; the ``latest`` stays, with any clock."""
        total, names = 0, self._path.parent.glob(f"{self.reader.site}.{self.reader.machine}.*{KEPT}")
        for path in sorted(names, key=lambda path: (path == latest, path.name), reverse=True):
            total += path.stat().st_size
            if path != latest and total > self._bounds.max_bytes:
                path.unlink()
                path.with_name(f"{path.name}-wal").unlink(missing_ok=True)

    def _connect(self) -> None:
        with opened_folder(self._path.parent) as folder:  # SQLite gives its own files the owner of this one
            handle = os.open(self._path.name, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600, dir_fd=folder)
            give_to(os.fstat(folder), handle)
            self._file = os.fstat(handle)
            os.close(handle)
        self._connection = sqlite3.connect(self._path, timeout=BUSY_TIMEOUT, check_same_thread=False)
        try:
            self._prepare(self._connection)
        except BaseException:
            self._close()
            raise

    def _prepare(self, connection: sqlite3.Connection) -> None:
        if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            create(connection, self.reader.site, self.reader.machine)
        site, machine = check(connection)
        if (site, machine) != (self.reader.site, self.reader.machine):
            raise ValueError(f"it is of {machine} at {site}")
        upgrade(connection, "main")
        connection.execute("PRAGMA synchronous = NORMAL")
        (page_size,) = connection.execute("PRAGMA page_size").fetchone()
        connection.execute(f"PRAGMA wal_autocheckpoint = {CHECKPOINT_BYTES // page_size}").fetchall()
        connection.execute("PRAGMA journal_size_limit = 0").fetchall()
        self._tables, self._retention = Tables(connection, int(time.time())), Retention(connection, self._bounds)
        reports, run = self._tables.unmerged()
        with connection:
            Tables(connection, run).merge(report for report in reports if report.sequence not in self._unmerged)
            self._tables.begin()

    def _begin_numbers(self, now: float) -> Numbers:
        """Return where the numbers continue; it is saved before the first of them is published."""
        assert self._connection is not None  # noqa: S101 - for mypy
        tables = "report", "event", "start"
        queries = (f"SELECT coalesce(max(sequence), 0) FROM {table}" for table in tables)  # noqa: S608 - our own names
        report, event, start = (self._connection.execute(query).fetchone()[0] for query in queries)
        numbers = Numbers(now, report or None, event or None, start)
        with self._connection:
            self._connection.execute("DELETE FROM start")
            self._connection.execute("INSERT INTO start VALUES (?)", (numbers.start,))
        return numbers

    def _close(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(sqlite3.Error):
                self._connection.close()
            self._connection = None


def history_of(file: MachineFile) -> HistoryWriter | None:
    """Return the history of a machine; None if its file disables it. Raises as :func:`history_path`."""
    table, names = file.history, file.machine
    if not table.enabled:
        return None
    bounds = Bounds(table.max_megabytes * 1_000_000, table.days, table.resend_hours)
    return HistoryWriter(history_path(names.site, names.name), bounds)


def _code(error: sqlite3.Error) -> int:
    """Return the primary code of SQLite; 0 for an error of the Python module itself."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF
