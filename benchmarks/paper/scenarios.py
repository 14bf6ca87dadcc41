"""The paper's scenarios, one row each, their sensors, and their simulation into windows of any length."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.cli.common import shipped_directory
from otolith.estimation.problem import Problem
from otolith.machine import LoadedMachine, load_machine
from otolith_drivers.plant.scenario import load_scenario, simulate
from otolith_drivers.units import factor

PEAK = 5.0  # largest error allowed, in multiples of the target for 99 % of the errors
NOISE = 0.005  # standard deviation of a sensor, as a share of that of its signal
CHUNK = 200  # simulated records between two calls of ``on_chunk``


@dataclass(frozen=True, slots=True)
class Row:
    """A scenario in which one parameter drifts and is estimated."""

    name: str
    """Of the scenario file."""
    title: str
    machine: str
    """The machine file, for its twin, its known parameters and its noise."""
    parameter: str
    """The estimated one; all others are known."""
    seconds: float
    paper: float
    """Bound of the paper's relative error, without its peaks."""
    target: float
    """Bound of 99 % of our relative errors."""
    figures: tuple[str, str, str]
    """The paper's figures of the value over time, its error, and the outputs; empty if it has none."""


# Section 5.3.1 reports a change of the damping a hundred times larger than its formula gives: hence two rows.
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
    """A noisy sensor with a 12-bit converter."""

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
    def adc_step(self) -> float:
        """The converter's step."""
        return (self.high - self.low) / 2**12

    @property
    def deviation(self) -> float:
        """Standard deviation of noise and rounding together."""
        return math.hypot(self.noise, self.adc_step / math.sqrt(12.0))


# By machine file. Commands of the drive, voltage and valve, need no sensor.
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
# By machine file: the signal whose noise limits the parameter; damping is 7 Pa of the lift's pressure of 50 kPa.
LIMITING_SIGNAL = {"hydraulic-actuator": "p"}


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a component that is to be discovered."""

    name: str
    """In the report."""
    target: float | None = None
    """Bound of its relative error from the discovery on, with ideal sensors; None for no target."""
    noisy: float | None = None
    """The same with noisy sensors."""
    paper: float | None = None
    """The paper's relative error."""
    over: str = ""
    """The parameter by which the paper divides it, if any."""
    unit: str = ""
    """The paper's unit, if it divides."""


@dataclass(frozen=True, slots=True)
class Unknown:
    """A scenario in which a component appears."""

    name: str
    """Of the scenario file."""
    title: str
    machine: str
    """The machine file, for its twin, its known parameters and its noise."""
    parameter: str
    """The estimated one; all others are known."""
    seconds: float
    component: str
    """Its expected key."""
    numbers: tuple[Number, ...]
    output: str
    """The output whose prediction the paper shows."""
    within: float
    """Bound of its largest error from the discovery on, in its unit, with ideal sensors."""
    paper: tuple[float, float] | None
    """The paper's largest errors before and after the discovery; None if not reported."""
    figures: tuple[str, str]
    """The paper's figures of the outputs before and after."""
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


def unknown_row_of(name: str) -> Unknown:
    """The row of that name."""
    return next(row for row in UNKNOWNS if row.name == name)


class AnyRow(Protocol):
    """What both kinds of rows have."""

    @property
    def name(self) -> str:
        """Of the scenario file."""

    @property
    def machine(self) -> str:
        """The machine file."""

    @property
    def parameter(self) -> str:
        """The estimated one."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRecord:
    """Signals of a simulated machine, and the true values of its parameter."""

    signals: tuple[str, ...]
    """Of the twin."""
    period: float
    """s."""
    values: Array
    """(records, signals)."""
    truth: Array
    """(records + 1,) at each record, and at the end of the last."""

    def windows(self, records: int) -> Iterator[Window]:
        """Consecutive windows of so many records, as the daemon cuts them; an incomplete last one is dropped."""
        for index in range(len(self.values) // records):
            first = index * records
            values = self.values[first : first + records]
            yield Window.whole(index, first * self.period, self.period, self.signals, values)

    def with_noise(self, deviations: Mapping[str, float], seed: int) -> "SimulatedRecord":
        """The same record with other sensors, for signals that no controller uses."""
        random = np.random.default_rng(seed)
        values = self.values.copy()
        for name, deviation in deviations.items():
            values[:, self.signals.index(name)] += deviation * random.standard_normal(len(values))
        return replace(self, values=values)


def machine_of(row: AnyRow) -> LoadedMachine:
    """The row's machine, loaded.

    Raises:
        OtolithError: its file cannot be used.
    """
    return load_machine(shipped_directory("config") / f"{row.machine}.toml", with_driver=False)


def problem_of(row: AnyRow, machine: LoadedMachine, deviations: Mapping[str, float]) -> Problem:
    """The machine's problem with only the row's parameter free, and ``deviations`` as noise of the sensors.

    An input without a deviation is exact; an output without one has the noise of the machine file.
    """
    problem, twin = machine.problem, machine.twin
    nominal = dict(problem.known) | {parameter.name: parameter.nominal for parameter in problem.free}
    estimated = next((free for free in problem.free if free.name == row.parameter), twin.parameter(row.parameter))
    return replace(
        problem,
        known=tuple((name, value) for name, value in nominal.items() if name != row.parameter),
        free=(replace(estimated, nominal=nominal[row.parameter]),),
        noise=tuple(deviations.get(signal.name, own) for signal, own in zip(twin.outputs, problem.noise, strict=True)),
        input_noise=tuple(deviations.get(signal.name, 0.0) for signal in twin.inputs),
    )


def simulate_row(
    row: AnyRow, machine: LoadedMachine, seconds: float, sensors: Sequence[Sensor], on_chunk: Callable[[], None]
) -> SimulatedRecord:
    """The row's scenario, simulated with ``sensors`` or ideal ones; ``on_chunk`` is called every ``CHUNK`` records.

    Raises:
        OtolithError: the scenario file cannot be used.
    """
    scenario = load_scenario(shipped_directory("config") / "scenarios" / f"{row.name}.toml")
    noise = {sensor.plant: sensor.noise for sensor in sensors}
    scenario = scenario.model_copy(update={"noise": scenario.noise.model_copy(update=noise)})
    sources = [str(machine.file.signals[name]["signal"]) for name in machine.twin.signals]
    records = round(seconds / scenario.sample_period)
    values, truth = np.empty((records + 1, len(sources))), np.empty(records + 1)
    for index, tick in enumerate(islice(simulate(scenario), records + 1)):
        values[index] = [tick.measured[source] for source in sources]
        truth[index] = tick.truth[row.parameter]
        if index % CHUNK == CHUNK - 1:
            on_chunk()
    units = scenario.SIGNALS
    for column, (name, source) in enumerate(zip(machine.twin.signals, sources, strict=True)):
        scale, offset = factor(units[source], machine.twin.unit_of(name))
        values[:, column] = scale * values[:, column] + offset
    for sensor in sensors:
        column = machine.twin.signals.index(sensor.signal)
        clipped = np.clip(values[:, column], sensor.low, sensor.high - sensor.adc_step)
        values[:, column] = sensor.low + np.rint((clipped - sensor.low) / sensor.adc_step) * sensor.adc_step
    return SimulatedRecord(machine.twin.signals, scenario.sample_period, values[:records], truth)
