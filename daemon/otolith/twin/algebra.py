"""Algebra before code: a printer of scalars, what can be computed once per trajectory, and sparse Jacobians."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy.printing.pycode import PythonCodePrinter


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
