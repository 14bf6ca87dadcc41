"""Estimation on windows of the simulated motor: known parameters come back, and ignorance is said."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Quality, Verdict, Window
from otolith.adaptation.estimate import estimate
from otolith.adaptation.information import Identifiability
from otolith.adaptation.problem import HOPELESS, Objective, Problem, SwarmOptions
from otolith.health.report import Status
from otolith.heart import adapt
from otolith.state import State, begin
from otolith.twins import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario

Cut = Callable[..., list[tuple[Window, float]]]

DC_MOTOR = find_twin("dc_motor")


def problem_for(*names: str) -> Problem:
    free = tuple(entry for entry in DC_MOTOR.parameters if entry.name in names)
    known = tuple((entry.name, entry.nominal) for entry in DC_MOTOR.parameters if entry.name not in names)
    return Problem(DC_MOTOR, known, free, (0.005, 0.02), swarm=SwarmOptions(generations=400))


def state_for(*names: str) -> State:
    return begin("motor", "here", problem_for(*names))


def test_resistance_comes_back_within_half_a_percent_in_every_window(scenario: MotorScenario, windows: Cut) -> None:
    state = state_for("R_a")
    for window, injected in windows(scenario, 45):
        state, report = adapt(state, window)
        found = report.document.parameters["R_a"]
        assert found.status is Status.ESTIMATED
        assert found.value == pytest.approx(injected, rel=0.005)


@pytest.mark.parametrize("names", [("D",), ("R_a", "D"), ("R_a", "L_a", "J")])
def test_any_subset_can_be_estimated(scenario: MotorScenario, windows: Cut, names: tuple[str, ...]) -> None:
    quiet = scenario.model_copy(update={"faults": ()})
    window, _ = windows(quiet, 11)[-1]  # the set-point has just doubled: everything moves
    found = estimate(problem_for(*names), window, np.array([DC_MOTOR.parameter(name).nominal for name in names]))
    for entry in found.parameters:
        assert entry.identifiability is Identifiability.DETERMINED
        assert entry.value == pytest.approx(DC_MOTOR.parameter(entry.name).nominal, rel=0.02)


def test_the_same_seed_gives_the_same_report(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 2)[-1]
    first, second = (adapt(state_for("R_a"), window)[1].document for _ in range(2))
    assert first.to_json() == second.to_json()


def test_a_motor_at_rest_says_nothing_about_its_resistance() -> None:
    values = np.zeros((200, 4))
    missing = np.zeros(values.shape, dtype=np.bool_)
    quality = Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0)
    window = Window(0, 0.0, 0.01, DC_MOTOR.signals, values, missing, quality)
    _, report = adapt(state_for("R_a"), window)
    found = report.document.parameters["R_a"]
    assert (found.status, found.value) == (Status.UNESTIMATED, None)
    assert found.identifiability in (Identifiability.FLAT, Identifiability.WEAK)
    assert found.reason


def test_parameters_that_only_act_together_are_named_as_traded(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 4)[-1]
    found = estimate(problem_for("J", "K_t", "D"), window, np.array([0.001171, 0.038, 0.00143]))
    traded = {entry.name: entry.reason for entry in found.parameters}
    assert Identifiability.TRADED in {entry.identifiability for entry in found.parameters}
    assert any("can be traded with" in reason for reason in traded.values())


def test_a_bad_window_teaches_nothing(scenario: MotorScenario, windows: Cut) -> None:
    (good, _), (next_one, _) = windows(scenario, 2)
    state, _ = adapt(state_for("R_a"), good)
    bad = replace(next_one, quality=Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",)))
    after, report = adapt(state, bad)
    found = report.document.parameters["R_a"]
    assert after == state
    assert found.status is Status.HELD
    assert "no samples of i" in found.reason
    assert report.document.fit is None


def test_the_truth_outside_the_bounds_is_reported_as_invalid(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 5)[-1]
    problem = problem_for("R_a")
    narrow = replace(problem, free=(replace(problem.free[0], nominal=8.0, low=7.0, high=9.0),))
    _, report = adapt(begin("motor", "here", narrow), window)
    found = report.document.parameters["R_a"]
    assert found.status is Status.INVALID
    assert "bound" in found.reason


def test_a_guess_that_diverges_never_wins(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 1)[-1]
    objective = Objective(problem_for("J"), window)
    cost = objective.cost(np.vstack([objective.guess(np.array([1e-300])), objective.guess(np.array([np.nan]))]))
    assert cost.tolist() == [HOPELESS, HOPELESS]


def test_missing_records_do_not_count(scenario: MotorScenario, windows: Cut) -> None:
    window, injected = windows(scenario, 5)[-1]
    missing = window.missing.copy()
    values = window.values.copy()
    missing[50:60, 2:], values[50:60, 2:] = True, 99.0
    _, report = adapt(state_for("R_a"), replace(window, values=values, missing=missing))
    assert report.document.parameters["R_a"].value == pytest.approx(injected, rel=0.005)


def test_spread_over_seeds_is_what_the_report_claims(scenario: MotorScenario, windows: Cut) -> None:
    """Sensor noise alone, as the standard deviation assumes; the load torque is known exactly."""
    problem, pulls = problem_for("R_a"), []
    quiet = scenario.noise.model_copy(update={"load_torque": 0.0})
    for seed in range(40):
        changed = scenario.model_copy(update={"seed": seed, "noise": quiet, "faults": ()})
        window, _ = windows(changed, 3)[-1]
        entry = estimate(problem, window, np.array([6.5])).parameters[0]
        pulls.append((entry.value - 6.5) / entry.sd)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.35)
    assert abs(np.mean(pulls)) < 0.6
