"""What the ablation searches in: a twin, its unknowns within wide bounds, and windows of many truths."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.estimators.data import APART
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin, load_twin
from otolith.twin.definition import Definition, Input, Parameter, Role
from otolith.twin.kernel import Excitation, kernel_of

RECORDS = 200
HELD = 20  # records that a level of an input lasts
WIDER = 10.0
EXACT = 1e-3  # of the noise: the error that the data's own integration may have
HERE = Path(__file__).parent / "twins"


@dataclass(frozen=True, slots=True)
class Case:
    """One twin."""

    name: str
    problem: Problem
    period: float
    excite: Callable[[np.random.Generator, Definition, Array], Array]


def cases(wider: float) -> tuple[Case, ...]:
    """Four machines of the library, then two whose cost has many valleys, their bounds ``wider`` times as wide."""
    made = (
        _case(find_twin("dc_motor"), 0.01, unknown=("R_a", "J", "D")),
        _case(find_twin("two_mass"), 0.002),
        _case(find_twin("pmsm"), 0.0005),
        _case(find_twin("servo_axis"), 0.005),
        _case(load_twin(HERE / "resonator.toml"), 0.005, _sweep),
        _case(load_twin(HERE / "eccentric.toml"), 0.005),
    )
    return tuple(_widened(case, wider) for case in made)


def windows(case: Case, count: int, seed: int) -> list[tuple[Array, Window]]:
    """Truth (free,) and a window cut from the middle of its motion, of ``count`` machines."""
    random = np.random.default_rng(seed)
    return [_window(case, random, index) for index in range(count)]


def start(problem: Problem, random: np.random.Generator) -> Array:
    """Anywhere within the bounds: of what is positive the order of magnitude is drawn, of the rest the value."""
    low, high = problem.bounds
    share = random.random(len(low))
    orders = np.log(np.maximum(low, 1e-300)), np.log(np.maximum(high, 1e-300))
    return np.where(low > 0.0, np.exp(orders[0] + share * (orders[1] - orders[0])), low + share * (high - low))


def wide(entry: Parameter, wider: float) -> Parameter:
    """So many times wider on either side; a phase repeats, so it stays."""
    if entry.unit == "rad":
        return entry
    low = entry.low / wider if entry.low > 0.0 else entry.low * wider
    return replace(entry, low=low, high=entry.high * wider)


def _widened(case: Case, wider: float) -> Case:
    free = tuple(wide(entry, wider) for entry in case.problem.free)
    return replace(case, problem=replace(case.problem, free=free))


def _levels(random: np.random.Generator, twin: Definition, times: Array) -> Array:
    """Random levels, held or run through, over each input's range."""

    def column(entry: Input) -> Array:
        levels = random.uniform(entry.low, entry.high, len(times) // HELD + 2)
        if entry.hold == "zoh":
            return np.repeat(levels, HELD)[: len(times)]
        return np.interp(np.arange(len(times)), HELD * np.arange(len(levels)), levels)

    return np.column_stack([column(entry) for entry in twin.inputs])


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
    unknown = unknown or tuple(entry.name for entry in twin.parameters if entry.role is Role.ESTIMATED)
    free = tuple(entry for entry in twin.parameters if entry.name in unknown)
    known = tuple((entry.name, entry.nominal) for entry in twin.parameters if entry.name not in unknown)
    return Case(twin.name, Problem(twin, known, free, tuple(o.noise for o in twin.outputs)), period, excite)


def _window(case: Case, random: np.random.Generator, index: int) -> tuple[Array, Window]:
    problem, twin = case.problem, case.problem.twin
    off = np.where(problem.nominal == 0.0, 1.0, problem.nominal)  # of what is nominally nothing: about its unit
    truth = np.where(problem.nominal == 0.0, random.normal(size=len(off)), random.uniform(*APART, len(off)) * off)
    values = dict(problem.known) | dict(zip((entry.name for entry in problem.free), truth, strict=True))
    parameters = np.array([values[entry.name] for entry in twin.parameters])
    initial = np.array([entry.initial for entry in twin.states])
    times: Array = np.multiply(case.period, np.arange(2 * RECORDS), dtype=np.float64)
    inputs = case.excite(random, twin, times)
    drive, noise, kernel = Excitation(inputs, case.period), np.array(problem.noise), kernel_of(twin)
    drive = replace(drive, substeps=kernel.substeps(parameters, initial, drive, EXACT * noise))
    outputs = kernel.simulate(parameters[None], initial[None], drive)[0]
    found = np.column_stack([inputs, outputs + random.normal(size=outputs.shape) * noise])[RECORDS:]
    return truth, Window.whole(index, 0.0, case.period, twin.signals, found)
