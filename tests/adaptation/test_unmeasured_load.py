"""A drive without torque sensor: parameters are recovered, intervals cover, faults are named, a healthy run is silent.

The machines are integrated with equations of their own (``benchmarks.changes``); the twin does not see their load.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.changes.machines import INDUCTION_MOTOR, LIBRARY_PLANTS, REVERSING_MOTOR
from benchmarks.changes.plants import HEALTHY, Plant, Values, cut, generator, simulate

from otolith.acquisition.window import Array, Window
from otolith.adaptation.state import initial_state
from otolith.commissioning.identification import identify_noise
from otolith.estimation.information import initial_prior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.schema import EventDocument
from otolith.machine import LoadedMachine, find_twin, load_machine, load_rules
from otolith.twin.definition import Parameter, Role
from otolith.twin.unmeasured import SLOW_CHANGE, Assumption, UnmeasuredInput, without_sensor
from otolith_drivers.plant.faults import Unbalance
from otolith_drivers.plant.scenario import load_scenario
from otolith_drivers.plant.scenario import simulate as simulate_scenario
from otolith_drivers.units import to_base
from tests.adaptation.plant_runs import events_of, measured, windows_of_runs
from tests.conftest import EXAMPLES, SIGNALS

COVERAGE = 0.95
DEVIATIONS = 4.0  # of the share of covered windows, in which it lies but once in 16 000 tests


@dataclass(frozen=True, slots=True)
class Case:
    """A machine and its load."""

    name: str
    plant: Plant
    assumption: Assumption
    load: Callable[[Values], Any] | None  # N·m, of the states; None for a random walk
    truth: dict[str, float]  # Of the parameters that stand for the load
    expression: str = ""

    @property
    def problem(self) -> Problem:
        """The estimation problem without the load's sensor, and with the dynamics that the load shows in."""
        twin = without_sensor(find_twin(self.plant.twin), UnmeasuredInput("T_load", self.assumption, self.expression))
        free = tuple(row for row in twin.parameters if row.role is Role.ESTIMATED)
        known = tuple((row.name, self.true(row)) for row in twin.parameters if row not in free)
        noise, process = (tuple(row.noise for row in twin.outputs), tuple(row.process_noise for row in twin.states))
        return Problem(twin, known, free, noise, process_noise=process if any(process) else ())

    def true(self, row: Parameter) -> float:
        """The value of a parameter, in its unit."""
        coherent = self.plant.parameters.get(row.name)
        return self.truth[row.name] if coherent is None else coherent / to_base(row.unit)[0]


def reversing(plant: Plant, name: str, reach: float) -> Plant:
    """The plant with commands of both signs."""

    def operate(random: np.random.Generator, times: Array) -> dict[str, Array]:
        own = dict(plant.operate(random, times))
        middle = 0.5 * (own[name].min() + own[name].max())
        return own | {name: (own[name] - middle) * reach / max(np.abs(own[name] - middle).max(), 1e-9)}

    return replace(plant, operate=operate)


def dry(torque: float, transition: float, speed: str) -> Callable[[Values], Any]:
    return lambda x: torque * np.tanh(x[speed] / transition)


DC_MOTOR, COULOMB, PMSM, TWO_MASS = (
    LIBRARY_PLANTS[name] for name in ("dc_motor", "dc_motor_coulomb", "pmsm", "two_mass")
)
CASES = (
    Case("dc_motor, constant", DC_MOTOR, Assumption.CONSTANT, lambda _: 0.02, {"T_load": 0.02}),
    Case("dc_motor, friction", replace(REVERSING_MOTOR, steps=20), Assumption.FRICTION, dry(0.012, 0.5, "omega"),
         {"T_load_dry": 0.012, "T_load_speed": 0.5}),
    Case("dc_motor, slow", DC_MOTOR, Assumption.SLOW, None, {}),
    Case("dc_motor_coulomb, friction", COULOMB, Assumption.FRICTION, lambda _: 0.0, {}),
    Case("dc_motor_coulomb, constant", COULOMB, Assumption.CONSTANT, lambda _: 0.015, {"T_load": 0.015}),
    Case("pmsm, constant", PMSM, Assumption.CONSTANT, lambda _: 1.5, {"T_load": 1.5}),
    Case("pmsm, squared", PMSM, Assumption.PROPORTIONAL, lambda x: 1e-3 * x["omega"] * np.abs(x["omega"]),
         {"T_load_factor": 1e-3}, "omega*abs(omega)"),
    Case("induction_motor, squared", INDUCTION_MOTOR, Assumption.PROPORTIONAL,
         lambda x: 5e-4 * x["omega"] * np.abs(x["omega"]), {"T_load_factor": 5e-4}, "omega*abs(omega)"),
    Case("two_mass, friction", reversing(TWO_MASS, "T_m", 3.0), Assumption.FRICTION, dry(0.2, 0.5, "omega_l"),
         {"T_load_dry": 0.2, "T_load_speed": 0.5}),
)  # fmt: skip


def windows_of(case: Case, count: int) -> Iterator[Window]:
    """Windows of as many runs, with the noise of the twin's sensors."""
    plant, load, twin = case.plant, case.load, case.problem.twin
    if load is not None:
        own = plant.rates
        plant = replace(plant, rates=lambda x, u, q: own(x, {**u, "T_load": load(x)}, q))
    else:
        plant = replace(plant, operate=_walking(plant))
    yield from windows_of_runs(plant, twin, [generator(7, case.name, run) for run in range(count)])


def _walking(plant: Plant) -> Callable[[np.random.Generator, Array], Values]:
    """The operation of a plant whose load is a random walk of the rate that the twin assumes."""
    driven = next(row for row in find_twin(plant.twin).inputs if row.name == "T_load")

    def operate(random: np.random.Generator, times: Array) -> Values:
        change = SLOW_CHANGE * (driven.high - driven.low) * np.sqrt(plant.period)
        walk = 0.02 + np.cumsum(change * random.standard_normal(len(times)))
        return {**plant.operate(random, times), "T_load": walk}

    return operate


@pytest.mark.parametrize(
    ("case", "count"),
    [(case, 25) if case is CASES[0] else pytest.param(case, 100, marks=pytest.mark.full) for case in CASES],
    ids=lambda value: getattr(value, "name", None),
)
def test_parameters_are_recovered_with_valid_intervals(case: Case, count: int) -> None:
    problem = case.problem
    truth = np.array([case.true(row) for row in problem.free])
    errors, sds = [], []
    for window in windows_of(case, count):
        found = estimate(problem, window, initial_prior(problem), problem.nominal, SwarmSearch.IF_UNEXPLAINED)
        errors.append([row.value for row in found.parameters] - truth)
        sds.append([row.sd for row in found.parameters])
    pulls = np.array(errors) / np.array(sds)
    share = (np.abs(pulls) <= 1.959964).mean(axis=0)
    tolerance = DEVIATIONS * np.sqrt(COVERAGE * (1.0 - COVERAGE) / count)
    assert (np.abs(share - COVERAGE) <= tolerance).all(), (share, np.median(np.array(sds), axis=0))
    if case.load is not None:  # what is constant is also determined
        assert (np.median(np.array(sds), axis=0) <= 0.1 * np.abs(truth)).all(), np.median(np.array(sds), axis=0)


def machine_without_torque_sensor(folder: Path, load: str) -> LoadedMachine:
    """The machine of the demo; its damping is estimated too."""
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    for old, new in (
        ('T_load = { signal = "LoadTorque" }', f"T_load = {load}"),
        ('T_load = "0.2 mN*m"', ""),
        ('D = "0.00143 N*m*s/rad"', 'D = { value = "0.00743 N*m*s/rad", estimate = true }'),
    ):
        assert old in text
        text = text.replace(old, new)
    path = folder / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return load_machine(path, with_driver=False)


def announced(
    machine: LoadedMachine, count: int, unbalance: float | None, seed: int = 5
) -> list[tuple[EventDocument, ...]]:
    """The open events after each window of the demo's set-points, with an unbalance (rad/s²) from half of them on."""
    scenario: Any = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    fault = {"kind": "unbalance", "start": f"{count} s", "order": 1.0, "acceleration": f"{unbalance} rad/s^2"}
    faults = () if unbalance is None else (Unbalance.model_validate(fault),)
    samples = simulate_scenario(scenario.model_copy(update={"faults": faults, "seed": seed}))
    names = machine.twin.signals
    rows = ([sample.measured[SIGNALS[name]] for name in names] for sample in samples)
    windows = (Window.whole(k, 2.0 * k, 0.01, names, np.array(list(islice(rows, 200)))) for k in range(count))
    return events_of(initial_state("m", "s", machine.problem, machine.plan), windows)


@pytest.mark.full
@pytest.mark.parametrize("kind", ["friction", "constant", "slow"])
def test_an_unbalance_is_named_and_a_healthy_run_is_silent(kind: str, tmp_path: Path) -> None:
    machine = machine_without_torque_sensor(tmp_path, f'{{ unknown = "{kind}" }}')
    events = announced(machine, 30, 4.0)
    assert not any(events[:15])
    (event,) = events[-1]
    assert event.condition == "unbalanced shaft"
    assert not any(announced(machine, 90, None))


def long_run(case: Case, load: Callable[[Array], Array] | None, count: int) -> list[tuple[EventDocument, ...]]:
    """The open events after each window of one run with ``load`` (N·m) of time (s), by default that of the case."""
    plant = case.plant if load is None else replace(case.plant, operate=_given(case.plant, load))
    plant = replace(plant, operate=_walking(plant)) if case.load is None else plant
    random, records, problem = generator(9, case.name, 0), plant.records, case.problem
    signals = simulate(plant, [random], count * records, HEALTHY, HEALTHY, 0)
    noise = {row.name: row.noise for row in problem.twin.outputs}
    run = measured(signals, 0, random, noise, problem.twin.signals)
    plan = MonitoringPlan(rules=load_rules(), varying=frozenset({"T_load"}))
    return events_of(initial_state("m", "s", problem, plan), cut(plant, run, problem.twin.signals))


def _given(plant: Plant, load: Callable[[Array], Array]) -> Callable[[np.random.Generator, Array], Values]:
    return lambda random, times: {**plant.operate(random, times), "T_load": load(times)}


@pytest.mark.full
def test_a_load_that_changes_in_steps_is_no_event() -> None:
    """Within a window two values hold: it contradicts both, and the next one agrees with the second."""
    case = next(case for case in CASES if case.name == "dc_motor, constant")
    events = long_run(case, lambda times: np.where(np.floor(times / 14.7) % 2 == 0.0, 0.01, 0.03), 60)
    assert not any(events), events


@pytest.mark.full
def test_a_load_that_changes_slowly_is_no_event() -> None:
    case = next(case for case in CASES if case.name == "dc_motor, slow")
    assert not any(long_run(case, None, 100))


@pytest.mark.full
def test_the_rate_of_a_slow_load_is_identified() -> None:
    case = next(case for case in CASES if case.name == "dc_motor, slow")
    windows = [replace(window, index=index, start=2.0 * index) for index, window in enumerate(windows_of(case, 20))]
    levels = {level.name: level.value for level in identify_noise(case.problem, windows).states}
    assert levels["T_load"] == pytest.approx(0.4 * SLOW_CHANGE, rel=0.1)  # N·m: the range is 0.4 wide
