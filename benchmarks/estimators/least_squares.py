"""scipy.optimize.least_squares over parameters and initial state, started from the result of the last window.

With three simulations: ``solve_ivp``, the usual choice; ``lsim``, as the motor is linear; and a hand-written Numba
kernel that computes a whole finite-difference Jacobian per call.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.signal import StateSpace, lsim

from benchmarks import handwritten
from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import KNOWN, NOISE, full, inputs_of, outputs_of
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem

Simulation = Callable[[Array, Array, Array, float], Array]
"""Parameters (free,), initial state (states,), inputs (records, inputs), sample period -> (records, outputs)."""
DIFFERENCE_STEP = 1e-6  # relative: of the finite differences


def methods(_: Budget) -> tuple[Method, ...]:
    """All three."""
    return (
        Method(("least_squares, solve_ivp",), partial(Fitted, by_solve_ivp), slow=True),
        Method(("least_squares, lsim",), partial(Fitted, by_lsim)),
        Method(("least_squares, own Numba kernel",), Expert),
    )


class Fitted:
    """Trust region with bounds; the Jacobian by SciPy's own differences."""

    def __init__(self, simulation: Simulation, problem: Problem) -> None:
        self._simulation = simulation
        self._start, (self._low, self._high) = problem.nominal, problem.bounds

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        inputs, measured = inputs_of(window), outputs_of(window)

        def residuals(guess: Array) -> Array:
            result = self._simulation(guess[:-2], guess[-2:], inputs, window.sample_period)
            return np.asarray(((result - measured) / NOISE).ravel())

        return (self._solve(residuals, "2-point", measured[0]),)

    def _solve(
        self, residuals: Callable[[Array], Array], jac: str | Callable[[Array], Array], first: Array
    ) -> Estimate:
        free = np.full(2, np.inf)
        result = least_squares(
            residuals,
            np.concatenate([self._start, first]),
            jac=jac,
            bounds=(np.concatenate([self._low, -free]), np.concatenate([self._high, free])),
            x_scale="jac",
            method="trf",
        )
        self._start = result.x[:-2]
        covariance = np.linalg.inv(result.jac.T @ result.jac)
        return Estimate(result.x[:-2], np.sqrt(np.diag(covariance))[:-2])


class Expert(Fitted):
    """The Jacobian from one call of the kernel for all nudged guesses."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(by_solve_ivp, problem)
        handwritten.simulate(full(problem.nominal[None]), np.zeros((1, 2)), np.zeros((2, 2)), 0.01)  # compiles

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        inputs, measured = inputs_of(window), outputs_of(window)

        def simulate(guesses: Array) -> Array:
            outputs = handwritten.simulate(full(guesses[:, :-2]), guesses[:, -2:], inputs, window.sample_period)
            return np.asarray(((outputs - measured) / NOISE).reshape(len(guesses), -1))

        def jacobian(guess: Array) -> Array:
            steps = DIFFERENCE_STEP * np.maximum(np.abs(guess), 1e-6)
            outputs = simulate(np.vstack([guess, guess + np.diag(steps)]))
            return np.asarray(((outputs[1:] - outputs[0]) / steps[:, None]).T)

        return (self._solve(lambda guess: simulate(guess[None])[0], jacobian, measured[0]),)


def matrices(parameters: Array) -> tuple[Array, Array]:
    """A and B of the motor."""
    R_a, D, J = parameters
    L_a, K_e, K_t = KNOWN["L_a"], KNOWN["K_e"], KNOWN["K_t"]
    return np.array([[-R_a / L_a, -K_e / L_a], [K_t / J, -D / J]]), np.array([[1.0 / L_a, 0.0], [0.0, -1.0 / J]])


def by_solve_ivp(parameters: Array, initial: Array, inputs: Array, period: float) -> Array:
    """Runge-Kutta 4(5) with no step beyond a record, so that no step of the voltage is missed."""
    R_a, D, J = parameters.tolist()
    L_a, K_e, K_t = KNOWN["L_a"], KNOWN["K_e"], KNOWN["K_t"]
    times = period * np.arange(len(inputs))
    voltage, load = inputs[:, 0].tolist(), inputs[:, 1]

    def rates(t: float, x: Array) -> list[float]:
        i, omega = x.tolist()
        V_a = voltage[min(int(t / period + 1e-9), len(voltage) - 1)]
        T_load = float(np.interp(t, times, load))
        return [(V_a - R_a * i - K_e * omega) / L_a, (K_t * i - T_load - D * omega) / J]

    solution = solve_ivp(rates, (0.0, times[-1]), initial, t_eval=times, max_step=period, rtol=1e-6, atol=1e-8)
    return np.asarray(solution.y.T)


def by_lsim(parameters: Array, initial: Array, inputs: Array, period: float) -> Array:
    """The sum of the responses to the held voltage and to the interpolated load: lsim has one hold for all inputs."""
    A, B = matrices(parameters)
    times = period * np.arange(len(inputs))
    held = lsim(StateSpace(A, B[:, :1], np.eye(2), np.zeros((2, 1))), inputs[:, 0], times, X0=initial, interp=False)
    run = lsim(StateSpace(A, B[:, 1:], np.eye(2), np.zeros((2, 1))), inputs[:, 1], times, interp=True)
    return np.asarray(held[1] + run[1])
