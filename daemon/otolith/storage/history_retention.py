"""How the history of a machine stays bounded: by age and by size."""

import math
import sqlite3
from dataclasses import dataclass
from functools import partial

from otolith.storage.history import DAY, HOUR, MINUTE, WINDOW

# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
AGES = {WINDOW: 1.0 * DAY, MINUTE: 14.0 * DAY, HOUR: 366.0 * DAY}  # s; of days, events and findings the machine file
MAX_LEAP = 1.0 * DAY  # s by which the clock may pass the time that the daemon ran
LEAP_PATIENCE = 1.0 * DAY  # s of operation after which a clock that leapt is used
MAX_AHEAD = 1.0 * DAY  # s after the present from which a time is that of a wrong clock
HARD_SHARE, PRUNED_SHARE = 0.9, 0.8  # of the size limit: never exceeded, and kept by deleting
MIN_REPORTS = 1800  # that are kept before coarser values go
CHUNK = 1000  # rows of a table in one transaction
PAGES_AT_ONCE = 1000  # that are given back to the file system in one transaction


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the history of a machine may take."""

    max_bytes: int
    """Of all its files."""
    days: float
    """Age of what is kept longest."""
    resend_hours: float
    """Age of whole reports."""


class Retention:
    """Deletes what is older or more than the bounds allow."""

    def __init__(self, connection: sqlite3.Connection, bounds: Bounds) -> None:
        self._connection, self._bounds = connection, bounds
        (self._page_size,) = connection.execute("PRAGMA page_size").fetchone()
        self._limit()

    def by_age(self, now: float, elapsed: float) -> None:
        """Delete what is too old at the Unix time ``now``, ``elapsed`` s of operation after the last call."""
        clock, longest = self._clock(now, elapsed), self._bounds.days * DAY
        for resolution in (*AGES, DAY):
            oldest = clock - min(AGES.get(resolution, longest), longest)
            while self._delete_samples(resolution, oldest):
                pass
        # By sequence: a report from a time when the clock was ahead goes with those that were published after it.
        oldest_rows = f"(SELECT sequence, time FROM report ORDER BY sequence LIMIT {CHUNK})"  # noqa: S608 - our own names
        latest = f"(SELECT max(sequence) FROM {oldest_rows} WHERE time < ?)"  # noqa: S608 - our own names
        resend = clock - min(self._bounds.resend_hours * HOUR, longest)
        while self._delete_reports(f"sequence <= {latest}", resend):
            pass
        for table, column in (("event", "time"), ("finding", "last"), ("counters", "hour"), ("state", "since")):
            self._delete(f"DELETE FROM {table} WHERE {column} < ?", clock - longest)  # noqa: S608 - our own names

    def by_size(self, now: float) -> None:
        """Delete the oldest details, then the oldest rest, until the size is within its bound."""
        if not self._is_too_large():
            return
        self._delete("DELETE FROM sample WHERE time > ?", now + MAX_AHEAD)
        steps = (
            partial(self._delete_details, MIN_REPORTS, now - HOUR),
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
        keys = {"event": "sequence", "finding": "(id, first)", "counters": "(hour, run)", "state": "(part, since)"}
        orders = {"event": "sequence", "finding": "last", "counters": "run, hour", "state": "since"}
        for table, key in keys.items():
            chosen = f"SELECT {key.strip('()')} FROM {table} ORDER BY {orders[table]} LIMIT {CHUNK}"  # noqa: S608 - our own names
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
