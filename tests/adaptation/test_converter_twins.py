"""Twins for machines on a frequency converter: a fan and an induction motor, integrated with equations of their own."""

from collections.abc import Iterator

import numpy as np
import pytest
from benchmarks.changes.machines import FAN, INDUCTION_MOTOR, in_twin_units, problem_of
from benchmarks.changes.plants import HEALTHY, Change, Plant, generator, simulate

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.information import initial_prior
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.machine import load_machine
from otolith.twin.definition import Definition
from tests.conftest import EXAMPLES
from tests.variants import often

WINDOWS = 40
DEVIATIONS = 4.0  # of the share of covered windows, in which it lies but once in 16 000 tests


def windows_of_runs(plant: Plant, twin: Definition, count: int) -> Iterator[Window]:
    """A window of each of as many runs, with the noise of the twin's sensors."""
    randoms = [generator(3, plant.name, run) for run in range(count)]
    rows = simulate(plant, randoms, plant.records, HEALTHY, HEALTHY, 0)
    noise = {output.name: output.noise for output in twin.outputs}
    for run, random in enumerate(randoms):
        values = [rows[name][run] + noise.get(name, 0.0) * random.standard_normal(plant.records)
                  for name in twin.signals]  # fmt: skip
        yield Window.whole(run, 0.0, plant.period, twin.signals, np.column_stack(values))


@pytest.mark.parametrize("plant", often([FAN], [FAN, INDUCTION_MOTOR]), ids=lambda plant: plant.name)
def test_parameters_are_recovered_with_valid_intervals(plant: Plant) -> None:
    problem = problem_of(plant)
    truth = np.array([in_twin_units(problem.twin, row.name, plant.parameters[row.name]) for row in problem.free])
    found = [
        estimate(problem, window, initial_prior(problem), 1.1 * truth, SwarmSearch.IF_UNEXPLAINED).parameters
        for window in windows_of_runs(plant, problem.twin, WINDOWS)
    ]
    errors = np.array([[row.value for row in rows] for rows in found]) - truth
    sds = np.array([[row.sd for row in rows] for rows in found])
    share = (np.abs(errors) <= 1.959964 * sds).mean(axis=0)
    assert (np.abs(share - 0.95) <= DEVIATIONS * np.sqrt(0.95 * 0.05 / WINDOWS)).all(), share
    assert (np.median(sds, axis=0) <= 0.05 * truth).all(), np.median(sds, axis=0) / truth


@pytest.mark.full
def test_a_clogged_filter_is_named_and_a_healthy_fan_is_silent() -> None:
    machine = load_machine(EXAMPLES / "fan-vfd.toml", with_driver=False)
    count, random = 16, generator(4, "clogged", 0)
    clogged = Change(parameters={"k_air": 0.7 * FAN.parameters["k_air"]})
    rows = simulate(FAN, [random], count * FAN.records, HEALTHY, clogged, count // 2 * FAN.records)
    noise = {"omega": machine.problem.noise[0], "T_m": machine.problem.input_noise[0]}
    values = np.column_stack([
        rows[name][0] + noise[name] * random.standard_normal(count * FAN.records) for name in machine.twin.signals
    ])  # fmt: skip
    state, events = initial_state("fan", "s", machine.problem, machine.plan), []
    for index in range(count):
        part = values[index * FAN.records : (index + 1) * FAN.records]
        start = index * FAN.records * FAN.period
        state, report = adapt(state, Window.whole(index, start, FAN.period, machine.twin.signals, part))
        events.append(report.document.events)
    assert not any(events[: count // 2])
    (event,) = events[-1]
    assert (event.condition_id, event.part) == ("fan-air-less", "impeller")
