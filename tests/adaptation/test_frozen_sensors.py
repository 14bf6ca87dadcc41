"""A frozen sensor stays a finding until its reading changes, also where the twin could follow it with other values."""

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.frozen_sensors import frozen_readings, with_still_frozen
from otolith.estimation.data_checks import CheckedWindow, FaultySensor

SENSOR = FaultySensor("i", "i is frozen at 2 A", "")
STEADY = np.full(50, 2.0)


def window_of(current: np.ndarray, missing: np.ndarray | None = None) -> Window:
    window = Window.whole(0, 0.0, 0.01, ("V_a", "i"), np.column_stack([np.arange(len(current)), current]))
    if missing is not None:
        window.missing[:, 1] = missing
    return window


@pytest.mark.parametrize(
    ("current", "missing", "expected"),
    [
        (STEADY, None, (SENSOR,)),
        (STEADY + 0.01, None, ()),
        (np.where(np.arange(50) < 49, 2.0, 2.01), None, ()),
        (np.where(np.arange(50) < 49, 2.0, 0.0), np.arange(50) == 49, (SENSOR,)),
        (STEADY, np.full(50, True), ()),  # another check tells that nothing comes
    ],
)
def test_a_frozen_sensor_is_so_until_its_reading_changes(
    current: np.ndarray, missing: np.ndarray | None, expected: tuple[FaultySensor, ...]
) -> None:
    frozen = frozen_readings((SENSOR,), window_of(STEADY))
    window = window_of(current, missing)
    assert with_still_frozen(CheckedWindow(window), frozen, window).faulty_sensors == expected


def test_a_sensor_that_moved_in_its_faulty_window_is_not_kept() -> None:
    assert not frozen_readings((SENSOR,), window_of(np.where(np.arange(50) < 20, 1.0, 2.0)))
