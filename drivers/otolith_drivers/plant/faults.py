"""What can happen to a simulated machine, each fault one row: how it is written in a scenario and what it does.

What can happen to its sensors and to its bus is in ``sensor_faults`` and ``bus_faults``; the table of all is here.
Laws of paper.txt section 5.2 and 5.3: exponential drift of a parameter, a torque or acceleration on the shaft.

What a simulated machine says at each sampling instant.

When something happens in a scenario.

What can happen to a sensor on its way to the bus: the bus lies, while controller and truth do not.

What can happen between a simulated machine and who listens: its bus, its line, its clock.

A fault acts on whole ticks, and which ones depends on seed and scenario alone, so that a node can say exactly what it
withheld.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.modbus.protocol import Order
from otolith_drivers.units import Quantity


@dataclass(frozen=True, slots=True)
class PlantSample:
    """One sampling instant."""

    time: float
    """s since the start of the scenario."""
    measured: dict[str, float]
    """Signals by their name on the bus, as sensors and drive see them."""
    truth: dict[str, float]
    """The parameters as they are, and the states without noise."""


ROUNDING = 1e-9  # s; a tick's time is a multiple of the sample period, give or take the last bit
Seconds = Annotated[float, BeforeValidator(Quantity("s", 0.0, 1e9))]
Share = Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))]
"""Of ticks, each by its own throw of the dice."""


class Span(StrictModel):
    """From ``start`` on, and before ``until``."""

    start: Seconds
    until: Seconds = 1e9

    @model_validator(mode="after")
    def _is_a_span(self) -> Self:
        if self.until <= self.start:
            raise ValueError(f"until ({self.until:g} s) must be later than start ({self.start:g} s)")
        return self

    def covers(self, time: float) -> bool:
        """Whether ``time`` (s) is in it."""
        return self.start - ROUNDING <= time < self.until - ROUNDING


def generator(seed: int, number: int) -> np.random.Generator:
    """The random numbers of fault ``number`` of a scenario: its own, and independent of the machine's noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))


# From what the sensor would say to what the bus carries; called once a tick, in their order.
Distortion = Callable[[float], float]


class _OfASignal(Span):
    signal: str
    """By its name on the bus."""


class Frozen(_OfASignal):
    """The signal stays at what it was at ``start``, noise included."""

    kind: Literal["frozen"]

    def distortion(self, _amount: float, _random: np.random.Generator) -> Distortion:
        """What it does to the signal."""
        held: list[float] = []

        def distort(value: float) -> float:
            held.append(value)
            del held[1:]
            return held[0]

        return distort


class Gain(_OfASignal):
    """The signal is ``factor`` times what it should be: a wrong range, a drifting amplifier."""

    kind: Literal["gain"]
    factor: Annotated[float, BeforeValidator(Quantity("1", -1e6, 1e6))]

    def distortion(self, _amount: float, _random: np.random.Generator) -> Distortion:
        """What it does to the signal."""
        return lambda value: self.factor * value


class Offset(_OfASignal):
    """``amount`` is added to the signal: a zero that has moved."""

    kind: Literal["offset"]
    amount: str
    """In a unit of the signal."""

    def distortion(self, amount: float, _random: np.random.Generator) -> Distortion:
        """What it does to the signal."""
        return lambda value: value + amount


class Spikes(_OfASignal):
    """In a share of ticks ``amount`` is added to the signal or, as often, subtracted: a loose contact, a bad cable."""

    kind: Literal["spikes"]
    share: Share
    amount: str
    """In a unit of the signal."""

    def distortion(self, amount: float, random: np.random.Generator) -> Distortion:
        """What it does to the signal."""

        def distort(value: float) -> float:
            hit, up = random.random(2)
            if hit >= self.share:
                return value
            return value + amount if up < 0.5 else value - amount

        return distort


SensorFault = Frozen | Gain | Offset | Spikes


def distorted(ticks: Iterable[PlantSample], faults: list[tuple[SensorFault, Distortion]]) -> Iterator[PlantSample]:
    """``ticks`` as the bus carries them; several faults of a signal act one after the other."""
    for tick in ticks:
        measured = dict(tick.measured)
        for fault, distort in faults:
            if fault.covers(tick.time):
                measured[fault.signal] = distort(measured[fault.signal])
        yield replace(tick, measured=measured)


CAN, MODBUS_TCP, MODBUS_RTU, IN_PROCESS = "can", "modbus-tcp", "modbus-rtu", "in-process"
MODBUS = frozenset({MODBUS_TCP, MODBUS_RTU})
ALL = MODBUS | {CAN, IN_PROCESS}
MEAN_LATENESS = 3.0  # standard deviations of jitter, as no tick can be sent before it was
GARBAGE_LENGTHS = 3, 12  # bytes
REGISTERS = 65536


@dataclass(frozen=True, slots=True)
class Effect:
    """What the faults of the bus make of one tick."""

    acting: tuple[int, ...] = ()
    """Which of the faults, by their number among all of the scenario."""
    delay: float = 0.0
    """s; how much later than it was the tick is sent."""
    withheld: int | None = None
    """The number of the fault that lets nobody have the tick; the first, if several would."""
    gone: bool = False
    order: Order | None = None
    """Instead of the scenario's."""
    refusals: tuple[tuple[int, "Refusal"], ...] = ()
    """Each with its number."""
    garbage: tuple[bytes, ...] = ()


class Dropouts(Span):
    """A share of ticks is not sent; over Modbus, what is asked during such a tick is not answered."""

    ACTS_ON: ClassVar[frozenset[str]] = ALL
    kind: Literal["dropouts"]
    share: Share

    def act(self, effect: Effect, number: int, random: np.random.Generator) -> Effect:
        """On one tick."""
        if random.random() >= self.share:
            return effect
        return replace(effect, withheld=_first(effect.withheld, number))


class Gone(Span):
    """The device is silent, then back: no frame, no answer; over Modbus TCP its port and connections are closed."""

    ACTS_ON: ClassVar[frozenset[str]] = ALL
    kind: Literal["gone"]

    def act(self, effect: Effect, number: int, _: np.random.Generator) -> Effect:
        """On one tick."""
        return replace(effect, withheld=_first(effect.withheld, number), gone=True)


class Jitter(Span):
    """The moment at which a tick is sent strays by this standard deviation about a mean of three: late, never early."""

    ACTS_ON: ClassVar[frozenset[str]] = ALL
    kind: Literal["jitter"]
    deviation: Annotated[float, BeforeValidator(Quantity("s", 0.0, 1.0))]

    def act(self, effect: Effect, _: int, random: np.random.Generator) -> Effect:
        """On one tick."""
        lateness = self.deviation * max(MEAN_LATENESS + random.standard_normal(), 0.0)
        return replace(effect, delay=effect.delay + lateness)


class ClockStep(StrictModel):
    """The node's clock is set: from ``start`` on ticks come later by ``by``, or earlier if that is below zero.

    Those that come earlier come in a burst at first, as a node does that makes up for time it believes to have lost.
    """

    ACTS_ON: ClassVar[frozenset[str]] = ALL
    kind: Literal["clock_step"]
    start: Seconds
    by: Annotated[float, BeforeValidator(Quantity("s", -60.0, 60.0))]

    def covers(self, time: float) -> bool:
        """Whether it has happened by ``time`` (s)."""
        return time >= self.start - ROUNDING

    def act(self, effect: Effect, _: int, __: np.random.Generator) -> Effect:
        """On one tick."""
        return replace(effect, delay=effect.delay + self.by)


class WordOrder(Span):
    """Registers come in another order of bytes and words, as after a change of the drive's settings."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS
    kind: Literal["word_order"]
    order: Order

    def act(self, effect: Effect, _: int, __: np.random.Generator) -> Effect:
        """On one tick."""
        return replace(effect, order=self.order)


class Garbage(Span):
    """In a share of ticks something else is on the bus as well: a stranger's frame, or bytes that are none of ours."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS | {CAN}
    kind: Literal["garbage"]
    share: Share

    def act(self, effect: Effect, _: int, random: np.random.Generator) -> Effect:
        """On one tick."""
        if random.random() >= self.share:
            return effect
        return replace(effect, garbage=(*effect.garbage, random.bytes(int(random.integers(*GARBAGE_LENGTHS)))))


class Refusal(Span):
    """Whoever reads one of the registers ``first`` to ``last`` gets an exception instead."""

    ACTS_ON: ClassVar[frozenset[str]] = MODBUS
    kind: Literal["exception"]
    code: Annotated[int, Field(ge=1, le=11)]
    """2: illegal data address, 4: device failure, 6: device busy ..."""
    first: Annotated[int, Field(ge=0, lt=REGISTERS)] = 0
    last: Annotated[int, Field(ge=0, lt=REGISTERS)] = REGISTERS - 1

    @model_validator(mode="after")
    def _is_a_range(self) -> Self:
        if self.last < self.first:
            raise ValueError(f"last ({self.last}) must not be below first ({self.first})")
        return self

    def act(self, effect: Effect, number: int, _: np.random.Generator) -> Effect:
        """On one tick."""
        return replace(effect, refusals=(*effect.refusals, (number, self)))

    def concerns(self, address: int, count: int) -> bool:
        """Whether a read of ``count`` registers from ``address`` on touches it."""
        return address <= self.last and self.first < address + count


BusFault = Dropouts | Gone | Jitter | ClockStep | WordOrder | Garbage | Refusal


class FaultInjector:
    """All faults of the bus of one scenario, each with random numbers of its own."""

    def __init__(self, faults: Sequence[object], seed: int) -> None:
        """``faults`` are all of the scenario; those of machine and sensors are not looked at."""
        self._faults = [
            (number, fault, generator(seed, number))
            for number, fault in enumerate(faults)
            if isinstance(fault, BusFault)
        ]

    def at(self, time: float) -> Effect:
        """On the tick at ``time`` (s); to be asked once for each tick, in their order."""
        effect = Effect()
        for number, fault, random in self._faults:
            if fault.covers(time) and (after := fault.act(effect, number, random)) is not effect:
                effect = replace(after, acting=(*after.acting, number))
        return effect


def _first(before: int | None, number: int) -> int:
    return number if before is None else before


Array = NDArray[np.float64]


class Drift(StrictModel):
    """``amount * (exp(rate * (t - start)) - 1)`` added to a parameter: wear that feeds on itself."""

    kind: Literal["drift"]
    parameter: str
    start: Seconds
    amount: str
    """In a unit of the parameter."""
    rate: Annotated[float, BeforeValidator(Quantity("1/s", -10.0, 10.0))]
    until: Seconds = 1e9
    """From then on the parameter stays where it has come to: an exponential has no other end."""

    def change(self, times: Array, amount: float) -> Array:
        """What is added to the parameter at ``times`` (s), in its unit."""
        return amount * np.expm1(self.rate * np.maximum(np.minimum(times, self.until) - self.start, 0.0))


class Step(StrictModel):
    """``amount`` added to a parameter from ``start`` on: a sudden fault."""

    kind: Literal["step"]
    parameter: str
    start: Seconds
    amount: str

    def change(self, times: Array, amount: float) -> Array:
        """What is added to the parameter at ``times`` (s), in its unit."""
        return np.where(times > self.start, amount, 0.0)


class Unbalance(StrictModel):
    """A sinusoidal angular acceleration of the shaft (Eq. 13), of a fixed frequency or an order of the shaft angle."""

    kind: Literal["unbalance"]
    start: Seconds
    acceleration: Annotated[float, BeforeValidator(Quantity("rad/s^2", 0.0, 1e6))]
    frequency: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0, 1e4))] | None = None
    order: Annotated[float, Field(gt=0.0, le=100.0)] | None = None


def shaking(unbalances: Iterable[Unbalance]) -> Callable[[float, float], float]:
    """The acceleration by all of them, in rad/s², at a time (s) and a shaft angle (rad)."""
    sines = [(fault.start, fault.acceleration, fault.frequency or 0.0, fault.order or 0.0) for fault in unbalances]

    def acceleration(time: float, angle: float) -> float:
        total = 0.0
        for start, amplitude, frequency, order in sines:
            if time >= start:
                total += amplitude * math.sin(frequency * time + order * angle)
        return total

    return acceleration


Fault = Annotated[Drift | Step | Unbalance | SensorFault | BusFault, Field(discriminator="kind")]
