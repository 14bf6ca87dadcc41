"""What can happen to a simulated machine, each fault one row: how it is written in a scenario and what it does.

Laws of paper.txt section 5.2 and 5.3: exponential drift of a parameter, a torque or acceleration on the shaft.
"""

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

Seconds = Annotated[float, BeforeValidator(Quantity("s", 0.0, 1e9))]


class Drift(Closed):
    """``amount * (exp(rate * (t - start)) - 1)`` added to a parameter: wear that feeds on itself."""

    kind: Literal["drift"]
    parameter: str
    start: Seconds
    amount: str
    """In a unit of the parameter."""
    rate: Annotated[float, BeforeValidator(Quantity("1/s", -10.0, 10.0))]

    def change(self, time: float, amount: float) -> float:
        """What is added to the parameter at ``time`` (s), in its unit."""
        return amount * math.expm1(self.rate * (time - self.start)) if time > self.start else 0.0


class Step(Closed):
    """``amount`` added to a parameter from ``start`` on: a sudden fault."""

    kind: Literal["step"]
    parameter: str
    start: Seconds
    amount: str

    def change(self, time: float, amount: float) -> float:
        """What is added to the parameter at ``time`` (s), in its unit."""
        return amount if time > self.start else 0.0


class Unbalance(Closed):
    """A sinusoidal angular acceleration of the shaft (Eq. 13), of a fixed frequency or an order of the shaft angle."""

    kind: Literal["unbalance"]
    start: Seconds
    acceleration: Annotated[float, BeforeValidator(Quantity("rad/s^2", 0.0, 1e6))]
    frequency: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0, 1e4))] | None = None
    order: Annotated[float, Field(gt=0.0, le=100.0)] | None = None

    def value(self, time: float, angle: float) -> float:
        """The acceleration in rad/s² at ``time`` (s) and shaft ``angle`` (rad)."""
        if time < self.start:
            return 0.0
        phase = self.order * angle if self.order is not None else (self.frequency or 0.0) * time
        return self.acceleration * math.sin(phase)


Fault = Annotated[Drift | Step | Unbalance, Field(discriminator="kind")]
