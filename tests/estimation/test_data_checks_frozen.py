"""Frozen channels: what the prediction makes improbable is rejected, and what it may be wrong about is not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from otolith.acquisition.samples import Check
from otolith.acquisition.window import Array, TimeGrid, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.data_checks import check_window
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import estimate_window
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Step
from tests.variants import often

Cut = Callable[..., list[tuple[Window, float]]]

MOTOR, AXIS = find_twin("dc_motor"), find_twin("servo_axis")
SETS = (("R_a",), ("R_a", "D"), ("R_a", "D", "J"))
RECORDS, PERIOD = 200, 0.01
TRUE = {"R_a": 6.5, "D": 0.00143, "J": 0.001171}


def motor(*names: str, wrong: float = 1.0, unchecked: frozenset[tuple[str, Check]] = frozenset()) -> Problem:
    """Return the motor with free ``names``, whose nominal values are ``wrong`` times the true ones."""
    free = tuple(replace(each, nominal=wrong * each.nominal) for each in MOTOR.parameters if each.name in names)
    known = tuple((each.name, each.nominal) for each in MOTOR.parameters if each.name not in names)
    return Problem(MOTOR, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002), unchecked=unchecked)


@pytest.fixture
def record(scenario: MotorScenario, windows: Cut) -> list[Window]:
    return [window for window, _ in windows(scenario.model_copy(update={"faults": ()}), 24)]


def run(state: AdaptationState, windows: list[Window]) -> tuple[AdaptationState, list[WindowDecision]]:
    decisions = []
    for window in windows:
        state, report = adapt(state, window)
        decisions.append(report.document.decision)
    return state, decisions


def with_column(window: Window, signal: str, values: Array) -> Window:
    changed = window.values.copy()
    changed[:, window.signals.index(signal)] = values
    return replace(window, values=changed)


def rounded(window: Window, **steps: float) -> Window:
    for signal, step in steps.items():
        window = with_column(window, signal, np.rint(window.column(signal) / step) * step)
    return window


def frozen_from(window: Window, signal: str, first: int, last: int = RECORDS) -> Window:
    values = window.column(signal).copy()
    values[first:last] = values[first]
    return with_column(window, signal, values)


def faults(problem: Problem, window: Window, state: AdaptationState | None = None) -> tuple[str, ...]:
    posterior = Posterior.initial(problem) if state is None else state.posterior
    return tuple(
        f"{sensor.text}; {sensor.setting}" for sensor in check_window(window, posterior.predict(window)).faulty_sensors
    )


@pytest.mark.parametrize("wrong", [0.5, 1.5])
def test_wrong_start_rejects_no_healthy_window(record: list[Window], wrong: float) -> None:
    """Coarse sensors repeat their values while the twin with wrong parameters moves."""
    coarse = [rounded(window, i=0.01, omega=0.1) for window in record[:12]]
    state, decisions = run(initial_state("motor", "here", motor("R_a", "J", wrong=wrong)), coarse)
    assert set(decisions) == {WindowDecision.LEARNED}
    for free, value in zip(state.problem.free, state.posterior.start(), strict=True):
        assert value == pytest.approx(TRUE[free.name], rel=0.02)


@pytest.mark.parametrize("step", [0.2, 0.4])
def test_steps_of_a_sensor_are_shown_by_two_levels(record: list[Window], step: float) -> None:
    """Speeds of two or three levels, while the twin moves by many standard deviations of the noise between them."""
    for window in record[1:20]:
        coarse = rounded(window, omega=step)
        if 1 < len(np.unique(coarse.column("omega"))) < 4:
            assert faults(motor("R_a", "D"), coarse) == ()


@pytest.mark.parametrize("names", often([SETS[0], SETS[-1]], SETS), ids="-".join)
@pytest.mark.parametrize("signal", ["i", "omega"])
@pytest.mark.parametrize("first", often([0, 120], [0, 60, 120]))
def test_frozen_sensor_is_detected_in_its_first_moving_window(
    record: list[Window], names: tuple[str, ...], signal: str, first: int
) -> None:
    state, _ = run(initial_state("motor", "here", motor(*names)), record[:10])
    (sentence,) = faults(state.problem, frozen_from(record[10], signal, first), state)
    assert sentence.startswith(f"{signal} is ")


@pytest.mark.parametrize("signal", ["i", "omega"])
@pytest.mark.parametrize("first", [0, 60, 120])
def test_frozen_sensor_is_detected_at_a_cold_start(record: list[Window], signal: str, first: int) -> None:
    (sentence,) = faults(motor("R_a"), frozen_from(record[10], signal, first))
    assert sentence.startswith(f"{signal} is ")


def test_finding_names_value_time_length_and_way_out(record: list[Window]) -> None:
    window = frozen_from(record[10], "omega", 50, 150)
    (sentence,) = faults(motor("R_a"), window)
    assert f"omega is frozen at {window.column('omega')[50]:.6g} rad/s for 0.99 s (100 samples)" in sentence
    assert f"from t = {window.start + 0.5:.4g} s" in sentence
    assert 'checks = ["spikes", "stale"]' in sentence


@pytest.mark.parametrize("other", ["i", "omega"])
def test_check_is_turned_off_for_one_signal(record: list[Window], other: str) -> None:
    window = frozen_from(record[10], "omega", 50)
    off = motor("R_a", unchecked=frozenset({(other, Check.FROZEN), ("omega", Check.STALE), ("omega", Check.SPIKES)}))
    assert bool(faults(off, window)) == (other == "i")


@pytest.mark.parametrize("kept", [2, 5])
def test_run_is_counted_over_present_samples(record: list[Window], kept: int) -> None:
    """Every second or fifth record has a sample; the values between are none, whatever they are."""
    absent = np.arange(RECORDS) % kept != 0
    for window, is_frozen in ((record[10], False), (frozen_from(record[10], "omega", 50), True)):
        column = window.signals.index("omega")
        missing, values = window.missing.copy(), window.values.copy()
        missing[:, column], values[absent, column] = absent, 7.0
        sparse = replace(window, missing=missing, values=values)
        assert bool(faults(motor("R_a"), sparse)) == is_frozen


def test_frozen_sensor_is_detected_at_times_of_its_own(record: list[Window]) -> None:
    random = np.random.default_rng(3)
    kept = np.sort(random.choice(np.arange(1, RECORDS), 140, replace=False))
    kept = np.concatenate([[0], kept])
    for window, is_frozen in ((record[10], False), (frozen_from(record[10], "i", 50), True)):
        grid = TimeGrid.at(PERIOD * kept, PERIOD * RECORDS)
        irregular = replace(window, values=window.values[kept], missing=window.missing[kept], grid=grid)
        assert bool(faults(motor("R_a"), irregular)) == is_frozen


MASS, VISCOUS, DRY, STICTION = 95.0, 200.0, 20.0, 30.0  # kg, N*s/m, N, N
RADIUS = 0.02  # m of the pulley on which the encoder sits


@cache
def axis_record(forces: str) -> Array:
    """Force (N) and position (m) of an axis that sticks, over 40 s; columns F, x."""
    count, fine = 4000, 20
    time = PERIOD * np.arange(count)
    amplitude = np.where(time % 20.0 < 12.0, 60.0, 28.0)  # the smaller one moves nothing
    phase = 2.0 * np.pi * time / 5.0
    force = amplitude * (np.sin(phase) if forces == "sine" else np.sign(np.sin(phase)))
    position, velocity, positions = 0.0, 0.0, []
    for drive in force.tolist():
        positions.append(position)
        for _ in range(fine):
            if velocity == 0.0 and abs(drive) <= STICTION:
                break
            direction = np.sign(velocity) if velocity else np.sign(drive)
            following = velocity + PERIOD / fine * (drive - VISCOUS * velocity - DRY * direction) / MASS
            following = 0.0 if following * velocity < 0.0 else following
            position += 0.5 * PERIOD / fine * (velocity + following)
            velocity = following
    return np.column_stack([force, positions])


def axis(noise: float, *, friction: bool) -> Problem:
    """Return the axis, whose twin has the dry friction or lacks it."""
    known = {"v_s": 0.002} | ({} if friction else {"F_c": 0.0})
    free = tuple(each for each in AXIS.parameters if each.name not in known)
    return Problem(AXIS, tuple(known.items()), free, (noise,))


@pytest.mark.parametrize("friction", [True, False], ids=["friction in the twin", "not in the twin"])
@pytest.mark.parametrize("steps", often([64, 4096], [64, 512, 4096]))
@pytest.mark.parametrize("stated", [0.29, pytest.param(0.5, marks=pytest.mark.full)])
@pytest.mark.parametrize("forces", often(["square"], ["sine", "square"]))
def test_stuck_axis_with_coarse_encoder_is_not_frozen(forces: str, stated: float, steps: int, friction: bool) -> None:
    """``stated`` is the noise of the machine file in steps of the encoder."""
    step = 2.0 * np.pi * RADIUS / steps
    values = axis_record(forces).copy()
    values[:, 1] = np.rint(values[:, 1] / step) * step
    posterior = Posterior.initial(axis(stated * step, friction=friction))
    at_rest = 0
    for index in range(len(values) // RECORDS):
        part = values[index * RECORDS : (index + 1) * RECORDS]
        window = Window.whole(index, index * RECORDS * PERIOD, PERIOD, ("F", "x"), part)
        predicted = posterior.predict(window)
        assert check_window(window, predicted).faulty_sensors == ()
        estimated = estimate_window(predicted, window)
        posterior = predicted.update(predicted.innovation(estimated.evidence), estimated.advance)
        at_rest += np.mean(np.diff(part[:, 1]) == 0.0) > 0.9
    assert at_rest >= 4


def test_noisy_position_that_stops_dead_is_frozen() -> None:
    """Noise of many steps shows at rest as well, so a constant value is no axis at rest."""
    values = axis_record("sine").copy()
    values[:, 1] += 1e-4 * np.random.default_rng(5).normal(size=len(values))
    window = Window.whole(0, 0.0, PERIOD, ("F", "x"), values[:RECORDS])
    posterior = Posterior.initial(axis(1e-4, friction=True))
    assert check_window(window, posterior.predict(window)).faulty_sensors == ()
    estimated = estimate_window(posterior.predict(window), window)
    predicted = posterior.predict(window)
    posterior = predicted.update(predicted.innovation(estimated.evidence), estimated.advance)
    moving = replace(window, index=1, start=2.0, values=values[RECORDS : 2 * RECORDS])
    (sensor,) = check_window(frozen_from(moving, "x", 80), posterior.predict(moving)).faulty_sensors
    assert sensor.signal == "x"
    assert sensor.text.startswith("x is ")


def test_window_of_a_frozen_sensor_leaves_an_open_test_open(scenario: MotorScenario, windows: Cut) -> None:
    """Data that are not used are no evidence: the step that the window before shows is accepted after the next one."""
    fault = Step.model_validate({"kind": "step", "parameter": "R_a", "start": "20 s", "amount": "-0.65 ohm"})
    record = [window for window, _ in windows(scenario.model_copy(update={"faults": (fault,)}), 14)]
    suspected, decisions = run(initial_state("motor", "here", motor("R_a", "D")), record[:11])
    assert decisions[-1] is WindowDecision.SUSPECTED
    rejected, (decision,) = run(suspected, [frozen_from(record[11], "i", 0)])
    assert decision is WindowDecision.SENSOR
    assert rejected.test is suspected.test is not None
    after, decisions = run(rejected, record[12:])
    assert WindowDecision.STEPPED in decisions
    assert after.posterior.start()[0] == pytest.approx(5.85, rel=0.005)
