"""Estimation on windows of the simulated motor: accuracy, identifiability, coverage and rejected windows."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Quality, Verdict, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import Identifiability, inflation_of, initial_prior
from otolith.estimation.objective import PENALTY, Objective
from otolith.estimation.problem import Problem, SwarmOptions
from otolith.estimation.window_fit import SwarmSearch, WindowEstimate, estimate
from otolith.health.schema import Status
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.plant.dc_motor import MotorScenario

Cut = Callable[..., list[tuple[Window, float]]]

DC_MOTOR = find_twin("dc_motor")


def problem_for(*names: str) -> Problem:
    free = tuple(parameter for parameter in DC_MOTOR.parameters if parameter.name in names)
    known = tuple(
        (parameter.name, parameter.nominal) for parameter in DC_MOTOR.parameters if parameter.name not in names
    )
    return Problem(DC_MOTOR, known, free, (0.005, 0.02), swarm=SwarmOptions(generations=400))


def estimated(
    problem: Problem, window: Window, start: list[float], search: SwarmSearch = SwarmSearch.FROM_BOUNDS
) -> WindowEstimate:
    return estimate(problem, window, initial_prior(problem), np.array(start), search)


def state_for(*names: str) -> AdaptationState:
    return initial_state("motor", "here", problem_for(*names))


def test_resistance_is_within_half_a_percent_in_every_window(scenario: MotorScenario, windows: Cut) -> None:
    state = state_for("R_a")
    drifting = scenario.model_copy(update={"faults": scenario.faults[:1]})
    for window, injected in windows(drifting, 45):
        state, report = adapt(state, window)
        resistance = report.document.parameters["R_a"]
        assert resistance.status is Status.ESTIMATED
        assert resistance.value == pytest.approx(injected, rel=0.005)


@pytest.mark.parametrize("names", [("D",), ("R_a", "D"), ("R_a", "L_a", "J")])
def test_any_subset_of_parameters_is_estimated(scenario: MotorScenario, windows: Cut, names: tuple[str, ...]) -> None:
    quiet = scenario.model_copy(update={"faults": ()})
    window, _ = windows(quiet, 11)[-1]  # the set-point has just doubled, so that all states change
    result = estimated(problem_for(*names), window, [DC_MOTOR.parameter(name).nominal for name in names])
    for parameter in result.parameters:
        assert parameter.identifiability is Identifiability.DETERMINED
        assert parameter.value == pytest.approx(DC_MOTOR.parameter(parameter.name).nominal, rel=0.02)


def test_the_same_seed_gives_the_same_report(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 2)[-1]
    first, second = (adapt(state_for("R_a"), window)[1].document for _ in range(2))
    assert first.to_json() == second.to_json()


def test_resistance_is_unestimated_at_rest() -> None:
    values = np.zeros((200, 4))
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    _, report = adapt(state_for("R_a"), window)
    resistance = report.document.parameters["R_a"]
    assert (resistance.status, resistance.value) == (Status.UNESTIMATED, None)
    assert resistance.identifiability in (Identifiability.FLAT, Identifiability.WEAK)
    assert resistance.reason


def test_confounded_parameters_are_reported_as_traded(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 4)[-1]
    result = estimated(problem_for("J", "K_t", "D"), window, [0.001171, 0.038, 0.00143])
    reasons = {parameter.name: parameter.reason for parameter in result.parameters}
    assert Identifiability.TRADED in {parameter.identifiability for parameter in result.parameters}
    assert any("can be traded with" in reason for reason in reasons.values())


def test_bad_window_does_not_update_the_posterior(scenario: MotorScenario, windows: Cut) -> None:
    (good, _), (following, _) = windows(scenario, 2)
    state, _ = adapt(state_for("R_a"), good)
    bad = replace(following, quality=Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",)))
    after, report = adapt(state, bad)
    resistance = report.document.parameters["R_a"]
    assert after.posterior is state.posterior
    assert resistance.status is Status.HELD
    assert "no samples of i" in resistance.reason
    assert report.document.fit is None
    assert report.document.decision is WindowDecision.BAD


def test_truth_outside_the_bounds_is_reported_as_invalid(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 5)[-1]
    problem = problem_for("R_a")
    narrow = replace(problem, free=(replace(problem.free[0], nominal=8.0, low=7.0, high=9.0),))
    _, report = adapt(initial_state("motor", "here", narrow), window)
    resistance = report.document.parameters["R_a"]
    assert resistance.status is Status.INVALID
    assert "bound" in resistance.reason


def test_a_value_that_presses_on_its_bound_is_at_bound_however_wide_its_interval(
    scenario: MotorScenario, windows: Cut
) -> None:
    """An accuracy far beyond what a window gives made of the bound a "weak" value."""
    window, _ = windows(scenario, 5)[-1]
    problem = problem_for("R_a")
    bounded = replace(problem.free[0], nominal=8.0, low=7.0, high=9.0)
    _, report = adapt(initial_state("motor", "here", replace(problem, free=(bounded,), determined_within=1e-6)), window)
    resistance = report.document.parameters["R_a"]
    assert resistance.identifiability is Identifiability.AT_BOUND
    assert resistance.status is Status.INVALID
    assert "at its bound 7 Ω" in resistance.reason


def test_unexplained_window_does_not_update_the_posterior(scenario: MotorScenario, windows: Cut) -> None:
    (first, _), (second, _) = windows(scenario, 6)[-2:]
    state, _ = adapt(state_for("R_a"), first)
    values = second.values.copy()
    values[80, 0] = 65.5  # one corrupt voltage
    wrong = replace(second, values=values)
    after, report = adapt(state, wrong)
    resistance = report.document.parameters["R_a"]
    assert report.document.fit is not None
    assert not report.document.fit.explained
    assert resistance.status is Status.HELD
    assert "nothing explains" in resistance.reason
    assert after.posterior is state.posterior
    repeated = adapt(after, replace(wrong, start=wrong.end))[1].document.parameters["R_a"]
    assert repeated.status is Status.INVALID


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_missing_first_records_do_not_bias_the_estimate(scenario: MotorScenario, windows: Cut, lost: int) -> None:
    quiet = scenario.model_copy(update={"faults": ()})
    window, _ = windows(quiet, 11)[-1]  # the set-point has just been doubled
    missing, values = window.missing.copy(), window.values.copy()
    missing[:lost], values[:lost] = True, values[lost]
    problem = replace(problem_for("R_a"), input_noise=(0.0, 0.0002))
    resistance = estimated(problem, replace(window, values=values, missing=missing), [6.5]).parameters[0]
    assert resistance.sd < 0.005
    assert resistance.value == pytest.approx(6.5, abs=4.0 * resistance.sd)


@pytest.mark.parametrize("value", [0.0, 1e-300, 1.0, 1e6, 1e11, 1e15, 1e29, 1e100, np.inf, np.nan])
@pytest.mark.parametrize("records", [1, 2, 5, 200])
@pytest.mark.parametrize("names", [("R_a",), ("R_a", "K_e"), ("R_a", "L_a", "J", "K_e", "K_t", "D")])
def test_constant_windows_give_finite_reports_with_reasons(value: float, records: int, names: tuple[str, ...]) -> None:
    values = np.full((records, 4), value)
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    problem = replace(problem_for(*names), swarm=SwarmOptions(generations=3))
    _, report = adapt(initial_state("motor", "here", problem), window)
    text = report.document.to_json()
    assert "NaN" not in text
    assert "Infinity" not in text
    for parameter in report.document.parameters.values():
        assert parameter.status is not Status.ESTIMATED or parameter.sd is not None
        assert parameter.status is Status.ESTIMATED or parameter.reason


def test_resistance_and_k_e_are_traded_at_equilibrium() -> None:
    """At an exact equilibrium only V_a - R_a i - K_e omega is measured, so that R_a and K_e are confounded."""
    i, omega = (0.00143 + 0.006) * 10.0 / 0.038, 10.0
    row = [6.5 * i + 0.038 * omega, 0.06, i, omega]
    values = np.tile(row, (200, 1))
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    result = estimated(problem_for("R_a", "K_e"), window, [6.5, 0.038])
    assert {parameter.identifiability for parameter in result.parameters} == {Identifiability.TRADED}


def test_fast_electrical_dynamics_are_integrated_accurately() -> None:
    """An inductance of 10 mH makes the electrical time constant a sixth of the sample period."""
    truth = {**{parameter.name: parameter.nominal for parameter in DC_MOTOR.parameters}, "L_a": 0.01}
    parameters = np.array([list(truth.values())])
    random = np.random.default_rng(3)
    inputs = np.column_stack([np.repeat(random.uniform(5.0, 20.0, 20), 10), np.full(200, 0.03)])
    outputs = kernel_of(DC_MOTOR).simulate(parameters, np.zeros((1, 2)), Excitation.uniform(inputs, 0.01, 64))[0]
    values = np.column_stack([inputs, outputs + random.normal(size=(200, 2)) * [0.005, 0.02]])
    window = Window.whole(0, 0.0, 0.01, DC_MOTOR.signals, values)
    known = tuple((name, value) for name, value in truth.items() if name != "R_a")
    parameter = estimated(replace(problem_for("R_a"), known=known), window, [6.0]).parameters[0]
    assert parameter.value == pytest.approx(6.5, abs=4.0 * parameter.sd)
    assert parameter.sd < 0.01


def test_input_noise_widens_the_interval(scenario: MotorScenario, windows: Cut) -> None:
    """The load torque is noisy. Only the interval that includes its noise covers the truth."""
    noisy_input = replace(problem_for("R_a"), input_noise=(0.0, 0.0002))
    inside = {True: 0, False: 0}
    count = 60
    for seed in range(count):
        changed = scenario.model_copy(update={"seed": seed, "faults": ()})
        window, _ = windows(changed, 5)[-1]
        for modelled, problem in ((True, noisy_input), (False, problem_for("R_a"))):
            resistance = estimated(problem, window, [6.5], SwarmSearch.IF_UNEXPLAINED).parameters[0]
            inside[modelled] += abs(resistance.value - 6.5) <= 1.96 * resistance.sd
    assert inside[True] >= 0.87 * count  # 0.5 % quantile of the binomial distribution for 95 %
    assert inside[False] < 0.75 * count


def test_residuals_above_noise_widen_the_interval(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 5)[-1]
    reference = estimated(problem_for("R_a"), window, [6.5]).parameters[0]
    underestimated = replace(problem_for("R_a"), noise=(0.005 / 3.0, 0.02 / 3.0))
    inflated = estimated(underestimated, window, [6.5]).parameters[0]
    assert inflated.sd == pytest.approx(reference.sd, rel=0.15)


def test_only_correlated_residuals_are_inflated_further() -> None:
    random = np.random.default_rng(1)
    white = random.standard_normal((200, 2))
    correlated = np.cumsum(random.standard_normal((200, 2)), axis=0)
    for residuals, low, high in ((white, 0.95, 1.1), (correlated, 3.0, 20.0)):
        cost = float(np.sqrt(np.mean(residuals**2)))
        assert low <= inflation_of(3.0 / cost * residuals, np.ones_like(residuals, dtype=np.bool_), 3.0) / 3.0 <= high


def test_fit_without_its_prior_is_linearised_as_the_window_alone(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 11)[-1]
    fitted = estimated(problem_for("R_a", "D"), window, [3.0, 2e-4]).fit
    assert fitted.result.guess[2:4].any()  # trends
    alone, (residuals, jacobian) = fitted.without_prior(), fitted.objective.linearise(fitted.guess)
    np.testing.assert_allclose(alone.residuals, residuals, atol=1e-9)
    np.testing.assert_allclose(alone.jacobian, jacobian, rtol=1e-9)
    assert alone.chi_square == pytest.approx(float(residuals @ residuals))


def test_diverging_guess_costs_the_penalty(scenario: MotorScenario, windows: Cut) -> None:
    window, _ = windows(scenario, 1)[-1]
    objective = Objective(problem_for("J"), window, np.array([0.001171]))
    cost = objective.cost(np.vstack([objective.guess(np.array([1e-300])), objective.guess(np.array([np.nan]))]))
    assert cost.tolist() == [PENALTY, PENALTY]


def test_missing_records_are_not_used(scenario: MotorScenario, windows: Cut) -> None:
    window, injected = windows(scenario, 5)[-1]
    missing = window.missing.copy()
    values = window.values.copy()
    missing[50:60, 2:], values[50:60, 2:] = True, 99.0
    _, report = adapt(state_for("R_a"), replace(window, values=values, missing=missing))
    assert report.document.parameters["R_a"].value == pytest.approx(injected, rel=0.005)


def test_spread_over_seeds_matches_the_reported_sd(scenario: MotorScenario, windows: Cut) -> None:
    """The load torque is exact: the standard deviation assumes sensor noise only."""
    problem, pulls = problem_for("R_a"), []
    quiet = scenario.noise.model_copy(update={"load_torque": 0.0})
    for seed in range(40):
        changed = scenario.model_copy(update={"seed": seed, "noise": quiet, "faults": ()})
        window, _ = windows(changed, 3)[-1]
        resistance = estimated(problem, window, [6.5]).parameters[0]
        pulls.append((resistance.value - 6.5) / resistance.sd)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.35)
    assert abs(np.mean(pulls)) < 0.6
