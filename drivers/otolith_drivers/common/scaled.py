"""Signals that arrive as plain numbers: unit, scale, offset and range in the machine file, and the conversion."""

import math
from dataclasses import dataclass
from typing import Self

from pydantic import model_validator

from otolith_drivers.base import Signal
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.units import factor


class ScaledSource(StrictModel):
    """Keys of a signal that arrives as a number; the value is ``scale * number + offset`` in ``unit``."""

    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    range: tuple[float, float] | None = None
    """In ``unit``; a value outside is no reading."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale 0 makes every value the same: leave it out, or write what one step is worth")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range {list(self.range)}: the lower end comes first")
        return self


@dataclass(frozen=True, slots=True)
class Conversion:
    """From a number to the value in the unit of the twin."""

    source: ScaledSource
    to_target: tuple[float, float]
    """Scale and offset from the unit of the source."""

    @classmethod
    def of(cls, source: ScaledSource, unit: str, target: str) -> Self:
        """Return the conversion of ``source``, which is in ``unit``; raise ValueError if the quantities differ."""
        return cls(source, factor(unit, target))

    @classmethod
    def for_signal(cls, signal: Signal) -> Self:
        """Return the conversion from the unit that the source of a signal names.

        Raises:
            ConfigurationError: it measures another quantity than the signal.
        """
        try:
            return cls.of(signal.source, signal.source.unit, signal.unit)
        except ValueError as error:
            raise ConfigurationError(str(error), ("signals", signal.name)) from error

    def value(self, number: object) -> float:
        """Return the value; NaN if ``number`` is none, not finite, or out of range."""
        if not isinstance(number, bool | int | float):
            return math.nan
        try:
            written = self.source.scale * float(number) + self.source.offset
        except OverflowError:  # an integer beyond the largest float
            return math.nan
        if self.source.range is not None and not self.source.range[0] <= written <= self.source.range[1]:
            return math.nan
        value = self.to_target[0] * written + self.to_target[1]
        return value if math.isfinite(value) else math.nan
