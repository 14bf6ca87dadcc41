"""The history: what is kept, bounded by age and size with any clock, and a database that cannot be used."""

import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.health.labels import Numbers
from otolith.health.limits import Level
from otolith.health.schema import HealthDocument, PartDocument, ReportDocument
from otolith.machine import load_machine
from otolith.storage.history import (
    DAY,
    HOUR,
    KEPT,
    MINUTE,
    SUFFIX,
    WINDOW,
    HistoryReader,
    Tables,
    describe_machine,
)
from otolith.storage.history_schema import create
from otolith.storage.history_writer import AGES, BATCH, MAX_WAITING, Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.storage.histories import MACHINE, SITE, START, document, documents
from tests.waiting import PATIENCE, wait_for

MEGABYTE = 1_000_000
BOUNDS = Bounds(20 * MEGABYTE, 3650, 24)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "history" / f"{SITE}.{MACHINE}{SUFFIX}"


@pytest.fixture
def opened(path: Path) -> Iterator[Callable[..., "Simulated"]]:
    """Function that opens the history as a daemon does; all are closed with the test."""
    simulated: list[Simulated] = []

    def begin(bounds: Bounds = BOUNDS, now: float = START) -> Simulated:
        simulated.append(Simulated(path, bounds, now))
        return simulated[-1]

    yield begin
    for each in simulated:
        each.writer._close()


class Simulated:
    """A history without its thread, in simulated time: reports are written in batches, then what is too much goes."""

    def __init__(self, path: Path, bounds: Bounds, now: float) -> None:
        self.writer, self.folder = HistoryWriter(path, bounds), path.parent
        self.numbers, self.note = self.writer.open(now)
        self.largest, self._then = 0, now

    def write(self, *reports: ReportDocument) -> None:
        for report in reports:
            self.writer.add(self.numbers.number(report))
        self.writer._write_waiting()

    def prune(self, now: float, elapsed: float) -> None:
        self.writer._retention.by_size(now)
        self.writer._retention.by_age(now, elapsed)
        self.largest = max(self.largest, sum(file.stat().st_size for file in self.folder.iterdir()))


def numbers_of(reader: HistoryReader) -> list[int]:
    texts = reader.messages("report", 1_000_000)
    return [number for text in texts if (number := ReportDocument.from_json(text).sequence) is not None]


@pytest.mark.full
def test_a_simulated_month_stays_within_its_size(opened: Callable[..., Simulated]) -> None:
    history = opened(Bounds(20 * MEGABYTE, 3650, 8760))  # by age alone, the reports would take 40 MB
    noise, length, batch = np.random.default_rng(1), 240.0, list[ReportDocument]()
    for report in documents(int(30 * DAY / length), length=length):
        batch.append(report.model_copy(update={"notes": (noise.bytes(1500).hex(),)}))
        if len(batch) == MAX_WAITING // 2:
            history.write(*batch)
            history.prune(batch[-1].window.end, len(batch) * length)
            batch.clear()
    history.write(*batch)
    reader, end = history.writer.reader, START + 30 * DAY
    assert 10 * MEGABYTE < history.largest <= 20 * MEGABYTE
    reports = [ReportDocument.from_json(text) for text in reader.messages("report", 1_000_000)]
    assert reports[-1].window.end == end
    assert len(reports) > 2000
    assert all(after.previous == before.sequence for before, after in pairwise(reports))
    assert len(reader.events(0.0)) == 30 * DAY / length / 100
    hours = reader.samples(HOUR, 0.0, ["R_a"])
    assert {sample.time for sample in hours} == set(np.arange(START // HOUR * HOUR, end + 1.0, HOUR))
    assert hours[-1].last == reports[-1].parameters["R_a"].value
    (finding,) = reader.findings(0.0)
    assert finding["count"] == 30 * DAY / length / 2


def in_state(report: ReportDocument, state: Level, since: float) -> ReportDocument:
    part = PartDocument(state=state, since=since)
    health = HealthDocument(**part.model_dump(), parts={"winding": part})
    return report.model_copy(update={"health": health})


def test_each_state_is_kept_once_and_the_one_at_the_begin_is_read(opened: Callable[..., Simulated]) -> None:
    history = opened(Bounds(20 * MEGABYTE, 10, 24))
    changes = [(START, Level.OK), (START + 100.0, Level.WATCH), (START + 150.0, Level.ACT)]
    for report in documents(100):
        since, state = max(change for change in changes if change[0] < report.window.end)
        history.write(in_state(report, state, since))
    reader = history.writer.reader
    expected = [(part, *change) for change in changes for part in ("", "winding")]
    assert [(row.part, row.since, row.state) for row in reader.states(0.0)] == expected
    assert [row.state for row in reader.states(START + 120.0) if row.part] == [Level.WATCH, Level.ACT]
    history.prune(START + 10 * DAY + 120.0, 10 * DAY)
    assert [row.state for row in reader.states(0.0) if row.part] == [Level.WATCH, Level.ACT]
    history.prune(START + 30 * DAY, 20 * DAY)
    assert [row.state for row in reader.states(0.0) if row.part] == [Level.ACT]  # the present one, however old


def test_the_machine_is_described_as_it_was_last(opened: Callable[..., Simulated]) -> None:
    history = opened()
    for text in ('{"title": "before"}', '{"title": "after"}'):
        history.writer.description = text
        history.write(*documents(2))
    assert history.writer.reader.description() == {"title": "after"}
    twin = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False)
    history.writer.description = describe_machine(twin.twin, twin.plan)
    history.write(*documents(2))
    content = history.writer.reader.description()
    assert content["limits"]["R_a"][0] == ["WATCH", 0.98 * 6.5, True]
    assert content["equations"][0][0] == "der(i)"


def test_beyond_the_size_reports_go_before_values_of_minutes(opened: Callable[..., Simulated]) -> None:
    history, noise = opened(Bounds(20 * MEGABYTE, 3650, 8760)), np.random.default_rng(1)
    for report in documents(6000, length=30.0):
        history.writer.add(history.numbers.number(report.model_copy(update={"notes": (noise.bytes(2500).hex(),)})))
        if report.window.index % 100 == 99:
            history.writer._write_waiting()
            history.writer._retention.by_size(report.window.end)
    reader, end = history.writer.reader, START + 6000 * 30.0
    assert 1800 <= len(numbers_of(reader)) < 5000
    assert reader.first(MINUTE) == START // MINUTE * MINUTE
    first = reader.first(WINDOW)
    assert first is not None
    assert START + HOUR < first < end - HOUR


def test_a_report_writes_little_more_than_it_contains(opened: Callable[..., Simulated], path: Path) -> None:
    history, noise = opened(), np.random.default_rng(1)
    assert history.writer._connection is not None
    history.writer._connection.execute("PRAGMA wal_autocheckpoint = 0").fetchall()  # the log has all that was written
    for report in documents(300):
        history.write(report.model_copy(update={"notes": (noise.bytes(1200).hex(),)}))  # 1.5 kB when compressed
    assert path.with_name(f"{path.name}-wal").stat().st_size / 300 < 16_000


def test_a_lower_limit_makes_the_file_smaller(opened: Callable[..., Simulated], path: Path) -> None:
    history, noise = opened(Bounds(40 * MEGABYTE, 3650, 8760)), np.random.default_rng(1)
    reports = [report.model_copy(update={"notes": (noise.bytes(5000).hex(),)}) for report in documents(3200)]
    for index in range(0, len(reports), 200):
        history.write(*reports[index : index + 200])
    history.writer._close()
    assert path.stat().st_size > 20 * MEGABYTE
    lower = opened(Bounds(20 * MEGABYTE, 3650, 8760))
    lower.write(document(0, START + 20_000.0))
    lower.writer._retention.by_size(START + 20_000.0)
    lower.writer._close()
    assert path.stat().st_size <= 18 * MEGABYTE


def test_windows_are_kept_for_a_day_and_reports_as_long_as_configured(opened: Callable[..., Simulated]) -> None:
    history = opened(Bounds(100 * MEGABYTE, 40, 6))
    for report in documents(480, length=HOUR / 8):
        history.write(report)
    for _ in range(2):  # a second call finds nothing
        history.prune(START + 60 * HOUR, 60 * HOUR)
        reader, end = history.writer.reader, START + 60 * HOUR
        assert reader.first(WINDOW) == end - AGES[WINDOW]
        assert len(reader.messages("report", 1000)) == 6 * 8 + 1
        assert reader.first(HOUR) == START // HOUR * HOUR
        assert len(reader.events(0.0)) == 5
    history.prune(end + 41 * DAY, 41 * DAY)
    assert reader.first(DAY) is None
    assert (reader.events(0.0), reader.findings(0.0), reader.counters(0.0)) == ([], [], [])
    assert len(reader.messages("report", 1000)) == 1  # the next one refers to it


@given(st.lists(st.tuples(st.floats(0.0, 4 * HOUR), st.floats(-1e6, 1e6)), min_size=1, max_size=40))
def test_an_interval_has_the_statistics_of_its_windows(values: list[tuple[float, float]]) -> None:
    connection = sqlite3.connect(":memory:")
    create(connection, SITE, MACHINE)
    tables = Tables(connection, 0)
    for index, (time, value) in enumerate(values):
        tables.merge([document(index, START + time, value).model_copy(update={"sequence": index})])
    for length in (MINUTE, HOUR, DAY):
        expected: dict[float, list[float]] = {}
        for time, value in values:
            expected.setdefault((START + time) // length * length, []).append(value)
        query = "SELECT time, count, min, mean, max, last, low FROM sample WHERE resolution = ?"
        rows = {time: rest for time, *rest in connection.execute(query, (length,))}
        assert set(rows) == set(expected)
        for time, (count, low, mean, high, last, low_end) in rows.items():
            inside = expected[time]
            assert (count, low, high, last) == (len(inside), min(inside), max(inside), inside[-1])
            assert mean == pytest.approx(np.mean(inside), rel=1e-9, abs=1e-6)
            assert low_end == inside[-1] - 0.02
    connection.close()


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.floats(-1e9, 1e9)), min_size=1, max_size=20))
def test_numbers_rise_over_restarts_whatever_was_not_saved(runs: list[tuple[int, int, float]]) -> None:
    """Each run publishes reports that are saved, then some that are not; the clock is anywhere at its start."""
    start, saved_report, saved_event, published, newest = 0, None, None, list[int | None](), 0
    for saved, lost, clock in runs:
        numbers = Numbers(max(0.0, START + clock), saved_report, saved_event, start)
        start = numbers.start
        for index in range(saved + lost):
            report = numbers.number(next(iter(documents(1))) if index % 2 else list(documents(51))[50])
            assert report.sequence is not None
            assert report.previous is None or report.previous >= newest or index == 0
            published.append(report.sequence)
            published += [event.sequence for event in report.events]
            newest = report.sequence
            if index < saved:
                saved_report = report.sequence
                saved_event = next((event.sequence for event in report.events), saved_event)
    known = [number for number in published if number is not None]
    assert len(known) == len(published)
    assert known == sorted(set(known))


def broken(path: Path, how: str) -> None:
    if how == "damaged":
        size = path.stat().st_size
        path.write_bytes(path.read_bytes()[:100] + np.random.default_rng(1).bytes(size - 100))
    elif how == "text":
        path.write_text("half a fi" * 1000, encoding="utf-8")
    elif how == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    else:
        connection = sqlite3.connect(path)
        connection.executescript({
            "older": "PRAGMA user_version = 0",
            "foreign": "PRAGMA application_id = 7",
            "other machine": "UPDATE identity SET machine = 'press-4'",
            "no table": "DROP TABLE identity",
        }[how])  # fmt: skip
        connection.close()


@pytest.mark.parametrize(
    ("how", "reason"),
    [
        ("damaged", ""),
        ("text", "not a database"),
        ("truncated", "malformed"),
        ("older", "version 0"),
        ("foreign", "no history of Otolith"),
        ("other machine", "press-4 at hall-1"),
        ("no table", "no such table"),
    ],
)
def test_a_database_that_cannot_be_used_is_kept(
    opened: Callable[..., Simulated], path: Path, how: str, reason: str
) -> None:
    first = opened()
    first.write(*documents(60))
    first.writer._close()
    broken(path, how)
    content = path.read_bytes()
    with pytest.raises(ConfigurationError, match=str(path)):
        HistoryReader(path).events(0.0)
    assert path.read_bytes() == content
    second = opened(now=START + 1000.0)
    (kept,) = path.parent.glob(f"*{KEPT}")
    assert kept.read_bytes() == content
    assert reason in second.note
    assert kept.name in second.note
    second.write(*documents(3, start=START + 1000.0))
    assert len(numbers_of(second.writer.reader)) == 3
    assert min(numbers_of(second.writer.reader)) > first.numbers._next


def test_a_database_that_is_damaged_while_it_is_used_is_kept(opened: Callable[..., Simulated], path: Path) -> None:
    history = opened()
    history.write(*documents(500))
    history.writer._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # type: ignore[union-attr]  # it is open
    history.writer._close()
    history = opened()
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(np.random.default_rng(1).bytes(path.stat().st_size - 4096))
    for report in documents(3, start=START + 2000.0):
        history.writer.add(history.numbers.number(report))
    history.writer._work(0.0)
    assert len(list(path.parent.glob(f"*{KEPT}"))) == 1
    assert len(numbers_of(history.writer.reader)) == 3


def test_a_database_that_readers_find_damaged_is_named_once(
    opened: Callable[..., Simulated], path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Who writes has its pages in memory, and notices nothing."""
    history = opened()
    history.write(*documents(3))
    path.write_bytes(bytes(1024) + path.read_bytes()[1024:])
    path.with_name(f"{path.name}-wal").write_bytes(b"")
    for _ in range(3):
        assert history.writer.messages("report", 10) == []
    assert caplog.text.count("queries are not answered") == 1


def test_kept_databases_take_no_more_than_a_history_and_the_newest_stays(
    opened: Callable[..., Simulated], path: Path
) -> None:
    history = opened()
    for size in (8, 9, 10, 30):
        history.writer._close()
        path.write_bytes(bytes(size * MEGABYTE))
        history.writer._open()
    (kept,) = path.parent.glob(f"*{KEPT}")
    assert kept.stat().st_size // MEGABYTE == 30
    kept.rename(kept.with_name(f"{SITE}.{MACHINE}.20990101T000000000000{KEPT}"))  # the clock was ahead
    history.writer._close()
    path.write_bytes(bytes(29 * MEGABYTE))
    history.writer._open()
    assert [kept.stat().st_size // MEGABYTE for kept in path.parent.glob(f"*{KEPT}")] == [29]


def test_a_database_that_another_process_locks_is_written_later(
    opened: Callable[..., Simulated], path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    history = opened()
    history.write(*documents(3))
    with closing(sqlite3.connect(path)) as other:
        other.execute("BEGIN EXCLUSIVE")
        history.writer.start()
        history.writer.add(history.numbers.number(document(3, START + 8.0)))
        wait_for(lambda: "is locked: end the other process" in caplog.text)
    history.writer.stop(PATIENCE)
    assert len(numbers_of(history.writer.reader)) == 4


def test_a_database_that_is_deleted_meanwhile_is_made_again(opened: Callable[..., Simulated], path: Path) -> None:
    history = opened()
    history.write(*documents(3))
    shutil.rmtree(path.parent)
    for report in documents(2, start=START + 100.0):
        history.writer.add(history.numbers.number(report))
        history.writer._work(0.0)
    assert len(numbers_of(history.writer.reader)) == 2


def test_quick_restarts_do_not_run_ahead_of_the_clock(opened: Callable[..., Simulated]) -> None:
    for index in range(100):
        history = opened(now=START + 5.0 * index)
        history.write(document(index, START + 5.0 * index))
        history.writer._close()
    assert history.numbers.start == int((START + 5.0 * 99) * 1e3)


def test_a_link_to_another_file_is_not_followed(path: Path, tmp_path: Path) -> None:
    path.parent.mkdir()
    (tmp_path / "other").write_bytes(b"")
    path.symlink_to(tmp_path / "other")
    writer = HistoryWriter(path, BOUNDS)
    writer.open(START)
    assert writer._connection is None
    assert (tmp_path / "other").read_bytes() == b""


def test_a_full_disk_is_logged_once_and_what_waits_is_written_later(
    path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    writer = HistoryWriter(path, BOUNDS)
    numbers, _ = writer.open(START)
    monkeypatch.setattr("otolith.storage.disk.WRITE_RETRY", 0.0)
    tries = list[int]()

    def full(*_: object) -> None:
        tries.append(0)
        raise sqlite3.OperationalError("disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr(Tables, "add", full)
        writer.start()
        for report in documents(MAX_WAITING + 10):
            writer.add(numbers.number(report))
        for count in (1, 2, 3):
            writer._wakeup.set()
            wait_for(lambda least=count: len(tries) >= least)  # type: ignore[misc]  # mypy infers no type of a default
        assert writer.dropped == 10
        assert writer.messages("report", 10) == []  # without waiting for the disk
    writer.stop(PATIENCE)
    assert len(numbers_of(writer.reader)) == MAX_WAITING
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "disk I/O error" in caplog.text


def test_a_database_at_its_hard_limit_deletes_and_goes_on(opened: Callable[..., Simulated]) -> None:
    history = opened(Bounds(20 * MEGABYTE, 3650, 8760))
    noise = np.random.default_rng(1)
    for report in documents(2000):
        padded = report.model_copy(update={"notes": (noise.bytes(10_000).hex(),)})
        history.writer.add(history.numbers.number(padded))
        if report.window.index % 200 == 199:  # 2 MB at once
            history.writer._work(0.0)
    assert ReportDocument.from_json(history.writer.messages("report", 10_000)[-1]).window.index == 1999
    assert history.writer.dropped == 0


def test_a_reader_that_never_ends_does_not_fill_the_disk(
    opened: Callable[..., Simulated], path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("otolith.storage.history_writer.MAX_LOG_BYTES", MEGABYTE)
    monkeypatch.setattr("otolith.storage.history_writer.BUSY_TIMEOUT", 0.01)
    history = opened()
    history.write(*documents(10))
    reader = sqlite3.connect(path)
    reader.execute("BEGIN")
    reader.execute("SELECT * FROM report").fetchone()
    history.writer.start()
    for report in documents(20_000):
        history.writer.add(history.numbers.number(report))
        if history.writer.dropped:
            break
        if report.window.index % 50 == 0:
            history.writer._written.wait(PATIENCE)
    assert history.writer.dropped
    assert path.with_name(f"{path.name}-wal").stat().st_size < 3 * MEGABYTE
    assert "another process keeps it open" in caplog.text
    reader.close()
    history.writer.stop(PATIENCE)
    assert not history.writer._waiting


def test_a_clock_that_is_set_back_loses_nothing(opened: Callable[..., Simulated]) -> None:
    history = opened(Bounds(20 * MEGABYTE, 3650, 8760))
    history.write(*documents(100))
    history.write(*documents(100, start=START - 30 * DAY))
    history.prune(START - 30 * DAY + 200.0, 400.0)
    reader = history.writer.reader
    numbers = numbers_of(reader)
    assert numbers == sorted(numbers)
    assert len(numbers) == 200
    assert len(reader.samples(WINDOW, 0.0)) == 200
    later = opened(Bounds(20 * MEGABYTE, 3650, 8760), START - 30 * DAY)
    later.write(document(0, START - 30 * DAY + 300.0))
    assert numbers_of(reader)[-1] > numbers[-1]


def test_a_clock_that_leaps_ahead_deletes_nothing_for_a_day(opened: Callable[..., Simulated]) -> None:
    history = opened()
    history.write(*documents(100))
    history.prune(START + 200.0, 200.0)
    wrong = START + 70 * 365 * DAY
    history.write(*documents(100, start=wrong))
    for hour in range(23):
        history.prune(wrong + hour * HOUR, HOUR)
    assert len(numbers_of(history.writer.reader)) == 200
    for minute in range(60):  # set right again
        history.prune(START + 200.0 + minute * 60.0, 60.0)
    assert len(numbers_of(history.writer.reader)) == 200
    for hour in range(24):
        history.prune(wrong + hour * HOUR, HOUR)
    assert len(history.writer.reader.samples(WINDOW, 0.0)) == 100  # a day after the leap, the clock is used


@pytest.mark.parametrize("wrong", [0.0, START - 2 * DAY, START + 20 * DAY])
def test_a_clock_that_was_wrong_for_a_while_deletes_no_reports(opened: Callable[..., Simulated], wrong: float) -> None:
    """Without a battery it begins anywhere, until the network sets it right; reports of before the boot are there."""
    history = opened(Bounds(20 * MEGABYTE, 3650, 24))
    history.write(*documents(100))
    history.write(*documents(100, start=wrong))
    history.write(*documents(100, start=START + HOUR))
    for hours in range(1, 23):
        history.prune(START + hours * HOUR, HOUR)
        assert len(numbers_of(history.writer.reader)) == 300, hours
    history.write(*documents(100, start=START + 30 * HOUR))
    for hours in range(24, 32):
        history.prune(START + hours * HOUR, HOUR)
    assert len(numbers_of(history.writer.reader)) == 100


WRITES_FOR_EVER = """
import sys
from pathlib import Path
from otolith.storage.history_writer import Bounds
from otolith.storage.history_writer import HistoryWriter
from tests.storage.histories import START, documents
writer = HistoryWriter(Path(sys.argv[1]), Bounds(20_000_000, 3650, 8760))
numbers, note = writer.open(START)
assert not note, note
writer.start()
for report in documents(1_000_000):
    numbered = numbers.number(report)
    writer.add(numbered)
    if report.window.index % 20 == 0:
        writer._written.wait(60.0)
        print(numbered.sequence, flush=True)
"""


def test_a_kill_in_the_middle_of_a_write_loses_nothing_that_was_written(path: Path) -> None:
    reader, newest = HistoryReader(path), 0
    for lines in (5, 17, 30):
        command = [sys.executable, "-c", WRITES_FOR_EVER, str(path)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        printed = [int(process.stdout.readline()) for _ in range(lines)]
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        process.stdout.close()
        numbers = numbers_of(reader)
        assert printed[0] > newest
        assert set(printed) <= set(numbers)
        newest = numbers[-1]
        connection = sqlite3.connect(path)
        assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        connection.close()


def test_it_is_read_while_it_is_written_and_where_nothing_can_be_written(
    opened: Callable[..., Simulated], path: Path, tmp_path: Path
) -> None:
    history, failures = opened(), list[Exception]()

    def read() -> None:
        for _ in range(30):
            try:
                HistoryReader(path).samples(HOUR, 0.0)
            except ConfigurationError as error:
                failures.append(error)

    thread = threading.Thread(target=read)
    thread.start()
    for report in documents(300):
        history.write(report)
    thread.join()
    assert failures == []
    history.writer._close()
    copy = tmp_path / "copy"
    shutil.copytree(path.parent, copy)
    (copy / path.name).chmod(0o400)
    copy.chmod(0o500)
    assert len(HistoryReader(copy / path.name).samples(WINDOW, 0.0)) == 300
    assert [file.name for file in copy.iterdir()] == [path.name]
    copy.chmod(0o700)


def test_rows_that_the_disk_has_damaged_are_left_out(
    opened: Callable[..., Simulated], path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each of a compressed report, an event, a finding and counters; what SQLite itself notices is another test."""
    history = opened()
    history.write(*documents(200))
    reports, events = history.writer.reader.messages("report", 1000), history.writer.reader.events(0.0)
    connection = sqlite3.connect(path)
    for number in (reports[10], reports[-1]):
        sequence = ReportDocument.from_json(number).sequence
        ((packed,),) = connection.execute("SELECT text FROM report WHERE sequence = ?", (sequence,)).fetchall()
        torn = packed[:40] + bytes([packed[40] ^ 4]) + packed[41:]
        connection.execute("UPDATE report SET text = ? WHERE sequence = ?", (torn, sequence))
    connection.execute("UPDATE event SET text = substr(text, 3) WHERE sequence = (SELECT min(sequence) FROM event)")
    connection.execute("UPDATE finding SET text = '[]'")
    connection.execute("UPDATE counters SET text = '{'")
    connection.commit()
    connection.close()
    reader = HistoryReader(path)
    assert reader.messages("report", 1000) == [*reports[:10], *reports[11:-1]]
    assert f"{path}: 2 rows that the disk has damaged are left out" in caplog.text
    assert [report.to_json() for report in reader.latest(3)] == reports[-2:-4:-1]
    assert reader.events(0.0) == events[1:]
    assert (reader.findings(0.0), reader.counters(0.0)) == ([], [])
    assert len(reader.samples(WINDOW, 0.0)) == 200


def counted(reader: HistoryReader) -> tuple[int, int]:
    """How many windows the values of days and of windows are of."""
    return sum(sample.count for sample in reader.samples(DAY, 0.0)), len(reader.samples(WINDOW, 0.0))


def test_values_follow_together_but_reports_at_once(path: Path) -> None:
    writer, reader = HistoryWriter(path, BOUNDS), HistoryReader(path)
    numbers, _ = writer.open(START)
    writer.start()
    first, *rest = documents(BATCH + 5)  # the one with index 50 raises an event
    writer.add(numbers.number(first))
    wait_for(lambda: len(numbers_of(reader)) == 1)
    for report in rest[:30]:
        writer.add(numbers.number(report))
    wait_for(lambda: len(numbers_of(reader)) == 31)
    assert counted(reader) == (0, 0)
    for report in rest[30:50]:
        writer.add(numbers.number(report))
    wait_for(lambda: len(reader.events(0.0)) == 1)
    wait_for(lambda: counted(reader) == (51, 51))
    for report in rest[50:]:
        writer.add(numbers.number(report))
    writer.stop(PATIENCE)
    assert counted(reader) == (BATCH + 5, BATCH + 5)


def test_values_of_a_killed_daemon_are_written_once_by_the_next_one(path: Path) -> None:
    reader = HistoryReader(path)
    for run, lines in enumerate((1, 6, 2)):
        process = subprocess.Popen(
            [sys.executable, "-c", WRITES_FOR_EVER, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        for _ in range(lines):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        process.wait(PATIENCE)
        process.stdout.close()
        before = len(numbers_of(reader))
        assert before > counted(reader)[1] or run == 0 or before % BATCH == 0
        writer = HistoryWriter(path, BOUNDS)
        writer.open(START + run)
        ends = {json.loads(text)["window"]["end"] for text in reader.messages("report", 1_000_000)}
        assert {sample.time for sample in reader.samples(WINDOW, 0.0)} == ends
        assert sum(sample.count for sample in reader.samples(DAY, 0.0)) == len(numbers_of(reader)) == before
        writer._close()
        writer.open(START + run)
        assert sum(sample.count for sample in reader.samples(DAY, 0.0)) == before
        writer._close()


def test_counters_of_a_killed_daemon_stay_its_own(opened: Callable[..., Simulated]) -> None:
    first = opened()
    first.writer.add(first.numbers.number(document(7, START + 2.0)))
    first.writer._write_reports()
    assert first.writer._connection is not None
    with first.writer._connection as connection:  # as a daemon that started earlier and is killed leaves it
        connection.execute("UPDATE merged SET run = 5")
    first.writer._close()
    second = opened()
    second.write(document(1, START + 4.0))
    old, new = second.writer.reader.counters(0.0)
    assert (old["run"], old["windows"], new["windows"]) == (5, 7, 1)


def test_a_time_is_found_without_a_walk_through_the_table(
    opened: Callable[..., Simulated], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The work of a query, in instructions of SQLite, does not depend on how long the history is."""
    history, steps = opened(), list[int]()

    def counting(connection: sqlite3.Connection) -> None:
        connection.set_progress_handler(lambda: steps.append(0), 10)

    monkeypatch.setattr("otolith.storage.history.bound", counting)

    def work(kind: str, begin: float, end: float, found: int) -> int:
        steps.clear()
        assert len(history.writer.reader.messages(kind, 1000, 0, begin, end)) == found
        return len(steps)

    reports = iter(documents(6000))
    for _ in range(2):
        history.write(*islice(reports, 200))
    short = {kind: work(kind, START + 700.0, START + 760.0, found) for kind, found in (("report", 31), ("event", 1))}
    while batch := list(islice(reports, 200)):
        history.write(*batch)
    assert history.writer.dropped == 0
    for kind, found in (("report", 31), ("event", 1)):
        for begin in (START + 700.0, START + 11_700.0):
            assert work(kind, begin, begin + 60.0, found) < 2 * short[kind]


def test_each_window_writes_little(opened: Callable[..., Simulated], path: Path) -> None:
    """A minute of windows writes its values once; the log has all that was written."""
    history, noise = opened(), np.random.default_rng(1)
    assert history.writer._connection is not None
    history.writer._connection.execute("PRAGMA wal_autocheckpoint = 0").fetchall()
    for report in documents(300):
        padded = report.model_copy(update={"notes": (noise.bytes(600).hex(),), "events": ()})
        history.writer.add(history.numbers.number(padded))
        history.writer._merged_at = 0.0
        history.writer._write_waiting(59.0 if report.window.index % 30 else 60.0)
    assert path.with_name(f"{path.name}-wal").stat().st_size / 300 < 8_500
