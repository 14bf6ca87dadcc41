"""Algebra before code: a printer of scalars, what can be computed once per trajectory, and sparse Jacobians.

Fragments of generated kernels: lines of source that more than one kernel is made of.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy.printing.pycode import PythonCodePrinter

from otolith.twin.definition import Definition
from otolith.twin.symbolic import System, system_of


class Printer(PythonCodePrinter):  # type: ignore[misc]  # sympy has no types
    """Scalars for numba: small powers as products, the steps of sign and max without a call."""

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:  # noqa: N802 - sympy's name
        base, exponent = expr.as_base_exp()
        text = self.parenthesize(base, 1000)
        if exponent.is_Integer and 1 <= abs(int(exponent)) <= 4:
            product = "*".join([text] * abs(int(exponent)))
            return f"({product})" if exponent > 0 else f"(1.0/({product}))"
        if exponent == sympy.Rational(1, 2):
            return f"math.sqrt({self._print(base)})"
        if exponent == sympy.Rational(-1, 2):
            return f"(1.0/math.sqrt({self._print(base)}))"
        return f"({text})**({float(exponent)!r})"

    def _print_sign(self, expr: Any) -> str:
        text = self._print(expr.args[0])
        return f"(1.0 if {text} > 0.0 else (-1.0 if {text} < 0.0 else 0.0))"

    def _print_absolute(self, expr: Any) -> str:
        return f"abs({self._print(expr.args[0])})"

    def _print_component(self, expr: Any) -> str:
        return f"{expr.func.__name__}({', '.join(self._print(argument) for argument in expr.args)})"

    # SymPy asks for a method of the very name of a function's class.
    _print_component_x = _print_component_a = _print_component_b = _print_component_c = _print_component

    def _print_Heaviside(self, expr: Any) -> str:  # noqa: N802
        return f"(1.0 if {self._print(expr.args[0])} > 0.0 else 0.0)"

    def _print_DiracDelta(self, expr: Any) -> str:  # noqa: N802 - where a step is, the derivative is taken beside it
        del expr
        return "0.0"

    def _print_Float(self, expr: Any) -> str:  # noqa: N802
        return repr(float(expr))

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: Any) -> str:  # noqa: N802
        return f"({int(expr.p)}.0/{int(expr.q)}.0)"


PRINTER = Printer({"fully_qualified_modules": True})


class Hoist:
    """Takes what depends on parameters alone out of expressions."""

    def __init__(self, parameters: Iterable[sympy.Symbol]) -> None:
        self._parameters = set(parameters)
        self._symbols: dict[sympy.Expr, sympy.Symbol] = {}

    @property
    def lines(self) -> list[str]:
        """Assignments, to be made once per trajectory."""
        return [f"{symbol.name} = {PRINTER.doprint(expression)}" for expression, symbol in self._symbols.items()]

    @property
    def names(self) -> list[str]:
        """What the assignments assign to."""
        return [symbol.name for symbol in self._symbols.values()]

    def __call__(self, expression: sympy.Expr) -> sympy.Expr:
        """The expression with what depends on parameters alone replaced by names."""
        if expression.is_Atom:
            return expression
        if self._alone(expression):
            return self._symbol(expression)
        if isinstance(expression, sympy.Piecewise):
            return sympy.Piecewise(*((self(value), self._condition(condition)) for value, condition in expression.args))
        if not (expression.is_Add or expression.is_Mul):
            return expression.func(*(self(part) for part in expression.args))
        alone = [part for part in expression.args if self._alone(part)]
        rest = [self(part) for part in expression.args if part not in alone]
        if alone and not (len(alone) == 1 and alone[0].is_Symbol):
            alone = [self._symbol(expression.func(*alone))]
        return expression.func(*alone, *rest)

    def _condition(self, condition: Any) -> Any:
        """A comparison is no number and stays; what it compares may be hoisted."""
        if condition.is_Atom:
            return condition
        inside = self._condition if not condition.is_Relational else self
        return condition.func(*(inside(part) for part in condition.args))

    def _alone(self, expression: sympy.Expr) -> bool:
        return bool(expression.free_symbols) and expression.free_symbols <= self._parameters

    def _symbol(self, expression: sympy.Expr) -> sympy.Symbol:
        if expression not in self._symbols:
            self._symbols[expression] = sympy.Symbol(f"h_{len(self._symbols)}", real=True)
        return self._symbols[expression]


@dataclass(frozen=True)
class Entries:
    """The entries of a Jacobian that are not zero everywhere."""

    places: tuple[tuple[int, int], ...]
    values: tuple[sympy.Expr, ...]

    @classmethod
    def of(cls, rows: Sequence[sympy.Expr], by: Sequence[sympy.Symbol]) -> "Entries":
        """The derivatives of ``rows``, each by each of ``by``."""
        found = [((r, c), sympy.diff(row, symbol)) for r, row in enumerate(rows) for c, symbol in enumerate(by)]
        found = [(place, value) for place, value in found if value != 0]
        return cls(tuple(place for place, _ in found), tuple(value for _, value in found))

    def names(self, prefix: str) -> list[str]:
        """A variable for each entry."""
        return [f"{prefix}_{row}_{column}" for row, column in self.places]


HELPER = '@njit(error_model="numpy", fastmath={"contract"})'


class Fragments:
    """What the kernels of one twin are put together of: names, reads, corrections, the integrator's step."""

    def __init__(self, definition: Definition) -> None:
        system = _renamed(system_of(definition))
        hoist = Hoist((*system.parameters, *system.settings))
        self.x = [symbol.name for symbol in system.states]
        self.u = [symbol.name for symbol in system.inputs]
        self.p = [symbol.name for symbol in system.parameters]
        self.settings = [symbol.name for symbol in system.settings]
        self.linear = [entry.hold == "foh" for entry in definition.inputs]
        self.outputs = len(system.outputs)
        self.a, self.b = Entries.of(system.rates, system.states), Entries.of(system.rates, system.parameters)
        self.c, self.d = Entries.of(system.outputs, system.states), Entries.of(system.outputs, system.parameters)
        self.rates = [hoist(expression) for expression in system.rates]
        self.expressions = [hoist(expression) for expression in system.outputs]
        self.rate_entries = [hoist(expression) for expression in (*self.a.values, *self.b.values)]
        self.output_entries = [hoist(expression) for expression in (*self.c.values, *self.d.values)]
        self.hoisted = hoist.lines
        self.fixed = [*self.p, *self.settings, *hoist.names]

    def function(self, name: str, expressions: list[sympy.Expr]) -> list[str]:
        """A function of scalars, subexpressions shared."""
        shared, results = sympy.cse(expressions, symbols=sympy.numbered_symbols("t_", real=True), order="none")
        lines = [f"{symbol.name} = {PRINTER.doprint(value)}" for symbol, value in shared]
        returned = ", ".join(PRINTER.doprint(result) for result in results)
        head = f"def {name}({', '.join([*self.x, *self.u, *self.fixed])}):"
        return [HELPER, head, *indent([*lines, f"return ({returned},)"]), "", ""]

    def arguments(self, states: Sequence[str], inputs: Sequence[str]) -> str:
        """What such a function is called with."""
        return ", ".join([*states, *inputs, *self.fixed])

    def y(self) -> list[str]:
        """The outputs of a record."""
        return [f"y_{index}" for index in range(self.outputs)]

    def k(self, stage: int) -> list[str]:
        """The rates at a stage."""
        return [f"k{stage}_{row}" for row in range(len(self.x))]

    def jacobians(self, stage: int) -> list[str]:
        """The entries of both Jacobians of the rates at a stage."""
        return [*self.a.names(f"a{stage}"), *self.b.names(f"b{stage}")]

    def preamble(self) -> list[str]:
        """Once per call."""
        return [
            "step = sample_period / substeps",
            "half, sixth = step / 2.0, step / 6.0",
            "correct = np.any(gain != 0.0)",
        ]

    def read(self, parameter: str, state: str) -> list[str]:
        """Once per trajectory."""
        return [
            *(f"{name} = {parameter.format(index)}" for index, name in enumerate([*self.p, *self.settings])),
            *self.hoisted,
            *(f"{name} = {state.format(index)}" for index, name in enumerate(self.x)),
        ]

    def read_inputs(self) -> list[str]:
        """Once per record."""
        return [f"{name} = inputs[record, {index}]" for index, name in enumerate(self.u)]

    def innovations(self) -> list[str]:
        """What was measured minus predicted; a record without a measurement corrects nothing."""
        lines = []
        for index in range(self.outputs):
            lines += [
                f"e_{index} = measured[record, {index}] - y_{index}",
                f"m_{index} = 1.0",
                f"if e_{index} != e_{index}:",
                f"    e_{index} = m_{index} = 0.0",
            ]
        return lines

    def correction(self, row: int) -> str:
        """Of a state, by the gain."""
        return added([f"gain[record, {row}, {index}] * e_{index}" for index in range(self.outputs)])

    def slope_correction(self, row: int) -> str:
        """Of a state's sensitivity, by the gain."""
        terms = [f"gain[record, {row}, {i}] * m_{i} * slopes[record, {i}, column]" for i in range(self.outputs)]
        return f"({added(terms)})"

    def slopes(self, following: str = "inputs[record + 1, {index}]") -> list[str]:
        """How a ``foh`` input runs from substep to substep."""
        return [
            f"g_{name} = ({following.format(index=index)} - {name}) / substeps"
            for index, (name, linear) in enumerate(zip(self.u, self.linear, strict=True))
            if linear
        ]

    def step(self, stages: list[str], then: list[str]) -> list[str]:
        """From a record to the next, if there is one; see :meth:`substeps`."""
        return ["if record + 1 == records:", "    break", *self.slopes(), *self.substeps(stages, then)]

    def substeps(self, stages: list[str], then: list[str]) -> list[str]:
        """The substeps of a record by the classical Runge-Kutta method; ``stages`` wait for their arguments."""
        running = [name for name, linear in zip(self.u, self.linear, strict=True) if linear]
        at = {"": "", "half": "m", "step": "z"}

        def inputs(where: str) -> list[str]:
            return [f"{at[where]}{name}" if name in running and at[where] else name for name in self.u]

        def states(stage: int, length: str) -> list[str]:
            return [f"{x} + {length} * k{stage}_{row}" for row, x in enumerate(self.x)]

        arguments = [
            self.arguments(self.x, inputs("")),
            self.arguments(states(1, "half"), inputs("half")),
            self.arguments(states(2, "half"), inputs("half")),
            self.arguments(states(3, "step"), inputs("step")),
        ]
        substep = [
            *(f"m{name}, z{name} = {name} + 0.5 * g_{name}, {name} + g_{name}" for name in running),
            *(stage.format(given) for stage, given in zip(stages, arguments, strict=True)),
            *(f"{x} += sixth * (k1_{r} + 2.0 * k2_{r} + 2.0 * k3_{r} + k4_{r})" for r, x in enumerate(self.x)),
            *then,
            *(f"{name} = z{name}" for name in running),
        ]
        return ["for substep in range(substeps):", *indent(substep)]

    def advance(self) -> list[str]:
        """A function of scalars: the states at the next record, where the inputs are ``w``."""
        following = [f"w_{index}" for index in range(len(self.u))]
        head = ", ".join(["step", "substeps", *self.x, *self.u, *following, *self.fixed])
        body = [
            "half, sixth = step / 2.0, step / 6.0",
            *self.slopes("w_{index}"),
            *self.substeps([f"{unpacked(self.k(stage))} = rates_({{}})" for stage in range(1, 5)], []),
            f"return {unpacked(self.x)}",
        ]
        return [HELPER, f"def advance_({head}):", *indent(body), "", ""]

    def propagate(self, columns: int) -> list[str]:
        """The derivative of the step: each column of the state's sensitivities through the four stages."""
        lines = [
            f"drive[{stage - 1}, {row}, {column}] = {name}"
            for stage in range(1, 5)
            for (row, column), name in zip(self.b.places, self.b.names(f"b{stage}"), strict=True)
        ]
        base = len(self.p) + len(self.x)
        if columns > base:
            lines.append("begins = when + substep * step")
            lines += [
                f"drive[{stage - 1}, {row}, {base + column}] = (begins + {share} * step) * {name}"
                for stage, share in ((1, 0.0), (2, 0.5), (3, 0.5), (4, 1.0))
                for (row, column), name in zip(self.b.places, self.b.names(f"b{stage}"), strict=True)
            ]
        rows, driven = range(len(self.x)), {row for row, _ in self.b.places}
        inner = [f"s_{row} = state[{row}, column]" for row in rows]
        for stage, length in ((1, ""), (2, "half"), (3, "half"), (4, "step")):
            for row in rows:
                terms = [
                    f"{name} * {f'(s_{c} + {length} * q{stage - 1}_{c})' if length else f's_{c}'}"
                    for (r, c), name in zip(self.a.places, self.a.names(f"a{stage}"), strict=True)
                    if r == row
                ]
                terms += [f"drive[{stage - 1}, {row}, column]"] if row in driven else []
                inner.append(f"q{stage}_{row} = {added(terms)}")
        inner += [f"state[{r}, column] = s_{r} + sixth * (q1_{r} + 2.0 * q2_{r} + 2.0 * q3_{r} + q4_{r})" for r in rows]
        return [*lines, f"for column in range({columns}):", *indent(inner)]


def _renamed(system: System) -> System:
    """Prefixed symbols, so that no name of a page meets one of the kernel's own."""
    new = {
        symbol: sympy.Symbol(f"{prefix}_{symbol.name}", real=True)
        for prefix, symbols in (
            ("x", system.states),
            ("u", system.inputs),
            ("p", (*system.parameters, *system.settings)),
        )
        for symbol in symbols
    }
    return System(
        states=tuple(new[symbol] for symbol in system.states),
        inputs=tuple(new[symbol] for symbol in system.inputs),
        parameters=tuple(new[symbol] for symbol in system.parameters),
        settings=tuple(new[symbol] for symbol in system.settings),
        rates=tuple(expression.xreplace(new) for expression in system.rates),
        outputs=tuple(expression.xreplace(new) for expression in system.outputs),
    )


def indent(lines: Iterable[str]) -> list[str]:
    """One level deeper."""
    return [f"    {line}" for line in lines]


def record_loop(lines: list[str]) -> list[str]:
    """Over all records."""
    return ["for record in range(records):", *indent(lines)]


def unpacked(names: Sequence[str]) -> str:
    """A tuple to assign to, of one entry as well."""
    return f"({', '.join(names)},)"


def added(terms: Sequence[str]) -> str:
    """A sum, of nothing as well."""
    return " + ".join(terms) if terms else "0.0"
