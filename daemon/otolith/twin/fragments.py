"""Fragments of generated kernels: lines of source that more than one kernel is made of."""

from collections.abc import Iterable, Sequence

import sympy

from otolith.twin.algebra import PRINTER, Entries, Hoist
from otolith.twin.definition import Definition
from otolith.twin.system import System, system_of

HELPER = '@njit(error_model="numpy", fastmath={"contract"})'


class Fragments:
    """What the kernels of one twin are put together of: names, reads, corrections, the integrator's step."""

    def __init__(self, definition: Definition) -> None:
        system = _renamed(system_of(definition))
        hoist = Hoist((*system.parameters, *system.settings))
        self.x = [symbol.name for symbol in system.states]
        self.u = [symbol.name for symbol in system.inputs]
        self.p = [symbol.name for symbol in system.parameters]
        self.settings = [symbol.name for symbol in system.settings]
        self.linear = [entry.hold == "foh" for entry in definition.inputs]
        self.outputs = len(system.outputs)
        self.a, self.b = Entries.of(system.rates, system.states), Entries.of(system.rates, system.parameters)
        self.c, self.d = Entries.of(system.outputs, system.states), Entries.of(system.outputs, system.parameters)
        self.rates = [hoist(expression) for expression in system.rates]
        self.expressions = [hoist(expression) for expression in system.outputs]
        self.rate_entries = [hoist(expression) for expression in (*self.a.values, *self.b.values)]
        self.output_entries = [hoist(expression) for expression in (*self.c.values, *self.d.values)]
        self.hoisted = hoist.lines
        self.fixed = [*self.p, *self.settings, *hoist.names]

    def function(self, name: str, expressions: list[sympy.Expr]) -> list[str]:
        """A function of scalars, subexpressions shared."""
        shared, results = sympy.cse(expressions, symbols=sympy.numbered_symbols("t_", real=True), order="none")
        lines = [f"{symbol.name} = {PRINTER.doprint(value)}" for symbol, value in shared]
        returned = ", ".join(PRINTER.doprint(result) for result in results)
        head = f"def {name}({', '.join([*self.x, *self.u, *self.fixed])}):"
        return [HELPER, head, *indent([*lines, f"return ({returned},)"]), "", ""]

    def arguments(self, states: Sequence[str], inputs: Sequence[str]) -> str:
        """What such a function is called with."""
        return ", ".join([*states, *inputs, *self.fixed])

    def y(self) -> list[str]:
        """The outputs of a record."""
        return [f"y_{index}" for index in range(self.outputs)]

    def k(self, stage: int) -> list[str]:
        """The rates at a stage."""
        return [f"k{stage}_{row}" for row in range(len(self.x))]

    def jacobians(self, stage: int) -> list[str]:
        """The entries of both Jacobians of the rates at a stage."""
        return [*self.a.names(f"a{stage}"), *self.b.names(f"b{stage}")]

    def preamble(self) -> list[str]:
        """Once per call."""
        return [
            "step = sample_period / substeps",
            "half, sixth = step / 2.0, step / 6.0",
            "correct = np.any(gain != 0.0)",
        ]

    def read(self, parameter: str, state: str) -> list[str]:
        """Once per trajectory."""
        return [
            *(f"{name} = {parameter.format(index)}" for index, name in enumerate([*self.p, *self.settings])),
            *self.hoisted,
            *(f"{name} = {state.format(index)}" for index, name in enumerate(self.x)),
        ]

    def read_inputs(self) -> list[str]:
        """Once per record."""
        return [f"{name} = inputs[record, {index}]" for index, name in enumerate(self.u)]

    def innovations(self) -> list[str]:
        """What was measured minus predicted; a record without a measurement corrects nothing."""
        lines = []
        for index in range(self.outputs):
            lines += [
                f"e_{index} = measured[record, {index}] - y_{index}",
                f"m_{index} = 1.0",
                f"if e_{index} != e_{index}:",
                f"    e_{index} = m_{index} = 0.0",
            ]
        return lines

    def correction(self, row: int) -> str:
        """Of a state, by the gain."""
        return added([f"gain[record, {row}, {index}] * e_{index}" for index in range(self.outputs)])

    def slope_correction(self, row: int) -> str:
        """Of a state's sensitivity, by the gain."""
        terms = [f"gain[record, {row}, {i}] * m_{i} * slopes[record, {i}, column]" for i in range(self.outputs)]
        return f"({added(terms)})"

    def slopes(self, following: str = "inputs[record + 1, {index}]") -> list[str]:
        """How a ``foh`` input runs from substep to substep."""
        return [
            f"g_{name} = ({following.format(index=index)} - {name}) / substeps"
            for index, (name, linear) in enumerate(zip(self.u, self.linear, strict=True))
            if linear
        ]

    def step(self, stages: list[str], then: list[str]) -> list[str]:
        """From a record to the next, if there is one; see :meth:`substeps`."""
        return ["if record + 1 == records:", "    break", *self.slopes(), *self.substeps(stages, then)]

    def substeps(self, stages: list[str], then: list[str]) -> list[str]:
        """The substeps of a record by the classical Runge-Kutta method; ``stages`` wait for their arguments."""
        running = [name for name, linear in zip(self.u, self.linear, strict=True) if linear]
        at = {"": "", "half": "m", "step": "z"}

        def inputs(where: str) -> list[str]:
            return [f"{at[where]}{name}" if name in running and at[where] else name for name in self.u]

        def states(stage: int, length: str) -> list[str]:
            return [f"{x} + {length} * k{stage}_{row}" for row, x in enumerate(self.x)]

        arguments = [
            self.arguments(self.x, inputs("")),
            self.arguments(states(1, "half"), inputs("half")),
            self.arguments(states(2, "half"), inputs("half")),
            self.arguments(states(3, "step"), inputs("step")),
        ]
        substep = [
            *(f"m{name}, z{name} = {name} + 0.5 * g_{name}, {name} + g_{name}" for name in running),
            *(stage.format(given) for stage, given in zip(stages, arguments, strict=True)),
            *(f"{x} += sixth * (k1_{r} + 2.0 * k2_{r} + 2.0 * k3_{r} + k4_{r})" for r, x in enumerate(self.x)),
            *then,
            *(f"{name} = z{name}" for name in running),
        ]
        return ["for substep in range(substeps):", *indent(substep)]

    def advance(self) -> list[str]:
        """A function of scalars: the states at the next record, where the inputs are ``w``."""
        following = [f"w_{index}" for index in range(len(self.u))]
        head = ", ".join(["step", "substeps", *self.x, *self.u, *following, *self.fixed])
        body = [
            "half, sixth = step / 2.0, step / 6.0",
            *self.slopes("w_{index}"),
            *self.substeps([f"{unpacked(self.k(stage))} = rates_({{}})" for stage in range(1, 5)], []),
            f"return {unpacked(self.x)}",
        ]
        return [HELPER, f"def advance_({head}):", *indent(body), "", ""]

    def propagate(self, columns: int) -> list[str]:
        """The derivative of the step: each column of the state's sensitivities through the four stages."""
        lines = [
            f"drive[{stage - 1}, {row}, {column}] = {name}"
            for stage in range(1, 5)
            for (row, column), name in zip(self.b.places, self.b.names(f"b{stage}"), strict=True)
        ]
        base = len(self.p) + len(self.x)
        if columns > base:
            lines.append("begins = when + substep * step")
            lines += [
                f"drive[{stage - 1}, {row}, {base + column}] = (begins + {share} * step) * {name}"
                for stage, share in ((1, 0.0), (2, 0.5), (3, 0.5), (4, 1.0))
                for (row, column), name in zip(self.b.places, self.b.names(f"b{stage}"), strict=True)
            ]
        rows, driven = range(len(self.x)), {row for row, _ in self.b.places}
        inner = [f"s_{row} = state[{row}, column]" for row in rows]
        for stage, length in ((1, ""), (2, "half"), (3, "half"), (4, "step")):
            for row in rows:
                terms = [
                    f"{name} * {f'(s_{c} + {length} * q{stage - 1}_{c})' if length else f's_{c}'}"
                    for (r, c), name in zip(self.a.places, self.a.names(f"a{stage}"), strict=True)
                    if r == row
                ]
                terms += [f"drive[{stage - 1}, {row}, column]"] if row in driven else []
                inner.append(f"q{stage}_{row} = {added(terms)}")
        inner += [f"state[{r}, column] = s_{r} + sixth * (q1_{r} + 2.0 * q2_{r} + 2.0 * q3_{r} + q4_{r})" for r in rows]
        return [*lines, f"for column in range({columns}):", *indent(inner)]


def _renamed(system: System) -> System:
    """Prefixed symbols, so that no name of a page meets one of the kernel's own."""
    new = {
        symbol: sympy.Symbol(f"{prefix}_{symbol.name}", real=True)
        for prefix, symbols in (
            ("x", system.states),
            ("u", system.inputs),
            ("p", (*system.parameters, *system.settings)),
        )
        for symbol in symbols
    }
    return System(
        states=tuple(new[symbol] for symbol in system.states),
        inputs=tuple(new[symbol] for symbol in system.inputs),
        parameters=tuple(new[symbol] for symbol in system.parameters),
        settings=tuple(new[symbol] for symbol in system.settings),
        rates=tuple(expression.xreplace(new) for expression in system.rates),
        outputs=tuple(expression.xreplace(new) for expression in system.outputs),
    )


def indent(lines: Iterable[str]) -> list[str]:
    """One level deeper."""
    return [f"    {line}" for line in lines]


def record_loop(lines: list[str]) -> list[str]:
    """Over all records."""
    return ["for record in range(records):", *indent(lines)]


def unpacked(names: Sequence[str]) -> str:
    """A tuple to assign to, of one entry as well."""
    return f"({', '.join(names)},)"


def added(terms: Sequence[str]) -> str:
    """A sum, of nothing as well."""
    return " + ".join(terms) if terms else "0.0"
