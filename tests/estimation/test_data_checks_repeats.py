"""An old image, sent again, is no new measurement: it teaches little, and nothing wrong."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.decision import WindowDecision
from otolith.estimation.data_checks import MIN_REPEATED_RUN, drop_repeats, repeated_records
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario

Cut = Callable[..., list[tuple[Window, float]]]

TWIN = find_twin("dc_motor")
RECORDS, WINDOWS = 200, 18
SENSORS = np.isin(TWIN.signals, ["i", "omega"])
SPEED = 15.0  # rad/s
CURRENT = 0.00143 * SPEED / 0.038  # A
# Records: within a window, over two, over three; while the machine hardly moves, and over a change of the set-point.
OLD = [(1455, 1634), (1681, 2161), (1827, 2246), (1979, 2560), (1400, 1800)]


def problem() -> Problem:
    free = tuple(entry for entry in TWIN.parameters if entry.name == "R_a")
    known = tuple((entry.name, entry.nominal) for entry in TWIN.parameters if entry.name != "R_a")
    return Problem(TWIN, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))


def of(whole: Window, index: int, values: np.ndarray) -> Window:
    part = values[index * RECORDS : (index + 1) * RECORDS]
    return Window.whole(index, whole.start + index * RECORDS * 0.01, 0.01, whole.signals, part)


def lived(scenario: MotorScenario, windows: Cut, first: int, last: int, dither: float = 0.0) -> list[ReportDocument]:
    record = [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), WINDOWS)]
    values = np.vstack([window.values for window in record])
    noise = dither * np.random.default_rng(1).normal(size=(last - first, values.shape[1]))
    values[first:last] = values[first] + noise
    state, documents = initial_state("motor", "here", problem()), []
    for index in range(WINDOWS):
        state, report = adapt(state, of(record[0], index, values))
        documents.append(report.document)
    return documents


def teaches_nothing_wrong(documents: list[ReportDocument]) -> None:
    for document in documents:
        found = document.parameters["R_a"]
        assert not document.components
        assert document.decision is not WindowDecision.STEPPED
        assert found.value is None or found.value == pytest.approx(6.5, rel=0.005)


@pytest.mark.parametrize(("first", "last"), OLD)
def test_an_old_image_is_forgotten_with_the_first_new_window(
    scenario: MotorScenario, windows: Cut, first: int, last: int
) -> None:
    documents = lived(scenario, windows, first, last)
    teaches_nothing_wrong(documents)
    after = documents[last // RECORDS + 1 :]
    assert {document.decision for document in after} == {WindowDecision.LEARNED}
    assert all(document.parameters["R_a"].status is Status.ESTIMATED for document in after)


@pytest.mark.parametrize(("first", "last"), [(1455, 1634), (1827, 2246)])
def test_an_explanation_that_comes_to_nothing_is_dropped(
    scenario: MotorScenario, windows: Cut, first: int, last: int
) -> None:
    """The same images with a dither, so that they pass for measurements: a case is opened, and ends by itself."""
    documents = lived(scenario, windows, first, last, dither=1e-9)
    teaches_nothing_wrong(documents)
    assert any(document.decision is WindowDecision.SUSPECTED for document in documents)
    after = documents[last // RECORDS + 3 :]
    assert {document.decision for document in after} == {WindowDecision.LEARNED}


def test_a_machine_that_only_repeats_itself_is_not_estimated_from_each_repetition() -> None:
    """Digital zeros at rest: one record, whatever their number; said, and no reason to stop."""
    state = initial_state("motor", "here", problem())
    for index in range(3):
        window = Window.whole(index, 2.0 * index, 0.01, TWIN.signals, np.zeros((RECORDS, 4)))
        state, report = adapt(state, window)
        found = report.document.parameters["R_a"]
        assert found.status is not Status.ESTIMATED
        assert "198 of 200 records repeat" in found.reason


@pytest.mark.parametrize("steps", [1.0, 3.0, 8.0])
def test_coarse_sensors_that_move_slowly_count_with_every_record(steps: float) -> None:
    """Of a ramp in steps the first record of each is half a step ahead, so that these alone would be off."""
    ramp = np.rint(np.linspace(0.0, steps, RECORDS))
    values = np.column_stack([ramp, 0.0 * ramp, 2.0 * ramp, np.rint(0.3 * ramp)])
    assert not repeated_records(Window.whole(0, 0.0, 0.01, TWIN.signals, values), SENSORS).any()


@pytest.mark.parametrize("seed", range(4))
def test_a_quiet_machine_whose_converters_flip_now_and_then_is_healthy(seed: int) -> None:
    """At constant speed; one count of the converters is four times the noise, and seldom another."""
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
def test_long_runs_in_all_channels_are_repeats_and_nothing_else_is(
    start: int, length: int, seed: int, channels: int
) -> None:
    values = np.random.default_rng(seed).normal(size=(150, 4))
    values[start : start + length, :channels] = values[start, :channels]
    window = Window.whole(0, 0.0, 0.01, TWIN.signals, values)
    found = np.flatnonzero(repeated_records(window, SENSORS)).tolist()
    long = channels == 4 and length > MIN_REPEATED_RUN
    assert found == (list(range(start + 1, start + length - 1)) if long else [])
    counted, notes = drop_repeats(window, TWIN)
    assert bool(notes) == long
    assert np.flatnonzero(counted.missing_in("omega")).tolist() == found
    assert not counted.missing_in("V_a").any()
