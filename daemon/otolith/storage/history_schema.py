"""The tables of a history and their versions: creating, checking, and upgrading what an earlier version wrote."""

import contextlib
import json
import logging
import sqlite3
from collections.abc import Callable
from typing import Literal

from otolith.storage.history_safety import check_tables

log = logging.getLogger(__name__)

SCHEMA_VERSION = 5
STRICT_SINCE = (3, 37)  # version of SQLite that has strict tables
APPLICATION_ID = 0x4F544F4C  # marks the file as ours: "OTOL"
PAGE_BYTES = 1024  # of a page of a new database; each report writes every page that it changes as a whole

Place = Literal["main", "temp"]
TYPES = frozenset({"INTEGER", "REAL", "TEXT", "BLOB"})  # of columns; a strict table refuses values of another type

_SCHEMA = """
CREATE TABLE identity (site TEXT NOT NULL, machine TEXT NOT NULL) STRICT;
CREATE TABLE series (id INTEGER PRIMARY KEY, name TEXT NOT NULL, unit TEXT NOT NULL, UNIQUE (name, unit)) STRICT;
CREATE TABLE sample (
    resolution INTEGER NOT NULL, time REAL NOT NULL, series INTEGER NOT NULL, count INTEGER NOT NULL,
    min REAL NOT NULL, mean REAL NOT NULL, max REAL NOT NULL, last REAL NOT NULL, low REAL, high REAL,
    status TEXT NOT NULL, PRIMARY KEY (resolution, time, series)) WITHOUT ROWID, STRICT;
CREATE TABLE report (sequence INTEGER PRIMARY KEY, time REAL NOT NULL, text BLOB NOT NULL) STRICT;
CREATE TABLE event (sequence INTEGER PRIMARY KEY, time REAL NOT NULL, text TEXT NOT NULL) STRICT;
CREATE TABLE finding (
    id TEXT NOT NULL, first REAL NOT NULL, last REAL NOT NULL, count INTEGER NOT NULL, text TEXT NOT NULL,
    PRIMARY KEY (id, first)) WITHOUT ROWID, STRICT;
CREATE TABLE counters (hour REAL NOT NULL, run INTEGER NOT NULL, text TEXT NOT NULL, PRIMARY KEY (hour, run)) STRICT;
CREATE TABLE clock (retention REAL NOT NULL, waited REAL NOT NULL) STRICT;
CREATE TABLE start (sequence INTEGER NOT NULL) STRICT;
"""
_STATE = """
CREATE TABLE {place}.state (
    part TEXT NOT NULL, sequence INTEGER NOT NULL, entered REAL NOT NULL, since REAL NOT NULL, state TEXT NOT NULL,
    PRIMARY KEY (part, sequence)) WITHOUT ROWID, STRICT
"""
_DESCRIPTION = "CREATE TABLE {place}.description (text TEXT NOT NULL) STRICT"
# See otolith.health.labels
_LABEL = "CREATE TABLE {place}.label (begin REAL PRIMARY KEY, ahead REAL NOT NULL) STRICT"


_MERGED = "CREATE TABLE merged (sequence INTEGER NOT NULL, run INTEGER NOT NULL) STRICT"  # See Tables.merge
_INDEXES = {
    "report_time": "CREATE INDEX report_time ON report (time)",
    "event_time": "CREATE INDEX event_time ON event (time)",
}
"""By name, as SQLite keeps their statements."""


class NewerVersionError(ValueError):
    """A later version of Otolith wrote the database, or it needs a later SQLite than this computer has."""


def create(connection: sqlite3.Connection, site: str, machine: str) -> None:
    """Make an empty database a history; raise NewerVersionError if this computer has an older SQLite."""
    _need_strict_tables()
    connection.execute(f"PRAGMA page_size = {PAGE_BYTES}")
    connection.execute("PRAGMA auto_vacuum = INCREMENTAL")
    connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
    connection.execute("PRAGMA journal_mode = WAL")
    later = "; ".join(table.format(place="main") for table in (_STATE, _DESCRIPTION, _LABEL))
    later = "; ".join((later, _MERGED, *_INDEXES.values()))
    connection.executescript(f"BEGIN; {_SCHEMA}{later}; PRAGMA user_version = {SCHEMA_VERSION}; COMMIT")
    with connection:
        connection.execute("INSERT INTO identity VALUES (?, ?)", (site, machine))
        connection.execute("INSERT INTO merged VALUES (0, 0)")


def check(connection: sqlite3.Connection) -> tuple[str, str]:
    """Return site and machine of an open database.

    Raises:
        NewerVersionError: a later version of Otolith wrote it, or this computer has an older SQLite.
        ValueError: it is no history of one machine.
        sqlite3.Error: it is damaged or cannot be read.
    """
    _need_strict_tables()
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    version = _version(connection)
    if application != APPLICATION_ID:
        raise ValueError("it is no history of Otolith")
    if version > SCHEMA_VERSION:
        newer = f"version {version} of the format, and this Otolith reads 1 to {SCHEMA_VERSION}"
        raise NewerVersionError(f"{newer}: install the newer Otolith again, or move the file away")
    if version < 1:
        raise ValueError(f"version {version} of the format: this Otolith reads 1 to {SCHEMA_VERSION}")
    check_tables(connection, frozenset(_INDEXES.items()))
    rows = connection.execute("SELECT site, machine FROM identity LIMIT 2").fetchall()
    if len(rows) != 1 or not all(isinstance(name, str) for name in rows[0]):
        raise ValueError("it is not of one machine")
    site, machine = rows[0]
    return site, machine


def _need_strict_tables() -> None:
    if sqlite3.sqlite_version_info < STRICT_SINCE:
        needed = ".".join(map(str, STRICT_SINCE))
        raise NewerVersionError(f"SQLite {sqlite3.sqlite_version} is too old: a history needs {needed} or later")


def upgrade(connection: sqlite3.Connection, place: Place) -> None:
    """Give a checked database the tables of the present version: in ``main`` all or nothing, or for this connection.

    Tables in ``temp`` hide those of the file, which may be read-only then.

    Raises:
        sqlite3.Error: it is damaged, or the disk refuses.
    """
    if (version := _version(connection)) == SCHEMA_VERSION:
        return
    with connection:
        connection.execute("BEGIN IMMEDIATE" if place == "main" else "BEGIN")
        for number in range(version, SCHEMA_VERSION):
            _UPGRADES[number](connection, place)
        if place == "main":
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")


def _version(connection: sqlite3.Connection) -> int:
    return int(connection.execute("PRAGMA user_version").fetchone()[0])


def _from_1(connection: sqlite3.Connection, place: Place) -> None:
    """Version 1 kept the begin of the cause of a state, but not when a report had the state first.

    The change of the event from the same time has that; a state without event began with its window.
    """
    entered: dict[tuple[str, float, str], float] = {}
    for time, text in connection.execute("SELECT time, text FROM event ORDER BY sequence"):
        with contextlib.suppress(ValueError, TypeError, KeyError):  # what the disk has damaged
            event = json.loads(text)
            for part in ("", event["part"]):
                entered.setdefault((part, event["since"], event["state"]), time)
    tables = {name for (name,) in connection.execute("SELECT name FROM main.sqlite_master")}
    states = connection.execute("SELECT part, since, state FROM main.state").fetchall() if "state" in tables else []
    if "description" not in tables:  # nor did its first releases have these two tables
        connection.execute(_DESCRIPTION.format(place=place))
    if place == "main":
        connection.execute("DROP TABLE IF EXISTS main.state")
    connection.execute(_STATE.format(place=place))
    rows = sorted((entered.get((part, since, state), since), since, part, state) for part, since, state in states)
    numbered = ((part, number, begin, since, state) for number, (begin, since, part, state) in enumerate(rows))
    connection.executemany(f"INSERT INTO {place}.state VALUES (?, ?, ?, ?, ?)", numbered)  # noqa: S608 - our own names


def _from_2(connection: sqlite3.Connection, place: Place) -> None:
    """Version 2 had Unix times, and whatever the clock said: they are the labels of themselves."""
    connection.execute(_LABEL.format(place=place))


def _from_3(connection: sqlite3.Connection, place: Place) -> None:
    """Version 3 had no index by time, and wrote the values of a report together with it."""
    if place == "main":  # a reader does without
        connection.execute(_MERGED)
        connection.execute("INSERT INTO merged SELECT coalesce(max(sequence), 0), 0 FROM report")
        for statement in _INDEXES.values():
            connection.execute(statement)


def _from_4(connection: sqlite3.Connection, place: Place) -> None:
    """Version 4 had tables that take values of any type; rows stay where they are, but for those that are damaged.

    SQLite stores a value of the right type in a strict table as in another one, so the statement of the table alone is
    changed: a copy would need the disk twice.
    """
    if place == "temp":  # a reader does without
        return
    kinds = connection.execute("SELECT name, wr FROM pragma_table_list WHERE schema = 'main' AND NOT strict").fetchall()
    loose = {name: ", STRICT" if is_without_rowid else " STRICT" for name, is_without_rowid in kinds
             if not name.startswith("sqlite_")}  # fmt: skip
    damaged = sum(_delete_other_types(connection, table) for table in loose)
    if damaged:
        log.warning("%d rows of a history that the disk has damaged are deleted", damaged)
    (number,) = connection.execute("PRAGMA schema_version").fetchone()
    connection.execute("PRAGMA writable_schema = ON")
    try:
        change = "UPDATE sqlite_master SET sql = rtrim(sql, char(9, 10, 13, 32)) || ? WHERE type = 'table' AND name = ?"
        connection.executemany(change, ((more, table) for table, more in loose.items()))
        connection.execute(f"PRAGMA schema_version = {number + 1}")  # other connections read the statements again
    finally:
        connection.execute("PRAGMA writable_schema = RESET")


def _delete_other_types(connection: sqlite3.Connection, table: str) -> int:
    """Delete the rows with a value that is not of the type of its column, and return how many."""
    columns = connection.execute('SELECT name, type, "notnull" FROM pragma_table_info(?)', (table,)).fetchall()
    if unknown := {kind for _, kind, _ in columns} - TYPES:
        raise ValueError(f"table {table!r:.40} has a column of type {min(unknown)!r:.40}, and no history has one")
    wrong = " OR ".join(
        f"typeof({_quoted(column)}) NOT IN ('{kind.lower()}', '{kind.lower() if is_required else 'null'}')"
        for column, kind, is_required in columns
    )
    return connection.execute(f"DELETE FROM {_quoted(table)} WHERE {wrong}").rowcount  # noqa: S608 - names are quoted


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


_UPGRADES: dict[int, Callable[[sqlite3.Connection, Place], None]] = {1: _from_1, 2: _from_2, 3: _from_3, 4: _from_4}
"""By the version that they upgrade to the next one."""
