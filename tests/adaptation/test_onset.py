"""A sensor that becomes wrong is named wherever in a window it begins, also if other records of it are wrong."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.discovery.alternatives import WindowDecision
from otolith.health.schema import ReportDocument
from tests.adaptation.measured_like import TRUTH, Imperfections, motor_problem, motor_windows, reports

FREE = ("R_a", "D", "J")
BEGIN, WINDOWS = 3, 8
GAIN = 1.05
MOVED = np.array([3.0, -2.0, 4.0])  # rad/s
SDS = 4.0


def changed(change: Callable[[int, Array], None], seed: int) -> list[Window]:
    """Return windows of a motor whose values ``change`` changes in place, given how long ago the first of them was."""
    windows = []
    for window in motor_windows(seed, WINDOWS, Imperfections()):
        values = window.values.copy()
        if window.index >= BEGIN:
            change(window.index - BEGIN, values)
        windows.append(replace(window, values=values))
    return windows


def assert_estimates_hold(document: ReportDocument) -> None:
    for name in FREE:
        parameter = document.parameters[name]
        assert parameter.value is not None
        assert abs(parameter.value - TRUTH[name]) < SDS * (parameter.sd or 0.0), name


@pytest.mark.parametrize("first", [1, 15, *(pytest.param(at, marks=pytest.mark.full) for at in (0, 5, 24, 40, 100))])
def test_a_wrong_scale_is_named_from_any_record_on(first: int) -> None:
    def change(age: int, values: Array) -> None:
        values[0 if age else first :, 3] *= GAIN

    documents = reports(motor_problem(*FREE), changed(change, 3))
    assert all(document.decision is WindowDecision.SENSOR for document in documents[BEGIN + 3 :])
    assert "omega reads wrong by +5.0%" in documents[-1].findings[0].text
    assert_estimates_hold(documents[-1])


@pytest.mark.parametrize("wrong", [120, *(pytest.param(at, marks=pytest.mark.full) for at in (30, 170))])
@pytest.mark.parametrize(("signal", "gain"), [(3, GAIN), pytest.param(2, 1.1, marks=pytest.mark.full)])
def test_a_window_that_nothing_explains_excludes_no_hypothesis(wrong: int, signal: int, gain: float) -> None:
    """Three wrong readings in the first window of a wrong scale: hypotheses that it seems to exclude come back."""

    def change(age: int, values: Array) -> None:
        values[:, signal] *= gain
        if not age:
            values[wrong : wrong + len(MOVED), 3] += MOVED

    documents = reports(motor_problem(*FREE), changed(change, 4))
    assert documents[BEGIN].decision is WindowDecision.REFUSED
    assert all(document.decision is WindowDecision.SENSOR for document in documents[BEGIN + 3 :])
    assert_estimates_hold(documents[-1])
