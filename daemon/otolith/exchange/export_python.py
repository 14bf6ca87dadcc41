"""The adapted twin as a Python program that needs NumPy alone."""

import ast
from collections.abc import Iterator, Sequence

from otolith.estimation.information import QUANTILE
from otolith.exchange.exported import TIME, ExportedTwin, ExportedValue
from otolith.twin.expressions import FUNCTIONS
from otolith_drivers.outside_text import visible

NUMPY = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "min": "minimum", "max": "maximum"}
INTEGRATOR = '''
def simulate(t, inputs, initial=None, values=VALUES, substeps=SUBSTEPS):
    """Return the outputs (records, outputs) at the times t (s), by the classical Runge-Kutta method.

    ``inputs`` (records, inputs) are in the units and the order of INPUTS.
    """
    t, inputs = np.asarray(t, dtype=float), np.asarray(inputs, dtype=float)
    state = np.array(list(STATES.values()) if initial is None else initial, dtype=float)
    state = np.append(state, np.zeros(len(STATES) - len(state)))
    is_linear = np.array([hold == "foh" for hold in INPUTS.values()])
    found = []
    for record in range(len(t)):
        time, now = t[record] - t[0], inputs[record]
        found.append(evaluate(time, state, now, values)[1])
        if record + 1 == len(t):
            break
        step = (t[record + 1] - t[record]) / substeps
        slope = np.where(is_linear, (inputs[record + 1] - now) / substeps, 0.0)
        for number in range(substeps):
            begin = time + number * step
            first, middle, last = (now + (number + part) * slope for part in (0.0, 0.5, 1.0))
            a = evaluate(begin, state, first, values)[0]
            b = evaluate(begin + 0.5 * step, state + 0.5 * step * a, middle, values)[0]
            c = evaluate(begin + 0.5 * step, state + 0.5 * step * b, middle, values)[0]
            d = evaluate(begin + step, state + step * c, last, values)[0]
            state = state + step / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return np.array(found)


if __name__ == "__main__":
    print(__doc__)
    for name, value in VALUES.items():
        print(f"{name} = {value:.10g}")
'''


def python_text(twin: ExportedTwin, notes: Sequence[str], substeps: int) -> str:
    """Return the program; ``notes`` say of which machine and of which time it is, a line each.

    ``substeps`` are steps of its integrator from record to record.
    """
    return "\n".join(_lines(twin, notes, substeps)).rstrip() + "\n"


def _lines(twin: ExportedTwin, notes: Sequence[str], substeps: int) -> Iterator[str]:
    yield f'"""{_plain(twin.title)}, as Otolith has adapted it.'
    yield ""
    yield from map(_plain, notes)
    yield f"Source of the equations: {_plain(twin.source)}"
    yield "Intervals are of 95 %."
    yield '"""'
    yield from (
        "",
        "import numpy as np",
        "",
        "_np = np  # a twin may have a quantity np",
        "",
        f"SUBSTEPS = {substeps}  # of the integrator, from record to record",
        "",
    )
    yield "VALUES = {"
    for item in twin.values:
        yield f'    "{item.name}": {item.value!r},  # {comment(item)}'
    yield from ("}", "STATES = {  # at the first record")
    for state in twin.states:
        yield f'    "{state.name}": {state.initial!r},  # {state.unit}, {_plain(state.meaning)}'
    yield from ("}", "INPUTS = {  # zoh: held until the next record; foh: linear")
    for driven in twin.inputs:
        yield f'    "{driven.name}": "{driven.hold}",  # {driven.unit}, {_plain(driven.meaning)}'
    yield from ("}", "OUTPUTS = {")
    for name, unit, meaning in twin.outputs:
        yield f'    "{name}": "{unit}",  # {_plain(meaning)}'
    yield from ("}", "", "", f"def evaluate({TIME}, _state, _inputs, _values):")
    yield f'    """Return derivatives and outputs; {TIME} is in s since the first record."""'
    yield f"    {', '.join(item.name for item in twin.states)}, = _state"
    if twin.inputs:
        yield f"    {', '.join(item.name for item in twin.inputs)}, = _inputs"
    yield from (f'    {item.name} = _values["{item.name}"]' for item in twin.values)
    for name, tree, words in twin.components:
        yield f"    # discovered component, {_plain(words)}"
        yield f"    {name} = {python_expression(tree)}"
    for name, tree, meaning in twin.definitions:
        yield f"    {name} = {python_expression(tree)}  # {_plain(meaning)}"
    yield "    _rates = ["
    yield from (
        f"        {python_expression(tree)},  # d {state.name} / dt"
        for state, tree in zip(twin.states, twin.rates, strict=True)
    )
    yield from ("    ]", "    _outputs = [")
    yield from (
        f"        {python_expression(tree)},  # {name}"
        for (name, _, _), tree in zip(twin.outputs, twin.shown, strict=True)
    )
    yield from ("    ]", "    return _np.array(_rates), _np.array(_outputs)", "")
    yield from INTEGRATOR.splitlines()


def comment(item: ExportedValue) -> str:
    """Return unit, interval, where the value is from, and meaning, in a line."""
    interval = f"± {QUANTILE * item.sd:.3g}, estimated" if item.sd else "given"
    return f"{item.unit}, {interval}: {_plain(item.meaning)}"


def _plain(text: str) -> str:
    """Return a text from outside as part of a line of a comment or of a docstring."""
    return visible(text).replace("\\", "/").replace('"', "'")


class _Numpy(ast.NodeTransformer):
    def visit_Call(self, node: ast.Call) -> ast.Call:
        """Call the function of NumPy."""
        assert isinstance(node.func, ast.Name)  # noqa: S101 - the twin language has no other functions
        assert node.func.id in FUNCTIONS  # noqa: S101 - the same
        name = ast.Attribute(ast.Name("_np"), NUMPY.get(node.func.id, node.func.id))
        return ast.Call(name, [self.visit(argument) for argument in node.args], [])

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Return the number π for its name."""
        return ast.Attribute(ast.Name("_np"), "pi") if node.id == "pi" else node


def python_expression(tree: ast.expr) -> str:
    """Return an expression of the twin language for NumPy."""
    return ast.unparse(ast.fix_missing_locations(_Numpy().visit(ast.parse(ast.unparse(tree), mode="eval").body)))
