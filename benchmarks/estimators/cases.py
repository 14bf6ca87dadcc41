"""Cases of the ablation: a twin, its unknowns within wide bounds, and windows with random true values."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.estimators.data import TRUTH_RANGE
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin, load_twin
from otolith.twin.definition import Definition, Input, Parameter, Role
from otolith.twin.kernel import Excitation, kernel_of

RECORDS = 200
LEVEL_RECORDS = 20  # records that a level of an input lasts
BOUNDS_FACTOR = 10.0
EXACT = 1e-3  # of the noise: integration error of the data
HERE = Path(__file__).parent / "twins"


@dataclass(frozen=True, slots=True)
class Case:
    """One twin."""

    name: str
    problem: Problem
    period: float
    excite: Callable[[np.random.Generator, Definition, Array], Array]


def cases(factor: float) -> tuple[Case, ...]:
    """Four machines of the library and two with many local minima, their bounds ``factor`` times as wide."""
    made = (
        _case(find_twin("dc_motor"), 0.01, unknown=("R_a", "J", "D")),
        _case(find_twin("two_mass"), 0.002),
        _case(find_twin("pmsm"), 0.0005),
        _case(find_twin("servo_axis"), 0.005),
        _case(load_twin(HERE / "resonator.toml"), 0.005, _sweep),
        _case(load_twin(HERE / "eccentric.toml"), 0.005),
    )
    return tuple(_widened(case, factor) for case in made)


def windows(case: Case, count: int, seed: int) -> list[tuple[Array, Window]]:
    """True values (free,) and a window from the middle of the motion, of ``count`` machines."""
    random = np.random.default_rng(seed)
    return [_window(case, random, index) for index in range(count)]


def start(problem: Problem, random: np.random.Generator) -> Array:
    """A random point within the bounds, log-uniform if the lower one is positive, uniform otherwise."""
    low, high = problem.bounds
    share = random.random(len(low))
    orders = np.log(np.maximum(low, 1e-300)), np.log(np.maximum(high, 1e-300))
    return np.where(low > 0.0, np.exp(orders[0] + share * (orders[1] - orders[0])), low + share * (high - low))


def widened(parameter: Parameter, factor: float) -> Parameter:
    """Bounds that are ``factor`` times wider on either side; those of a phase stay."""
    if parameter.unit == "rad":
        return parameter
    low = parameter.low / factor if parameter.low > 0.0 else parameter.low * factor
    return replace(parameter, low=low, high=parameter.high * factor)


def _widened(case: Case, factor: float) -> Case:
    free = tuple(widened(parameter, factor) for parameter in case.problem.free)
    return replace(case, problem=replace(case.problem, free=free))


def _levels(random: np.random.Generator, twin: Definition, times: Array) -> Array:
    """Random levels over each input's range, held or interpolated."""

    def column(signal: Input) -> Array:
        levels = random.uniform(signal.low, signal.high, len(times) // LEVEL_RECORDS + 2)
        if signal.hold == "zoh":
            return np.repeat(levels, LEVEL_RECORDS)[: len(times)]
        return np.interp(np.arange(len(times)), LEVEL_RECORDS * np.arange(len(levels)), levels)

    return np.column_stack([column(signal) for signal in twin.inputs])


def _sweep(_: np.random.Generator, twin: Definition, times: Array) -> Array:
    """From 1 to 20 Hz and back, once a window."""
    length = RECORDS * (times[1] - times[0])
    rate = 2.0 * np.pi * (10.5 - 9.5 * np.cos(2.0 * np.pi * times / length))
    phase = np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(times))])
    return np.asarray(twin.inputs[0].high * np.sin(phase)[:, None])


def _case(
    twin: Definition,
    period: float,
    excite: Callable[[np.random.Generator, Definition, Array], Array] = _levels,
    unknown: tuple[str, ...] = (),
) -> Case:
    unknown = unknown or tuple(parameter.name for parameter in twin.parameters if parameter.role is Role.ESTIMATED)
    free = tuple(parameter for parameter in twin.parameters if parameter.name in unknown)
    known = tuple((parameter.name, parameter.nominal) for parameter in twin.parameters if parameter.name not in unknown)
    return Case(twin.name, Problem(twin, known, free, tuple(output.noise for output in twin.outputs)), period, excite)


def _window(case: Case, random: np.random.Generator, index: int) -> tuple[Array, Window]:
    problem, twin = case.problem, case.problem.twin
    scale = np.where(problem.nominal == 0.0, 1.0, problem.nominal)  # a nominal value of zero: one unit
    truth = np.where(
        problem.nominal == 0.0, random.normal(size=len(scale)), random.uniform(*TRUTH_RANGE, len(scale)) * scale
    )
    values = dict(problem.known) | dict(zip((parameter.name for parameter in problem.free), truth, strict=True))
    parameters = np.array([values[parameter.name] for parameter in twin.parameters])
    initial = np.array([state.initial for state in twin.states])
    times: Array = np.multiply(case.period, np.arange(2 * RECORDS), dtype=np.float64)
    inputs = case.excite(random, twin, times)
    drive, noise, kernel = Excitation.uniform(inputs, case.period), np.array(problem.noise), kernel_of(twin)
    drive = replace(drive, substeps=kernel.substeps(parameters, initial, drive, EXACT * noise))
    outputs = kernel.simulate(parameters[None], initial[None], drive)[0]
    signals = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * noise])[RECORDS:]
    return truth, Window.whole(index, 0.0, case.period, twin.signals, signals)
