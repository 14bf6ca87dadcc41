"""Repeated records: they count once, and they do not falsify the estimates."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.data_checks import MIN_REPEATED_RUN, drop_repeats, repeated_records
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.variants import often_rows

Cut = Callable[..., list[tuple[Window, float]]]

TWIN = find_twin("dc_motor")
RECORDS, WINDOWS = 200, 18
SENSORS = np.isin(TWIN.signals, ["i", "omega"])
SPEED = 15.0  # rad/s
CURRENT = 0.00143 * SPEED / 0.038  # A
# Ranges of records that repeat the first one. They span two to four windows, at nearly constant speed and over a
# change of the set-point.
REPEATED = [(1455, 1634), (1681, 2161), (1827, 2246), (1979, 2560), (1400, 1800)]


def problem() -> Problem:
    free = tuple(parameter for parameter in TWIN.parameters if parameter.name == "R_a")
    known = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter.name != "R_a")
    return Problem(TWIN, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))


def window_of(whole: Window, index: int, values: np.ndarray) -> Window:
    part = values[index * RECORDS : (index + 1) * RECORDS]
    return Window.whole(index, whole.start + index * RECORDS * 0.01, 0.01, whole.signals, part)


def run_with_repeats(
    scenario: MotorScenario, windows: Cut, first: int, last: int, dither: float = 0.0
) -> list[ReportDocument]:
    record = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS)]
    values = np.vstack([window.values for window in record])
    noise = dither * np.random.default_rng(1).normal(size=(last - first, values.shape[1]))
    values[first:last] = values[first] + noise
    state, documents = initial_state("motor", "here", problem()), []
    for index in range(WINDOWS):
        state, report = adapt(state, window_of(record[0], index, values))
        documents.append(report.document)
    return documents


def assert_no_false_estimate(documents: list[ReportDocument]) -> None:
    for document in documents:
        resistance = document.parameters["R_a"]
        assert not document.components
        assert document.decision is not WindowDecision.STEPPED
        assert resistance.value is None or resistance.value == pytest.approx(6.5, rel=0.005)


@pytest.mark.parametrize(("first", "last"), REPEATED)
def test_windows_after_repeated_records_update_normally(
    scenario: MotorScenario, windows: Cut, first: int, last: int
) -> None:
    documents = run_with_repeats(scenario, windows, first, last)
    assert_no_false_estimate(documents)
    after = documents[last // RECORDS + 1 :]
    assert {document.decision for document in after} == {WindowDecision.LEARNED}
    assert all(document.parameters["R_a"].status is Status.ESTIMATED for document in after)


@pytest.mark.parametrize(("first", "last"), often_rows([(1827, 2246)], [(1455, 1634), (1827, 2246)]))
def test_sequential_test_ends_after_dithered_repeats(
    scenario: MotorScenario, windows: Cut, first: int, last: int
) -> None:
    """Repeats with a small dither are not detected. The sequential test starts, and ends without adoption."""
    documents = run_with_repeats(scenario, windows, first, last, dither=1e-9)
    assert_no_false_estimate(documents)
    assert any(document.explanations for document in documents)
    after = documents[last // RECORDS + 3 :]
    assert {document.decision for document in after} == {WindowDecision.LEARNED}


def test_constant_records_are_not_estimated_from() -> None:
    """A window of exact zeros counts as one record. The reason gives the number of repeats."""
    state = initial_state("motor", "here", problem())
    for index in range(3):
        window = Window.whole(index, 2.0 * index, 0.01, TWIN.signals, np.zeros((RECORDS, 4)))
        state, report = adapt(state, window)
        resistance = report.document.parameters["R_a"]
        assert resistance.status is not Status.ESTIMATED
        assert "199 of 200 records repeat" in resistance.reason


@pytest.mark.parametrize("steps", [1.0, 3.0, 8.0])
def test_slow_coarse_signals_are_not_repeats(steps: float) -> None:
    """Dropping the repeats of a quantised ramp would keep the first record of each step, half a step too high."""
    ramp = np.rint(np.linspace(0.0, steps, RECORDS))
    values = np.column_stack([ramp, 0.0 * ramp, 2.0 * ramp, np.rint(0.3 * ramp)])
    assert not repeated_records(Window.whole(0, 0.0, 0.01, TWIN.signals, values), SENSORS).any()


@pytest.mark.parametrize("seed", range(4))
def test_rare_adc_flips_at_constant_speed_are_healthy(seed: int) -> None:
    """The speed is constant. One ADC step is four times the noise; 1 % of the records start a flip of one step."""
    random = np.random.default_rng(seed)
    state, documents = initial_state("motor", "here", problem()), []
    for index in range(16):
        values = np.tile([6.5 * CURRENT + 0.038 * SPEED, 0.0, CURRENT, SPEED], (RECORDS, 1))
        for column, count in ((2, 0.02), (3, 0.08)):
            flips = random.random(RECORDS) < 0.01
            values[:, column] += count * (flips | np.roll(flips, 1))
        state, report = adapt(state, Window.whole(index, 2.0 * index, 0.01, ("V_a", "T_load", "i", "omega"), values))
        documents.append(report.document)
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert documents[-1].parameters["R_a"].status is Status.ESTIMATED
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


@given(
    start=st.integers(0, 80), length=st.integers(1, 60), seed=st.integers(0, 2**16), channels=st.integers(1, 4)
)  # fmt: skip
def test_only_long_runs_in_all_channels_are_repeats(start: int, length: int, seed: int, channels: int) -> None:
    values = np.random.default_rng(seed).normal(size=(150, 4))
    values[start : start + length, :channels] = values[start, :channels]
    window = Window.whole(0, 0.0, 0.01, TWIN.signals, values)
    repeated = np.flatnonzero(repeated_records(window, SENSORS)).tolist()
    is_repeat = channels == 4 and length > MIN_REPEATED_RUN
    assert repeated == (list(range(start + 1, start + length - 1)) if is_repeat else [])
    counted, notes = drop_repeats(window, TWIN)
    assert bool(notes) == is_repeat
    assert np.flatnonzero(counted.missing_in("omega")).tolist() == repeated
    assert not counted.missing_in("V_a").any()
