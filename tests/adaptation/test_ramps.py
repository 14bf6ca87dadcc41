"""A parameter that moves along a ramp: it is followed, and the ramp is no component."""

from collections.abc import Callable

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Drift

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR = find_twin("dc_motor")
NOMINAL, WINDOWS, WINDOW = 6.5, 18, 2.0  # ohm, windows, s
FOLLOWED_FROM = 13  # window
SDS = 5.0  # of an estimate, in which the truth lies: one window in a million is outside by chance
SLOW = 1e-3  # 1/s: an exponential that is straight over the record


@pytest.mark.parametrize("free", [("R_a",), ("R_a", "L_a", "J", "D")])
@pytest.mark.parametrize("share_per_second", [-0.0005, -0.002, 0.003, -0.01])
def test_a_resistance_on_a_ramp_is_followed(
    scenario: MotorScenario, windows: Cut, free: tuple[str, ...], share_per_second: float
) -> None:
    amount = NOMINAL * share_per_second / SLOW
    ramp = Drift(kind="drift", parameter="R_a", start="10 s", amount=f"{amount} ohm", rate=f"{SLOW} 1/s")
    known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row.name not in free)
    estimated = tuple(row for row in MOTOR.parameters if row.name in free)
    problem = Problem(MOTOR, known, estimated, (0.005, 0.02), input_noise=(0.0, 0.0002))
    state = initial_state("motor", "bench", problem)
    for window, _ in windows(scenario.model_copy(update={"faults": (ramp,)}), WINDOWS):
        state, report = adapt(state, window)
        truth = NOMINAL + float(ramp.change(np.array([(window.index + 1) * WINDOW]), amount)[0])
        value = report.document.parameters["R_a"]
        assert report.document.components == ()
        if window.index >= FOLLOWED_FROM:
            assert value.value is not None
            assert value.sd is not None
            assert abs(value.value - truth) < SDS * value.sd, window.index
            assert value.value == pytest.approx(truth, rel=0.01)
