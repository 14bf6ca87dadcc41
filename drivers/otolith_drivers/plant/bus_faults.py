"""What can happen between a simulated machine and who listens: its bus, its line, its clock.

A fault acts on whole ticks, and which ones depends on seed and scenario alone, so that a node can say exactly what it
withheld.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.modbus_types import Order
from otolith_drivers.plant.spans import ROUNDING, Seconds, Share, Span, generator
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

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


class ClockStep(Closed):
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


class Interference:
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
