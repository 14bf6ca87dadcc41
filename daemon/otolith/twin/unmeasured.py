"""Inputs that no sensor measures: a twin rewritten by what is assumed of them.

Such an input becomes a parameter, a state or a definition of the same name, so that the equations which use it stay as
their author wrote them. ``docs/describe-your-machine.md`` explains when to use which.
"""

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.components import integral_unit
from otolith.twin.definition import Definition, Input, Parameter, Role, StateVariable
from otolith.twin.expressions import (
    check_known,
    describe,
    dimension_of,
    dimensionless,
    evaluate,
    infer_dimension,
    parse,
)
from otolith.twin.language import equation_faults
from otolith.twin.rates import ordered_equations, rate_terms
from otolith_drivers.units import to_base

# Decisions. docs/reference/thresholds-twin.md gives the origin of each and the test that guards it.
WIDER = 1.0  # of the width of an input's range: what the bounds of the unknown value have on either side of it
SLOW_CHANGE = 0.01  # of that width per square root of a second: process noise of a load that changes slowly
USUAL_SHARE, LEAST_SHARE = 0.1, 0.01  # of a state's largest value: where the load is thought to be the range's largest
DRY_SHARE = 0.05  # of the range's largest value: dry friction at which a search begins
TRANSITIONS = {"rad": (0.05, 0.5, 5.0), "m": (1e-4, 2e-3, 5e-2)}
"""Lowest, nominal and highest speed within which dry friction changes sign, in rad/s or m/s."""
FRICTION_LIMITS = (("+50 %",), ("+100 %",))  # WATCH and ACT, as of the frictions of the library's twins
FACTOR_LIMITS = (("-20 %", "+20 %"), ("-40 %", "+40 %"))  # WATCH and ACT, as of the torque of the library's fan
LOAD = "load"  # part to which belongs what stands for a load, unless the twin has a part with friction there
SPEEDS = np.array([0.1, 0.2, 0.4, -0.1, -0.2, -0.4])  # of a state's largest value: where frictions are compared
SAME_SHAPE = 1e-6  # relative difference up to which a term of the twin is the friction it is compared with


class Assumption(StrEnum):
    """What is assumed of an input without a sensor."""

    CONSTANT = "constant"  # One value in each window
    SLOW = "slow"  # A random walk
    FRICTION = "friction"  # Viscous and dry friction
    PROPORTIONAL = "proportional"  # A factor times an expression


@dataclass(frozen=True, slots=True)
class UnmeasuredInput:
    """An input without a sensor."""

    name: str
    assumption: Assumption
    expression: str = ""  # In the twin language, of a proportional one

    @property
    def description(self) -> str:
        """The assumption in words."""
        match self.assumption:
            case Assumption.CONSTANT:
                return f"{self.name}, taken as constant within a window"
            case Assumption.SLOW:
                return f"{self.name}, taken as changing slowly"
            case Assumption.FRICTION:
                return f"{self.name}, taken as friction"
            case Assumption.PROPORTIONAL:
                return f"{self.name}, taken as proportional to {self.expression}"


def without_sensor(definition: Definition, item: UnmeasuredInput) -> Definition:
    """Return the twin with an input replaced by what is assumed of it.

    Raises:
        ValueError: the twin has no such input or states no range of it, or the assumption does not fit the equations.
    """
    driven = next((row for row in definition.inputs if row.name == item.name), None)
    if driven is None:
        raise ValueError(f"the twin has no input {item.name}")
    if not driven.has_range:
        raise ValueError(f"the twin states no range of {driven.name}: write one in its file, like range = [-5, 5]")
    rest = replace(
        definition,
        inputs=tuple(row for row in definition.inputs if row is not driven),
        operation=tuple(own for own in definition.operation if own.signal != driven.name),
    )
    match item.assumption:
        case Assumption.CONSTANT:
            changed = replace(rest, parameters=(*rest.parameters, _constant(driven)))
        case Assumption.SLOW:
            equations = (*rest.equations, (f"der({driven.name})", "0"))
            changed = replace(rest, states=(*rest.states, _slow(driven)), equations=equations)
        case Assumption.FRICTION:
            changed = _with_friction(definition, rest, driven)
        case Assumption.PROPORTIONAL:
            factor = _factor(rest, driven, item.expression, "factor", "factor of")
            watch, act = FACTOR_LIMITS
            factor = replace(factor, part=LOAD, watch=watch, act=act)
            changed = _with_terms(rest, driven, [f"{factor.name}*({item.expression})"], [factor])
    taken = rest.units().keys() | {name for name, _, _ in rest.definitions}
    for parameter in changed.parameters[len(rest.parameters) :]:
        if parameter.name in taken:
            raise ValueError(f"the twin has a quantity {parameter.name} already: rename it in its file")
    if faults := equation_faults(changed):
        raise ValueError(f"does not fit the twin: {faults[0]}")
    return changed


def _constant(driven: Input) -> Parameter:
    return Parameter(driven.name, driven.unit, *_bounds(driven), driven.meaning, Role.ESTIMATED)


def _slow(driven: Input) -> StateVariable:
    change = SLOW_CHANGE * (driven.high - driven.low)
    return StateVariable(driven.name, driven.unit, driven.meaning, *_bounds(driven), process_noise=change)


def _bounds(driven: Input) -> tuple[float, float, float]:
    """Return the middle of an input's range, and wider bounds around the range; a range of one sign keeps it."""
    reach, middle = WIDER * (driven.high - driven.low), 0.5 * (driven.low + driven.high)
    low = max(driven.low - reach, 0.0) if driven.low >= 0.0 else driven.low - reach
    high = min(driven.high + reach, 0.0) if driven.high <= 0.0 else driven.high + reach
    return middle, low, high


def _with_terms(rest: Definition, driven: Input, terms: list[str], added: list[Parameter]) -> Definition:
    """Return the twin with the sum of ``terms`` as the definition of an input, and the parameters in them."""
    definitions = ((driven.name, " + ".join(terms) or "0", driven.meaning), *rest.definitions)
    return replace(rest, definitions=definitions, parameters=(*rest.parameters, *added))


def _factor(rest: Definition, driven: Input, expression: str, suffix: str, what: str) -> Parameter:
    """Return the parameter that multiplies an expression; at usual values the product is the largest of the range."""
    tree = parse(expression)
    shown = {row.name for row in rest.outputs} - {row.name for row in rest.states}
    known = {name: dimension_of(unit) for name, unit in rest.units().items() if name not in shown}
    check_known(tree, known)
    dimension = dimension_of(driven.unit) / (infer_dimension(tree, known) or dimensionless())
    unit = "1" if dimension == dimensionless() else describe(dimension)
    _, scales = ordered_equations(rest)
    usual, least = (
        abs(float(evaluate(tree, {name: [value * scales[name]] for name, value in _values(rest, share).items()})[0]))
        for share in (USUAL_SHARE, LEAST_SHARE)
    )
    if not 0.0 < least < usual < np.inf:
        raise ValueError(f"{expression!r} does not grow with a state or an input: write one that does, like 'omega^2'")
    largest = _largest(driven.low, driven.high) * to_base(driven.unit)[0]
    meaning = f"{what} {driven.meaning}"
    name = f"{driven.name}_{suffix}"
    return Parameter(name, unit, largest / usual, -largest / least, largest / least, meaning, Role.ESTIMATED)


def _largest(low: float, high: float) -> float:
    return max(abs(low), abs(high))


def _values(definition: Definition, share: float) -> dict[str, Array]:
    """Return a value (1,) of every quantity: of states that share of the largest, of inputs ten times as much."""
    values = {row.name: row.nominal for row in definition.parameters}
    values |= {row.name: row.value for row in definition.constants}
    values |= {row.name: share * _largest(row.low, row.high) for row in definition.states}
    values |= {row.name: share / USUAL_SHARE * _largest(row.low, row.high) for row in definition.inputs}
    return {name: np.array([value]) for name, value in values.items()}


def _with_friction(definition: Definition, rest: Definition, driven: Input) -> Definition:
    """Return the twin with friction in place of an input, as far as the twin does not have that friction itself.

    The friction that the twin has is then that of the load too: its bounds are wider. That which is added may be
    slightly negative, so that none is an estimate within the bounds; it belongs to the part with the friction that the
    twin has.
    """
    frictions, largest = _Frictions(definition, driven), _largest(driven.low, driven.high)
    speed, place = frictions.speed, integral_unit(frictions.speed.unit)
    parts = [row.part for row in definition.parameters if row.name in (*frictions.viscous, *frictions.dry) and row.part]
    watch, act = FRICTION_LIMITS
    limited = partial(replace, part=parts[0] if parts else LOAD, watch=watch, act=act)
    terms: list[str] = []
    added: list[Parameter] = []
    viscous = _factor(rest, driven, speed.name, "viscous", "viscous friction in")
    if not frictions.viscous:
        added.append(limited(replace(viscous, low=-viscous.nominal)))
        terms.append(f"{viscous.name}*{speed.name}")
    if not frictions.dry:
        dry, transition = f"{driven.name}_dry", f"{driven.name}_speed"
        size, meaning = DRY_SHARE * largest, f"dry friction in {driven.meaning}"
        added.append(limited(Parameter(dry, driven.unit, size, -size, largest, meaning, Role.ESTIMATED)))
        low, nominal, high = TRANSITIONS[place]
        meaning = "speed within which dry friction changes sign"
        added.append(Parameter(transition, f"{place}/s", nominal, low, high, meaning))
        terms.append(f"{dry}*tanh({speed.name}/{transition})")
    of_load = dict.fromkeys(frictions.viscous, viscous.high * to_base(viscous.unit)[0])
    of_load |= dict.fromkeys(frictions.dry, largest * to_base(driven.unit)[0])
    wider = tuple(
        replace(row, high=row.high + of_load[row.name] / to_base(row.unit)[0]) if row.name in of_load else row
        for row in rest.parameters
    )
    return _with_terms(replace(rest, parameters=wider), driven, terms, added)


class _Frictions:
    """The speed that an input acts on, and the parameters of a twin that act as friction at the same place."""

    def __init__(self, definition: Definition, driven: Input) -> None:
        if definition.fmu is not None:
            raise ValueError(f'which friction the FMU has is not known: write {driven.name} = {{ unknown = "slow" }}')
        self._definition = definition
        effects = self._effect(driven.name, driven.low, driven.high)
        acting = [row for row, effect in zip(definition.states, effects, strict=True) if effect.any()]
        if len(acting) != 1 or not integral_unit(acting[0].unit):
            on = ", ".join(f"{row.name} ({row.unit})" for row in acting)
            raise ValueError(f"{driven.name} acts on {on}: friction acts on one speed, in rad/s or m/s")
        (self.speed,) = acting
        at = definition.states.index(self.speed)
        braking = self._effect(driven.name, driven.low, driven.high, self.speed)[at]
        if not (braking < 0.0).all():
            raise ValueError(f"{driven.name} drives {self.speed.name}: friction can only stand for what brakes it")
        shapes = {
            row.name: self._effect(row.name, row.low, row.high, self.speed)[at] / braking
            for row in definition.parameters
        }
        self.viscous = [name for name, shape in shapes.items() if _is_multiple(shape, SPEEDS)]
        self.dry = [name for name, shape in shapes.items() if _is_multiple(shape, np.sign(SPEEDS))]

    def _effect(self, name: str, low: float, high: float, speed: StateVariable | None = None) -> Array:
        """Return the change (states, speeds) of each rate from the ``low`` to the ``high`` value of a quantity."""
        values = _values(self._definition, USUAL_SHARE)
        if speed is not None:
            values[speed.name] = SPEEDS * _largest(speed.low, speed.high)
        behind, ahead = (
            np.array(
                [
                    np.broadcast_to(rows.sum(axis=0), len(SPEEDS))
                    for rows in rate_terms(self._definition, values | {name: np.array([value])})
                ]
            )
            for value in (low, high)
        )
        return np.asarray(ahead - behind)


def _is_multiple(shape: Array, of: Array) -> bool:
    """Whether ``shape`` is ``of`` times a positive number."""
    ratios = shape / of
    return bool(ratios.min() > 0.0 and np.ptp(ratios) <= SAME_SHAPE * ratios.max())
