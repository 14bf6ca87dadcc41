"""Experiment design: the advised step determines its parameter, and the window length follows drift and noise."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.experiment_design import NO_EXPERIMENT, Situation, deciding_experiment, moves
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, TrackedHypothesis
from otolith.estimation.information import Prior, extend_prior
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, Problem, WindowExcitation, WindowOptions, augment, next_records
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from tests.messages import assert_says

TWIN = find_twin("dc_motor")
FREE = tuple(parameter for parameter in TWIN.parameters if parameter.name in ("R_a", "J", "D"))
KNOWN = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter not in FREE)
PROBLEM = Problem(TWIN, KNOWN, FREE, (0.005, 0.02))
RECORDS, PERIOD = 200, 0.01
PARAMETERS = np.array([[parameter.nominal for parameter in TWIN.parameters]])
SPEED = 10.0  # rad/s
CURRENT = (0.00143 + 0.006) * SPEED / 0.038
STEADY = np.array([6.5 * CURRENT + 0.038 * SPEED, 0.06])


def window(index: int, inputs: Array, initial: Array) -> Window:
    random = np.random.default_rng(index)
    outputs = kernel_of(TWIN).simulate(PARAMETERS, initial[None], Excitation.uniform(inputs, PERIOD, 4))[0]
    values = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * [0.005, 0.02]])
    return Window.whole(index, 2.0 * index, PERIOD, TWIN.signals, values)


def steady(count: int) -> tuple[AdaptationState, ReportDocument]:
    """State and last report after ``count`` windows at constant speed."""
    state = initial_state("motor", "here", PROBLEM)
    for index in range(count):
        state, report = adapt(state, window(index, np.tile(STEADY, (RECORDS, 1)), np.array([CURRENT, SPEED])))
    return state, report.document


def test_inertia_at_constant_speed_is_unestimated_with_advice() -> None:
    _, document = steady(5)
    inertia = document.parameters["J"]
    assert (inertia.status, inertia.value) == (Status.UNESTIMATED, None)
    assert inertia.reason
    assert inertia.advice is not None
    assert "V_a" in inertia.advice
    assert document.parameters["R_a"].status is Status.ESTIMATED


def test_advised_step_estimates_inertia_as_predicted() -> None:
    state, document = steady(5)
    advice = document.parameters["J"].advice or ""
    assert advice.startswith("a step of V_a from")
    target = float(advice.split(" to ")[1].split()[0])
    predicted = float(advice.split("±")[1].split()[0])
    inputs = np.tile(STEADY, (RECORDS, 1))
    inputs[RECORDS // 4 :, 0] = target
    _, report = adapt(state, window(9, inputs, np.array([CURRENT, SPEED])))
    inertia = report.document.parameters["J"]
    assert inertia.status is Status.ESTIMATED
    assert inertia.sd is not None
    assert 0.5 < 1.96 * inertia.sd / predicted < 2.0
    assert inertia.value == pytest.approx(0.001171, abs=3.0 * inertia.sd)


INFORMED = Prior(
    np.array([*(parameter.nominal for parameter in FREE), 0.0, 0.0, 0.0]),
    np.diag(np.concatenate([0.003 * PROBLEM.scale, 1e-5 * PROBLEM.scale]) ** 2),
)
STILL = Situation(STEADY, np.array([CURRENT, SPEED]), RECORDS, PERIOD)


def tracked(kind: FaultType, problem: Problem = PROBLEM, *, moved: float = 0.0) -> TrackedHypothesis:
    """A hypothesis that knows its parameters to 0.3 %, of which the inertia may have moved by a share of itself."""
    prior = extend_prior(INFORMED, PROBLEM, problem)
    prior.mean[1] *= 1.0 + moved
    return TrackedHypothesis(FaultHypothesis(kind), Posterior.initial(problem).set_prior(prior), 0.0, 0.0, 1.0)


def test_a_change_of_speed_tells_a_late_speed_from_nothing_and_from_an_inertia() -> None:
    late = tracked(FaultType.TIMING, replace(PROBLEM, delays=(("omega", 0.05),)))
    for other in (tracked(FaultType.NOTHING), tracked(FaultType.PARAMETER, moved=0.3)):
        for pair in ((late, other), (other, late)):
            text = deciding_experiment(*pair, STILL)
            assert_says(text, "V_a", "V", f"{STEADY[0]:.3g}")


def test_an_input_that_is_almost_zero_is_written_as_zero() -> None:
    """Seen: "a step of V_a from 1.82e-48 to 4.8 V"."""
    situation = Situation(np.array([1.82e-48, 0.0]), np.zeros(2), RECORDS, PERIOD)
    texts = [move.text for move in moves(PROBLEM, situation)]
    assert any("V_a from 0 to " in text for text in texts)
    assert not any("e-48" in text for text in texts)


def test_noise_is_told_from_nothing_by_the_size_of_innovations() -> None:
    noisy = tracked(FaultType.NOISE, PROBLEM.with_levels([0.0, 0.0, 0.005, 0.1]))
    assert "V_a" in deciding_experiment(noisy, tracked(FaultType.NOTHING), STILL)


def test_causes_of_the_same_signals_are_told_apart_by_no_experiment() -> None:
    offset, torque = (
        augment(PROBLEM, [Component(site, "constant", "", amplitude)])
        for site, amplitude in (("sensor of T_load", -0.01), ("shaft", 0.01))
    )
    assert deciding_experiment(tracked(FaultType.SENSOR, offset), tracked(FaultType.COMPONENT, torque), STILL) == (
        NO_EXPERIMENT
    )


def test_a_disturbed_machine_needs_a_larger_move() -> None:
    """Process noise hides what sensor noise alone would show."""
    sizes = []
    for disturbed in (0.0, 2.0, 1e3):
        problem = replace(PROBLEM, process_noise=(0.0, disturbed))
        pair = tracked(FaultType.NOTHING, problem), tracked(FaultType.PARAMETER, problem, moved=0.1)
        text = deciding_experiment(*pair, STILL)
        sizes.append(np.inf if text == NO_EXPERIMENT else abs(float(text.split(" to ")[1].split()[0]) - STEADY[0]))
    assert sizes[0] < sizes[1] <= sizes[2]


def test_window_length_shrinks_as_the_trend_grows() -> None:
    options = WindowOptions(200, 50, 1000)

    def settled(trend: float) -> int:
        records = 200
        for _ in range(30):
            sd = 0.002 * np.sqrt(200 / records)  # of one window of this length
            excitation = WindowExcitation(np.array([sd]), np.array([trend]), explained=True)
            records = next_records(options, records * PERIOD, PERIOD, excitation)
        return records

    lengths = [settled(trend) for trend in (1e-6, 3e-4, 1e-3, 3e-3, 1e-1)]
    assert lengths == sorted(lengths, reverse=True)
    assert (lengths[0], lengths[-1]) == (1000, 50)
    best = np.cbrt(2.0 * 0.002**2 * 2.0 / 1e-3**2) / PERIOD  # minimises squared bias plus variance
    assert lengths[2] == pytest.approx(best, rel=0.25)


def test_window_length_stays_if_its_bounds_are_equal() -> None:
    excitation = WindowExcitation(np.array([0.1]), np.array([10.0]), explained=False)
    assert next_records(WindowOptions(200, 200, 200), 200 * PERIOD, PERIOD, excitation) == 200


@pytest.mark.parametrize("records", [50_000, pytest.param(1_000_000, marks=pytest.mark.full)])
def test_long_window_is_estimated(records: int) -> None:
    inputs = np.tile(STEADY, (records, 1))
    inputs[:, 0] += np.repeat(np.random.default_rng(1).uniform(-2.0, 2.0, 1000), records // 1000)
    state, _ = steady(1)
    large = replace(window(1, inputs, np.array([CURRENT, SPEED])), start=2.0)
    _, report = adapt(state, large)
    assert report.document.parameters["R_a"].status is Status.ESTIMATED
    assert report.document.parameters["R_a"].value == pytest.approx(6.5, rel=1e-4)
