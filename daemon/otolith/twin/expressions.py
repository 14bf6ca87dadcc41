"""The expressions of the twin language: parsed by Python's grammar and checked against a list of allowed nodes.

No text is evaluated. Allowed are numbers, names, the four operations, powers with a constant exponent, calls of the
functions below and comparisons inside ``where``; anything else is an error with its column. Dimensional analysis with
pint gives the dimension of an expression, or two of its parts that disagree.
"""

import ast
import keyword
import math
import operator
import re
from collections.abc import Callable, Collection, Mapping
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import nearest
from otolith_drivers.units import unit

# Limits keep parser, SymPy and compiler from hostile or generated files; docs/reference/thresholds-twin.md.
MAX_LENGTH = 2000  # characters of an expression
MAX_DEPTH = 40  # levels of nesting
MAX_TERMS = 600  # nodes of the tree
MAX_EXPONENT = 16.0
MAX_NUMBER = 1e30
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")

FUNCTIONS: dict[str, int] = {
    "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "atan2": 2, "sinh": 1, "cosh": 1, "tanh": 1,
    "exp": 1, "log": 1, "sqrt": 1, "abs": 1, "sign": 1, "min": 2, "max": 2, "where": 3,
}  # fmt: skip
"""Every function and its number of arguments."""

FMU = "fmu"
"""Function of a number and all arguments of an FMU: that row of its rates and outputs, a right side by itself."""

RESERVED = frozenset({*FUNCTIONS, FMU, "t", "der", "pi", "Piecewise"})
ARITHMETIC: dict[type[ast.operator], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}  # fmt: skip
COMPARISONS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
NUMERICAL: dict[str, Callable[..., Any]] = {
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2, "min": np.minimum, "max": np.maximum,
}  # fmt: skip
"""Functions that NumPy names differently."""
NUMERICAL_COMPARISONS: dict[type[ast.cmpop], Callable[..., Any]] = {
    ast.Lt: operator.lt, ast.LtE: operator.le, ast.Gt: operator.gt, ast.GtE: operator.ge,
}  # fmt: skip
Column = NDArray[np.float64]
Dimension = Any  # pint's container of dimensions and exponents; None for the number zero, which fits any dimension

NAMED_UNITS = ("V", "A", "ohm", "H", "Wb", "W", "N*m", "J", "N", "Pa", "m", "s", "kg", "m/s", "m/s^2", "rad/s^2", "1/s",
               "kg*m^2", "N*m*s", "m^3/s", "V/s", "A/s", "N/m", "N*s/m", "Pa/s", "K", "K/s", "W/K", "J/K", "W/s", "m^2",
               "m^3")  # fmt: skip
BASE_UNITS = {"[mass]": "kg", "[length]": "m", "[time]": "s", "[current]": "A", "[temperature]": "K",
              "[substance]": "mol", "[luminosity]": "cd"}  # fmt: skip


class ExpressionError(ValueError):
    """The text is not an expression of the language; ``column`` counts from 1."""

    def __init__(self, message: str, column: int) -> None:
        super().__init__(f"column {column}: {message}")
        self.column = column


def check_name(name: str) -> None:
    """Check the name of a quantity; raise ValueError if it is not valid, or reserved."""
    if not NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ValueError(f"{name!r} is not a name: write a letter, then letters, digits and '_', at most 40 characters")
    if name in RESERVED:
        raise ValueError(f"{name!r} is reserved by the twin language: choose another name")


def parse(text: str) -> ast.expr:
    """The syntax tree of ``text``; ``^`` is accepted for ``**``. Raises ExpressionError."""
    if len(text) > MAX_LENGTH:
        raise ExpressionError(f"longer than {MAX_LENGTH} characters: use definitions", MAX_LENGTH)
    columns = _columns(text)
    try:
        tree = ast.parse(text.strip().replace("^", "**"), mode="eval").body
    except (SyntaxError, RecursionError, MemoryError, ValueError) as error:
        offset = (getattr(error, "offset", None) or 1) - 1
        raise ExpressionError(f"not an expression: {getattr(error, 'msg', error)}", columns(offset)) from error
    for node in ast.walk(tree):
        if hasattr(node, "col_offset"):
            node.col_offset = columns(node.col_offset) - 1
    _check(tree)
    _check_constants(tree)
    return tree


def _columns(text: str) -> Callable[[int], int]:
    """A function from an offset in the parsed text (stripped, '**' for '^') to a column of ``text``, which is ASCII."""
    places, depth = [], 0
    for column, letter in enumerate(text, start=1):
        if not letter.isascii() or letter in "\n\r\f\v\0":
            raise ExpressionError(f"{letter!r} is not allowed: an expression is one line of plain ASCII", column)
        depth += {"(": 1, "[": 1, "{": 1, ")": -1, "]": -1, "}": -1}.get(letter, 0)
        if depth > MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels: use definitions", column)
        places += [column, column] if letter == "^" else [column]
    places = places[len(text) - len(text.lstrip()) :] or [1]
    return lambda offset: places[min(offset, len(places) - 1)]


def names_in(tree: ast.expr) -> set[str]:
    """Names of the quantities that the expression depends on."""
    return {node.id for node in _quantities(tree)}


def check_known(tree: ast.expr, known: Collection[str]) -> None:
    """Raise ExpressionError with the nearest known name if the expression has a name that is not ``known``."""
    for node in _quantities(tree):
        if node.id not in known:
            raise ExpressionError(f"unknown symbol {node.id!r}: {nearest(node.id, sorted(known))}", node.col_offset + 1)


def _quantities(tree: ast.expr) -> list[ast.Name]:
    called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return [node for node in ast.walk(tree) if isinstance(node, ast.Name) and node not in called and node.id != "pi"]


def _check(tree: ast.expr) -> None:
    """Raise ExpressionError if the tree is too large or has a node that is not allowed."""
    pending: list[tuple[ast.AST, int]] = [(tree, 0)]
    terms = 0
    while pending:
        node, depth = pending.pop()
        terms += 1
        column = getattr(node, "col_offset", 0) + 1
        if depth > MAX_DEPTH:
            raise ExpressionError(f"nested deeper than {MAX_DEPTH} levels: use definitions", column)
        if terms > MAX_TERMS:
            raise ExpressionError(f"more than {MAX_TERMS} terms: use definitions", column)
        pending += [(child, depth + 1) for child in _children(node, column)]


def _check_constants(tree: ast.expr) -> float | None:
    """The value of an expression without names, else None; raises ExpressionError if it is not real, as 1/0."""
    operands = [_check_constants(operand) for operand in _operands(tree)]
    try:
        return _folded(tree, operands)
    except (ArithmeticError, ValueError) as error:
        raise ExpressionError(f"{ast.unparse(tree)} has no real value", tree.col_offset + 1) from error


def _operands(tree: ast.expr) -> list[ast.expr]:
    children = tree.args if isinstance(tree, ast.Call) else ast.iter_child_nodes(tree)
    return [child for child in children if isinstance(child, ast.expr)]


def _folded(tree: ast.expr, operands: list[float | None]) -> float | None:
    if isinstance(tree, ast.Constant) and isinstance(tree.value, int | float):  # the parser has refused all others
        return float(tree.value)
    if isinstance(tree, ast.Name):
        return math.pi if tree.id == "pi" else None
    if isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Div) and operands[1] == 0.0:
        raise ZeroDivisionError
    values = [operand for operand in operands if operand is not None]
    if len(values) < len(operands):
        return None
    if isinstance(tree, ast.UnaryOp):
        return -values[0] if isinstance(tree.op, ast.USub) else values[0]
    if isinstance(tree, ast.BinOp):
        result = ARITHMETIC[type(tree.op)](*values)
        if isinstance(result, complex) or not math.isfinite(result):
            raise ArithmeticError
        return float(result)
    name = tree.func.id if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) else ""
    return float(getattr(math, name)(*values)) if name in FUNCTIONS and hasattr(math, name) else None


def _children(node: ast.AST, column: int) -> list[ast.expr]:
    """The operands of an allowed node; raises ExpressionError for any other."""
    match node:
        case ast.Constant(value=bool()) | ast.Constant(value=complex()):
            raise ExpressionError(f"{node.value!r} is not a real number", column)
        case ast.Constant(value=int() | float() as value):
            _check_number(value, column)
            return []
        case ast.Name(id=name):
            if name in FUNCTIONS:
                raise ExpressionError(f"{name!r} is a function: write {name}(...)", column)
            return []
        case ast.UnaryOp(op=ast.USub() | ast.UAdd(), operand=operand):
            return [operand]
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            _check_exponent(right, column)
            return [left, right]
        case ast.BinOp(left=left, op=ast.Add() | ast.Sub() | ast.Mult() | ast.Div(), right=right):
            return [left, right]
        case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
            return _arguments(name, arguments, column)
        case _:
            raise ExpressionError(f"{_kind_of(node)} is not allowed", column)


def row_of_fmu(tree: ast.expr) -> int | None:
    """Return the number of the row of an FMU that a right side is; None if it is an expression."""
    match tree:
        case ast.Call(func=ast.Name(id=name), args=[ast.Constant(value=int(row)), *_]) if name == FMU:
            return row
        case _:
            return None


def _arguments(name: str, arguments: list[ast.expr], column: int) -> list[ast.expr]:
    if name == FMU:
        return arguments
    if name not in FUNCTIONS:
        raise ExpressionError(f"{name!r} is not a function of the language: {', '.join(sorted(FUNCTIONS))}", column)
    if len(arguments) != FUNCTIONS[name]:
        raise ExpressionError(f"{name} takes {FUNCTIONS[name]} arguments, not {len(arguments)}", column)
    if name != "where":
        return arguments
    condition = arguments[0]
    if not (
        isinstance(condition, ast.Compare) and len(condition.ops) == 1 and isinstance(condition.ops[0], COMPARISONS)
    ):
        raise ExpressionError("where takes a comparison first: where(a < b, then, else)", column)
    return [condition.left, *condition.comparators, *arguments[1:]]


def _check_number(value: float, column: int) -> None:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number) or abs(number) > MAX_NUMBER:
        raise ExpressionError(f"a number is beyond {MAX_NUMBER:g}", column)


def _check_exponent(node: ast.expr, column: int) -> None:
    if constant(node) is None:
        raise ExpressionError("the exponent must be a number: write exp(b*log(a)) for a variable one", column)
    if abs(constant(node) or 0.0) > MAX_EXPONENT:
        raise ExpressionError(f"the exponent is beyond {MAX_EXPONENT:g}", column)


def constant(node: ast.expr) -> float | None:
    """The value of a number, a signed number or a quotient of two; None for anything else."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value) if abs(value) < MAX_NUMBER else math.inf
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            inner = constant(operand)
            return None if inner is None else -inner
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            above, below = constant(left), constant(right)
            return None if above is None or not below else above / below
        case _:
            return None


def _kind_of(node: ast.AST) -> str:
    kinds = {
        ast.Attribute: "attribute access", ast.Subscript: "indexing", ast.Lambda: "a lambda", ast.IfExp: "if",
        ast.ListComp: "a comprehension", ast.GeneratorExp: "a comprehension", ast.Compare: "a comparison outside where",
        ast.BoolOp: "and/or", ast.JoinedStr: "a string", ast.Constant: "this constant", ast.Starred: "unpacking",
        ast.NamedExpr: "an assignment", ast.Tuple: "a tuple", ast.List: "a list", ast.Dict: "a dictionary",
        ast.Call: "this kind of call",
    }  # fmt: skip
    return kinds.get(type(node), f"this ({type(node).__name__})")


def terms(tree: ast.expr, values: Mapping[str, list[Column]]) -> list[Column]:
    """Return the summands of an expression, each (records,), with products of sums expanded by their first sum.

    ``values`` has the summands of every name.
    """
    match tree:
        case ast.Name(id=name) if name in values:
            return values[name]
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            return [-term for term in terms(operand, values)]
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return [*terms(left, values), *terms(right, values)]
        case ast.BinOp(left=left, op=ast.Sub(), right=right):
            return [*terms(left, values), *(-term for term in terms(right, values))]
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            summands, factor = terms(left, values), terms(right, values)
            if len(summands) < len(factor):
                summands, factor = factor, summands
            return [term * sum(factor) for term in summands]
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            divisor = evaluate(right, values)
            return [term / divisor for term in terms(left, values)]
        case _:
            return [evaluate(tree, values)]


def evaluate(tree: ast.expr, values: Mapping[str, list[Column]]) -> Column:
    """Return the value (records,) of an expression; ``values`` has the summands of every name."""
    match tree:
        case ast.Constant(value=value):
            return np.array([float(str(value))])
        case ast.Name(id=name):
            return np.array([math.pi]) if name == "pi" else np.asarray(sum(values[name]))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return np.asarray(evaluate(left, values) ** float(constant(right) or 0.0))
        case ast.Call(func=ast.Name(id="where"), args=[ast.Compare() as condition, then, otherwise]):
            compare = NUMERICAL_COMPARISONS[type(condition.ops[0])]
            test = compare(evaluate(condition.left, values), evaluate(condition.comparators[0], values))
            return np.where(test, evaluate(then, values), evaluate(otherwise, values))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            function = NUMERICAL.get(name) or getattr(np, name)
            return np.asarray(function(*(evaluate(argument, values) for argument in arguments)))
        case _:
            return np.asarray(sum(terms(tree, values)))


def dimension_of(unit_text: str) -> Dimension:
    """The dimension of a unit; raise ValueError if it is none."""
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
    if name == FMU:  # not within an expression: it is the whole right side of a twin that an FMU computes
        raise ExpressionError(
            f"{name!r} is not a function of the language", arguments[0].col_offset if arguments else 1
        )
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
