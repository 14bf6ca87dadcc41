"""What every scenario says, whatever the machine: seed, bus, sampling, and what happens to it.

The table of simulated machines: one row each.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import count, repeat
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, model_validator

from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.config_files import StrictModel, expect, parse, read, validate
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.plant.faults import (
    Array,
    Distortion,
    Drift,
    Fault,
    Offset,
    PlantSample,
    SensorFault,
    Spikes,
    Step,
    Unbalance,
    distorted,
    generator,
)
from otolith_drivers.plant.register_map import ModbusOptions, RegisterMap
from otolith_drivers.units import Quantity

POSITIVE = 1e-12
SENSORS = 3  # with noise, on every machine
STRETCH_PERIODS = 256  # numpy's overhead is shared by so many, and a node in real time is held up for few ms
STRETCH_STEPS = 32768  # at most, however many a sample period has


class Scenario(StrictModel):
    """The part of a scenario file that all machines share."""

    UNITS: ClassVar[dict[str, str]]
    """Of each parameter that a fault may change."""
    SIGNALS: ClassVar[dict[str, str]]
    """What the machine measures, and the unit of each."""
    HAS_SHAFT: ClassVar[bool] = False
    """Whether an unbalance means anything."""

    plant: str
    seed: int = 1
    integrator: Literal["accurate", "euler"] = "accurate"
    """``euler`` at 0.1 ms is the paper's plant; a real machine is continuous."""
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-3, 1.0))] = 0.01
    dbc: Path
    bus: BusOptions = BusOptions()
    modbus: ModbusOptions = ModbusOptions()
    parameters: Any
    noise: Any
    """Standard deviation of each sensor."""
    faults: tuple[Fault, ...] = ()

    @model_validator(mode="after")
    def _faults_fit(self) -> Self:
        for fault in self.faults:
            if isinstance(fault, Unbalance):
                self._check_unbalance(fault)
            elif isinstance(fault, Drift | Step):
                _check_name(fault.parameter, "parameter", self.UNITS)
                self.amount(fault)
            elif isinstance(fault, SensorFault):
                _check_name(fault.signal, "signal", self.SIGNALS)
                self.amount(fault)
        return self

    @model_validator(mode="after")
    def _registers_fit(self) -> Self:
        RegisterMap(self.modbus, self.SIGNALS)
        return self

    def _check_unbalance(self, fault: Unbalance) -> None:
        if not self.HAS_SHAFT:
            raise ValueError(f"plant {self.plant!r} has no shaft that could be out of balance")
        if (fault.frequency is None) == (fault.order is None):
            raise ValueError("an unbalance has either a frequency or an order of the shaft angle")

    def amount(self, fault: Drift | Step | SensorFault) -> float:
        """Of a fault, in the unit of its parameter or signal; 0 of one that has none."""
        match fault:
            case Drift() | Step():
                return Quantity(self.UNITS[fault.parameter])(fault.amount)
            case Offset() | Spikes():
                return Quantity(self.SIGNALS[fault.signal], difference=True)(fault.amount)
        return 0.0

    def distortions(self) -> list[tuple[SensorFault, Distortion]]:
        """What its sensors do to their signals, anew from the start; each has random numbers of its own."""
        return [
            (fault, fault.distortion(self.amount(fault), generator(self.seed, number)))
            for number, fault in enumerate(self.faults)
            if isinstance(fault, SensorFault)
        ]


def _check_name(name: str, what: str, known: dict[str, str]) -> None:
    if name not in known:
        raise ValueError(f"a fault names {what} {name!r}: {nearest(name, list(known))}")


@dataclass(frozen=True, slots=True)
class Stretch:
    """Some sample periods in a row, and what is known of them before the machine has lived them."""

    times: Array
    """Of the sampling instants, s."""
    noise: list[list[float]]
    """Of each sensor at each of them, in standard deviations."""
    truth: list[dict[str, float]]
    """The parameters at each of them."""
    moments: Array
    """When each step of the integrator begins, s: a row for each step, a column for each sample period."""
    parameters: dict[str, Any]
    """In each step: an array like ``moments``, or the number that holds in all of them."""

    def steps(self, index: int, columns: Iterable[Any]) -> Iterator[tuple[float, ...]]:
        """Of one sample period the steps: the moment of each, and what ``columns``, like parameters, say of it."""
        values = (column[:, index].tolist() if isinstance(column, np.ndarray) else repeat(column) for column in columns)
        return zip(self.moments[:, index].tolist(), *values, strict=False)


def stretches(scenario: Scenario, steps: int, where: float) -> Iterator[Stretch]:
    """The time of ``scenario`` without end, each sample period divided into ``steps``.

    The parameters of a step are those that hold at ``where`` in it: 0 at its beginning, 0.5 in its middle.
    """
    random = np.random.default_rng(scenario.seed)
    changes = [(fault, scenario.amount(fault)) for fault in scenario.faults if isinstance(fault, Drift | Step)]
    size = max(1, min(STRETCH_PERIODS, STRETCH_STEPS // steps))
    step = scenario.sample_period / steps
    begins = step * np.arange(steps, dtype=np.float64)[:, np.newaxis]
    for first in count(0, size):
        times = np.arange(first, first + size, dtype=np.float64) * scenario.sample_period
        now = _parameters(scenario, changes, times)
        values = zip(*(np.broadcast_to(value, size).tolist() for value in now.values()), strict=True)
        yield Stretch(
            times=times,
            noise=random.standard_normal((size, SENSORS)).tolist(),
            truth=[dict(zip(now, row, strict=True)) for row in values],
            moments=times + begins,
            parameters=_parameters(scenario, changes, times + begins + where * step),
        )


def _parameters(scenario: Scenario, changes: list[tuple[Drift | Step, float]], times: Array) -> dict[str, Any]:
    """Each parameter at ``times`` (s), in its unit: an array, or a number if nothing changes it meanwhile."""
    values: dict[str, Any] = dict(scenario.parameters)
    for fault, amount in changes:
        change = fault.change(times, amount)
        values[fault.parameter] += change if np.ptp(change) else change.item(0)
    return values


# Each module has SCENARIO, the model of its scenario files, and simulate(scenario), its ticks without end.
PLANTS = {
    "dc_motor": "otolith_drivers.plant.dc_motor",
    "hydraulic_actuator": "otolith_drivers.plant.hydraulic_actuator",
}


def load_scenario(path: Path) -> Scenario:
    """The scenario in ``path``, the files that it names made relative to it.

    Raises:
        ConfigurationError: unreadable, an unknown plant, or one line per fault.
    """
    page = read(path)
    data = parse(page)
    expect(page, data, "plant")
    name = data.get("plant")
    if not isinstance(name, str) or name not in PLANTS:
        raise ConfigurationError(f"{page.place(('plant',))}: no plant {name!r}: {nearest(str(name), list(PLANTS))}")
    scenario: Scenario = validate(data, _module(name).SCENARIO, page)
    line = scenario.modbus.line
    modbus = scenario.modbus.model_copy(update={"line": None if line is None else path.parent / line})
    return scenario.model_copy(update={"dbc": path.parent / scenario.dbc, "modbus": modbus})


def simulate(scenario: Scenario) -> Iterator[PlantSample]:
    """The machine of ``scenario``, one tick per sample period, without end; the same for the same seed.

    What is measured is as its sensors say it, faults included; what happens on the bus is not in it.
    """
    ticks: Iterator[PlantSample] = _module(scenario.plant).simulate(scenario)
    distortions = scenario.distortions()
    return distorted(ticks, distortions) if distortions else ticks


def _module(name: str) -> Any:
    return import_module(PLANTS[name])
