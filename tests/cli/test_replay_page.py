"""``otolith replay --report`` and ``--history``: the page of a log, with the times of its data."""

import re
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result

from otolith.cli.main import cli
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.cli.replays import MACHINE, Lines, recorded, written
from tests.messages import assert_says
from tests.publishing.test_html_report import Page

MONDAY = 1_790_000_000.0  # Unix s: in September 2026


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario)


def dated(rows: Lines) -> Lines:
    return [[f"{MONDAY + float(time):.3f}", *rest] for time, *rest in rows]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments], standalone_mode=False)


def replayed(*arguments: object) -> Result:
    result = run("replay", MACHINE, *arguments)
    assert result.exception is None, result.exception
    return result


def text_of(page: Path) -> str:
    return Page(page.read_text(encoding="utf-8")).text


def test_the_page_of_a_log_has_the_times_of_its_data(tmp_path: Path, rows: Lines) -> None:
    page = tmp_path / "pages" / "monday.html"
    replayed(written(tmp_path, dated(rows)), "--report", page)
    text = text_of(page)
    assert_says(text, "2026-09-", "data.csv", "R_a", "armature resistance")
    assert "UNKNOWN" not in text  # no daemon is missing
    assert "daemon" not in text
    assert not re.search(r"19[67]\d-|20[013-9]\d-", text)


def test_a_log_without_a_time_of_day_says_so_and_names_no_year(tmp_path: Path, rows: Lines) -> None:
    page = tmp_path / "monday.html"
    replayed(written(tmp_path, rows), "--report", page)
    text = text_of(page)
    assert_says(text, "no time of day", "t = 0 s to t = 10 s")
    assert not re.search(r"\d{4}-\d\d-\d\d|\d\d:\d\d", text)


def test_the_page_has_the_values_that_the_machine_file_gives(tmp_path: Path, rows: Lines) -> None:
    text = MACHINE.read_text(encoding="utf-8")
    machine, page = tmp_path / "own.toml", tmp_path / "own.html"
    machine.write_text(text.replace("[noise]", 'J = "12.5 kg*cm^2"\n\n[noise]'), encoding="utf-8")
    assert run("replay", machine, written(tmp_path, rows), "--report", page).exception is None
    assert "0.00125 kg" in text_of(page)
    assert "0.001171" not in text_of(page)


def test_two_replays_draw_the_same_bytes(tmp_path: Path, rows: Lines) -> None:
    data, pages = written(tmp_path, dated(rows)), [tmp_path / "1.html", tmp_path / "2.html"]
    for page in pages:
        replayed(data, "--report", page, "--json")
    assert pages[0].read_bytes() == pages[1].read_bytes()


def test_what_the_replay_warns_of_is_on_the_page(tmp_path: Path, rows: Lines) -> None:
    page = tmp_path / "monday.html"
    replayed(written(tmp_path, [*rows[:550], *rows[980:]]), "--report", page)
    assert_says(text_of(page), "gaps longer than a window")


def test_the_history_of_a_log_is_kept_and_shown_up_to_its_end(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    data, folder = written(tmp_path, dated(rows)), tmp_path / "kept"
    replayed(data, "--history", folder)
    (history,) = folder.glob("*.sqlite")
    result = run("report", history)
    assert result.exception is None
    text = text_of(tmp_path / result.stdout.strip())
    assert_says(text, "2026-09-", "data.csv", "state at the last report")
    assert "UNKNOWN" not in text
    assert "R_a" in run("history", history, "--since", "1h").stdout
    again = run("replay", MACHINE, data, "--history", folder).exception
    assert isinstance(again, ConfigurationError)
    assert_says(str(again), str(history), "exists")


def test_what_cannot_be_written_is_named_and_nothing_is_left(tmp_path: Path, rows: Lines) -> None:
    data, page = written(tmp_path, rows), tmp_path / "old.html"
    page.touch()
    assert isinstance(run("replay", MACHINE, data, "--report", page).exception, click.BadParameter)
    assert isinstance(run("replay", MACHINE, data, "--report", data / "page.html").exception, click.BadParameter)
    short = run("replay", MACHINE, written(tmp_path, rows[:20]), "--history", tmp_path / "kept").exception
    assert isinstance(short, ConfigurationError)
    assert list((tmp_path / "kept").iterdir()) == []
