"""What reading a history may cost: a database that was copied from elsewhere is no reason for hours or gigabytes.

Bytes of the file bound little: a view computes rows without end, a column computes its value, and a text is a thousand
times larger when it is unpacked. So tables have to be tables, and time, rows and sizes have bounds of their own.
"""

import math
import sqlite3
import time
import zlib
from typing import Any

from otolith_drivers.errors import ConfigurationError

# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
QUERY_TIME = 60.0  # s for one query
STEPS = 10_000  # instructions of SQLite between two looks at the time
MAX_ROWS = 1_000_000  # of one query
MAX_VALUE_BYTES = 4 << 20  # of a text in the database
MAX_HEAP_BYTES = 256 << 20  # of SQLite itself, in the whole process
MAX_REPORT_BYTES = 4 << 20  # of an unpacked report
MAX_TEXT_BYTES = 128 << 20  # of all texts that a query returns, or that are unpacked for one
LAST_TIME = 253_402_300_799.0  # Unix s: the end of the year 9999, the last one that has a date


def bound(connection: sqlite3.Connection) -> None:
    """Bound time and memory of what an open connection computes; sqlite3.OperationalError is raised beyond them."""
    end = time.monotonic() + QUERY_TIME
    connection.set_progress_handler(lambda: time.monotonic() > end, STEPS)
    connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_VALUE_BYTES)
    for pragma in ("trusted_schema = OFF", "cell_size_check = ON", f"hard_heap_limit = {MAX_HEAP_BYTES}"):
        connection.execute(f"PRAGMA {pragma}").fetchall()


def check_tables(connection: sqlite3.Connection, indexes: frozenset[tuple[str, str]]) -> None:
    """Check that a database has nothing but tables that are stored, and ``indexes`` (name and statement).

    Raises ValueError if something is computed.
    """
    for kind, name, text in connection.execute("SELECT type, name, sql FROM sqlite_master"):
        is_own = kind == "index" and (text is None or (name, text) in indexes)  # None: of a primary key
        is_virtual = kind == "table" and str(text)[:20].upper().startswith("CREATE VIRTUAL")
        if is_virtual or not (kind == "table" or is_own):
            raise ValueError(
                f"it has a {'virtual table' if is_virtual else kind}, {name!r:.40}, and no history has one"
            )
    computed = "SELECT t.name FROM sqlite_master AS t, pragma_table_xinfo(t.name) AS c WHERE c.hidden LIMIT 1"
    if row := connection.execute(computed).fetchone():
        raise ValueError(f"a column of {row[0]!r:.40} is computed, and no history has such a one")


def rows_of(cursor: sqlite3.Cursor) -> list[tuple[Any, ...]]:
    """Return the rows of a query; raise ValueError if they are too many or too large."""
    rows, size = [], 0
    for row in cursor:
        rows.append(row)
        size += sum(len(value) for value in row if isinstance(value, str | bytes))
        if len(rows) > MAX_ROWS or size > MAX_TEXT_BYTES:
            many = f"more than {MAX_ROWS} rows, or {MAX_TEXT_BYTES >> 20} MB"
            raise ValueError(f"{many}: ask for less, with --since, --every or --parameter")
    return rows


def moment(value: object) -> float:
    """Return a time in s, or raise ValueError if it is none that has a date."""
    if not isinstance(value, int | float) or not -LAST_TIME < value < LAST_TIME:
        raise ValueError("no time")
    return float(value)


def number(value: object) -> float:
    """Return a number, or raise ValueError if it is none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("no number")
    return float(value)


class Unpacker:
    """Unpacks the texts of a query."""

    def __init__(self) -> None:
        self._left = MAX_TEXT_BYTES

    def __call__(self, packed: bytes | str) -> str:
        """Return a text.

        Raises:
            ValueError, zlib.error: it is damaged, or too large.
            ConfigurationError: all of them are too large.
        """
        if not isinstance(packed, bytes):
            return packed
        expanding = zlib.decompressobj()
        data = expanding.decompress(packed, MAX_REPORT_BYTES)
        self._left -= len(data)
        if self._left < 0:
            raise ConfigurationError(f"the reports of a history take more than {MAX_TEXT_BYTES >> 20} MB")
        if not expanding.eof:
            raise ValueError(f"cut off, or larger than {MAX_REPORT_BYTES} bytes")
        return data.decode()
