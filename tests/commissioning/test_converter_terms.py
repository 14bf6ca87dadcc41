"""A synchronous motor on a real converter: dead time of its three half bridges, and iron that saturates."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.changes.machines import PMSM
from benchmarks.changes.plants import HEALTHY, Change, Values, cut, generator, simulate
from benchmarks.other_situations import machine_with

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.commissioning.own_values import own_values
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.health.schema import EventChange, EventDocument
from otolith.machine import find_twin
from otolith.twin.definition import Role
from tests.variants import often_rows

SATURATION, DEAD_TIME = 0.01, 1.2  # 1/A, and V of each half bridge
SOFT = 0.05  # A: current within which the voltage of a half bridge changes its sign
FUNDAMENTAL = 4.0 / np.pi  # of a square wave, over its height
CURRENT = 8.0  # A, of the quadrature axis under load
PHASES = np.array([0.0, 2.0, 4.0]) * np.pi / 3.0
ROWS = often_rows([(SATURATION, False)], [(SATURATION, False), (0.0, True), (0.0, False)])
COMMISSIONED, SECONDS = 20, 20.0  # windows of the healthy record; s


def _half_bridges(x: Values) -> tuple[float, float]:
    """Return the voltage that the three half bridges take, in rotor coordinates."""
    angles = x["angle"] - PHASES
    currents = x["i_d"] * np.cos(angles) - x["i_q"] * np.sin(angles)
    taken = DEAD_TIME * np.tanh(currents / SOFT)
    taken -= taken.mean()
    direct, quadrature = 2.0 / 3.0 * (taken * np.cos(angles)).sum(), -2.0 / 3.0 * (taken * np.sin(angles)).sum()
    return float(direct), float(quadrature)


def _rates(x: Values, u: Values, q: Values) -> Values:
    direct, quadrature = _half_bridges(x) if q["dead_time"] else (0.0, 0.0)
    linkage = q["L_q"] * x["i_q"] / (1.0 + q["saturation"] * abs(x["i_q"]))
    slope = q["L_q"] / (1.0 + q["saturation"] * abs(x["i_q"])) ** 2  # of the linkage by the current
    speed = q["n_p"] * x["omega"]
    torque = 1.5 * q["n_p"] * ((q["psi"] + q["L_d"] * x["i_d"]) * x["i_q"] - linkage * x["i_d"])
    return {
        "i_d": (u["v_d"] - direct - q["R_s"] * x["i_d"] + speed * linkage) / q["L_d"],
        "i_q": (u["v_q"] - quadrature - q["R_s"] * x["i_q"] - speed * (q["L_d"] * x["i_d"] + q["psi"])) / slope,
        "omega": (torque - u["T_load"] - q["D"] * x["omega"]) / q["J"],
        "angle": speed,
    }


def _operation(random: np.random.Generator, times: Array) -> dict[str, Array]:
    turn = (times + random.uniform(0.0, 2.0)) % 8.0
    load = 3.0 + 2.0 * np.sin(0.7 * times + random.uniform(0.0, 6.0))
    flux = np.where(times % 3.0 < 1.5, -6.0, -1.0)  # weakened at times
    return {"speed": 30.0 + 30.0 * (turn // 2.0), "flux": flux, "T_load": load}


def _control(x: Values, u: Values) -> Values:
    wanted = np.clip(0.3 * (u["speed"] - x["omega"]) + u["T_load"] / 1.05, -12.0, 12.0)
    speed = 4.0 * x["omega"]
    return {
        "v_d": np.clip(4.0 * (u["flux"] - x["i_d"]) - speed * 9.5e-3 * x["i_q"] + 1.2 * u["flux"], -100.0, 100.0),
        "v_q": np.clip(4.0 * (wanted - x["i_q"]) + speed * (8.5e-3 * x["i_d"] + 0.175) + 1.2 * wanted, -100.0, 100.0),
    }


def _windows(saturation: float, dead_time: bool, seed: int, change: Change = HEALTHY) -> tuple[Window, ...]:
    """Return windows of 0.5 s with the noise that the twin states; a change comes after 20 s."""
    plant = replace(
        PMSM,
        parameters={**PMSM.parameters, "saturation": saturation, "dead_time": float(dead_time)},
        initial={**PMSM.initial, "angle": 0.0},
        rates=_rates,
        operate=_operation,
        control=_control,
        held=("v_d", "v_q", "speed", "flux"),
    )
    twin, random = find_twin("pmsm"), generator(seed, "converter", 0)
    count = round(SECONDS / plant.period)
    rows = simulate(plant, [random], count, HEALTHY, change, count // 2)
    noise = {output.name: output.noise for output in twin.outputs}
    measured = {name: values[0] + noise.get(name, 0.0) * random.standard_normal(count) for name, values in rows.items()}
    return tuple(cut(plant, measured, twin.signals))


@cache
def _commissioned(saturation: float, dead_time: bool) -> tuple[Problem, dict[str, tuple[float, float | None]]]:
    """Return the problem with the values that a healthy record shows, and these values with their deviations."""
    twin = find_twin("pmsm")
    free = tuple(row for row in twin.parameters if row.role is Role.ESTIMATED)
    known = tuple((row.name, row.nominal) for row in twin.parameters if row not in free)
    problem = Problem(twin, known, free, tuple(output.noise for output in twin.outputs))
    searched = [row for row in twin.parameters if row.part or row.role is Role.ESTIMATED]
    record = list(_windows(saturation, dead_time, 1))[:COMMISSIONED]
    found = {
        item.name: (item.value, item.sd) for item in own_values(problem, record, searched, set(), lambda _: None).values
    }
    held = tuple((name, found[name][0] if name in found else value) for name, value in known)
    own = tuple(replace(row, nominal=found[row.name][0]) for row in free)
    return replace(problem, known=held, free=own), found


@pytest.mark.parametrize(("saturation", "dead_time"), ROWS)
def test_a_healthy_record_shows_what_converter_and_iron_do(saturation: float, dead_time: bool) -> None:
    found = _commissioned(saturation, dead_time)[1]
    slope, voltage = found["s_q"], found["V_dt"]
    assert slope == (0.0, None) if not saturation else slope[1] is not None
    inductance = found["L_q"][0] / (1.0 + slope[0] * CURRENT)
    assert abs(inductance / (9.5 / (1.0 + saturation * CURRENT)) - 1.0) < 0.01
    assert voltage == (0.0, None) if not dead_time else abs(voltage[0] / (FUNDAMENTAL * DEAD_TIME) - 1.0) < 0.05
    value, sd = found["R_s"]
    assert sd is not None
    assert abs(value - PMSM.parameters["R_s"]) < 1.5 * QUANTILE * sd + 0.02 * dead_time


def _announced(problem: Problem, windows: Iterable[Window]) -> list[EventDocument]:
    """Return the events, hints left out, that a machine with the values of its commissioning announces."""
    state, events = initial_state("m", "s", problem, machine_with("pmsm").plan), list[EventDocument]()
    for window in windows:
        state, report = adapt(state, window)
        events += [event for event in report.document.events if event.change is EventChange.RAISED]
    return [event for event in events if not event.is_hint]


@pytest.mark.parametrize(("saturation", "dead_time"), ROWS[:2])
def test_a_healthy_motor_is_silent_and_a_short_circuit_is_named(saturation: float, dead_time: bool) -> None:
    problem = _commissioned(saturation, dead_time)[0]
    assert not _announced(problem, _windows(saturation, dead_time, 2))
    shorted = Change(parameters={"R_s": 0.85 * PMSM.parameters["R_s"]})
    events = _announced(problem, _windows(saturation, dead_time, 3, shorted))
    assert {event.part for event in events} == {"winding"}
    assert all(event.condition_id.startswith("winding-turns") for event in events)
