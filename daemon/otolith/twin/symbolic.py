"""From the page to algebra: the right sides as SymPy expressions of scalars, helpers substituted, units made coherent.

Importing it loads SymPy, which only those need who print equations or generate a kernel.

Functions that SymPy lacks, or has with properties that a machine does not care for.

The algebra of slots: what enters at each site of a twin with slots (see :mod:`otolith.twin.augmentation`).

A twin as people read it: its equations as on paper, in Unicode or LaTeX.
"""

import ast
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import sympy

from otolith.twin.augmentation import SLOTS, enters, family, numbers, place, shift, sites, sources, weight
from otolith.twin.definition import Definition, Site
from otolith.twin.expressions import constant, parse
from otolith_drivers.units import to_base


class sign(sympy.Function):  # type: ignore[misc]  # noqa: N801 - sympy has no types; printed as it is called
    """The sign, with the slope that it has beside its step: SymPy's own asks whether its argument is real."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """Zero."""
        del argindex
        return sympy.Integer(0)


class absolute(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as above
    """The absolute value of a real quantity."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """The sign."""
        del argindex
        return sign(self.args[0])

    def _pretty(self, printer: object) -> object:
        return printer._print(sympy.Abs(self.args[0]))  # type: ignore[attr-defined]  # what sympy hands every printer

    def _latex(self, printer: object) -> str:
        found: str = printer._print(sympy.Abs(self.args[0]))  # type: ignore[attr-defined]  # as above
        return found


class component(sympy.Function):  # type: ignore[misc]  # noqa: N801 - as above
    """``component(family, x, a, b, c)``: a meta-model, which the kernel looks up by the family's number."""

    def fdiff(self, argindex: int = 1) -> sympy.Expr:
        """By anything but the family."""
        slope: sympy.Expr = SLOPES[argindex - 2](*self.args)
        return slope


class component_x(component):  # noqa: N801 - as above
    """Its derivative by the input."""


class component_a(component):  # noqa: N801 - as above
    """Its derivative by the amplitude."""


class component_b(component):  # noqa: N801 - as above
    """Its derivative by the inner number."""


class component_c(component):  # noqa: N801 - as above
    """Its derivative by the phase."""


SLOPES = (component_x, component_a, component_b, component_c)


def entering_of(
    plain: Definition, symbols: Mapping[str, sympy.Symbol], outputs: Mapping[str, sympy.Expr]
) -> list[sympy.Expr]:
    """For each site of ``plain``, in its order, the sum of what enters there, in coherent units.

    ``outputs`` are those of the plain twin in the units of the page: a component that depends on one would otherwise
    depend on itself.
    """
    components = [_component(plain, slot, symbols, outputs) for slot in range(SLOTS)]
    found = []
    for index, site in enumerate(sites(plain)):
        terms = [symbols[place(slot, index)] * entry for slot, entry in enumerate(components)]
        scale = to_base(site.unit)[0]
        total = sympy.Add(symbols[enters(index)], *terms)
        found.append(total if scale == 1.0 else sympy.Float(scale) * total)
    return found


def _component(
    plain: Definition, slot: int, symbols: Mapping[str, sympy.Symbol], outputs: Mapping[str, sympy.Expr]
) -> sympy.Expr:
    states = {entry.name for entry in plain.states}
    terms = [symbols[shift(slot)]]
    for index, source in enumerate(sources(plain)):
        if source.symbol:
            is_output = source.name in outputs and source.name not in states
            value = outputs[source.name] if is_output else symbols[source.symbol]
            terms.append(symbols[weight(slot, index)] * value)
    amplitude, inner, phase = (symbols[name] for name in numbers(slot))
    return component(symbols[family(slot)], sympy.Add(*terms), amplitude, inner, phase)


UNARY = {name: getattr(sympy, name) for name in ("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh",
                                                   "exp", "log", "sqrt")}  # fmt: skip
COMPARE = {ast.Lt: sympy.Lt, ast.LtE: sympy.Le, ast.Gt: sympy.Gt, ast.GtE: sympy.Ge}


@dataclass(frozen=True)
class System:
    """``dx/dt = rates(x, u, p)``, ``y = outputs(x, u, p)``, every quantity a real symbol in the unit of the page."""

    states: tuple[sympy.Symbol, ...]
    inputs: tuple[sympy.Symbol, ...]
    parameters: tuple[sympy.Symbol, ...]
    settings: tuple[sympy.Symbol, ...]
    """Of which no derivative is taken."""
    rates: tuple[sympy.Expr, ...]
    outputs: tuple[sympy.Expr, ...]


@lru_cache(maxsize=64)
def system_of(definition: Definition) -> System:
    """The algebra of a checked definition."""
    symbols = {name: sympy.Symbol(name, real=True) for name in definition.units()}
    scales = {name: to_base(unit)[0] for name, unit in definition.units().items()}
    # Equations hold in coherent units; a page may use others, so each symbol enters with its factor.
    values: dict[str, sympy.Expr] = {name: _scaled(symbols[name], scales[name]) for name in symbols}
    for entry in definition.constants:
        values[entry.name] = sympy.Float(entry.value * scales[entry.name])
    entering = _Entering(definition, symbols)
    for driven in definition.inputs:
        values[driven.name] -= entering.sensor(driven.name)  # the twin is driven by what is true
    pending = {name: parse(text) for name, text, _ in definition.definitions}
    while pending:
        ready = [name for name in pending if not _depends(pending[name], pending)]
        for name in ready:
            values[name] = entering.at(name, to_sympy(pending.pop(name), values), values)
    states = [entry.name for entry in definition.states]
    right = {left: entering.at(left, to_sympy(parse(text), values), values) for left, text in definition.equations}
    shown = {left: _scaled(side, 1.0 / scales[left]) for left, side in right.items() if left in scales}
    shown |= {name: symbols[name] for name in states}
    settings = len(definition.parameters) - definition.settings
    return System(
        states=tuple(symbols[name] for name in states),
        inputs=tuple(symbols[entry.name] for entry in definition.inputs),
        parameters=tuple(symbols[entry.name] for entry in definition.parameters[:settings]),
        settings=tuple(symbols[entry.name] for entry in definition.parameters[settings:]),
        rates=tuple(_scaled(right[f"der({name})"], 1.0 / scales[name]) for name in states),
        outputs=tuple(
            shown[entry.name] + _scaled(entering.sensor(entry.name), 1.0 / scales[entry.name])
            for entry in definition.outputs
        ),
    )


class _Entering:
    """What components add at the sites of a twin with slots; nothing at those of a plain one."""

    def __init__(self, definition: Definition, symbols: dict[str, sympy.Symbol]) -> None:
        self._sites: list[tuple[Site, sympy.Expr]] = []
        self._sensors: dict[str, sympy.Expr] = {}
        plain = definition.plain
        if plain is not None:
            outputs = [entry.name for entry in plain.outputs]
            entering = entering_of(plain, symbols, dict(zip(outputs, system_of(plain).outputs, strict=True)))
            own = len(plain.sites)
            self._sites = list(zip(plain.sites, entering[:own], strict=True))
            self._sensors = {
                site.into: expression for site, expression in zip(sites(plain)[own:], entering[own:], strict=True)
            }

    def at(self, left: str, side: sympy.Expr, values: dict[str, sympy.Expr]) -> sympy.Expr:
        """The right side that belongs to ``left``, with what enters there (Eq. 3 and 18)."""
        for site, expression in self._sites:
            if site.into == left and site.mode == "multiplicative":
                side *= 1 + expression
            elif site.into == left:
                side += to_sympy(parse(site.through), values) * expression
        return side

    def sensor(self, name: str) -> sympy.Expr:
        """What the sensor of a signal adds to the truth."""
        return self._sensors.get(name, sympy.Integer(0))


def to_sympy(tree: ast.expr, values: dict[str, sympy.Expr]) -> sympy.Expr:
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
            first, second = to_sympy(left, values), to_sympy(right, values)
            match operator:
                case ast.Add():
                    return first + second
                case ast.Sub():
                    return first - second
                case ast.Mult():
                    return first * second
                case _:
                    return first / second
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return _call(name, arguments, values)
        case _:
            raise AssertionError(ast.dump(tree))


def _call(name: str, arguments: list[ast.expr], values: dict[str, sympy.Expr]) -> sympy.Expr:
    if name == "where":
        condition = arguments[0]
        assert isinstance(condition, ast.Compare)  # noqa: S101 - the parser has seen to it
        left, right = to_sympy(condition.left, values), to_sympy(condition.comparators[0], values)
        test = COMPARE[type(condition.ops[0])](left, right)
        return sympy.Piecewise((to_sympy(arguments[1], values), test), (to_sympy(arguments[2], values), True))
    found = [to_sympy(argument, values) for argument in arguments]
    several = {"sign": sign, "abs": absolute, "min": sympy.Min, "max": sympy.Max, "atan2": sympy.atan2}
    return (UNARY | several)[name](*found)


def _scaled(expression: sympy.Expr, scale: float) -> sympy.Expr:
    return expression if scale == 1.0 else sympy.Float(scale) * expression


def _depends(tree: ast.expr, on: dict[str, ast.expr]) -> bool:
    return any(isinstance(node, ast.Name) and node.id in on for node in ast.walk(tree))


TIME = sympy.Symbol("t")


def equations(definition: Definition) -> list[sympy.Eq]:
    """Helper quantities in the author's order, then the equations; names stay as the author gave them."""
    symbols = {name: sympy.Symbol(name, real=True) for name in definition.units()}
    symbols |= {name: sympy.Symbol(name, real=True) for name, _, _ in definition.definitions}
    found = [
        sympy.Eq(symbols[name], to_sympy(parse(text), symbols), evaluate=False)
        for name, text, _ in definition.definitions
    ]
    for left, text in definition.equations:
        if left.startswith("der("):
            side = sympy.Derivative(sympy.Symbol(left[4:-1]), TIME, evaluate=False)
        else:
            side = symbols[left]
        found.append(sympy.Eq(side, to_sympy(parse(text), symbols), evaluate=False))
    return found


def unicode_page(definition: Definition, columns: int = 110) -> str:
    """The equations for a terminal."""
    return "\n\n".join(
        sympy.pretty(equation, use_unicode=True, num_columns=columns) for equation in equations(definition)
    )


def latex_page(definition: Definition) -> str:
    """The equations as the body of a LaTeX ``align*``."""
    lines = [sympy.latex(equation).replace(" = ", " &= ", 1) for equation in equations(definition)]
    return "\\begin{align*}\n" + " \\\\\n".join(lines) + "\n\\end{align*}"
