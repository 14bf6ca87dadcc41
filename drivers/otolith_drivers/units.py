"""Physical quantities as people write them: ``"6.5 ohm"``, ``"11.7 g*cm^2"``, ``"2 s"``.

Every number in a file carries its unit, is converted once on the way in, and is a plain float in its declared unit
from there on. Parsing is pint's, behind a pattern that admits one number and one unit, so that nothing is evaluated.
"""

import contextlib
import math
import re
import shutil
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import cache_directory

if TYPE_CHECKING:
    import pint


LONGEST = 100  # characters of a quantity
QUANTITY = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(.*)")
# Names, each with at most one small exponent, joined by * or /: nothing that pint could be kept busy with.
FACTOR = r"[( ]*(?:1|[^\W\d][\w°%µμΩ]*|[°%][^\W\d]*)(?: ?(?:\^|\*\*) ?\(?-?\d(?:\.\d{1,3})?\)?)?[) ]*"
UNIT = re.compile(rf"{FACTOR}(?:[*/· ]{FACTOR}){{0,12}}")

# Units as drives and DBC files write them, where pint reads something else or nothing:
# "Nm" alone would be read as "number meter".
ALIASES = {
    "Nm": "N*m",
    "mNm": "mN*m",
    "Nms": "N*m*s",
    "U/min": "rpm",
    "1/min": "rpm",
    "r/min": "rpm",
    "rev/min": "rpm",
    "RPM": "rpm",
    "rev": "turn",
    "rev/s": "turn/s",
    "Volt": "V",
    "Amp": "A",
    "min^-1": "rpm",
    "min**-1": "rpm",
    "min-1": "rpm",
    "°C": "degC",
    "°": "degree",
    "": "dimensionless",
    "1": "dimensionless",
    "-": "dimensionless",
}


@cache
def _registry() -> "pint.UnitRegistry[float]":
    import pint  # noqa: PLC0415 - a quarter of a second, and not every command reads a quantity

    try:  # parsed units are kept, which saves most of the time; half a file of a process that died is made anew
        return pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=cache_directory("units"))
    except Exception:  # noqa: BLE001 - whatever is wrong with the cache, the units are not
        with contextlib.suppress(OtolithError):
            shutil.rmtree(cache_directory("units"), ignore_errors=True)
        return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


@cache
def unit(text: str) -> "pint.Unit":
    """The unit that ``text`` names.

    Raises:
        ValueError: unknown or malformed unit.
    """
    short = re.sub(r"\s+", " ", text.strip())
    written = ALIASES.get(short.replace(" ", ""), short)
    if len(text) > LONGEST or not UNIT.fullmatch(written):
        raise ValueError(f"{text!r} is not a unit")
    try:
        return _registry().Unit(written)
    except Exception as error:
        raise ValueError(f"{text!r} is not a unit (examples: ohm, N*m*s/rad, rad/s, ms)") from error


def factor(source: str, target: str) -> tuple[float, float]:
    """``(scale, offset)`` with ``value_in_target = scale * value_in_source + offset``.

    Raises:
        ValueError: the units measure different things; both are named.
    """
    _same_dimension(source, target)
    zero = _registry().Quantity(0.0, unit(source)).to(unit(target)).magnitude
    one = _registry().Quantity(1.0, unit(source)).to(unit(target)).magnitude
    return one - zero, zero


def to_base(text: str) -> tuple[float, float]:
    """``(scale, offset)`` from the unit ``text`` to SI base units (with radians)."""
    registry = _registry()
    zero = registry.Quantity(0.0, unit(text)).to_base_units().magnitude
    return registry.Quantity(1.0, unit(text)).to_base_units().magnitude - zero, zero


def _same_dimension(source: str, target: str) -> None:
    if unit(source).dimensionality != unit(target).dimensionality:
        raise ValueError(f"unit {source!r} does not measure what {target!r} does: expected a unit like {target!r}")
    # pint takes an angle for a plain number, so that 1 Hz or 1/s would become 1 rad/s: wrong by 2π if turns are meant.
    if _is_angular(target) != _is_angular(source) and unit(target).dimensionality in _RATES:
        raise ValueError(f"unit {source!r} leaves open whether turns or radians are meant: write {target!r} or 'rpm'")


def _is_angular(text: str) -> bool:
    return any(angle in str(unit(text)) for angle in ("radian", "degree", "revolution", "turn"))


_RATES = ({"[time]": -1}, {"[time]": -2})


@dataclass(frozen=True, slots=True)
class Quantity:
    """A validator: text with a unit in, float in ``unit`` out, ``low <= value <= high``."""

    unit: str
    low: float = -math.inf
    high: float = math.inf
    difference: bool = False
    """Of two such quantities, like a noise level: 0.1 degC is 0.1 K then."""

    def __call__(self, written: Any) -> float:
        """The value in ``self.unit``.

        Raises:
            ValueError: no number, no unit, another dimension, or out of bounds (which are named).
        """
        value = self.convert(written)
        if not self.low <= value <= self.high:
            raise ValueError(f"{written!r} is out of bounds: it must lie {self._bounds()}")
        return value

    def convert(self, written: Any) -> float:
        """The value in ``self.unit``, its bounds not looked at."""
        example = f'write it with its unit, like "{1.0 if math.isinf(self.low) else max(self.low, 1.0):g} {self.unit}"'
        if isinstance(written, bool) or not isinstance(written, str | int | float):
            raise ValueError(f"{written!r} is not a quantity: {example}")  # noqa: TRY004 - a fault of a file, not a bug
        text = str(written).strip()
        match = QUANTITY.fullmatch(text) if len(text) <= LONGEST else None
        if match is None:
            raise ValueError(f"{written!r} is not a number with a unit: {example}")
        if not match[2] and not self._is_plain_number:
            raise ValueError(f"{written!r} has no unit: {example}")
        if match[2].startswith(","):
            raise ValueError(f"{written!r} is not a number with a unit: the decimal sign is a point")
        scale, offset = factor(match[2], self.unit)
        value = scale * float(match[1]) + (0.0 if self.difference else offset)
        if not math.isfinite(value):
            raise ValueError(f"{written!r} is not finite")
        return value

    @property
    def _is_plain_number(self) -> bool:
        return unit(self.unit).dimensionless and unit(self.unit) not in (unit("rad"), unit("degree"))

    def _bounds(self) -> str:
        if math.isinf(self.high):
            return f"at or above {self.low:g} {self.unit}"
        if math.isinf(self.low):
            return f"at or below {self.high:g} {self.unit}"
        return f"between {self.low:g} and {self.high:g} {self.unit}"
