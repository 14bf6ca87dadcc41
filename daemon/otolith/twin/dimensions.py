"""Dimensional analysis of expressions with pint: the dimension of an expression, or two of its parts that disagree."""

import ast
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from otolith.twin.expressions import ExpressionError, constant
from otolith_drivers.units import unit

Dimension = Any
"""pint's container of dimensions and exponents; None for the number zero, which fits any dimension."""

NAMED_UNITS = ("V", "A", "ohm", "H", "Wb", "W", "N*m", "J", "N", "Pa", "m", "s", "kg", "m/s", "m/s^2", "rad/s^2", "1/s",
               "kg*m^2", "N*m*s", "m^3/s", "V/s", "A/s", "N/m", "N*s/m", "Pa/s", "K", "K/s", "W/K", "J/K", "W/s", "m^2",
               "m^3")  # fmt: skip
BASE_UNITS = {"[mass]": "kg", "[length]": "m", "[time]": "s", "[current]": "A", "[temperature]": "K",
              "[substance]": "mol", "[luminosity]": "cd"}  # fmt: skip


def dimension_of(unit_text: str) -> Dimension:
    """The dimension of a unit.

    Raises:
        ValueError: not a unit.
    """
    return unit(unit_text).dimensionality


def dimensionless() -> Dimension:
    """The dimension of a plain number. A function, as pint takes 15 MB in each process that reads a unit."""
    return dimension_of("1")


def infer_dimension(tree: ast.expr, known: Mapping[str, Dimension]) -> Dimension:
    """The dimension of an expression; ``known`` has that of every name in it.

    Raises:
        ExpressionError: two parts differ in dimension that must not, or a function does not take its argument.
    """
    match tree:
        case ast.Constant(value=value):
            return None if value == 0 else dimensionless()
        case ast.Name(id=name):
            return dimensionless() if name == "pi" else known[name]
        case ast.UnaryOp(operand=operand):
            return infer_dimension(operand, known)
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub(), right=right):
            return _same([left, right], known, "a sum")
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            first, second = infer_dimension(left, known), infer_dimension(right, known)
            return None if first is None or second is None else _tidy(first * second)
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            first, second = infer_dimension(left, known), infer_dimension(right, known)
            return None if first is None else _tidy(first / (dimensionless() if second is None else second))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            base = infer_dimension(left, known)
            return None if base is None else _tidy(base ** constant(right))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return _call(name, arguments, known)
        case _:
            raise AssertionError(ast.dump(tree))


def _tidy(dimension: Dimension) -> Dimension:
    """``dimension`` without rounding errors of exponents: s^0.1 * s^0.2 / s^0.3 is a plain number."""
    exact = {name: Fraction(float(value)).limit_denominator(1000) for name, value in dimension.items()}
    return type(dimension)({name: float(value) for name, value in exact.items() if value})


def _call(name: str, arguments: list[ast.expr], known: Mapping[str, Dimension]) -> Dimension:
    if name == "where":
        condition = arguments[0]
        assert isinstance(condition, ast.Compare)  # noqa: S101 - the parser refuses anything else
        _same([condition.left, *condition.comparators], known, "a comparison")
        return _same(arguments[1:], known, "the two branches of where")
    if name in ("abs", "min", "max"):
        return _same(arguments, known, name)
    if name == "atan2":
        _same(arguments, known, name)
        return dimensionless()
    dimension = infer_dimension(arguments[0], known)
    if name == "sqrt":
        return None if dimension is None else _tidy(dimension**0.5)
    if name != "sign" and dimension is not None and dimension != dimensionless():
        text = f"{name} takes a plain number, not {describe(dimension)}: {ast.unparse(arguments[0])}"
        raise ExpressionError(text, arguments[0].col_offset + 1)
    return dimensionless()


def _same(parts: list[ast.expr], known: Mapping[str, Dimension], what: str) -> Dimension:
    """The common dimension of ``parts``; ``what`` they are, for the error."""
    first = None
    for part in parts:
        dimension = infer_dimension(part, known)
        if first is None:
            first, owner = dimension, part
        elif dimension is not None and dimension != first:
            dimensions = f"{describe(first)} and {describe(dimension)}"
            text = f"{what} of {dimensions}: {ast.unparse(owner)} and {ast.unparse(part)}"
            raise ExpressionError(text, part.col_offset + 1)
    return first


def describe(dimension: Dimension) -> str:
    """The dimension as a common unit such as "V" or "N*m", else in base units."""
    if dimension is None or dimension == dimensionless():
        return "a plain number"
    for name in NAMED_UNITS:
        if dimension_of(name) == dimension:
            return name
    above = "*".join(_power(name, value) for name, value in sorted(dimension.items()) if value > 0)
    below = "*".join(_power(name, -value) for name, value in sorted(dimension.items()) if value < 0)
    return f"{above or '1'}/({below})" if "*" in below else f"{above or '1'}/{below}" if below else above


def _power(name: str, exponent: float) -> str:
    return BASE_UNITS.get(name, name) + ("" if exponent == 1 else f"^{exponent:g}")
