"""What would help: a move that pins a parameter down really does, and windows are as long as drift and noise ask."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.estimation.problem import Problem, WindowOptions
from otolith.estimation.window_length import WindowExcitation, next_records
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
FREE = tuple(entry for entry in TWIN.parameters if entry.name in ("R_a", "J", "D"))
KNOWN = tuple((entry.name, entry.nominal) for entry in TWIN.parameters if entry not in FREE)
PROBLEM = Problem(TWIN, KNOWN, FREE, (0.005, 0.02))
RECORDS, PERIOD = 200, 0.01
PARAMETERS = np.array([[entry.nominal for entry in TWIN.parameters]])
SPEED = 10.0  # rad/s
CURRENT = (0.00143 + 0.006) * SPEED / 0.038
STEADY = np.array([6.5 * CURRENT + 0.038 * SPEED, 0.06])


def window(index: int, inputs: Array, initial: Array) -> Window:
    random = np.random.default_rng(index)
    outputs = kernel_of(TWIN).simulate(PARAMETERS, initial[None], Excitation(inputs, PERIOD, 4))[0]
    values = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * [0.005, 0.02]])
    return Window.whole(index, 2.0 * index, PERIOD, TWIN.signals, values)


def steady(count: int) -> tuple[AdaptationState, ReportDocument]:
    """After windows at constant speed."""
    state = initial_state("motor", "here", PROBLEM)
    for index in range(count):
        state, report = adapt(state, window(index, np.tile(STEADY, (RECORDS, 1)), np.array([CURRENT, SPEED])))
    return state, report.document


def test_constant_speed_says_nothing_of_the_inertia_and_asks_for_a_move() -> None:
    _, document = steady(5)
    entry = document.parameters["J"]
    assert (entry.status, entry.value) == (Status.UNESTIMATED, None)
    assert entry.reason
    assert entry.advice is not None
    assert "V_a" in entry.advice
    assert document.parameters["R_a"].status is Status.ESTIMATED


def test_the_move_that_is_advised_pins_it_down_as_foretold() -> None:
    state, document = steady(5)
    advice = document.parameters["J"].advice or ""
    assert advice.startswith("a step of V_a from")
    target = float(advice.split(" to ")[1].split()[0])
    foretold = float(advice.split("±")[1].split()[0])
    inputs = np.tile(STEADY, (RECORDS, 1))
    inputs[RECORDS // 4 :, 0] = target
    _, report = adapt(state, window(9, inputs, np.array([CURRENT, SPEED])))
    found = report.document.parameters["J"]
    assert found.status is Status.ESTIMATED
    assert found.sd is not None
    assert 0.5 < 1.96 * found.sd / foretold < 2.0
    assert found.value == pytest.approx(0.001171, abs=3.0 * found.sd)


def test_windows_grow_while_nothing_drifts_and_shrink_with_the_drift() -> None:
    options = WindowOptions(200, 50, 1000)

    def settled(trend: float) -> int:
        records = 200
        for _ in range(30):
            sd = 0.002 * np.sqrt(200 / records)  # of a window of this length, alone
            need = WindowExcitation(np.array([sd]), np.array([trend]), explained=True)
            records = next_records(options, records, PERIOD, need)
        return records

    lengths = [settled(trend) for trend in (1e-6, 3e-4, 1e-3, 3e-3, 1e-1)]
    assert lengths == sorted(lengths, reverse=True)
    assert (lengths[0], lengths[-1]) == (1000, 50)
    best = np.cbrt(2.0 * 0.002**2 * 2.0 / 1e-3**2) / PERIOD  # where squared bias and variance add up to least
    assert lengths[2] == pytest.approx(best, rel=0.25)


def test_without_a_choice_the_length_stays() -> None:
    need = WindowExcitation(np.array([0.1]), np.array([10.0]), explained=False)
    assert next_records(WindowOptions(200, 200, 200), 200, PERIOD, need) == 200


@pytest.mark.parametrize("records", [50_000, pytest.param(1_000_000, marks=pytest.mark.full)])
def test_a_long_window_is_answered(records: int) -> None:
    inputs = np.tile(STEADY, (records, 1))
    inputs[:, 0] += np.repeat(np.random.default_rng(1).uniform(-2.0, 2.0, records // 1000), 1000)
    state, _ = steady(1)
    large = replace(window(1, inputs, np.array([CURRENT, SPEED])), start=2.0)
    _, report = adapt(state, large)
    assert report.document.parameters["R_a"].status is Status.ESTIMATED
    assert report.document.parameters["R_a"].value == pytest.approx(6.5, rel=1e-4)
