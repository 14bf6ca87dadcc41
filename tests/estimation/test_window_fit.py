"""Estimation on windows of the simulated motor: known parameters come back, and ignorance is said."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Quality, Verdict, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.decision import WindowDecision
from otolith.estimation.arrival_cost import initial_prior
from otolith.estimation.information import Identifiability, inflation_of
from otolith.estimation.objective import PENALTY, Objective
from otolith.estimation.problem import Problem, SwarmOptions
from otolith.estimation.window_fit import Search, WindowEstimate, estimate
from otolith.health.schema import Status
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.plant.dc_motor import MotorScenario

Cut = Callable[..., list[tuple[Window, float]]]

DC_MOTOR = find_twin("dc_motor")


def problem_for(*names: str) -> Problem:
    free = tuple(entry for entry in DC_MOTOR.parameters if entry.name in names)
    known = tuple((entry.name, entry.nominal) for entry in DC_MOTOR.parameters if entry.name not in names)
    return Problem(DC_MOTOR, known, free, (0.005, 0.02), swarm=SwarmOptions(generations=400))


def estimated(problem: Problem, window: Window, start: list[float], search: Search = Search.ALWAYS) -> WindowEstimate:
    return estimate(problem, window, initial_prior(problem), np.array(start), search)


def state_for(*names: str) -> AdaptationState:
    return initial_state("motor", "here", problem_for(*names))


def test_resistance_comes_back_within_half_a_percent_in_every_window(scenario: MotorScenario, windows: Cut) -> None:
    state = state_for("R_a")
    drifting = scenario.model_copy(update={"faults": scenario.faults[:1]})
    for window, injected in windows(drifting, 45):
        state, report = adapt(state, window)
        found = report.document.parameters["R_a"]
        assert found.status is Status.ESTIMATED
        assert found.value == pytest.approx(injected, rel=0.005)


@pytest.mark.parametrize("names", [("D",), ("R_a", "D"), ("R_a", "L_a", "J")])
def test_any_subset_can_be_estimated(scenario: MotorScenario, windows: Cut, names: tuple[str, ...]) -> None:
    quiet = scenario.model_copy(update={"faults": ()})
    window, _ = windows(quiet, 11)[-1]  # the set-point has just doubled: everything moves
    found = estimated(problem_for(*names), window, [DC_MOTOR.parameter(name).nominal for name in names])
    for entry in found.parameters:
        assert entry.identifiability is Identifiability.DETERMINED
        assert entry.value == pytest.approx(DC_MOTOR.parameter(entry.name).nominal, rel=0.02)


def test_the_same_seed_gives_the_same_report(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 2)[-1]
    first, second = (adapt(state_for("R_a"), window)[1].document for _ in range(2))
    assert first.to_json() == second.to_json()


def test_a_motor_at_rest_says_nothing_about_its_resistance() -> None:
    values = np.zeros((200, 4))
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    _, report = adapt(state_for("R_a"), window)
    found = report.document.parameters["R_a"]
    assert (found.status, found.value) == (Status.UNESTIMATED, None)
    assert found.identifiability in (Identifiability.FLAT, Identifiability.WEAK)
    assert found.reason


def test_parameters_that_only_act_together_are_named_as_traded(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 4)[-1]
    found = estimated(problem_for("J", "K_t", "D"), window, [0.001171, 0.038, 0.00143])
    traded = {entry.name: entry.reason for entry in found.parameters}
    assert Identifiability.TRADED in {entry.identifiability for entry in found.parameters}
    assert any("can be traded with" in reason for reason in traded.values())


def test_a_bad_window_teaches_nothing(scenario: MotorScenario, windows: Cut) -> None:
    (good, _), (next_one, _) = windows(scenario, 2)
    state, _ = adapt(state_for("R_a"), good)
    bad = replace(next_one, quality=Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",)))
    after, report = adapt(state, bad)
    found = report.document.parameters["R_a"]
    assert after.posterior is state.posterior
    assert found.status is Status.HELD
    assert "no samples of i" in found.reason
    assert report.document.fit is None
    assert report.document.decision is WindowDecision.BAD


def test_the_truth_outside_the_bounds_is_reported_as_invalid(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 5)[-1]
    problem = problem_for("R_a")
    narrow = replace(problem, free=(replace(problem.free[0], nominal=8.0, low=7.0, high=9.0),))
    _, report = adapt(initial_state("motor", "here", narrow), window)
    found = report.document.parameters["R_a"]
    assert found.status is Status.INVALID
    assert "bound" in found.reason


def test_a_window_that_contradicts_the_twin_teaches_nothing(scenario: MotorScenario, windows: Cut) -> None:
    (first, _), (second, _) = windows(scenario, 6)[-2:]
    state, _ = adapt(state_for("R_a"), first)
    values = second.values.copy()
    values[80, 0] = 65.5  # one corrupt voltage
    wrong = replace(second, values=values)
    after, report = adapt(state, wrong)
    found = report.document.parameters["R_a"]
    assert report.document.fit is not None
    assert not report.document.fit.explained
    assert found.status is Status.HELD
    assert "nothing explains" in found.reason
    assert after.posterior is state.posterior
    again = adapt(after, replace(wrong, start=wrong.end))[1].document.parameters["R_a"]
    assert again.status is Status.INVALID


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_lost_first_records_do_not_bias(scenario: MotorScenario, windows: Cut, lost: int) -> None:
    quiet = scenario.model_copy(update={"faults": ()})
    window, _ = windows(quiet, 11)[-1]  # the set-point has just been doubled
    missing, values = window.missing.copy(), window.values.copy()
    missing[:lost], values[:lost] = True, values[lost]
    told = replace(problem_for("R_a"), input_noise=(0.0, 0.0002))
    entry = estimated(told, replace(window, values=values, missing=missing), [6.5]).parameters[0]
    assert entry.sd < 0.005
    assert entry.value == pytest.approx(6.5, abs=4.0 * entry.sd)


@pytest.mark.parametrize("value", [0.0, 1e-300, 1.0, 1e6, 1e11, 1e15, 1e29, 1e100, np.inf, np.nan])
@pytest.mark.parametrize("records", [1, 2, 5, 200])
@pytest.mark.parametrize("names", [("R_a",), ("R_a", "K_e"), ("R_a", "L_a", "J", "K_e", "K_t", "D")])
def test_constant_windows_are_answered_honestly(value: float, records: int, names: tuple[str, ...]) -> None:
    values = np.full((records, 4), value)
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    problem = replace(problem_for(*names), swarm=SwarmOptions(generations=3))
    _, report = adapt(initial_state("motor", "here", problem), window)
    text = report.document.to_json()
    assert "NaN" not in text
    assert "Infinity" not in text
    for entry in report.document.parameters.values():
        assert entry.status is not Status.ESTIMATED or entry.sd is not None
        assert entry.status is Status.ESTIMATED or entry.reason


def test_a_constant_equilibrium_cannot_tell_resistance_from_the_electromotive_force() -> None:
    """Nominal equilibrium to the last digit: only V_a - R_a i - K_e omega is seen, so neither alone is known."""
    i, omega = (0.00143 + 0.006) * 10.0 / 0.038, 10.0
    row = [6.5 * i + 0.038 * omega, 0.06, i, omega]
    values = np.tile(row, (200, 1))
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    found = estimated(problem_for("R_a", "K_e"), window, [6.5, 0.038])
    assert {entry.identifiability for entry in found.parameters} == {Identifiability.TRADED}


def test_a_fast_motor_is_integrated_finely_enough() -> None:
    """An inductance of 10 mH: the time constant is a sixth of the sample period."""
    truth = {**{entry.name: entry.nominal for entry in DC_MOTOR.parameters}, "L_a": 0.01}
    parameters = np.array([list(truth.values())])
    random = np.random.default_rng(3)
    inputs = np.column_stack([np.repeat(random.uniform(5.0, 20.0, 20), 10), np.full(200, 0.03)])
    outputs = kernel_of(DC_MOTOR).simulate(parameters, np.zeros((1, 2)), Excitation(inputs, 0.01, 64))[0]
    values = np.column_stack([inputs, outputs + random.normal(size=(200, 2)) * [0.005, 0.02]])
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    known = tuple((name, value) for name, value in truth.items() if name != "R_a")
    entry = estimated(replace(problem_for("R_a"), known=known), window, [6.0]).parameters[0]
    assert entry.value == pytest.approx(6.5, abs=4.0 * entry.sd)
    assert entry.sd < 0.01


def test_noise_of_a_measured_input_widens_the_interval(scenario: MotorScenario, windows: Cut) -> None:
    """The load torque is as noisy as its sensor; the interval that knows it covers the truth, the other does not."""
    told = replace(problem_for("R_a"), input_noise=(0.0, 0.0002))
    inside = {True: 0, False: 0}
    count = 60
    for seed in range(count):
        changed = scenario.model_copy(update={"seed": seed, "faults": ()})
        window, _ = windows(changed, 5)[-1]
        for knows, problem in ((True, told), (False, problem_for("R_a"))):
            entry = estimated(problem, window, [6.5], Search.IF_UNEXPLAINED).parameters[0]
            inside[knows] += abs(entry.value - 6.5) <= 1.96 * entry.sd
    assert inside[True] >= 0.87 * count  # the binomial's 0.5 % quantile for 95 %
    assert inside[False] < 0.75 * count


def test_a_residual_beyond_the_noise_widens_the_interval(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 5)[-1]
    told = estimated(problem_for("R_a"), window, [6.5]).parameters[0]
    optimist = replace(problem_for("R_a"), noise=(0.005 / 3.0, 0.02 / 3.0))
    doubted = estimated(optimist, window, [6.5]).parameters[0]
    assert doubted.sd == pytest.approx(told.sd, rel=0.15)


def test_only_a_residual_that_lasts_widens_the_interval_beyond_its_size() -> None:
    random = np.random.default_rng(1)
    white = random.standard_normal((200, 2))
    lasting = np.cumsum(random.standard_normal((200, 2)), axis=0)
    for residuals, low, high in ((white, 0.95, 1.1), (lasting, 3.0, 20.0)):
        cost = float(np.sqrt(np.mean(residuals**2)))
        assert low <= inflation_of(3.0 / cost * residuals, 3.0) / 3.0 <= high


def test_a_guess_that_diverges_never_wins(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 1)[-1]
    objective = Objective(problem_for("J"), window, np.array([0.001171]))
    cost = objective.cost(np.vstack([objective.guess(np.array([1e-300])), objective.guess(np.array([np.nan]))]))
    assert cost.tolist() == [PENALTY, PENALTY]


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
        entry = estimated(problem, window, [6.5]).parameters[0]
        pulls.append((entry.value - 6.5) / entry.sd)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.35)
    assert abs(np.mean(pulls)) < 0.6
