"""From a definition to algebra: its right sides as SymPy expressions, and its equations as printed for people.

Definitions are substituted, units are converted to coherent ones, and in an augmented twin components enter at their
sites. Importing this module loads SymPy, which only printing equations and generating a kernel need.
"""

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy

from otolith.twin.components import (
    MAX_COMPONENTS,
    augmentation_inputs,
    component_parameters,
    family_setting,
    shift_setting,
    site_setting,
    sites,
    source_setting,
    sources,
)
from otolith.twin.definition import Definition, Site
from otolith.twin.expressions import ARITHMETIC, constant, parse, row_of_fmu
from otolith_drivers.units import to_base

Values = Mapping[str, sympy.Expr]  # The expression of each name


class sign(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; the class name is printed
    """The sign function with derivative 0; SymPy's own asks whether its argument is real."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """0: the slope beside the step."""
        del argindex
        return sympy.Integer(0)


class absolute(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; the class name is printed
    """The absolute value of a real quantity."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """The sign of the argument."""
        del argindex
        return sign(self.args[0])

    def _pretty(self, printer: Any) -> Any:
        return printer._print(sympy.Abs(self.args[0]))

    def _latex(self, printer: Any) -> str:
        return str(printer._print(sympy.Abs(self.args[0])))


class component(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; the class name is printed
    """``component(family, x, a, b, c)``: the kernel looks the formula up by the code of the family."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """The derivative by ``x``, ``a``, ``b`` or ``c``; by the family there is none."""
        slope: sympy.Expr = COMPONENT_SLOPES[argindex - 2](*self.args)
        return slope


class component_x(component):  # noqa: N801 - sympy has no types; the class name is printed
    """Derivative of a component by its source."""


class component_a(component):  # noqa: N801 - sympy has no types; the class name is printed
    """Derivative of a component by its amplitude."""


class component_b(component):  # noqa: N801 - sympy has no types; the class name is printed
    """Derivative of a component by its inner parameter."""


class component_c(component):  # noqa: N801 - sympy has no types; the class name is printed
    """Derivative of a component by its phase."""


class external(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; the class name is printed
    """``external(row, table, ...)``: that row of what an FMU computes from all that follows, in coherent units."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """The derivative by an argument of the FMU; neither the row nor the table has one."""
        row, *rest = self.args
        return external_slope(row, sympy.Integer(argindex - FIRST_ARGUMENT), *rest)


class external_slope(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; the class name is printed
    """``external_slope(row, column, table, ...)``: the derivative of that row by that argument."""


TIME = sympy.Symbol("t")
FMU_TABLE = sympy.Symbol("fmu", real=True)
"""The address of the table by which kernels call an FMU; no name of a definition lacks a prefix."""
FIRST_ARGUMENT = 3  # of ``external``, counted from 1
COMPONENT_SLOPES = (component_x, component_a, component_b, component_c)
COMPARISONS = {ast.Lt: sympy.Lt, ast.LtE: sympy.Le, ast.Gt: sympy.Gt, ast.GtE: sympy.Ge}
SYMPY_FUNCTIONS = {
    **{name: getattr(sympy, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh",
                                               "tanh", "exp", "log", "sqrt")},
    "sign": sign, "abs": absolute, "min": sympy.Min, "max": sympy.Max,
}  # fmt: skip


@dataclass(frozen=True)
class System:
    """``dx/dt = rates(x, u, p)``, ``y = outputs(x, u, p)``; every symbol is real and in the unit of the definition.

    Names are prefixed with ``x_``, ``u_`` or ``p_``, so that no name of a twin file meets one of a kernel's own.
    """

    states: tuple[sympy.Symbol, ...]
    inputs: tuple[sympy.Symbol, ...]
    parameters: tuple[sympy.Symbol, ...]
    settings: tuple[sympy.Symbol, ...]  # Parameters by which no derivative is taken
    rates: tuple[sympy.Expr, ...]
    outputs: tuple[sympy.Expr, ...]


@lru_cache(maxsize=64)
def system_of(definition: Definition) -> System:
    """The algebra of a checked definition."""
    symbols = _symbols(definition)
    scales = {name: to_base(unit)[0] for name, unit in definition.units().items()}
    # Equations hold in coherent units, so each symbol enters with the factor of its own unit.
    values: dict[str, sympy.Expr] = {name: _scaled(symbol, scales[name]) for name, symbol in symbols.items()}
    for fixed in definition.constants:
        values[fixed.name] = sympy.Float(fixed.value * scales[fixed.name])
    entering = _Entering(definition, symbols, values)
    for driven in definition.inputs:
        values[driven.name] -= entering.sensor_error(driven.name)  # the true input drives the twin
    pending = {name: parse(text) for name, text, _ in definition.definitions}
    while pending:
        for name in [name for name in pending if not _depends(pending[name], pending)]:
            values[name] = entering.at(name, to_sympy(pending.pop(name), values), values)
    states = [state.name for state in definition.states]
    right = {left: entering.at(left, to_sympy(parse(text), values), values) for left, text in definition.equations}
    shown = {left: _scaled(side, 1.0 / scales[left]) for left, side in right.items() if left in scales}
    shown |= {name: symbols[name] for name in states}
    parameters = tuple(symbols[parameter.name] for parameter in definition.parameters)
    free = len(parameters) - definition.settings
    return System(
        states=tuple(symbols[name] for name in states),
        inputs=tuple(symbols[driven.name] for driven in definition.inputs),
        parameters=parameters[:free],
        settings=parameters[free:],
        rates=tuple(_scaled(right[f"der({name})"], 1.0 / scales[name]) for name in states),
        outputs=tuple(
            shown[output.name] + _scaled(entering.sensor_error(output.name), 1.0 / scales[output.name])
            for output in definition.outputs
        ),
    )


def _symbols(definition: Definition) -> dict[str, sympy.Symbol]:
    names = {
        "p": [parameter.name for parameter in definition.parameters],
        "u": [driven.name for driven in definition.inputs],
        "x": [state.name for state in definition.states],
    }
    return {name: sympy.Symbol(f"{prefix}_{name}", real=True) for prefix, group in names.items() for name in group}


def _scaled(expression: sympy.Expr, scale: float) -> sympy.Expr:
    return expression if scale == 1.0 else sympy.Float(scale) * expression


def _depends(tree: ast.expr, on: Mapping[str, ast.expr]) -> bool:
    return any(isinstance(node, ast.Name) and node.id in on for node in ast.walk(tree))


class _Entering:
    """What components and augmentation inputs add at the sites of an augmented twin; nothing for any other twin."""

    def __init__(self, definition: Definition, symbols: Mapping[str, sympy.Symbol], values: Values) -> None:
        self._author: list[tuple[Site, sympy.Expr]] = []
        self._sensors: dict[str, sympy.Expr] = {}
        if definition.base is not None:
            entering = list(zip(sites(definition.base), _sums_at_sites(definition.base, symbols), strict=True))
            own = len(definition.base.sites)
            self._author = entering[:own]
            for site, added in entering[own:]:
                self._sensors[site.into] = self.sensor_error(site.into) + to_sympy(parse(site.through), values) * added

    def at(self, left: str, side: sympy.Expr, values: Values) -> sympy.Expr:
        """The right ``side`` of ``left`` with what enters there (Eq. 3 and 18)."""
        for site, expression in self._author:
            if site.into == left and site.mode == "multiplicative":
                side *= 1 + expression
            elif site.into == left:
                side += to_sympy(parse(site.through), values) * expression
        return side

    def sensor_error(self, name: str) -> sympy.Expr:
        """What the sensor of a signal adds to its true value."""
        return self._sensors.get(name, sympy.Integer(0))


def _sums_at_sites(base: Definition, symbols: Mapping[str, sympy.Symbol]) -> list[sympy.Expr]:
    """For each site of ``base`` its augmentation input and the components there, in coherent units."""
    components = [_component(base, slot, symbols) for slot in range(MAX_COMPONENTS)]
    sums = []
    for index, (site, name) in enumerate(zip(sites(base), augmentation_inputs(base), strict=True)):
        terms = [symbols[site_setting(slot, index)] * term for slot, term in enumerate(components)]
        sums.append(_scaled(sympy.Add(symbols[name], *terms), to_base(site.unit)[0]))
    return sums


def _component(base: Definition, slot: int, symbols: Mapping[str, sympy.Symbol]) -> sympy.Expr:
    """The component of a slot, as a function of the source that its settings select."""
    # The outputs of the base model: those of the augmented twin would depend on the component itself.
    outputs = {shown.name: value for shown, value in zip(base.outputs, system_of(base).outputs, strict=True)}
    values = outputs | {state.name: symbols[state.name] for state in base.states}
    terms = [symbols[shift_setting(slot)]]
    for index, source in enumerate(sources(base)):
        if source.symbol:
            value = values[source.name] if source.name in values else symbols[source.symbol]
            terms.append(symbols[source_setting(slot, index)] * value)
    amplitude, inner, phase = (symbols[name] for name in component_parameters(slot))
    return component(symbols[family_setting(slot)], sympy.Add(*terms), amplitude, inner, phase)


def to_sympy(tree: ast.expr, values: Values) -> sympy.Expr:
    """The expression with every name replaced by its value."""
    match tree:
        case ast.Constant(value=value):
            return sympy.Integer(value) if isinstance(value, int) else sympy.Float(value)
        case ast.Name(id=name):
            return sympy.pi if name == "pi" else values[name]
        case ast.UnaryOp(op=operator, operand=operand):
            inner = to_sympy(operand, values)
            return -inner if isinstance(operator, ast.USub) else inner
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return to_sympy(left, values) ** sympy.nsimplify(constant(right), rational=True)
        case ast.BinOp(left=left, op=operator, right=right):
            return ARITHMETIC[type(operator)](to_sympy(left, values), to_sympy(right, values))
        case ast.Call(func=ast.Name(id="where"), args=[ast.Compare() as condition, then, otherwise]):
            left, right = to_sympy(condition.left, values), to_sympy(condition.comparators[0], values)
            test = COMPARISONS[type(condition.ops[0])](left, right)
            return sympy.Piecewise((to_sympy(then, values), test), (to_sympy(otherwise, values), True))
        case ast.Call(args=[ast.Constant(), *arguments]) if (row := row_of_fmu(tree)) is not None:
            return external(sympy.Integer(row), FMU_TABLE, *(to_sympy(argument, values) for argument in arguments))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return SYMPY_FUNCTIONS[name](*(to_sympy(argument, values) for argument in arguments))
        case _:
            raise AssertionError(ast.dump(tree))


def equations(definition: Definition) -> list[sympy.Eq]:
    """Definitions in the author's order, then the equations, with the author's names."""
    symbols = {name: sympy.Symbol(name, real=True) for name in definition.units()}
    symbols |= {name: sympy.Symbol(name, real=True) for name, _, _ in definition.definitions}
    sides = [(symbols[name], text) for name, text, _ in definition.definitions]
    for left, text in definition.equations:
        is_rate = left.startswith("der(")
        side = sympy.Derivative(sympy.Symbol(left[4:-1]), TIME, evaluate=False) if is_rate else symbols[left]
        sides.append((side, text))
    return [sympy.Eq(left, to_sympy(parse(text), symbols), evaluate=False) for left, text in sides]


def unicode_page(definition: Definition, columns: int = 110) -> str:
    """The equations for a terminal of that many columns."""
    return "\n\n".join(
        sympy.pretty(equation, use_unicode=True, num_columns=columns) for equation in equations(definition)
    )


def latex_page(definition: Definition) -> str:
    """The equations as a LaTeX ``align*`` environment."""
    lines = [sympy.latex(equation).replace(" = ", " &= ", 1) for equation in equations(definition)]
    return "\\begin{align*}\n" + " \\\\\n".join(lines) + "\n\\end{align*}"
