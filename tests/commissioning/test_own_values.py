"""Values of a motor that is far from the twin's example, from its healthy record."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.commissioning.own_values import OwnValue, OwnValues, own_values
from otolith.estimation.problem import Problem
from otolith.estimation.timing import shifted
from otolith.machine import find_twin
from otolith.twin.definition import Definition, Role
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from otolith_drivers.plant.dc_motor import MotorScenario

Cut = Callable[..., list[tuple[Window, float]]]
TRUE = {"R_a": 2.1, "L_a": 0.12, "J": 4e-4, "K_e": 0.11, "K_t": 0.11, "D": 6e-4}  # the example has 6.5, 0.673, ...
UNITS = {"R_a": "ohm", "L_a": "H", "J": "kg*m^2", "K_e": "V*s/rad", "K_t": "N*m/A", "D": "N*m*s/rad"}


@pytest.fixture
def motor(scenario: MotorScenario) -> MotorScenario:
    """A motor that speeds up and reverses every two seconds."""
    speeds = (20.0, 60.0, -30.0, 80.0)
    points = [{"at": f"{2 * place} s", "speed": f"{speed} rad/s"} for place, speed in enumerate(speeds)]
    parameters = {name: f"{value} {UNITS[name]}" for name, value in TRUE.items()}
    return MotorScenario.model_validate(
        {
            "plant": "dc_motor",
            "seed": 3,
            "dbc": scenario.dbc,
            "sample_period": "10 ms",
            "parameters": parameters,
            "load": "0 N*m*s/rad",
            "controller": {"K_p": "0.15 V*s/rad", "K_i": "0.4 V/rad"},
            "set_points": points,
            "repeat_every": "8 s",
            "noise": {"current": "5 mA", "speed": "0.1 rad/s"},
        }
    )


def found(twin: Definition, windows: list[Window], loads: set[str]) -> OwnValues:
    free = tuple(row for row in twin.parameters if row.role is Role.ESTIMATED)
    known = tuple((row.name, row.nominal) for row in twin.parameters if row.role is not Role.ESTIMATED)
    problem = Problem(twin, known, free, tuple(output.noise for output in twin.outputs))
    return own_values(problem, windows, twin.parameters, loads, lambda _: None)


def by_name(values: OwnValues) -> dict[str, OwnValue]:
    return {item.name: item for item in values.values}


def assert_true(rows: dict[str, OwnValue], names: set[str]) -> None:
    for name in names:
        assert rows[name].value == pytest.approx(TRUE[name], rel=0.05), name
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - TRUE[name]) < 4.0 * sd, name


def test_a_motor_far_from_the_example_is_found(motor: MotorScenario, windows: Cut) -> None:
    values = found(find_twin("dc_motor"), [window for window, _ in windows(motor, 8)], set())
    assert values.is_followed
    assert_true(by_name(values), set(TRUE) - {"K_t"})  # no torque moves the shaft that would be known in its unit


def test_without_the_load_the_torque_constant_is_that_of_the_voltage(motor: MotorScenario, windows: Cut) -> None:
    """Current and speed show torque constant, inertia, friction and load in proportion only."""
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT))
    values = found(twin, [window for window, _ in windows(motor, 8)], {"T_load"})
    rows = by_name(values)
    assert_true(rows, set(TRUE) - {"K_t"})
    assert (rows["K_t"].sd, rows["K_t"].is_taken) == (None, True)
    assert rows["K_t"].value == rows["K_e"].value
    assert "T_load" not in rows
    assert max(map(abs, values.loads["T_load"])) < 1e-3


def test_what_the_data_do_not_show_stays_as_it_was(motor: MotorScenario, windows: Cut) -> None:
    """A motor that turns at one speed shows neither inertia nor inductance."""
    steady = motor.model_copy(update={"set_points": motor.set_points[:1], "repeat_every": None})
    cut = [window for window, _ in windows(steady, 10)][4:]
    rows = by_name(found(find_twin("dc_motor"), cut, set()))
    assert (rows["J"].value, rows["J"].sd) == (find_twin("dc_motor").parameter("J").nominal, None)
    assert rows["J"].remark


def test_a_machine_of_another_kind_is_not_described(motor: MotorScenario, windows: Cut) -> None:
    cut = []
    for window, _ in windows(motor, 8):
        values = window.values.copy()
        values[:, 3] = np.roll(values[:, 3], 90)  # a speed that has nothing to do with voltage and current
        cut.append(replace(window, values=values))
    assert not found(find_twin("dc_motor"), cut, set()).is_followed


def test_without_a_window_nothing_is_found() -> None:
    values = found(find_twin("dc_motor"), [], set())
    assert not values.is_followed
    assert values.values == ()


@pytest.mark.parametrize(
    "late",
    [{"omega": 0.01}, *(pytest.param(each, marks=pytest.mark.full) for each in ({"i": 0.02}, {"omega": 0.017}, {}))],
    ids=lambda late: "".join(late) or "none",
)
def test_a_signal_that_is_late_does_not_bias_the_values(
    motor: MotorScenario, windows: Cut, late: dict[str, float]
) -> None:
    whole = find_twin("dc_motor")
    twin = without_sensor(whole, UnmeasuredInput("T_load", Assumption.CONSTANT))
    early = {name: -delay for name, delay in late.items()}
    recorded = [shifted(whole, window, early) for window, _ in windows(motor, 8)]
    rows = by_name(found(twin, recorded, {"T_load"}))
    for name in set(TRUE) - {"K_t"}:
        assert rows[name].value == pytest.approx(TRUE[name], rel=0.03), name
