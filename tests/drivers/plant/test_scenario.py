"""The simulated motor and lift: their physics, their reproducibility, and the paper's scenarios."""

import math
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from otolith_drivers.plant.dc_motor import MotorScenario, SetPoint
from otolith_drivers.plant.faults import Drift, Fault, PlantSample, Step, Unbalance, shaking
from otolith_drivers.plant.hydraulic_actuator import LiftScenario
from otolith_drivers.plant.scenario import Scenario, load_scenario, simulate
from tests.conftest import EXAMPLES

WEAR = Drift(kind="drift", parameter="R_a", start="0.5 s", amount="-0.65 ohm", rate="0.1 1/s")  # 1 % per second
SHORT = Step(kind="step", parameter="R_a", start="1 s", amount="-1 ohm")
SHAKE = Unbalance(kind="unbalance", start="0 s", acceleration="5 rad/s^2", frequency="10 rad/s")
IMBALANCE = Unbalance(kind="unbalance", start="0 s", acceleration="5 rad/s^2", order=2.0)
LATER = Unbalance(kind="unbalance", start="1 s", acceleration="5 rad/s^2", order=2.0)


def names(value: object) -> str | None:
    """Test identifier of a tuple of faults."""
    return "-".join(fault.kind for fault in value) or "healthy" if isinstance(value, tuple) else None


def run(scenario: Scenario, seconds: float) -> list[PlantSample]:
    return list(islice(simulate(scenario), round(seconds / scenario.sample_period) + 1))


@pytest.fixture
def quiet(scenario: MotorScenario) -> MotorScenario:
    """The motor without noise and faults, with a set-point of 10 rad/s from the start."""
    changes = {"noise": type(scenario.noise)(), "faults": (), "set_points": (SetPoint(at="0 s", speed="10 rad/s"),)}
    return scenario.model_copy(update={**changes, "repeat_every": None})


@pytest.fixture
def lift() -> LiftScenario:
    """The lift of the paper with a valve that reaches its limit, and with parameters that change."""
    loaded = load_scenario(EXAMPLES / "scenarios" / "hydraulic-leak.toml")
    assert isinstance(loaded, LiftScenario)
    faults = (
        Drift(kind="drift", parameter="D", start="0.1 s", amount="5 N*s/m", rate="0.5 1/s"),
        Drift(kind="drift", parameter="q_pump", start="0 s", amount="0.001 m^3/s", rate="-0.5 1/s"),
        Step(kind="step", parameter="leak", start="1 s", amount="0.2 1"),
    )
    return loaded.model_copy(update={"faults": faults, "parameters": type(loaded.parameters)(A_max="63.2 mm^2")})


@pytest.mark.parametrize("fault", [SHORT, SHAKE], ids=lambda fault: fault.kind)
def test_a_fault_of_the_machine_that_ends_leaves_it_as_it_was(quiet: MotorScenario, fault: Fault) -> None:
    ended = run(quiet.model_copy(update={"faults": (fault.model_copy(update={"until": 3.0}),)}), 40.0)
    healthy, lasting = (run(quiet.model_copy(update={"faults": faults}), 40.0) for faults in ((), (fault,)))
    assert ended[-1].truth == pytest.approx(healthy[-1].truth, rel=2e-3)
    assert lasting[-1].truth != pytest.approx(healthy[-1].truth, rel=2e-3)
    assert [sample.truth for sample in ended[:300]] == [sample.truth for sample in lasting[:300]]


def test_motor_settles_at_the_solution_of_its_equations(quiet: MotorScenario) -> None:
    last = run(quiet, 200.0)[-1]
    speed, p = last.truth["omega"], quiet.parameters
    assert speed == pytest.approx(10.0, rel=1e-4)
    assert last.truth["i"] == pytest.approx((p.D + quiet.load) * speed / p.K_t, rel=1e-6)
    assert last.measured["ArmatureVoltage"] == pytest.approx(p.R_a * last.truth["i"] + p.K_e * speed, rel=1e-6)


def test_scenario_same_seed_gives_the_same_run(scenario: Scenario) -> None:
    assert run(scenario, 1.0) == run(scenario, 1.0)
    assert run(scenario, 1.0) != run(scenario.model_copy(update={"seed": 7}), 1.0)


def test_scenario_noise_has_its_deviation(scenario: MotorScenario) -> None:
    samples = run(scenario, 60.0)
    spread = math.sqrt(
        sum((sample.measured["ArmatureCurrent"] - sample.truth["i"]) ** 2 for sample in samples) / len(samples)
    )
    assert spread == pytest.approx(scenario.noise.current, rel=0.05)


def test_motor_integrators_agree(quiet: MotorScenario) -> None:
    accurate = run(quiet, 5.0)[-1].truth
    euler = run(quiet.model_copy(update={"integrator": "euler"}), 5.0)[-1].truth
    assert euler["omega"] == pytest.approx(accurate["omega"], rel=1e-3)
    assert euler["omega"] != accurate["omega"]


def resistance(scenario: MotorScenario, time: float) -> float:
    """Resistance (ohm) by the laws of the paper; a step acts after its time."""
    value = scenario.parameters.R_a
    for fault in scenario.faults:
        if isinstance(fault, Drift) and fault.parameter == "R_a":
            value += float(fault.amount.split()[0]) * (math.exp(fault.rate * max(time - fault.start, 0.0)) - 1.0)
        if isinstance(fault, Step) and time > fault.start:
            value += float(fault.amount.split()[0])
    return value


def unbalance(scenario: MotorScenario, time: float, angle: float) -> float:
    return sum(
        fault.acceleration * math.sin(fault.order * angle if fault.order else (fault.frequency or 0.0) * time)
        for fault in scenario.faults
        if isinstance(fault, Unbalance) and time >= fault.start
    )


@pytest.mark.parametrize("faults", [(), (WEAR,), (SHAKE,), (LATER, SHAKE, WEAR, SHORT)], ids=names)
def test_motor_by_euler_is_equation_11_to_13(quiet: MotorScenario, faults: tuple[Fault, ...]) -> None:
    quiet = quiet.model_copy(update={"integrator": "euler", "faults": faults})
    p, i, w, angle = quiet.parameters, 0.0, 0.0, 0.0
    for sample in run(quiet, 2.7):
        assert sample.truth["i"] == pytest.approx(i, rel=1e-12, abs=1e-14)
        assert sample.truth["omega"] == pytest.approx(w, rel=1e-12, abs=1e-14)
        for step in range(100):
            time = sample.time + step * 1e-4
            i_new = i + 1e-4 * (sample.measured["ArmatureVoltage"] - resistance(quiet, time) * i - p.K_e * w) / p.L_a
            w_new = w + 1e-4 * (i_new * p.K_t - quiet.load * w - p.D * w) / p.J
            w_new += 1e-4 * unbalance(quiet, time, angle)
            i, w, angle = i_new, w_new, angle + 1e-4 * w


@pytest.mark.parametrize(
    ("faults", "error"),
    [((), 1e-10), ((SHORT,), 1e-10), ((SHAKE,), 1e-10), ((IMBALANCE, SHORT), 1e-9), ((WEAR,), 2e-8)],
    ids=names,
)
def test_accurate_motor_agrees_with_scipy(quiet: MotorScenario, faults: tuple[Fault, ...], error: float) -> None:
    quiet = quiet.model_copy(update={"faults": faults})
    p, state = quiet.parameters, np.zeros(3)

    def rates(time: float, state: tuple[float, float, float], voltage: float) -> list[float]:
        i, w, angle = state
        acceleration = (p.K_t * i - (p.D + quiet.load) * w) / p.J + unbalance(quiet, time, angle)
        return [(voltage - resistance(quiet, time) * i - p.K_e * w) / p.L_a, acceleration, w]

    samples = run(quiet, 2.7)
    highest = {name: max(abs(sample.truth[name]) for sample in samples) for name in ("i", "omega")}
    for sample, after in pairwise(samples):
        # 1 ps later, so that a fault that starts at a sampling instant acts.
        period, voltage = (sample.time + 1e-12, after.time), (sample.measured["ArmatureVoltage"],)
        state = solve_ivp(rates, period, state, method="DOP853", rtol=1e-13, atol=1e-15, args=voltage).y[:, -1]
        assert after.truth["i"] == pytest.approx(state[0], abs=error * highest["i"])
        assert after.truth["omega"] == pytest.approx(state[1], abs=error * highest["omega"])


def test_motor_truth_follows_the_laws_of_the_faults(quiet: MotorScenario) -> None:
    quiet = quiet.model_copy(update={"faults": (WEAR, SHORT)})
    for sample in run(quiet, 6.0):
        assert sample.truth["R_a"] == pytest.approx(resistance(quiet, sample.time), rel=1e-13)
        assert sample.truth["D"] == quiet.parameters.D


def test_motor_set_points_at_their_times_and_repeated(quiet: MotorScenario) -> None:
    points = (SetPoint(at="0.5 s", speed="10 rad/s"), SetPoint(at="0.7 s", speed="-5 rad/s"))
    changes = {"set_points": points, "controller": type(quiet.controller)(K_i="0 V/rad")}
    for repeat_every, later in ((None, -5.0), (1.0, 10.0)):
        samples = run(quiet.model_copy(update=changes | {"repeat_every": repeat_every}), 4.0)
        wanted = [sample.measured["ArmatureVoltage"] / 0.3 + sample.truth["omega"] for sample in samples]
        assert [wanted[n] for n in (49, 50, 69, 70)] == pytest.approx([0.0, 10.0, 10.0, -5.0])
        assert wanted[360] == pytest.approx(later)


def test_motor_voltage_stays_within_its_limit(quiet: MotorScenario) -> None:
    changes = {"controller": type(quiet.controller)(voltage_limit="2 V"), "repeat_every": None}
    voltages = [sample.measured["ArmatureVoltage"] for sample in run(quiet.model_copy(update=changes), 2.0)]
    assert max(voltages) == 2.0
    wanted = (SetPoint(at="0 s", speed="-10 rad/s"),)
    voltages = [
        sample.measured["ArmatureVoltage"]
        for sample in run(quiet.model_copy(update=changes | {"set_points": wanted}), 2.0)
    ]
    assert min(voltages) == -2.0


def leak_and_more(lift: LiftScenario, time: float) -> tuple[float, float, float]:
    """Leak, damping (N·s/m) and pump flow (m³/s) at a time (s), by the faults of ``lift``."""
    damping = 100.0 + 5.0 * (math.exp(0.5 * max(time - 0.1, 0.0)) - 1.0)
    return 0.2 if time > 1.0 else 0.0, damping, 0.02 + 0.001 * (math.exp(-0.5 * time) - 1.0)


def test_lift_by_euler_is_the_papers_equations(lift: LiftScenario) -> None:
    p, g = lift.parameters, lift.controller
    x, pressure, filtered = 0.0, lift.load / p.A_piston, 0.0
    integral = p.q_pump / math.sqrt(2.0 * pressure / p.rho)
    samples = run(lift, 3.0)
    for sample in samples:
        for step in range(100):
            time = sample.time + step * 1e-4
            leak, damping, pump = leak_and_more(lift, time)
            error = x - 0.45 * math.sin(2.0 * math.pi * 0.005 * time)
            derivative = g.N * (g.K_d * error - filtered)
            valve = min(max(g.K_p * error + integral + derivative, 0.0), p.A_max)
            if step == 0:
                state = sample.truth["x"], sample.truth["p"], sample.measured["ValveArea"]
                assert state == pytest.approx((x, pressure, valve), rel=1e-9, abs=1e-12)
            integral += g.K_i * error * 1e-4 if 0.0 < valve < p.A_max else 0.0
            filtered += derivative * 1e-4
            velocity = (pump - valve * math.sqrt(2.0 * pressure / p.rho)) / p.A_piston
            x += 1e-4 * velocity
            pressure = (1.0 + leak) * (lift.load + p.k_spring * x + damping * velocity) / p.A_piston
    assert min(valves := [sample.measured["ValveArea"] for sample in samples]) < p.A_max
    assert max(valves) == p.A_max


def test_accurate_lift_pressure_balances_its_flow(lift: LiftScenario) -> None:
    p = lift.parameters
    for sample in run(lift.model_copy(update={"integrator": "accurate"}), 3.0):
        leak, damping, pump = leak_and_more(lift, sample.time)
        velocity = (pump - sample.measured["ValveArea"] * math.sqrt(2.0 * sample.truth["p"] / p.rho)) / p.A_piston
        force = lift.load + p.k_spring * sample.truth["x"] + damping * velocity
        assert sample.truth["p"] == pytest.approx((1.0 + leak) * force / p.A_piston, rel=1e-12)


def test_lift_integrators_agree(lift: LiftScenario) -> None:
    accurate = run(lift.model_copy(update={"integrator": "accurate"}), 3.0)
    for one, other in zip(accurate, run(lift, 3.0), strict=True):
        assert one.truth["x"] == pytest.approx(other.truth["x"], abs=1e-5)
        assert one.truth["p"] == pytest.approx(other.truth["p"], rel=1e-3)


@pytest.mark.parametrize(
    ("name", "parameter", "final"), [("armature-resistance", "R_a", 5.6), ("bearing-wear", "D", 0.00227)]
)
def test_paper_degradations_end_at_the_papers_values(name: str, parameter: str, final: float) -> None:
    fault = load_scenario(EXAMPLES / "scenarios" / f"{name}.toml").faults[0]
    assert isinstance(fault, Drift)
    initial = {"R_a": 6.5, "D": 0.00143}[parameter]
    amount = {"R_a": -0.044, "D": 0.00003806}[parameter]
    at_start, at_end = fault.change(np.array([160.0, 1200.0]), amount)
    assert initial + at_end == pytest.approx(final, rel=0.02)
    assert at_start == 0.0


def test_demo_loses_five_percent_of_the_resistance(scenario: Scenario) -> None:
    last = run(scenario, 90.0)[-1].truth["R_a"]
    assert last < 0.95 * 6.5


def test_unbalance_by_order_follows_the_shaft_angle() -> None:
    by_order = Unbalance(kind="unbalance", start="0 s", acceleration="5 rad/s^2", order=2.0)
    acceleration = shaking([by_order])
    assert acceleration(1.0, math.pi / 4) == pytest.approx(5.0)
    assert acceleration(99.0, math.pi / 4) == pytest.approx(5.0)


@pytest.mark.parametrize("path", sorted((EXAMPLES / "scenarios").glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_scenario_runs(path: Path) -> None:
    samples = run(load_scenario(path), 0.1)
    assert all(
        math.isfinite(value) for sample in samples for value in (*sample.measured.values(), *sample.truth.values())
    )
