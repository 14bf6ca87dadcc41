"""The kernels of a search for components: the twin linearised along a window, and what a curve at a site does to it.

Along its trajectory the corrected twin is a linear system that varies with time: ``state + early @ now + late @ next``
from record to record, ``output @ state + through @ now`` at each. Its response to a component is all that a search by
linear algebra needs (L. Ljung, System Identification, 2nd ed., section 4.3, in innovation form).
"""

from otolith.twin.filtering import arguments, names, transition
from otolith.twin.fragments import Fragments, indent, record_loop, unpacked

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
