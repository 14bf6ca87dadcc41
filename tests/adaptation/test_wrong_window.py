"""A window that was itself wrong: what it seems to show is given up when the windows after it do not confirm it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.reporting import OPEN
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.variants import often

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
WINDOWS = 12
DOUBTED = 3  # windows, the wrong one included, that may publish what the wrong one suggests
SDS = 5.0  # of an estimate, in which the truth lies: one window in a million is outside by chance


def late_current(values: Array) -> Array:
    """The current of some samples is that of the sample before, as where a device refreshes its registers late."""
    values[70:150, 2] = values[69:149, 2]
    return values


def low_voltage(values: Array) -> Array:
    values[90:, 0] *= 0.93
    return values


def offset_load(values: Array) -> Array:
    values[60:, 1] += 0.002
    return values


def offset_voltage(values: Array) -> Array:
    values[100:, 0] += 0.2
    return values


def late_voltage(values: Array) -> Array:
    values[1:, 0] = values[:-1, 0]
    return values


WRONG = (late_current, low_voltage, offset_load, offset_voltage, late_voltage)


def high_voltage(values: Array) -> Array:
    values[:, 0] *= 1.05
    return values


def warped_speed(values: Array) -> Array:
    """The sensor of the speed is not linear: its error has 15 times the noise and repeats with the speed."""
    values[:, 3] += 0.3 * np.sin(4.0 * values[:, 3])
    return values


def problem_of(free: tuple[str, ...]) -> Problem:
    known = tuple(pair for pair in TRUTH.items() if pair[0] not in free)
    estimated = tuple(parameter for parameter in MOTOR.parameters if parameter.name in free)
    return Problem(MOTOR, known, estimated, (0.005, 0.02), input_noise=(0.0, 0.0002))


def reports(windows: list[Window], free: tuple[str, ...]) -> list[ReportDocument]:
    state, documents = initial_state("motor", "bench", problem_of(free)), []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return documents


@pytest.mark.parametrize("wrong", often(WRONG[:2], WRONG), ids=lambda wrong: wrong.__name__)
@pytest.mark.parametrize(
    "free", often([("R_a", "L_a", "J", "D")], [("R_a",), ("R_a", "D"), ("R_a", "L_a", "J", "D")]), ids=len
)
@pytest.mark.parametrize("at", often([0], [0, 1, 5]))
def test_a_wrong_window_is_given_up(
    wrong: Callable[[Array], Array], free: tuple[str, ...], at: int, scenario: MotorScenario, windows: Cut
) -> None:
    """The machine starts from rest: nothing is known before the first window, so that it can mislead most."""
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS)]
    cut[at] = replace(cut[at], values=wrong(cut[at].values.copy()))
    documents = reports(cut, free)
    assert not any(document.components for document in documents)
    for document in documents[at + DOUBTED :]:
        assert document.decision is WindowDecision.LEARNED
        for name, parameter in document.parameters.items():
            if parameter.status in (Status.ESTIMATED, Status.HELD):
                assert parameter.value is not None
                assert parameter.sd is not None
                assert abs(parameter.value - TRUTH[name]) <= SDS * parameter.sd, document.window.index
    assert documents[-1].parameters["R_a"].status is Status.ESTIMATED


@pytest.mark.parametrize("free", [("R_a",), ("R_a", "D")], ids=len)
def test_windows_that_are_wrong_now_and_then_move_no_estimate(
    free: tuple[str, ...], scenario: MotorScenario, windows: Cut
) -> None:
    """Each wrong window is a new contradiction, whatever the one before suggested."""
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS + 5)]
    for at in range(5, len(cut), 3):
        cut[at] = replace(cut[at], values=high_voltage(cut[at].values.copy()))
    for document in reports(cut, free)[:15]:
        if document.decision is WindowDecision.LEARNED:
            resistance = document.parameters["R_a"]
            assert resistance.value is not None
            assert resistance.sd is not None
            assert abs(resistance.value - TRUTH["R_a"]) <= SDS * resistance.sd, document.window.index


@pytest.mark.parametrize("wrong", [1, 3])
@pytest.mark.parametrize("seed", often([2], range(8)))
def test_windows_that_no_hypothesis_explains_leave_no_doubt(
    seed: int, wrong: int, scenario: MotorScenario, windows: Cut
) -> None:
    """Registers are read up to 0.1 s late while a computer is busy, all signals at once."""
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS)]
    values = np.concatenate([window.values for window in cut])
    late = np.random.default_rng(seed).exponential(2.0, len(values)).astype(int)
    late[wrong * len(values) // WINDOWS :] = 0
    values = values[np.maximum(np.arange(len(values)) - late, 0)]
    read = [replace(window, values=part) for window, part in zip(cut, np.array_split(values, WINDOWS), strict=True)]
    for document in reports(read, ("R_a",))[wrong + 1 :]:
        resistance = document.parameters["R_a"]
        assert resistance.value is not None
        assert resistance.sd is not None
        assert resistance.sd < 0.003 * TRUTH["R_a"], document.window.index
        assert abs(resistance.value - TRUTH["R_a"]) <= SDS * resistance.sd, document.window.index


@pytest.mark.full
def test_nothing_is_estimated_from_what_no_hypothesis_explains(scenario: MotorScenario, windows: Cut) -> None:
    state, unexplained = initial_state("motor", "bench", problem_of(("R_a", "D"))), 0
    for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS):
        state, report = adapt(state, replace(window, values=warped_speed(window.values.copy())))
        if state.test is not None and report.document.decision in OPEN and not state.test.best.is_explained:
            unexplained += 1
            statuses = {parameter.status for parameter in report.document.parameters.values()}
            assert Status.ESTIMATED not in statuses, window.index
    assert unexplained > 0
