"""``otolith history``: table, CSV, JSON and Parquet, with a daemon running or not, and what cannot be read."""

import contextlib
import csv
import json
import os
import re
import shutil
import sqlite3
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from click.testing import CliRunner, Result

from otolith.cli import common
from otolith.cli.machines import last_reports
from otolith.cli.main import cli
from otolith.cli.operation.history import end_of
from otolith.health.labels import Numbers
from otolith.health.limits import Level
from otolith.health.schema import EventChange, HealthDocument
from otolith.storage.history import HOUR, HistoryReader, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import state_directory
from tests.conftest import EXAMPLES
from tests.storage.histories import MACHINE, SITE, document, documents

COUNT, LENGTH = 400, 30.0


@pytest.fixture
def written() -> Iterator[HistoryWriter]:
    """A history of the last 200 minutes, with four events; the daemon still has it open."""
    now = time.time()
    writer = HistoryWriter(history_path(SITE, MACHINE), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(now - COUNT * LENGTH)
    for report in documents(COUNT, start=now - COUNT * LENGTH, length=LENGTH):
        writer.add(numbers.number(report))
        writer._write_waiting()
    yield writer
    writer._close()


def run(*arguments: str, width: int = 120) -> Result:
    return CliRunner().invoke(cli, ["history", *arguments], env={"COLUMNS": str(width)}, standalone_mode=False)


@pytest.mark.parametrize("is_running", [True, False])
def test_the_table_has_values_events_and_findings(written: HistoryWriter, is_running: bool) -> None:
    if not is_running:
        written._close()
    lines = run(MACHINE).stdout.splitlines()
    assert lines[0].startswith(f"{MACHINE} at {SITE}, since ")
    assert lines[0].endswith("values per minute")
    (row,) = [line for line in lines if "R_a" in line and "│" in line]
    assert [cell.strip() for cell in row.split("│")][1:6] == ["R_a", "6.500", "0.020", "Ω", "+0.01%"]
    assert "▁" in row
    assert "█" in row
    assert len([line for line in lines if re.search(r" WATCH +winding +short circuit", line)]) == 4
    text = run(MACHINE, "--details").stdout
    assert text.count("raised: WATCH: winding") == 4
    assert "finding: new torque on the shaft" in text
    assert f"windows: {COUNT // 2}\n" in text


def test_a_cleared_event_says_so_once(written: HistoryWriter) -> None:
    now = time.time()
    cleared = document(COUNT, now, change=EventChange.CLEARED)
    events = tuple(event.model_copy(update={"end": now}) for event in cleared.events)
    numbers = Numbers(now)
    written.add(numbers.number(cleared.model_copy(update={"events": events})))
    written._write_waiting()
    lines = run(MACHINE, "--details", width=400).stdout.splitlines()
    assert len([line for line in lines if line.startswith("cleared: winding: short circuit")]) == 1


@pytest.mark.parametrize("width", [40, 60])
def test_a_narrow_terminal_cuts_no_number(written: HistoryWriter, width: int) -> None:
    del written
    text = run(MACHINE, width=width).stdout
    assert "…" not in text
    assert re.search(r"R_a\W+6\.500\W+0\.020\W+Ω\W+0\.01%.*█", text)  # on one line


@pytest.mark.parametrize("width", [80, 100, 120, 200])
def test_values_and_curve_are_on_one_line(written: HistoryWriter, width: int) -> None:
    del written
    rows = [line.split("│")[1:-1] for line in run(MACHINE, width=width).stdout.splitlines() if "│" in line]
    assert rows
    assert all(cell.strip() for row in rows for cell in (row[1], row[-1]))


def test_csv_json_and_parquet_have_the_same_values(written: HistoryWriter, tmp_path: Path) -> None:
    del written
    rows = list(csv.DictReader(run(MACHINE, "--csv", "--every", "hour").stdout.splitlines()))
    document = json.loads(run(MACHINE, "--json", "--every", "hour").stdout)
    file = tmp_path / "values.parquet"
    assert run(MACHINE, "--parquet", str(file), "--every", "hour").exit_code == 0
    table = pq.read_table(file).to_pylist()
    assert len(rows) == len(document["values"]) == len(table) >= 4
    for row, value, record in zip(rows, document["values"], table, strict=True):
        assert row["parameter"] == value["name"] == record["parameter"] == "R_a"
        times = datetime.fromisoformat(row["time"]).timestamp(), record["time"].timestamp()
        assert times == (value["time"], value["time"])
        assert float(row["mean"]) == value["mean"] == record["mean"]
        assert int(row["count"]) == value["count"] == record["count"]
    assert sum(value["count"] for value in document["values"]) == COUNT
    assert [event["change"] for event in document["events"]] == ["raised"] * 4
    assert document["findings"][0]["count"] == COUNT // 2
    assert document["counters"][-1]["windows"] == COUNT - 1


def test_each_change_of_an_event_has_its_evidence(written: HistoryWriter) -> None:
    ends = list(written.reader.event_ends(0.0).items())
    folder = state_directory() / "evidence"
    folder.mkdir(parents=True)
    stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(ends[1][1]))
    path = folder / f"{SITE}.{MACHINE}-000001-{stamp}.zip"
    for name in (path.name, path.name.replace(MACHINE, "other"), path.name.replace(stamp, "20000101T000000")):
        (folder / name).touch()
    lines = run(MACHINE, "--events", "--details", width=400).stdout.splitlines()
    changes = [number for number, line in enumerate(lines) if line.startswith("raised: ")]
    assert [line for line in lines if "reproduce" in line] == [lines[changes[1] + 1]] == [f"  otolith reproduce {path}"]
    assert json.loads(run(MACHINE, "--json").stdout)["evidence"] == {str(ends[1][0]): str(path)}
    assert "reproduce" not in run(MACHINE).stdout


def test_a_parquet_file_that_cannot_be_written_is_named(written: HistoryWriter) -> None:
    """A folder in which nobody may write a file."""
    del written
    path = "/proc/values.parquet"
    error = run(MACHINE, "--parquet", path).exception
    assert isinstance(error, OSError)
    assert error.filename == path


def test_a_history_that_was_set_aside_is_opened_by_its_path(written: HistoryWriter) -> None:
    written._close()
    kept = written.reader.path.with_name(f"{SITE}.{MACHINE}.20260131T101112000000.kept.sqlite")
    written.reader.path.rename(kept)
    assert re.search("WATCH +winding", run(str(kept)).stdout)
    rows = json.loads(run(str(kept), "--json").stdout)
    assert (rows["site"], rows["machine"]) == (SITE, MACHINE)


def test_events_alone(written: HistoryWriter) -> None:
    del written
    rows = list(csv.DictReader(run(MACHINE, "--events", "--csv").stdout.splitlines()))
    assert [row["part"] for row in rows] == ["winding"] * 4
    assert json.loads(run(MACHINE, "--events", "--json").stdout)["values"] == []
    assert "R_a │" not in run(MACHINE, "--events").stdout


@pytest.mark.parametrize(("since", "interval"), [("1h", "window"), ("1d", "minute"), ("8w", "minute")])
def test_the_resolution_follows_the_time_that_is_shown(written: HistoryWriter, since: str, interval: str) -> None:
    del written  # its values are of the last hours, so that a longer time needs no coarser resolution
    assert json.loads(run(MACHINE, "--since", since, "--json").stdout)["every"] == interval


def test_since_is_an_age_or_a_date(written: HistoryWriter) -> None:
    del written
    begin = time.time() - HOUR
    for since in ("60m", "1h", "3600s", datetime.fromtimestamp(begin).isoformat()):  # noqa: DTZ006 - as a user writes it
        values = json.loads(run(MACHINE, "--since", since, "--json").stdout)["values"]
        assert 115 <= len(values) <= 121


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("press-4",), "did you mean 'press-3'"),
        (("../../no-such-folder",), "No such file"),
        ((MACHINE, "--parameter", "R_b"), "did you mean 'R_a'"),
        ((MACHINE, "--since", "yesterday"), "write an age"),
        ((MACHINE, "--csv", "--json"), "give one of"),
        ((MACHINE, "--events", "--parquet", "x.parquet"), "give --csv or --json"),
        ((MACHINE, "--parquet", "/dev/null"), "another name"),
        ((MACHINE, "--parquet", "/missing/x.parquet"), "no folder"),
    ],
)
def test_a_wrong_argument_names_the_way_out(written: HistoryWriter, arguments: tuple[str, ...], message: str) -> None:
    del written
    error = run(*arguments).exception
    assert error is not None
    assert message in getattr(error, "message", str(error))


def test_machines_of_one_name_ask_for_the_site(written: HistoryWriter) -> None:
    path = written.reader.path
    path.with_name(f"hall-2.{MACHINE}.history.sqlite").write_bytes(b"")
    error = run(MACHINE).exception
    assert isinstance(error, ConfigurationError)
    assert "hall-1.press-3, hall-2.press-3: give one of these names" in str(error)


def test_a_history_of_another_version_is_not_read(written: HistoryWriter) -> None:
    written._close()
    with sqlite3.connect(written.reader.path) as connection:
        connection.execute("PRAGMA user_version = 99")
    error = run(MACHINE).exception
    assert isinstance(error, ConfigurationError)
    assert "version 99" in str(error)


def test_an_instance_of_the_service_has_its_own_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """docs/service.md: the name of the machine file; the machine in it may have another one."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "line-7"))
    request.getfixturevalue("written")
    assert run("line-7", "--since", "1d").output == run(MACHINE, "--since", "1d").output != ""
    assert "no history of a machine 'line-8'" in str(run("line-8").exception)


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Machine file of an installed service, whose state this command is not told of."""
    for name in ("SERVICES", "INSTALLED"):
        (tmp_path / name).mkdir()
        monkeypatch.setattr(common, name, tmp_path / name)
    (tmp_path / "SERVICES" / "line-7").mkdir()
    monkeypatch.setenv("STATE_DIRECTORY", "")  # restored after the test, whatever the command sets
    monkeypatch.delenv("STATE_DIRECTORY")
    return Path(shutil.copy(EXAMPLES / "dc-motor-in-process.toml", tmp_path / "INSTALLED" / "line-7.toml"))


def test_commands_of_root_use_the_state_of_the_service(
    service: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """They said that nothing was there, or that it was forgotten, and meant the state of root."""
    monkeypatch.setenv("STATE_DIRECTORY", str(common.SERVICES / "line-7"))
    request.getfixturevalue("written")
    expected = run(MACHINE, "--since", "1d").output
    monkeypatch.delenv("STATE_DIRECTORY")
    assert run("line-7", "--since", "1d").output == expected != ""
    monkeypatch.delenv("STATE_DIRECTORY")
    shutil.copytree(EXAMPLES / "scenarios", service.parent / "scenarios")
    result = CliRunner().invoke(cli, ["reset", str(service), "R_a"], catch_exceptions=False)
    assert (result.output, result.exit_code) == ("R_a is forgotten\n", 0)
    assert len(list((common.SERVICES / "line-7" / "components").glob("*.decisions.json"))) == 1


def test_commands_of_root_use_the_state_of_the_hall(
    service: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """By the file of a machine, by the name of the file, and by that of the machine."""
    state = common.SERVICES / common.HALL
    state.mkdir()
    monkeypatch.setenv("STATE_DIRECTORY", str(state))
    request.getfixturevalue("written")
    expected = run(MACHINE, "--since", "1d").output
    service.unlink()
    file = common.INSTALLED / common.HALL / "line-8.toml"
    file.parent.mkdir()
    names = f'[machine]\nname = "{MACHINE}"\nsite = "{SITE}"\n[twin]'
    rest = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8").partition("[twin]")[2]
    file.write_text(names + rest, encoding="utf-8")
    shutil.copytree(EXAMPLES / "scenarios", file.parent / "scenarios")
    for text in ("line-8", MACHINE, f"{SITE}.{MACHINE}", str(file)):
        monkeypatch.delenv("STATE_DIRECTORY")
        assert run(text, "--since", "1d").output == expected != ""
        assert common.restart_command(file) == "systemctl restart otolith"


def test_a_command_that_may_not_use_the_state_of_the_service_says_so(
    service: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = common.SERVICES / "line-7"
    may = os.access
    monkeypatch.setattr(os, "access", lambda path, *rest, **more: path != state and may(path, *rest, **more))
    for command in (["history", "line-7"], ["components", "list", str(service)]):
        error = CliRunner().invoke(cli, command, standalone_mode=False).exception
        assert isinstance(error, ServiceError)
        assert "line-7: state of a service, which root and its own user may read: try it with sudo" in str(error)


def damage(written: HistoryWriter, count: int) -> None:
    """The disk has damaged the newest reports; who writes them has the file open."""
    with contextlib.closing(sqlite3.connect(written.reader.path)) as connection, connection:
        connection.execute(
            "UPDATE report SET text = substr(text, 1, 40) WHERE sequence IN "
            "(SELECT sequence FROM report ORDER BY sequence DESC LIMIT ?)", (count,),
        )  # fmt: skip


@pytest.mark.parametrize("count", [1, COUNT], ids=["the newest", "all"])
def test_a_damaged_report_prevents_no_command_that_does_without_it(written: HistoryWriter, count: int) -> None:
    damage(written, count)
    name = written.reader.last_changes().popitem()[0]
    for arguments in (
        ["history", MACHINE], ["history", MACHINE, "--csv"], ["history", MACHINE, "--json", "--since", "2023-01-31"],
        ["event", "list", MACHINE], ["event", "acknowledge", MACHINE, name], ["event", "comment", MACHINE, name, "x"],
        ["report", MACHINE, "--output", "-"],
    ):  # fmt: skip
        if count == 1 or arguments[0] != "report":  # a page is made of reports
            done = CliRunner().invoke(cli, arguments, standalone_mode=False)
            assert done.exception is None, arguments
    assert list(last_reports(MACHINE))


def test_times_keep_language_and_zone_of_the_machine_if_a_report_is_damaged(written: HistoryWriter) -> None:
    health = HealthDocument(state=Level.OK, since=0.0, reason="", parts={}, language="de", timezone="Asia/Tokyo")
    now = time.time()
    numbers = Numbers(now)
    for report in documents(3, start=now, length=LENGTH):
        written.add(numbers.number(report.model_copy(update={"health": health})))
    written._write_waiting()
    assert written.reader.language_and_zone() == ("de", "Asia/Tokyo")
    damage(written, 1)
    assert written.reader.language_and_zone() == ("de", "Asia/Tokyo")


def test_a_copy_ends_with_its_last_window_also_if_that_is_damaged(written: HistoryWriter, tmp_path: Path) -> None:
    end = written.reader.latest(1)[0].window.end
    damage(written, 1)
    written._close()
    copy = shutil.copy(written.reader.path, tmp_path)
    assert end_of(HistoryReader(Path(copy))) == end
