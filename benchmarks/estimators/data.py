"""The windows everybody gets: DC motors of which R_a, D and J are unknown, each living through a few windows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
FREE = ("R_a", "D", "J")
KNOWN = {entry.name: entry.nominal for entry in TWIN.parameters if entry.name not in FREE}
NOISE = np.array([0.005, 0.02])
PERIOD, RECORDS = 0.01, 200
LIFE = 20  # windows of one machine that are scored
RUN_IN = 1  # windows before them, so that who remembers has something to remember
APART = (0.7, 1.4)  # of the nominal values, between which the truth lies: nobody may begin at it
EXACT = 8  # substeps: the data's own error is far below any rival's


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """A motor and what was recorded of it."""

    truths: Array
    """(windows, free), each at the window's end."""
    windows: tuple[Window, ...]
    """One after the other without a gap; the first :data:`RUN_IN` are not scored."""


def problem() -> Problem:
    """The estimation problem, the same for everybody."""
    free = tuple(TWIN.parameter(name) for name in FREE)
    return Problem(TWIN, tuple(KNOWN.items()), free, tuple(NOISE))


def full(values: Array) -> Array:
    """(particles, free) -> (particles, parameters of the twin)."""
    columns = {name: values[:, index] for index, name in enumerate(FREE)}
    return np.column_stack([columns.get(p.name, np.full(len(values), p.nominal)) for p in TWIN.parameters])


def inputs_of(window: Window) -> Array:
    """(records, inputs)."""
    return np.column_stack([window.column(entry.name) for entry in TWIN.inputs])


def outputs_of(window: Window) -> Array:
    """(records, outputs)."""
    return np.column_stack([window.column(entry.name) for entry in TWIN.outputs])


def machines(scored: int, drift: float, seed: int) -> Iterator[Machine]:
    """As many as make ``scored`` windows, the last may live shorter; each parameter changes by ``drift`` an hour."""
    random = np.random.default_rng(seed)
    while scored > 0:
        life = min(LIFE, scored)
        yield _machine(random, life + RUN_IN, drift)
        scored -= life


def _machine(random: np.random.Generator, life: int, drift: float) -> Machine:
    """Random steps of the voltage, a load that swings, a random beginning, noisy sensors."""
    truth = random.uniform(*APART, size=len(FREE)) * np.array([TWIN.parameter(name).nominal for name in FREE])
    ways = random.choice([-1.0, 1.0], size=len(FREE))
    times = PERIOD * np.arange(RECORDS * life)
    truths = truth * (1.0 + drift / 3600.0 * times[:, None] * ways)
    voltage = np.repeat(random.uniform(4.0, 20.0, 4 * life), RECORDS // 4)
    load = 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * times + random.uniform(0.0, 2.0 * np.pi))
    inputs = np.column_stack([voltage, load])
    outputs = _lived(truths, random.uniform([0.5, 3.0], [2.0, 15.0]), inputs)
    values = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * NOISE])
    windows = tuple(_window(index, part) for index, part in enumerate(np.split(values, life)))
    return Machine(truths[RECORDS - 1 :: RECORDS], windows)


def _lived(truths: Array, state: Array, inputs: Array) -> Array:
    """(records, outputs) of a motor whose parameters (records, free) change from record to record."""
    kernel, parameters = kernel_of(TWIN), full(truths)
    found = np.empty((len(inputs), len(TWIN.outputs)))
    for record in range(len(inputs)):
        found[record] = state  # the motor's outputs are its states
        drive = Excitation(inputs[record : record + 2], PERIOD, EXACT)
        state = kernel.simulate(parameters[record : record + 1], state[None], drive)[0, -1]
    return found


def _window(index: int, values: Array) -> Window:
    return Window.whole(index, PERIOD * RECORDS * index, PERIOD, TWIN.signals, values)
