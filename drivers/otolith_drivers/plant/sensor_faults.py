"""What can happen to a sensor on its way to the bus: the bus lies, while controller and truth do not."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import BeforeValidator

from otolith_drivers.plant.spans import Share, Span
from otolith_drivers.plant.tick import Tick
from otolith_drivers.quantities import Quantity

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


def distorted(ticks: Iterable[Tick], faults: list[tuple[SensorFault, Distortion]]) -> Iterator[Tick]:
    """``ticks`` as the bus carries them; several faults of a signal act one after the other."""
    for tick in ticks:
        measured = dict(tick.measured)
        for fault, distort in faults:
            if fault.covers(tick.time):
                measured[fault.signal] = distort(measured[fault.signal])
        yield replace(tick, measured=measured)
