"""Whether a record is of one state of the machine."""

from collections.abc import Callable

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.commissioning.constancy import ValueChange
from otolith.estimation.information import QUANTILE
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Step
from tests.commissioning.test_own_values import TRUE, changed, found, motor
from tests.variants import often

__all__ = ["motor"]  # the fixture
Cut = Callable[..., list[tuple[Window, float]]]


def changes(motor: MotorScenario, windows: Cut, resistances: tuple[float, ...], seed: int) -> tuple[ValueChange, ...]:
    """Return the changes in a record of which each window is of a machine with its own resistance."""
    record = list[Window]()
    for place, resistance in enumerate(resistances):
        parameters = motor.parameters.model_copy(update={"R_a": resistance})
        own = motor.model_copy(update={"seed": seed, "parameters": parameters})
        record.append(windows(own, len(resistances))[place][0])
    return found(find_twin("dc_motor"), record, set()).changes


@pytest.mark.parametrize("seed", range(3, 8))
def test_a_healthy_record_has_no_change(motor: MotorScenario, windows: Cut, seed: int) -> None:
    assert not changes(motor, windows, (TRUE["R_a"],) * 12, seed)


@pytest.mark.parametrize("moment", often([13.3], [8.0, 12.0, 13.3, 14.0, 15.9]))  # a window takes 2 s
def test_a_step_is_told_with_both_values_and_its_time(motor: MotorScenario, windows: Cut, moment: float) -> None:
    fault = Step.model_validate({"kind": "step", "parameter": "R_a", "start": f"{moment} s", "amount": "1.3 ohm"})
    record = [window for window, _ in windows(motor.model_copy(update={"faults": (fault,)}), 12)]
    (step,) = found(find_twin("dc_motor"), record, set()).changes
    assert step.name == "R_a"
    assert not step.is_drift
    assert abs(step.before - 2.1) < 2.0 * QUANTILE * step.before_sd < 0.05
    assert abs(step.after - 3.4) < 2.0 * QUANTILE * step.after_sd < 0.05
    assert step.until is not None
    assert step.since is not None
    assert step.until - 1e-6 <= moment <= step.since + 1e-6 <= step.until + 2.0 + 2e-6


def test_a_step_hides_no_wrong_sign(motor: MotorScenario, windows: Cut) -> None:
    fault = Step.model_validate({"kind": "step", "parameter": "R_a", "start": "12 s", "amount": "1.3 ohm"})
    record = [window for window, _ in windows(motor.model_copy(update={"faults": (fault,)}), 12)]
    values = found(find_twin("dc_motor"), changed(record, "omega", np.negative), set())
    assert values.faults or not values.is_followed


def test_a_small_step_is_no_change(motor: MotorScenario, windows: Cut) -> None:
    assert not changes(motor, windows, (2.1,) * 6 + (2.16,) * 6, 3)


def test_a_drift_is_no_step(motor: MotorScenario, windows: Cut) -> None:
    rows = changes(motor, windows, tuple(np.linspace(2.1, 2.6, 12).tolist()), 3)
    assert [row.name for row in rows if row.is_drift] == ["R_a"] == [row.name for row in rows]


@pytest.mark.parametrize("share", often([0.125], [1.0, 0.5, 0.25, 0.125]))
def test_a_machine_that_warms_up_has_no_step(motor: MotorScenario, windows: Cut, share: float) -> None:
    """By a quarter, in a ``share`` of the record."""
    resistances = 2.1 + 0.5 * -np.expm1(-np.arange(12) / (12.0 * share))
    rows = changes(motor, windows, tuple(resistances.tolist()), 3)
    assert [row.name for row in rows if row.is_drift] == ["R_a"] == [row.name for row in rows]
