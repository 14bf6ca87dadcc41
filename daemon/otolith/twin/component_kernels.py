"""Generated kernels of an augmented twin, for the search for components (docs/explanation/innovation-form.md).

``linearise`` is the linear time-varying system along a trajectory, ``curves`` are basis functions of components, and
``respond`` runs curves through the system: all that a search by linear algebra needs. ``adjoint`` and ``spread`` score
a whole spectrum of curves at the cost of a few.
"""

import sympy

from otolith.twin.codegen import PRINTER, Blocks, KernelCode, fill, numbered, unpacked
from otolith.twin.component_families import COMPONENT_FAMILIES, family_code
from otolith.twin.symbolic import absolute, sign

LINEARISE = """
@njit(cache=True, error_model="numpy", fastmath={"contract"})
def linearise(parameters, initial, inputs, steps, counts, measured, gain, nudge):
    records = inputs.shape[0]
    trajectory, transition = np.zeros((records, $n_states)), np.zeros((records, $n_states, $n_states))
    input_now, input_next = np.zeros((2, records, $n_states, $n_sites))
    output, feedthrough = np.zeros((records, $n_outputs, $n_states)), np.zeros((records, $n_outputs, $n_sites))
    correct = np.any(gain != 0.0)
    $read_parameters
    for record in range(records):
        $read_inputs
        $store_trajectory
        $linearised_y = linearise_outputs_($arguments)
        $store_output_matrix
        $store_feedthrough
        if correct:
            $innovations
            $correct_state
        if record + 1 == records:
            break
        substeps = counts[record]
        step = steps[record] / substeps
        $read_next_inputs
        $next_state
        $store_transition
        $store_input_matrices
        $move_to_next
    return trajectory, transition, input_now, input_next, output, feedthrough
"""


def linearise(code: KernelCode, site_inputs: list[int]) -> list[str]:
    """``linearise``: the linear time-varying system along a trajectory, its inputs those of the sites.

    ``state + input_now @ u[k] + input_next @ u[k + 1]`` to the next record, ``output @ state + feedthrough @ u[k]``.
    """
    matrix = [f"output[record, {row}, {column}] = {c}" for row, column, c in code.c.named("c")]
    blocks: Blocks = {
        "n_sites": str(len(site_inputs)),
        "store_trajectory": [f"trajectory[record, {row}] = {x}" for row, x in enumerate(code.x)],
        "store_output_matrix": matrix,
        "store_feedthrough": _feedthrough(code, site_inputs),
        "store_transition": code.transition("transition[record, {}, {}]"),
        "store_input_matrices": _input_matrices(code, site_inputs),
    }
    return fill(LINEARISE, code.blocks | blocks)


def _feedthrough(code: KernelCode, site_inputs: list[int]) -> list[str]:
    """Outputs by the input of each site at the same record, by a forward difference of ``nudge``."""
    lines = []
    for site, index in enumerate(site_inputs):
        nudged = [f"{u} + nudge[{site}]" if position == index else u for position, u in enumerate(code.u)]
        lines += [
            f"{unpacked(numbered('z', len(code.y)))} = outputs_({code.arguments(code.x, nudged)})",
            *(f"feedthrough[record, {r}, {site}] = (z_{r} - y_{r}) / nudge[{site}]" for r in range(len(code.y))),
        ]
    return lines


def _input_matrices(code: KernelCode, site_inputs: list[int]) -> list[str]:
    """Next states by the input of each site at this record and at the next, by forward differences of ``nudge``."""
    lines = []
    for site, index in enumerate(site_inputs):
        for matrix, nudged in (("input_now", code.u[index]), ("input_next", f"w_{index}")):
            lines += [
                code.advanced(numbered("z", len(code.x)), {nudged: f"{nudged} + nudge[{site}]"}),
                *(f"{matrix}[record, {r}, {site}] = (z_{r} - n_{r}) / nudge[{site}]" for r in range(len(code.x))),
            ]
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
        before[:] = 0.0
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
            weighted[row] = 0.0
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
        costate[:] = before
    return result
'''

# Each record goes to the few nearest points of a grid over the circle, with the weights of a Gaussian.
SPREAD = '''
@njit(cache=True, error_model="numpy", fastmath=True)
def spread(x, signals, first, width, points, variance, reach):
    """(records,), (records, signals) -> (points, signals): ``signals * exp(i first x)`` at the angles ``width * x``."""
    grid = np.zeros((points, signals.shape[1]), dtype=np.complex128)
    step = 2.0 * math.pi / points
    for record in range(len(x)):
        angle = width * x[record]
        nearest = math.floor(angle / step)
        phase = complex(math.cos(first * x[record]), math.sin(first * x[record]))
        for point in range(nearest - reach + 1, nearest + reach + 1):
            factor = phase * math.exp(-((point * step - angle) ** 2) / (4.0 * variance))
            target = grid[point % points]
            for signal in range(signals.shape[1]):
                target[signal] += factor * signals[record, signal]
    return grid
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
    """``component(family, x, a, b, c)`` and its derivatives by ``x``, ``a``, ``b`` and ``c``; then ``curves``."""
    arguments = sympy.symbols("x a b c", real=True)
    known = {symbol.name: symbol for symbol in arguments} | {"absolute": absolute, "sign": sign}
    formulas = [(family_code(row.name), sympy.sympify(row.formula, locals=known)) for row in COMPONENT_FAMILIES]
    lines = _by_family("component", formulas)
    for symbol in arguments:
        slopes = [(code, sympy.diff(formula, symbol)) for code, formula in formulas]
        lines += _by_family(f"component_{symbol.name}", slopes)
    return [*lines, *CURVES.strip().splitlines(), "", ""]


def _by_family(name: str, formulas: list[tuple[float, sympy.Expr]]) -> list[str]:
    """A function that evaluates the formula of the family whose code it is given, and 0 for any other code."""
    branches = []
    for code, formula in formulas:
        if formula != 0:
            branches += [f"    if family == {code!r}:", f"        return {PRINTER.doprint(formula)}"]
    return ['@njit(error_model="numpy")', f"def {name}(family, x, a, b, c):", *branches, "    return 0.0", "", ""]
