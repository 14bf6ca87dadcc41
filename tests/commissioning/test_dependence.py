"""Values that are only as right as another one, which the data do not determine: that is part of the result."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.linalg import expm

from otolith.acquisition.window import Window
from otolith.commissioning.dependence import MATERIAL, TOLERANCE, dependences, is_count
from otolith.commissioning.own_values import own_values
from otolith.commissioning.value_search import OwnValue
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith.twin.definition import Definition, Role
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from tests.variants import often

EXAMPLE = {"R_a": 6.5, "L_a": 0.673, "J": 1.171e-3, "K_e": 0.038, "K_t": 0.038, "D": 1.43e-3}


def slow_motor(seed: int, count: int = 6) -> tuple[dict[str, float], list[Window]]:
    """Return a motor that is not the example, and windows in which its speed hardly varies; integrated here."""
    draw, rng = np.random.default_rng(1000 + seed), np.random.default_rng(seed)
    true = {name: value * float(np.exp(draw.uniform(-0.6, 0.6))) for name, value in EXAMPLE.items()}
    true["K_t"] = true["K_e"]  # one constant in SI units
    a = np.array([
        [-true["R_a"] / true["L_a"], -true["K_e"] / true["L_a"]], [true["K_t"] / true["J"], -true["D"] / true["J"]]
    ])  # fmt: skip
    b = np.array([1.0 / true["L_a"], 0.0])
    transition = expm(0.01 * a)
    driven = np.linalg.solve(a, (transition - np.eye(2)) @ b)
    speed, swing = draw.uniform(8.0, 40.0), draw.uniform(0.3, 2.0)
    speeds = np.repeat(speed + swing * rng.uniform(-1.0, 1.0, 2 * count), 100)
    voltages = (true["R_a"] * true["D"] / true["K_t"] + true["K_e"]) * speeds
    state, rows = -np.linalg.solve(a, b * voltages[0]), []
    for voltage in voltages:
        rows.append([voltage, 0.0, *(state + rng.normal(0.0, [5e-3, 0.02]))])
        state = transition @ state + driven * voltage
    values = np.array(rows)
    names = ("V_a", "T_load", "i", "omega")
    return true, [Window.whole(at, 2.0 * at, 0.01, names, values[200 * at : 200 * (at + 1)]) for at in range(count)]


def commissioned(
    twin: Definition, windows: list[Window], loads: set[str], stated: Mapping[str, float]
) -> dict[str, OwnValue]:
    """Return the values of a machine whose file states some of them; none where the record contradicts them."""
    rows = [row for row in twin.parameters if row.name not in stated]
    free = tuple(row for row in rows if row.role is Role.ESTIMATED)
    known = tuple((row.name, row.nominal) for row in rows if row.role is not Role.ESTIMATED)
    problem = Problem(twin, (*known, *stated.items()), free, tuple(output.noise for output in twin.outputs))
    searched = [row for row in rows if row.part or row.role is Role.ESTIMATED]
    found = own_values(problem, windows, searched, loads, lambda _: None, stated=stated)
    return {} if found.faults else {item.name: item for item in found.values}


@pytest.mark.parametrize("seeds", often([range(4, 6)], [range(4, 6), range(20)]), ids=str)
def test_a_value_of_a_slow_motor_is_right_or_its_result_says_with_what(seeds: range) -> None:
    """The speed hardly varies, so resistance and voltage constant act alike, and the constant stays the example's."""
    twin, honest = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT)), []
    for seed in seeds:
        true, windows = slow_motor(seed)
        for name, row in commissioned(twin, windows, {"T_load"}, {}).items():
            if row.sd is not None:
                is_inside = abs(row.value - true[name]) <= QUANTILE * row.sd
                honest.append(is_inside or bool(row.only_with))
                for other in row.only_with:  # to first order, what the error of the held value does
                    error = 1.0 - true[other.name] / other.value
                    assert row.value * (1.0 - other.share * error) == pytest.approx(true[name], rel=0.05), (seed, name)
    assert len(honest) >= 0.9 * len(seeds)
    assert np.mean(honest) >= 0.93


def test_a_value_depends_on_one_that_the_file_states_as_on_one_of_the_example() -> None:
    """It may come from a data sheet, whose tolerance moves the resistance out of its interval."""
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT))
    true, windows = slow_motor(4)
    stated = {name: true[name] for name in ("K_e", "K_t", "L_a")}
    row = commissioned(twin, windows, {"T_load"}, stated)["R_a"]
    assert row.sd is not None
    assert abs(row.value - true["R_a"]) < 4.0 * row.sd
    assert [other.name for other in row.only_with] == ["K_e"]
    assert row.only_with[0].value == true["K_e"]


def test_what_the_speeds_of_a_fan_do_not_tell_apart_is_said() -> None:
    """At one speed, dry friction is only as right as the torque of the air; and so of any twin."""
    rng, true = np.random.default_rng(3), {"k_air": 9e-4, "T_c": 0.35, "J": 0.12}
    speed, rows = 45.0, []
    torques = np.repeat(true["T_c"] + true["k_air"] * (speed + rng.uniform(-1.0, 1.0, 24)) ** 2, 100)
    for torque in torques:
        rows.append([torque, speed + rng.normal(0.0, 0.2)])
        for _ in range(10):
            speed += 5e-3 * (torque - true["T_c"] - true["k_air"] * speed**2) / true["J"]
    values = np.array(rows)
    windows = [
        Window.whole(at, 20.0 * at, 0.05, ("T_m", "omega"), values[400 * at : 400 * (at + 1)]) for at in range(6)
    ]
    found = commissioned(find_twin("fan"), windows, set(), {})
    determined = {name: row for name, row in found.items() if row.sd is not None}
    for name, row in determined.items():
        assert abs(row.value - true[name]) <= QUANTILE * (row.sd or 0.0) or row.only_with, name
    held = {other.name for row in determined.values() for other in row.only_with}
    assert held <= found.keys() - determined.keys()
    assert held


@pytest.mark.parametrize(
    ("share", "half", "is_stated", "depends", "wider"),
    [
        (2.0 * MATERIAL, 0.01, False, True, 0.0),  # of another machine
        (0.5 * MATERIAL, 0.01, False, False, 0.5 * MATERIAL),  # a slight effect, even if all of it is wrong
        (2.0 * MATERIAL, 0.01, True, True, 0.0),  # a usual tolerance moves it out of its interval
        (2.0 * MATERIAL, 2.0 * MATERIAL * TOLERANCE, True, False, 0.0),  # the interval holds it
        (0.5 * MATERIAL, 0.0, True, False, 0.0),
    ],
)
def test_a_dependence_is_stated_or_added_to_the_interval(
    share: float, half: float, is_stated: bool, depends: bool, wider: float
) -> None:
    size, held = 5.0, {"K": -3.0}
    moved = {"K": share * size / 3.0}
    found, added = dependences(size, half * size, moved, held, frozenset(held if is_stated else ()))
    assert [(row.name, row.value) for row in found] == ([("K", -3.0)] if depends else [])
    assert [abs(row.share) for row in found] == pytest.approx([share] if depends else [])
    assert added == pytest.approx(wider * size)


@pytest.mark.parametrize(
    ("twin", "name", "value", "expected"),
    [("induction_motor", "n_p", 2.0, True), ("induction_motor", "n_p", 2.5, False), ("dc_motor", "R_a", 6.0, False)],
)
def test_a_number_of_pole_pairs_that_is_stated_has_no_tolerance(
    twin: str, name: str, value: float, expected: bool
) -> None:
    assert is_count(find_twin(twin).parameter(name), value) is expected
