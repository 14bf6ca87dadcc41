"""Intervals are honest: over seeded windows with sensor noise they hold the truth as often as they say."""

import numpy as np
import pytest

from otolith.acquisition.window import Array, Quality, Verdict, Window
from otolith.adaptation.estimate import estimate
from otolith.adaptation.problem import Problem
from otolith.twin.kernel import Excitation, kernel_of
from otolith.twins import find_twin

TWIN = find_twin("dc_motor")
TRUTH = {entry.name: entry.nominal for entry in TWIN.parameters}
NOISE = np.array([0.005, 0.02])
WINDOWS, PERIOD, RECORDS = 300, 0.01, 200
GOOD = Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0)


def window(random: np.random.Generator, index: int) -> Window:
    """Random voltage steps, a load that swings, a random initial state, noisy sensors."""
    voltage = np.repeat(random.uniform(4.0, 20.0, 4), RECORDS // 4)
    load = 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * PERIOD * np.arange(RECORDS))
    inputs: Array = np.column_stack([voltage, load])
    initial = random.uniform([0.5, 3.0], [2.0, 15.0])[None]
    parameters = np.array([list(TRUTH.values())])
    outputs = kernel_of(TWIN).simulate(parameters, initial, Excitation(inputs, PERIOD, 4))[0]
    values = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * NOISE])
    return Window(index, 0.0, PERIOD, TWIN.signals, values, np.zeros(values.shape, dtype=np.bool_), GOOD)


@pytest.mark.parametrize("names", [("R_a",), ("R_a", "D"), ("R_a", "D", "L_a"), ("R_a", "K_e", "J", "D")], ids="-".join)
def test_95_percent_are_95_percent(names: tuple[str, ...]) -> None:
    free = tuple(entry for entry in TWIN.parameters if entry.name in names)
    known = tuple((name, value) for name, value in TRUTH.items() if name not in names)
    problem = Problem(TWIN, known, free, tuple(NOISE))
    random = np.random.default_rng(11)
    start = np.array([1.1 * entry.nominal for entry in free])
    inside = np.zeros(len(free))
    for index in range(WINDOWS):
        found = estimate(problem, window(random, index), start, warm=True).parameters
        inside += [abs(entry.value - TRUTH[entry.name]) <= 1.959964 * entry.sd for entry in found]
    share = inside / WINDOWS
    doubt = 3.0 * np.sqrt(0.05 * 0.95 / WINDOWS)  # of the count itself
    assert (np.abs(share - 0.95) <= doubt).all(), share
