"""Whether a record is of one state of the machine."""

from collections.abc import Callable

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.commissioning.constancy import ValueChange
from otolith.estimation.information import QUANTILE
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.commissioning.test_own_values import TRUE, found, motor

__all__ = ["motor"]  # the fixture
Cut = Callable[..., list[tuple[Window, float]]]


def changes(motor: MotorScenario, windows: Cut, resistances: tuple[float, ...], seed: int) -> tuple[ValueChange, ...]:
    """Return the changes in a record of which each window is of a machine with its own resistance."""
    record = list[Window]()
    for place, resistance in enumerate(resistances):
        own = motor.model_copy(update={"seed": seed, "parameters": motor.parameters.model_copy(update={"R_a": resistance})})
        record.append(windows(own, len(resistances))[place][0])
    return found(find_twin("dc_motor"), record, set()).changes


@pytest.mark.parametrize("seed", range(3, 8))
def test_a_healthy_record_has_no_change(motor: MotorScenario, windows: Cut, seed: int) -> None:
    assert not changes(motor, windows, (TRUE["R_a"],) * 12, seed)


def test_a_step_is_told_with_both_values_and_its_time(motor: MotorScenario, windows: Cut) -> None:
    steps = changes(motor, windows, (2.1,) * 6 + (3.4,) * 6, 3)
    (step,) = [change for change in steps if change.name == "R_a"]
    assert not step.is_drift
    assert abs(step.before - 2.1) < 2.0 * QUANTILE * step.before_sd
    assert abs(step.after - 3.4) < 2.0 * QUANTILE * step.after_sd


def test_a_small_step_is_no_change(motor: MotorScenario, windows: Cut) -> None:
    assert not changes(motor, windows, (2.1,) * 6 + (2.16,) * 6, 3)


def test_a_drift_is_no_step(motor: MotorScenario, windows: Cut) -> None:
    rows = changes(motor, windows, tuple(np.linspace(2.1, 2.6, 12).tolist()), 3)
    assert [row.name for row in rows if row.is_drift] == ["R_a"] == [row.name for row in rows]
