"""Inputs without a sensor: the rewritten twin has the rates of the original one driven by what is assumed."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.machine import find_twin, library_twins
from otolith.twin.definition import Definition, OperatingRange, Role
from otolith.twin.identifiability import structural_identifiability
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from tests.twin.reference import Reference

INPUTS = [(name, driven.name) for name in library_twins() for driven in find_twin(name).inputs]
LOADED = ("dc_motor", "dc_motor_coulomb", "pmsm", "two_mass")


def nominal(twin: Definition, **values: float) -> Array:
    return np.array([values.get(row.name, row.nominal) for row in twin.parameters])


def rates(twin: Definition, parameters: Array, seed: int, **given: float) -> dict[str, float]:
    """The rate of each state, at random states and inputs that are the same for every twin."""
    random = np.random.default_rng(seed)
    levels = {row.name: 0.1 * random.uniform(row.low, row.high) for row in find_twin(twin.name).states}
    levels |= {row.name: random.uniform(row.low, row.high) for row in find_twin(twin.name).inputs} | given
    states, inputs = (np.array([levels[row.name] for row in rows]) for rows in (twin.states, twin.inputs))
    names = [row.name for row in twin.states]
    return dict(zip(names, Reference(twin, parameters).rates(states, inputs).tolist(), strict=True))


def speed_of(twin: Definition, seed: int) -> float:
    """The speed that the load acts on, as :func:`rates` has it."""
    random = np.random.default_rng(seed)
    levels = {row.name: 0.1 * random.uniform(row.low, row.high) for row in twin.states}
    return levels.get("omega", levels.get("omega_l", 0.0))


@pytest.mark.parametrize(("name", "driven"), INPUTS)
def test_a_constant_input_is_a_parameter_and_a_slow_one_a_state(name: str, driven: str) -> None:
    twin = find_twin(name)
    constant, slow = (
        without_sensor(twin, UnmeasuredInput(driven, kind)) for kind in (Assumption.CONSTANT, Assumption.SLOW)
    )
    value = constant.parameter(driven).nominal
    expected = rates(twin, nominal(twin), 3, **{driven: value})
    assert rates(constant, nominal(constant), 3) == pytest.approx(expected)
    assert rates(slow, nominal(slow), 3, **{driven: value}) == pytest.approx(expected | {driven: 0.0})
    assert constant.parameter(driven).role is Role.ESTIMATED
    (state,) = (row for row in slow.states if row.name == driven)
    assert state.process_noise > 0.0
    assert driven not in constant.signals + slow.signals


@pytest.mark.parametrize("name", LOADED)
@pytest.mark.parametrize("seed", [1, 2])
def test_friction_adds_only_what_the_twin_lacks(name: str, seed: int) -> None:
    twin = find_twin(name)
    without = without_sensor(twin, UnmeasuredInput("T_load", Assumption.FRICTION))
    added = {row.name for row in without.parameters} - {row.name for row in twin.parameters}
    assert added == (set() if name == "dc_motor_coulomb" else {"T_load_dry", "T_load_speed"})
    load = 0.3 * np.tanh(speed_of(twin, seed) / 0.7) if added else 0.0
    values = nominal(without, T_load_dry=0.3, T_load_speed=0.7)
    expected = rates(twin, nominal(twin), seed, T_load=float(load))
    assert rates(without, values, seed) == pytest.approx(expected)


@pytest.mark.parametrize(("name", "own"), [("dc_motor", {"D"}), ("dc_motor_coulomb", {"D", "T_c"})])
def test_friction_of_the_twin_is_then_that_of_the_load_too(name: str, own: set[str]) -> None:
    twin = find_twin(name)
    without = without_sensor(twin, UnmeasuredInput("T_load", Assumption.FRICTION))
    for row in twin.parameters:
        now = without.parameter(row.name)
        assert (now != row) == (row.name in own)
        assert now.high > row.high or now == row
        assert (now.watch, now.act, now.part) == (row.watch, row.act, row.part)


@pytest.mark.parametrize("name", LOADED)
@pytest.mark.parametrize(
    ("kind", "expression"), [(Assumption.FRICTION, ""), (Assumption.PROPORTIONAL, "omega*abs(omega)")]
)
def test_what_stands_for_a_load_has_limits_and_a_part(name: str, kind: Assumption, expression: str) -> None:
    """A friction that doubles must not be OK for want of a limit."""
    twin = find_twin(name)
    of_load = "omega_l*abs(omega_l)" if expression and name == "two_mass" else expression
    without = without_sensor(twin, UnmeasuredInput("T_load", kind, of_load))
    added = [row for row in without.parameters if row not in twin.parameters and row.role is Role.ESTIMATED]
    assert added
    for row in added:
        assert row.watch, row.name
        assert row.act, row.name
        assert row.part == ("bearing" if kind is Assumption.FRICTION else "load")


def test_a_twin_without_viscous_friction_gets_it() -> None:
    twin = find_twin("dc_motor")
    bare = replace(
        twin,
        parameters=tuple(row for row in twin.parameters if row.name != "D"),
        equations=tuple((left, text.replace(" - D*omega", "")) for left, text in twin.equations),
    )
    without = without_sensor(bare, UnmeasuredInput("T_load", Assumption.FRICTION))
    viscous = without.parameter("T_load_viscous")
    assert viscous.low < 0.0 < viscous.nominal < viscous.high
    assert viscous.unit == "N*m*s"
    values = nominal(without, T_load_dry=0.0, T_load_viscous=0.00143)
    assert rates(without, values, 1) == pytest.approx(rates(twin, nominal(twin), 1, T_load=0.0))


def test_a_load_in_proportion_to_an_expression() -> None:
    twin = find_twin("pmsm")
    item = UnmeasuredInput("T_load", Assumption.PROPORTIONAL, "omega*abs(omega)")
    without = without_sensor(twin, item)
    factor = without.parameter("T_load_factor")
    assert factor.unit == "kg*m^2"
    assert 0.0 < factor.nominal < factor.high
    speed = speed_of(twin, 4)
    expected = rates(twin, nominal(twin), 4, T_load=2e-4 * speed * abs(speed))
    assert rates(without, nominal(without, T_load_factor=2e-4), 4) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("name", "driven", "kind", "expression", "reason"),
    [
        ("pump", "T_m", Assumption.FRICTION, "", "drives omega"),
        ("pump", "u", Assumption.FRICTION, "", "acts on Q"),
        ("pump", "u", Assumption.PROPORTIONAL, "p", "unknown symbol 'p'"),  # an output follows from the states
        ("dc_motor", "T_load", Assumption.PROPORTIONAL, "sin(omega)", "takes a plain number"),
        ("dc_motor", "T_load", Assumption.PROPORTIONAL, "T_load*omega", "unknown symbol 'T_load'"),
        ("dc_motor", "T_load", Assumption.PROPORTIONAL, "omega +", "column"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, driven: str, kind: Assumption, expression: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        without_sensor(find_twin(name), UnmeasuredInput(driven, kind, expression))


def test_an_input_that_the_twin_does_not_have_is_named() -> None:
    """As in a bundle of evidence that somebody has changed."""
    item = UnmeasuredInput("T_load", Assumption.CONSTANT)
    without = without_sensor(find_twin("dc_motor"), item)
    with pytest.raises(ValueError, match="T_load"):
        without_sensor(without, item)


def test_without_a_range_there_is_no_scale() -> None:
    twin = find_twin("dc_motor")
    unstated = replace(twin, inputs=tuple(replace(row, has_range=False) for row in twin.inputs))
    with pytest.raises(ValueError, match="no range of T_load"):
        without_sensor(unstated, UnmeasuredInput("T_load", Assumption.CONSTANT))


def test_a_constant_load_and_damping_need_a_change_of_speed() -> None:
    without = without_sensor(find_twin("dc_motor"), UnmeasuredInput("T_load", Assumption.CONSTANT))
    changing = {row.name: row.reason for row in structural_identifiability(without)}
    constant = {row.name: row.reason for row in structural_identifiability(without, settled=True)}
    assert not any(changing.values())
    assert constant["D"] == "only together with T_load"
    assert constant["T_load"] == "only together with D"
    assert constant["R_a"] == ""


def test_a_range_of_an_input_without_a_sensor_is_dropped() -> None:
    """Its twin cannot be asked where the input is; another range stays."""
    ranges = (OperatingRange("T_load", low=0.0), OperatingRange("omega", low=1.0))
    twin = replace(find_twin("dc_motor"), operation=ranges)
    assert without_sensor(twin, UnmeasuredInput("T_load", Assumption.CONSTANT)).operation == ranges[1:]
