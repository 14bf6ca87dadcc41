"""The history of one machine in an SQLite database: what it keeps, and how it is read.

A value of each parameter and window is kept, and merged into its minute, hour and day at once, so that nothing has to
be summarised later. Times in the tables are service times, in s, and so are those of the documents in them; what is
read has Unix times, as the labels say that are known by then. Writer and retention:
:mod:`otolith.storage.history_writer`; any number of processes may read meanwhile.
"""

import contextlib
import json
import logging
import math
import sqlite3
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field

from otolith.health.diagnosis import MonitoringPlan, Rule
from otolith.health.labels import TimeLabels
from otolith.health.limits import Level
from otolith.health.schema import (
    EventDocument,
    FindingDocument,
    Language,
    NumberDocument,
    ParameterDocument,
    PartDocument,
    PerformanceDocument,
    ReportDocument,
)
from otolith.storage.history_safety import QUERY_TIME, Unpacker, bound, moment, number, rows_of
from otolith.storage.history_schema import check, upgrade
from otolith.twin.definition import Definition, Role
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.grammars.json_lines import json_text
from otolith_drivers.user_dirs import state_directory

Content = TypeVar("Content")

log = logging.getLogger(__name__)

SUFFIX = ".history.sqlite"
KEPT = ".kept.sqlite"  # of one that was set aside
PERFORMANCE = "performance."  # Before the name of a figure of performance, as the name of its values
WINDOW, MINUTE, HOUR, DAY = 0, 60, 3600, 86_400
RESOLUTIONS = {WINDOW: "window", MINUTE: "minute", HOUR: "hour", DAY: "day"}
"""Seconds of an interval, and its name; 0 for the windows themselves."""
# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
BUSY_TIMEOUT = 2.0  # s to wait for another process that reads or writes
CHECKPOINT_BYTES = 1 << 20  # of the write-ahead log, after which it is merged
COMPRESSION = 1  # level of zlib
LATEST_CHANGES = 2000  # changes of events that are searched for those that were left open
SEARCHED_REPORTS = 10  # of which one that the disk has not damaged has the language and the zone
FINDING_PAUSE = 3600.0  # s after which a finding that returns is a new one

# What the content of a row raises that the disk has damaged.
DAMAGES = (zlib.error, ValueError, TypeError, LookupError, RecursionError)

# By sequence: versions without labels wrote the time of a wrong clock.
_SINCE = "WHERE sequence >= (SELECT min(+sequence) FROM event WHERE time >= ?)"  # '+': by the index of time
_SAMPLE = """
INSERT INTO sample VALUES (?, ?, ?, 1, ?4, ?4, ?4, ?4, ?5, ?6, ?7) ON CONFLICT DO UPDATE SET
    count = count + 1, min = min(min, excluded.min), mean = mean + (excluded.mean - mean) / (count + 1),
    max = max(max, excluded.max), last = excluded.last, low = excluded.low, high = excluded.high,
    status = excluded.status
"""


@dataclass(frozen=True, slots=True)
class HistorySample:
    """A parameter in an interval of time."""

    name: str
    unit: str
    time: float  # Begin of the interval; of a window its end
    count: int  # Windows in it
    min: float
    mean: float
    max: float
    last: float
    low: float | None  # Lower end of the 95 % interval of last
    high: float | None
    status: str  # Of the last window; of a component adopted or fading


@dataclass(frozen=True, slots=True)
class PartState:
    """A state of a part, or of the machine."""

    part: str  # Empty for the machine
    entered: float  # End of the window that showed it first, Unix s: it was announced from then on
    since: float  # Begin of its cause, which may be long before
    state: Level


def history_directory() -> Path:
    """Return the folder of the databases; raise ServiceError if there is no home directory."""
    return state_directory() / "history"


def history_path(site: str, machine: str) -> Path:
    """Return the path of a machine's database; raises as :func:`history_directory`."""
    return path_in(history_directory(), site, machine)


def path_in(folder: Path, site: str, machine: str) -> Path:
    """Return the path of a machine's database in a folder."""
    return folder / f"{site}.{machine}{SUFFIX}"


def describe_machine(
    twin: Definition,
    plan: MonitoringPlan,
    log: Mapping[str, Any] | None = None,
    file: Path | None = None,
    given: Mapping[str, float] | None = None,
) -> str:
    """Return as JSON what reports do not repeat: the equations, and the meaning and the limits of each parameter.

    ``log`` tells of the data that were replayed: ``files``, their names, and ``warnings``, what a reader must know.
    ``given`` has the parameters that the machine file gives; the others have the values of the twin's example.
    ``file`` is the machine file, by which commands find it that are given the name of the machine.
    """
    sides = [(name, text) for name, text, _ in twin.definitions]
    rows, stated = [row for row in twin.parameters if row.role is not Role.SETTING], given or {}
    values = {row.name: (stated.get(row.name, row.nominal), row.unit, row.meaning) for row in rows}
    limits = {name: [(row.level, row.value, row.is_lower) for row in quantity.limits]
              for name, quantity in {**plan.sites, **plan.parameters}.items()}  # fmt: skip
    sites = {row.name: (row.into, row.mode, row.through) for row in twin.sites}
    places = {row.name: row.meaning for row in twin.sites}
    texts = {"title": twin.title, "equations": [*twin.equations, *sides]} | ({} if log is None else {"log": log})
    texts |= {} if file is None else {"file": str(file.absolute())}
    rules = [rule.model_dump(mode="json", exclude={"is_own"}) for rule in plan.rules if rule.is_own]
    units = {row.name: row.unit for rows in (twin.states, twin.inputs, twin.outputs) for row in rows}
    keys = {"values": values, "units": units, "limits": limits, "sites": sites, "places": places, "rules": rules}
    return json_text({**texts, **keys})


class _Description(BaseModel):
    """What :func:`describe_machine` writes; other versions may write less, or more."""

    title: str = ""
    file: str = ""
    equations: tuple[tuple[str, str], ...] = ()
    values: dict[str, tuple[float | None, str, str]] = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)  # Of states, inputs and outputs
    limits: dict[str, tuple[tuple[Level, float, bool], ...]] = Field(default_factory=dict)
    sites: dict[str, tuple[str, str, str]] = Field(default_factory=dict)
    rules: tuple[Rule, ...] = ()
    places: dict[str, str] = Field(default_factory=dict)  # Meanings of the sites
    log: dict[str, tuple[str, ...]] | None = None


class Tables:
    """Writes reports into the tables of an open database; the caller commits."""

    def __init__(self, connection: sqlite3.Connection, run: int) -> None:
        """``run`` distinguishes the counters of this daemon from those before: they begin at zero with each start."""
        self._connection, self._run = connection, run
        self._series: dict[tuple[str, str], int] = {}
        self._description = ""
        self._states: dict[str, tuple[str, float, int]] = {}
        """The last state of each part as it is written: with the begin of its cause, and its sequence number."""
        self._labels: TimeLabels | None = None

    def describe(self, text: str) -> None:
        """Write the description of the machine, as :func:`describe_machine` returns it, if it has changed."""
        if text != self._description:
            self._connection.execute("DELETE FROM description")
            self._connection.execute("INSERT INTO description VALUES (?)", (text,))
            self._description = text

    def label(self, labels: TimeLabels) -> None:
        """Write the Unix times of service times, if they have changed."""
        if labels != self._labels:
            self._connection.execute("DELETE FROM label")
            self._connection.executemany("INSERT INTO label VALUES (?, ?)", labels.spans)
            self._labels = labels

    def add(self, document: ReportDocument, text: str = "") -> None:
        """Write a report with service times, and the events that it changed; :meth:`merge` writes the rest.

        ``text`` is the JSON of the report, if it was made already.
        """
        execute, end = self._connection.execute, document.window.end
        packed = zlib.compress((text or document.to_json()).encode(), COMPRESSION)
        execute("INSERT OR REPLACE INTO report VALUES (?, ?, ?)", (document.sequence, end, packed))
        for event in document.events:
            if event.change is not None:
                row = (event.sequence, end, event.json_line())
                execute("INSERT OR REPLACE INTO event VALUES (?, ?, ?)", row)

    def merge(self, documents: Iterable[ReportDocument]) -> None:
        """Write values, states, findings and counters of reports that were added, in their order.

        They change the same pages of the file each time, so that many reports together write little more than one.
        """
        for document in documents:
            self._merge(document)
            self._connection.execute("UPDATE merged SET sequence = ?, run = ?", (document.sequence or 0, self._run))

    def begin(self) -> None:
        """Note the ``run`` of the reports to come, for :meth:`unmerged`."""
        self._connection.execute("UPDATE merged SET run = ?", (self._run,))

    def unmerged(self) -> tuple[list[ReportDocument], int]:
        """Return the reports that a daemon added before it was killed, and its ``run``; without damaged ones."""
        execute, unpacked, reports = self._connection.execute, Unpacker(), list[ReportDocument]()
        later = "sequence > (SELECT sequence FROM merged)"
        for (text,) in execute(f"SELECT text FROM report WHERE {later} ORDER BY sequence"):  # noqa: S608 - our own text
            with contextlib.suppress(*DAMAGES, ConfigurationError):
                reports.append(ReportDocument.from_json(unpacked(text)))
        return reports, int(execute("SELECT run FROM merged").fetchone()[0])

    def _merge(self, document: ReportDocument) -> None:
        execute, end = self._connection.execute, document.window.end
        for name, parameter in document.parameters.items():
            self._add_value(name, end, parameter, parameter.status)
        for name, figure in (document.performance or {}).items():
            self._add_value(f"{PERFORMANCE}{name}", end, figure, figure.status)
        for component in document.components:
            self._add_value(component.id, end, component.values["amplitude"], component.status)
        if (health := document.health) is not None:
            self._add_states({"": health, **health.parts}, document.sequence or 0, end)
        for finding in document.findings:
            text_of = finding.json_line()
            known = execute(
                "UPDATE finding SET last = ?, count = count + 1, text = ? WHERE id = ? AND last BETWEEN ? AND ?",
                (end, text_of, finding.id, end - FINDING_PAUSE, end + FINDING_PAUSE),
            ).rowcount
            if not known:
                execute("INSERT OR REPLACE INTO finding VALUES (?, ?, ?, 1, ?)", (finding.id, end, end, text_of))
        if document.counters is not None:
            row_of = (end // HOUR * HOUR, self._run, document.counters.model_dump_json())
            # Not by REPLACE, which would change the index as well.
            execute("INSERT INTO counters VALUES (?, ?, ?) ON CONFLICT DO UPDATE SET text = excluded.text", row_of)

    def forget_series(self) -> None:
        """Read the numbers of the series again: a transaction that added some was rolled back."""
        self._series.clear()
        self._states.clear()
        self._description, self._labels = "", None

    def _add_states(self, parts: Mapping[str, PartDocument], sequence: int, end: float) -> None:
        """Write the states that were entered at ``end``; a part that the report does not name any more is at OK."""
        if not self._states:
            query = "SELECT part, state, since, max(sequence) FROM state GROUP BY part"
            self._states = {part: tuple(rest) for part, *rest in self._connection.execute(query)}
        shown: dict[str, tuple[str, float]] = {part: (item.state, item.since) for part, item in parts.items()}
        for part in self._states.keys() - shown.keys():
            shown[part] = Level.OK, end
        for part, (state, since) in shown.items():
            before = self._states.get(part)
            if before is None or before[0] != state:
                values = part, sequence, end, since, state
                self._connection.execute("INSERT OR REPLACE INTO state VALUES (?, ?, ?, ?, ?)", values)
                self._states[part] = state, since, sequence
            elif since < before[1]:
                query = "UPDATE state SET since = ? WHERE part = ? AND sequence = ?"
                self._connection.execute(query, (since, part, before[2]))
                self._states[part] = state, since, before[2]

    def _add_value(
        self, name: str, end: float, item: ParameterDocument | NumberDocument | PerformanceDocument, status: str
    ) -> None:
        if item.value is None:
            return
        series, rest = self._number(name, item.unit), (item.value, item.low, item.high, status)
        rows = [(length, end // length * length if length else end, series, *rest) for length in RESOLUTIONS]
        self._connection.executemany(_SAMPLE, rows)

    def _number(self, name: str, unit: str) -> int:
        key = name, unit
        if key not in self._series:
            self._connection.execute("INSERT OR IGNORE INTO series (name, unit) VALUES (?, ?)", key)
            query = "SELECT id FROM series WHERE name = ? AND unit = ?"
            (self._series[key],) = self._connection.execute(query, key).fetchone()
        return self._series[key]


class HistoryReader:
    """Reads the history of a machine, also while a daemon writes; each call opens the database for itself."""

    def __init__(self, path: Path) -> None:
        """``path`` as :func:`history_path` returns it."""
        self.path = path
        self.site, _, self.machine = path.name.removesuffix(SUFFIX).partition(".")

    @classmethod
    def of_file(cls, path: Path) -> "HistoryReader":
        """Return the reader of a file of any name, as of one that was set aside; raises as :meth:`names`."""
        reader = cls(path)
        with reader._checked() as (connection, identity):
            del connection
            reader.site, reader.machine = identity
        return reader

    def names(self) -> list[str]:
        """Return the names of all series; these and the following methods raise ConfigurationError.

        Raises:
            ConfigurationError: the database is missing, damaged, unreadable or of another version.
        """
        return [name for (name,) in self._rows("SELECT DISTINCT name FROM series ORDER BY id")]

    def samples(self, resolution: int, since: float, names: Sequence[str] = ()) -> list[HistorySample]:
        """Return the values since a time, of the parameters ``names`` or of all, in the order in which they came."""
        chosen = f"AND name IN ({', '.join('?' * len(names))})" if names else ""
        columns = ", ".join(column.name for column in fields(HistorySample))
        query = (
            f"SELECT {columns} FROM sample JOIN series ON series.id = series "  # noqa: S608 - no text of a user
            f"WHERE resolution = ? AND time >= ? {chosen} ORDER BY time, series.id"
        )
        labels = self.labels()
        rows = self._rows(query, resolution, labels.first(since), *names)

        def parse(name: str, unit: str, time: float, count: int, *rest: Any) -> HistorySample:
            *values, low, high, status = rest
            least, mean, most, last = map(number, values)
            low, high = (None if end is None else number(end) for end in (low, high))
            unix = labels.unix(moment(time))
            return HistorySample(
                str(name), str(unit), unix, int(count), least, mean, most, last, low, high, str(status)
            )

        return self._undamaged(rows, parse)

    def first(self, resolution: int) -> float | None:
        """Return the time of the oldest value of a resolution; None if there is none."""
        ((time,),) = self._rows("SELECT min(time) FROM sample WHERE resolution = ?", resolution)
        return None if time is None else self.labels().unix(self._moment(time))

    def events(self, since: float) -> list[EventDocument]:
        """Return the changes of events since a time, in the order in which they were published."""
        labels = self.labels()
        rows = self._rows(f"SELECT text FROM event {_SINCE} ORDER BY sequence", labels.first(since))  # noqa: S608 - our own text
        return self._undamaged(rows, lambda text: labels.of_event(EventDocument.model_validate_json(text)))

    def event_ends(self, since: float) -> dict[int, float]:
        """Return the end (service time) of the window of each change of an event since a time, by sequence number."""
        query = f"SELECT sequence, time FROM event {_SINCE}"  # noqa: S608 - our own text
        rows = self._rows(query, self.labels().first(since))
        return dict(self._undamaged(rows, lambda sequence, time: (int(sequence), moment(time))))

    def last_changes(self) -> dict[str, EventDocument]:
        """Return the last change of each event by its id (service times, of ``LATEST_CHANGES``), the latest first."""
        rows = self._rows("SELECT text FROM event ORDER BY sequence DESC LIMIT ?", LATEST_CHANGES)
        changes: dict[str, EventDocument] = {}
        for event in self._undamaged(rows, EventDocument.model_validate_json):
            changes.setdefault(event.id, event)
        return changes

    def findings(self, since: float) -> list[dict[str, Any]]:
        """Return the findings since a time: ``first``, ``last``, ``count`` of windows, and the latest document."""
        query = "SELECT first, last, count, text FROM finding WHERE last >= ? ORDER BY first"
        labels = self.labels()
        rows = self._rows(query, labels.first(since))

        def parse(first: float, last: float, count: int, text: str) -> dict[str, Any]:
            document = json.loads(text)
            whole = FindingDocument.model_validate(document).model_dump(mode="json")  # also what an older version lacks
            times = {"first": first, "last": last, "since": document.get("since", first)}
            times = {name: labels.unix(moment(time)) for name, time in times.items()}
            return {**whole, **document, "count": int(count), **times}

        return self._undamaged(rows, parse)

    def counters(self, since: float) -> list[dict[str, Any]]:
        """Return the last counters of each hour and start (``run``) of the daemon since a time."""
        labels, query = self.labels(), "SELECT hour, run, text FROM counters WHERE hour >= ? ORDER BY run, hour"
        rows = self._rows(query, labels.first(since) - HOUR)
        return self._undamaged(
            rows,
            lambda hour, run, text: {**json.loads(text), "hour": labels.unix(moment(hour)), "run": int(moment(run))},
        )

    def states(self, since: float) -> list[PartState]:
        """Return the states of the parts in the order in which they were entered, from those at ``since`` on."""
        before = "SELECT part, max(sequence) AS first FROM state WHERE entered <= ? GROUP BY part"
        query = (
            f"SELECT part, entered, since, state FROM state LEFT JOIN ({before}) USING (part) "  # noqa: S608 - our own text
            "WHERE sequence >= coalesce(first, sequence) ORDER BY sequence"
        )
        labels = self.labels()

        def parse(part: str, entered: float, since: float, state: str) -> PartState:
            return PartState(str(part), labels.unix(moment(entered)), labels.unix(moment(since)), Level(state))

        return self._undamaged(self._rows(query, labels.first(since)), parse)

    def description(self) -> dict[str, Any]:
        """Return what :func:`describe_machine` wrote; empty if nobody did."""
        rows = self._rows("SELECT text FROM description LIMIT 1")

        def parse(text: str) -> dict[str, Any]:
            _Description.model_validate_json(text)
            return dict(json.loads(text))

        return next(iter(self._undamaged(rows, parse)), {})

    def own_rules(self) -> tuple[Rule, ...]:
        """Return the rules of the machine file, as :func:`describe_machine` wrote them."""
        rules = _Description.model_validate(self.description()).rules
        return tuple(rule.model_copy(update={"is_own": True}) for rule in rules)

    def labels(self) -> TimeLabels:
        """Return the Unix times of service times, as they are known now."""
        rows = self._rows("SELECT begin, ahead FROM label ORDER BY begin")
        labels = TimeLabels(tuple(self._undamaged(rows, lambda begin, ahead: (moment(begin), moment(ahead)))))
        if not labels.is_plausible:
            raise ConfigurationError(f"{self.path}: cannot be read: the labels of its times are not plausible")
        return labels

    def last(self) -> float:
        """Return the service time at which the window of the newest report ends; minus infinity if there is none."""
        rows = self._rows("SELECT time FROM report ORDER BY sequence DESC LIMIT 1")
        return self._moment(rows[0][0]) if rows else -math.inf

    def latest(self, count: int) -> list[ReportDocument]:
        """Return the last reports, the newest first."""
        rows = self._rows("SELECT text FROM report ORDER BY sequence DESC LIMIT ?", count)
        labels, unpacked = self.labels(), Unpacker()
        reports = self._undamaged(rows, lambda text: labels.of_report(ReportDocument.from_json(unpacked(text))))
        if rows and not reports:
            raise ConfigurationError(f"{self.path}: cannot be read: the disk has damaged the last {len(rows)} reports")
        return reports

    def language_and_zone(self) -> tuple[Language | None, str | None]:
        """Return language and zone of the machine as its newest undamaged report has them; None where it has none."""
        unpacked = Unpacker()
        for (text,) in self._rows("SELECT text FROM report ORDER BY sequence DESC LIMIT ?", SEARCHED_REPORTS):
            with contextlib.suppress(*DAMAGES, ConfigurationError):
                health = ReportDocument.from_json(unpacked(text)).health
                return (None, None) if health is None else (health.language, health.timezone)
        return None, None

    def messages(
        self, kind: str, limit: int, after: int = 0, start: float | None = None, end: float | None = None
    ) -> list[str]:
        """Return documents of a ``kind``, ``report`` or ``event``, the oldest first, with the labels that hold now.

        They have a sequence number above ``after``, and their windows end from ``start`` to ``end``. A ``limit`` is of
        the first ones; one below zero is of the last ones.
        """
        table, labels, unpacked = "event" if kind == "event" else "report", self.labels(), Unpacker()
        begin = -math.inf if start is None else labels.first(start)
        until = math.inf if end is None else labels.last(end)
        # '+': the numbers bound the rows that are read, and the index of time has the numbers.
        numbers = f"FROM {table} WHERE time BETWEEN ?2 AND ?3"
        lower = "?1" if start is None else f"max(?1, (SELECT min(+sequence) {numbers}) - 1)"
        upper = "" if end is None else f"AND sequence <= (SELECT max(+sequence) {numbers})"
        among = f"sequence > {lower} {upper} AND +time BETWEEN ?2 AND ?3"
        order = "DESC" if limit < 0 else "ASC"
        query = f"SELECT text FROM {table} WHERE {among} ORDER BY sequence {order} LIMIT ?4"  # noqa: S608 - as above
        rows = self._rows(query, after, begin, until, abs(limit))[:: -1 if limit < 0 else 1]

        def published(row: bytes | str) -> str:
            text = unpacked(row)
            if not labels.spans:
                return text
            if kind == "event":
                return labels.of_event(EventDocument.model_validate_json(text)).json_line()
            return labels.of_report(ReportDocument.from_json(text)).to_json()

        return self._undamaged(rows, published)

    def _undamaged(self, rows: Iterable[tuple[Any, ...]], parse: Callable[..., Content]) -> list[Content]:
        """Return what ``parse`` returns for each row, without those whose content the disk has damaged."""
        contents, damaged = [], 0
        for row in rows:
            try:
                contents.append(parse(*row))
            except DAMAGES:
                damaged += 1
        if damaged:
            log.warning("%s: %d rows that the disk has damaged are left out", self.path, damaged)
        return contents

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with self._checked() as (connection, identity):
            if identity != (self.site, self.machine):
                raise ValueError(f"it is of {identity[1]} at {identity[0]}")
            return rows_of(connection.execute(query, values))

    def _moment(self, value: object) -> float:
        try:
            return moment(value)
        except ValueError as error:
            raise ConfigurationError(f"{self.path}: cannot be read: it has the time {value!r:.40}") from error

    @contextlib.contextmanager
    def _checked(self) -> Iterator[tuple[sqlite3.Connection, tuple[str, str]]]:
        """Open for reading as a database of the present version, with its site and machine."""
        if not self.path.is_file():  # a pipe would not return
            raise ConfigurationError(f"{self.path}: no such file; 'otolith run' makes the history of a machine")
        try:
            with self._opened() as connection:
                bound(connection)
                identity = check(connection)
                upgrade(connection, "temp")
                yield connection, identity
        except (sqlite3.Error, ValueError) as error:
            is_slow = isinstance(error, sqlite3.OperationalError) and str(error) == "interrupted"
            reason = f"a query takes longer than {QUERY_TIME:g} s" if is_slow else str(error)
            raise ConfigurationError(f"{self.path}: cannot be read: {reason}") from error

    @contextlib.contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """Open for reading; without the write-ahead log, the file does not change and needs no other file beside it."""
        still = "" if self.path.with_name(f"{self.path.name}-wal").exists() else "&immutable=1"
        connection = sqlite3.connect(f"{self.path.absolute().as_uri()}?mode=ro{still}", uri=True, timeout=BUSY_TIMEOUT)
        try:
            yield connection
        finally:
            connection.close()
