"""``service.toml``: what belongs to the computer, beside the machine files for which it holds."""

import logging
import re
from pathlib import Path

import pytest

from otolith.cli.commissioning.complete_file import complete_lines
from otolith.cli.run import serve
from otolith.machine import LIBRARY, load_machine
from otolith.publishing.zenoh_config import Access
from otolith.runtime.hall.changes import changes_of_hall
from otolith.runtime.hall.files import files_in, read_files
from otolith.service_file import ServiceFile, ServiceTable, service_file_in, workers_of
from otolith_drivers.config_files import read
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.messages import assert_says, raises_saying

SERVICE = """
[service]
workers = 3
[zenoh]
listen = ["tcp/127.0.0.1:7450"]
[recording]
max_gigabytes = 2
[history]
days = 30
[evidence]
max_megabytes = 7
[outlets.prometheus]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in ("one", "two"):
        text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
        text = text.replace('"dc-motor-in-process"', f'"{name}"').replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    (tmp_path / "service.toml").write_text(SERVICE, encoding="utf-8")
    return tmp_path


def add(path: Path, text: str) -> None:
    path.write_text(path.read_text(encoding="utf-8") + text, encoding="utf-8")


def test_tables_of_the_service_hold_for_each_machine_beside_it(folder: Path) -> None:
    files = read_files([folder])
    assert not files.refused
    assert {name for _, name in files.machines} == {"one", "two"}
    for machine in files.machines.values():
        assert machine.file.zenoh.listen == ("tcp/127.0.0.1:7450",)
        assert machine.file.recording.max_gigabytes == 2
        assert machine.file.history.days == 30
        assert machine.file.evidence.max_megabytes == 7
        assert machine.file.outlets.names == ("prometheus",)
    assert workers_of([folder]) == 3
    assert workers_of([folder.parent]) is None


def test_a_table_of_a_machine_stands_in_place_of_that_of_the_service(folder: Path) -> None:
    add(folder / "one.toml", "\n[history]\nresend_hours = 2\n")
    one, two = (load_machine(folder / f"{name}.toml") for name in ("one", "two"))
    assert (one.file.history.days, one.file.history.resend_hours) == (3650, 2)
    assert two.file.history.days == 30
    assert one.file.recording == two.file.recording
    assert (one.path_of("history").name, two.path_of("history").name) == ("one.toml", "service.toml")


def test_a_machine_without_a_service_file_is_as_before(folder: Path) -> None:
    (folder / "service.toml").unlink()
    machine = load_machine(folder / "one.toml")
    assert machine.file.zenoh.listen == ("local",)
    assert machine.file.history.days == 3650
    assert machine.of_service == ()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[history]\ndays = 0\n", ("service.toml:2", "history.days", "0", "1")),
        ("[service]\nworker = 2\n", ("service.toml:2", "worker", "workers")),
        ("[service]\nworkers = 0\n", ("service.toml:2", "service.workers", "1")),
        ("[machine]\nname = 'press'\n", ("service.toml", "a machine file", "the file of a service")),
        ("[twin]\nname = 'pump'\n", ("service.toml:1", "twin")),
        ("[history\n", ("service.toml", "TOML")),
    ],
)
def test_a_wrong_service_file_is_named_by_line_and_ends_the_start(
    folder: Path, text: str, said: tuple[str, ...]
) -> None:
    (folder / "service.toml").write_text(text, encoding="utf-8")
    with raises_saying(ConfigurationError, *said):
        load_machine(folder / "one.toml")
    with pytest.raises(ConfigurationError) as caught:
        serve([folder], None, None, None)
    assert_says(str(caught.value), *said)
    assert caught.value.exit_code == 78


def test_a_link_that_leads_nowhere_is_no_missing_file(folder: Path) -> None:
    (folder / "service.toml").unlink()
    (folder / "service.toml").symlink_to(folder / "away")
    with raises_saying(ConfigurationError, "service.toml", "cannot be read"):
        load_machine(folder / "one.toml")


def test_the_file_of_the_service_is_no_machine(folder: Path) -> None:
    assert [path.name for path in files_in([folder])] == ["one.toml", "two.toml"]
    for text in (SERVICE, "", "[zenoh]\n"):
        (folder / "service.toml").write_text(text, encoding="utf-8")
        with raises_saying(ConfigurationError, "service.toml", "the file of a service", "otolith run DIRECTORY"):
            load_machine(folder / "service.toml")


def test_twins_and_scenarios_beside_machine_files_are_no_machines(folder: Path) -> None:
    """They were told as machines at NO DATA."""
    (folder / "pump-twin.toml").write_bytes((LIBRARY / "pump.toml").read_bytes())
    (folder / "plant.toml").write_bytes((EXAMPLES / "scenarios/demo.toml").read_bytes())
    (folder / "unfinished.toml").write_text("[machine", encoding="utf-8")
    (folder / "empty.toml").write_text("", encoding="utf-8")
    assert [each.path.name for each in read_files([folder]).refused] == ["empty.toml", "unfinished.toml"]


def test_a_folder_with_the_service_file_alone_has_no_machine(folder: Path) -> None:
    for name in ("one", "two"):
        (folder / f"{name}.toml").unlink()
    with raises_saying(ConfigurationError, "no machine", str(folder)):
        serve([folder], None, None, None)
    assert changes_of_hall([], [folder]).new == []
    for path in (folder, folder / "away"):
        assert changes_of_hall([], [path]).refused == ()


def test_what_is_wrong_with_certificates_is_said_of_the_file_that_names_them(folder: Path) -> None:
    text = '[zenoh]\nlisten = ["tls/127.0.0.1:7450"]\n[zenoh.tls]\nca = "ca"\ncertificate = "c"\nkey = "k"\n'
    (folder / "service.toml").write_text(text, encoding="utf-8")
    machine = load_machine(folder / "one.toml")
    with raises_saying(ConfigurationError, "service.toml:4: zenoh.tls.ca"):
        Access(machine.file.zenoh, machine.path_of("zenoh")).settings(["otolith/demo/one"], machine.file.zenoh.listen)


def test_the_complete_file_of_a_machine_leaves_tables_to_the_service(folder: Path) -> None:
    path = folder / "one.toml"
    add(path, "\n[history]\nresend_hours = 2\n")
    before = load_machine(path)
    lines = complete_lines(before, read(path))
    path.write_text("\n".join(lines), encoding="utf-8")
    after = load_machine(path)
    assert after.file.zenoh == before.file.zenoh
    assert after.file.history == before.file.history
    assert after.of_service == before.of_service


def test_tables_of_the_service_in_machine_files_are_told_once(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "two"):
        add(folder / f"{name}.toml", "\n[history]\nresend_hours = 2\n")
    monkeypatch.setattr("otolith.runtime.hall.daemon.Daemon.run", lambda _: 0)
    with caplog.at_level(logging.INFO, "otolith.cli.run"):
        assert serve([folder], None, None, None) == 0
    (line,) = [record.getMessage() for record in caplog.records if record.name == "otolith.cli.run"]
    assert_says(line, "[history]", "one.toml", "two.toml", "service.toml")


def test_every_key_of_the_service_is_listed() -> None:
    """Those of the other tables are listed for the machine file."""
    page = (Path(__file__).parents[2] / "docs/reference/service-file.md").read_text(encoding="utf-8")
    assert set(re.findall(r"^\| `\[(\w+)\]` \|", page, re.MULTILINE)) == set(ServiceFile.model_fields)
    assert set(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == set(ServiceTable.model_fields)


def test_the_shipped_example_is_one() -> None:
    example = service_file_in(EXAMPLES / "hall")
    assert example is not None
    assert example.recording.max_gigabytes == 2.0
