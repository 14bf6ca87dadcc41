"""Machines whose load is measured with an error that no machine file states: process noise contains it."""

import numpy as np
import pytest
from benchmarks.changes.healthy import MACHINES, Ageing, cases
from benchmarks.changes.machines import DC_MOTOR, in_twin_units
from benchmarks.changes.observe import Case, recordings
from benchmarks.changes.plants import HEALTHY, Plant

from otolith.acquisition.window import Array, Window
from otolith.commissioning.identification import identify_noise
from otolith.commissioning.structure import remaining_structure
from otolith.estimation.information import QUANTILE, initial_prior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import estimate

WINDOWS, RUNS = 12, 8
LOADED = [machine for machine in MACHINES if machine.load == "T_load"]


def coverage(machine: Ageing, *, learned: bool) -> dict[str, float]:
    """Return the share of 95 % intervals that hold the truth, in single windows that noise was not learned from."""
    (case,) = cases(WINDOWS, [f"{machine.plant.name}: load noise"])
    first, *records = recordings(case, case.problem, range(RUNS + 1), seed=1)
    problem = identify_noise(case.problem, first).applied(case.problem) if learned else case.problem
    held = np.array([inside(problem, window, machine) for record in records for window in record])
    return dict(zip((parameter.name for parameter in problem.free), held.mean(axis=0).tolist(), strict=True))


def inside(problem: Problem, window: Window, machine: Ageing) -> list[bool]:
    """Whether the interval of each free parameter holds the truth."""
    rows = estimate(problem, window, initial_prior(problem), problem.nominal).parameters
    truth = [in_twin_units(problem.twin, row.name, machine.plant.parameters[row.name]) for row in rows]
    return [abs(row.value - value) <= QUANTILE * row.sd for row, value in zip(rows, truth, strict=True)]


@pytest.mark.full
@pytest.mark.parametrize("machine", LOADED, ids=lambda machine: machine.plant.name)
def test_identified_noise_makes_intervals_right_under_load_noise(machine: Ageing) -> None:
    """Of 96 windows: 95 % less two of its standard deviations, 2.2 % each."""
    shares = coverage(machine, learned=True)
    assert min(shares.values()) >= 0.90
    assert np.mean(list(shares.values())) >= 0.93


@pytest.mark.full
@pytest.mark.parametrize("machine", LOADED, ids=lambda machine: machine.plant.name)
def test_intervals_are_too_narrow_if_nothing_states_the_noise_of_the_load(machine: Ageing) -> None:
    """The innovations of each window are too few to show it: noise must be identified."""
    assert min(coverage(machine, learned=False).values()) < 0.90


def with_slow_load(random: np.random.Generator, plant: Plant, rows: dict[str, Array]) -> None:
    """Hide a part of the load that changes slowly: 0.002 N*m, correlated over half a second."""
    share, load = np.exp(-plant.period / 0.5), np.zeros(len(rows["T_load"]))
    shocks = 0.002 * np.sqrt(1.0 - share**2) * random.standard_normal(len(load))
    for record in range(1, len(load)):
        load[record] = share * load[record - 1] + shocks[record]
    rows["T_load"] = rows["T_load"] - load


@pytest.mark.parametrize("seed", [0, pytest.param(7, marks=pytest.mark.full)])
def test_a_slow_load_is_inconsistent_and_coloured_and_no_structure(seed: int) -> None:
    """White process noise that explains its changes lets sines of low frequency gain; seed 7 has one."""
    case = Case("slow load", DC_MOTOR, HEALTHY, healthy=24, changed=0, disturb=with_slow_load)
    (windows,) = recordings(case, case.problem, [0], seed)
    noise = identify_noise(case.problem, windows)
    assert noise.consistency.factor is not None
    assert noise.consistency.factor > 2.0
    assert not all(row.is_white for row in noise.whiteness)
    assert remaining_structure(case.problem, noise, windows) == []
