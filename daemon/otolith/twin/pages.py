"""A twin as people read it: its equations as on paper, in Unicode or LaTeX."""

import sympy

from otolith.twin.definition import Definition
from otolith.twin.expressions import parse
from otolith.twin.system import to_sympy

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
