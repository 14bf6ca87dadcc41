"""Hypotheses are compared at their best fits: neither a local minimum nor the integrator's error is evidence."""

import re
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.changes import classes
from benchmarks.changes.machines import DC_MOTOR, LAB_MOTOR, ONE_MASS, PUMP, SERVO_AXIS, TWO_MASS
from benchmarks.changes.observe import Case, observe, recordings
from benchmarks.changes.plants import Change, Term

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.candidate_forms import scales_a_sum
from otolith.discovery.candidates import Candidate
from otolith.discovery.hypotheses import (
    FaultHypothesis,
    FaultType,
    Proposal,
    all_parameters_moved,
    evidence_factor,
    nothing_happened,
    with_candidate,
)
from otolith.discovery.search import fit_hypotheses
from otolith.estimation.evidence import NULL_ODDS, prior_deviance
from otolith.estimation.information import Prior, forget_parameter, initial_prior
from otolith.estimation.problem import Component, Problem
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from tests.variants import often

MOTOR = find_twin("dc_motor")


@pytest.mark.full
def test_a_step_whose_fit_reaches_another_minimum_is_no_component() -> None:
    """Friction that changes its sign makes the fit of F_v alone fail, where an equivalent component explains the step.

    Values before the step, from which the component is fitted, are no start: the parameter must take its place.
    """
    truth = 0.8 * SERVO_AXIS.parameters["F_v"]
    case = Case("F_v", SERVO_AXIS, Change(parameters={"F_v": truth}), healthy=12, changed=12)
    state = initial_state("axis", "bench", case.problem)
    for window in next(recordings(case, case.problem, [5], 1))[10:14]:
        state, report = adapt(state, window)
    friction = report.document.parameters["F_v"]
    assert friction.low is not None
    assert friction.high is not None
    assert friction.low <= truth <= friction.high


@pytest.mark.parametrize("run", [pytest.param(0, marks=pytest.mark.full), 2])
def test_a_stiffness_that_moved_far_is_no_periodic_torque(run: int) -> None:
    """The resonance moves by several half waves in a window, so that a fit from the old stiffness ends elsewhere."""
    change = Change(parameters={"k_s": 0.8 * TWO_MASS.parameters["k_s"]})
    case = Case("k_s", TWO_MASS, change, healthy=12, changed=12)
    state, decisions = initial_state("two masses", "bench", case.problem), []
    for window in next(recordings(case, case.problem, [run], 1))[8:14]:
        state, report = adapt(state, window)
        decisions.append(report.document.decision)
    assert decisions == [*[WindowDecision.LEARNED] * 4, WindowDecision.SUSPECTED, WindowDecision.STEPPED]


@pytest.mark.parametrize("number", often([20], [17, 20]))
def test_the_error_of_the_integrator_is_no_evidence(number: int) -> None:
    """Speed crosses zero where dry friction needs short steps; a fit that starts beside it must not keep long ones."""
    (trial,) = (own for own in classes.trials(12, 12) if own.case.name == "J / gain of omega: J -20 %")
    problem = trial.case.problem
    window = next(recordings(trial.case, problem, [2], 1))[number]
    truth = ONE_MASS.parameters
    prior = Prior(np.array([truth["J"], truth["T_c"], 0.0, 0.0]), np.diag([2e-5, 5e-4, 1e-5, 1e-4]) ** 2)
    gain = Component("sensor of omega", "linear", "omega", 0.25)
    moved = FaultHypothesis(FaultType.PARAMETER, "J", 1)
    proposals = [
        Proposal(moved, problem, forget_parameter(prior, problem, 0), prior.mean),
        with_candidate(problem, prior, Candidate(gain, 1.0, True)),
    ]
    parameter, sensor = (fitted.chi_square for fitted in fit_hypotheses(proposals, window))
    assert parameter == pytest.approx(sensor, abs=1.0)


@pytest.mark.full
def test_a_simple_cause_is_compared_beside_a_shape_that_fits_the_error_of_the_linear_response() -> None:
    """Force reads 10 % too much, 9.1 % of the reading: that is stated beside the parameters that it resembles."""
    case = Case("gain of F", SERVO_AXIS, Change(gains={"F": 1.1}), healthy=5, changed=2)
    (windows,) = observe(case, [0], 1)
    stated = [(item.reason, item.text.split(":")[0], item.probability) for item in windows[-1].stated]
    assert any(reason == "SENSOR" and text == "F reads wrong by +9.1%" for reason, text, _ in stated), stated
    assert max(share for reason, _, share in stated if reason == "SENSOR") == pytest.approx(stated[0][2], abs=0.01)


def test_a_site_that_scales_a_sum_is_a_cause_beside_its_parts() -> None:
    pump = find_twin("pump")
    head = [site.name for site in pump.sites].index("head")
    assert scales_a_sum(pump, head)
    rest = tuple(own for own in pump.definitions if own[0] != "dp")
    wholes = ("h_0*omega^2", "h_0*(omega^2 - h_2*Q*abs(Q))", "omega^2/h_0", "(omega^2 + Q)/h_0^2")
    for expression in wholes:  # the parameter is a factor of all
        assert not scales_a_sum(replace(pump, definitions=(("dp", expression, ""), *rest)), head)
    assert not any(scales_a_sum(pump, site) for site in range(len(pump.sites) + 3) if site != head)


@pytest.mark.full
@pytest.mark.parametrize("truth", ["h_0 -12 %", "head -12 %"])
def test_a_step_of_the_head_curve_and_a_loss_of_head_are_a_class_without_the_other_part(truth: str) -> None:
    (trial,) = (own for own in classes.trials(5, 5) if own.case.name == f"h_0 / constant head: {truth}")
    outcomes = [classes.judge(trial, run) for run in observe(trial.case, [0, 1], 1)]
    assert all(outcome.right for outcome in outcomes), outcomes


@pytest.mark.parametrize("names", [("K_t", "K_e"), ("J", "L_a")])
def test_two_known_parameters_that_move_at_once_are_no_components(names: tuple[str, str]) -> None:
    """As of magnets that weaken: the estimated parameters stay as they are, and what has moved is named."""
    old = DC_MOTOR.parameters
    change = Change(parameters={name: 1.1 * old[name] for name in names})
    (reports,) = observe(Case("two", DC_MOTOR, change, ("R_a", "D"), healthy=6, changed=5), [0], 1)
    for report in reports[6:]:
        best = report.stated[0]
        assert report.components == ()
        assert report.decision is WindowDecision.SUSPECTED
        assert (best.reason, set(best.text.split(", "))) == ("PARAMETER", set(names))
        assert all(report.parameters[name].holds_truth for name in ("R_a", "D"))


def test_a_parameter_that_moves_beside_a_known_one_is_followed() -> None:
    """A constant pressure is the static one; a component of another shape must not take its place."""
    change = Change(parameters={"k_v": 1.15 * PUMP.parameters["k_v"]}, terms={"pipe": Term("constant", amplitude=-6e3)})
    (reports,) = observe(Case("two", PUMP, change, healthy=6, changed=5), [0], 1)
    for report in reports[7:]:
        assert report.components == ()
        assert report.stated[0].text == "p_static, k_v"
        assert all(own.holds_truth for own in report.parameters.values())


def window_under_ripple(period: float) -> Window:
    """Return 2 s of a motor under a torque of 2 Hz that nobody measures, sampled with ``period``; 2.5 ms at least."""
    random, times = np.random.default_rng(5), 0.0025 * np.arange(800)
    volts, load = np.where(np.arange(800) % 200 < 100, 18.0, 6.0), 0.01 + 0.002 * np.sin(4.0 * np.pi * times)
    values = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
    inputs = Excitation.uniform(np.column_stack([volts, load]), 0.0025, 4)
    states = kernel_of(MOTOR).simulate(np.array([list(values.values())]), np.array([[1.0, 150.0]]), inputs)[0]
    columns = np.column_stack([volts, np.full(800, 0.01), states + random.normal(size=states.shape) * (0.005, 0.02)])
    return Window.whole(0, 0.0, period, MOTOR.signals, columns[:: round(period / 0.0025)])


def test_samples_of_a_structure_that_nothing_explains_are_no_independent_evidence() -> None:
    """Sampled four times as fast, the same window is hardly more evidence for parameters that follow a part of it."""
    evidence = []
    for period in (0.01, 0.0025):
        free = tuple(parameter for parameter in MOTOR.parameters if parameter.name in ("R_a", "D"))
        known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row not in free)
        problem = Problem(MOTOR, known, free, noise=(0.005, 0.02))
        prior = initial_prior(problem)
        certain = replace(prior, covariance=1e-6 * prior.covariance)
        proposals = [nothing_happened(problem, certain), all_parameters_moved(problem, prior.mean)]
        fitted = fit_hypotheses(proposals, window_under_ripple(period))
        evidence.append((fitted[0].chi_square - fitted[1].chi_square) / evidence_factor(fitted))
    slow, fast = evidence
    assert slow > 0.0
    assert fast < 1.5 * slow


@pytest.mark.full
def test_a_gain_of_the_speed_is_a_cause_beside_all_parameters_on_a_sine() -> None:
    """A tenth of the speed is lost, as if K, J and T_c had moved. Shapes that depend on the voltage score far better.

    The linear response underrates the gain, because dry friction changes its sign at other times.
    """

    def sine(random: np.random.Generator, times: Array) -> dict[str, Array]:
        return {"V": 9.0 * np.sin(2.0 * np.pi * 0.7 * times + random.uniform(0.0, 6.0))}

    plant = replace(LAB_MOTOR, operate=sine)
    (reports,) = observe(Case("gain", plant, Change(gains={"omega": 0.9}), healthy=6, changed=5), [0], 1)
    for report in reports[6:]:
        assert report.decision in (WindowDecision.SUSPECTED, WindowDecision.AMBIGUOUS)
        assert {item.reason for item in report.stated} == {"PARAMETER", "SENSOR"}
        assert all(parameter.holds_truth for parameter in report.parameters.values())


def test_a_load_that_drops_is_a_cause_beside_the_offset_of_the_measured_torque() -> None:
    """While the winch turns one way, dry friction explains both; when it turns back, a sensor is not the only cause."""
    change = Change(terms={"shaft": Term("constant", amplitude=-0.4)})
    (reports,) = observe(Case("load", ONE_MASS, change, healthy=6, changed=9), [0], 1)
    assert WindowDecision.SENSOR not in {report.decision for report in reports}
    shares = {
        (item.reason, item.text.split(":")[0].split(" reads")[0]): item.probability for item in reports[-1].stated
    }
    assert shares["SENSOR", "T"] == pytest.approx(shares["COMPONENT", "shaft"], abs=0.01)
    assert all(parameter.holds_truth for report in reports[8:] for parameter in report.parameters.values())


@pytest.mark.parametrize("run", [1, 2])
def test_a_constant_represents_what_hardly_varies(run: int) -> None:
    """A constant torque, and ln(omega) where the speed varies by little of its logarithm."""
    lacking = Change(terms={"shaft": Term("constant", amplitude=-0.0004)})
    case = Case("constant", DC_MOTOR, lacking, before=lacking, healthy=3, changed=0)
    (reports,) = observe(case, [run], 1)
    for report in reports:
        components = [item for item in report.stated if item.reason == "COMPONENT"]
        best = max(components, key=lambda item: item.probability)
        assert re.fullmatch(r"shaft: -0\.000\d+ N·m", best.text), best


def test_the_types_have_equal_odds_before_any_evidence() -> None:
    """However many hypotheses of a type there are; screening and search charge a form the same."""
    for alternatives in (1.0, 40.0):
        stated = FaultHypothesis(FaultType.COMPONENT, alternatives=alternatives)
        assert alternatives * np.exp(-0.5 * stated.prior_deviance) == pytest.approx(1.0 / NULL_ODDS)
        assert stated.prior_deviance == float(prior_deviance(alternatives))
    assert FaultHypothesis(FaultType.NOTHING).prior_deviance == 0.0
