"""The state from which a simulation begins, and how well it is known: that of the last record of the last window."""

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.posterior import Posterior
from otolith.twin.kernel import Kernel

DIFFERENCE = 1e-6  # relative step of the central differences


def last_state(posterior: Posterior) -> Array:
    """Return the state (states,) at the last record of the last window; angles of components count from there.

    Raises:
        ValueError: no window has shown it yet.
    """
    known = () if posterior.phase is None else posterior.phase.last_state
    if not known:
        raise ValueError("no window has been learned from yet, so the state of the machine is not known")
    added = len(posterior.problem.twin.states) - len(known)
    return np.concatenate([known, np.zeros(added)])


def state_covariance(posterior: Posterior, kernel: Kernel, parameters: Array, inputs: Array, substeps: int) -> Array:
    """Return the covariance (states, states) with which the Kalman filter knows that state after a window.

    The twin is linearised there, with ``parameters`` (parameters,) and the ``inputs`` (inputs,) of the first record. A
    problem without a sample period has no window, so one record is all that is known of its states.
    """
    problem = posterior.problem
    twin, period = problem.base_model, problem.window.sample_period or 0.0
    own, state = len(twin.states), last_state(posterior)
    reach = np.array([0.5 * (item.high - item.low) for item in twin.states])
    steps = DIFFERENCE * np.maximum(np.abs(state), np.pad(reach * DIFFERENCE, (0, len(state) - own)) + DIFFERENCE)
    shifted = np.concatenate([state + np.diag(steps)[:own], state - np.diag(steps)[:own]])
    noise = np.array(problem.input_noise or [0.0] * len(twin.inputs))
    noisy = np.tile(inputs, (2 * len(noise), 1))
    noisy[: len(noise), : len(noise)] += np.diag(noise)
    noisy[len(noise) :, : len(noise)] -= np.diag(noise)
    states = np.concatenate([shifted, np.tile(state, (len(noisy), 1))])
    driving = np.concatenate([np.tile(inputs, (len(shifted), 1)), noisy])
    rows = np.tile(parameters, (len(states), 1))
    outputs, final = kernel.ensemble(rows, states, driving, driving, period, substeps)
    slopes = 0.5 / steps[:own, None]
    transition = ((final[:own] - final[own : 2 * own]) * slopes)[:, :own].T
    output = ((outputs[:own] - outputs[own : 2 * own]) * slopes).T
    by_inputs = 0.5 * (final[2 * own : 2 * own + len(noise)] - final[2 * own + len(noise) :])[:, :own].T
    disturbance = by_inputs @ by_inputs.T + period * np.diag(np.array(problem.process_noise or [0.0] * own) ** 2)
    sensors = np.diag(np.array(problem.noise) ** 2)
    covariance = np.diag(reach**2)
    for record in range(problem.window.records if period else 1):
        if record:
            covariance = transition @ covariance @ transition.T + disturbance
        crossed = covariance @ output.T
        gain = np.linalg.solve(output @ crossed + sensors, crossed.T).T
        kept = np.eye(own) - gain @ output  # Joseph form
        covariance = kept @ covariance @ kept.T + gain @ sensors @ gain.T
    whole = np.zeros((len(state), len(state)))
    whole[:own, :own] = covariance if np.isfinite(covariance).all() else np.diag(reach**2)
    return whole
