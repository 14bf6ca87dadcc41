"""Sensors whose steps are far coarser than their noise: their rounding is no component, no fault and no bias."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.estimation.objective import WHITE_ROUNDING, adc_step, rounding_variance
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Step
from tests.variants import often, often_rows

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
WINDOWS = 14
CURRENT, SPEED = 2, 3
SDS = 5.0  # of an estimate, in which the truth lies: one window in a million is outside by chance
LEVELS = ((-1e11, 0.0, 1e11), (-1e11, 1e11), (-100.0, 0.0, 100.0))
FREE = (("R_a",), ("R_a", "L_a", "J", "D"))


def problem_of(free: tuple[str, ...]) -> Problem:
    known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row.name not in free)
    estimated = tuple(row for row in MOTOR.parameters if row.name in free)
    return Problem(MOTOR, known, estimated, noise=tuple(output.noise for output in MOTOR.outputs))


def reports(
    windows: list[tuple[Window, float]], free: tuple[str, ...], column: int, step: float
) -> list[ReportDocument]:
    state, documents = initial_state("motor", "bench", problem_of(free)), []
    for window, _ in windows:
        values = window.values.copy()
        values[:, column] = step * np.rint(values[:, column] / step)
        state, report = adapt(state, replace(window, values=values))
        documents.append(report.document)
    return documents


@pytest.mark.parametrize("free", FREE)
@pytest.mark.parametrize(
    ("column", "step"),
    often_rows(
        [(SPEED, 0.5), (CURRENT, 0.12)], [(SPEED, 0.1), (SPEED, 0.5), (SPEED, 1.2), (CURRENT, 0.02), (CURRENT, 0.12)]
    ),
)
def test_rounding_is_no_component_no_fault_and_no_bias(
    scenario: MotorScenario, windows: Cut, free: tuple[str, ...], column: int, step: float
) -> None:
    healthy = windows(scenario.model_copy(update={"faults": ()}), WINDOWS)
    documents = reports(healthy, free, column, step)
    # A first window on fewer levels than show a step may be refused.
    assert {document.decision for document in documents[1:]} == {WindowDecision.LEARNED}
    for document in documents:
        assert document.components == ()
        for name, parameter in document.parameters.items():
            if parameter.value is not None and parameter.sd is not None:
                assert abs(parameter.value - TRUTH[name]) < SDS * parameter.sd, (document.window.index, name)


def test_a_step_of_a_resistance_is_detected_behind_a_coarse_sensor(scenario: MotorScenario, windows: Cut) -> None:
    changed = scenario.model_copy(
        update={"faults": (Step(kind="step", parameter="R_a", start="11 s", amount="0.6 ohm"),)}
    )
    last = reports(windows(changed, WINDOWS), ("R_a",), SPEED, 0.5)[-1].parameters["R_a"]
    assert last.value is not None
    assert last.sd is not None
    assert last.sd < 0.05
    assert abs(last.value - TRUTH["R_a"] - 0.6) < SDS * last.sd


@pytest.mark.parametrize(
    ("values", "step"),
    [
        ([1.0, 1.0, 1.0, 1.0], 0.0),
        ([1.0, 1.0, 0.0, 0.0], 0.0),  # a sensor that fails
        ([1.0, 1.5, 1.0, 1.5], 0.5),
        ([0.0, 0.5, 1.5, 1.0], 0.5),
        ([0.0, 0.5, 1.5, 1.13], 0.0),
    ],
)
def test_the_step_of_a_converter(values: list[float], step: float) -> None:
    assert adc_step(np.array(values)) == step


def test_equal_readings_have_one_error() -> None:
    assert rounding_variance(np.array([0.0, 1.0, 2.0, 3.0]), 0.1, 0.0) == pytest.approx(1.0 / 12.0)
    assert rounding_variance(np.repeat([0.0, 1.0, 2.0, 3.0], 10), 0.1, 0.0) == pytest.approx(10.0 / 12.0)
    assert rounding_variance(np.repeat([2.0], 10), 0.1, 0.5) == pytest.approx(10.0 * 0.25 / 12.0)
    assert rounding_variance(np.array([]), 0.1, 0.5) == 0.0


def test_rounding_beside_noise_is_white() -> None:
    """Normal noise of half a step leaves no mean error, wherever the value lies between two levels."""
    noise = np.random.default_rng(1).normal(0.0, 1.0 / WHITE_ROUNDING, 1_000_000)
    for value in np.linspace(0.0, 0.5, 6):
        assert abs(float(np.mean(np.rint(value + noise) - value))) < 0.005
    values = np.repeat([0.0, 1.0, 2.0, 3.0], 10)
    assert rounding_variance(values, 0.5, 0.0) == pytest.approx(1.0 / 12.0)
    assert rounding_variance(values, 0.49, 0.0) == pytest.approx(10.0 / 12.0)


@pytest.mark.parametrize("size", [3.4e38, 1e5])
def test_faulty_values_show_no_step(scenario: MotorScenario, windows: Cut, size: float) -> None:
    """Such a step would stay, hide a frozen sensor, and in a saved state be refused as implausible."""
    (window, _), *_ = windows(scenario.model_copy(update={"faults": ()}), 1)
    values = window.values.copy()
    values[:, CURRENT] = size * (np.arange(len(values)) % 7 == 0)
    state, report = adapt(initial_state("motor", "bench", problem_of(FREE[0])), replace(window, values=values))
    assert report.document.decision is not WindowDecision.LEARNED
    assert state.posterior.problem.steps == ()


@pytest.mark.parametrize("levels", often(LEVELS[-1:], LEVELS))
def test_wrong_readings_are_no_levels_of_a_converter(
    scenario: MotorScenario, windows: Cut, levels: tuple[float, ...]
) -> None:
    state = initial_state("motor", "bench", problem_of(("R_a", "D")))
    *before, (last, _) = windows(scenario.model_copy(update={"faults": ()}), 3)
    for window, _ in before:
        state, _ = adapt(state, window)
    values = last.values.copy()
    values[:, SPEED] = np.random.default_rng(1).choice(levels, len(values))
    state, report = adapt(state, replace(last, values=values))
    assert report.document.decision not in ACCEPTED
    assert state.problem.steps == ()
