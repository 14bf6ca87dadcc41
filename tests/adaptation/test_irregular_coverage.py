"""Coverage at records of any times: 95 % intervals contain the truth, whatever samples are there."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, BridgeError, Quality, TimeGrid, Verdict, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.estimation.information import initial_prior
from otolith.estimation.objective import Objective
from otolith.estimation.problem import MAX_CHANGE, Problem, WindowOptions
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in TWIN.parameters}
NOISE = np.array([0.005, 0.02])  # A, rad/s
FINE, LENGTH = 1e-3, 2.0  # s
FREE = ("R_a", "D", "J")
HIDDEN = 0.03  # N*m
OFFSET = "sensor of T_load/constant"
PROBLEM = Problem(
    TWIN,
    known=tuple((name, value) for name, value in TRUTH.items() if name not in FREE),
    free=tuple(parameter for parameter in TWIN.parameters if parameter.name in FREE),
    noise=tuple(NOISE),
    window=WindowOptions(sample_period=0.01),
)
EXPECTED = np.array([parameter.nominal for parameter in PROBLEM.free])
GOOD = Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0)


def window(random: np.random.Generator, index: int, missing: float, hidden: float = 0.0, step: float = 0.01) -> Window:
    """Random voltage steps and a load that waves, in records at random times, ``step`` (s) apart on average.

    Outputs are ``missing`` at random, but not from the first record. The motor is simulated every millisecond, with a
    ``hidden`` load (N*m) that no input shows.
    """
    count = round(LENGTH / FINE)
    at = random.random(count) < FINE / step
    at[:: count // 4] = True
    rows = np.flatnonzero(at)
    wave = 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * FINE * np.arange(count))
    load = np.interp(np.arange(count), rows, wave[rows])
    inputs: Array = np.column_stack([np.repeat(random.uniform(4.0, 20.0, 4), count // 4), load])
    initial, parameters = random.uniform([0.5, 3.0], [2.0, 15.0]), np.array([list(TRUTH.values())])
    drive = Excitation.uniform(inputs + np.array([0.0, hidden]), FINE)
    outputs = kernel_of(TWIN).simulate(parameters, initial[None], drive)[0]
    absent = np.zeros((len(rows), 4), dtype=np.bool_)
    absent[1:, 2:] = random.random((len(rows) - 1, 2)) < missing
    measured = outputs[rows] + NOISE * random.normal(size=(len(rows), 2))
    values = np.column_stack([inputs[rows], measured])
    for column, lacking in enumerate(absent.T):  # any number: it is no measurement
        values[:, column] = np.interp(rows, rows[~lacking], values[~lacking, column])
    return Window(
        index,
        2.0 * index,
        TimeGrid.at(np.asarray(FINE * rows, dtype=np.float64), LENGTH),
        TWIN.signals,
        values,
        absent,
        GOOD,
    )


@pytest.mark.full
@pytest.mark.parametrize("missing", [0.0, 0.8])
def test_95_percent_intervals_cover_the_truth_at_random_times(missing: float) -> None:
    random, windows = np.random.default_rng(31), 600
    inside = np.zeros(len(FREE))
    for index in range(windows):
        record = window(random, index, missing)
        estimates = estimate(
            PROBLEM, record, initial_prior(PROBLEM), 1.1 * EXPECTED, SwarmSearch.IF_UNEXPLAINED
        ).parameters
        errors = np.array([parameter.value for parameter in estimates]) - EXPECTED
        inside += np.abs(errors) <= 1.959964 * np.array([parameter.sd for parameter in estimates])
    share = inside / windows
    assert ((share >= 0.93) & (share <= 0.97)).all(), share


def bridged(record: Window, held: float, at_record: float = 0.0, ratio: float = 1.0) -> Window:
    """The window with errors of its inputs, in units of their ranges."""
    size = np.concatenate([[driven.high - driven.low for driven in TWIN.inputs], np.zeros(2)])
    every = np.ones((record.records, 1))
    error = BridgeError(
        ratio * np.ones(record.values.shape),
        (at_record * every * size) ** 2,
        (held * every * size) ** 2,
        np.zeros(record.values.shape),
    )
    return Window(record.index, record.start, record.grid, record.signals, record.values, record.missing, GOOD, error)


def test_errors_of_bridged_inputs_are_process_noise() -> None:
    record = window(np.random.default_rng(32), 0, 0.5)
    exact, uncertain = Objective(PROBLEM, record, EXPECTED), Objective(PROBLEM, bridged(record, 1e-3), EXPECTED)
    assert not exact.innovation_model.gain.any()
    assert uncertain.innovation_model.gain.any()
    assert (uncertain.whitening[-1].diagonal() <= exact.whitening[-1].diagonal()).all()


def test_noise_of_bridged_inputs_follows_its_ratio() -> None:
    record = window(np.random.default_rng(33), 0, 0.0)
    noisy = replace(PROBLEM, input_noise=(0.1, 0.0))
    plain = Objective(noisy, record, EXPECTED).noise
    for ratio in (1.0, 4.0):
        model = Objective(noisy, bridged(record, 0.0, 0.0, ratio), EXPECTED).noise
        assert model.inputs == pytest.approx(plain.inputs)
        assert model.held_inputs == pytest.approx(np.sqrt(ratio) * plain.held_inputs)
    model = Objective(noisy, bridged(record, 1e-3, 2e-3), EXPECTED).noise
    reach = TWIN.inputs[0].high - TWIN.inputs[0].low
    assert model.held_inputs[:, 0] == pytest.approx(np.hypot(0.1, 1e-3 * reach))
    assert model.inputs[:, 0] == pytest.approx(np.hypot(0.1, 2e-3 * reach))


@pytest.mark.parametrize("step", [0.002, 0.01, 0.05])
def test_window_length_counts_nominal_records(step: float) -> None:
    """The next window is about as long in seconds, however many records came in this one."""
    state = initial_state("motor", "test", replace(PROBLEM, window=WindowOptions(200, 50, 1000, 0.01)))
    state, _ = adapt(state, window(np.random.default_rng(34), 0, 0.0, step=step))
    assert round(200 / MAX_CHANGE) <= state.records <= round(200 * MAX_CHANGE)


@pytest.mark.parametrize("missing", [0.0, 0.8])
def test_a_component_is_discovered_at_random_times(missing: float) -> None:
    """A load that no sensor shows begins between two windows; an offset of the load's sensor is ruled out."""
    trusted = replace(PROBLEM, discover=True, excluded=frozenset({OFFSET}))
    state, decisions = with_hidden_load(trusted, missing, windows=9)
    assert decisions == ["learned"] * 6 + ["suspected"] * 2 + ["discovered"]
    (adopted,) = state.adopted
    assert adopted.component.key == "shaft/constant"
    assert adopted.component.amplitude == pytest.approx(-HIDDEN, rel=0.01)


@pytest.mark.parametrize("missing", [0.0, 0.8])
def test_a_component_that_looks_like_an_offset_of_a_sensor_is_not_adopted(missing: float) -> None:
    """No window distinguishes a constant hidden load from an offset of the load's sensor."""
    state, decisions = with_hidden_load(replace(PROBLEM, discover=True), missing, windows=16)
    assert decisions == ["learned"] * 6 + ["suspected"] * 2 + ["ambiguous"] * 8
    assert state.test is not None
    members = [state.test.best, *(item for item, _ in state.test.alternatives(state.test.best))]
    assert {item.hypothesis.name for item in members} == {"shaft/constant", OFFSET}
    assert state.test.probabilities[:2] == pytest.approx([0.5, 0.5], abs=1e-6)


def with_hidden_load(problem: Problem, missing: float, windows: int) -> tuple[AdaptationState, list[str]]:
    """Return state and decisions after windows of which the first six have no hidden load."""
    random = np.random.default_rng(35)
    state = initial_state("motor", "test", problem)
    decisions = []
    for index in range(windows):
        state, report = adapt(state, window(random, index, missing, HIDDEN if index >= 6 else 0.0))
        decisions.append(report.document.decision.name.lower())
    return state, decisions
