"""What disturbs a real machine between records, and the predictor that knows it.

Process noise comes from noisy inputs and from what strays in the states themselves. The steady-state Kalman gain weighs
it against the sensors' noise; with it the twin predicts in innovation form (L. Ljung, System Identification, 2nd ed.,
sections 4.3 and 7.4). Without process noise the gain is zero and the twin runs in open loop, the paper's cost.
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.kernel import Excitation, Kernel

ITERATIONS = 60  # of the doubling, which needs a handful
SETTLED = 1e-12  # relative change of the covariance


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Standard deviations, each in the unit of its signal or state."""

    outputs: Array
    """(outputs,) of the sensors."""
    inputs: Array
    """(inputs,) of what the twin is told to be driven by; independent from record to record."""
    states: Array
    """(states,) per square root of a second, of what strays in the machine itself."""


@dataclass(frozen=True, slots=True, eq=False)
class Predictor:
    """How the twin is corrected on its way, and how far off each prediction may then be."""

    gain: Array
    """(states, outputs)."""
    whitening: Array
    """(outputs, outputs): makes an innovation's covariance the identity."""


def predictor(kernel: Kernel, parameters: Array, initial: Array, excitation: Excitation, noise: Noise) -> Predictor:
    """The steady-state predictor around the middle of a window; shapes (parameters,), (states,)."""
    sensor = np.diag(noise.outputs**2)
    open_loop = Predictor(np.zeros((len(initial), len(noise.outputs))), np.diag(1.0 / noise.outputs))
    if not (noise.inputs.any() or noise.states.any()) or len(excitation.inputs) < 2:
        return open_loop
    transition, output, process = _linearised(kernel, parameters, initial, excitation, noise)
    covariance = steady_covariance(transition, output, process, sensor)
    innovation = output @ covariance @ output.T + sensor
    if not np.isfinite(innovation).all():
        return open_loop
    gain = np.linalg.solve(innovation, output @ covariance).T
    gained: Array = np.asarray(gain, dtype=np.float64)
    return Predictor(gained, np.asarray(np.linalg.inv(np.linalg.cholesky(innovation)), dtype=np.float64))


def _linearised(
    kernel: Kernel, parameters: Array, initial: Array, excitation: Excitation, noise: Noise
) -> tuple[Array, Array, Array]:
    """Transition (states, states), output (outputs, states) and process covariance (states, states) of one record."""
    count = len(parameters)
    middle = len(excitation.inputs) // 2
    there = kernel.sensitivities(parameters, initial, replace(excitation, inputs=excitation.inputs[: middle + 1])).last
    start = there if np.isfinite(there).all() else initial
    step = replace(excitation, inputs=excitation.inputs[[middle, middle]])
    found = kernel.sensitivities(parameters, start, step)
    process = np.diag(noise.states**2 * excitation.sample_period)
    for index in np.flatnonzero(noise.inputs):
        nudged = step.inputs.copy()
        nudged[:, index] += noise.inputs[index]
        effect = kernel.sensitivities(parameters, start, replace(step, inputs=nudged)).last - found.last
        process = process + np.outer(effect, effect)
    return found.last_slopes[:, count:], found.slopes[0][:, count:], process


def steady_covariance(transition: Array, output: Array, process: Array, sensor: Array) -> Array:
    """The covariance of the predicted state that the Riccati equation settles on, by structure-preserving doubling.

    (B. D. O. Anderson, J. B. Moore, Optimal Filtering, section 6.7.) Unlike a solver of the algebraic equation it also
    copes with states that nothing disturbs.
    """
    identity = np.eye(len(transition))
    alpha, beta, gamma = transition.T, output.T @ np.linalg.solve(sensor, output), process
    for _ in range(ITERATIONS):
        inner = np.linalg.inv(identity + beta @ gamma)
        grown = gamma + alpha.T @ gamma @ inner @ alpha
        beta = beta + alpha @ inner @ beta @ alpha.T
        alpha = alpha @ inner @ alpha
        settled = np.abs(grown - gamma).max() <= SETTLED * np.abs(grown).max()
        gamma = 0.5 * (grown + grown.T)
        if settled:
            break
    return gamma
