"""A machine is given by its file, its name, or site and name, in all commands alike."""

import json
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from otolith.cli import common
from otolith.cli.machines import file_of, key_of, last_reports, reader_of
from otolith.cli.main import cli
from otolith.cli.operation.live_table import FIRST_ANSWER, waiting_text
from otolith.cli.operation.view import Recordings
from otolith.health.labels import Numbers
from otolith.machine import load_machine
from otolith.storage.history import describe_machine, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.user_dirs import state_directory
from tests.conftest import EXAMPLES
from tests.messages import assert_says, raises_saying
from tests.storage.histories import MACHINE, SITE, document

FILE = f'[machine]\nname = "{MACHINE}"\nsite = "{SITE}"\n'
SPELLINGS = (MACHINE, f"{SITE}.{MACHINE}", "file")


@pytest.fixture
def machine_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The machine file of a daemon that ran an hour ago, and left a history."""
    monkeypatch.setattr(common, "INSTALLED", tmp_path / "etc")
    path = tmp_path / "own.toml"
    rest = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8").partition("[twin]")
    path.write_text(f"{FILE}{rest[1]}{rest[2]}", encoding="utf-8")
    shutil.copytree(EXAMPLES / "scenarios", tmp_path / "scenarios")
    keep_history(SITE, path)
    return path


def keep_history(site: str, path: Path) -> None:
    now = time.time() - 3600.0
    writer = HistoryWriter(history_path(site, MACHINE), Bounds(20_000_000, 3650, 24))
    writer.open(now)
    machine = load_machine(path, with_driver=False)
    writer.description = describe_machine(machine.twin, machine.plan, file=path)
    writer.add(Numbers(now).number(document(0, now).model_copy(update={"site": site})))
    writer._write_waiting()
    writer._close()


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_one_spelling_means_the_same_file_history_and_key(machine_file: Path, spelling: str) -> None:
    text = str(machine_file) if spelling == "file" else spelling
    assert file_of(text) == machine_file
    assert reader_of(text).path == history_path(SITE, MACHINE)
    folder = state_directory() / "recordings"
    folder.mkdir(parents=True)
    shutil.copy(machine_file, folder / f"{SITE}.{MACHINE}-20260131T101112-17.rrd")
    key = key_of(text)
    assert key in {MACHINE, f"{SITE}.{MACHINE}"}
    assert len(Recordings.search(key).files) == 1


def machine_arguments() -> Iterator[tuple[str, str]]:
    """The name of each command with an argument for a machine, and what help calls the argument."""

    def walk(command: click.Command, name: str) -> Iterator[tuple[str, str]]:
        for part in command.commands.values() if isinstance(command, click.Group) else ():
            yield from walk(part, f"{name} {part.name}")
        for row in command.params:
            if isinstance(row, click.Argument) and row.name in {"file", "machine", "recordings"}:
                yield name, row.make_metavar(click.Context(command))

    yield from walk(cli, "otolith")


def test_every_command_that_takes_a_machine_says_that_it_takes_both() -> None:
    rows = dict(machine_arguments())
    assert {"otolith watch", "otolith history", "otolith view", "otolith reset", "otolith baseline"} <= rows.keys()
    own = {"otolith init", "otolith twin check", "otolith site"}  # a new file; a twin; a site
    assert {name: text for name, text in rows.items() if name not in own and not {"FILE", "MACHINE"} <= set(
        text.strip("[].").split("|"))} == {}  # fmt: skip


@pytest.mark.parametrize("find", [file_of, reader_of])
def test_an_unknown_name_lists_what_is_there(machine_file: Path, find: Callable[[str], object]) -> None:
    del machine_file
    with raises_saying(ConfigurationError, "press-4", f"{SITE}.{MACHINE}", "machine file"):
        find("press-4")
    with raises_saying(ConfigurationError, f"did you mean '{SITE}.{MACHINE}'"):
        find("hall-1.pres-3")


def test_machines_of_one_name_are_told_apart_by_their_site(machine_file: Path) -> None:
    other = machine_file.with_name("other.toml")
    other.write_text(machine_file.read_text(encoding="utf-8").replace(SITE, "hall-2"), encoding="utf-8")
    keep_history("hall-2", other)
    for find in (file_of, reader_of):
        with raises_saying(ConfigurationError, MACHINE, f"{SITE}.{MACHINE}", f"hall-2.{MACHINE}"):
            find(MACHINE)
    assert file_of(f"hall-2.{MACHINE}") == other
    assert reader_of(f"hall-2.{MACHINE}").site == "hall-2"


def test_a_service_is_found_by_its_own_name_and_that_of_its_machine(machine_file: Path) -> None:
    installed = common.INSTALLED / "line-7.toml"
    installed.parent.mkdir()
    installed.write_text(FILE.replace(MACHINE, "mill"), encoding="utf-8")
    for text in ("line-7", "mill", f"{SITE}.mill"):
        assert file_of(text) == installed
        assert key_of(text) == f"{SITE}.mill"
    del machine_file


def test_a_file_that_has_become_that_of_another_machine_is_not_taken(machine_file: Path) -> None:
    machine_file.write_text(FILE.replace(MACHINE, "other"), encoding="utf-8")
    with raises_saying(ConfigurationError, MACHINE, "machine file", "give the file"):
        file_of(MACHINE)


def test_a_command_of_a_machine_takes_its_name(machine_file: Path) -> None:
    del machine_file
    done = CliRunner().invoke(cli, ["reset", MACHINE, "R_a"], catch_exceptions=False)
    assert (done.output, done.exit_code) == ("R_a is forgotten\n", 0)


@pytest.mark.parametrize("spelling", ["*", MACHINE, f"{SITE}.{MACHINE}", "other"])
def test_who_watches_a_daemon_that_has_ended_learns_when_its_last_report_was(machine_file: Path, spelling: str) -> None:
    del machine_file
    lines = list(last_reports(spelling))
    assert len(lines) == (spelling != "other")
    for line in lines:
        assert_says(line, f"{SITE}.{MACHINE}", "60 min ago", f"otolith report {SITE}.{MACHINE}")


def test_a_machine_is_named_as_silent_only_when_its_daemon_had_time_to_answer() -> None:
    """Meanwhile another one may be about to answer: the first line must not name a wrong machine."""
    known = [f"last report of {SITE}.{MACHINE}: an hour ago"]
    assert MACHINE not in waiting_text(0.0, known)
    assert MACHINE not in waiting_text(0.9 * FIRST_ANSWER, known)
    assert_says(waiting_text(1.1 * FIRST_ANSWER, known), "no daemon", known[0])


def test_a_history_says_nothing_of_where_its_file_is_to_a_reader_of_values(machine_file: Path) -> None:
    """The page and the JSON of a history are passed on."""
    shown = CliRunner().invoke(cli, ["history", MACHINE, "--json"]).output
    page = CliRunner().invoke(cli, ["report", MACHINE, "--output", "-"]).output
    assert json.loads(shown)["machine"] == MACHINE
    assert str(machine_file) not in shown + page
