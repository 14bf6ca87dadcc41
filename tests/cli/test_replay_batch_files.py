"""Which recordings of a folder are of which machine."""

from dataclasses import replace
from pathlib import Path

import pytest

from otolith.cli.replay_batch import files_of_machines
from otolith.machine import LoadedMachine, load_machine
from otolith_drivers.errors import ConfigurationError
from tests.cli.replays import MACHINE
from tests.messages import assert_says, raises_saying


@pytest.fixture(scope="module")
def machine() -> LoadedMachine:
    return load_machine(MACHINE, with_driver=False)


def named(machine: LoadedMachine, name: str, site: str = "hall") -> LoadedMachine:
    names = machine.file.machine.model_copy(update={"name": name, "site": site})
    return replace(machine, file=machine.file.model_copy(update={"machine": names}))


def made(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def found(machines: list[LoadedMachine], folder: Path, *data: Path) -> dict[str, list[str]]:
    files = files_of_machines(machines, data or [folder])
    return {key: [str(path.relative_to(folder)) for path in paths] for key, paths in files.items()}


def test_files_of_several_machines_are_found_by_folder_and_name(
    machine: LoadedMachine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    own, begun = "hall.press-20260101T000000-1.rrd", "hall.press-20260101T010000-1.rrd"
    made(tmp_path, own.replace(".rrd", ".samples.parquet"), begun, begun.replace(".rrd", ".samples/000001.parquet"))
    made(tmp_path, alone := "hall.press-20260101T020000-1.samples.parquet")
    made(tmp_path, "pump/2.csv", "pump/1.csv", "hall.saw/1.csv", "saw.csv", "saw.2026-01-02.csv", own, "notes.txt")
    made(tmp_path, ".hidden/1.csv", "pump/.hidden", "other/1.csv")
    machines = [named(machine, name) for name in ("pump", "saw", "press")]
    assert found(machines, tmp_path) == {
        "hall.pump": ["pump/1.csv", "pump/2.csv"],
        "hall.saw": ["saw.2026-01-02.csv", "saw.csv", "hall.saw/1.csv"],
        "hall.press": [own, begun, alone],
    }
    assert_says(caplog.text, "2 files", str(tmp_path / "notes.txt"), str(tmp_path / "other" / "1.csv"), "'pump.'")


def test_a_machine_that_is_alone_has_all_files(
    machine: LoadedMachine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made(tmp_path, "b.csv", "a.csv")
    assert found([machine], tmp_path) == {"site.motor": ["a.csv", "b.csv"]}
    assert not caplog.text
    assert found([machine], tmp_path, tmp_path / "b.csv", tmp_path / "a.csv") == {"site.motor": ["b.csv", "a.csv"]}


def test_a_name_of_two_sites_needs_the_site(machine: LoadedMachine, tmp_path: Path) -> None:
    made(tmp_path, "north.pump/1.csv", "south.pump.csv")
    machines = [named(machine, "pump", site) for site in ("north", "south")]
    assert found(machines, tmp_path) == {"north.pump": ["north.pump/1.csv"], "south.pump": ["south.pump.csv"]}
    made(tmp_path, "pump.csv")
    with raises_saying(ConfigurationError, "pump.csv", "north.pump"):
        found(machines, tmp_path, tmp_path, tmp_path / "pump.csv")


def test_a_machine_without_files_is_named(machine: LoadedMachine, tmp_path: Path) -> None:
    made(tmp_path, "pump.csv")
    with raises_saying(ConfigurationError, str(tmp_path), "hall.saw"):
        found([named(machine, "pump"), named(machine, "saw")], tmp_path)
