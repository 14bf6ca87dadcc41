"""Sensors whose reading stays while what they measure moves: healthy they are not frozen, and frozen they are found."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.data_checks import check_window
from otolith.estimation.objective import converter_steps
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.estimation.sensor_models import SensorModel, is_driven_position, least_change, new_readings, shown_model
from otolith.machine import find_twin, library_twins, load_machine
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.messages import raises_saying

Cut = Callable[..., list[tuple[Window, float]]]

LIFT = """
[twin]
name = "lift"
title = "lift with a valve that has a dead zone"
source = "speed is proportional to the opening beyond the dead zone"
validity = "constant supply"

[states]
y = { unit = "mm", bounds = [-10, 5000], meaning = "position" }

[inputs]
u = { unit = "1", hold = "zoh", range = [-2, 2], meaning = "signal of the valve" }

[outputs]
y = { unit = "mm", noise = "0.15 mm", meaning = "position" }

[parameters]
k = { unit = "mm/s", nominal = 150, bounds = [10, 2000], role = "estimated", meaning = "speed per signal" }
dead = { unit = "1", nominal = 0.3, bounds = [0, 1], meaning = "dead zone of the valve" }

[equations]
"der(y)" = "k*(max(u - dead, 0) + min(u + dead, 0))"

[sites]
valve = { into = "der(y)", mode = "additive", unit = "mm/s", meaning = "speed by leakage" }
"""
MACHINE = """
[machine]
name = "lift"
[twin]
file = "lift.toml"
[window]
length = "20 s"
sample_period = "20 ms"
[process_noise]
y = "3 mm/s^0.5"
[discovery]
enabled = false
[driver]
type = "replay"
file = "data.csv"
[signals]
u = { column = "u", unit = "1" }
y = { column = "y", unit = "mm" KEYS }
"""
PERIOD, RECORDS, SPEED, DEAD_BAND = 0.02, 1000, 200.0, 1.0  # s, records per window, mm/s, mm


@cache
def lift_record(windows: int, frozen_from: float) -> Array:
    """Valve and reading of a lift that moves for 2 s of each 20 s, stands and sinks; its sensor has a dead band."""
    random, position, shown, reading = np.random.default_rng(2), 300.0, 300.0, []
    for index in range(windows * RECORDS):
        target = 300.0 + (max(index - 100, 0) // RECORDS % 4) * 400.0
        valve = float(np.clip(0.005 * (target - position), -1.5, 1.5))
        position += PERIOD * (SPEED * (max(valve - 0.3, 0.0) + min(valve + 0.3, 0.0)) - 0.3)
        if abs(position - shown) > DEAD_BAND and index * PERIOD < frozen_from:
            shown = position + 0.1 * random.normal()
        reading.append((valve, shown))
    return np.array(reading)


def lift(folder: Path, keys: str) -> Problem:
    (folder / "lift.toml").write_text(LIFT, encoding="utf-8")
    (folder / "data.csv").write_text("t,u,y\n0,0,0\n0.02,0,0\n", encoding="utf-8")
    (folder / "m.toml").write_text(MACHINE.replace("KEYS", keys), encoding="utf-8")
    return load_machine(folder / "m.toml", with_driver=False).problem


@pytest.mark.parametrize("keys", ["", ', dead_band = "1 mm"'], ids=["not stated", "stated"])
@pytest.mark.parametrize("frozen_from", [np.inf, 83.0], ids=["healthy", "frozen in a move"])
def test_a_standing_lift_with_a_dead_band_is_not_frozen_and_a_frozen_sensor_is(
    tmp_path: Path, keys: str, frozen_from: float
) -> None:
    values = lift_record(7, frozen_from)
    state, named = initial_state("lift", "here", lift(tmp_path, keys)), []
    for index in range(len(values) // RECORDS):
        part = values[index * RECORDS : (index + 1) * RECORDS]
        state, report = adapt(state, Window.whole(index, index * RECORDS * PERIOD, PERIOD, ("u", "y"), part))
        named.append(report.document.decision is WindowDecision.SENSOR)
    if np.isinf(frozen_from):
        assert not any(named)
        assert state.posterior.start()[0] == pytest.approx(SPEED, rel=0.05)
    else:
        assert not any(named[:4])
        assert all(named[4:])


ANGLE = 0.5  # rad between two edges


def from_edges(window: Window, *, frozen_from: int = 200) -> Window:
    """Return the window with the speed that a counter of edges has: of the latest edge, which stays until the next.

    Also where the motor stands; from ``frozen_from`` on the reading stays although it turns.
    """
    column = window.signals.index("omega")
    speed = window.values[:, column].copy()
    turned, shown, reading = 0.0, speed[0], []
    for index, value in enumerate(speed):
        turned += 0.01 * abs(value)
        if turned >= ANGLE and index < frozen_from:
            shown, turned = value, turned % ANGLE
        reading.append(shown)
    values = window.values.copy()
    values[:, column] = reading
    return replace(window, values=values)


def test_a_speed_from_edges_is_not_frozen_between_them_and_a_frozen_one_is(
    scenario: MotorScenario, windows: Cut
) -> None:
    twin = find_twin("dc_motor")
    free = tuple(each for each in twin.parameters if each.name == "R_a")
    known = tuple((each.name, each.nominal) for each in twin.parameters if each.name != "R_a")
    sensors = (("omega", SensorModel(renewed=ANGLE)),)
    problem = Problem(twin, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002), sensors=sensors)
    frozen = 0
    for window, _ in windows(scenario.model_copy(update={"faults": ()}), 16):
        predicted = Posterior.initial(problem).predict(window)
        assert check_window(from_edges(window), predicted).faulty_sensors == ()
        moves = np.ptp(window.column("omega")[20:]) > 2.0
        named = [sensor.signal for sensor in check_window(from_edges(window, frozen_from=20), predicted).faulty_sensors]
        assert named in ([], ["omega"])
        assert moves <= bool(named), "a motor whose speed changes shows that the reading does not"
        frozen += bool(named)
    assert frozen >= 4


def test_the_least_change_is_that_of_a_reading_that_stays() -> None:
    random = np.random.default_rng(1)
    noise = random.normal(size=400)
    assert least_change(noise, 1.0) == 0.0
    stands = np.concatenate([noise[:60], np.full(340, noise[60])])
    assert least_change(stands, 1.0) == 0.0, "the changes of a noisy sensor that froze are small ones, too"
    band = np.repeat(np.cumsum(5.0 + np.abs(random.normal(size=20))), 20)
    assert least_change(band, 1.0) == pytest.approx(np.diff(np.unique(band)).min())
    assert least_change(np.repeat([0.0, 9.0], 200), 1.0) == 0.0, "one jump is no property of a sensor"


def test_what_windows_show_of_a_sensor() -> None:
    """A dead band and the distance between edges are shown; noise, steps of a converter and a constant are neither."""

    def shown(values: Array, noise: float = 0.1) -> SensorModel:
        rows = np.column_stack([np.zeros(len(values)), values])
        return shown_model([Window.whole(0, 0.0, PERIOD, ("u", "y"), rows)], "y", noise)

    band = shown(lift_record(3, np.inf)[:, 1], 0.15)
    assert band.renewed == 0.0
    assert band.dead_band == pytest.approx(DEAD_BAND, abs=0.3)
    time = PERIOD * np.arange(2000)
    speed, turned, reading = 6.0 + 4.0 * np.sin(time), 0.0, []
    angle, latest, value = np.cumsum(speed) * PERIOD, 0.0, 6.0
    for now, position in zip(time, angle, strict=True):
        if position - turned >= 2.0:
            turned, value, latest = position, (position - turned) / (now - latest), now
        reading.append(value)
    edges = shown(np.array(reading))
    assert edges.dead_band == 0.0
    assert edges.renewed == pytest.approx(2.0, rel=0.1)
    random = np.random.default_rng(1)
    for healthy in (random.normal(size=2000), np.rint(speed), np.ones(2000), np.rint(4.0 * np.sin(0.1 * time)) / 4.0):
        assert shown(healthy) == SensorModel()


def test_a_reading_that_stays_counts_once() -> None:
    window = Window.whole(0, 0.0, 0.1, ("u", "y"), np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 2.0], [1.0, 2.0]]))
    counted = new_readings(window, frozenset({"y"}))
    assert counted.missing[:, 1].tolist() == [False, True, False, True]
    assert not counted.missing[:, 0].any()
    assert not new_readings(window, frozenset()).missing.any()


def test_which_states_of_the_library_are_driven_positions(tmp_path: Path) -> None:
    """A speed, a current or a pressure has a value of its own at rest; an axis with a state of speed has friction.

    The twist between two masses follows from their speeds, and no sensor measures it.
    """
    found = {(name, state.name) for name in library_twins() for twin in (find_twin(name),) for state in twin.states
             if is_driven_position(twin, state.name)}  # fmt: skip
    assert found == {("two_mass", "twist")}
    assert is_driven_position(lift(tmp_path, "").twin, "y")


@pytest.mark.parametrize(
    ("keys", "parts"),
    [
        (', dead_band = "1 V"', ("dead_band", "mm")),
        (', dead_band = "-1 mm"', ("dead_band", "-1")),
        (', renewed = "1 mm"', ("renewed",)),
    ],
)
def test_a_sensor_model_has_the_unit_of_its_signal(tmp_path: Path, keys: str, parts: tuple[str, ...]) -> None:
    with raises_saying(ConfigurationError, *parts):
        lift(tmp_path, keys)


def test_a_sensor_model_is_of_an_output(tmp_path: Path) -> None:
    (tmp_path / "lift.toml").write_text(LIFT, encoding="utf-8")
    text = MACHINE.replace("KEYS", "").replace('column = "u",', 'column = "u", dead_band = "0.1",')
    (tmp_path / "m.toml").write_text(text, encoding="utf-8")
    with raises_saying(ConfigurationError, "dead_band", "input"):
        load_machine(tmp_path / "m.toml", with_driver=False)


def test_a_stated_resolution_counts_beside_steps_that_were_learned_before_it_was_stated(tmp_path: Path) -> None:
    """The learned state has the step of one converter; then a person writes that of another into the machine file."""
    problem = load_machine(Path(__file__).parents[2] / "config/dc-motor.toml", with_driver=False).problem
    (first, second), seed = (output.name for output in problem.base_model.outputs), np.random.default_rng(1)
    window = Window.whole(0, 0.0, 0.01, (first, second), seed.standard_normal((100, 2)))
    learned = replace(problem, steps=(0.01, 0.0), sensors=((second, SensorModel(resolution=0.5)),))
    assert converter_steps(learned, window) == (0.01, 0.5)
