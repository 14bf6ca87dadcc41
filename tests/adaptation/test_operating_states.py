"""A drive that is switched off is evidence of nothing, and hides no fault of a drive that is on."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.changes.machines import LIBRARY_PLANTS
from benchmarks.changes.plants import cut
from benchmarks.diagnosis import machine_of
from benchmarks.everyday import (
    NOISE,
    ONSET,
    PERIOD,
    RECORDS,
    RESISTANCE,
    SITUATIONS,
    Machine,
    Situation,
    run_of,
    simulate,
)
from benchmarks.other_situations import machine_with

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.operating_states import off_records, part_in_operation, running_part
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import MIN_RUN
from otolith.health.schema import Status
from otolith.machine import LoadedMachine
from tests.variants import often

MOTOR = machine_of("motor").problem
PARTS = 100  # of a record of the pump, for Euler's method
STOPS = Machine(enabled=lambda time: time % 40.0 < 28.0)


def window_of(values: Array) -> Window:
    return Window.whole(0, 0.0, PERIOD, tuple(NOISE), values)


@pytest.mark.parametrize("seed", often([1, 2], [1, 2, 3, 4, 5, 6]))
@pytest.mark.parametrize("length", [10.0, 15.0])
def test_a_drive_that_is_switched_off_is_no_event(seed: int, length: float) -> None:
    """The motor coasts against its load, and a worm gear holds it: the twin would let it turn back."""
    machine = Machine(enabled=lambda time: time % 40.0 < 40.0 - length)
    outcome = run_of(Situation("stops", machine), seed)
    assert (outcome.verdict, outcome.false_events) == ("right", 0), outcome.story
    assert outcome.covered >= 0.9 * outcome.intervals


@pytest.mark.parametrize("seed", often([1], [1, 2, 3]))
def test_turns_that_short_out_are_found_between_the_stops(seed: int) -> None:
    situation = next(item for item in SITUATIONS if item.name == "turns short out")
    fault = replace(situation.machine, enabled=STOPS.enabled)
    outcome = run_of(replace(situation, machine=fault), seed)
    assert outcome.verdict == "right", outcome.story


def test_only_an_open_bridge_is_off() -> None:
    """At a command of zero, a closed one brakes: its current is that of the speed over the resistance."""
    _, values = simulate(STOPS, 36.0, 1)
    stop = window_of(values[2750:2950])
    off = off_records(MOTOR, stop)
    assert not off[:50].any()
    assert off[50:].all()
    braking = stop.values.copy()
    braking[50:, 2] -= 0.038 / RESISTANCE * 10.0
    assert not off_records(MOTOR, window_of(braking)).any()
    broken = stop.values.copy()
    broken[50:, 0] = 3.0
    assert not off_records(MOTOR, window_of(broken)).any()


@pytest.mark.parametrize(("records", "expected"), [(MIN_RUN - 1, 0), (MIN_RUN, MIN_RUN)])
def test_a_command_of_zero_for_few_records_is_no_stop(records: int, expected: int) -> None:
    _, values = simulate(Machine(), 4.0, 1)
    values[100 : 100 + records, [0, 2]] = 0.0
    assert off_records(MOTOR, window_of(values[:RECORDS])).sum() == expected


@pytest.mark.parametrize("start", [0, 60, 150])
def test_the_longest_part_with_the_drive_on_is_used(start: int) -> None:
    _, values = simulate(Machine(), 4.0, 1)
    values[start : start + 50, [0, 2]] = 0.0
    part = running_part(MOTOR, window_of(values[200:400] if start == 0 else values[:RECORDS]))
    if start == 0:
        assert part is None
        return
    assert part is not None
    assert part.window is not None
    assert part.window.records == max(start, RECORDS - start - 50)
    assert np.all(part.window.column("V_a") != 0.0)


def test_nothing_is_used_of_a_window_with_short_parts() -> None:
    _, values = simulate(Machine(), 4.0, 1)
    values[40:160, [0, 2]] = 0.0
    part = running_part(MOTOR, window_of(values[:RECORDS]))
    assert part is not None
    assert part.window is None
    assert "1.2 s" in part.note


def test_an_offset_is_not_severe_because_the_machine_stands_still() -> None:
    """Its share of the signal is that while the machine runs: at rest any offset is all of the current."""
    stops = Machine(
        speed=lambda time: 12.0 if time < 60.0 else 0.0, current_zero=lambda time: 0.02 if time > ONSET else 0.0
    )
    outcome = run_of(Situation("offset", stops, ("sensor",)), 1)
    assert outcome.verdict == "right", outcome.story
    assert not any(" ACT " in line for line in outcome.story), outcome.story


def _pump_that_rests(seed: int, seconds: float) -> tuple[LoadedMachine, list[Window]]:
    """Return windows of 5 s of a pump that rests for 20 s of each minute, while a check valve holds the water."""
    plant, random, machine = LIBRARY_PLANTS["pump"], np.random.default_rng(seed), machine_with("pump")
    q, speed, flow, rows = plant.parameters, 150.0, 20.0 / 3600.0, list[tuple[float, ...]]()
    for record in range(round(seconds / plant.period)):
        time = record * plant.period
        torque, opening = 0.0 if time % 60.0 > 40.0 else 9.0, 0.8 + 0.1 * float(np.sin(0.2 * time))
        change = 0.8 + 0.1 * float(np.sin(0.2 * (time + plant.period))) - opening
        rows.append((torque, opening, speed, 3600.0 * flow, 1e-3 * (q["h_0"] * speed**2 - q["h_2"] * flow**2)))
        for part in range(PARTS):
            now = opening + change * (part + 0.5) / PARTS
            pressure = q["h_0"] * speed**2 - q["h_2"] * flow**2
            friction = q["T_c"] if speed > 0.0 else min(torque, q["T_c"])
            rate = (torque - q["t_1"] * speed * flow - q["t_0"] * speed**2 - friction) / q["J"]
            rise = (pressure - q["p_static"] - q["k_v"] * (flow / now) ** 2) / q["I_p"]
            speed = max(speed + rate * plant.period / PARTS, 0.0)
            flow = max(flow + rise * plant.period / PARTS, 0.0)
    noise = [0.0, 0.0, *(output.noise for output in machine.twin.outputs)]
    values = np.array(rows) + noise * random.standard_normal((len(rows), 5))
    measured = dict(zip(("T_m", "u", "omega", "Q", "p"), values.T, strict=True))
    return machine, cut(plant, measured, machine.twin.signals)


@pytest.mark.parametrize("seed", often([1], [1, 2, 3]))
def test_a_pump_that_rests_behind_its_check_valve_is_no_event(seed: int) -> None:
    machine, windows = _pump_that_rests(seed, 125.0)
    state, covered, reasons = initial_state("m", "s", machine.problem, machine.plan), [], set[str]()
    for window in windows:
        state, report = adapt(state, window)
        assert not [event.text for event in report.document.events if not event.is_hint]
        item = report.document.parameters["h_0"]
        if item.status is Status.ESTIMATED and item.low is not None and item.high is not None:
            covered.append(item.low <= 11.5 <= item.high)
        reasons.add(item.reason)
    assert sum(covered) >= 0.9 * len(covered) > 10
    assert any("omega was below 90 rad/s" in reason for reason in reasons)


def test_a_wrong_reading_is_no_stop() -> None:
    machine, windows = _pump_that_rests(1, 10.0)
    values = windows[1].values.copy()
    values[100 : 100 + MIN_RUN - 1, machine.twin.signals.index("omega")] = 0.0
    assert part_in_operation(machine.problem, replace(windows[1], values=values)) is None
    values[100 : 100 + MIN_RUN, machine.twin.signals.index("omega")] = 0.0
    part = part_in_operation(machine.problem, replace(windows[1], values=values))
    assert part is not None
    assert part.window is not None
    assert part.window.records == len(values) - 100 - MIN_RUN


def test_readings_are_counted_not_records() -> None:
    """Of a signal that is measured every tenth record: the records before its first reading are as that reading."""
    machine, windows = _pump_that_rests(1, 10.0)
    column, values = machine.twin.signals.index("omega"), windows[1].values.copy()
    missing = windows[1].missing.copy()
    missing[:, column] = np.arange(len(values)) % 10 != 7
    rare = replace(windows[1], missing=missing)
    values[107, column] = 0.0
    assert part_in_operation(machine.problem, replace(rare, values=values)) is None
    values[:48, column] = 0.0
    values[0, column] = 1e9  # without meaning, as it was not measured
    part = part_in_operation(machine.problem, replace(rare, values=values))
    assert part is not None
    assert part.note.startswith("omega was below 90 rad/s")
    assert part.window is not None
    assert part.window.records == len(values) - 57


def test_a_flow_sensor_that_fails_at_full_speed_is_no_rest() -> None:
    machine, windows = _pump_that_rests(1, 35.0)
    column = machine.twin.signals.index("Q")
    state = initial_state("m", "s", machine.problem, machine.plan)
    for window in windows[:3]:
        state, _ = adapt(state, window)
    for window in windows[3:]:
        values = window.values.copy()
        values[:, column] = 0.05 * np.random.default_rng(window.index).standard_normal(len(values))
        state, report = adapt(state, replace(window, values=values))
        assert report.document.decision is not WindowDecision.OFF
        assert report.document.findings
