"""Components that a twin may lack: their families, and the augmented twin that has slots for them.

A component is ``amplitude * shape(x; inner, phase)`` of one source ``x``. The families are the shapes that it may have,
one row each (the paper's Table 1; friction). A new row adds a family everywhere: its formula becomes compiled code with
derivatives, and the search takes its bounds from here.

An augmented twin is the author's twin with component slots, augmentation inputs at its sites, and angles as states.
Settings choose the component of a slot: its family, the site it enters and the source it depends on. They are ordinary
arguments of the kernel, so one compiled kernel serves every component and nothing is compiled during a search.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.definition import Definition, Input, Output, Parameter, Role, Site, StateVariable
from otolith.twin.expressions import dimension_of

# Decisions. docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
MIN_MAGNITUDE = 1e-9  # of |x|, in the unit of x: roots and logarithms have no slope at zero
MIN_VARIATION = 0.02  # range of x over its largest magnitude: below it x is constant and so is any shape of it
MIN_PERIODIC_ANGLE = 0.75 * 2.0 * math.pi  # rad of a sine within a window: less is a bend and no period
MAX_ANGLE_PER_RECORD = 0.8 * math.pi  # rad of a sine from record to record: the Nyquist limit, with 20 % of margin
MIN_BEND, MAX_BEND = 0.3, 12.0  # exponent of an exponential over the range of x: below a line, above a step
MAX_EXPONENT = 30.0  # exponent of an exponential at the largest |x|: the amplitude at zero stays a readable number
MIN_POWER, MAX_POWER = 0.3, 4.0  # exponent of a power
COULOMB_TRANSITION = 0.005  # of the largest |x|: width of the transition of dry friction around zero
WIDEST_TRANSITION = 10.0  # times that width: dry friction that rounds off
MIN_HUMP = 5.0  # widths of the transition of dry friction: beside it, a narrower hump would only correct its rounding
MIN_STRIBECK_SPEED, MAX_STRIBECK_SPEED = 0.02, 0.5  # of the largest |x|: a wider hump does not decay in the window
HIDDEN_HUMP = 0.5  # of the smallest |x|: a narrower hump lies outside the window and could be of any height
MAX_COMPONENTS = 3  # Component slots of an augmented twin. Engineering choice: compile time grows with each slot.
UNBOUNDED = 1e30  # bounds of parameters whose real bounds come with the component; any finite number would do
ELAPSED = "_elapsed"  # input: s since the first record; no author can write a name that begins with "_"
INTEGRAL_UNITS = {"rad/s": "rad", "m/s": "m"}


class SourceKind(StrEnum):
    """What the source of a component is."""

    NOTHING = "nothing"
    TIME = "time"
    PLACE = "place"  # An angle or a position: forces of a machine are periodic in it
    SPEED = "speed"  # Of a rotation or a motion: force times speed is a power
    SIGNAL = "signal"


@dataclass(frozen=True, slots=True)
class SourceRange:
    """Which values a source takes in a window, in its unit."""

    low: float
    high: float
    smallest: float  # Least magnitude
    step: float  # Largest change from record to record
    width: float  # From the lowest value to the highest
    largest: float  # Largest magnitude

    @classmethod
    def of_each(cls, x: Array) -> "list[SourceRange]":
        """Return the range of each row of ``x`` (sources, records); NaN separates windows."""
        steps = np.fmax.reduce(np.abs(np.diff(x)), axis=1, initial=0.0)
        smallest = np.fmin.reduce(np.abs(x), axis=1)
        low, high = np.fmin.reduce(x, axis=1), np.fmax.reduce(x, axis=1)
        columns = np.array((low, high, smallest, steps, high - low, np.maximum(-low, high)))
        return [cls(*row) for row in columns.T.tolist()]


@dataclass(frozen=True, slots=True)
class InnerParameter:
    """The parameter inside the shape of a family: the component is not linear in it, so a search has to find it."""

    meaning: str
    unit: str  # {x} stands for the unit of the source
    bounds: Callable[[SourceRange], tuple[float, float]]  # Lowest and highest value that such a window can show
    points: int  # Of the grid from which the search begins; 0 for one point per line of the spectrum


@dataclass(frozen=True, slots=True)
class ComponentFamily:
    """One row of the table."""

    name: str
    formula: str  # In a the amplitude, x the source, b the inner parameter, c the phase
    equation: str  # For people; the same letters in braces
    conditions: str  # Working conditions under which machines show it (Table 1)
    domain: str  # Where it is valid, in words
    inputs: frozenset[SourceKind]  # Kinds of source that it may depend on
    valid: Callable[[SourceRange], bool]
    """Whether the window distinguishes the family from others, if it also leaves the inner parameter a range."""
    inner: InnerParameter | None = None
    threshold_like: bool = False
    """Whether it can hold what it depends on at zero, as dry friction does: a linear response then underrates it."""
    threshold_at_rest: bool = False
    """Whether its magnitude at zero is the amplitude although a window may show its tail only."""
    dissipates: bool = False  # Whether it takes power where its source is a speed and its site the force there
    phases: tuple[float, ...] = (0.0,)  # Of the basis functions, rad; two for a free phase: both are linear

    def __hash__(self) -> int:
        """Of the name alone, as each candidate form is looked up by its family."""
        return hash(self.name)


def _largest(x: SourceRange) -> float:
    return max(x.largest, MIN_MAGNITUDE)


def _varies(x: SourceRange) -> bool:
    return x.width > MIN_VARIATION * x.largest


def _keeps_sign(x: SourceRange) -> bool:
    return _varies(x) and (x.low > 0.0 or x.high < 0.0)


def _changes_sign(x: SourceRange) -> bool:
    return x.low < 0.0 < x.high


def _frequencies(x: SourceRange) -> tuple[float, float]:
    return MIN_PERIODIC_ANGLE / max(x.width, MIN_MAGNITUDE), MAX_ANGLE_PER_RECORD / max(x.step, MIN_MAGNITUDE)


def _rates(x: SourceRange) -> tuple[float, float]:
    width = max(x.width, MIN_MAGNITUDE)
    return MIN_BEND / width, min(MAX_BEND / width, MAX_EXPONENT / _largest(x))


def _coulomb_transitions(x: SourceRange) -> tuple[float, float]:
    """Widths of the transition around zero; with a step the simulated speed would oscillate around zero."""
    width = COULOMB_TRANSITION * _largest(x)
    return width, WIDEST_TRANSITION * width


def _stribeck_speeds(x: SourceRange) -> tuple[float, float]:
    low = max(MIN_STRIBECK_SPEED * _largest(x), HIDDEN_HUMP * x.smallest)
    return low, MAX_STRIBECK_SPEED * _largest(x)


MOTION = frozenset({SourceKind.PLACE, SourceKind.SPEED, SourceKind.SIGNAL})
ANY = MOTION | {SourceKind.TIME}
GROWTH = ANY - {SourceKind.SPEED}  # no effect of a machine grows exponentially with its speed
RATE = InnerParameter("rate", "1/{x}", _rates, 2)

COMPONENT_FAMILIES: tuple[ComponentFamily, ...] = (
    ComponentFamily("constant", "a", "{a}", "offset, constant load, leak", "everywhere",
                    frozenset({SourceKind.NOTHING}), lambda x: True),
    ComponentFamily("linear", "a*x", "{a}·{x}", "friction, misalignment, backlash", "everywhere", ANY, _varies,
                    dissipates=True),
    ComponentFamily("exponential", "a*exp(b*x)", "{a}·exp({b}·{x})",
                    "current leaking, deterioration, wear and tear, corrosion", "everywhere, but for speeds", GROWTH,
                    _varies, RATE),
    ComponentFamily("negative exponential", "a*exp(-b*x)", "{a}·exp(-{b}·{x})",
                    "ageing, degradation, fatigue, crack growth", "everywhere, but for speeds", GROWTH,
                    _varies, RATE),
    ComponentFamily("power", f"a*sign(x)*exp(b*log(Max(absolute(x), {MIN_MAGNITUDE})))", "{a}·{x}^{b}",
                    "hard stops, overloading, mechanical shock", "mirrored for negative inputs", ANY, _varies,
                    InnerParameter("exponent", "1", lambda x: (MIN_POWER, MAX_POWER), 2), dissipates=True),
    ComponentFamily("logarithmic", f"a*log(Max(absolute(x), {MIN_MAGNITUDE}))", "{a}·ln({x})",
                    "saturation, memory effects, hysteresis", "inputs of one sign", ANY, _keeps_sign),
    ComponentFamily("periodic", "a*sin(b*x + c)", "{a}·sin({b}·{x} {c})",
                    "unbalanced shaft, shaft misalignment, machine unsteadiness",
                    "time, angles and positions: a sine of anything else could fit almost any signal",
                    frozenset({SourceKind.TIME, SourceKind.PLACE}), lambda x: True,
                    InnerParameter("frequency", "rad/{x}", _frequencies, 0), phases=(0.0, 0.5 * math.pi)),
    ComponentFamily("Coulomb", "a*tanh(x/b)", "{a}·sign({x})", "dry friction", "inputs that change their sign",
                    MOTION, _changes_sign, InnerParameter("transition", "{x}", _coulomb_transitions, 2),
                    threshold_like=True, dissipates=True),
    ComponentFamily("Stribeck", f"a*tanh(x/({COULOMB_TRANSITION}*b))*exp(-(x/b)**2)",
                    "{a}·sign({x})·exp(-({x}/{b})²)", "friction that falls with the speed",
                    "inputs that come near zero", MOTION, _varies,
                    InnerParameter("Stribeck speed", "{x}", _stribeck_speeds, 4), threshold_at_rest=True,
                    dissipates=True),
)  # fmt: skip
FAMILY_NAMES = tuple(row.name for row in COMPONENT_FAMILIES)
_CODES = {name: 1.0 + index for index, name in enumerate(FAMILY_NAMES)}


def family_of(name: str) -> ComponentFamily:
    """The family of that name."""
    return COMPONENT_FAMILIES[FAMILY_NAMES.index(name)]


def family_code(name: str) -> float:
    """The number of a family in compiled code; 0 stands for none."""
    return _CODES[name]


@dataclass(frozen=True, slots=True)
class ComponentSource:
    """A quantity that a component may depend on."""

    name: str
    unit: str
    kind: SourceKind
    symbol: str  # Its name in the augmented twin; empty for no quantity


@lru_cache(maxsize=64)
def sites(base: Definition) -> tuple[Site, ...]:
    """Return the author's sites, then those of the errors of outputs, inputs, and gains of measured speeds."""
    names = [*(output.name for output in base.outputs), *(driven.name for driven in base.inputs)]
    sensors, gains = [(name, sensor_site(name)) for name in names], dict.fromkeys(measured_speeds(base).values())
    return (
        *base.sites,
        *(Site(sensor, base.unit_of(name), f"error of the {sensor}", name, "additive") for name, sensor in sensors),
        *(Site(gain_site(name), "1", f"error of the {gain_site(name)}", name, "additive", name) for name in gains),
    )


def sensor_site(signal: str) -> str:
    """Return the name of the site of errors of the sensor of ``signal``."""
    return f"sensor of {signal}"


def gain_site(speed: str) -> str:
    """Return the name of the site of errors in proportion to a measured ``speed``, as of an eccentric encoder."""
    return f"gain of {speed}"


def measured_speeds(base: Definition) -> dict[str, str]:
    """Return the name of each place whose speed is a state that a sensor shows, and that of the speed."""
    rates = {left[4:-1]: text.strip() for left, text in base.equations if left.startswith("der(")}
    rates |= {f"angle({name})": name for name, _ in _speeds(base)}
    shown = {state.name for state in base.states if integral_unit(state.unit)} & {row.name for row in base.outputs}
    return {place: speed for place, speed in rates.items() if speed in shown}


@lru_cache(maxsize=64)
def sources(base: Definition) -> tuple[ComponentSource, ...]:
    """Nothing, time, angles, inputs, states, and the outputs that are no states."""
    states = [state.name for state in base.states]
    shown: list[StateVariable | Output] = [*base.states, *(o for o in base.outputs if o.name not in states)]
    return (
        ComponentSource("", "1", SourceKind.NOTHING, ""),
        ComponentSource("t", "s", SourceKind.TIME, ELAPSED),
        *(ComponentSource(f"angle({name})", unit, SourceKind.PLACE, _angle(name)) for name, unit in _speeds(base)),
        *(ComponentSource(driven.name, driven.unit, _input_kind(driven.unit), driven.name) for driven in base.inputs),
        *(ComponentSource(quantity.name, quantity.unit, _kind(quantity.unit), quantity.name) for quantity in shown),
    )


def _input_kind(unit: str) -> SourceKind:
    """Return the kind of an input: a place that is given is an ordinary signal."""
    return SourceKind.SPEED if integral_unit(unit) else SourceKind.SIGNAL


def _kind(unit: str) -> SourceKind:
    if unit in ("rad", "m"):
        return SourceKind.PLACE
    return SourceKind.SPEED if integral_unit(unit) else SourceKind.SIGNAL


def integral_unit(unit: str) -> str:
    """Return the unit of the integral of a speed; empty if ``unit`` is that of no speed."""
    for speed, integral in INTEGRAL_UNITS.items():
        # 1/s has the dimension of an angular speed too, but may be the rate of anything.
        if dimension_of(unit) == dimension_of(speed) and (speed == "m/s" or "rad" in unit or "rpm" in unit):
            return integral
    return ""


def _angle(speed: str) -> str:
    return f"_angle_{speed}"


def _speeds(base: Definition) -> list[tuple[str, str]]:
    """States that are speeds, with the unit of their integral; without those whose integral is a state already."""
    integrated = {text.strip() for left, text in base.equations if left.startswith("der(")}
    return [
        (state.name, integral_unit(state.unit))
        for state in base.states
        if state.name not in integrated and integral_unit(state.unit)
    ]


def augmentation_inputs(base: Definition) -> tuple[str, ...]:
    """The augmentation inputs, in the order of the sites."""
    return tuple(f"_enter_{site}" for site in range(len(sites(base))))


def component_parameters(slot: int) -> tuple[str, str, str]:
    """Amplitude, inner parameter and phase of a slot's component."""
    return f"_amplitude_{slot}", f"_inner_{slot}", f"_phase_{slot}"


def family_setting(slot: int) -> str:
    """The setting with the code of the family in a slot."""
    return f"_family_{slot}"


def shift_setting(slot: int) -> str:
    """The setting that is added to the source of a slot."""
    return f"_shift_{slot}"


def source_setting(slot: int, source: int) -> str:
    """The setting that is 1 for the source of a slot and 0 for every other, by the source's number."""
    return f"_weight_{slot}_{source}"


def site_setting(slot: int, site: int) -> str:
    """The setting that is 1 for the site of a slot and 0 for every other, by the site's number."""
    return f"_place_{slot}_{site}"


@lru_cache(maxsize=64)
def augmented_model(base: Definition) -> Definition:
    """``base`` with empty component slots, the angles of its speeds as states, and an input for each site."""
    speeds = _speeds(base)
    free: list[str] = []
    settings: list[str] = []
    for slot in range(MAX_COMPONENTS):
        free += component_parameters(slot)
        settings += [family_setting(slot), shift_setting(slot)]
        settings += [source_setting(slot, index) for index in range(1, len(sources(base)))]
        settings += [site_setting(slot, index) for index in range(len(sites(base)))]
    site_inputs = zip(augmentation_inputs(base), sites(base), strict=True)
    return replace(
        base,
        states=(*base.states, *(StateVariable(_angle(name), unit, "", 0.0, 0.0, 0.0) for name, unit in speeds)),
        inputs=(
            *base.inputs,
            Input(ELAPSED, "s", "", "foh"),
            *(Input(name, site.unit, "", "foh") for name, site in site_inputs),
        ),
        parameters=(
            *base.parameters,
            *(Parameter(name, "1", 0.0, -UNBOUNDED, UNBOUNDED, "") for name in free),
            *(Parameter(name, "1", 0.0, -UNBOUNDED, UNBOUNDED, "", Role.SETTING) for name in settings),
        ),
        equations=(*base.equations, *((f"der({_angle(name)})", name) for name, _ in speeds)),
        base=base,
    )


def positions(base: Definition) -> list[int]:
    """Return the indices of the sources that are positions and do not begin at zero in each window.

    What depends on time, or on a signal that drifts, resembles a parameter that drifts.
    """
    rows = enumerate(sources(base))
    return [at for at, source in rows if source.kind is SourceKind.PLACE and not source.symbol.startswith("_")]
