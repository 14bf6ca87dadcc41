"""The paper's scenarios, one row each, and the sensors that the noise study gives their machines.

The paper's scenarios in which something appears that the twin does not know, one row each.

A scenario lived through once: what the sensors said and what was true, to be cut into windows of any length.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.cli.common import examples_directory
from otolith.estimation.problem import Problem
from otolith.machine import LoadedMachine, load_machine
from otolith_drivers.plant.scenario import load_scenario, simulate
from otolith_drivers.units import factor

PEAK = 5.0  # times what 99 % of the errors must stay below: what the largest may reach


@dataclass(frozen=True, slots=True)
class Row:
    """A scenario in which one parameter drifts and is sought."""

    name: str
    """Of the scenario file."""
    title: str
    machine: str
    """The machine file, for its twin, its known parameters and its noise."""
    parameter: str
    """The one that is sought; all others are known."""
    seconds: float
    paper: float
    """What the paper's relative error stays below, but for peaks."""
    target: float
    """What 99 % of our relative errors shall stay below."""
    figures: tuple[str, str, str]
    """The paper's numbers for the value over time, its error, and the outputs; empty for a figure it does not have."""


# The text of section 5.3.1 sees a change of the damping that its formula is a hundred times too small for: hence two.
ROWS = (
    Row(
        name="armature-resistance",
        title="armature resistance",
        machine="dc-motor",
        parameter="R_a",
        seconds=1200.0,
        paper=0.002,
        target=0.0002,
        figures=("7", "8", "9"),
    ),
    Row(
        name="bearing-wear",
        title="bearing wear",
        machine="dc-motor",
        parameter="D",
        seconds=1200.0,
        paper=0.005,
        target=0.0005,
        figures=("10", "11", ""),
    ),
    Row(
        name="hydraulic-fluid",
        title="hydraulic fluid, as the formula is written",
        machine="hydraulic-actuator",
        parameter="D",
        seconds=600.0,
        paper=0.03,
        target=0.003,
        figures=("15", "16", "17-18"),
    ),
    Row(
        name="hydraulic-fluid-visible",
        title="hydraulic fluid, a hundred times larger",
        machine="hydraulic-actuator",
        parameter="D",
        seconds=600.0,
        paper=0.03,
        target=0.003,
        figures=("15", "16", "17-18"),
    ),
)
NAMES = tuple(row.name for row in ROWS)


def row_of(name: str) -> Row:
    """The row of that name."""
    return next(row for row in ROWS if row.name == name)


@dataclass(frozen=True, slots=True)
class Sensor:
    """A noisy sensor behind a converter of 12 bit."""

    signal: str
    """Of the twin."""
    plant: str
    """Its name among the noises of the plant."""
    unit: str
    noise: float
    """Standard deviation."""
    low: float
    high: float

    @property
    def quantum(self) -> float:
        """The converter's step."""
        return (self.high - self.low) / 2**12

    @property
    def deviation(self) -> float:
        """Standard deviation of noise and rounding together."""
        return math.hypot(self.noise, self.quantum / math.sqrt(12.0))


# By machine file. What the drive commands, voltage and valve, it knows without a sensor.
SENSORS = {
    "dc-motor": (
        Sensor("i", "current", "A", 0.005, -10.0, 10.0),
        Sensor("omega", "speed", "rad/s", 0.02, -50.0, 50.0),
        Sensor("T_load", "load_torque", "N*m", 0.0002, -0.5, 0.5),
    ),
    "hydraulic-actuator": (
        Sensor("x", "position", "m", 1e-5, -0.5, 0.5),
        Sensor("p", "pressure", "Pa", 0.2, 0.0, 60e3),
    ),
}
# By machine file: the signal whose noise can hide the parameter; damping is 7 Pa of the lift's pressure of 50 kPa.
HIDING = {"hydraulic-actuator": "p"}


NOISE = 0.005  # standard deviation of a sensor, as a share of that of its signal


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a component that is to be found."""

    name: str
    """In the report."""
    target: float | None = None
    """What its relative error shall stay below from the discovery on, with ideal sensors; None for no target."""
    noisy: float | None = None
    """The same with noisy sensors."""
    paper: float | None = None
    """The paper's relative error."""
    over: str = ""
    """The parameter by which the paper divides it, if it does."""
    unit: str = ""
    """The paper's, if it divides."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """A scenario in which a component appears."""

    name: str
    """Of the scenario file."""
    title: str
    machine: str
    """The machine file, for its twin, its known parameters and its noise."""
    parameter: str
    """The one that is estimated all the while; all others are known."""
    seconds: float
    component: str
    """The key that it has to be found as."""
    numbers: tuple[Number, ...]
    output: str
    """The one whose prediction the paper looks at."""
    within: float
    """What its largest error shall stay below from the discovery on, in its unit, with ideal sensors."""
    paper: tuple[float, float] | None
    """The paper's largest errors before and after the discovery; None for what it does not say."""
    figures: tuple[str, str]
    """The paper's numbers for the outputs before and after."""
    sensors: tuple[Sensor, ...] = ()
    """Noisy ones; none for noise in proportion to the signals (:data:`NOISE`)."""


UNKNOWNS = (
    Unknown(
        name="unbalance",
        title="unbalanced shaft",
        machine="dc-motor",
        parameter="R_a",
        seconds=120.0,
        component="shaft/periodic/t",
        numbers=(
            Number("amplitude", target=2e-4, paper=0.016, over="J", unit="rad/s^2"),
            Number("frequency", target=2e-5, paper=0.0022),
            Number("phase"),
        ),
        output="omega",
        within=5e-4,
        paper=(0.5, 0.02),
        figures=("12", "13"),
        sensors=SENSORS["dc-motor"],
    ),
    Unknown(
        name="hydraulic-leak",
        title="internal leak",
        machine="hydraulic-actuator",
        parameter="D",
        seconds=600.0,
        component="pressure/constant",
        numbers=(Number("amplitude", target=1e-6, noisy=0.01, paper=4.5e-7),),
        output="p",
        within=0.2,
        paper=None,
        figures=("19-20", "21-22"),
    ),
)

UNKNOWN_NAMES = tuple(row.name for row in UNKNOWNS)


def unknown_of(name: str) -> Unknown:
    """The row of that name."""
    return next(row for row in UNKNOWNS if row.name == name)


CHUNK = 200  # records between two calls that tell of progress


class Lived(Protocol):
    """A row of any kind."""

    @property
    def name(self) -> str:
        """Of the scenario file."""

    @property
    def machine(self) -> str:
        """The machine file."""

    @property
    def parameter(self) -> str:
        """The one that is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """A simulated machine's signals, and its parameter as it really was."""

    signals: tuple[str, ...]
    """Of the twin."""
    period: float
    """s."""
    values: Array
    """(records, signals)."""
    truth: Array
    """(records + 1,) at each record, and at the end of the last."""

    def windows(self, records: int) -> Iterator[Window]:
        """As the daemon would cut them; what is left over at the end makes none."""
        for index in range(len(self.values) // records):
            first = index * records
            values = self.values[first : first + records]
            yield Window.whole(index, first * self.period, self.period, self.signals, values)

    def with_noise(self, deviations: Mapping[str, float], seed: int) -> "Life":
        """As other sensors would have seen the same life: for signals that no controller acts upon."""
        random = np.random.default_rng(seed)
        values = self.values.copy()
        for name, deviation in deviations.items():
            values[:, self.signals.index(name)] += deviation * random.standard_normal(len(values))
        return replace(self, values=values)


def plan_of(row: Lived) -> LoadedMachine:
    """What the row's machine file means.

    Raises:
        OtolithError: it cannot be used.
    """
    return load_machine(examples_directory() / f"{row.machine}.toml", with_driver=False)


def problem_of(row: Lived, plan: LoadedMachine, deviations: Mapping[str, float]) -> Problem:
    """The plan's, with the row's parameter sought and all others known, told ``deviations`` of the sensors.

    An input that is measured by an ideal sensor is exact; outputs are weighed as the machine file says.
    """
    problem, twin = plan.problem, plan.twin
    nominal = dict(problem.known) | {entry.name: entry.nominal for entry in problem.free}
    sought = next((entry for entry in problem.free if entry.name == row.parameter), twin.parameter(row.parameter))
    return replace(
        problem,
        known=tuple((name, value) for name, value in nominal.items() if name != row.parameter),
        free=(replace(sought, nominal=nominal[row.parameter]),),
        noise=tuple(deviations.get(entry.name, own) for entry, own in zip(twin.outputs, problem.noise, strict=True)),
        input_noise=tuple(deviations.get(entry.name, 0.0) for entry in twin.inputs),
    )


def live(row: Lived, plan: LoadedMachine, seconds: float, sensors: Sequence[Sensor], lived: Callable[[], None]) -> Life:
    """Simulate the row's scenario, with ideal sensors if none are given; ``lived`` is called after every 200 records.

    Raises:
        OtolithError: the scenario file cannot be used.
    """
    scenario = load_scenario(examples_directory() / "scenarios" / f"{row.name}.toml")
    noise = {sensor.plant: sensor.noise for sensor in sensors}
    scenario = scenario.model_copy(update={"noise": scenario.noise.model_copy(update=noise)})
    sources = [str(plan.file.signals[name]["signal"]) for name in plan.twin.signals]
    records = round(seconds / scenario.sample_period)
    values, truth = np.empty((records + 1, len(sources))), np.empty(records + 1)
    for index, tick in enumerate(islice(simulate(scenario), records + 1)):
        values[index] = [tick.measured[source] for source in sources]
        truth[index] = tick.truth[row.parameter]
        if index % CHUNK == CHUNK - 1:
            lived()
    units = scenario.SIGNALS
    for column, (name, source) in enumerate(zip(plan.twin.signals, sources, strict=True)):
        scale, offset = factor(units[source], plan.twin.unit_of(name))
        values[:, column] = scale * values[:, column] + offset
    for sensor in sensors:
        column = plan.twin.signals.index(sensor.signal)
        clipped = np.clip(values[:, column], sensor.low, sensor.high - sensor.quantum)
        values[:, column] = sensor.low + np.rint((clipped - sensor.low) / sensor.quantum) * sensor.quantum
    return Life(plan.twin.signals, scenario.sample_period, values[:records], truth)
