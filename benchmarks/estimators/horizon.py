"""Moving-horizon estimation by CasADi and IPOPT: multiple shooting over a window, Runge-Kutta between the records.

It starts at the last window's parameters, with their covariance as its arrival cost (C. V. Rao, J. B. Rawlings, D. Q.
Mayne, 2003); the initial state is free. The random walk of the parameters between windows is tuned like the filter's:
CONSTANT for constant parameters, DRIFTING for a drift of up to 20 % per hour.
"""

from functools import partial
from typing import Any

import casadi
import numpy as np

from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import KNOWN, NOISE, PERIOD, RECORDS, inputs_of, outputs_of
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem

CONSTANT, DRIFTING = 1e-5, 3e-4  # of each parameter per window, in shares of its nominal value
INITIAL_SPREAD = 0.5  # in the same, at the beginning
IPOPT_OPTIONS: dict[str, Any] = {
    "expand": True,
    "print_time": False,
    "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-8},
}


def methods(_: Budget) -> tuple[Method, ...]:
    """Both tunings."""
    return (
        Method(("MHE (CasADi, IPOPT), constant",), partial(Horizon, CONSTANT), stateful=True),
        Method(("MHE (CasADi, IPOPT), drifting",), partial(Horizon, DRIFTING), stateful=True),
    )


class Horizon:
    """The nonlinear programme, built once per machine; unknowns are the three relative parameters, then all states."""

    def __init__(self, walk: float, problem: Problem) -> None:
        self._walk, self._nominal = walk, problem.nominal
        low, high = problem.bounds
        free = np.full(2 * RECORDS, np.inf)
        self._low, self._high = (
            np.concatenate([low / problem.nominal, -free]),
            np.concatenate([high / problem.nominal, free]),
        )
        self._mean, self._covariance = np.ones(3), INITIAL_SPREAD**2 * np.eye(3)
        self._solver, self._slopes = _programme(problem.nominal)

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        inputs, measured = inputs_of(window), outputs_of(window)
        weight: Array = np.asarray(np.linalg.inv(self._covariance), dtype=np.float64)
        given = np.concatenate([inputs.ravel(), measured.ravel(), self._mean, weight.ravel()])
        start = np.concatenate([self._mean, measured.ravel()])
        solution = self._solver(x0=start, p=given, lbx=self._low, ubx=self._high, lbg=0.0, ubg=0.0)["x"].full().ravel()
        shares, initial = solution[:3], solution[3:5]
        covariance = self._posterior(shares, initial, inputs, weight)
        self._mean, self._covariance = shares, covariance + self._walk**2 * np.eye(3)
        return (Estimate(shares * self._nominal, np.sqrt(np.diag(covariance)) * self._nominal),)

    def _posterior(self, shares: Array, initial: Array, inputs: Array, weight: Array) -> Array:
        """From the Gauss-Newton Hessian of window and arrival cost, the initial state eliminated by inverting it."""
        jacobian = self._slopes(np.concatenate([shares, initial]), inputs.T).full()
        hessian = jacobian.T @ jacobian
        hessian[:3, :3] += weight
        return np.asarray(np.linalg.inv(hessian)[:3, :3])


def _programme(nominal: Array) -> tuple[casadi.Function, casadi.Function]:
    """The solver, and the derivatives of all whitened outputs by parameters and initial state."""
    step = _step(nominal)
    p, X = casadi.MX.sym("p", 3), casadi.MX.sym("X", 2, RECORDS)
    U, Y = casadi.MX.sym("U", 2, RECORDS), casadi.MX.sym("Y", 2, RECORDS)
    mean, weight = casadi.MX.sym("mean", 3), casadi.MX.sym("weight", 3, 3)
    steps = step.map(RECORDS - 1)
    after = steps(X[:, :-1], casadi.repmat(p, 1, RECORDS - 1), U[:, :-1], U[1, 1:])
    error = (X - Y) / casadi.repmat(casadi.DM(NOISE), 1, RECORDS)
    off = p - mean
    programme: dict[str, Any] = {
        "x": casadi.vertcat(p, casadi.vec(X)),
        "p": casadi.vertcat(casadi.vec(U), casadi.vec(Y), mean, casadi.vec(weight)),
        "f": 0.5 * casadi.sumsqr(error) + 0.5 * casadi.mtimes([off.T, weight, off]),
        "g": casadi.vec(after - X[:, 1:]),
    }
    solver = casadi.nlpsol("mhe", "ipopt", programme, IPOPT_OPTIONS)
    z = casadi.MX.sym("z", 5)
    run = step.mapaccum(RECORDS - 1)(z[3:], casadi.repmat(z[:3], 1, RECORDS - 1), U[:, :-1], U[1, 1:])
    whole = casadi.horzcat(z[3:], run) / casadi.repmat(casadi.DM(NOISE), 1, RECORDS)
    return solver, casadi.Function("slopes", [z, U], [casadi.jacobian(casadi.vec(whole), z)])


def _step(nominal: Array) -> casadi.Function:
    """One record by the classical Runge-Kutta method; the voltage is held, the load runs to its next value."""
    x, p, u, load = casadi.SX.sym("x", 2), casadi.SX.sym("p", 3), casadi.SX.sym("u", 2), casadi.SX.sym("load")
    R_a, D, J = (p[k] * float(nominal[k]) for k in range(3))

    def rates(x: casadi.SX, load: casadi.SX) -> casadi.SX:
        current = (u[0] - R_a * x[0] - KNOWN["K_e"] * x[1]) / KNOWN["L_a"]
        return casadi.vertcat(current, (KNOWN["K_t"] * x[0] - load - D * x[1]) / J)

    middle = (u[1] + load) / 2.0
    k1 = rates(x, u[1])
    k2 = rates(x + PERIOD / 2 * k1, middle)
    k3 = rates(x + PERIOD / 2 * k2, middle)
    k4 = rates(x + PERIOD * k3, load)
    return casadi.Function("step", [x, p, u, load], [x + PERIOD / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
