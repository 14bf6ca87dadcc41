"""Values of a motor that is far from the twin's example, from its healthy record."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import combinations, islice
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from otolith.acquisition.playback import Playback
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, Window
from otolith.commissioning.own_values import own_values, widened
from otolith.commissioning.value_search import OwnValue, OwnValues, ValueSearch, are_one_constant
from otolith.estimation.problem import Problem
from otolith.estimation.timing import shifted
from otolith.machine import find_twin, library_twins
from otolith.twin.definition import Definition, Role
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from otolith_drivers.base import Sampling
from otolith_drivers.plant.dc_motor import MotorScenario, simulate
from otolith_drivers.plant.faults import Unbalance
from otolith_drivers.replay.readers import Rows
from tests.variants import often

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
    searched = [row for row in twin.parameters if row.part or row.role is Role.ESTIMATED]  # as commissioning does
    values = own_values(problem, windows, searched, loads, lambda _: None)
    held = {item.name: item.value for item in values.values if item.sd is None}
    assert held == {name: twin.parameter(name).nominal for name in held}  # which the machine file keeps
    return values


def by_name(values: OwnValues) -> dict[str, OwnValue]:
    return {item.name: item for item in values.values}


def assert_true(rows: dict[str, OwnValue], names: set[str], true: Mapping[str, float] = TRUE) -> None:
    for name in names:
        assert rows[name].value == pytest.approx(true[name], rel=0.05), name
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - true[name]) < 4.0 * sd, name


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
    assert rows["K_t"].is_taken
    assert (rows["K_t"].value, rows["K_t"].sd) == (rows["K_e"].value, rows["K_e"].sd)
    assert "T_load" not in rows
    assert max(map(abs, values.loads["T_load"])) < 1e-3


@pytest.mark.parametrize("load", [0.0, 6e-3])
def test_a_load_without_dry_friction_is_found_to_have_none(motor: MotorScenario, windows: Cut, load: float) -> None:
    """Zero is as well determined as any value: the example's dry friction, held, would bias the viscous one."""
    loaded = motor.model_copy(update={"load": load})
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.FRICTION))
    values = found(twin, [window for window, _ in windows(loaded, 8)], set())
    rows = by_name(values)
    assert values.is_followed
    assert not values.faults
    for name, truth in (("T_load_dry", 0.0), ("D", TRUE["D"] + load)):
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - truth) < 4.0 * sd, name


def test_what_the_data_do_not_show_stays_as_it_was(motor: MotorScenario, windows: Cut) -> None:
    """A motor that turns at one speed shows neither inertia nor inductance."""
    steady = motor.model_copy(update={"set_points": motor.set_points[:1], "repeat_every": None})
    cut = [window for window, _ in windows(steady, 10)][4:]
    rows = by_name(found(find_twin("dc_motor"), cut, set()))
    assert (rows["J"].value, rows["J"].sd) == (find_twin("dc_motor").parameter("J").nominal, None)
    assert rows["J"].remark


def test_a_search_that_begins_elsewhere_holds_parameters_at_the_example(motor: MotorScenario, windows: Cut) -> None:
    """As the second one does, beside components: the machine file keeps the example's value, the others must fit it."""
    steady = motor.model_copy(update={"set_points": motor.set_points[:1], "repeat_every": None})
    cut, twin = [window for window, _ in windows(steady, 10)][4:], find_twin("dc_motor")
    problem = Problem(twin, (), tuple(map(widened, twin.parameters)), tuple(output.noise for output in twin.outputs))
    values = ValueSearch(problem, cut, frozenset(), lambda _: None, TRUE).run()
    held = by_name(values)["J"]
    assert (held.value, held.sd) == (twin.parameter("J").nominal, None)


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


PAPER = {"R_a": 6.5, "L_a": 0.673, "J": 1.171e-3, "K_e": 0.038, "K_t": 0.038, "D": 1.43e-3}


@pytest.mark.parametrize(
    ("of", "source", "own"),
    [
        ({"frequency": "10 rad/s"}, "t", TRUE),
        *(
            pytest.param(*row, marks=pytest.mark.full)
            for row in (({"order": 1.0}, "angle(omega)", TRUE), ({"frequency": "10 rad/s"}, "t", PAPER))
        ),
    ],
    ids=["frequency", "order", "the motor of the paper"],
)
def test_an_unbalance_in_the_record_does_not_bias_the_values(
    of: dict[str, Any], source: str, own: dict[str, float], motor: MotorScenario, windows: Cut
) -> None:
    shape = {"kind": "unbalance", "start": "0 s", "acceleration": "40 rad/s^2"}
    fault = Unbalance.model_validate(shape | of)
    parameters = motor.parameters.model_copy(update=own)
    shaken = motor.model_copy(update={"faults": (fault,), "parameters": parameters})
    values = found(find_twin("dc_motor"), [window for window, _ in windows(shaken, 8)], set())
    rows = by_name(values)
    assert values.faults == ()
    assert values.beside == (f"shaft/periodic/{source}",)
    for name in ("R_a", "L_a", "J", "K_e", "D"):
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - own[name]) < min(4.0 * sd, 0.05 * own[name]), name


@pytest.mark.parametrize("load", often([0.0], [0.0, 6e-3]))
def test_a_load_without_dry_friction_is_found_to_have_none_beside_an_unbalance(
    motor: MotorScenario, windows: Cut, load: float
) -> None:
    """Values are fitted twice; the second fit begins at those of the first, but its sizes are those of the example."""
    shape = {"kind": "unbalance", "start": "0 s", "acceleration": "40 rad/s^2", "frequency": "10 rad/s"}
    shaken = motor.model_copy(update={"load": load, "faults": (Unbalance.model_validate(shape),)})
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.FRICTION))
    values = found(twin, [window for window, _ in windows(shaken, 8)], set())
    rows = by_name(values)
    assert values.beside == ("shaft/periodic/t",)
    assert not values.faults
    for name, truth in (("T_load_dry", 0.0), ("D", TRUE["D"] + load)):
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - truth) < 4.0 * sd, name


def polled(scenario: MotorScenario, seed: int) -> list[Window]:
    """Windows of 4 s of a drive whose registers are rounded and renewed each 10 ms, and read each 20 ms."""
    random, twin = np.random.default_rng(seed), find_twin("dc_motor")
    samples = [sample.measured for sample in islice(simulate(scenario.model_copy(update={"seed": seed})), 12_500)]
    times = 0.02 * np.arange(6000) + 0.005 + np.abs(random.normal(0.0, 2e-3, 6000))
    renewed = (times / 0.01).astype(int)
    columns = {
        name: step * np.rint([samples[at][signal] / step for at in renewed])
        for name, signal, step in (("V_a", "ArmatureVoltage", 1e-2), ("i", "ArmatureCurrent", 1e-3),
                                   ("omega", "RotorSpeed", 1e-2))
    }  # fmt: skip
    holds = {row.name: row.hold for row in twin.inputs}
    plans = [SignalPlan(name, hold=holds.get(name), sampling=Sampling.POLLED) for name in columns]
    playback = Playback(plans, 200, 0.02)
    rows = Rows(np.asarray(times, dtype=np.float64), columns, np.arange(1, 6001), np.zeros(6000, dtype=np.int64))
    return [window for window in (*playback.windows(rows), *playback.rest()) if not window.quality.reasons]


@pytest.mark.parametrize("seed", often([22], [21, 22, 23, 24]))
def test_registers_of_a_healthy_drive_show_its_values(scenario: MotorScenario, seed: int) -> None:
    """Where measurements correct much, inductance and delays are uncertain together; where they correct less, not."""
    points = [{"at": f"{1 + 10 * at} s", "speed": f"{speed} rad/s"} for at, speed in enumerate((10, 13, 9, 12, 8))]
    drive = MotorScenario.model_validate({
        "plant": "dc_motor", "dbc": scenario.dbc, "set_points": points, "repeat_every": "51 s",
        "noise": {"current": "5 mA", "speed": "0.02 rad/s"},
    })  # fmt: skip
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT))
    values = found(twin, polled(drive, seed), {"T_load"})
    rows = by_name(values)
    assert values.faults == ()
    assert values.is_explained
    for name, truth in (("R_a", 6.5), ("L_a", 0.673)):
        sd = rows[name].sd
        assert sd is not None
        assert abs(rows[name].value - truth) < min(4.0 * sd, 0.03 * truth), name


def test_a_record_without_a_measurement_has_no_residual(motor: MotorScenario, windows: Cut) -> None:
    """A cost over such records would be smaller the more of them there are, as where signals are late."""
    costs = []
    for share in (1, 2):
        cut = []
        for window, _ in windows(motor, 4):
            missing = window.missing.copy()
            missing[np.arange(window.grid.records) % share > 0, 2:] = True
            cut.append(replace(window, missing=missing))
        values = found(find_twin("dc_motor"), cut, set())
        costs.append(values.quiet_cost)
    assert costs[1] == pytest.approx(costs[0], rel=0.15)


def test_values_that_depend_on_what_the_twin_lacks_are_not_taken(windows: Cut) -> None:
    """A load that nobody measures, and that follows no form."""
    values = found(find_twin("dc_motor"), changed(loaded(), "T_load", lambda load: 0.0 * load), set())
    assert values.faults or not values.is_followed


LOAD = 0.1  # N*m


def loaded(count: int = 8, true: Mapping[str, float] = TRUE, noise: tuple[float, float] = (5e-3, 0.1)) -> list[Window]:
    """Windows of the motor with steps of the voltage and a load of any form, integrated here.

    ``noise`` is that of current (A) and speed (rad/s).
    """
    steps, fine, rng = 200 * count, 10, np.random.default_rng(1)
    rates = np.diag([1.0 / true["L_a"], 1.0 / true["J"]])
    a = rates @ np.array([[-true["R_a"], -true["K_e"]], [true["K_t"], -true["D"]]])
    b = rates @ np.diag([1.0, -1.0])
    transition = expm(0.01 / fine * a)
    driven = np.linalg.solve(a, (transition - np.eye(2)) @ b)
    voltage = np.repeat(rng.uniform(-10.0, 10.0, steps // 50), 50)
    corners = np.arange(0, steps + 35, 35)
    load = np.interp(np.arange(steps * fine) / fine, corners, rng.uniform(0.0, LOAD, len(corners)))
    state, rows = np.zeros(2), []
    for step in range(steps):
        errors = rng.normal(0.0, noise)
        rows.append([voltage[step], load[step * fine], *(state + errors)])
        for each in range(fine):
            state = transition @ state + driven @ (voltage[step], load[step * fine + each])
    values = np.array(rows)
    return [
        Window.whole(at, 2.0 * at, 0.01, ("V_a", "T_load", "i", "omega"), values[200 * at : 200 * (at + 1)])
        for at in range(count)
    ]


def changed(windows: list[Window], name: str, change: Callable[[Array], Array]) -> list[Window]:
    """The windows with another column."""
    cut = []
    for window in windows:
        values, column = window.values.copy(), window.signals.index(name)
        values[:, column] = change(values[:, column])
        cut.append(replace(window, values=values))
    return cut


def test_a_measured_load_shows_the_torque_constant() -> None:
    values = found(find_twin("dc_motor"), loaded(), set())
    assert values.is_explained
    assert values.faults == ()
    assert_true(by_name(values), set(TRUE))


@pytest.mark.parametrize("inductance", [1.2e-3, pytest.param(4e-4, marks=pytest.mark.full)])
def test_an_inductance_that_hardly_shows_is_not_that_of_the_example(inductance: float) -> None:
    """The current settles within 1.5 ms, and is sampled every 10 ms; with the example's 0.673 H nothing fits."""
    true = {"R_a": 0.8, "L_a": inductance, "J": 2.5e-3, "K_e": 0.12, "K_t": 0.12, "D": 6e-4}
    values = found(find_twin("dc_motor"), loaded(true=true, noise=(0.03, 0.1)), set())
    rows = by_name(values)
    assert values.is_explained
    assert values.faults == ()
    assert_true(rows, set(true) - {"L_a"}, true)
    sd = rows["L_a"].sd
    assert sd is not None
    assert sd > 0.05 * inductance
    assert abs(rows["L_a"].value - inductance) < 4.0 * sd


@pytest.mark.parametrize("name", ["T_load", *(pytest.param(name, marks=pytest.mark.full) for name in ("V_a", "omega"))])
def test_a_wrong_sign_is_named(name: str) -> None:
    values = found(find_twin("dc_motor"), changed(loaded(), name, np.negative), set())
    assert name in " ".join(values.faults)


def test_only_constants_that_are_one_in_si_units_are_compared_over_the_library() -> None:
    """K_e of a motor in V*s/rad is K_t in N*m/A. Frictions of two directions have one unit, and differ as they like."""
    found = {
        (name, one.name, other.name)
        for name in library_twins()
        for one, other in combinations(find_twin(name).parameters, 2)
        if are_one_constant(one, other)
    }
    assert found == {("dc_motor", "K_e", "K_t"), ("dc_motor_coulomb", "K_e", "K_t")}


@pytest.mark.parametrize(
    ("unit", "share", "is_same"),
    [
        ("N*m/A", 1.0, True),
        ("N*m/A", 2.0, False),
        ("mN*m/A", 1.0, False),
        ("V*s", 1.0, False),  # the same quantity
        ("kg", 1.0, False),
    ],
)
def test_a_constant_is_one_that_the_twin_states_in_other_quantities(unit: str, share: float, is_same: bool) -> None:
    own = find_twin("dc_motor").parameter("K_e")
    assert are_one_constant(own, replace(own, name="other", unit=unit, nominal=share * own.nominal)) is is_same


def test_a_speed_in_rpm_that_is_said_to_be_in_radians_is_named() -> None:
    values = found(find_twin("dc_motor"), changed(loaded(), "omega", lambda speed: 30.0 / np.pi * speed), set())
    assert "rpm" in " ".join(values.faults)


@pytest.mark.parametrize(
    "pair",
    [("i", "omega"), *(pytest.param(pair, marks=pytest.mark.full) for pair in (("V_a", "T_load"), ("V_a", "omega")))],
    ids="-".join,
)
def test_swapped_columns_give_no_values(pair: tuple[str, str]) -> None:
    cut = []
    for window in loaded():
        columns, places = window.values.copy(), [window.signals.index(name) for name in pair]
        columns[:, places] = columns[:, places[::-1]]
        cut.append(replace(window, values=columns))
    values = found(find_twin("dc_motor"), cut, set())
    assert values.faults or not values.is_followed


@pytest.mark.parametrize("level", [np.nan, 0.0, 3.5])
@pytest.mark.filterwarnings("error")
def test_a_column_that_is_blank_or_constant_is_named(level: float) -> None:
    cut = [replace(window, missing=window.missing | np.isnan(window.values)) for window in
           changed(loaded(), "omega", lambda speed: np.full(len(speed), level))]  # fmt: skip
    values = found(find_twin("dc_motor"), cut, set())
    assert "omega" in " ".join(values.faults)
    assert values.values == ()


@pytest.mark.parametrize("seed", often([1], [1, 2]))
def test_what_was_determined_beside_a_value_of_the_example_stays_as_uncertain(
    motor: MotorScenario, windows: Cut, seed: int
) -> None:
    """At a speed that hardly changes, voltage constant and resistance trade, and the example's constant is wrong.

    Where the resistance is not determined either (other seeds), it is as right as the constant, which is said.
    """
    true = {"R_a": 4.3, "L_a": 0.45, "J": 1.7e-3, "K_e": 0.06, "K_t": 0.06, "D": 2.1e-3}
    points = tuple(point.model_copy(update={"speed": 14.0 + at}) for at, point in enumerate(motor.set_points))
    update = {
        "seed": seed,
        "parameters": motor.parameters.model_copy(update=true),
        "noise": motor.noise.model_copy(update={"speed": 0.02}),
        "set_points": points,
    }
    twin = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT))
    cut = [window for window, _ in windows(motor.model_copy(update=update), 12)]
    rows = by_name(found(twin, cut, {"T_load"}))
    assert rows["K_e"].sd is None
    sd = rows["R_a"].sd
    assert sd is not None
    assert abs(rows["R_a"].value - true["R_a"]) < 3.0 * sd
