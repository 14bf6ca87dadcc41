"""Limits of parameters and components, and which of them an estimate has passed, judged by its interval.

A limit is passed if the value is beyond it with a probability of 97.5 %: if the whole 95 % interval is. A level is left
if the value is back inside the limit that was passed with the same probability, by a share of the distance to the
nominal value, or if the interval holds the nominal value and not the limit. An estimate that wanders around its limit
therefore changes nothing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from otolith.estimation.information import QUANTILE
from otolith_drivers.units import quantity_text

RELEASE = 0.1  # of the distance from the nominal value to a limit, by which a value must be back inside
MIN_TEMPERATURE_FACTOR = 0.1  # relative value at a temperature, below which the temperature cannot be true
MACHINE = "machine"  # the part to which belongs what no part of the twin explains


class Level(StrEnum):
    """State of a part or of the machine."""

    OK = "OK"
    HINT = "HINT"  # Only the machine file is wrong: a matter of the specialist, and the state of no part
    NO_DATA = "NO DATA"  # Nothing is known at present
    WATCH = "WATCH"
    ACT = "ACT"

    @property
    def rank(self) -> int:
        """Position from the least severe to the most severe."""
        return LEVELS.index(self)


LEVELS = tuple(Level)


@dataclass(frozen=True, slots=True)
class Limit:
    """A limit of a value."""

    level: Level
    value: float
    is_lower: bool  # Whether values below it are beyond it
    is_relative: bool = False  # Whether it is stated in percent of the nominal value

    @property
    def side(self) -> str:
        """On which side of the nominal value it is."""
        return "below" if self.is_lower else "above"

    def excess(self, value: float) -> float:
        """Return how far ``value`` is beyond the limit; negative inside."""
        return self.value - value if self.is_lower else value - self.value


@dataclass(frozen=True, slots=True)
class MonitoredQuantity:
    """A parameter, or the components at a site: its part and its limits."""

    part: str = MACHINE
    meaning: str = ""
    unit: str = ""
    nominal: float = 0.0
    limits: tuple[Limit, ...] = ()
    waiting: tuple[Limit, ...] = ()  # Limits in percent of a value that is not known yet: they wait for a baseline
    temperature_coefficient: float = 0.0  # Relative change per kelvin
    temperature: str = ""  # Signal of the temperature, K; empty if it is not measured
    reference: float = 293.15  # Temperature for which nominal value and limits are stated, K
    is_example: bool = False  # Whether nominal is of the twin's example, which is another machine
    has_baseline: bool = False  # Whether nominal is a value from commissioning instead of that of the machine file

    def referred(self, value: float, sd: float, observed: Mapping[str, float]) -> tuple[float, float] | None:
        """Return an estimate as it would be at the reference temperature, from the ``observed`` signals of a window.

        Without a temperature it is the estimate itself; None if the temperature is measured, but not at present.
        (IEC 60034-1: resistance is linear in temperature.)
        """
        if not self.temperature:
            return value, sd
        if (temperature := observed.get(self.temperature)) is None:
            return None
        factor = 1.0 + self.temperature_coefficient * (temperature - self.reference)
        return (value / factor, sd / factor) if factor > MIN_TEMPERATURE_FACTOR else None

    @property
    def has_limits(self) -> bool:
        """Whether it has limits, or will have them with a baseline."""
        return bool(self.limits or self.waiting)

    @property
    def limits_text(self) -> str:
        """The limits in words; empty without one."""
        texts = [f"{item.level} {item.side} {quantity_text(item.value, self.unit)}" for item in self.limits]
        if self.is_example and len(self.limits) == 1:
            example = f"{quantity_text(self.nominal, self.unit)}, the value of the twin's example"
            texts.append(f"the side as seen from {example}: write value = ... of your machine beside it")
        shares = [f"{item.level} {item.value / self.nominal - 1.0:+.0%}" for item in self.waiting]
        texts += [f"{', '.join(shares)} of the baseline, none yet: run 'otolith commission'"] if shares else []
        return ", ".join(texts)

    def level(self, value: float, sd: float, before: Level, held: float | None = None) -> tuple[Level, Limit | None]:
        """Return the level of an estimate after the level ``before``, with the limit that decides it.

        ``held`` is the value of the limit that decided the level before. On the way to it all limits were passed that
        lie nearer to the nominal value, and none on the other side of it.
        """
        levels: list[tuple[Level, Limit | None]] = [(Level.OK, None)]
        for limit in self.limits:
            excess, reach = limit.excess(value), QUANTILE * sd
            release = RELEASE * abs(limit.value - self.nominal)
            is_healthy = abs(value - self.nominal) <= reach < -excess  # as the healthy value may be, and inside
            was_passed = (
                not is_healthy and before.rank >= limit.level.rank and held is not None and limit.excess(held) >= 0.0
            )
            if excess > reach or (was_passed and excess > -release - reach):
                levels.append((limit.level, limit))
        return max(levels, key=lambda item: item[0].rank)


def probability_beyond(limit: Limit, value: float, sd: float) -> float:
    """Return the probability that the true value is beyond ``limit``."""
    if sd <= 0.0:
        return float(limit.excess(value) > 0.0)
    return 0.5 * math.erfc(-limit.excess(value) / (math.sqrt(2.0) * sd))
