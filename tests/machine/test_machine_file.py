"""Machine files: the golden folder of wrong ones, each with the sentence it gets, and what a right one means.

A case is a folder with ``machine.toml`` and ``error.txt``; in the latter ``{file}`` stands for the file and ``*`` for
what differs between computers. ``OTOLITH_UPDATE_GOLDEN=1 make test`` writes the sentences anew: read the difference.
"""

import os
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from otolith.cli.check import describe
from otolith.machine import load_machine
from otolith_drivers.errors import ConfigurationError, OtolithError
from tests.conftest import EXAMPLES, OwnMachine

GOLDEN = Path(__file__).parents[1] / "golden" / "machine_files"
CASES = sorted(path.parent for path in GOLDEN.glob("*/machine.toml"))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_wrong_file_gets_its_sentence(case: Path) -> None:
    file = case / "machine.toml"
    with pytest.raises(OtolithError) as caught:
        load_machine(file).driver.open(lambda _: None)
    assert caught.value.exit_code == 2
    said = str(caught.value).replace(str(file), "{file}").replace(str(case), "{folder}")
    expected = case / "error.txt"
    if os.environ.get("OTOLITH_UPDATE_GOLDEN") and not (expected.exists() and "*" in expected.read_text()):
        expected.write_text(said + "\n", encoding="utf-8")
    assert fnmatchcase(said, expected.read_text(encoding="utf-8").rstrip("\n").replace("[", "[[]"))


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_machine_file_to_copy_can_be_loaded(path: Path) -> None:
    plan = load_machine(path)
    lines = describe(plan)
    assert all(any(line.startswith(f"{signal} ") for line in lines) for signal in plan.twin.signals)


def test_all_machine_files_to_copy_can_run_on_one_computer() -> None:
    """Each publishes on a port of its own; only the two of the same motor share theirs."""
    others = [path for path in sorted(EXAMPLES.glob("*.toml")) if path.stem != "dc-motor-in-process"]
    endpoints = [endpoint for path in others for endpoint in load_machine(path).file.zenoh.listen]
    assert len(set(endpoints)) == len(others)


def test_the_example_means_what_it_says() -> None:
    plan = load_machine(EXAMPLES / "dc-motor.toml")
    assert [entry.name for entry in plan.problem.free] == ["R_a"]
    assert dict(plan.problem.known)["J"] == pytest.approx(0.001171)
    assert plan.problem.noise == (0.005, 0.02)
    assert plan.records == 200
    assert any("MotorMechanical.RotorSpeed" in line for line in describe(plan))


def test_the_simplest_machine_file_needs_no_bus() -> None:
    """The machine of dc-motor.toml, simulated in the daemon; what the shorter file leaves out is as the twin says."""
    simple, whole = load_machine(EXAMPLES / "dc-motor-in-process.toml"), load_machine(EXAMPLES / "dc-motor.toml")
    assert [entry.name for entry in simple.problem.free] == ["R_a", "D"]
    assert simple.problem.noise == whole.problem.noise
    assert any("omega from RotorSpeed [rad/s]" in line for line in describe(simple))


def test_every_commented_default_of_the_example_is_the_default(tmp_path: Path) -> None:
    """What a user gets by taking the '# ' off is what there was before."""
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    plain = load_machine(EXAMPLES / "dc-motor.toml").file
    uncommented = "\n".join(
        line[2:] if line.startswith("# ") and "folder" not in line else line for line in text.splitlines()
    )
    assert uncommented.count("\n[") > text.count("\n[")
    path = tmp_path / "dc-motor.toml"
    path.write_text(uncommented, encoding="utf-8")
    (tmp_path / "dc-motor.dbc").write_bytes((EXAMPLES / "dc-motor.dbc").read_bytes())
    loaded = load_machine(path)
    assert loaded.file.model_copy(update={"driver": plain.driver, "process_noise": {}}) == plain
    assert loaded.problem == load_machine(EXAMPLES / "dc-motor.toml").problem


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("odrive-axis", "F [N] from Axis0_Iq.Iq_Measured * 62.8 [N], frame 0x14"),
        ("canopen-drive", "x [m] from node 5 Position actual value (0x6064:00), TPDO 2 * 1e-06 [m], frame 0x285"),
    ],
)
def test_the_examples_of_drives_are_in_order(name: str, line: str) -> None:
    said = describe(load_machine(EXAMPLES / f"{name}.toml"))
    assert line in said
    assert not any("warning" in text for text in said)


def test_units_of_the_file_are_free(own_machine: OwnMachine) -> None:
    text = own_machine.machine.read_text(encoding="utf-8")
    other = text.replace('"6.5 ohm"', '"6500 mohm"').replace('"0.02 rad/s"', '"0.190985932 rpm"')
    own_machine.machine.write_text(other, encoding="utf-8")
    problem = load_machine(own_machine.machine).problem
    assert problem.free[0].nominal == pytest.approx(6.5)
    assert problem.noise[1] == pytest.approx(0.02)


def test_an_unreadable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load_machine(tmp_path / "none.toml")
