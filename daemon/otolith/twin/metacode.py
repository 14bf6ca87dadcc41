"""The table of meta-models in compiled code: one function of scalars that looks a family up, and its derivatives."""

import sympy

from otolith.twin.algebra import PRINTER
from otolith.twin.functions import absolute, sign
from otolith.twin.metamodels import METAMODELS, code_of

ARGUMENTS = sympy.symbols("x a b c", real=True)

CURVES = '''
@njit(cache=True, error_model="numpy")
def curves(family, x, sources, b, c):
    """Shapes of unit amplitude: (curves,), (sources, records), (curves,), (curves,), (curves,) -> (records, curves)."""
    found = np.empty((x.shape[1], len(family)))
    for curve in range(len(family)):
        for record in range(x.shape[1]):
            found[record, curve] = component(family[curve], x[sources[curve], record], 1.0, b[curve], c[curve])
    return found
'''


def metacode() -> list[str]:
    """The functions ``component``, its derivatives by each of its arguments, and ``curves``."""
    known = {symbol.name: symbol for symbol in ARGUMENTS} | {"absolute": absolute, "sign": sign}
    formulas = [(code_of(row.name), sympy.sympify(row.formula, locals=known)) for row in METAMODELS]
    lines = _function("component", formulas)
    for symbol in ARGUMENTS:
        slopes = [(code, sympy.diff(formula, symbol)) for code, formula in formulas]
        lines += _function(f"component_{symbol.name}", slopes)
    return [*lines, *CURVES.strip().splitlines(), "", ""]


def _function(name: str, formulas: list[tuple[float, sympy.Expr]]) -> list[str]:
    branches = []
    for code, formula in formulas:
        if formula != 0:
            branches += [f"    if family == {code!r}:", f"        return {PRINTER.doprint(formula)}"]
    head = ['@njit(error_model="numpy")', f"def {name}(family, {', '.join(symbol.name for symbol in ARGUMENTS)}):"]
    return [*head, *branches, "    return 0.0", "", ""]
