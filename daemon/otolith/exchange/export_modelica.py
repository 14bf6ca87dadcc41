"""The adapted twin as a Modelica model, by the Modelica language specification 3.6."""

import ast
import math
import re
from collections.abc import Iterator, Mapping, Sequence

from otolith.exchange.export_python import comment
from otolith.exchange.exported import TIME, ExportedTwin
from otolith.exchange.identifiers import identifiers
from otolith_drivers.outside_text import visible

RESERVED = frozenset({
    "Boolean", "Integer", "Real", "String",  # a variable of such a name would hide the type
    "algorithm", "and", "annotation", "assert", "block", "break", "class", "connect", "connector", "constant",
    "constrainedby", "der", "discrete", "each", "else", "elseif", "elsewhen", "encapsulated", "end", "enumeration",
    "equation", "expandable", "extends", "external", "false", "final", "flow", "for", "function", "if", "import",
    "impure", "in", "initial", "inner", "input", "loop", "model", "not", "operator", "or", "outer", "output", "package",
    "parameter", "partial", "protected", "public", "pure", "record", "redeclare", "replaceable", "return", "stream",
    "then", "time", "true", "type", "when", "while", "within",
})  # fmt: skip
READING = "reading_of_"  # An output is another variable than the state that it shows
OPERATORS = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "^"}
STRENGTH = {ast.Add: 1, ast.Sub: 1, ast.Mult: 2, ast.Div: 2, ast.Pow: 4}
COMPARED = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">="}


def modelica_text(twin: ExportedTwin, notes: Sequence[str], name: str) -> str:
    """Return the model ``name``; ``notes`` say of which machine and of which time it is, a line each."""
    return "\n".join(_lines(twin, notes, identifier(name))) + "\n"


def identifier(name: str) -> str:
    """Return a name that Modelica accepts."""
    text = re.sub(r"\W", "_", name, flags=re.ASCII)
    return f"{text}_" if text in RESERVED else text if re.match(r"[A-Za-z_]", text) else f"m_{text}"


def _lines(twin: ExportedTwin, notes: Sequence[str], name: str) -> Iterator[str]:
    shown = [f"{READING}{own}" for own, _, _ in twin.outputs]
    quantities = [item.name for group in (twin.values, twin.inputs, twin.states) for item in group]
    named = [own for group in (twin.components, twin.definitions) for own, _, _ in group]
    known = identifiers([*quantities, *named], identifier, {name})
    readings = identifiers(shown, identifier, {name, *known.values()})
    yield f'model {name} "{_plain(twin.title)}, as Otolith has adapted it"'
    yield from (f"  // {_plain(line)}" for line in notes)
    yield f"  // Source of the equations: {_plain(twin.source)}"
    yield "  // Intervals are of 95 %. Units are those of the comments; equations hold in SI units."
    for item in twin.values:
        declared = f'  parameter Real {known[item.name]} = {item.value!r} "{_plain(item.meaning)}";'
        yield f"{declared} // {_plain(comment(item))}"
    for driven in twin.inputs:
        held = "held between samples" if driven.hold == "zoh" else "linear between samples"
        yield f'  input Real {known[driven.name]} "{_plain(driven.meaning)}"; // {driven.unit}, {held}'
    for state in twin.states:
        start = f"(start = {state.initial!r}, fixed = true)"
        yield f'  Real {known[state.name]}{start} "{_plain(state.meaning)}"; // {state.unit}'
    for (_, unit, meaning), reading in zip(twin.outputs, shown, strict=True):
        yield f'  output Real {readings[reading]} "{_plain(meaning)}"; // {unit}'
    for own, _, words in twin.components:
        yield f'  Real {known[own]} "discovered component, {_plain(words)}";'
    for own, _, meaning in twin.definitions:
        yield f'  Real {known[own]} "{_plain(meaning)}";'
    yield "equation"
    for own, tree, _ in (*twin.components, *twin.definitions):
        yield f"  {known[own]} = {modelica_expression(tree, known)};"
    for state, tree in zip(twin.states, twin.rates, strict=True):
        yield f"  der({known[state.name]}) = {modelica_expression(tree, known)};"
    for reading, tree in zip(shown, twin.shown, strict=True):
        yield f"  {readings[reading]} = {modelica_expression(tree, known)};"
    yield f"end {name};"


def _plain(text: str) -> str:
    """Return a text from outside as part of a line of a comment or of a string."""
    return visible(text).replace("\\", "/").replace('"', "'")


def modelica_expression(tree: ast.expr, names: Mapping[str, str], strength: int = 0) -> str:
    """Return an expression of the twin language, with ``names`` by those of the author.

    It is in parentheses if its operator is weaker than ``strength``.
    """
    match tree:
        case ast.Constant(value=value):
            return repr(value)
        case ast.Name(id=name):
            return {"pi": repr(math.pi), TIME: "time"}.get(name) or names[name]
        case ast.UnaryOp(op=operator, operand=operand):
            sign = "-" if isinstance(operator, ast.USub) else "+"
            text = f"{sign}{modelica_expression(operand, names, 3)}"
            return f"({text})" if strength else text
        case ast.BinOp(left=left, op=operator, right=right):
            own = STRENGTH[type(operator)]
            is_power = isinstance(operator, ast.Pow)
            ends = modelica_expression(left, names, own + is_power), modelica_expression(right, names, own + 1)
            text = f" {OPERATORS[type(operator)]} ".join(ends)
            return f"({text})" if own < strength else text
        case ast.Call(func=ast.Name(id="where"), args=[ast.Compare() as test, then, otherwise]):
            sides = (modelica_expression(side, names, 1) for side in (test.left, test.comparators[0]))
            condition = f" {COMPARED[type(test.ops[0])]} ".join(sides)
            first, second = (modelica_expression(side, names) for side in (then, otherwise))
            return f"(if {condition} then {first} else {second})"
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return f"{name}({', '.join(modelica_expression(argument, names) for argument in arguments)})"
        case _:
            raise AssertionError(ast.dump(tree))
