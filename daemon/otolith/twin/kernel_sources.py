"""From algebra to source: the text of a module with the compiled kernels of a twin.

The text is generated from SymPy expressions by a printer that knows nothing but arithmetic; no text of a twin file
reaches it except names, which :mod:`otolith.twin.expressions` has checked.

What depends on parameters alone is computed once per trajectory; common subexpressions are shared between right sides
and their derivatives. Sensitivities are those of the integrator itself: the derivative of each Runge-Kutta step.

The kernel of the extended Kalman filter: how a disturbed machine is followed from record to record.

Its gains and the covariances of its innovations are computed once per window around a trajectory; with them the other
kernels predict in innovation form (B. D. O. Anderson, J. B. Moore, Optimal Filtering, section 8.2; L. Ljung, System
Identification, 2nd ed., section 4.3). The initial state is taken as given: it is estimated along with the parameters.

The kernels of a search for components: the twin linearised along a window, and what a curve at a site does to it.

Along its trajectory the corrected twin is a linear system that varies with time: ``state + early @ now + late @ next``
from record to record, ``output @ state + through @ now`` at each. Its response to a component is all that a search by
linear algebra needs (L. Ljung, System Identification, 2nd ed., section 4.3, in innovation form).

The table of meta-models in compiled code: one function of scalars that looks a family up, and its derivatives.
"""

import sympy

from otolith.twin.augmentation import entrances
from otolith.twin.codegen import PRINTER, Fragments, added, indent, record_loop, unpacked
from otolith.twin.component_families import COMPONENT_FAMILIES, code_of
from otolith.twin.definition import Definition
from otolith.twin.symbolic import absolute, sign

DIFFERENCE = "1e-6 * abs({name}) + 1e-9"  # of a state: far under any curvature, far over rounding

# The covariance is corrected by what was measured: innovation = output @ covariance @ output.T + noise of the sensors.
UPDATE = '''
@njit(error_model="numpy")
def update_(covariance, output, innovation, present, gain, whitening):
    """Gain, whitening and corrected covariance; the logarithm of the innovation's determinant."""
    outputs, states = output.shape
    cross = np.zeros((states, outputs))
    for row in range(states):
        for column in range(outputs):
            for inner in range(states):
                cross[row, column] += covariance[row, inner] * output[column, inner]
    for row in range(outputs):
        for column in range(outputs):
            for inner in range(states):
                innovation[row, column] += output[row, inner] * cross[inner, column]
    for row in range(outputs):
        if not present[row]:
            innovation[row, :] = 0.0
            innovation[:, row] = 0.0
            innovation[row, row] = 1.0
            cross[:, row] = 0.0
    # By Cholesky's factor and its inverse, both lower triangular.
    log_determinant = 0.0
    for row in range(outputs):
        for column in range(row + 1):
            rest = innovation[row, column]
            for inner in range(column):
                rest -= innovation[row, inner] * innovation[column, inner]
            innovation[row, column] = math.sqrt(rest) if row == column else rest / innovation[column, column]
        log_determinant += 2.0 * math.log(innovation[row, row])
    for column in range(outputs):
        for row in range(column, outputs):
            rest = 1.0 if row == column else 0.0
            for inner in range(column, row):
                rest -= innovation[row, inner] * whitening[inner, column]
            whitening[row, column] = rest / innovation[row, row]
    half = np.zeros((states, outputs))
    for row in range(states):
        for column in range(outputs):
            for inner in range(column + 1):
                half[row, column] += cross[row, inner] * whitening[column, inner]
    for row in range(states):
        for column in range(outputs):
            for inner in range(column, outputs):
                gain[row, column] += half[row, inner] * whitening[inner, column]
    for row in range(states):
        for column in range(states):
            for inner in range(outputs):
                covariance[row, column] -= half[row, inner] * half[column, inner]
    return log_determinant


@njit(error_model="numpy")
def spread_(covariance, transition):
    """transition @ covariance @ transition.T, symmetric to the last bit."""
    states = len(covariance)
    moved = np.zeros((states, states))
    for row in range(states):
        for column in range(states):
            for inner in range(states):
                moved[row, column] += transition[row, inner] * covariance[inner, column]
    for row in range(states):
        for column in range(row + 1):
            found = 0.0
            for inner in range(states):
                found += moved[row, inner] * transition[column, inner]
            covariance[row, column] = covariance[column, row] = found
'''


def kalman(writer: Fragments, decorator: str) -> list[str]:
    """The text of the kernel ``kalman``."""
    states, outputs, inputs = len(writer.x), writer.outputs, len(writer.u)
    entries = [*writer.c.names("c"), *writer.d.names("d")]
    loop = [
        *writer.read_inputs(),
        f"{unpacked([*writer.y(), *entries])} = linearise_outputs_({writer.arguments(writer.x, writer.u)})",
        *(f"output[{row}, {column}] = {name}"
          for (row, column), name in zip(writer.c.places, writer.c.names("c"), strict=True)),
        "innovation = np.diag(sensor)",
        *_inputs_into_outputs(writer),
        *writer.innovations(),
        *(f"present[{index}] = m_{index} > 0.0" for index in range(outputs)),
        "log_determinant += update_(covariance, output, innovation, present, gain[record], whitening[record])",
        *(f"{x} += {writer.correction(row)}" for row, x in enumerate(writer.x)),
        "if record + 1 == records:",
        "    break",
        *(f"w_{index} = inputs[record + 1, {index}]" for index in range(inputs)),
        f"{unpacked(names('n', states))} = advance_({arguments(writer, {})})",
        *transition(writer, "transition[{}, {}]"),
        "spread_(covariance, transition)",
        *(f"covariance[{row}, {row}] += process[{row}] * sample_period" for row in range(states)),
        *_inputs_into_states(writer),
        *(f"{x} = n_{row}" for row, x in enumerate(writer.x)),
    ]  # fmt: skip
    return [
        decorator,
        "def kalman(parameters, initial, inputs, sample_period, substeps, measured, sensor, process, driving):",
        *indent([
            "records, log_determinant = inputs.shape[0], 0.0",
            f"gain, whitening = np.zeros((records, {states}, {outputs})), np.zeros((records, {outputs}, {outputs}))",
            f"covariance, transition = np.zeros(({states}, {states})), np.zeros(({states}, {states}))",
            f"output, present = np.zeros(({outputs}, {states})), np.zeros({outputs}, dtype=np.bool_)",
            "step = sample_period / substeps",
            *writer.read("parameters[{}]", "initial[{}]"),
            *record_loop(loop),
            "return gain, whitening, log_determinant",
        ]),
    ]  # fmt: skip


def names(prefix: str, count: int) -> list[str]:
    """Numbered variables."""
    return [f"{prefix}_{index}" for index in range(count)]


def arguments(writer: Fragments, changed: dict[str, str]) -> str:
    """Of ``advance_``, with some names replaced."""
    given = [*writer.x, *writer.u, *names("w", len(writer.u))]
    return ", ".join(["step", "substeps", *(changed.get(name, name) for name in given), *writer.fixed])


def transition(writer: Fragments, place: str) -> list[str]:
    """The derivative of the next state by this one, by central differences, into ``place`` of row and column."""
    lines = []
    for column, name in enumerate(writer.x):
        up, down = names("up", len(writer.x)), names("down", len(writer.x))
        lines += [
            f"by = {DIFFERENCE.format(name=name)}",
            f"{unpacked(up)} = advance_({arguments(writer, {name: f'{name} + by'})})",
            f"{unpacked(down)} = advance_({arguments(writer, {name: f'{name} - by'})})",
            *(f"{place.format(row, column)} = (up_{row} - down_{row}) / (2.0 * by)" for row in range(len(writer.x))),
        ]
    return lines


def _inputs_into_outputs(writer: Fragments) -> list[str]:
    """What the noise of an input does to the outputs of the same record."""
    lines = []
    for index, name in enumerate(writer.u):
        nudged = [f"{u} + driving[{index}]" if u == name else u for u in writer.u]
        lines += [
            f"if driving[{index}] > 0.0:",
            *indent([
                f"{unpacked(names('z', writer.outputs))} = outputs_({writer.arguments(writer.x, nudged)})",
                *(f"innovation[{row}, {column}] += (z_{row} - y_{row}) * (z_{column} - y_{column})"
                  for row in range(writer.outputs) for column in range(writer.outputs)),
            ]),
        ]  # fmt: skip
    return lines


def _inputs_into_states(writer: Fragments) -> list[str]:
    """What the noise of an input, held for a record, does to the next state."""
    lines = []
    for index, name in enumerate(writer.u):
        changed = {name: f"{name} + driving[{index}]", f"w_{index}": f"w_{index} + driving[{index}]"}
        lines += [
            f"if driving[{index}] > 0.0:",
            *indent([
                f"{unpacked(names('z', len(writer.x)))} = advance_({arguments(writer, changed)})",
                *(f"covariance[{row}, {column}] += (z_{row} - n_{row}) * (z_{column} - n_{column})"
                  for row in range(len(writer.x)) for column in range(len(writer.x))),
            ]),
        ]  # fmt: skip
    return lines


# Innovations whitened, as they change by a curve of unit amplitude; curves run straight from record to record. Curves
# that enter at the same site and follow each other are taken side by side, so that the processor can be as well.
RESPOND = '''
@njit(cache=True, error_model="numpy", fastmath=True)
def respond(transition, early, late, output, through, gain, whitening, present, curves, sites):
    """(records, curves) -> (records * outputs, curves)."""
    records, count = curves.shape
    outputs, states = gain.shape[2], gain.shape[1]
    found = np.empty((records * outputs, count))
    state, moved = np.zeros((states, count)), np.zeros((states, count))
    first = 0
    while first < count:
        site, last = sites[first], first
        while last < count and sites[last] == site:
            last += 1
        for record in range(records):
            for row in range(outputs):
                shown = found[record * outputs + row]
                there = 1.0 if present[record, row] else 0.0
                by = through[record, row, site] * there
                for curve in range(first, last):
                    shown[curve] = by * curves[record, curve]
                for column in range(states):
                    by = output[record, row, column] * there
                    if by != 0.0:
                        for curve in range(first, last):
                            shown[curve] += by * state[column, curve]
            if record + 1 < records:
                for row in range(states):
                    for column in range(outputs):
                        by, shown = gain[record, row, column], found[record * outputs + column]
                        if by != 0.0:
                            for curve in range(first, last):
                                state[row, curve] -= by * shown[curve]
                for row in range(states):
                    now, following = early[record, row, site], late[record, row, site]
                    for curve in range(first, last):
                        moved[row, curve] = now * curves[record, curve] + following * curves[record + 1, curve]
                    for column in range(states):
                        by = transition[record, row, column]
                        if by != 0.0:
                            for curve in range(first, last):
                                moved[row, curve] += by * state[column, curve]
                for row in range(states):
                    for curve in range(first, last):
                        state[row, curve] = moved[row, curve]
            for row in range(outputs - 1, -1, -1):
                shown, by = found[record * outputs + row], whitening[record, row, row]
                for curve in range(first, last):
                    shown[curve] *= by
                for column in range(row):
                    by, other = whitening[record, row, column], found[record * outputs + column]
                    if by != 0.0:
                        for curve in range(first, last):
                            shown[curve] += by * other[curve]
        first = last
    return found
'''


def linearised(writer: Fragments, decorator: str, entering: list[int]) -> list[str]:
    """The text of the kernel ``along``; ``entering`` are the inputs of the sites."""
    states, outputs, count = len(writer.x), writer.outputs, len(entering)
    shown = [*writer.y(), *writer.c.names("c"), *writer.d.names("d")]
    loop = [
        *writer.read_inputs(),
        *(f"trajectory[record, {row}] = {name}" for row, name in enumerate(writer.x)),
        f"{unpacked(shown)} = linearise_outputs_({writer.arguments(writer.x, writer.u)})",
        *(f"output[record, {row}, {column}] = {name}"
          for (row, column), name in zip(writer.c.places, writer.c.names("c"), strict=True)),
        *_through(writer, entering),
        "if correct:",
        *indent([*writer.innovations(), *(f"{x} += {writer.correction(row)}" for row, x in enumerate(writer.x))]),
        "if record + 1 == records:",
        "    break",
        *(f"w_{index} = inputs[record + 1, {index}]" for index in range(len(writer.u))),
        f"{unpacked(names('n', states))} = advance_({arguments(writer, {})})",
        *transition(writer, "moves[record, {}, {}]"),
        *_into_states(writer, entering),
        *(f"{x} = n_{row}" for row, x in enumerate(writer.x)),
    ]  # fmt: skip
    return [
        decorator,
        "def along(parameters, initial, inputs, sample_period, substeps, measured, gain, nudge):",
        *indent([
            "records = inputs.shape[0]",
            f"trajectory, moves = np.zeros((records, {states})), np.zeros((records, {states}, {states}))",
            f"early, late = np.zeros((2, records, {states}, {count}))",
            f"output, through = np.zeros((records, {outputs}, {states})), np.zeros((records, {outputs}, {count}))",
            "step = sample_period / substeps",
            "correct = np.any(gain != 0.0)",
            *writer.read("parameters[{}]", "initial[{}]"),
            *record_loop(loop),
            "return trajectory, moves, early, late, output, through",
        ]),
    ]  # fmt: skip


def _through(writer: Fragments, entering: list[int]) -> list[str]:
    """What enters now, in the outputs of the same record, per unit."""
    lines = []
    for site, index in enumerate(entering):
        nudged = [f"{u} + nudge[{site}]" if place == index else u for place, u in enumerate(writer.u)]
        lines += [
            f"{unpacked(names('z', writer.outputs))} = outputs_({writer.arguments(writer.x, nudged)})",
            *(f"through[record, {row}, {site}] = (z_{row} - y_{row}) / nudge[{site}]" for row in range(writer.outputs)),
        ]
    return lines


def _into_states(writer: Fragments, entering: list[int]) -> list[str]:
    """What enters at this record and at the next, in the next states, per unit."""
    lines = []
    for site, index in enumerate(entering):
        name = writer.u[index]
        for where, changed in (("early", {name: f"{name} + nudge[{site}]"}),
                               ("late", {f"w_{index}": f"w_{index} + nudge[{site}]"})):  # fmt: skip
            lines += [
                f"{unpacked(names('z', len(writer.x)))} = advance_({arguments(writer, changed)})",
                *(f"{where}[record, {row}, {site}] = (z_{row} - n_{row}) / nudge[{site}]"
                  for row in range(len(writer.x))),
            ]  # fmt: skip
    return lines


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
    formulas = [(code_of(row.name), sympy.sympify(row.formula, locals=known)) for row in COMPONENT_FAMILIES]
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


HEAD = '''"""Kernels of a twin. Generated by otolith.twin.kernel_sources; see otolith.twin.kernel for what they do."""

import math

import numpy as np
from numba import njit
'''
KERNEL = '@njit(cache=True, error_model="numpy", fastmath={"contract"})'


class _Writer(Fragments):
    """Writes the kernels of one twin."""

    def helpers(self) -> list[str]:
        """The right sides as functions of scalars, which the compiler inlines."""
        return [
            *self.function("rates_", self.rates),
            *self.function("outputs_", self.expressions),
            *self.function("linearise_", [*self.rates, *self.rate_entries]),
            *self.function("linearise_outputs_", [*self.expressions, *self.output_entries]),
            *self.advance(),
        ]

    def simulate(self) -> list[str]:
        loop = [
            *self.read_inputs(),
            f"{unpacked(self.y())} = outputs_({self.arguments(self.x, self.u)})",
            *(f"found[particle, record, {index}] = {name}" for index, name in enumerate(self.y())),
            "if correct:",
            *indent([*self.innovations(), *(f"{x} += {self.correction(row)}" for row, x in enumerate(self.x))]),
            *self.step([f"{unpacked(self.k(stage))} = rates_({{}})" for stage in range(1, 5)], []),
        ]
        return [
            KERNEL,
            "def simulate(parameters, initial, inputs, sample_period, substeps, measured, gain):",
            *indent([
                "particles, records = parameters.shape[0], inputs.shape[0]",
                f"found = np.empty((particles, records, {self.outputs}))",
                *self.preamble(),
                "for particle in range(particles):",
                *indent([*self.read("parameters[particle, {}]", "initial[particle, {}]"), *record_loop(loop)]),
                "return found",
            ]),
        ]  # fmt: skip

    def sensitivities(self, name: str, *, drifts: bool) -> list[str]:
        """Columns: each parameter, each initial state and, with ``drifts``, each parameter's drift.

        A drift moves its parameter by one unit per second and leaves it as it is at the last record, so its column is
        driven as the parameter's, weighted with the time until then.
        """
        entries, base = [*self.c.names("c"), *self.d.names("d")], len(self.p) + len(self.x)
        columns = base + len(self.p) * drifts
        slope: dict[int, list[str]] = {row: [] for row in range(self.outputs)}
        for (row, column), entry in zip(self.c.places, self.c.names("c"), strict=True):
            slope[row].append(f"{entry} * state[{column}, column]")
        stages = [f"{unpacked([*self.k(n), *self.jacobians(n)])} = linearise_({{}})" for n in range(1, 5)]
        drifting = ["when = (record - records + 1) * sample_period"] if drifts else []
        drifting += [
            f"slopes[record, {row}, {base + column}] += when * {entry}"
            for (row, column), entry in zip(self.d.places, self.d.names("d"), strict=True)
            if drifts
        ]
        loop = [
            *self.read_inputs(),
            f"{unpacked([*self.y(), *entries])} = linearise_outputs_({self.arguments(self.x, self.u)})",
            *(f"found[record, {index}] = {entry}" for index, entry in enumerate(self.y())),
            f"for column in range({columns}):",
            *indent([f"slopes[record, {row}, column] = {added(terms)}" for row, terms in slope.items()]),
            *(f"slopes[record, {row}, {column}] += {entry}"
              for (row, column), entry in zip(self.d.places, self.d.names("d"), strict=True)),
            *drifting,
            "if correct:",
            *indent([
                *self.innovations(),
                *(f"{x} += {self.correction(row)}" for row, x in enumerate(self.x)),
                f"for column in range({columns}):",
                *indent([f"state[{row}, column] -= {self.slope_correction(row)}" for row in range(len(self.x))]),
            ]),
            *self.step(stages, self.propagate(columns)),
        ]  # fmt: skip
        return [
            KERNEL,
            f"def {name}(parameters, initial, inputs, sample_period, substeps, measured, gain):",
            *indent([
                "records = inputs.shape[0]",
                f"found = np.empty((records, {self.outputs}))",
                f"slopes = np.zeros((records, {self.outputs}, {columns}))",
                f"state = np.zeros(({len(self.x)}, {columns}))",
                f"drive = np.zeros((4, {len(self.x)}, {columns}))",
                *(f"state[{row}, {len(self.p) + row}] = 1.0" for row in range(len(self.x))),
                *self.preamble(),
                *self.read("parameters[{}]", "initial[{}]"),
                *record_loop(loop),
                f"last = np.empty({len(self.x)})",
                *(f"last[{row}] = {name}" for row, name in enumerate(self.x)),
                "return found, slopes, last, state",
            ]),
        ]  # fmt: skip

    def euler(self) -> list[str]:
        """Explicit Euler, each state with the new values of those before it, as the paper's Eq. 11-12."""
        step = [f"{x} = {x} + step * ({PRINTER.doprint(rate)})" for x, rate in zip(self.x, self.rates, strict=True)]
        loop = [
            *self.read_inputs(),
            f"{unpacked(self.y())} = outputs_({self.arguments(self.x, self.u)})",
            *(f"found[particle, record, {index}] = {name}" for index, name in enumerate(self.y())),
            "if record + 1 == records:",
            "    break",
            *self.slopes(),
            "for substep in range(substeps):",
            *indent([*step, *(f"{u} += g_{u}" for u, linear in zip(self.u, self.linear, strict=True) if linear)]),
        ]
        return [
            KERNEL,
            "def euler(parameters, initial, inputs, sample_period, substeps):",
            *indent([
                "particles, records = parameters.shape[0], inputs.shape[0]",
                f"found = np.empty((particles, records, {self.outputs}))",
                "step = sample_period / substeps",
                "for particle in range(particles):",
                *indent([*self.read("parameters[particle, {}]", "initial[particle, {}]"), *record_loop(loop)]),
                "return found",
            ]),
        ]  # fmt: skip


def kernel_source(definition: Definition) -> str:
    """The text of the kernel module: ``simulate``, both kinds of sensitivities, ``kalman`` and ``euler``.

    Of the page only names of quantities enter it, each behind a prefix, and they are letters, digits and underscores.
    """
    writer = _Writer(definition)
    blank = ["", ""]
    lines = [*writer.helpers(), *writer.simulate(), *blank]
    lines += [*writer.sensitivities("sensitivities", drifts=False), *blank]
    lines += [*writer.sensitivities("drifting_sensitivities", drifts=True), *blank]
    lines += [*kalman(writer, KERNEL), *blank, *writer.euler()]
    if definition.plain is not None:
        entering = [index for index, entry in enumerate(definition.inputs) if entry.name in entrances(definition.plain)]
        lines = [*metacode(), *lines, *blank, *linearised(writer, KERNEL, entering), *RESPOND.splitlines()]
    return f"{HEAD}\n{UPDATE}\n\n" + "\n".join(lines) + "\n"
