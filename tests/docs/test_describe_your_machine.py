"""The guide docs/describe-your-machine.md: its files are read, its twin estimates, its error is the real one."""

import re
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.commissioning.check import describe, without_sensors
from otolith.machine import load_machine, load_twin
from otolith.twin.expressions import FUNCTIONS
from otolith.twin.identifiability import structural_identifiability
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.errors import ConfigurationError

GUIDE = (Path(__file__).parents[2] / "docs" / "describe-your-machine.md").read_text(encoding="utf-8")
DBC = """VERSION "1"
BU_: Drive Monitor
BO_ 400 Drive: 8 Drive
 SG_ MotorTorque : 0|16@1- (0.01,0) [-300|300] "Nm" Monitor
 SG_ MotorVoltage : 32|16@1- (0.01,0) [-300|300] "V" Monitor
 SG_ MotorCurrent : 48|16@1- (0.01,0) [-300|300] "A" Monitor
 SG_ MotorSpeed : 16|16@1- (0.1,0) [-3000|3000] "rpm" Monitor
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in re.findall(r"<!-- file: (\S+) -->\n```toml\n(.*?)```", GUIDE, re.DOTALL):
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "drive.dbc").write_text(DBC, encoding="utf-8")
    return tmp_path


def test_guide_files_are_read_and_identifiable(folder: Path) -> None:
    assert all(parameter.identifiable for parameter in structural_identifiability(load_twin(folder / "fan.toml")))
    plan = load_machine(folder / "fan-3.toml")
    assert [parameter.name for parameter in plan.problem.free] == ["T_c", "k"]
    assert any("MotorSpeed [rpm]" in line for line in describe(plan))


def test_guide_prints_what_is_lost_without_a_sensor(folder: Path) -> None:
    ((name, expected),) = re.findall(r"<!-- lost: (\S+) -->\n```\n(.*?)\n```", GUIDE, re.DOTALL)
    assert without_sensors(load_machine(folder / name)) == expected.splitlines()


def test_guide_prints_the_real_error(folder: Path) -> None:
    name, right, wrong, message = re.findall(
        r"<!-- error: (\S+) \| (.*?) \| (.*?) -->\n```\n(.*?)\n```", GUIDE, re.DOTALL
    )[0]
    text = (folder / name).read_text(encoding="utf-8")
    assert right in text
    (folder / name).write_text(text.replace(right, wrong), encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_twin(folder / name)
    assert str(caught.value).replace(f"{folder}/", "") == message


def test_guide_twin_estimates(folder: Path) -> None:
    plan = load_machine(folder / "fan-3.toml")
    random = np.random.default_rng(1)
    torque = np.repeat(random.uniform(2.0, 12.0, 10), 50)
    truth = np.array([[0.085, 0.9, 0.00031]])
    omega = kernel_of(plan.twin).simulate(truth, np.array([[80.0]]), Excitation.uniform(torque[:, None], 0.02))[0, :, 0]
    values = np.column_stack([torque, omega + random.normal(0.0, 0.1, 500)])
    window = Window.whole(0, 0.0, 0.02, ("T_m", "omega"), values)
    _, report = adapt(initial_state("fan-3", "hall-2", plan.problem), window)
    estimates = {name: parameter.value for name, parameter in report.document.parameters.items()}
    assert estimates == pytest.approx({"T_c": 0.9, "k": 0.00031}, rel=0.02)


def test_guide_names_every_function() -> None:
    assert all(re.search(rf"\b{name}\b", GUIDE) for name in FUNCTIONS)
