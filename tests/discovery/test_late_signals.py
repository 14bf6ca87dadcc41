"""A signal that is late is named, and its delay is not turned into a parameter."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import FREE, replayed, some_motor, write_machine
from benchmarks.sampling.plant import Motor
from benchmarks.sampling.schedules import Recording, Samples, Schedule, Timing, record

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin, load_machine
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.variants import often_rows

Cut = Callable[..., list[tuple[Window, float]]]
MOTOR, ALL = find_twin("dc_motor"), ("R_a", "L_a", "J", "D")
DEVIATIONS = 4.0  # standard deviations: several hundred values are compared
ROWS, SLOW_OMEGA = Schedule(rows=Timing(0.01)), Schedule(omega=Timing(0.05))
FINDING = re.compile(
    r'(\w+) is ([\d.]+) ms late \(([\d.]+) to ([\d.]+)\).*; write delay = "([\d.]+) ms" under \[signals\]'
)


def recorded(schedule: Schedule = ROWS, seed: int = 5, length: float = 13.0) -> Recording:
    random = np.random.default_rng(seed)
    return record(schedule, some_motor(random), length, random)


def reports(folder: Path, recording: Recording, schedule: Schedule = ROWS, extra: str = "") -> list[ReportDocument]:
    machine = load_machine(write_machine(folder, schedule, extra), with_driver=False)
    data = folder / "recording.csv"
    data.write_text(recording.table(), encoding="utf-8")
    return replayed(machine, data)


def assert_named(document: ReportDocument, name: str, delay: float, within: float = 1.0) -> None:
    """The first finding names signal, delay (ms), ``within`` as many ms, and interval."""
    finding = FINDING.search("; ".join((document.findings[0].text, document.findings[0].setting)))
    assert finding is not None, document.findings
    value, low, high = map(float, finding.group(2, 3, 4))
    assert finding.group(1) == name
    assert value == pytest.approx(delay, abs=within)
    assert low - 0.5 * (high - low) <= delay <= high + 0.5 * (high - low)
    assert document.explanations[0].reason is FaultType.TIMING
    assert document.findings[0].condition == FaultType.TIMING


def assert_not_wrong(document: ReportDocument, motor: Motor) -> None:
    """No parameter is published with a value that is off by more than its interval explains."""
    for name in FREE:
        parameter, truth = document.parameters[name], getattr(motor, name)
        if parameter.value is not None:
            assert parameter.sd is not None
            assert parameter.value == pytest.approx(truth, abs=DEVIATIONS * parameter.sd)
            assert parameter.value == pytest.approx(truth, rel=0.01)


CASES = [(ROWS, name, delay) for name in ("omega", "i", "V_a") for delay in (10.0, 35.0)]


@pytest.mark.parametrize(
    ("schedule", "name", "delay"),
    often_rows([CASES[0], CASES[3]], [*CASES, (SLOW_OMEGA, "omega", 10.0)]),
    ids=lambda value: str(value)[:8],
)
def test_a_late_signal_is_named_from_the_first_window_on(
    tmp_path: Path, schedule: Schedule, name: str, delay: float
) -> None:
    recording = recorded(schedule)
    documents = reports(tmp_path, recording.delayed({name: 1e-3 * delay}), schedule)
    assert len(documents) >= 5
    for document in documents:
        assert document.decision not in ACCEPTED
        assert_not_wrong(document, recording.motor)
    assert all(document.decision is WindowDecision.TIMING for document in documents[1:])
    assert_named(documents[-1], name, delay)


@pytest.mark.parametrize("name", ["omega", "V_a"])
def test_a_signal_that_becomes_late_leaves_the_estimates_as_they_are(tmp_path: Path, name: str) -> None:
    recording, since = recorded(length=15.0), 6.0
    own = recording.samples[name]
    stated = own.stated + np.where(own.stated > since, 0.01, 0.0)
    changed = {**recording.samples, name: Samples(own.times, own.values, np.round(stated, 6), own.fresh)}
    late = replace(recording, samples=changed)
    documents = reports(tmp_path, late)
    healthy = [document for document in documents if document.window.end <= since]
    assert all(document.decision is WindowDecision.LEARNED for document in healthy)
    after = documents[len(healthy) + 1 :]
    assert len(after) >= 3
    for document in after:
        assert document.decision is WindowDecision.TIMING
        assert_not_wrong(document, recording.motor)
    assert_named(documents[-1], name, 10.0)


def test_a_delay_of_a_fifth_of_a_record_is_never_learned(tmp_path: Path) -> None:
    """Parameters would explain the first window almost up to the noise without it."""
    recording = recorded()
    documents = reports(tmp_path, recording.delayed({"omega": 0.002}))
    for document in documents:
        assert document.decision not in ACCEPTED
        assert_not_wrong(document, recording.motor)
    assert_named(documents[-1], "omega", 2.0)


@pytest.mark.parametrize(("name", "delay"), [("omega", 10), ("omega", 35), ("V_a", 10), ("i", 35)])
def test_a_declared_delay_gives_the_estimates_of_no_delay(tmp_path: Path, name: str, delay: int) -> None:
    recording = recorded()
    without = reports(tmp_path, recording)
    extra = f'[signals]\n{name} = {{ delay = "{delay} ms" }}'
    declared = reports(tmp_path, recording.delayed({name: 1e-3 * delay}), ROWS, extra)
    assert all(document.decision is WindowDecision.LEARNED for document in [*without, *declared])
    for parameter in FREE:
        own, other = declared[-1].parameters[parameter], without[-1].parameters[parameter]
        assert own.value is not None
        assert other.value is not None
        assert own.sd is not None
        assert abs(own.value - other.value) < 2.0 * own.sd
        assert own.value == pytest.approx(getattr(recording.motor, parameter), abs=3.3 * own.sd)


BLOCK = """
[twin]
name = "block"
title = "heated block"
source = "energy balance"
validity = "always"
[states]
T = { unit = "K", bounds = [250, 600], initial = 300, meaning = "temperature" }
[inputs]
P = { unit = "W", hold = "zoh", range = [0, 500], meaning = "power of the heater" }
[outputs]
T = { unit = "K", noise = "20 mK", meaning = "temperature" }
[parameters]
C = { unit = "J/K", nominal = 500, bounds = [50, 5000], role = "estimated", meaning = "heat capacity" }
h = { unit = "W/K", nominal = 5, bounds = [0.5, 50], role = "estimated", meaning = "heat loss coefficient" }
[constants]
T_a = { unit = "K", value = 293, meaning = "ambient temperature" }
[equations]
"der(T)" = "(P - h*(T - T_a)) / C"
[sites]
block = { into = "der(T)", mode = "additive", through = "1/C", unit = "W", meaning = "heat into the block" }
"""
HEATER = """
[machine]
name = "heater"
[twin]
file = "block.toml"
[window]
length = "300 s"
sample_period = "5 s"
"""


# A third signal that is zero but for its noise shows no delay of its own.
WITH_SUN = (
    ('power of the heater" }', 'power of the heater" }\nS = { unit = "W", hold = "foh", meaning = "heat of the sun" }'),
    ("(P - h", "(P + S - h"),
)
SLOW = [(4, "T", False), (4, "P", False), (4, "T", True), (5, "T", False), (6, "P", False), (5, "P", True)]


@pytest.mark.parametrize(("seed", "name", "has_sun"), often_rows(SLOW[:3], SLOW))
def test_a_delay_of_some_samples_of_a_slow_machine_is_named(
    tmp_path: Path, seed: int, name: str, has_sun: bool
) -> None:
    """Samples come every 5 s, so a delay of 20 s is one of four samples. Of two signals the late one is named alone.

    That the other is early would be the same statement once more, and no delay could be written under it.
    """
    random, capacity, loss, step, late = np.random.default_rng(seed), 540.0, 4.6, 5.0, 4
    power = np.repeat(random.choice([0.0, 100.0, 200.0, 300.0, 400.0], 40), 12)
    rises, decay = [7.0], np.exp(-step * loss / capacity)  # K above the ambient temperature
    for value in power[:-1].tolist():
        rises.append(decay * rises[-1] + (1.0 - decay) * value / loss)
    heat = np.array(rises) + 293.0 + random.normal(0.0, 0.02, len(power))
    rows = {"T": (power[late:], heat[:-late]), "P": (power[:-late], heat[late:])}[name]
    sun = random.normal(0.0, 0.5, len(rows[0]))
    lines = [f"{step * at},{own[0]},{own[1]:.4f},{own[2]:.3f}" for at, own in enumerate(zip(*rows, sun, strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(["t,P,T,S", *lines]) + "\n", encoding="utf-8")
    block = BLOCK
    for before, after in WITH_SUN if has_sun else ():
        block = block.replace(before, after)
    (tmp_path / "block.toml").write_text(block, encoding="utf-8")
    (tmp_path / "heater.toml").write_text(HEATER, encoding="utf-8")
    documents = replayed(load_machine(tmp_path / "heater.toml", with_driver=False), tmp_path / "log.csv")
    assert len(documents) >= 7
    assert all(document.decision not in ACCEPTED for document in documents)
    assert documents[-1].decision is WindowDecision.TIMING
    assert_named(documents[-1], name, 20e3, within=500.0)
    assert [each.reason for each in documents[-1].explanations].count(FaultType.TIMING) == 1


@pytest.mark.parametrize(("seed", "since"), often_rows([(1, 5)], [(1, 5), (2, 5)]))
def test_windows_that_do_not_show_a_delay_do_not_give_it_up(
    scenario: MotorScenario, windows: Cut, seed: int, since: int
) -> None:
    """The load moves in few windows. Between them J explains its delay as well, and it must not win alone."""
    cut = [window for window, _ in windows(scenario.model_copy(update={"faults": (), "seed": seed}), 20)]
    whole, load = np.concatenate([window.values for window in cut]), 1
    first, late = since * len(cut[0].values), whole.copy()
    late[first:, load] = whole[first - 10 : -10, load]  # 100 ms
    known = tuple((row.name, row.nominal) for row in MOTOR.parameters if row.name not in ALL)
    free = tuple(row for row in MOTOR.parameters if row.name in ALL)
    state = initial_state("motor", "bench", Problem(MOTOR, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002)))
    for window, values in zip(cut, np.split(late, len(cut)), strict=True):
        state, report = adapt(state, replace(window, values=values))
        inertia = report.document.parameters["J"]
        if inertia.value is not None and inertia.status is Status.ESTIMATED:
            assert inertia.value == pytest.approx(1.1714e-3, rel=0.2), window.index
    explanations = report.document.explanations
    assert any(each.reason is FaultType.TIMING and each.text.startswith("T_load") for each in explanations)
