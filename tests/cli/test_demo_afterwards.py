"""After a demo: its last line works when pasted, and its machine's name finds it where there is no other machine."""

import shlex
import subprocess
import time
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from otolith.cli.demo import Demo
from otolith.cli.machines import last_reports
from otolith.cli.main import cli
from otolith.cli.operation import view as module
from otolith.health.limits import Level
from otolith.storage.history import history_path, path_in
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.user_dirs import state_directory
from tests.cli.test_view import arguments_of, made, services, shown
from tests.conftest import EXAMPLES
from tests.messages import assert_says
from tests.publishing.test_html_report import Page, state_of
from tests.storage.histories import document

__all__ = ["services", "shown"]  # fixtures
SITE, MACHINE = "demo", "dc-motor"  # of config/dc-motor.toml


def keep(path: Path, end: float, value: float) -> None:
    """Write a history with one window that ends at ``end``."""
    writer = HistoryWriter(path, Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(end)
    names = {"machine": MACHINE, "site": SITE, "health": state_of(Level.OK, end - 2.0)}
    writer.add(numbers.number(document(0, end, value).model_copy(update=names)))
    writer._write_waiting()
    writer._close()


def demo(stamp: str, age: float, value: float) -> Path:
    """The folder of a demo that ended ``age`` s ago."""
    folder = state_directory() / "demo" / stamp
    keep(path_in(folder / "history", SITE, MACHINE), time.time() - age, value)
    return folder


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli, arguments, standalone_mode=False)


def shown_page() -> str:
    return Page(run("report", MACHINE, "--output", "-").stdout).text


def test_the_last_line_of_a_demo_works_when_pasted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = Demo(EXAMPLES / "dc-motor.toml", EXAMPLES / "scenarios" / "demo.toml", 8.0, as_json=False)
    keep(path_in(ended._folder / "history", SITE, MACHINE), time.time() - 300.0, 6.5)
    monkeypatch.chdir(tmp_path)
    *_, last = ended._closing_lines()
    command = last.partition(": ")[2]
    pasted = subprocess.run(shlex.split(command), capture_output=True, text=True, check=True)
    text = Page((tmp_path / pasted.stdout.strip()).read_text(encoding="utf-8")).text
    assert_says(text, "6.500 ± 0.020 Ω", "state at the last report")
    assert "UNKNOWN" not in text


def test_a_name_without_a_machine_means_the_last_demo() -> None:
    demo("20260101T120000-7", 500.0, 6.1)
    demo("20260101T130000-5", 300.0, 6.3)
    assert_says(shown_page(), "6.300 ± 0.020 Ω", "state at the last report")
    result = run("history", MACHINE, "--since", "1m")
    assert "6.3" in result.stdout
    assert "20260101T130000-5" in result.stderr  # nobody takes it for a machine


def test_a_machine_goes_before_a_demo() -> None:
    demo("20260101T130000-5", 300.0, 6.3)
    keep(history_path(SITE, MACHINE), time.time(), 6.7)
    assert "6.700 ± 0.020 Ω" in shown_page()


def test_an_unknown_name_is_refused_all_the_same() -> None:
    demo("20260101T130000-5", 300.0, 6.3)
    error = run("report", "dc-moter").exception
    assert isinstance(error, ConfigurationError)
    assert_says(str(error), "dc-moter", "'dc-motor'")


def test_the_recording_of_a_demo_is_viewed_by_name_if_there_is_no_other(services: Path, shown: Path) -> None:
    own = services.parent / "own" / "otolith"
    ended = Demo(EXAMPLES / "dc-motor.toml", EXAMPLES / "scenarios" / "demo.toml", 8.0, as_json=False)
    recording = made(ended._folder, f"{SITE}.{MACHINE}", 10.0).rename(ended._recording)
    assert run("view", MACHINE).exception is None
    assert str(recording) in arguments_of(shown)
    assert module.Recordings.search(MACHINE).files[0].key == f"{SITE}.{MACHINE}"
    other = made(own / "recordings", f"{SITE}.{MACHINE}", 900.0)
    run("view", MACHINE)
    assert str(other) in arguments_of(shown).splitlines()[-1]


def test_who_watches_after_a_demo_learns_when_it_ended() -> None:
    demo("20260131T101112", 7200.0, 6.5)
    demo("20260131T111112", 600.0, 6.6)
    (line,) = last_reports()
    assert_says(line, f"{SITE}.{MACHINE}", "10 min ago", "otolith report")
