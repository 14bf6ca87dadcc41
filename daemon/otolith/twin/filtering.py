"""The kernel of the extended Kalman filter: how a disturbed machine is followed from record to record.

Its gains and the covariances of its innovations are computed once per window around a trajectory; with them the other
kernels predict in innovation form (B. D. O. Anderson, J. B. Moore, Optimal Filtering, section 8.2; L. Ljung, System
Identification, 2nd ed., section 4.3). The initial state is taken as given: it is estimated along with the parameters.
"""

from otolith.twin.fragments import Fragments, indent, record_loop, unpacked

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
