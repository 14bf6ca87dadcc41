"""While a test is open, the published intervals hold the truth, also in windows that the filter expects."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Step

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
OFFSET = 0.1  # rad/s: five times the noise of the speed
FIRST, HELD_FROM = 5, 7  # windows: with the change, and the third one of it
EXCITED = 10  # window in which the load is switched for the first time after the change: it shows the inertia
SDS = 5.0  # of an estimate, in which the truth lies: one window in a million is outside by chance


def assert_held(windows: list[Window], free: tuple[str, ...], name: str, truth: float, first: int) -> None:
    """Every interval of one parameter from window ``first`` on holds the truth."""
    known = tuple(pair for pair in TRUTH.items() if pair[0] not in free)
    estimated = tuple(parameter for parameter in MOTOR.parameters if parameter.name in free)
    problem = Problem(MOTOR, known, estimated, (0.005, 0.02), input_noise=(0.0, 0.0002))
    state = initial_state("motor", "bench", problem)
    for window in windows:
        state, report = adapt(state, window)
        published = report.document.parameters[name]
        assert not report.document.components
        if window.index >= first:
            assert published.value is not None
            assert published.sd is not None
            assert abs(published.value - truth) <= SDS * published.sd, window.index


@pytest.mark.parametrize("free", [("D",), ("R_a", "D")], ids=len)
def test_an_offset_that_a_parameter_absorbs_is_not_forgotten(
    free: tuple[str, ...], scenario: MotorScenario, windows: Cut
) -> None:
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), 18)]
    for at in range(FIRST, len(cut)):
        values = cut[at].values.copy()
        values[:, 3] += OFFSET
        cut[at] = replace(cut[at], values=values)
    assert_held(cut, free, "D", TRUTH["D"], HELD_FROM)


def test_a_given_parameter_that_moved_does_not_pass_for_an_estimated_one(scenario: MotorScenario, windows: Cut) -> None:
    """At constant speed a torque constant 10 % higher looks like a damping that is 47 % lower."""
    step = Step(kind="step", parameter="K_t", start="10.7 s", amount="0.0038 N*m/A")
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": (step,), "seed": 1}), 14)]
    assert_held(cut, ("D",), "D", TRUTH["D"], HELD_FROM)


def test_a_step_that_few_windows_excite_is_not_forgotten(scenario: MotorScenario, windows: Cut) -> None:
    step = Step(kind="step", parameter="J", start="10.7 s", amount="0.000234 kg*m^2")
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": (step,)}), 20)]
    assert_held(cut, ("R_a", "L_a", "J", "D"), "J", 1.2 * TRUTH["J"], EXCITED)


def test_a_delay_from_the_first_window_on_is_not_forgotten(scenario: MotorScenario, windows: Cut) -> None:
    """The current is one record late. At constant speed no window shows it, and only later ones show the inertia."""
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": (), "seed": 3}), 13)]
    before = cut[0].values[0, 2]
    for at, window in enumerate(cut):
        values = window.values.copy()
        values[:, 2] = [before, *window.values[:-1, 2]]
        before = window.values[-1, 2]
        cut[at] = replace(window, values=values)
    assert_held(cut, ("R_a", "L_a", "J", "D"), "J", TRUTH["J"], EXCITED)
