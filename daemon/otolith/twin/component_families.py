"""The meta-models: what an unknown component may look like, one row each (the paper's Table 1; friction).

A component is ``amplitude * shape(x; inner, phase)`` of one quantity ``x``. Whoever adds a row adds a family
everywhere: its formula is turned into compiled code with its derivatives, and the search takes its bounds from here.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array


class Kind(StrEnum):
    """What an input of a component is."""

    NOTHING = "nothing"
    TIME = "time"
    PLACE = "place"
    """An angle or a position, in which a machine repeats itself."""
    SIGNAL = "signal"


@dataclass(frozen=True, slots=True)
class Inner:
    """The number inside a meta-model that the search has to find."""

    meaning: str
    unit: str
    """Of one unit of the input ``{x}``."""
    bounds: Callable[[Array], tuple[float, float]]
    """(records,) of the input -> lowest and highest value that such a window can show."""
    points: int
    """Of the grid from which the search begins."""


@dataclass(frozen=True, slots=True)
class ComponentFamily:
    """A family of components."""

    name: str
    formula: str
    """Of ``a`` the amplitude, ``x`` the input, ``b`` the inner number, ``c`` the phase."""
    equation: str
    """For people; the same letters in braces."""
    conditions: str
    """Working conditions under which machines show it (Table 1)."""
    domain: str
    """Where it is valid, in words."""
    inputs: frozenset[Kind]
    valid: Callable[[Array], bool]
    """(records,) of the input -> whether this window lets the family be told from others at all."""
    inner: Inner | None = None
    holds: bool = False
    """Whether it takes hold of what it depends on, as dry friction of a speed: then the linear picture, which is about
    none of it, underrates it."""
    given: Callable[[Array], float] | None = None
    """(records,) of the input -> the inner number of a family that has one which is not searched for."""
    phases: tuple[float, ...] = (0.0,)
    """Two for a shape whose phase is unknown: both amplitudes enter linearly."""


FLOOR = 1e-9  # of the absolute value of an input, in its unit: roots and logarithms have no slope at zero
ANY = frozenset({Kind.TIME, Kind.PLACE, Kind.SIGNAL})
LEAST_TURN = 0.75 * 2.0 * math.pi  # of a sine within a window, below which it is a bend and no period
STEEPEST = 30.0  # exponent at most: an amplitude at zero has to be a number that somebody can read
DIED_DOWN = 0.5  # of the largest value of an input: a hump that is wider has not been seen to die down
TURNOVER = 0.005  # of the largest value of an input: where dry friction has turned over
NYQUIST = 0.8 * math.pi  # per record, of what can be sampled at all


def _moves(x: Array) -> bool:
    return float(np.ptp(x)) > 0.02 * float(np.abs(x).max())


def _keeps_its_sign(x: Array) -> bool:
    return _moves(x) and (float(x.min()) > 0.0 or float(x.max()) < 0.0)


def _changes_its_sign(x: Array) -> bool:
    return float(x.min()) < 0.0 < float(x.max())


def _turns(x: Array) -> bool:
    low, high = _orders(x)
    return high > low


def _orders(x: Array) -> tuple[float, float]:
    step = float(np.abs(np.diff(x)).max(initial=0.0))
    return LEAST_TURN / max(float(np.ptp(x)), FLOOR), NYQUIST / max(step, FLOOR)


def _bends(x: Array) -> tuple[float, float]:
    width, reach = max(float(np.ptp(x)), FLOOR), max(float(np.abs(x).max()), FLOOR)
    return 0.3 / width, min(12.0 / width, STEEPEST / reach)


def _can_bend(x: Array) -> bool:
    low, high = _bends(x)
    return _moves(x) and high > low


def _turnover(x: Array) -> float:
    """Within this of zero dry friction turns over: a step would never let a machine at rest come to rest."""
    return TURNOVER * max(float(np.abs(x).max()), FLOOR)


def _comes_near_zero(x: Array) -> bool:
    low, high = _near_zero(x)
    return _moves(x) and low < high


def _near_zero(x: Array) -> tuple[float, float]:
    """A hump so narrow that the window sees nothing of it could be of any height."""
    size = np.abs(x)
    reach = max(float(size.max()), FLOOR)
    return max(0.02 * reach, 0.5 * float(size.min())), DIED_DOWN * reach


RATE = Inner("rate", "1/{x}", _bends, 2)

COMPONENT_FAMILIES: tuple[ComponentFamily, ...] = (
    ComponentFamily("constant", "a", "{a}", "offset, constant load, leak", "everywhere", frozenset({Kind.NOTHING}),
              lambda x: True),
    ComponentFamily("linear", "a*x", "{a}·{x}", "friction, misalignment, backlash", "everywhere", ANY, _moves),
    ComponentFamily("exponential", "a*exp(b*x)", "{a}·exp({b}·{x})",
              "current leaking, deterioration, wear and tear, corrosion",
              "everywhere", ANY, _can_bend, RATE),
    ComponentFamily("negative exponential", "a*exp(-b*x)", "{a}·exp(−{b}·{x})",
              "ageing, degradation, fatigue, crack growth",
              "everywhere", ANY, _can_bend, RATE),
    ComponentFamily("power", f"a*sign(x)*exp(b*log(Max(absolute(x), {FLOOR})))", "{a}·{x}^{b}",
              "hard stops, overloading, mechanical shock", "mirrored for negative inputs", ANY, _moves,
              Inner("exponent", "1", lambda x: (0.3, 4.0), 2)),
    ComponentFamily("logarithmic", f"a*log(Max(absolute(x), {FLOOR}))", "{a}·ln({x})",
              "saturation, memory effects, hysteresis", "inputs of one sign", ANY, _keeps_its_sign),
    ComponentFamily("periodic", "a*sin(b*x + c)", "{a}·sin({b}·{x} {c})",
              "unbalanced shaft, shaft misalignment, machine unsteadiness",
              "time, angles and positions: a sine of anything else could follow whatever it likes",
              frozenset({Kind.TIME, Kind.PLACE}), _turns, Inner("frequency", "rad/{x}", _orders, 0),
              phases=(0.0, 0.5 * math.pi)),
    ComponentFamily("Coulomb", "a*tanh(x/b)", "{a}·sign({x})", "dry friction", "inputs that change their sign",
              frozenset({Kind.PLACE, Kind.SIGNAL}), _changes_its_sign, holds=True, given=_turnover),
    ComponentFamily("Stribeck", f"a*tanh(x/({TURNOVER}*b))*exp(-(x/b)**2)", "{a}·sign({x})·exp(−({x}/{b})²)",
              "friction that falls with the speed",
              "inputs that come near zero", frozenset({Kind.PLACE, Kind.SIGNAL}), _comes_near_zero,
              Inner("Stribeck speed", "{x}", _near_zero, 4)),
)  # fmt: skip
NAMES = tuple(row.name for row in COMPONENT_FAMILIES)


def family_of(name: str) -> ComponentFamily:
    """The row of that name."""
    return COMPONENT_FAMILIES[NAMES.index(name)]


def code_of(name: str) -> float:
    """What stands for the family in compiled code; zero stands for none."""
    return 1.0 + NAMES.index(name)
