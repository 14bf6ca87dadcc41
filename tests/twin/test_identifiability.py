"""Structural identifiability, and a new twin from one TOML file: a thermal model of a winding."""

from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.schema import Status
from otolith.machine import load_machine, load_twin
from otolith.twin.identifiability import structural_identifiability
from otolith.twin.kernel import Excitation, kernel_of

PAGE = """
[twin]
name = "winding"
title = "temperature of a motor winding"
source = "one thermal body: heat capacity and thermal resistance to the housing"

[states]
theta = { unit = "K", meaning = "temperature of the winding over the housing", bounds = [-50, 300] }

[inputs]
i = { unit = "A", hold = "foh", range = [0, 20], meaning = "current" }

[outputs]
theta = { unit = "K", noise = "0.1 K", meaning = "temperature of the winding over the housing" }

[parameters]
R = { unit = "ohm", nominal = 1.5, bounds = [0.5, 5], meaning = "resistance of the winding" }
C = { unit = "J/K", nominal = 120, bounds = [20, 800], role = "estimated", meaning = "heat capacity" }
R_th = { unit = "K/W", nominal = 0.9, bounds = [0.2, 4], role = "estimated", meaning = "thermal resistance" }

[equations]
"der(theta)" = "(R*i^2 - theta/R_th) / C"

[sites]
heat = { into = "der(theta)", mode = "additive", through = "1/C", unit = "W", meaning = "heat" }
"""

LAB_MOTOR = """[twin]
name = "lab_motor"
title = "lab motor"
source = "own"
[states]
i = { unit = "A", meaning = "current", bounds = [-50, 50] }
omega = { unit = "rad/s", meaning = "speed", bounds = [-500, 500] }
[inputs]
V = { unit = "V", hold = "zoh", range = [-24, 24], meaning = "voltage" }
[outputs]
i = { unit = "A", noise = "5 mA", meaning = "current" }
omega = { unit = "rad/s", noise = "0.05 rad/s", meaning = "speed" }
[parameters]
R = { unit = "ohm", nominal = 2.0, bounds = [0.5, 6], meaning = "resistance" }
L = { unit = "H", nominal = 0.002, bounds = [0.0005, 0.01], meaning = "inductance" }
K_e = { unit = "V*s/rad", nominal = 0.05, bounds = [0.01, 0.2], role = "estimated", meaning = "emf constant" }
K_t = { unit = "N*m/A", nominal = 0.05, bounds = [0.01, 0.2], role = "estimated", meaning = "torque constant" }
J = { unit = "kg*m^2", nominal = 1e-4, bounds = [2e-5, 5e-4], meaning = "inertia" }
B = { unit = "N*m*s/rad", nominal = 1e-4, bounds = [0, 1e-3], role = "estimated", meaning = "damping" }
T_c = { unit = "N*m", nominal = 0.01, bounds = [0, 0.1], role = "estimated", meaning = "dry friction" }
w_s = { unit = "rad/s", nominal = 0.5, bounds = [0.1, 2], meaning = "transition" }
[equations]
"der(i)" = "(V - R*i - K_e*omega) / L"
"der(omega)" = "(K_t*i - B*omega - T_c*tanh(omega/w_s)) / J"
"""

DBC = """VERSION "1"
BU_: Drive Monitor
BO_ 387 Thermal: 8 Drive
 SG_ Current : 0|16@1- (0.01,0) [-300|300] "A" Monitor
 SG_ Temperature : 16|16@1- (0.1,0) [-300|300] "K" Monitor
"""


@pytest.fixture
def machine_file(tmp_path: Path) -> Path:
    (tmp_path / "winding.toml").write_text(PAGE, encoding="utf-8")
    (tmp_path / "thermal.dbc").write_text(DBC, encoding="utf-8")
    path = tmp_path / "machine.toml"
    path.write_text(
        '[machine]\nname = "spindle"\n[driver]\ntype = "can"\ndbc = "thermal.dbc"\n[twin]\nfile = "winding.toml"\n'
        '[signals]\ni = { signal = "Current" }\ntheta = { signal = "Temperature" }\n'
        '[window]\nlength = "300 s"\nsample_period = "1 s"\n',
        encoding="utf-8",
    )
    return path


def test_new_twin_estimates_parameters_by_role(machine_file: Path) -> None:
    plan = load_machine(machine_file)
    assert [parameter.name for parameter in plan.problem.free] == ["C", "R_th"]
    random = np.random.default_rng(4)
    current = np.repeat(random.uniform(2.0, 15.0, 30), 10)
    drive = Excitation.uniform(current[:, None], 1.0)
    truth = np.array([[1.5, 95.0, 1.1]])
    theta = kernel_of(plan.twin).simulate(truth, np.array([[20.0]]), drive)[0, :, 0] + random.normal(0.0, 0.1, 300)
    values = np.column_stack([current, theta])
    window = Window.whole(0, 0.0, 1.0, ("i", "theta"), values)
    _, report = adapt(initial_state("spindle", "site", plan.problem), window)
    for name, value in (("C", 95.0), ("R_th", 1.1)):
        result = report.document.parameters[name]
        assert result.status is Status.ESTIMATED
        assert result.value == pytest.approx(value, rel=0.01)
        assert result.low is not None
        assert result.high is not None
        assert result.low - 2e-3 * value < value < result.high + 2e-3 * value


def reasons(tmp_path: Path, page: str) -> dict[str, str]:
    """Why each parameter could not be estimated; empty if it could."""
    path = tmp_path / "twin.toml"
    path.write_text(page, encoding="utf-8")
    return {row.name: row.reason for row in structural_identifiability(load_twin(path))}


KNOWN_HEAT = PAGE.replace(
    'R = { unit = "ohm", nominal = 1.5, bounds = [0.5, 5], meaning = "resistance of the winding" }\n', ""
).replace(
    "[equations]",
    '[constants]\nR = { unit = "ohm", value = 1.5, meaning = "resistance of the winding" }\n\n[equations]',
)


def with_second(page: str, line: str) -> str:
    """``page`` with one more parameter."""
    return page.replace("\n[constants]", f"{line}\n\n[constants]")


def test_parameters_that_act_together_are_named(tmp_path: Path) -> None:
    """Only R/C and R_th*C act: one of the three can be estimated if another is given."""
    unknown = PAGE.replace("bounds = [0.5, 5],", 'bounds = [0.5, 5], role = "estimated",')
    names = {"R": "C, R_th", "C": "R, R_th", "R_th": "R, C"}
    assert reasons(tmp_path, unknown) == {name: f"only together with {others}" for name, others in names.items()}
    assert reasons(tmp_path, KNOWN_HEAT) == {"C": "", "R_th": ""}


def test_a_given_parameter_makes_the_others_estimable(tmp_path: Path) -> None:
    """The role of R is not to be estimated, so it is given."""
    assert reasons(tmp_path, PAGE) == {"R": "only together with C, R_th", "C": "", "R_th": ""}


def test_a_small_partner_is_named(tmp_path: Path) -> None:
    """Torques are not measured: their constant, inertia, damping and dry friction have one scale in common."""
    known = reasons(tmp_path, LAB_MOTOR)
    assert known == dict.fromkeys(known, "") | {"J": "only together with K_t, B, T_c"}
    scaled = reasons(
        tmp_path, LAB_MOTOR.replace("bounds = [2e-5, 5e-4],", 'bounds = [2e-5, 5e-4], role = "estimated",')
    )
    scale = ("K_t", "J", "B", "T_c")
    assert scaled == {
        name: f"only together with {', '.join(other for other in scale if other != name)}" if name in scale else ""
        for name in known
    }


def test_resistances_in_series_are_one(tmp_path: Path) -> None:
    second = 'R_2 = { unit = "K/W", nominal = 0.4, bounds = [0.1, 2], role = "estimated", meaning = "second" }'
    result = reasons(tmp_path, with_second(KNOWN_HEAT, second).replace("theta/R_th", "theta/(R_th + R_2)"))
    assert result == {"C": "", "R_th": "only together with R_2", "R_2": "only together with R_th"}


def test_parameter_without_effect_is_named(tmp_path: Path) -> None:
    second = 'R_2 = { unit = "1", nominal = 0.4, bounds = [0.1, 2], meaning = "nothing" }'
    result = reasons(tmp_path, with_second(KNOWN_HEAT, second).replace('/ C"', '/ C + 0*R_2*theta/R_th/C"'))
    assert result == {"C": "", "R_th": "", "R_2": "no output depends on it"}


def test_threshold_is_not_called_dead(tmp_path: Path) -> None:
    second = 'i_0 = { unit = "A", nominal = 5, bounds = [1, 9], meaning = "current from which it heats" }'
    result = reasons(tmp_path, with_second(KNOWN_HEAT, second).replace("R*i^2", "where(i > i_0, R*i^2, 0)"))
    assert result["i_0"].startswith("it acts as a threshold only")


def test_fast_circuit_is_judged_by_its_equations(tmp_path: Path) -> None:
    """A time constant of a microsecond: only the product of resistance and capacitance acts."""
    path = tmp_path / "rc.toml"
    path.write_text(
        """
[twin]
name = "rc"
title = "low pass"
source = "Kirchhoff"
[states]
v = { unit = "V", meaning = "voltage" }
[inputs]
u = { unit = "V", hold = "zoh", range = [0, 10], meaning = "input" }
[outputs]
v = { unit = "V", noise = 0.01, meaning = "voltage" }
[parameters]
R = { unit = "ohm", nominal = 10, bounds = [1, 100], role = "estimated", meaning = "resistance" }
C = { unit = "nF", nominal = 100, bounds = [10, 1000], role = "estimated", meaning = "capacitance" }
[equations]
"der(v)" = "(u - v)/(R*C)"
""",
        encoding="utf-8",
    )
    result = {row.name: row.reason for row in structural_identifiability(load_twin(path))}
    assert result == {"R": "only together with C", "C": "only together with R"}
