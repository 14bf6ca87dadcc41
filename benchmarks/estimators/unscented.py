"""An augmented-state unscented Kalman filter by filterpy: current, speed, and the logarithms of the three unknowns.

Tuned on motors of another seed than those compared: Merwe's points with alpha 0.1, beta 2 and kappa 3 - n; hardly any
noise in the states, since the equations are exact; the logarithms start at the nominal values, with INITIAL_SPREAD.
Their random walk is the user's choice, so there are two: CONSTANT is best for constant parameters, DRIFTING has correct
intervals up to a drift of 20 % per hour.
"""

from functools import partial

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

from benchmarks.estimators.base import Budget, Estimate, Method
from benchmarks.estimators.data import KNOWN, NOISE, PERIOD, inputs_of, outputs_of
from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem

CONSTANT, DRIFTING = 1e-6, 3e-5  # of the logarithms, standard deviation per record
STATE_NOISE = 1e-6  # A and rad/s per record
INITIAL_SPREAD = 0.3  # of the logarithms at the beginning


def methods(_: Budget) -> tuple[Method, ...]:
    """Both tunings; there is no cold one, as a filter carries its state."""
    return (
        Method(("UKF (filterpy), constant",), partial(Unscented, CONSTANT), stateful=True),
        Method(("UKF (filterpy), drifting",), partial(Unscented, DRIFTING), stateful=True),
    )


class Unscented:
    """One filter for all windows of the machine."""

    def __init__(self, walk: float, problem: Problem) -> None:
        points = MerweScaledSigmaPoints(5, alpha=0.1, beta=2.0, kappa=-2.0)
        self._filter = UnscentedKalmanFilter(5, 2, PERIOD, lambda x: x[:2], _advance, points)
        self._filter.x = np.concatenate([np.zeros(2), np.log(problem.nominal)])
        self._filter.P = np.diag([*NOISE**2, *[INITIAL_SPREAD**2] * 3])
        self._filter.Q = np.diag([STATE_NOISE**2] * 2 + [walk**2] * 3)
        self._filter.R = np.diag(NOISE**2)
        self._before: Array | None = None

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        for u, y in zip(inputs_of(window), outputs_of(window), strict=True):
            if self._before is None:  # the very first record is the initial state, with the uncertainty of its sensors
                self._filter.x[:2] = y
            else:
                self._filter.predict(u=self._before.tolist(), load=float(u[1]))
                self._filter.update(y)
            self._before = u
        values = np.exp(self._filter.x[2:])
        return (Estimate(values, values * np.sqrt(np.diag(self._filter.P)[2:])),)


def _advance(x: Array, dt: float, u: list[float], load: float) -> Array:
    """One record by the classical Runge-Kutta method; the voltage is held, the load is interpolated to ``load``."""
    L_a, K_e, K_t = KNOWN["L_a"], KNOWN["K_e"], KNOWN["K_t"]
    R_a, D, J = np.exp(x[2:]).tolist()
    i, w = float(x[0]), float(x[1])
    V, T, middle, half = u[0], u[1], (u[1] + load) / 2.0, dt / 2.0
    i1, w1 = (V - R_a * i - K_e * w) / L_a, (K_t * i - T - D * w) / J
    a, b = i + half * i1, w + half * w1
    i2, w2 = (V - R_a * a - K_e * b) / L_a, (K_t * a - middle - D * b) / J
    a, b = i + half * i2, w + half * w2
    i3, w3 = (V - R_a * a - K_e * b) / L_a, (K_t * a - middle - D * b) / J
    a, b = i + dt * i3, w + dt * w3
    i4, w4 = (V - R_a * a - K_e * b) / L_a, (K_t * a - load - D * b) / J
    sixth = dt / 6.0
    return np.array([i + sixth * (i1 + 2.0 * (i2 + i3) + i4), w + sixth * (w1 + 2.0 * (w2 + w3) + w4), *x[2:]])
