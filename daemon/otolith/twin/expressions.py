"""The expressions of the twin language: parsed by Python's own grammar, against a list of what is allowed.

Nothing is ever evaluated. An expression is a tree of numbers, names, the four operations, powers with a constant
exponent, calls of the functions below and comparisons inside ``where``; anything else is refused with its position.
"""

import ast
import keyword
import math
import operator
import re
from collections.abc import Callable, Collection
from typing import Any

from otolith_drivers.errors import nearest

LONGEST = 2000  # characters
DEEPEST = 40  # levels of nesting
LARGEST_TREE = 600  # nodes
LARGEST_EXPONENT = 16.0
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")

FUNCTIONS: dict[str, int] = {
    "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "atan2": 2, "sinh": 1, "cosh": 1, "tanh": 1,
    "exp": 1, "log": 1, "sqrt": 1, "abs": 1, "sign": 1, "min": 2, "max": 2, "where": 3,
}  # fmt: skip
"""Every function, and how many arguments it takes."""

RESERVED = frozenset({*FUNCTIONS, "t", "der", "pi", "Piecewise"})
ARITHMETIC: dict[type[ast.operator], Callable[..., Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}  # fmt: skip
COMPARISONS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)


class ExpressionError(ValueError):
    """An expression that is not one of the language; ``column`` counts from 1."""

    def __init__(self, message: str, column: int) -> None:
        super().__init__(f"column {column}: {message}")
        self.column = column


def check_name(name: str) -> None:
    """Refuse what cannot be the name of a quantity.

    Raises:
        ValueError: with the rule it breaks.
    """
    if not NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ValueError(f"{name!r} is no name: a letter, then letters, digits and '_', at most 40")
    if name in RESERVED:
        raise ValueError(f"{name!r} is a word of the language and cannot name a quantity")


def parse(text: str) -> ast.expr:
    """The tree of ``text``; ``^`` may be written for ``**``.

    Raises:
        ExpressionError: not an expression of the language.
    """
    if len(text) > LONGEST:
        raise ExpressionError(f"longer than {LONGEST} characters: use definitions", LONGEST)
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
    """From an offset in what is parsed (stripped, '**' for '^') to a column of ``text``; refuses all but ASCII."""
    places, depth = [], 0
    for column, letter in enumerate(text, start=1):
        if not letter.isascii() or letter in "\n\r\f\v\0":
            raise ExpressionError(f"{letter!r} is not allowed: an expression is one line of plain ASCII", column)
        depth += {"(": 1, "[": 1, "{": 1, ")": -1, "]": -1, "}": -1}.get(letter, 0)
        if depth > DEEPEST:
            raise ExpressionError(f"nested deeper than {DEEPEST} levels: use definitions", column)
        places += [column, column] if letter == "^" else [column]
    places = places[len(text) - len(text.lstrip()) :] or [1]
    return lambda offset: places[min(offset, len(places) - 1)]


def names(tree: ast.expr) -> set[str]:
    """The quantities that the expression depends on."""
    called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    return {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node not in called} - {"pi"}


def check_known(tree: ast.expr, known: Collection[str]) -> None:
    """Refuse names that stand for nothing.

    Raises:
        ExpressionError: with the nearest known name.
    """
    called = {node.func for node in ast.walk(tree) if isinstance(node, ast.Call)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node not in called and node.id not in known and node.id != "pi":
            raise ExpressionError(f"unknown symbol {node.id!r}: {nearest(node.id, sorted(known))}", node.col_offset + 1)


def _check(tree: ast.expr) -> None:
    pending: list[tuple[ast.AST, int]] = [(tree, 0)]
    seen = 0
    while pending:
        node, depth = pending.pop()
        seen += 1
        column = getattr(node, "col_offset", 0) + 1
        if depth > DEEPEST:
            raise ExpressionError(f"nested deeper than {DEEPEST} levels: use definitions", column)
        if seen > LARGEST_TREE:
            raise ExpressionError(f"more than {LARGEST_TREE} terms: use definitions", column)
        pending += [(child, depth + 1) for child in _children(node, column)]


def _check_constants(tree: ast.expr) -> float | None:
    """The value of an expression without names, None of one with; refuses what has no real value, like 1/0."""
    try:
        found = _folded(tree, [_check_constants(part) for part in _parts(tree)])
    except ExpressionError:
        raise
    except (ArithmeticError, ValueError) as error:
        raise ExpressionError(f"{ast.unparse(tree)} has no real value", tree.col_offset + 1) from error
    if isinstance(found, complex) or (found is not None and not math.isfinite(found)):
        raise ExpressionError(f"{ast.unparse(tree)} has no real value", tree.col_offset + 1)
    return found


def _parts(tree: ast.expr) -> list[ast.expr]:
    match tree:
        case ast.BinOp(left=left, right=right):
            return [left, right]
        case ast.UnaryOp(operand=operand):
            return [operand]
        case ast.Call(args=arguments):
            return arguments
        case ast.Compare(left=left, comparators=others):
            return [left, *others]
        case _:
            return []


def _folded(tree: ast.expr, parts: list[float | None]) -> float | complex | None:
    if isinstance(tree, ast.Constant):
        return float(tree.value)  # type: ignore[arg-type]  # the check before has left numbers only
    if isinstance(tree, ast.Name):
        return math.pi if tree.id == "pi" else None
    if isinstance(tree, ast.BinOp) and isinstance(tree.op, ast.Div) and parts[1] == 0.0:
        raise ZeroDivisionError
    known = [part for part in parts if part is not None]
    if not parts or len(known) < len(parts):
        return None
    if isinstance(tree, ast.UnaryOp):
        return -known[0] if isinstance(tree.op, ast.USub) else known[0]
    if isinstance(tree, ast.BinOp):
        found: float | complex = ARITHMETIC[type(tree.op)](*known)
        return found
    name = tree.func.id if isinstance(tree, ast.Call) and isinstance(tree.func, ast.Name) else ""
    return float(getattr(math, name)(*known)) if name in FUNCTIONS and hasattr(math, name) else None


def _children(node: ast.AST, column: int) -> list[ast.expr]:
    """What ``node`` is made of, if it is allowed at all."""
    match node:
        case ast.Constant(value=bool()) | ast.Constant(value=complex()):
            raise ExpressionError(f"{node.value!r} is no real number", column)
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
            raise ExpressionError(f"{_what(node)} is not allowed", column)


def _arguments(name: str, arguments: list[ast.expr], column: int) -> list[ast.expr]:
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
    if not math.isfinite(number) or abs(number) > 1e30:
        raise ExpressionError("a number beyond 1e30", column)


def _check_exponent(node: ast.expr, column: int) -> None:
    if constant(node) is None:
        raise ExpressionError("the exponent must be a number: write exp(b*log(a)) for a variable one", column)
    if abs(constant(node) or 0.0) > LARGEST_EXPONENT:
        raise ExpressionError(f"the exponent is beyond {LARGEST_EXPONENT:g}", column)


def constant(node: ast.expr) -> float | None:
    """The value of a number, a signed number or a quotient of two; None for anything else."""
    match node:
        case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
            return float(value) if abs(value) < 1e30 else math.inf
        case ast.UnaryOp(op=ast.USub(), operand=operand):
            inner = constant(operand)
            return None if inner is None else -inner
        case ast.BinOp(left=left, op=ast.Div(), right=right):
            above, below = constant(left), constant(right)
            return None if above is None or not below else above / below
        case _:
            return None


def _what(node: ast.AST) -> str:
    names = {
        ast.Attribute: "attribute access", ast.Subscript: "indexing", ast.Lambda: "a lambda", ast.IfExp: "if",
        ast.ListComp: "a comprehension", ast.GeneratorExp: "a comprehension", ast.Compare: "a comparison outside where",
        ast.BoolOp: "and/or", ast.JoinedStr: "a string", ast.Constant: "this constant", ast.Starred: "unpacking",
        ast.NamedExpr: "an assignment", ast.Tuple: "a tuple", ast.List: "a list", ast.Dict: "a dictionary",
        ast.Call: "this kind of call",
    }  # fmt: skip
    return names.get(type(node), f"this ({type(node).__name__})")
