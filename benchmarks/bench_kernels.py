"""Generated kernels compared with alternatives: 200 records of the DC motor, then with sensitivities.

By hand: a hand-written Numba kernel. CasADi: its Runge-Kutta through MX/SX and ``mapaccum``.
NumPy: vectorised over states only, as a first version would be. Ratios are medians of interleaved runs.
"""

import sys
import time
from collections.abc import Callable

import casadi
import numpy as np

from benchmarks import handwritten
from otolith.acquisition.window import Array
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

RECORDS, PERIOD, SUBSTEPS = 200, 0.01, handwritten.SUBSTEPS
TWIN = find_twin("dc_motor")
PARAMETERS = np.array([parameter.nominal for parameter in TWIN.parameters])
INITIAL = np.array([0.3, 4.0])
TIMES = np.arange(RECORDS) * PERIOD
INPUTS = np.column_stack([np.where(TIMES < 0.7, 12.0, 5.0), 0.05 + 0.02 * np.sin(9.0 * TIMES)])


def interleaved(functions: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each; the functions take turns, so that load on the computer affects all alike."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(seconds)) for name, seconds in times.items()}


def in_numpy(parameters: Array = PARAMETERS, initial: Array = INITIAL) -> Array:
    R_a, L_a, J, K_e, K_t, D = parameters
    A = np.array([[-R_a / L_a, -K_e / L_a], [K_t / J, -D / J]])
    B = np.array([[1.0 / L_a, 0.0], [0.0, -1.0 / J]])
    outputs, x, h = np.empty((RECORDS, 2)), initial.copy(), PERIOD / SUBSTEPS
    for record in range(RECORDS):
        outputs[record] = x
        u = INPUTS[record].copy()
        slope = np.array([0.0, (INPUTS[min(record + 1, RECORDS - 1), 1] - u[1]) / SUBSTEPS])
        for _ in range(SUBSTEPS):
            k1 = A @ x + B @ u
            k2 = A @ (x + h / 2 * k1) + B @ (u + slope / 2)
            k3 = A @ (x + h / 2 * k2) + B @ (u + slope / 2)
            k4 = A @ (x + h * k3) + B @ (u + slope)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            u = u + slope
    return outputs


def in_casadi() -> tuple[casadi.Function, casadi.Function]:
    """The trajectory, and the trajectory with its Jacobian by five parameters."""
    x, p, u, d = casadi.SX.sym("x", 2), casadi.SX.sym("p", 6), casadi.SX.sym("u", 2), casadi.SX.sym("d", 2)
    R_a, L_a, J, K_e, K_t, D = (p[k] for k in range(6))

    def rates(x: casadi.SX, u: casadi.SX) -> casadi.SX:
        return casadi.vertcat((u[0] - R_a * x[0] - K_e * x[1]) / L_a, (K_t * x[0] - u[1] - D * x[1]) / J)

    h, y, v = PERIOD / SUBSTEPS, x, u
    for _ in range(SUBSTEPS):
        k1 = rates(y, v)
        k2 = rates(y + h / 2 * k1, v + d / 2)
        k3 = rates(y + h / 2 * k2, v + d / 2)
        k4 = rates(y + h * k3, v + d)
        y, v = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + d
    step = casadi.Function("step", [x, p, u, d], [y])
    many = step.mapaccum("many", RECORDS - 1)
    P, X = casadi.MX.sym("P", 6), casadi.MX.sym("X", 2)
    slopes = np.column_stack([np.zeros(RECORDS - 1), np.diff(INPUTS[:, 1]) / SUBSTEPS])
    run = many(X, casadi.repmat(P, 1, RECORDS - 1), INPUTS[:-1].T, slopes.T)
    jacobian = casadi.jacobian(casadi.vec(run), P)[:, :5]
    return casadi.Function("run", [X, P], [run]), casadi.Function("both", [X, P], [run, jacobian])


def main() -> int:
    kernel, drive = kernel_of(TWIN), Excitation.uniform(INPUTS, PERIOD, SUBSTEPS)
    run, both = in_casadi()
    one, start = PARAMETERS[None], INITIAL[None]
    assert np.allclose(kernel.simulate(one, start, drive)[0], in_numpy(), atol=1e-10)  # noqa: S101 - all solve the same problem
    assert np.allclose(run(INITIAL, PARAMETERS).full().T, in_numpy()[1:], atol=1e-10)  # noqa: S101
    plain = interleaved(
        {
            "by hand": lambda: handwritten.simulate(one, start, INPUTS, PERIOD),
            "generated": lambda: kernel.simulate(one, start, drive),
            "CasADi": lambda: run(INITIAL, PARAMETERS),
        },
        300,
    ) | interleaved({"NumPy": in_numpy}, 20)
    slopes = interleaved(
        {
            "by hand": lambda: handwritten.sensitivities(PARAMETERS, INITIAL, INPUTS, PERIOD),
            "generated": lambda: kernel.sensitivities(PARAMETERS, INITIAL, drive),
            "CasADi": lambda: both(INITIAL, PARAMETERS),
        },
        300,
    ) | interleaved({"NumPy": lambda: [in_numpy(PARAMETERS * (1 + 1e-6 * np.eye(6)[k])) for k in range(6)]}, 10)
    for title, timings in (
        ("one trajectory", plain),
        ("with five sensitivities (the generated one has eight)", slopes),
    ):
        print(title)
        for name, seconds in timings.items():
            print(f"  {name:10} {seconds * 1e6:9.1f} us   {seconds / timings['by hand']:8.2f} x by hand")
    return 0


if __name__ == "__main__":
    sys.exit(main())
