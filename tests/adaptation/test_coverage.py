"""Coverage: 95 % intervals contain the truth in 95 % of the windows, and estimates are near the Cramer-Rao bound."""

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.estimation.information import initial_prior
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from tests.variants import often

TWIN = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in TWIN.parameters}
NOISE = np.array([0.005, 0.02])  # A, rad/s
ADC_STEP = np.array([20.0, 100.0]) / 2**12  # A, rad/s: step of 12-bit converters over ±10 A and ±50 rad/s
PERIOD, RECORDS = 0.01, 200
SETS = (
    ("R_a",),
    ("D",),
    ("R_a", "D"),
    ("L_a", "J"),
    ("R_a", "D", "L_a"),
    ("R_a", "K_e", "J"),
    ("R_a", "D", "J", "L_a"),
    ("R_a", "K_e", "J", "D"),
)


def window(random: np.random.Generator, index: int) -> tuple[Window, Array]:
    """A window with random voltage steps, a sinusoidal load, sensor noise and 12-bit converters; its initial state."""
    voltage = np.repeat(random.uniform(4.0, 20.0, 4), RECORDS // 4)
    load = 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * PERIOD * np.arange(RECORDS))
    inputs: Array = np.column_stack([voltage, load])
    initial: Array = random.uniform([0.5, 3.0], [2.0, 15.0])
    parameters = np.array([list(TRUTH.values())])
    outputs = kernel_of(TWIN).simulate(parameters, initial[None], Excitation.uniform(inputs, PERIOD, 4))[0]
    measured = np.rint((outputs + random.normal(size=outputs.shape) * NOISE) / ADC_STEP) * ADC_STEP
    values = np.column_stack([inputs, measured])
    return Window.whole(index, 0.0, PERIOD, TWIN.signals, values), initial


def cramer_rao_bound(problem: Problem, record: Window, initial: Array) -> Array:
    """(free,) Cramer-Rao bound of the standard deviations at the truth, for an unknown initial state."""
    truth = np.array([TRUTH[parameter.name] for parameter in problem.free])
    objective = Objective(problem, record, truth)
    _, jacobian = objective.linearise(np.concatenate([truth, initial]))
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))[: len(truth)])


@pytest.mark.parametrize("windows", [200, pytest.param(2000, marks=pytest.mark.full)])
@pytest.mark.parametrize("names", often([SETS[0], SETS[2], SETS[-1]], SETS), ids="-".join)
def test_95_percent_intervals_cover_the_truth(names: tuple[str, ...], windows: int) -> None:
    free = tuple(parameter for parameter in TWIN.parameters if parameter.name in names)
    known = tuple((name, value) for name, value in TRUTH.items() if name not in names)
    problem = Problem(TWIN, known, free, tuple(NOISE))
    truth = np.array([TRUTH[parameter.name] for parameter in free])
    random = np.random.default_rng(11)
    inside, pulls = np.zeros(len(free)), []
    for index in range(windows):
        record, initial = window(random, index)
        estimates = estimate(
            problem, record, initial_prior(problem), 1.1 * truth, SwarmSearch.IF_UNEXPLAINED
        ).parameters
        errors = np.array([parameter.value for parameter in estimates]) - truth
        inside += np.abs(errors) <= 1.959964 * np.array([parameter.sd for parameter in estimates])
        pulls.append(errors / cramer_rao_bound(problem, record, initial))
    share = inside / windows
    tolerance = 0.02 * np.sqrt(2000 / windows)  # four standard deviations of a share of 95 %
    assert (np.abs(share - 0.95) <= tolerance).all(), share
    assert (np.std(pulls, axis=0) <= 1.1).all(), np.std(pulls, axis=0)
