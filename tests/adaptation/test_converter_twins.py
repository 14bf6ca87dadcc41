"""Twins for machines on a frequency converter: a fan and an induction motor, integrated with equations of their own."""

import numpy as np
import pytest
from benchmarks.changes.machines import FAN, INDUCTION_MOTOR, in_twin_units, problem_of
from benchmarks.changes.plants import HEALTHY, Change, Plant, cut, generator, simulate

from otolith.adaptation.state import initial_state
from otolith.estimation.information import initial_prior
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.machine import load_machine
from tests.adaptation.plant_runs import events_of, measured, windows_of_runs
from tests.conftest import EXAMPLES
from tests.variants import often

WINDOWS = 40
DEVIATIONS = 4.0  # of the share of covered windows, in which it lies but once in 16 000 tests


@pytest.mark.parametrize("plant", often([FAN], [FAN, INDUCTION_MOTOR]), ids=lambda plant: plant.name)
def test_parameters_are_recovered_with_valid_intervals(plant: Plant) -> None:
    problem = problem_of(plant)
    truth = np.array([in_twin_units(problem.twin, row.name, plant.parameters[row.name]) for row in problem.free])
    found = [
        estimate(problem, window, initial_prior(problem), 1.1 * truth, SwarmSearch.IF_UNEXPLAINED).parameters
        for window in windows_of_runs(plant, problem.twin, [generator(3, plant.name, run) for run in range(WINDOWS)])
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
    run = measured(rows, 0, random, noise, machine.twin.signals)
    state = initial_state("fan", "s", machine.problem, machine.plan)
    events = events_of(state, cut(FAN, run, machine.twin.signals))
    assert not any(events[: count // 2])
    (event,) = events[-1]
    assert (event.condition_id, event.part) == ("fan-air-less", "impeller")
