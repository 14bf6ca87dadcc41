"""Physical quantities as people write them: ``"6.5 ohm"``, ``"11.7 g*cm^2"``, ``"2 s"``.

Each number in a file has a unit. It is converted once, when the file is read, to a float in the unit of its key.
pint parses the units, behind a pattern that admits one number and one unit, so that no expression is evaluated.
"""

import contextlib
import math
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, Any

from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import cache_directory

if TYPE_CHECKING:
    import pint


MAX_LENGTH = 100  # characters of a quantity: engineering choice; bounds the time of the patterns below
RELATIVE = re.compile(r"([+-]?)\s*((?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*%")
NUMBER_AND_UNIT = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?)\s*(.*)")
FACTOR_NAME = re.compile(r"[^\W\d][\w°%µμΩ]*|[°º%℃℉][^\W\d]*")
# Unit names with one small exponent each, joined by * or /. A larger exponent would keep pint busy for minutes.
FACTOR = rf"[( ]*(?:1|{FACTOR_NAME.pattern})(?: ?(?:\^|\*\*) ?\(?-?\d(?:\.\d{{1,3}})?\)?)?[) ]*"
UNIT = re.compile(rf"{FACTOR}(?:[*/· ]{FACTOR}){{0,12}}")

TURNS = ("turn", "rpm", "turn/s^2")
"""Units of an angle, its rate and its acceleration, which pint does not distinguish from 1, 1/s and 1/s^2."""


# pint distinguishes capitals and splits off prefixes: it reads "Grad" as a gigaradian and "amps" as attometres per
# second. So a unit is looked up in these tables first: as a whole without its spaces, then factor by factor.
def _by_spelling(rows: str) -> dict[str, str]:
    """Return pint's names by spelling; a row is a name and its spellings."""
    pairs = (row.split(" = ") for row in re.split(r";|\n", rows) if row.strip())
    return {spelling: name.strip() for name, spellings in pairs for spelling in spellings.split()}


EXACT = _by_spelling("""
    (N*m) = Nm NM N.m N-m N-M N_m Nmrms; (N*mm) = Nmm; (V*s) = Vs
    (kN*m) = kNm KNm; (mN*m) = mNm; (N*cm) = Ncm; (N*m*s) = Nms; (N*m/A) = N.m/A N-m/A
    (cN*m) = cNm; (daN*m) = daNm; metric_horsepower = PS
    degree = ° º; degC = °C ºC ℃ oC Â°C \ufffdC; degF = °F ºF ℉; kelvin = °K; (degree/s) = D/S; rpm = /min
    V = v; mV = mv; kV = KV; mH = mHenry; milliohm = mOhm; megaohm = MOhm; kN = KN; kJ = KJ; MPa = Mpa
    (m/s) = M/s M/S; (m/s^2) = M/s2 M/S2; dimensionless = 1 - --
""")
"""pint's names by spellings whose capitals matter."""

FOLDED = _by_spelling("""
    V = volt volts vrms v_rms vpk v_pk vpeak vdc v_dc v(dc) voltsdc vac; mV = mvolt mvolts millivolts
    A = amp amps ampere amperes arms a_rms apk a_pk apeak a_peak adc a_dc ampsdc ampsrms a(rms) aac; Ah = ah
    mA = mamp mamps milliamp milliamps; ohm = ohm ohms; kiloohm = kohm kohms; kWh = kwh; J = joule joules
    hp = hp; W = watt watts; kW = kw kilowatt kilowatts
    N = newton newtons; (N*m) = newtonmeter newtonmeters newton-meter
    (N*m) = newton-meters newtonmetre newtonmetres
    Hz = hz hertz; kHz = khz; s = sec secs second seconds sekunde sekunden sek; ms = msec msecs milliseconds
    min = min mins minute minutes minuten; h = hr hrs hour hours std stunden
    degree = deg degree degrees grad winkelgrad; rad = rad rads radian radians
    turn = rev revs revolution revolutions turn turns umdr umdrehung umdrehungen; (turn/s) = rps u/s r/s
    krpm = krpm; rpm = rpm rpms upm r.p.m rotations/min
    rpm = u/min 1/min r/min tr/min rev/min revs/min revolutions/minute umdr/min umdr./min umdrehungen/min
    rpm = min^-1 min**-1 min-1 rot/min; (degree/s) = dps; torr = torr
    (ft*lbf) = lb-ft lbf-ft ft-lb ft-lbf ft.lbf lbft ftlb ft-lbs ftlbs ft.lb lb.ft lbf.ft
    (inch*lbf) = in-lb in-lbf lb-in lbf-in inlb lbin in-lbs lbs-in in.lb
    (inch*ozf) = oz-in ozf-in oz.in ozin; (cm*kgf) = kgf-cm kgf.cm kgfcm
    degC = °c °celsius celsius celcius cel degc deg.c deg_c degreec degreesc degcelsius degreecelsius degreescelsius
    degC = grad_c gradc gradcelsius; kelvin = kelvin degk
    degF = °fahrenheit fahrenheit degf deg.f deg_f degreef degreesf degfahrenheit degreesfahrenheit
    (km/h) = km/h km/hr km/std kmh kmph kph; (m/s^2) = m/ss; m = metre metres meter meters; km = km
    (kg*m^2) = kgm2 kgm^2 kgm²; (kg*cm^2) = kgcm2 kgcm^2 kgcm²; (g*cm^2) = gcm2 gcm^2 gcm²; kg = kg
    bar = bar; mbar = mbar; hPa = hpa; kPa = kpa; psi = psi; (L/min) = lpm
    percent = pct percent prozent; dimensionless = none n/a unitless counts
""")
"""pint's names by spellings in any capitals, written here in small letters."""

SAME = 1e-9  # difference of the factors of one unit that is written in two ways: rounding

UNCLEAR = {"grad": ("degree", "gon"), "gradian": ("degree", "gon"), "ton": ("tonne", "short_ton")}
"""Units with several meanings of one dimension, by their exact spelling."""

OTHER_MEANINGS = _by_spelling("degC = C; degF = F; standard_gravity = g G; kN = kn; s = S; m = M")
"""What a symbol means for a signal that has not the dimension of its standard meaning."""

SIGNS = str.maketrans({"\u2126": "Ω", "\u02da": "°", "\u22c5": "·", "\u2219": "·", "\u2022": "·", "⁻": "-", "¹": "1"})
"""Signs that look like others."""

JOINED = {r"(?<=[^\W\d])[.-](?=[^\W\d])": "*", r"(?<=[^\W\d])-(?=[1-3](?!\d))": "^-"}
"""What stands for a product or an exponent in a unit that no table has, as in ``kg.m2`` and ``rad.s-1``."""

POWER = re.compile(r"(s|sec|mm|cm|m|min|h)([23])", re.IGNORECASE)
"""A unit with an exponent behind it, without a sign between them."""

ODD_PREFIX = re.compile(
    r"\b(?:quecto|ronto|yocto|zepto|atto|femto|peta|exa|zetta|yotta|ronna|quetta"
    r"|(?:mega|giga)(?=(?:volt|ampere|second|radian|meter|turn|degree)\b))\w+"
)
"""A prefix that machines do not have with its unit, so that another unit or a file in capitals is meant."""


PRODUCTS = {r"\*\*": "^", r"\s*\*\s*": "·", r"\^2(?![\d.])": "²", r"\^3(?![\d.])": "³"}
SYMBOLS = {
    r"(?<![^\W\d_])([kMGmnu]?)[Oo]hms?\b": r"\1Ω",
    r"(?<![^\W\d_])u(?=[ΩAVWNFHgmsT]\b)": "µ",
    r"\b(?:delta_)?deg(?=[CF]\b)|\bdeg(?:rees?)?\b": "°",
}
"""What people write by the pattern of what files write: in formulas, and in units besides."""


# Engineering choices, see docs/reference/thresholds-drivers.md.
PLAIN_NUMBERS = 1e-3, 1e5  # between which a number whose unit takes no prefix is read without a power of ten
PLAIN_QUANTITIES = 0.1, 1e4  # the same without a prefix
MAX_ZEROS, MAX_DECIMALS = 6, 8  # of a number beside one of another size
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
SMALL = {exponent: prefix for exponent, prefix in PREFIXES.items() if exponent <= 0}
PREFIXED = {
    r"(?:[NVAΩWJHFTCS]|Hz|Pa|Wb)(?![^\W\d_]|[²³^\d])": PREFIXES,
    r"(?:[ms]|bar)(?![^\W\d_]|[²³^\d])": SMALL,
}
"""The prefixes of a unit by its first symbol; others are read without, as rad/s and kg·m²."""


class UnitNameError(ValueError):
    """A text names no unit, or leaves open which."""


@cache
def _registry() -> "pint.UnitRegistry[float]":
    import pint  # noqa: PLC0415 - takes a quarter of a second, and not every command reads a quantity

    try:  # pint keeps parsed units in a folder, which saves most of the time
        return pint.UnitRegistry(autoconvert_offset_to_baseunit=True, cache_folder=cache_directory("units"))
    except Exception:  # noqa: BLE001 - any fault of the cache, such as a half-written file: work without it
        with contextlib.suppress(OtolithError):
            shutil.rmtree(cache_directory("units"), ignore_errors=True)
        return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


@cache
def unit_text(written: str) -> str:
    """Return a unit of a file as people write it: ``N·m·s/rad`` for ``N*m*s/rad``; empty for the number 1."""
    is_number = re.fullmatch(r"\s*|1|dimensionless|(\w+)/\1", written)
    return "" if is_number else _replaced(written, SYMBOLS | PRODUCTS)


def formula_text(written: str) -> str:
    """Return a formula as people write it; the angle of ``omega`` is ``θ``, that of ``omega_load`` ``θ_load``."""
    angles = re.sub(r"\bangle\((?:omega(?=_|\)))?_?(\w*)\)", lambda match: f"θ_{match[1]}".removesuffix("_"), written)
    return _replaced(angles, PRODUCTS)


def equation_text(written: str) -> str:
    """Return the equation of a component as people write it; a unit may stand behind its last space."""
    formula, space, unit_of_it = written.rpartition(" ")
    return f"{formula_text(formula)} {unit_text(unit_of_it)}" if space else formula_text(written)


@dataclass(frozen=True, slots=True)
class Scale:
    """The power of ten and the unit in which a number and those beside it are written."""

    exponent: int
    unit: str  # With its prefix; empty for a plain number
    mark: str = ""  # Behind each number, like e-6, if its unit takes no prefix

    def number(self, value: float, digits: int = 5) -> str:
        """Return a number with at most ``digits`` significant digits."""
        text = f"{value / 10.0**self.exponent + 0.0:.{digits}g}"
        if "e" in text:  # beside a number of another size
            text = f"{Decimal(text):f}" if abs(int(text.partition("e")[2])) <= MAX_ZEROS else _power_of_ten(text)
        return text if text in {"0", "-0"} else f"{text}{self.mark}"

    def text(self, value: float, digits: int = 5) -> str:
        """Return a number with its unit."""
        return f"{self.number(value, digits)} {self.unit}".rstrip()

    def numbers(self, value: float, half: float | None) -> tuple[str, str]:
        """Return a value and half of its interval, rounded to the two digits of this; empty without an interval."""
        if half is None or not (0.0 < half < math.inf and math.isfinite(value)):
            return self.number(value), "" if half is None else self.number(half)
        value, half = value / 10.0**self.exponent, half / 10.0**self.exponent
        decimals = 1 - math.floor(math.log10(float(f"{half:.1e}")))
        if decimals > MAX_DECIMALS:
            return self.number(value * 10.0**self.exponent), self.number(half * 10.0**self.exponent, 2)
        shown = (f"{round(number, decimals) + 0.0:.{max(decimals, 0)}f}{self.mark}" for number in (value, half))
        return next(shown), next(shown)


def scale_of(value: float, unit: str, half: float | None = None) -> Scale:
    """Return how a number of the size of ``value`` is written in a ``unit`` of a file.

    With ``half`` of its interval that of the larger of both: an interval around zero needs no prefix of its own.
    """
    symbol, size = unit_text(unit), max(abs(value), half or 0.0)
    prefixes = next((table for pattern, table in PREFIXED.items() if re.match(pattern, symbol)), None)
    low, high = PLAIN_NUMBERS if prefixes is None else PLAIN_QUANTITIES
    if not 0.0 < size < math.inf or low <= size < high:
        return Scale(0, symbol)
    exponent = 3 * math.floor(math.log10(size) / 3.0)
    if prefixes is None:
        return Scale(exponent, symbol, f"e{exponent}")
    exponent = min(max(exponent, min(prefixes)), max(prefixes))
    return Scale(exponent, f"{prefixes[exponent]}{symbol}")


def quantity_text(value: float, unit: str, half: float | None = None, digits: int = 5) -> str:
    """Return a value, half of its interval and their ``unit`` of a file as people read them.

    ``4.681 ± 0.041 mN·m``: both are rounded to two digits of the interval. Without one, or with one of 0, the value has
    at most ``digits`` significant digits.
    """
    scale = scale_of(value, unit, half)
    numbers = (scale.number(value, digits),) if half is None else scale.numbers(value, half)
    return " ".join(filter(None, (" ± ".join(numbers), scale.unit)))


def _power_of_ten(text: str) -> str:
    digits, _, exponent = text.partition("e")
    return f"{digits}e{int(exponent)}"


def _replaced(text: str, symbols: Mapping[str, str]) -> str:
    for pattern, symbol in symbols.items():
        text = re.sub(pattern, symbol, text)
    return text


@cache
def unit(text: str) -> "pint.Unit":
    """Return the unit that ``text`` names; raise UnitNameError if it is unknown, malformed or ambiguous."""
    short = re.sub(r"\s+", " ", text.strip()).removesuffix(".").translate(SIGNS)
    if around := re.fullmatch(r"\[(.*)\]|\(([^()]*)\)", short):
        short = around[1] or around[2] or ""
    whole = short.replace(" ", "")
    written = _known_name(whole) if whole else "dimensionless"
    short = short if written else _replaced(short, JOINED)
    if len(text) > MAX_LENGTH or not (written or UNIT.fullmatch(short)):
        raise UnitNameError(f"{text!r} is not a unit")
    name = written or FACTOR_NAME.sub(_renamed, short)
    try:
        parsed = _registry().Unit(name)
    except Exception as error:  # pint raises errors of many types for a text that is no unit
        raise UnitNameError(f"{text!r} is not a unit (examples: ohm, N*m*s/rad, rad/s, ms)") from error
    if odd := ODD_PREFIX.search(str(parsed)):
        raise UnitNameError(f"{text!r} would be {odd[0]}: write another prefix, or the name of the unit in full")
    return parsed


def is_unit(text: str) -> bool:
    """Return whether ``text`` names a unit."""
    with contextlib.suppress(UnitNameError):
        return unit(text) is not None
    return False


def _known_name(spelling: str) -> str:
    """Return pint's name of ``spelling``, empty if no table has it; raise UnitNameError if it has several meanings."""
    if spelling in UNCLEAR:
        names = " or ".join(map(repr, UNCLEAR[spelling]))
        raise UnitNameError(f"{spelling!r} may be {names}: write one of them")
    return EXACT.get(spelling) or FOLDED.get(spelling.casefold(), "")


def _renamed(match: re.Match[str]) -> str:
    """Return pint's name of a factor, with its exponent if one is attached."""
    if power := POWER.fullmatch(match[0]):
        return f"{power[1].lower()}^{power[2]}"
    return _known_name(match[0]) or match[0]


def _meant(source: str, target: str) -> str:
    """Return ``source``, or its other meaning if only that has the dimension of ``target``."""
    other = OTHER_MEANINGS.get(source.strip())
    dimension = unit(target).dimensionality
    return other if other and unit(source).dimensionality != dimension == unit(other).dimensionality else source


def factor(source: str, target: str) -> tuple[float, float]:
    """Return scale and offset from ``source`` to ``target``; raise ValueError if their dimensions differ."""
    source = _meant(source, target)
    _check_dimension(source, target)
    zero = _registry().Quantity(0.0, unit(source)).to(unit(target)).magnitude
    one, two = (_registry().Quantity(number, unit(source)).to(unit(target)).magnitude for number in (1.0, 2.0))
    if not math.isclose(two - one, one - zero, rel_tol=1e-6):
        raise ValueError(f"unit {source!r} is logarithmic: log the quantity itself, in {target!r}")
    return float(one - zero), float(zero)


def are_equal(one: str, other: str, target: str) -> bool:
    """Return whether two units of a quantity in ``target`` are the same; raise ValueError if one is none of it."""
    scales, offsets = zip(factor(one, target), factor(other, target), strict=True)
    return math.isclose(*scales, rel_tol=SAME) and math.isclose(*offsets, rel_tol=SAME, abs_tol=SAME * abs(scales[0]))


@cache
def to_base(text: str) -> tuple[float, float]:
    """Return ``(scale, offset)`` from the unit ``text`` to SI base units (with radians)."""
    zero = _registry().Quantity(0.0, unit(text)).to_base_units().magnitude
    one = _registry().Quantity(1.0, unit(text)).to_base_units().magnitude
    return one - zero, zero


def base_exponents(text: str) -> dict[str, float]:
    """Return the exponents of the SI base units, and of the radian, of the unit ``text``, by their symbols."""
    base = _registry().Quantity(1.0, unit(text)).to_base_units()
    return {f"{_registry().Unit(name):~}": float(str(exponent)) for name, exponent in base.unit_items()}


def is_one_in_si(one: str, other: str) -> bool:
    """Return whether units of two quantities are the same in SI, as V*s/rad and N*m/A are.

    Two units of one quantity are not: neither a prefix nor an angle makes another one.
    """
    has_one_dimension = unit(one).dimensionality == unit(other).dimensionality
    is_as_large = math.isclose(to_base(one)[0], to_base(other)[0], rel_tol=SAME)
    return has_one_dimension and is_as_large and _dimensions(one) != _dimensions(other)


def are_of_one_quantity(one: str, other: str) -> bool:
    """Return whether units measure the same quantity, as Nm and mN*m do; N*m and J do not."""
    return _dimensions(one) == _dimensions(other)


def _dimensions(text: str) -> dict[str, float]:
    """Return the exponents of the dimensions of the factors with which a unit is written."""
    exponents = dict[str, float]()
    for name, exponent in _registry().Quantity(1.0, unit(text)).unit_items():
        part = _registry().Unit(name)
        if not part.dimensionless:
            dimension = str(part.dimensionality)
            exponents[dimension] = exponents.get(dimension, 0.0) + float(str(exponent))
    return exponents


def _check_dimension(source: str, target: str) -> None:
    dimension = unit(target).dimensionality
    # pint treats angles as dimensionless, so 1 Hz would become 1 rad/s: wrong by 2π if turns are meant.
    turns = next((name for name in TURNS if unit(name).dimensionality == dimension), "")
    if unit(source).dimensionality != dimension:
        raise ValueError(f"unit {source!r} does not measure what {target!r} does: expected a unit like {target!r}")
    if not turns or _is_angular(source) == _is_angular(target):
        return
    if _is_angular(source):
        raise ValueError(f"unit {source!r} has turns or radians, but {target!r} has none: write {target!r}")
    text = f"unit {source!r} leaves open whether turns or radians are meant: write {target!r} or {turns!r}"
    raise UnitNameError(text)


def _is_angular(text: str) -> bool:
    return any(angle in str(unit(text)) for angle in ("radian", "degree", "revolution", "turn", "grade", "arc"))


@dataclass(frozen=True, slots=True)
class Quantity:
    """A validator: takes text with a unit, returns a float in ``unit`` with ``low <= value <= high``."""

    unit: str
    low: float = -math.inf
    high: float = math.inf
    difference: bool = False
    """Whether it is a difference of two such quantities, like a noise level: then 0.1 degC is 0.1 K."""

    def __call__(self, written: Any) -> float:
        """Return the value in ``self.unit``.

        Raises:
            ValueError: not a number, no unit, another dimension, or out of bounds; the message names the bounds.
        """
        value = self.convert(written)
        if not self.low <= value <= self.high:
            raise ValueError(f"{written!r} is out of bounds: it must lie {self._bounds()}")
        return value

    def convert(self, written: Any) -> float:
        """Return the value in ``self.unit`` without checking its bounds.

        Raises:
            ValueError: not a number, no unit, or another dimension.
        """
        example = f'write it with its unit, like "{1.0 if math.isinf(self.low) else max(self.low, 1.0):g} {self.unit}"'
        if isinstance(written, bool) or not isinstance(written, str | int | float):
            raise ValueError(f"{written!r} is not a quantity: {example}")  # noqa: TRY004 - a fault of a file, not a bug
        text = str(written).strip()
        match = NUMBER_AND_UNIT.fullmatch(text) if len(text) <= MAX_LENGTH else None
        if match is None:
            raise ValueError(f"{written!r} is not a number with a unit: {example}")
        if not match[2] and not self.is_plain_number:
            raise ValueError(f"{written!r} has no unit: {example}")
        if match[2].startswith(","):
            raise ValueError(f"{written!r} is not a number with a unit: the decimal sign is a point")
        scale, offset = factor(match[2], self.unit)
        value = scale * float(match[1]) + (0.0 if self.difference else offset)
        if not math.isfinite(value):
            raise ValueError(f"{written!r} is not finite")
        return value

    @property
    def is_plain_number(self) -> bool:
        """Whether its values may be written without a unit."""
        return unit(self.unit).dimensionless and unit(self.unit) not in (unit("rad"), unit("degree"))

    def _bounds(self) -> str:
        if math.isinf(self.high):
            return f"at or above {self.low:g} {self.unit}"
        if math.isinf(self.low):
            return f"at or below {self.high:g} {self.unit}"
        return f"between {self.low:g} and {self.high:g} {self.unit}"


def limit_values(written: Sequence[Any], unit_text: str, nominal: float) -> tuple[float, ...]:
    """Return limits in ``unit_text`` of one or two texts like ``"-3 %"`` (of ``nominal``) or ``"5.9 ohm"``.

    Raises:
        ValueError: no quantity, a percentage without sign or of zero, ``nominal`` itself, or two on one side of it.
    """
    values = tuple(_limit_value(limit, unit_text, nominal) for limit in written)
    if len(values) > 1 and (values[0] < nominal) == (values[1] < nominal):
        limits = " and ".join(f"{value:g}" for value in values)
        raise ValueError(f"{limits} {unit_text} lie on the same side of {nominal:g} {unit_text}: one is enough")
    return values


def _limit_value(written: Any, unit_text: str, nominal: float) -> float:
    match = RELATIVE.fullmatch(str(written).strip()[:MAX_LENGTH])
    if match and not match[1]:
        raise ValueError(f'{written!r} has no sign: write "-{match[2]} %" or "+{match[2]} %", or both in a list')
    if match and nominal == 0.0:
        raise ValueError(f'{written!r} of a nominal value of 0 is 0: write it with its unit, like "1 {unit_text}"')
    quantity = Quantity(unit_text)
    bare = NUMBER_AND_UNIT.fullmatch(str(written).strip()[:MAX_LENGTH])
    if bare and not bare[2] and not quantity.is_plain_number:
        number = bare[1] if bare[1][0] in "+-" else f"+{bare[1]}"
        text = f'{written!r} has no unit: write "{number} %" of the nominal value, or "{bare[1]} {unit_text}"'
        raise ValueError(text)
    value = nominal * (1.0 + float(match[1] + match[2]) / 100.0) if match else quantity(written)
    if value == nominal:
        raise ValueError(f"{written!r} is the nominal value {nominal:g} {unit_text} itself: write a limit beside it")
    return value
