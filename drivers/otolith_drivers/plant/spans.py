"""When something happens in a scenario."""

from typing import Annotated, Self

import numpy as np
from pydantic import BeforeValidator, model_validator

from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

ROUNDING = 1e-9  # s; a tick's time is a multiple of the sample period, give or take the last bit
Seconds = Annotated[float, BeforeValidator(Quantity("s", 0.0, 1e9))]
Share = Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))]
"""Of ticks, each by its own throw of the dice."""


class Span(Closed):
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
