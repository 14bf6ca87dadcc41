"""Building blocks of generated kernels: printed algebra, sparse Jacobians, lines of source that kernels share.

Names in generated code: ``x_``, ``u_`` and ``p_`` before the author's name of a state, an input and a parameter or
setting; ``h_`` an expression of parameters alone; ``t_`` a shared subexpression; ``y_`` outputs, ``e_`` innovations,
``k1_`` to ``k4_`` the rates at the Runge-Kutta stages. docs/explanation/kernels.md reads one kernel line by line.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from string import Template
from typing import Any

import sympy
from sympy.printing.pycode import PythonCodePrinter

from otolith.fmu.reference import OF_STEPPED, FmuReference
from otolith.twin.components import augmentation_inputs
from otolith.twin.definition import Definition
from otolith.twin.symbolic import COMPONENT_SLOPES, FMU_TABLE, component, external, external_slope, system_of
from otolith_drivers.units import to_base

# Of functions that kernels alone call: code that lets Python and C call them takes a fifth of their compile time.
INNER = "no_cpython_wrapper=True, no_cfunc_wrapper=True"
DECORATOR = f'@njit(error_model="numpy", fastmath={{"contract"}}, {INNER})'
LONGEST_TUPLE = 30  # values that CPython puts into a tuple without a list in between, which numba does not compile

# Step of a central difference by a state, in its unit. Its truncation error grows with the square of the step, its
# rounding error with the inverse: 1e-6 of the value is near the cube root of the floating-point resolution.
DIFFERENCE = "1e-6 * abs({name}) + 1e-9"


class Printer(PythonCodePrinter):  # type: ignore[misc]  # sympy has no types
    """Prints scalar expressions for numba: small powers as products, sign as a conditional expression."""

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

    def _print_Heaviside(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return f"(1.0 if {self._print(expr.args[0])} > 0.0 else 0.0)"

    def _print_Float(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return repr(float(expr))

    def _print_Integer(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return f"{int(expr)}.0"

    def _print_Rational(self, expr: Any) -> str:  # noqa: N802 - sympy's name
        return f"({int(expr.p)}.0/{int(expr.q)}.0)"


PRINTER = Printer({"fully_qualified_modules": True})


class Hoist:
    """Replaces subexpressions of parameters alone by symbols, which a kernel computes once per trajectory."""

    def __init__(self, parameters: Iterable[sympy.Symbol]) -> None:
        self._parameters = set(parameters)
        self._symbols: dict[sympy.Expr, sympy.Symbol] = {}

    @property
    def assignments(self) -> list[str]:
        """One line for each symbol."""
        return [f"{symbol.name} = {PRINTER.doprint(expression)}" for expression, symbol in self._symbols.items()]

    @property
    def names(self) -> list[str]:
        """Names of the symbols."""
        return [symbol.name for symbol in self._symbols.values()]

    def __call__(self, expression: sympy.Expr) -> sympy.Expr:
        """``expression`` with its constant parts replaced."""
        if expression.is_Atom:
            return expression
        if self._is_constant(expression):
            return self._symbol(expression)
        if isinstance(expression, sympy.Piecewise):
            return sympy.Piecewise(*((self(value), self._condition(condition)) for value, condition in expression.args))
        if not (expression.is_Add or expression.is_Mul):
            return expression.func(*(self(part) for part in expression.args))
        constant = [part for part in expression.args if self._is_constant(part)]
        rest = [self(part) for part in expression.args if part not in constant]
        if constant and not (len(constant) == 1 and constant[0].is_Symbol):
            constant = [self._symbol(expression.func(*constant))]
        return expression.func(*constant, *rest)

    def _condition(self, condition: Any) -> Any:
        """Hoist within both sides of a comparison; the comparison itself is no number and stays."""
        if condition.is_Atom:
            return condition
        inside = self._condition if not condition.is_Relational else self
        return condition.func(*(inside(part) for part in condition.args))

    def _is_constant(self, expression: sympy.Expr) -> bool:
        return bool(expression.free_symbols) and expression.free_symbols <= self._parameters

    def _symbol(self, expression: sympy.Expr) -> sympy.Symbol:
        return self._symbols.setdefault(expression, sympy.Symbol(f"h_{len(self._symbols)}", real=True))


class SparseJacobian:
    """The elements of a Jacobian that are not zero everywhere, by row and column."""

    def __init__(self, rows: Sequence[sympy.Expr], by: Sequence[sympy.Symbol]) -> None:
        derivatives = {(r, c): sympy.diff(row, symbol) for r, row in enumerate(rows) for c, symbol in enumerate(by)}
        self.elements = {position: value for position, value in derivatives.items() if value != 0}

    def names(self, prefix: str) -> list[str]:
        """A variable for each element: ``prefix_row_column``."""
        return [f"{prefix}_{row}_{column}" for row, column in self.elements]

    def named(self, prefix: str) -> list[tuple[int, int, str]]:
        """Row, column and variable of each element."""
        return [(row, column, f"{prefix}_{row}_{column}") for row, column in self.elements]


@dataclass(frozen=True)
class Stage:
    """One stage of the classical Runge-Kutta method (Hairer, Norsett, Wanner, Solving ODE I, Table II.1.2)."""

    number: int
    time: float  # Share of the step at which the stage evaluates the rates
    length: str  # Variable of the kernel by which the stage advances the state along the rates of the stage before
    input_prefix: str  # Before the name of a foh input: its value at the time of the stage

    def advanced(self, names: Sequence[str], rates: str) -> list[str]:
        """``names`` plus this stage's length times the ``rates`` (``k`` or ``q``) of the stage before."""
        if self.number == 1:
            return list(names)
        return [f"{name} + {self.length} * {rates}{self.number - 1}_{row}" for row, name in enumerate(names)]


STAGES = (Stage(1, 0.0, "", ""), Stage(2, 0.5, "half", "mid_"), Stage(3, 0.5, "half", "mid_"),
          Stage(4, 1.0, "step", "end_"))  # fmt: skip
STEPPED = (Stage(1, 0.5, "", "mid_"),)
"""Of an FMU that is stepped: its rates are the mean ones over the step, with inputs as they are in its middle."""

FROM_CALLS = ("ARGUMENTS_AT", "OF_INPUTS", "OF_PARAMETERS", "OF_STATES", "ROWS_AT", "SLOPES_AT", "differentiate",
              "entry", "evaluate", "evaluate_outputs", "load_real", "set_length", "store_real")  # fmt: skip

Blocks = dict[str, str | list[str]]  # What fills a template: text within a line, or lines of its own


class KernelCode:
    """Names, functions of scalars and source blocks that the kernels of one twin share."""

    def __init__(self, definition: Definition) -> None:
        system = system_of(definition)
        hoist = Hoist((*system.parameters, *system.settings))
        self.x = [symbol.name for symbol in system.states]
        self.u = [symbol.name for symbol in system.inputs]
        self.p = [symbol.name for symbol in system.parameters]
        self.settings = [symbol.name for symbol in system.settings]
        self.fmu = definition.fmu
        self.is_stepped = self.fmu is not None and self.fmu.is_stepped
        self.stages_of_step = STEPPED if self.is_stepped else STAGES
        self._differences = _differences(definition, self.x)
        self._from_fmu = [] if self.fmu is None else [FMU_TABLE.name]
        self.y = numbered("y", len(system.outputs))
        self.ramps = [name for name, driven in zip(self.u, definition.inputs, strict=True) if driven.hold == "foh"]
        # dx/dt = f(x, u, p) and y = g(x, u, p): a = df/dx, b = df/dp, c = dg/dx, d = dg/dp.
        self.a, self.b = (SparseJacobian(system.rates, by) for by in (system.states, system.parameters))
        self.c, self.d = (SparseJacobian(system.outputs, by) for by in (system.states, system.parameters))
        # By the inputs of the sites of an augmented twin: f = df/ds, g = dg/ds.
        added = augmentation_inputs(definition.base) if definition.base is not None else ()
        entering = [symbol for symbol, u in zip(system.inputs, definition.inputs, strict=True) if u.name in added]
        self.f, self.g = (SparseJacobian(rows, entering) for rows in (system.rates, system.outputs))
        self.sites = len(entering)
        self.rates = [hoist(expression) for expression in system.rates]
        outputs = [hoist(expression) for expression in system.outputs]
        of_rates = [hoist(value) for jacobian in (self.a, self.b) for value in jacobian.elements.values()]
        of_outputs = [hoist(value) for jacobian in (self.c, self.d) for value in jacobian.elements.values()]
        self._functions = {
            "rates_": self.rates,
            "outputs_": outputs,
            "linearise_": [*self.rates, *of_rates],
            "linearise_outputs_": [*outputs, *of_outputs],
        }
        if self.sites:
            of_sites = [[hoist(value) for value in part.elements.values()] for part in (self.a, self.f, self.c, self.g)]
            self._functions["linearise_sites_"] = [*self.rates, *of_sites[0], *of_sites[1]]
            self._functions["linearise_site_outputs_"] = [*outputs, *of_sites[2], *of_sites[3]]
        self._hoisted = hoist.assignments
        self._constants = [*self.p, *self.settings, *self._from_fmu, *hoist.names]
        self.blocks = self._shared_blocks()

    def functions(self) -> list[str]:
        """The right sides, alone and with their Jacobians, as functions of scalars that the compiler inlines."""
        return [line for name, expressions in self._functions.items() for line in self._function(name, expressions)]

    def kernel(self, template: str, blocks: Blocks) -> list[str]:
        """The lines of a kernel, without the constants that it does not use: each costs compile time."""
        lines = fill(template, self.blocks | blocks)
        uses = Counter(re.findall(r"\w+", "\n".join(lines)))
        unused = set()
        for line in reversed(self._read_constants("")):  # a constant may use those before it
            name, *used = re.findall(r"\w+", line)
            if uses[name] == 1:
                unused.add(name)
                uses.subtract(used)
        return [line for line in lines if line.split(" = ", 1)[0].strip() not in unused]

    def _function(self, name: str, expressions: list[sympy.Expr]) -> list[str]:
        """A function of states, inputs and constants; common subexpressions are computed once."""
        # An FMU computes outputs on which components depend, and those enter its arguments.
        before, expressions = ([], expressions) if self.fmu is None else _with_rows_of_fmu(expressions, self.fmu, "r")
        lines, expressions = _with_slopes_of_components(expressions)
        after, expressions = ([], expressions) if self.fmu is None else _with_rows_of_fmu(expressions, self.fmu, "q")
        lines = [*before, *lines, *after]
        shared, results = sympy.cse(expressions, symbols=sympy.numbered_symbols("t_", real=True), order="none")
        lines += [f"{symbol.name} = {PRINTER.doprint(value)}" for symbol, value in shared]
        texts = [PRINTER.doprint(result) for result in results]
        parts = [texts[at : at + LONGEST_TUPLE] for at in range(0, len(texts), LONGEST_TUPLE)]
        returned = " + ".join(f"({', '.join(part)},)" for part in parts)
        head = f"def {name}({self.arguments(name, self.x, self.u)}):"
        return [DECORATOR, head, *indent([*lines, f"return {returned}"]), "", ""]

    def arguments(self, function: str, states: Sequence[str], inputs: Sequence[str]) -> str:
        """Arguments of such a function: states, inputs and the constants that it uses."""
        return ", ".join([*states, *inputs, *self.constants_of(function)])

    def constants_of(self, function: str) -> list[str]:
        """The constants that such a function uses."""
        occurring = set().union(*(expression.free_symbols for expression in self._functions[function]))
        names = {symbol.name for symbol in occurring}
        return [name for name in self._constants if name in names]

    def _shared_blocks(self) -> Blocks:
        return {
            "decorator": DECORATOR,
            **{f"of_{name}": self.arguments(name, self.x, self.u) for name in self._functions},
            "n_states": str(len(self.x)),
            "n_outputs": str(len(self.y)),
            "y": unpacked(self.y),
            "linearised_y": unpacked([*self.y, *self.c.names("c"), *self.d.names("d")]),
            "read_parameters": self.read_parameters(""),
            "read_inputs": [f"{name} = inputs[record, {index}]" for index, name in enumerate(self.u)],
            "innovations": self._innovations(),
            "correct_state": [
                f"{x} += {total([f'gain[record, {row}, {index}] * e_{index}' for index in range(len(self.y))])}"
                for row, x in enumerate(self.x)
            ],
            "input_increments": self.input_increments("inputs[record + 1, {index}]"),
            "inputs_at_stages": [
                f"mid_{u}, end_{u} = {u} + 0.5 * increment_{u}, {u} + increment_{u}" for u in self.ramps
            ],
            "stage_rates": self.stages("rates_", []),
            "set_length": ["set_length(int(fmu), step)"] if self.is_stepped else [],
            "n_stages": str(len(self.stages_of_step)),
            "moments": unpacked([f"start + {stage.time} * step" for stage in self.stages_of_step]),
            "advance_state": [f"{x} += {self._over_step('k', row)}" for row, x in enumerate(self.x)],
            "advance_inputs": [f"{u} = end_{u}" for u in self.ramps],
            "read_next_inputs": [f"w_{index} = inputs[record + 1, {index}]" for index in range(len(self.u))],
            "next_state": [self.advanced(numbered("n", len(self.x)), {})],
            "move_to_next": [f"{x} = n_{row}" for row, x in enumerate(self.x)],
        }  # fmt: skip

    def _over_step(self, rates: str, row: int) -> str:
        """The change of a state in a step, or of its derivative, by the rates at the stages."""
        if self.is_stepped:
            return f"step * {rates}1_{row}"
        return f"sixth * ({rates}1_{row} + 2.0 * {rates}2_{row} + 2.0 * {rates}3_{row} + {rates}4_{row})"

    def _innovations(self) -> list[str]:
        """``e`` is measured minus predicted and ``m`` is 1; both are 0 for a missing measurement, which is NaN."""
        lines = []
        for index, y in enumerate(self.y):
            e, m = f"e_{index}", f"m_{index}"
            lines += [f"{e} = measured[record, {index}] - {y}", f"{m} = 1.0", f"if {e} != {e}:", f"    {e} = {m} = 0.0"]
        return lines

    def read_parameters(self, row: str) -> list[str]:
        """Parameters, hoisted expressions and the initial state; ``row`` selects the particle of a swarm."""
        return [*self._read_constants(row), *(f"{x} = initial[{row}{index}]" for index, x in enumerate(self.x))]

    def _read_constants(self, row: str) -> list[str]:
        names = [*self.p, *self.settings, *self._from_fmu]
        parameters = (f"{name} = parameters[{row}{index}]" for index, name in enumerate(names))
        return [*parameters, *self._hoisted]

    def input_increments(self, following: str) -> list[str]:
        """Change of each ``foh`` input per substep; ``following`` is its value at the next record."""
        return [
            f"increment_{name} = ({following.format(index=index)} - {name}) / substeps"
            for index, name in enumerate(self.u)
            if name in self.ramps
        ]

    def stages(self, function: str, jacobians: Sequence[tuple[str, SparseJacobian]]) -> list[str]:
        """The four stages of a substep: a call of ``function`` each, for ``k`` and the elements of ``jacobians``."""
        lines = []
        for stage in self.stages_of_step:
            results = numbered(f"k{stage.number}", len(self.x))
            results += [name for prefix, jacobian in jacobians for name in jacobian.names(f"{prefix}{stage.number}")]
            inputs = [stage.input_prefix + name if name in self.ramps else name for name in self.u]
            lines.append(
                f"{unpacked(results)} = {function}({self.arguments(function, stage.advanced(self.x, 'k'), inputs)})"
            )
        return lines

    def slopes_of_state(self, forced: SparseJacobian) -> Blocks:
        """A substep of S = dx by all columns, the Runge-Kutta step differentiated.

        q_j = A_j (s + length_j q_(j-1)) + F_j for each column s; F is zero in the rows that ``forced`` lacks.
        """
        states, forced_rows = range(len(self.x)), {row for row, _, _ in forced.named("f")}
        stage_dx = []
        for stage in self.stages_of_step:
            s = stage.advanced(numbered("s", len(self.x)), "q")
            for row in states:
                terms = [
                    f"{a} * {s[column] if stage.number == 1 else f'({s[column]})'}"
                    for r, column, a in self.a.named(f"a{stage.number}")
                    if r == row
                ]
                terms += [f"forcing[{stage.number - 1}, {row}, column]"] if row in forced_rows else []
                stage_dx.append(f"q{stage.number}_{row} = {total(terms)}")
        return {
            "read_dx": [f"s_{row} = dx[{row}, column]" for row in states],
            "stage_dx": stage_dx,
            "advance_dx": [f"dx[{r}, column] = s_{r} + {self._over_step('q', r)}" for r in states],
        }

    def advanced(self, names: list[str], changed: Mapping[str, str]) -> str:
        """An assignment of the states at the next record to ``names``, with some arguments of ``advance_`` replaced."""
        given = [changed.get(name, name) for name in (*self.x, *self.u, *numbered("w", len(self.u)))]
        return f"{unpacked(names)} = advance_({', '.join(['step', 'substeps', *given, *self.constants_of('rates_')])})"

    def transition(self, element: str) -> list[str]:
        """The next state by this one, by central differences, into ``element`` of row and column."""
        states = range(len(self.x))
        lines = []
        for column, x in enumerate(self.x):
            lines += [
                f"delta = {self._differences[column]}",
                self.advanced(numbered("up", len(self.x)), {x: f"{x} + delta"}),
                self.advanced(numbered("down", len(self.x)), {x: f"{x} - delta"}),
                *(f"{element.format(row, column)} = (up_{row} - down_{row}) / (2.0 * delta)" for row in states),
            ]
        return lines


def _differences(definition: Definition, states: Sequence[str]) -> list[str]:
    """Steps of the central differences by each state, in its unit."""
    if definition.fmu is None or not definition.fmu.is_stepped:
        return [DIFFERENCE.format(name=name) for name in states]
    found = [DIFFERENCE.format(name=name) for name in states]
    for index, item in enumerate(definition.fmu.states):  # angles of components follow
        size = item.scale * item.size / to_base(definition.states[index].unit)[0]
        found[index] = f"{OF_STEPPED!r} * max(abs({states[index]}), {size!r})"
    return found


def _with_slopes_of_components(expressions: list[sympy.Expr]) -> tuple[list[str], list[sympy.Expr]]:
    """Lines that evaluate each component whose derivative occurs, with all its derivatives; what is left."""
    occurring = set().union(*(expression.atoms(component) for expression in expressions))
    arguments = sorted({part.args for part in occurring if isinstance(part, COMPONENT_SLOPES)}, key=str)
    lines: list[str] = []
    values: dict[sympy.Expr, sympy.Symbol] = {}
    for index, given in enumerate(arguments):
        names = [f"v_{index}", *(f"v_{index}_{by}" for by in "xabc")]
        lines.append(f"{unpacked(names)} = component_slopes({', '.join(map(PRINTER.doprint, given))})")
        kinds = (component, *COMPONENT_SLOPES)
        values |= {kind(*given): sympy.Symbol(name, real=True) for kind, name in zip(kinds, names, strict=True)}
    return lines, [expression.xreplace(values) for expression in expressions]


def _with_rows_of_fmu(
    expressions: list[sympy.Expr], fmu: FmuReference, prefix: str
) -> tuple[list[str], list[sympy.Expr]]:
    """Lines that evaluate an FMU once for each set of arguments that depends on no other set; what is left.

    Each row and slope that occurs is read from its buffer after that, into a variable that begins with ``prefix``.
    """
    occurring = set().union(*(expression.atoms(external, external_slope) for expression in expressions))
    occurring = {part for part in occurring if not any(each.has(external, external_slope) for each in part.args)}
    given, width = sorted({_of_fmu(part) for part in occurring}, key=str), len(fmu.arguments)
    lines: list[str] = []
    values: dict[sympy.Expr, sympy.Symbol] = {}
    for index, arguments in enumerate(given):
        own = sorted((part for part in occurring if _of_fmu(part) == arguments), key=str)
        rows, slopes = f"{prefix}_{index}", f"{prefix}s_{index}"
        given_to = ", ".join(map(PRINTER.doprint, arguments))
        if columns := {int(part.args[1]) for part in own if isinstance(part, external_slope)}:
            lines.append(f"{rows}, {slopes} = fmu_slopes_({_groups(fmu, columns)}, {given_to})")
        else:
            needs_rates = any(int(part.args[0]) < len(fmu.rates) for part in own)
            lines.append(f"{rows} = fmu_{'rows' if needs_rates else 'outputs'}_({given_to})")
        for part in own:
            row = int(part.args[0])
            if isinstance(part, external_slope):
                column = int(part.args[1])
                name, place = f"{slopes}_{row}_{column}", f"{slopes} + {8 * (row * width + column)}"
                lines.append(f"{name} = load_real({place}) * fmu_scale_{row} * fmu_share_{column}")
            else:
                name = f"{rows}_{row}"
                lines.append(f"{name} = load_real({rows} + {8 * row}) * fmu_scale_{row}")
            values[part] = sympy.Symbol(name, real=True)
    return lines, [expression.xreplace(values) for expression in expressions]


def _groups(fmu: FmuReference, columns: set[int]) -> str:
    """Return the groups of arguments by which derivatives are needed, in the words of ``otolith.fmu.calls``."""
    states, known = len(fmu.states), len(fmu.states) + len(fmu.inputs)
    ranges = {"OF_STATES": range(states), "OF_INPUTS": range(states, known)}
    ranges["OF_PARAMETERS"] = range(known, len(fmu.arguments))
    return " + ".join(name for name, group in ranges.items() if columns & {*group})


def _of_fmu(part: sympy.Expr) -> tuple[sympy.Expr, ...]:
    """Return table and arguments of a row or slope."""
    first = 2 if isinstance(part, external_slope) else 1
    return tuple(part.args[first:])


def functions_of_fmu(fmu: FmuReference) -> list[str]:
    """Functions that set the arguments in the FMU's units and return where the results are.

    ``fmu_rows_`` computes rates and outputs, ``fmu_slopes_`` also their slopes, and ``fmu_outputs_`` outputs, without
    the step that the rates of some FMUs need.
    """
    lines = [f"from otolith.fmu.calls import {', '.join(FROM_CALLS)}", ""]
    lines += [f"fmu_scale_{row} = {item.scale!r}" for row, item in enumerate(fmu.rows)]
    lines += [f"fmu_share_{column} = {1.0 / item.scale!r}" for column, item in enumerate(fmu.arguments)]
    given = numbered("a", len(fmu.arguments))
    for function, evaluation, results in (
        ("fmu_rows_(", "evaluate(table)", "entry(table, ROWS_AT)"),
        ("fmu_outputs_(", "evaluate_outputs(table)", "entry(table, ROWS_AT)"),
        ("fmu_slopes_(groups, ", "differentiate(table, groups)", "entry(table, ROWS_AT), entry(table, SLOPES_AT)"),
    ):
        body = ["table = int(fmu)", "arguments = entry(table, ARGUMENTS_AT)"]
        body += [f"store_real(arguments + {8 * at}, {name} * fmu_share_{at})" for at, name in enumerate(given)]
        body += [evaluation, f"return {results}"]
        head = f"def {function}fmu, {', '.join(given)}):"
        lines += ["", "", f'@njit(error_model="numpy", {INNER})', head, *indent(body)]
    return [*lines, "", ""]


def fill(template: str, blocks: Blocks) -> list[str]:
    """The lines of ``template``: a line ``$name`` becomes the lines of that block, ``$name`` within a line its text."""
    lines: list[str] = []
    for line in template.strip().splitlines():
        code = line.lstrip()
        block = blocks.get(code.removeprefix("$")) if code.startswith("$") else None
        if isinstance(block, list):
            lines += [line[: -len(code)] + inner for inner in block]
        else:
            lines.append(Template(line).substitute(blocks))
    return lines


def indent(lines: Iterable[str]) -> list[str]:
    """One level deeper."""
    return [f"    {line}" for line in lines]


def numbered(prefix: str, count: int) -> list[str]:
    """``prefix_0``, ``prefix_1``, ..."""
    return [f"{prefix}_{index}" for index in range(count)]


def unpacked(names: Sequence[str]) -> str:
    """A tuple to assign to, with its comma if it has one element."""
    return f"({', '.join(names)},)"


def total(terms: Sequence[str]) -> str:
    """The sum of ``terms``; ``0.0`` if there are none."""
    return " + ".join(terms) if terms else "0.0"
