"""The equations of an adapted twin in C: the generated header ``model.h``, which ``fmi/instance.h`` includes."""

import ast
from collections.abc import Iterator
from typing import Any

import sympy
from sympy.printing.c import C99CodePrinter

from otolith.exchange.exported import TIME
from otolith.exchange.fmi_variables import FmuVariable, FmuVariables, Kind
from otolith.twin.symbolic import to_sympy
from otolith_drivers.outside_text import visible

PREFIXES = {Kind.STATE: "x", Kind.INPUT: "u", Kind.PARAMETER: "p", Kind.CONSTANT: "p", Kind.COMPUTED: "d"}
"""Before the name of the author, so that none is a word of C or a name of its libraries."""
SMALL_POWER = 4  # Up to it a power is a product, which is exact to the last digit and fast
ENTRIES = 4  # of an array in a line


class CPrinter(C99CodePrinter):  # type: ignore[misc]  # sympy has no types
    """Prints expressions of the twin language; every number is a double."""

    def __init__(self) -> None:
        super().__init__({"precision": 17, "contract": False, "math_macros": {}})

    def _print_Pow(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        base, exponent = expr.as_base_exp()
        if exponent.is_Integer and 2 <= abs(int(exponent)) <= SMALL_POWER:
            product = "*".join([f"({self._print(base)})"] * abs(int(exponent)))
            return f"({product})" if exponent > 0 else f"(1.0/({product}))"
        return str(super()._print_Pow(expr))

    def _print_sign(self, expr: Any) -> str:
        text = self._print(expr.args[0])
        return f"(((({text}) > 0.0) ? 1.0 : 0.0) - ((({text}) < 0.0) ? 1.0 : 0.0))"

    def _print_absolute(self, expr: Any) -> str:
        return f"fabs({self._print(expr.args[0])})"

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return f"{int(expr)}.0"

    def _print_Float(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return repr(float(expr))

    def _print_NumberSymbol(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return repr(float(expr))

    _print_Pi = _print_Exp1 = _print_NumberSymbol  # noqa: N815 - sympy's names; C99 has no constants of mathematics


def model_header(variables: FmuVariables, token: str, longest_step: float, notes: list[str]) -> str:
    """Return the text of ``model.h``; ``longest_step`` (s) of the integrator, ``notes`` of the machine, a line each."""
    return "\n".join(_lines(variables, token, longest_step, notes)) + "\n"


def _lines(variables: FmuVariables, token: str, longest_step: float, notes: list[str]) -> Iterator[str]:
    yield "/* Equations and values, as Otolith has adapted them."
    yield from (f"   {_plain(line)}" for line in notes)
    yield "*/"
    yield from ("", "#ifndef OTOLITH_MODEL_H", "#define OTOLITH_MODEL_H", "", "#include <math.h>", "")
    for kind in Kind:
        if kind is not Kind.TIME:
            name, count = kind.name, variables.count(kind)
            yield f"enum {{ FIRST_{name} = {variables.first[kind]}, {name}S = {count} }};"
    yield f"enum {{ VARIABLES = {len(variables.rows)} }};"
    yield from ("", f'static const char TOKEN[] = "{token}";')
    yield f"static const double MAX_STEP = {longest_step!r}; /* s */"
    nominal = [row.nominal for row in variables.of_kind(Kind.STATE)]
    yield from _array("NOMINAL[STATES + 1]", [*nominal, 1.0], "of the states")
    yield from _array("START[VARIABLES]", [row.start for row in variables.rows], "of all variables, in their units")
    yield from (
        "",
        "/* Compute all others from states, inputs, parameters and the time since the start, s. */",
    )
    yield from ("static inline void compute(double elapsed, double *v)", "{", "    (void)elapsed;")
    yield from _statements(variables)
    yield from ("}", "", "#endif")


def _array(declared: str, values: list[float], meaning: str) -> Iterator[str]:
    yield f"static const double {declared} = {{ /* {meaning} */"
    texts = [repr(float(value)) for value in values]
    for index in range(0, len(texts), ENTRIES):
        yield f"    {', '.join(texts[index : index + ENTRIES])},"
    yield "};"


def _statements(variables: FmuVariables) -> Iterator[str]:
    printer, symbols = CPrinter(), {TIME: sympy.Symbol("elapsed", real=True)}
    for row in variables.rows:
        if row.kind in PREFIXES:
            symbols[row.own] = sympy.Symbol(f"{PREFIXES[row.kind]}_{row.own}", real=True)
    computed = [(at, row) for at, row in enumerate(variables.rows) if row.tree is not None]
    computed.sort(key=lambda item: item[1].kind is not Kind.COMPUTED)  # others may depend on them
    sides = [(at, row, _side(row, symbols)) for at, row in computed]
    used = {symbol.name for _, _, side in sides for symbol in side.free_symbols}
    for at, row in enumerate(variables.rows):
        if row.kind in PREFIXES and row.tree is None and symbols[row.own].name in used:
            yield f"    const double {symbols[row.own].name} = v[{at}]; /* {_plain(row.unit)}, {_plain(row.meaning)} */"
    for at, row, side in sides:
        text, comment = printer.doprint(side), f"/* {_plain(row.name)}: {_plain(row.meaning)} */"
        is_used = row.kind is Kind.COMPUTED and symbols[row.own].name in used
        declared = f"const double {symbols[row.own].name} = " if is_used else ""
        yield f"    {comment}"
        yield f"    {declared}v[{at}] = {' '.join(text.split())};"


def _side(row: FmuVariable, symbols: dict[str, Any]) -> Any:
    assert row.tree is not None  # noqa: S101 - only computed variables are asked for
    return to_sympy(ast.fix_missing_locations(row.tree), symbols)


def _plain(text: str) -> str:
    """Return a text from outside as part of a comment of C: ASCII, without an end of the comment or a trigraph."""
    ascii_text = visible(text).encode("ascii", "backslashreplace").decode("ascii")
    return ascii_text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
