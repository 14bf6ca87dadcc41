"""The windows of the comparison: DC motors with R_a, D and J unknown, a few consecutive windows each."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
FREE = ("R_a", "D", "J")
KNOWN = {parameter.name: parameter.nominal for parameter in TWIN.parameters if parameter.name not in FREE}
NOISE = np.array([0.005, 0.02])
PERIOD, RECORDS = 0.01, 200
MAX_WINDOWS = 20  # scored windows of one machine
RUN_IN_WINDOWS = 1  # windows before them, for methods that carry a state
TRUTH_RANGE = (0.7, 1.4)  # of the nominal values: no method starts at the truth
SUBSTEPS = 8  # substeps: the error of the data is far below that of any method


@dataclass(frozen=True, slots=True, eq=False)
class Machine:
    """A simulated motor and its windows."""

    truths: Array
    """(windows, free), each at the window's end."""
    windows: tuple[Window, ...]
    """Consecutive; the first :data:`RUN_IN` are not scored."""


def problem() -> Problem:
    """The estimation problem, the same for all methods."""
    free = tuple(TWIN.parameter(name) for name in FREE)
    return Problem(TWIN, tuple(KNOWN.items()), free, tuple(NOISE))


def full(values: Array) -> Array:
    """(particles, free) -> (particles, parameters of the twin)."""
    columns = {name: values[:, index] for index, name in enumerate(FREE)}
    return np.column_stack([columns.get(p.name, np.full(len(values), p.nominal)) for p in TWIN.parameters])


def inputs_of(window: Window) -> Array:
    """(records, inputs)."""
    return np.column_stack([window.column(signal.name) for signal in TWIN.inputs])


def outputs_of(window: Window) -> Array:
    """(records, outputs)."""
    return np.column_stack([window.column(signal.name) for signal in TWIN.outputs])


def machines(scored: int, drift: float, seed: int) -> Iterator[Machine]:
    """Machines with ``scored`` windows in all; each parameter changes by ``drift`` per hour, relative."""
    random = np.random.default_rng(seed)
    while scored > 0:
        windows_per_machine = min(MAX_WINDOWS, scored)
        yield _machine(random, windows_per_machine + RUN_IN_WINDOWS, drift)
        scored -= windows_per_machine


def _machine(random: np.random.Generator, windows_per_machine: int, drift: float) -> Machine:
    """Random steps of the voltage, a sinusoidal load, a random initial state, noisy sensors."""
    truth = random.uniform(*TRUTH_RANGE, size=len(FREE)) * np.array([TWIN.parameter(name).nominal for name in FREE])
    ways = random.choice([-1.0, 1.0], size=len(FREE))
    times = PERIOD * np.arange(RECORDS * windows_per_machine)
    truths = truth * (1.0 + drift / 3600.0 * times[:, None] * ways)
    voltage = np.repeat(random.uniform(4.0, 20.0, 4 * windows_per_machine), RECORDS // 4)
    load = 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * times + random.uniform(0.0, 2.0 * np.pi))
    inputs = np.column_stack([voltage, load])
    outputs = _simulate(truths, random.uniform([0.5, 3.0], [2.0, 15.0]), inputs)
    values = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * NOISE])
    windows = tuple(_window(index, part) for index, part in enumerate(np.split(values, windows_per_machine)))
    return Machine(truths[RECORDS - 1 :: RECORDS], windows)


def _simulate(truths: Array, state: Array, inputs: Array) -> Array:
    """(records, outputs) of a motor whose parameters (records, free) change from record to record."""
    kernel, parameters = kernel_of(TWIN), full(truths)
    outputs = np.empty((len(inputs), len(TWIN.outputs)))
    for record in range(len(inputs)):
        outputs[record] = state  # the motor's outputs are its states
        drive = Excitation.uniform(inputs[record : record + 2], PERIOD, SUBSTEPS)
        state = kernel.simulate(parameters[record : record + 1], state[None], drive)[0, -1]
    return outputs


def _window(index: int, values: Array) -> Window:
    return Window.whole(index, PERIOD * RECORDS * index, PERIOD, TWIN.signals, values)
