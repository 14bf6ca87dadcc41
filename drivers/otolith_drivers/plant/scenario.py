"""Scenarios: what all simulated machines share, the table of machines, and time in chunks for their integrators."""

import math
import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import count, repeat
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.config_files import StrictModel, expect, parse, read, validate
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.modbus.options import BYTES_SWAPPED, LETTERS, WORDS_SWAPPED, Order
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
    fault_random,
)
from otolith_drivers.units import Quantity

# Each module has SCENARIO, the model of its scenario files, and simulate(scenario), its samples without end.
PLANTS = {
    "dc_motor": "otolith_drivers.plant.dc_motor",
    "hydraulic_actuator": "otolith_drivers.plant.hydraulic_actuator",
}
POSITIVE = 1e-12  # lower bound of a parameter that must be above zero, in its unit
SENSORS = 3  # with noise, on every machine
# Engineering choices: large enough to share numpy's overhead, small enough to delay a node in real time by few ms.
CHUNK_PERIODS = 256  # sample periods
CHUNK_STEPS = 32768  # steps of the integrator, at most
SPACING = 2  # registers from one signal to the next, of any type
COUNTER_VALUES = 65536

Type = Literal["float32", "int32", "int16"]

RANGES: dict[Type, tuple[float, float]] = {
    "float32": (-3.4028234e38, 3.4028234e38),
    "int32": (-(2.0**31), 2.0**31 - 1.0),
    "int16": (-(2.0**15), 2.0**15 - 1.0),
}


class NodeModbusOptions(StrictModel):
    """``[modbus]`` of a scenario."""

    host: str = "127.0.0.1"  # Address on which Modbus TCP listens; the default is reachable from this computer only
    port: Annotated[int, Field(ge=1, le=65535)] = 1502
    device: Annotated[int, Field(ge=1, le=247)] = 1
    order: Order = "ABCD"
    type: Type = "float32"
    scale: dict[str, str] = Field(default_factory=dict)  # Value of one count, like "1 mA"; needed for integers
    line: Path | None = None  # Modbus RTU: path of the serial line for the client, relative to the scenario
    baudrate: Annotated[int, Field(ge=300, le=4_000_000)] = 115200
    pace_line: bool = True  # Whether bytes take the time of 8N1 at baudrate; otherwise they arrive at once

    @model_validator(mode="after")
    def _type_fits(self) -> Self:
        if self.type == "float32" and self.scale:
            raise ValueError('scale is for type = "int16" and "int32": a float32 is in the unit of its signal')
        return self


class RegisterMap:
    """The address of each signal, and the content of all registers at a sample."""

    def __init__(self, options: NodeModbusOptions, signals: dict[str, str]) -> None:
        """``signals`` has the unit of each; integers need a scale of each in ``options``.

        Raises:
            ValueError: a scale is missing, of an unknown signal, or in a unit of another dimension.
        """
        self.addresses = {name: SPACING * number for number, name in enumerate(signals)}
        self.counter = SPACING * len(signals)
        self.size = self.counter + 1
        self._format = f">{LETTERS[options.type]}"
        self._range = RANGES[options.type]
        self._scales = _scales(options, signals)

    def encode(self, measured: dict[str, float], index: int, order: Order) -> list[int]:
        """All registers at sample ``index``; a value beyond the range of the type saturates."""
        registers: list[int] = []
        for name in self.addresses:
            registers += self._words(measured[name] / self._scales[name], order)
        return [*registers, index % COUNTER_VALUES]

    def _words(self, value: float, order: Order) -> list[int]:
        low, high = self._range
        within = min(max(value, low), high)
        data = struct.pack(self._format, within if self._format == ">f" else round(within))
        words = list(struct.unpack(f"{'<' if order in BYTES_SWAPPED else '>'}{len(data) // 2}H", data))
        if order in WORDS_SWAPPED:
            words.reverse()
        return [*words, *[0] * (SPACING - len(words))]


def _scales(options: NodeModbusOptions, signals: dict[str, str]) -> dict[str, float]:
    if options.type == "float32":
        return dict.fromkeys(signals, 1.0)
    if unknown := options.scale.keys() - signals.keys():
        text = f"modbus.scale names {min(unknown)!r}, which is no signal; the signals are {', '.join(signals)}"
        raise ValueError(text)
    if missing := [name for name in signals if name not in options.scale]:
        raise ValueError(f"type {options.type!r} needs modbus.scale of {', '.join(missing)}: the value of one count")
    scales = {name: Quantity(unit, difference=True)(options.scale[name]) for name, unit in signals.items()}
    for name, scale in scales.items():
        if not math.isfinite(scale) or scale <= 0.0:
            raise ValueError(f"modbus.scale.{name}: {options.scale[name]!r} must be above zero")
    return scales


class Scenario(StrictModel):
    """The part of a scenario file that all machines share."""

    UNITS: ClassVar[dict[str, str]]  # Unit of each parameter that a fault may change
    SIGNALS: ClassVar[dict[str, str]]  # Unit of each signal that the machine measures
    HAS_SHAFT: ClassVar[bool] = False  # Whether the machine can have an unbalance

    plant: str
    seed: int = 1
    integrator: Literal["accurate", "euler"] = "accurate"  # euler at 0.1 ms is the paper's plant
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-3, 1.0))] = 0.01
    dbc: Path
    bus: BusOptions = BusOptions()
    modbus: NodeModbusOptions = NodeModbusOptions()
    parameters: Any
    noise: Any  # Standard deviation of each sensor
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
            raise ValueError(f"plant {self.plant!r} has no shaft, so it can have no unbalance")
        if (fault.frequency is None) == (fault.order is None):
            raise ValueError("an unbalance needs either a frequency or an order of the shaft angle")

    def amount(self, fault: Drift | Step | SensorFault) -> float:
        """The amount of a fault in the unit of its parameter or signal; 0 if the fault has none."""
        match fault:
            case Drift() | Step():
                return Quantity(self.UNITS[fault.parameter])(fault.amount)
            case Offset() | Spikes():
                return Quantity(self.SIGNALS[fault.signal], difference=True)(fault.amount)
        return 0.0

    def distortions(self) -> list[tuple[SensorFault, Distortion]]:
        """The faults of the sensors with new distortions, each with random numbers of its own."""
        return [
            (fault, fault.distortion(self.amount(fault), fault_random(self.seed, number)))
            for number, fault in enumerate(self.faults)
            if isinstance(fault, SensorFault)
        ]


def _check_name(name: str, what: str, known: dict[str, str]) -> None:
    if name not in known:
        raise ValueError(f"a fault names {what} {name!r}: {nearest(name, list(known))}")


def load_scenario(path: Path, key: tuple[str, ...] = ()) -> Scenario:
    """The scenario in ``path``, at ``key`` of the machine file; the paths in it are made relative to its folder.

    Raises:
        ConfigurationError: unreadable file, an unknown plant, or a line for each wrong key.
    """
    page = read(path, key)
    data = parse(page)
    expect(page, data, "plant")
    name = data.get("plant")
    if not isinstance(name, str) or name not in PLANTS:
        raise ConfigurationError(f"{page.place(('plant',))}: no plant {name!r}: {nearest(str(name), list(PLANTS))}")
    scenario: Scenario = validate(data, import_module(PLANTS[name]).SCENARIO, page)
    line = scenario.modbus.line
    modbus = scenario.modbus.model_copy(update={"line": None if line is None else path.parent / line})
    return scenario.model_copy(update={"dbc": path.parent / scenario.dbc, "modbus": modbus})


def simulate(scenario: Scenario) -> Iterator[PlantSample]:
    """The samples of the machine without end, one per sample period; the same for the same seed.

    Faults of the machine and of its sensors are in them, faults of the bus are not.
    """
    samples: Iterator[PlantSample] = import_module(PLANTS[scenario.plant]).simulate(scenario)
    distortions = scenario.distortions()
    return distorted(samples, distortions) if distortions else samples


@dataclass(frozen=True, slots=True)
class SimulationChunk:
    """Some sample periods in a row, with all that does not depend on the state of the machine."""

    times: Array  # (periods,) sampling instants, s
    noise: list[list[float]]  # Noise of each sensor at each instant, in standard deviations
    truth: list[dict[str, float]]  # The parameters at each instant
    step_times: Array  # (steps, periods) start of each step of the integrator, s
    parameters: dict[str, Any]  # The parameters in each step: an array like step_times, or a number if constant

    def steps(self, index: int, columns: Iterable[Any]) -> Iterator[tuple[float, ...]]:
        """The steps of a sample period: for each its time (s) and its values of ``columns``, shaped like parameters."""
        values = (column[:, index].tolist() if isinstance(column, np.ndarray) else repeat(column) for column in columns)
        return zip(self.step_times[:, index].tolist(), *values, strict=False)


def chunks(scenario: Scenario, steps: int, where: float) -> Iterator[SimulationChunk]:
    """The time of ``scenario`` without end, each sample period divided into ``steps``.

    ``where`` in a step its parameters are taken: 0 at its start, 0.5 in its middle.
    """
    random = np.random.default_rng(scenario.seed)
    changes = [(fault, scenario.amount(fault)) for fault in scenario.faults if isinstance(fault, Drift | Step)]
    size = max(1, min(CHUNK_PERIODS, CHUNK_STEPS // steps))
    step = scenario.sample_period / steps
    starts = step * np.arange(steps, dtype=np.float64)[:, np.newaxis]
    for first in count(0, size):
        times = np.arange(first, first + size, dtype=np.float64) * scenario.sample_period
        now = _parameters(scenario, changes, times)
        values = zip(*(np.broadcast_to(value, size).tolist() for value in now.values()), strict=True)
        yield SimulationChunk(
            times=times,
            noise=random.standard_normal((size, SENSORS)).tolist(),
            truth=[dict(zip(now, row, strict=True)) for row in values],
            step_times=times + starts,
            parameters=_parameters(scenario, changes, times + starts + where * step),
        )


def _parameters(scenario: Scenario, changes: list[tuple[Drift | Step, float]], times: Array) -> dict[str, Any]:
    """Each parameter at ``times`` (s), in its unit: an array, or a number if it is constant."""
    values: dict[str, Any] = dict(scenario.parameters)
    for fault, amount in changes:
        change = fault.change(times, amount)
        values[fault.parameter] += change if np.ptp(change) else change.item(0)
    return values
