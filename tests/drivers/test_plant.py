"""The simulated motor: its physics, its reproducibility, and the paper's scenarios."""

import math
from itertools import islice
from pathlib import Path

import pytest

from otolith_drivers.plant.dc_motor import MotorScenario, SetPoint
from otolith_drivers.plant.faults import Drift, Unbalance
from otolith_drivers.plant.plants import load_scenario, simulate
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.tick import Tick
from tests.conftest import EXAMPLES


def run(scenario: Scenario, seconds: float) -> list[Tick]:
    return list(islice(simulate(scenario), round(seconds / scenario.sample_period) + 1))


@pytest.fixture
def quiet(scenario: MotorScenario) -> MotorScenario:
    """Without noise and faults, asked for 10 rad/s from the start."""
    changes = {"noise": type(scenario.noise)(), "faults": (), "set_points": (SetPoint(at="0 s", speed="10 rad/s"),)}
    return scenario.model_copy(update={**changes, "repeat_every": None})


def test_settles_where_the_equations_say(quiet: MotorScenario) -> None:
    last = run(quiet, 200.0)[-1]
    speed, p = last.truth["omega"], quiet.parameters
    assert speed == pytest.approx(10.0, rel=1e-4)
    assert last.truth["i"] == pytest.approx((p.D + quiet.load) * speed / p.K_t, rel=1e-6)
    assert last.measured["ArmatureVoltage"] == pytest.approx(p.R_a * last.truth["i"] + p.K_e * speed, rel=1e-6)


def test_the_same_seed_gives_the_same_run(scenario: Scenario) -> None:
    assert run(scenario, 1.0) == run(scenario, 1.0)
    assert run(scenario, 1.0) != run(scenario.model_copy(update={"seed": 7}), 1.0)


def test_noise_is_as_large_as_the_scenario_says(scenario: MotorScenario) -> None:
    ticks = run(scenario, 60.0)
    spread = math.sqrt(sum((tick.measured["ArmatureCurrent"] - tick.truth["i"]) ** 2 for tick in ticks) / len(ticks))
    assert spread == pytest.approx(scenario.noise.current, rel=0.05)


def test_integrators_agree_on_the_machine(quiet: MotorScenario) -> None:
    accurate = run(quiet, 5.0)[-1].truth
    euler = run(quiet.model_copy(update={"integrator": "euler"}), 5.0)[-1].truth
    assert euler["omega"] == pytest.approx(accurate["omega"], rel=1e-3)
    assert euler["omega"] != accurate["omega"]


def test_euler_is_equation_11_and_12_to_the_letter(quiet: MotorScenario) -> None:
    ticks = run(quiet.model_copy(update={"integrator": "euler"}), 0.01)
    p, i, w = quiet.parameters, 0.0, 0.0
    for _ in range(100):
        i_new = i + 1e-4 * (ticks[0].measured["ArmatureVoltage"] - p.R_a * i - p.K_e * w) / p.L_a
        w, i = w + 1e-4 * (i_new * p.K_t - quiet.load * w - p.D * w) / p.J, i_new
    assert ticks[1].truth["i"] == pytest.approx(i, rel=1e-14)
    assert ticks[1].truth["omega"] == pytest.approx(w, rel=1e-14)


@pytest.mark.parametrize(
    ("name", "parameter", "final"), [("armature-resistance", "R_a", 5.6), ("bearing-wear", "D", 0.00227)]
)
def test_the_papers_degradations_end_where_the_paper_says(name: str, parameter: str, final: float) -> None:
    fault = load_scenario(EXAMPLES / "scenarios" / f"{name}.toml").faults[0]
    assert isinstance(fault, Drift)
    initial = {"R_a": 6.5, "D": 0.00143}[parameter]
    amount = {"R_a": -0.044, "D": 0.00003806}[parameter]
    assert initial + fault.change(1200.0, amount) == pytest.approx(final, rel=0.02)
    assert fault.change(160.0, amount) == 0.0


def test_demo_loses_more_than_five_percent_of_the_resistance(scenario: Scenario) -> None:
    last = run(scenario, 90.0)[-1].truth["R_a"]
    assert last < 0.95 * 6.5


def test_unbalance_by_order_turns_with_the_shaft() -> None:
    by_order = Unbalance(kind="unbalance", start="0 s", acceleration="5 rad/s^2", order=2.0)
    assert by_order.value(1.0, math.pi / 4) == pytest.approx(5.0)
    assert by_order.value(99.0, math.pi / 4) == pytest.approx(5.0)


@pytest.mark.parametrize("path", sorted((EXAMPLES / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_every_scenario_can_be_run(path: Path) -> None:
    ticks = run(load_scenario(path), 0.1)
    assert all(math.isfinite(value) for tick in ticks for value in (*tick.measured.values(), *tick.truth.values()))
