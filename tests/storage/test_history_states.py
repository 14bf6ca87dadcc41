"""States of parts over time: what a report announced at an instant is what its history shows there, in any version."""

import contextlib
import shutil
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from otolith.health.limits import LEVELS, Level
from otolith.health.schema import HealthDocument, PartDocument, ReportDocument
from otolith.publishing.html_report import Axis, _lanes
from otolith.storage.history import KEPT, MINUTE, SUFFIX, HistoryReader, Tables
from otolith.storage.history_schema import SCHEMA_VERSION, check, create
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from tests.storage.histories import MACHINE, SITE, START, document

BOUNDS = Bounds(20_000_000, 3650, 24)
KEPT_FILES = Path(__file__).parents[1] / "golden" / "histories"
"""A small history by each version of the format, named by it: 12 windows, an event that is raised and becomes ACT."""
LENGTH = 2.0  # s of a window


def scenario(seed: int) -> Iterator[ReportDocument]:
    """Reports whose parts change their states at random, each with a cause that may be older than the report."""
    noise = np.random.default_rng(seed)
    states = dict.fromkeys(("", "shaft", "winding"), PartDocument(state=Level.OK, since=START))
    end, names = START, list(states)
    for index in range(int(noise.integers(5, 40))):
        end += LENGTH * int(noise.choice([1, 1, 1, 1, 30]))  # sometimes the daemon was off
        for part in names:
            if noise.random() < 0.3:
                since = end - float(noise.choice([LENGTH, 5 * LENGTH, end - START, 1e6]))
                states[part] = PartDocument(state=LEVELS[noise.integers(len(LEVELS))], since=since)
        present = names if noise.random() < 0.9 else names[:-1]  # one outside the twin has a state while it is not OK
        parts = {part: states[part] for part in present if part}
        health = HealthDocument(**dict(states[""]), parts=parts)
        yield document(index, end).model_copy(update={"health": health, "sequence": index + 1})


def kept(path: Path, reports: Sequence[ReportDocument], restart: int) -> HistoryReader:
    connection = sqlite3.connect(path)
    create(connection, SITE, MACHINE)
    connection.execute("PRAGMA synchronous = OFF")
    tables = Tables(connection, 0)
    for number, report in enumerate(reports):
        tables = Tables(connection, number) if number == restart else tables
        with connection:
            tables.add(report)
            tables.merge([report])
    connection.close()
    return HistoryReader(path)


def announced(reports: Sequence[ReportDocument], part: str, at: float) -> Level:
    """The state of a part by the last report before an instant; a part that it does not name is well."""
    (*_, last) = (report for report in reports if report.window.end <= at)
    health = last.health
    assert health is not None
    return health.state if not part else health.parts[part].state if part in health.parts else Level.OK


@pytest.mark.parametrize("seed", range(40))
def test_lanes_show_at_every_instant_what_was_announced(seed: int, tmp_path: Path) -> None:
    reports = list(scenario(seed))
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    reader = kept(path, reports, restart=seed % len(reports))
    first, now = reports[0].window.end, reports[-1].window.end + 1.0
    for begin in (first, 0.5 * (first + now)):
        shown = _lanes(Axis(begin, now, now), reports[-1], reader.states(begin))
        for part, present, pieces in shown:
            assert present is announced(reports, part, now)
            for at in np.arange(begin, now, 0.5 * LENGTH) + 0.1:
                if not any(report.health and (not part or part in report.health.parts) and report.window.end <= at
                           for report in reports):  # fmt: skip
                    continue  # no report has named it yet
                (state,) = (state for state, _, _, start, end in pieces if start <= at < end)
                assert state is announced(reports, part, at)


@pytest.mark.parametrize("steps", [(-3600.0, 3600.0), (-7e8, 7e8), (3600.0, -3600.0), (-50.0,), (60.0, -60.0, -60.0)])
def test_a_clock_that_was_set_shows_no_state_that_was_not_announced(tmp_path: Path, steps: Sequence[float]) -> None:
    noise, offset, state = np.random.default_rng(len(steps)), 0.0, Level.OK
    passes: list[list[ReportDocument]] = [[]]
    for index in range(120):
        if index % 30 == 0 and 0 < index // 30 <= len(steps):
            offset += steps[index // 30 - 1]
            passes.append([])
        end = START + LENGTH * (index + 1) + offset
        state = LEVELS[noise.integers(len(LEVELS))] if index % 7 == 0 else state
        part = PartDocument(state=state, since=min(end - LENGTH, START))
        health = HealthDocument(**dict(part), parts={"winding": part})
        passes[-1].append(document(index, end).model_copy(update={"health": health, "sequence": index + 1}))
    reports = [report for each in passes for report in each]
    now = reports[-1].window.end + 0.1
    states = kept(tmp_path / f"{SITE}.{MACHINE}{SUFFIX}", reports, 50).states(START)
    total = 0.0
    for part_name, _, pieces in _lanes(Axis(START, now, now), reports[-1], states):
        for shown, _, _, begin, end in pieces:
            total += end - max(begin, START)
            for at in np.arange(max(begin, START) + 0.1, min(end, now), LENGTH):
                assert shown in {announced(each, part_name, at) for each in passes if each[0].window.end <= at}
    assert total > 0.0


@pytest.mark.parametrize("version", range(1, SCHEMA_VERSION + 1))
def test_a_history_of_each_version_is_read_and_goes_on_in_place(version: int, tmp_path: Path) -> None:
    source = KEPT_FILES / f"{version}.sqlite"
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(source, path)
    reader, content = HistoryReader(path), path.read_bytes()
    before = read = everything(reader)
    assert path.read_bytes() == content  # who reads changes nothing
    writer = HistoryWriter(path, BOUNDS)
    numbers, note = writer.open(START + 100.0)
    assert note == ""
    read = everything(writer.reader)
    assert read == before
    last = writer.reader.latest(1)[0].sequence
    writer.add(numbers.number(document(20, START + 102.0)))
    writer._write_waiting()
    writer._close()
    assert not list(tmp_path.glob(f"*{KEPT}"))
    assert [report.window.end for report in reader.latest(100)][:2] == [START + 102.0, START + 24.0]
    assert reader.latest(1)[0].previous == last
    with sqlite3.connect(path) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)
        assert statements(connection) == statements_of_a_new_one()
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        for table, column in (("report", "time"), ("sample", "mean"), ("event", "time"), ("state", "since")):
            with pytest.raises(sqlite3.IntegrityError, match="cannot store TEXT"):
                connection.execute(f"UPDATE {table} SET {column} = 'much'")  # noqa: S608 - our own names


def statements(connection: sqlite3.Connection) -> dict[str, str]:
    """The statements of all tables and indexes by name, each blank as one space."""
    rows = connection.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL")
    return {name: " ".join(text.split()) for name, text in rows}


def statements_of_a_new_one() -> dict[str, str]:
    with contextlib.closing(sqlite3.connect(":memory:")) as connection:
        create(connection, SITE, MACHINE)
        return statements(connection)


def test_an_upgrade_leaves_out_the_rows_that_the_disk_has_damaged_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / "4.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE report SET time = x'00' WHERE sequence = (SELECT max(sequence) FROM report)")
        connection.execute("UPDATE sample SET mean = 'much' WHERE resolution = 60")
    connection.close()
    writer = HistoryWriter(path, BOUNDS)
    _, note = writer.open(START + 100.0)
    assert note == ""
    assert len(writer.reader.latest(100)) == 11
    assert [writer.reader.samples(length, 0.0) == [] for length in (0, MINUTE)] == [False, True]
    writer._close()
    assert caplog.text.count("2 rows") == 1
    assert not list(tmp_path.glob(f"*{KEPT}"))


def test_a_table_of_another_type_is_no_history(tmp_path: Path) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / "4.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.execute("ALTER TABLE event ADD COLUMN more VARCHAR")
    connection.close()
    writer = HistoryWriter(path, BOUNDS)
    _, note = writer.open(START + 100.0)
    writer._close()
    assert "VARCHAR" in note
    assert len(list(tmp_path.glob(f"*{KEPT}"))) == 1


def test_an_sqlite_without_strict_tables_costs_the_history_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / "4.sqlite", path)
    content = path.read_bytes()
    monkeypatch.setattr(sqlite3, "sqlite_version_info", (3, 34, 1))
    writer = HistoryWriter(path, BOUNDS)
    writer.open(START + 100.0)
    assert writer._connection is None
    assert "3.37" in caplog.text
    assert path.read_bytes() == content


def everything(reader: HistoryReader) -> tuple[object, ...]:
    """All content of a kept history, once it is checked against what was written."""
    states = reader.states(0.0)
    winding = [(row.entered, row.since, row.state) for row in states if row.part == "winding"]
    assert [state for _, _, state in winding] == [Level.OK, Level.WATCH, Level.ACT]
    assert winding[1:] == [(START + 16.0, START + 5.0, Level.WATCH), (START + 22.0, START + 3.0, Level.ACT)]
    assert [row.state for row in states if not row.part] == [Level.OK, Level.WATCH, Level.ACT]
    (minute,) = reader.samples(MINUTE, START - MINUTE)
    assert (minute.name, minute.count, minute.last) == ("R_a", 12, 6.5 + 0.01 * 11)
    assert [event.change for event in reader.events(0.0)] == ["raised", "changed"]
    assert reader.description() == {"title": "dc_motor"}
    contents = reader.events(0.0), reader.findings(0.0), reader.counters(0.0), reader.latest(100), reader.names()
    assert all(contents)
    return states, reader.samples(0, 0.0), minute, *contents


def test_the_first_releases_of_version_1_had_no_states_and_no_description(tmp_path: Path) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / "1.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.executescript("DROP TABLE state; DROP TABLE description")
    reader = HistoryReader(path)
    assert (reader.states(0.0), reader.description()) == ([], {})
    writer = HistoryWriter(path, BOUNDS)
    numbers, note = writer.open(START + 100.0)
    writer.description = '{"title": "now"}'
    part = PartDocument(state=Level.OK, since=START)
    health = HealthDocument(**dict(part), parts={})
    writer.add(numbers.number(document(20, START + 102.0).model_copy(update={"health": health})))
    writer._write_waiting()
    assert (note, len(reader.latest(100)), reader.description()) == ("", 13, {"title": "now"})
    assert [row.entered for row in reader.states(0.0)] == [START + 102.0]
    writer._close()


def test_an_upgrade_that_the_disk_refuses_changes_nothing_and_is_tried_again(tmp_path: Path) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / "1.sqlite", path)
    with sqlite3.connect(path) as other:
        other.execute("BEGIN EXCLUSIVE")
        writer = HistoryWriter(path, BOUNDS)
        writer.open(START)
        assert writer._connection is None
    other.close()
    assert not list(tmp_path.glob(f"*{KEPT}"))
    writer._open()
    assert len(everything(writer.reader)) > 0
    writer._close()


def test_a_newer_version_is_left_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    shutil.copy(KEPT_FILES / f"{SCHEMA_VERSION}.sqlite", path)
    with sqlite3.connect(path) as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    connection.close()
    content = path.read_bytes()
    writer = HistoryWriter(path, BOUNDS)
    numbers, _ = writer.open(START + 100.0)
    report = numbers.number(document(20, START + 102.0))
    assert report.sequence == int((START + 100.0) * 1e3)
    writer.start()
    writer.add(report)
    writer.stop(5.0)
    assert path.read_bytes() == content
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert caplog.text.count(f"version {SCHEMA_VERSION + 1}") == 1
    with pytest.raises(ConfigurationError, match=f"{path}.*version {SCHEMA_VERSION + 1}.*1 to {SCHEMA_VERSION}"):
        HistoryReader(path).events(0.0)


def test_a_history_is_read_under_any_name(tmp_path: Path) -> None:
    for name in (f"{SITE}.{MACHINE}.20260131T101112000000{KEPT}", "copy.sqlite"):
        path = tmp_path / name
        shutil.copy(KEPT_FILES / "1.sqlite", path)
        reader = HistoryReader.of_file(path)
        assert (reader.site, reader.machine) == (SITE, MACHINE)
        assert everything(reader)
    (tmp_path / "text.sqlite").write_text("half a file")
    with pytest.raises(ConfigurationError, match=r"text\.sqlite"):
        HistoryReader.of_file(tmp_path / "text.sqlite")


def test_a_database_without_one_machine_is_refused() -> None:
    connection = sqlite3.connect(":memory:")
    create(connection, SITE, MACHINE)
    connection.execute("INSERT INTO identity VALUES ('hall-2', 'press-4')")
    with pytest.raises(ValueError, match="one machine"):
        check(connection)
    connection.close()
