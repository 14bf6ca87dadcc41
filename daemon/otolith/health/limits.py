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
COLDEST = 55.0  # K: ambient temperatures of machines, from -15 to 40 °C (IEC 60034-1)
THERMAL_TIME = 600.0  # s: thermal time constant of a winding; those of motors of 0.1 to 100 kW are longer
COOLING = 10.0 / 3600.0  # K/s: how fast the surroundings of a running machine become colder
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
        return _RANKS[self]


LEVELS = tuple(Level)
_RANKS = {level: rank for rank, level in enumerate(LEVELS)}


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
    coldest: float = COLDEST  # By how much it may be colder than at the nominal value, K
    thermal_time: float = THERMAL_TIME  # Time constant with which its temperature changes, s
    as_right_as: tuple[str, ...] = ()  # Parameters that are held, and that the data do not tell from this one
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

    def colder_by(self, value: float) -> float:
        """Return by how much colder than at the nominal value it would be at ``value``, K, if nothing else has changed.

        Zero if it does not depend on the temperature, or that is measured.
        """
        if self.temperature or not self.temperature_coefficient or not self.nominal:
            return 0.0
        return (1.0 - value / self.nominal) / self.temperature_coefficient

    def warmed(self, value: float, sd: float, kelvin: float) -> tuple[float, float]:
        """Return an estimate as it would be if it were ``kelvin`` warmer."""
        factor = max(1.0 - self.temperature_coefficient * kelvin, MIN_TEMPERATURE_FACTOR)
        return value / factor, sd / factor

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


@dataclass(frozen=True, slots=True)
class Coldness:
    """What a lower temperature explains of a parameter whose temperature is not measured."""

    kelvin: float  # Below the temperature of the nominal value
    time: float  # Of the window that showed it, s
    is_beyond: bool = False  # Whether it is beyond a limit all the same


def coldness_after(
    quantity: MonitoredQuantity, before: Coldness | None, value: float, sd: float, window: tuple[float, float]
) -> Coldness:
    """Return what a lower temperature explains of an estimate, after what it explained ``before``.

    ``window`` has begin and end of the window that it is of, s. At the start it explains all that the range of the
    temperature allows. A machine that runs becomes colder only with its surroundings; one that rested, or whose clock
    was set back, as fast as its time constant lets it. What is beyond a limit all the same is no matter of the
    temperature, and stays so: no rest explains what was there before it.
    """
    start, time = window
    kelvin = min(max(quantity.colder_by(value), 0.0), quantity.coldest)
    if before is None:
        level, _ = quantity.level(*quantity.warmed(value, sd, kelvin), Level.OK)
        return Coldness(kelvin, time, level is not Level.OK)
    rest = max(start - before.time, 0.0) if time >= before.time else math.inf
    reach = quantity.coldest * -math.expm1(-rest / quantity.thermal_time) + COOLING * max(time - before.time, 0.0)
    allowed = min(kelvin, before.kelvin + (0.0 if before.is_beyond else reach))
    level, _ = quantity.level(*quantity.warmed(value, sd, allowed), Level.OK)
    is_beyond = level is not Level.OK
    return Coldness(min(kelvin, before.kelvin) if is_beyond else allowed, time, is_beyond)


def probability_beyond(limit: Limit, value: float, sd: float) -> float:
    """Return the probability that the true value is beyond ``limit``."""
    if sd <= 0.0:
        return float(limit.excess(value) > 0.0)
    return 0.5 * math.erfc(-limit.excess(value) / (math.sqrt(2.0) * sd))
