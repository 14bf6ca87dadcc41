"""Generated kernels for the search for components (docs/explanation/innovation-form.md).

``linearise`` is the linear time-varying system of an augmented twin along a trajectory, ``curves`` are basis functions
of components, and ``respond`` runs curves through the system: all that a search by linear algebra needs. ``adjoint``
and ``spread`` score a whole spectrum of curves at the cost of a few. All but ``linearise`` are the same for all twins.
"""

import sympy

from otolith.twin.codegen import INNER, PRINTER, Blocks, KernelCode, unpacked
from otolith.twin.components import COMPONENT_FAMILIES, family_code
from otolith.twin.symbolic import absolute, sign

# Columns of dx, the derivative of the next state: this state, the sites' inputs at this record, then at the next one.
LINEARISE = """
@njit(cache=True, error_model="numpy", fastmath={"contract"})
def linearise(parameters, initial, inputs, steps, counts, measured, gain):
    records = inputs.shape[0]
    trajectory, transition = np.zeros((records, $n_states)), np.zeros((records, $n_states, $n_states))
    input_now, input_next = np.zeros((2, records, $n_states, $n_sites))
    output, feedthrough = np.zeros((records, $n_outputs, $n_states)), np.zeros((records, $n_outputs, $n_sites))
    dx, forcing = np.zeros(($n_states, $n_columns)), np.zeros(($n_stages, $n_states, $n_columns))
    correct = len(gain) > 0
    $read_parameters
    for record in range(records):
        $read_inputs
        $store_trajectory
        $linearised_y = linearise_site_outputs_($of_linearise_site_outputs_)
        $store_output_matrix
        $store_feedthrough
        if correct:
            $innovations
            $correct_state
        if record + 1 == records:
            break
        substeps = counts[record]
        step = steps[record] / substeps
        half, sixth = step / 2.0, step / 6.0
        $set_length
        $input_increments
        for row in range($n_states):
            for column in range($n_columns):
                dx[row, column] = 0.0
        $initial_dx
        for substep in range(substeps):
            $inputs_at_stages
            $linearised_stages
            $advance_state
            $forcing_of_sites
            for column in range($n_columns):
                $read_dx
                $stage_dx
                $advance_dx
            $advance_inputs
        for row in range($n_states):
            for column in range($n_states):
                transition[record, row, column] = dx[row, column]
            $store_input_matrices
    return trajectory, transition, input_now, input_next, output, feedthrough
"""


def linearise(code: KernelCode) -> list[str]:
    """``linearise``: the linear time-varying system along a trajectory, its inputs those of the sites.

    ``state + input_now @ u[k] + input_next @ u[k + 1]`` to the next record, ``output @ state + feedthrough @ u[k]``.
    """
    states = len(code.x)
    reaching = sorted({site for _, site, _ in code.f.named("f")})  # the sites that enter a rate
    column_of = {site: states + index for index, site in enumerate(reaching)}
    blocks: Blocks = {
        "n_sites": str(code.sites),
        "n_columns": str(states + 2 * len(reaching)),
        "store_trajectory": [f"trajectory[record, {row}] = {x}" for row, x in enumerate(code.x)],
        "linearised_y": unpacked([*code.y, *code.c.names("c"), *code.g.names("g")]),
        "store_output_matrix": [f"output[record, {row}, {column}] = {c}" for row, column, c in code.c.named("c")],
        "store_feedthrough": [f"feedthrough[record, {row}, {site}] = {g}" for row, site, g in code.g.named("g")],
        "initial_dx": [f"dx[{row}, {row}] = 1.0" for row in range(states)],
        "linearised_stages": code.stages("linearise_sites_", [("a", code.a), ("f", code.f)]),
        "forcing_of_sites": _forcing(code, column_of),
        "store_input_matrices": [
            f"{matrix}[record, row, {site}] = dx[row, {column + shift}]"
            for matrix, shift in (("input_now", 0), ("input_next", len(reaching)))
            for site, column in column_of.items()
        ],
    }
    return code.kernel(LINEARISE, code.slopes_of_state(code.f) | blocks)


def _forcing(code: KernelCode, column_of: dict[int, int]) -> list[str]:
    """F_j of a substep: df/ds at stage j times the share of each record in the input, which is interpolated."""
    lines = []
    for stage in code.stages_of_step:
        lines.append(f"share = (substep + {stage.time}) / substeps")
        for row, site, f in code.f.named(f"f{stage.number}"):
            element = f"forcing[{stage.number - 1}, {row}, {{}}] = {{}} * {f}"
            column = column_of[site]
            lines += [element.format(column, "(1.0 - share)"), element.format(column + len(column_of), "share")]
    return lines


# Neighbouring curves of the same site share every factor: the inner loops run over them, so the compiler vectorises.
RESPOND = '''
@njit(cache=True, error_model="numpy", fastmath=True)
def respond(transition, input_now, input_next, output, feedthrough, gain, whitening, present, curves, sites):
    """(records, curves) -> (records * outputs, curves): whitened changes of the innovations."""
    records, count = curves.shape
    outputs, states = gain.shape[2], gain.shape[1]
    response = np.empty((records * outputs, count))
    state, next_state = np.zeros((states, count)), np.zeros((states, count))
    first = 0
    while first < count:
        site, last = sites[first], first
        while last < count and sites[last] == site:
            last += 1
        for record in range(records):
            for row in range(outputs):
                target = response[record * outputs + row]
                weight = 1.0 if present[record, row] else 0.0
                factor = feedthrough[record, row, site] * weight
                for curve in range(first, last):
                    target[curve] = factor * curves[record, curve]
                for column in range(states):
                    factor = output[record, row, column] * weight
                    if factor != 0.0:
                        for curve in range(first, last):
                            target[curve] += factor * state[column, curve]
            if record + 1 < records:
                for row in range(states):
                    for column in range(outputs):
                        factor, target = gain[record, row, column], response[record * outputs + column]
                        if factor != 0.0:
                            for curve in range(first, last):
                                state[row, curve] -= factor * target[curve]
                for row in range(states):
                    now, following = input_now[record, row, site], input_next[record, row, site]
                    for curve in range(first, last):
                        next_state[row, curve] = now * curves[record, curve] + following * curves[record + 1, curve]
                    for column in range(states):
                        factor = transition[record, row, column]
                        if factor != 0.0:
                            for curve in range(first, last):
                                next_state[row, curve] += factor * state[column, curve]
                for row in range(states):
                    for curve in range(first, last):
                        state[row, curve] = next_state[row, curve]
            for row in range(outputs - 1, -1, -1):
                target, factor = response[record * outputs + row], whitening[record, row, row]
                for curve in range(first, last):
                    target[curve] *= factor
                for column in range(row):
                    factor, other = whitening[record, row, column], response[record * outputs + column]
                    if factor != 0.0:
                        for curve in range(first, last):
                            target[curve] += factor * other[curve]
        first = last
    return response
'''

ADJOINT = '''
@njit(cache=True, error_model="numpy", fastmath=True)
def adjoint(transition, input_now, input_next, output, feedthrough, gain, whitening, present, signals):
    """(records * outputs, signals) -> (records, sites, signals): the transpose of ``respond``, backward in time."""
    records, sites, count = len(gain), input_now.shape[2], signals.shape[1]
    outputs, states = gain.shape[2], gain.shape[1]
    result = np.zeros((records, sites, count))
    costate, before = np.zeros((states, count)), np.zeros((states, count))
    weighted = np.zeros((outputs, count))
    for record in range(records - 1, -1, -1):
        for row in range(states):
            for signal in range(count):
                before[row, signal] = 0.0
        if record + 1 < records:
            for row in range(states):
                for site in range(sites):
                    now, following = input_now[record, row, site], input_next[record, row, site]
                    for signal in range(count):
                        result[record, site, signal] += now * costate[row, signal]
                        result[record + 1, site, signal] += following * costate[row, signal]
                for column in range(states):
                    factor = transition[record, row, column]
                    for signal in range(count):
                        before[column, signal] += factor * costate[row, signal]
        for row in range(outputs):
            for signal in range(count):
                weighted[row, signal] = 0.0
            if present[record, row]:
                for column in range(row, outputs):
                    factor = whitening[record, column, row]
                    for signal in range(count):
                        weighted[row, signal] += factor * signals[record * outputs + column, signal]
                for column in range(states):
                    factor = gain[record, column, row]
                    for signal in range(count):
                        weighted[row, signal] -= factor * before[column, signal]
        for row in range(outputs):
            for site in range(sites):
                factor = feedthrough[record, row, site]
                for signal in range(count):
                    result[record, site, signal] += factor * weighted[row, signal]
            for column in range(states):
                factor = output[record, row, column]
                for signal in range(count):
                    before[column, signal] += factor * weighted[row, signal]
        for row in range(states):
            for signal in range(count):
                costate[row, signal] = before[row, signal]
    return result
'''

# Each record goes to the few nearest points of a grid over the circle, with the weights of a Gaussian: a product of a
# factor of the record, a factor of the point, and a power of a ratio, so that a record takes two exponentials.
SPREAD = '''
@njit(cache=True, error_model="numpy", fastmath=True)
def spread(x, signals, first, width, points, variance, reach):
    """(records,), (records, signals) -> (points, signals): ``signals * exp(i first x)`` at the angles ``width * x``."""
    grid = np.zeros((points, signals.shape[1]), dtype=np.complex128)
    step = 2.0 * math.pi / points
    weights = np.exp(-((step * np.arange(1 - reach, reach + 1)) ** 2) / (4.0 * variance))
    for record in range(len(x)):
        angle = width * x[record]
        nearest = math.floor(angle / step)
        distance = nearest * step - angle
        ratio = math.exp(-distance * step / (2.0 * variance))
        factor = math.exp(-distance * (distance + 2.0 * (1 - reach) * step) / (4.0 * variance))
        phase = complex(math.cos(first * x[record]), math.sin(first * x[record]))
        for index in range(2 * reach):
            weight = phase * (factor * weights[index])
            factor *= ratio
            target = grid[(nearest + 1 - reach + index) % points]
            for signal in range(signals.shape[1]):
                target[signal] += weight * signals[record, signal]
    return grid
'''

WHITEN = '''
@njit(cache=True, error_model="numpy", fastmath={"contract"})
def whiten(whitening, slopes, present):
    """(records, outputs, outputs), (records, outputs, columns) -> (records * outputs, columns)

    Minus ``whitening @ slopes``, where ``slopes`` of values that are not present count as zero.
    """
    records, outputs, columns = slopes.shape
    whitened = np.zeros((records * outputs, columns))
    for record in range(records):
        for row in range(outputs):
            target = whitened[record * outputs + row]
            for output in range(row + 1):
                if present[record, output]:
                    factor = whitening[record, row, output]
                    for column in range(columns):
                        target[column] += factor * slopes[record, output, column]
    return -whitened
'''

CURVES = '''
@njit(cache=True, error_model="numpy")
def curves(family, x, sources, b, c):
    """Shapes of unit amplitude: (curves,), (sources, records), (curves,), (curves,), (curves,) -> (records, curves)."""
    shapes = np.empty((x.shape[1], len(family)))
    for curve in range(len(family)):
        for record in range(x.shape[1]):
            shapes[record, curve] = component(family[curve], x[sources[curve], record], 1.0, b[curve], c[curve])
    return shapes
'''


def component_functions() -> list[str]:
    """``component(family, x, a, b, c)``; ``component_slopes``, which adds its derivatives.

    The derivatives by ``x``, ``a``, ``b`` and ``c`` share the exponentials of the component.
    """
    arguments = sympy.symbols("x a b c", real=True)
    known = {symbol.name: symbol for symbol in arguments} | {"absolute": absolute, "sign": sign}
    formulas = {family_code(row.name): sympy.sympify(row.formula, locals=known) for row in COMPONENT_FAMILIES}
    slopes = {code: [formula, *(sympy.diff(formula, by) for by in arguments)] for code, formula in formulas.items()}
    lines = _by_family("component", {code: [formula] for code, formula in formulas.items()})
    return [*lines, *_by_family("component_slopes", slopes)]


def kernels_of_all_twins() -> list[str]:
    """``whiten``, ``curves``, ``respond``, ``adjoint`` and ``spread``, with what they call."""
    lines = component_functions()
    for kernel in (WHITEN, CURVES, RESPOND, ADJOINT, SPREAD):
        lines += [*kernel.strip().splitlines(), "", ""]
    return lines


def _by_family(name: str, rows: dict[float, list[sympy.Expr]]) -> list[str]:
    """A function that evaluates the row of the family whose code it is given; of an empty slot, code 0, zeros."""
    zeros = [sympy.Integer(0)] * len(next(iter(rows.values())))
    lines = [f'@njit(error_model="numpy", {INNER})', f"def {name}(family, x, a, b, c):"]
    for code, row in ({0.0: zeros} | rows).items():  # most slots are empty: they come first
        shared, results = sympy.cse(row, symbols=sympy.numbered_symbols("t_", real=True), order="none")
        lines.append(f"    if family == {code!r}:")
        lines += [f"        {symbol.name} = {PRINTER.doprint(value)}" for symbol, value in shared]
        lines.append(f"        return {', '.join(map(PRINTER.doprint, results))}")
    return [*lines, f"    return {', '.join(map(PRINTER.doprint, zeros))}", "", ""]
