"""Faults of a simulated machine: how a scenario writes each of them, and what it does.

A fault of the machine changes a parameter or shakes the shaft (the laws of the paper, sections 5.2 and 5.3). A fault of
a sensor changes what the bus carries, but neither the true values nor what the controller sees. A fault of the bus
delays, withholds or spoils whole samples. Which samples are hit depends on the seed alone, so a node can report them.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.modbus.options import Order
from otolith_drivers.units import Quantity

Array = NDArray[np.float64]
Seconds = Annotated[float, BeforeValidator(Quantity("s", 0.0, 1e9))]
Share = Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))]  # Of the samples that are hit, as a probability

ROUNDING = 1e-9  # s; rounding error of a sample's time, a multiple of the sample period
# Engineering choice: jitter delays by 3 standard deviations on average, so only 0.13 % are clipped at zero. Guarded by
# test_faults.py.
MEAN_DELAY = 3.0  # standard deviations
GARBAGE_LENGTHS = 3, 12  # bytes; at least, and below; engineering choice: as long as short frames of CAN and Modbus
REGISTERS = 65536  # that a Modbus address can name
CAN, MODBUS_TCP, MODBUS_RTU, IN_PROCESS = "can", "modbus-tcp", "modbus-rtu", "in-process"
MODBUS = frozenset({MODBUS_TCP, MODBUS_RTU})
ALL_TRANSPORTS = MODBUS | {CAN, IN_PROCESS}
Transport = Literal["can", "modbus-tcp", "modbus-rtu", "in-process"]


@dataclass(frozen=True, slots=True)
class PlantSample:
    """The machine at one sampling instant."""

    time: float  # s since the start of the scenario
    measured: dict[str, float]  # Signals by their name on the bus, as the sensors measure them
    truth: dict[str, float]  # The parameters, and the states without noise


def fault_random(seed: int, number: int) -> np.random.Generator:
    """Random numbers of fault ``number`` of a scenario; independent of other faults and of the sensor noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


class Span(StrictModel):
    """A fault that acts from ``start`` on and before ``until``."""

    start: Seconds
    until: Seconds = 1e9

    @model_validator(mode="after")
    def _is_a_span(self) -> Self:
        if self.until <= self.start:
            raise ValueError(f"until ({self.until:g} s) must be later than start ({self.start:g} s)")
        return self

    def covers(self, time: float) -> bool:
        """Whether the fault acts at ``time`` (s)."""
        return self.start - ROUNDING <= time < self.until - ROUNDING


# Faults of the machine


class Drift(Span):
    """Adds ``amount * (exp(rate * (t - start)) - 1)`` to a parameter: wear that accelerates, and stops at ``until``."""

    kind: Literal["drift"]
    parameter: str
    amount: str  # In a unit of the parameter
    rate: Annotated[float, BeforeValidator(Quantity("1/s", -10.0, 10.0))]

    def change(self, times: Array, amount: float) -> Array:
        """What is added to the parameter at ``times`` (s), in its unit."""
        return amount * np.expm1(self.rate * np.maximum(np.minimum(times, self.until) - self.start, 0.0))


class Step(Span):
    """Adds ``amount`` to a parameter from ``start`` on, and takes it back at ``until``."""

    kind: Literal["step"]
    parameter: str
    amount: str  # In a unit of the parameter

    def change(self, times: Array, amount: float) -> Array:
        """What is added to the parameter at ``times`` (s), in its unit."""
        return np.where((times > self.start) & (times <= self.until), amount, 0.0)


class Unbalance(Span):
    """A sinusoidal angular acceleration of the shaft (Eq. 13), at a fixed frequency or an order of the shaft angle."""

    kind: Literal["unbalance"]
    acceleration: Annotated[float, BeforeValidator(Quantity("rad/s^2", 0.0, 1e6))]
    frequency: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0, 1e4))] | None = None
    order: Annotated[float, Field(gt=0.0, le=100.0)] | None = None


def shaking(unbalances: Iterable[Unbalance]) -> Callable[[float, float], float]:
    """The acceleration (rad/s²) by all unbalances as a function of time (s) and shaft angle (rad)."""
    sines = [(u.start, u.until, u.acceleration, u.frequency or 0.0, u.order or 0.0) for u in unbalances]

    def acceleration(time: float, angle: float) -> float:
        total = 0.0
        for start, until, amplitude, frequency, order in sines:
            if start <= time < until:
                total += amplitude * math.sin(frequency * time + order * angle)
        return total

    return acceleration


# Faults of a sensor

Distortion = Callable[[float], float]  # From what the sensor measures to what the bus carries; once per sample


class _SignalSpan(Span):
    signal: str  # Name on the bus


class Frozen(_SignalSpan):
    """The signal keeps its value at ``start``, noise included."""

    kind: Literal["frozen"]

    def distortion(self, _amount: float, _random: np.random.Generator) -> Distortion:
        """Returns the first value for ever."""
        first: list[float] = []

        def distort(value: float) -> float:
            if not first:
                first.append(value)
            return first[0]

        return distort


class Gain(_SignalSpan):
    """The signal is multiplied by ``factor``: a wrong range, a drifting amplifier."""

    kind: Literal["gain"]
    factor: Annotated[float, BeforeValidator(Quantity("1", -1e6, 1e6))]

    def distortion(self, _amount: float, _random: np.random.Generator) -> Distortion:
        """Multiplies by ``factor``."""
        return lambda value: self.factor * value


class Offset(_SignalSpan):
    """``amount`` is added to the signal: a shifted zero."""

    kind: Literal["offset"]
    amount: str  # In a unit of the signal

    def distortion(self, amount: float, _random: np.random.Generator) -> Distortion:
        """Adds ``amount``."""
        return lambda value: value + amount


class Spikes(_SignalSpan):
    """In a share of the samples ``amount`` is added or, as often, subtracted: a loose contact, a bad cable."""

    kind: Literal["spikes"]
    share: Share
    amount: str  # In a unit of the signal

    def distortion(self, amount: float, random: np.random.Generator) -> Distortion:
        """Adds or subtracts ``amount`` at random."""

        def distort(value: float) -> float:
            hit, up = random.random(2)
            if hit >= self.share:
                return value
            return value + amount if up < 0.5 else value - amount

        return distort


SensorFault = Frozen | Gain | Offset | Spikes


def distorted(samples: Iterable[PlantSample], faults: list[tuple[SensorFault, Distortion]]) -> Iterator[PlantSample]:
    """``samples`` as the bus carries them; several faults of a signal act in their order."""
    for sample in samples:
        measured = dict(sample.measured)
        for fault, distort in faults:
            if fault.covers(sample.time):
                measured[fault.signal] = distort(measured[fault.signal])
        yield replace(sample, measured=measured)


# Faults of the bus. Each has ACTS_ON, the transports on which it can happen, on, the one on which it does, and act(),
# which adds its effect on one sample to that of the faults before it.


@dataclass(frozen=True, slots=True)
class BusEffect:
    """What the faults of the bus do to one sample."""

    acting: tuple[int, ...] = ()  # Numbers of the faults that act, counted over all faults of the scenario
    delay: float = 0.0  # s by which the sample is sent late
    withheld: int | None = None  # Number of the first fault that withholds the sample
    gone: bool = False  # Whether the device is off the bus
    order: Order | None = None  # Order of bytes and words instead of the scenario's
    refusals: tuple[tuple[int, "Refusal"], ...] = ()  # Refusals of reads, each with its number
    garbage: tuple[bytes, ...] = ()  # Bytes that are put on the bus

    def withhold(self, number: int, *, gone: bool = False) -> "BusEffect":
        """This effect, with the sample withheld by fault ``number`` unless another has done so."""
        return replace(self, withheld=number if self.withheld is None else self.withheld, gone=self.gone or gone)


class _BusSpan(Span):
    ACTS_ON: ClassVar[frozenset[str]] = ALL_TRANSPORTS
    on: Transport | None = None  # Transport that is hit, if the machine is on several; without it all are


class Dropouts(_BusSpan):
    """A share of the samples is not sent; over Modbus, requests during such a sample are not answered."""

    kind: Literal["dropouts"]
    share: Share

    def act(self, effect: BusEffect, number: int, random: np.random.Generator) -> BusEffect:
        """Withhold some samples."""
        return effect if random.random() >= self.share else effect.withhold(number)


class Gone(_BusSpan):
    """The device sends and answers nothing; over Modbus TCP its port and connections are closed."""

    kind: Literal["gone"]

    def act(self, effect: BusEffect, number: int, _: np.random.Generator) -> BusEffect:
        """Withhold all samples."""
        return effect.withhold(number, gone=True)


class Jitter(_BusSpan):
    """Samples are sent late: normally distributed with this deviation about a mean of three deviations, never early."""

    kind: Literal["jitter"]
    deviation: Annotated[float, BeforeValidator(Quantity("s", 0.0, 1.0))]

    def act(self, effect: BusEffect, _: int, random: np.random.Generator) -> BusEffect:
        """Delay each sample by another time."""
        delay = self.deviation * max(MEAN_DELAY + random.standard_normal(), 0.0)
        return replace(effect, delay=effect.delay + delay)


class ClockStep(_BusSpan):
    """The clock of the node is set: from ``start`` on samples come later by ``by``, or earlier if it is negative.

    Samples that come earlier start with a burst, like those of a node that catches up with its clock.
    """

    kind: Literal["clock_step"]
    by: Annotated[float, BeforeValidator(Quantity("s", -60.0, 60.0))]

    def act(self, effect: BusEffect, _: int, __: np.random.Generator) -> BusEffect:
        """Delay each sample by the same time."""
        return replace(effect, delay=effect.delay + self.by)


class WordOrder(_BusSpan):
    """Registers have another order of bytes and words, as after a change of the drive's settings."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS
    kind: Literal["word_order"]
    order: Order

    def act(self, effect: BusEffect, _: int, __: np.random.Generator) -> BusEffect:
        """Change the order."""
        return replace(effect, order=self.order)


class Garbage(_BusSpan):
    """With a share of the samples comes something else: a frame of another node, or bytes that are no frame."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS | {CAN}
    kind: Literal["garbage"]
    share: Share

    def act(self, effect: BusEffect, _: int, random: np.random.Generator) -> BusEffect:
        """Add bytes to some samples."""
        if random.random() >= self.share:
            return effect
        return replace(effect, garbage=(*effect.garbage, random.bytes(int(random.integers(*GARBAGE_LENGTHS)))))


class Refusal(_BusSpan):
    """A read of any of the registers ``first`` to ``last`` gets an exception."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS
    kind: Literal["exception"]
    code: Annotated[int, Field(ge=1, le=11)]  # 2: illegal data address, 4: device failure, 6: device busy
    first: Annotated[int, Field(ge=0, lt=REGISTERS)] = 0
    last: Annotated[int, Field(ge=0, lt=REGISTERS)] = REGISTERS - 1

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        if self.last < self.first:
            raise ValueError(f"last ({self.last}) must not be below first ({self.first})")
        return self

    def act(self, effect: BusEffect, number: int, _: np.random.Generator) -> BusEffect:
        """Add this refusal."""
        return replace(effect, refusals=(*effect.refusals, (number, self)))

    def concerns(self, address: int, count: int) -> bool:
        """Whether a read of ``count`` registers from ``address`` on includes one of these registers."""
        return address <= self.last and self.first < address + count


BusFault = Dropouts | Gone | Jitter | ClockStep | WordOrder | Garbage | Refusal
Fault = Annotated[Drift | Step | Unbalance | SensorFault | BusFault, Field(discriminator="kind")]


class FaultInjector:
    """All faults of the bus of a scenario, each with random numbers of its own."""

    def __init__(self, faults: Sequence[object], seed: int, transport: str | None = None) -> None:
        """``faults`` are all faults of the scenario; those that do not act on ``transport`` are ignored."""
        self._faults = [
            (number, fault, fault_random(seed, number))
            for number, fault in enumerate(faults)
            if isinstance(fault, BusFault) and (transport is None or fault.on in (None, transport))
        ]

    def at(self, time: float) -> BusEffect:
        """The effect on the sample at ``time`` (s); must be called once for each sample, in their order."""
        effect = BusEffect()
        for number, fault, random in self._faults:
            if fault.covers(time) and (after := fault.act(effect, number, random)) is not effect:
                effect = replace(after, acting=(*after.acting, number))
        return effect
