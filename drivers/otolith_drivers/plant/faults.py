"""What can happen to a simulated machine, each fault one row: how it is written in a scenario and what it does.

What can happen to its sensors and to its bus is in ``sensor_faults`` and ``bus_faults``; the table of all is here.
Laws of paper.txt section 5.2 and 5.3: exponential drift of a parameter, a torque or acceleration on the shaft.
"""

import math
from collections.abc import Callable, Iterable
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from otolith_drivers.plant.bus_faults import BusFault
from otolith_drivers.plant.sensor_faults import SensorFault
from otolith_drivers.plant.spans import Seconds
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

Array = NDArray[np.float64]


class Drift(Closed):
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


class Step(Closed):
    """``amount`` added to a parameter from ``start`` on: a sudden fault."""

    kind: Literal["step"]
    parameter: str
    start: Seconds
    amount: str

    def change(self, times: Array, amount: float) -> Array:
        """What is added to the parameter at ``times`` (s), in its unit."""
        return np.where(times > self.start, amount, 0.0)


class Unbalance(Closed):
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
