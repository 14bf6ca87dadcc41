"""The state from which a simulation begins, and how well it is known: that of the last record of the last window."""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import indices
from otolith.estimation.window_fit import fit_predicted
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


def after_window(posterior: Posterior, window: Window) -> Posterior:
    """Return the posterior with the state, and the phases of components, at the last record of ``window``.

    All other values keep what is known of them, also where the window contradicts it.

    Raises:
        ValueError: the twin diverges in the window.
    """
    predicted, problem = posterior.predict(window), posterior.problem
    starts = predicted.with_phases(predicted.start())
    best = min((fit_predicted(predicted, problem, window, start) for start in starts), key=lambda fit: fit.chi_square)
    advance = best.advance()
    if not advance.last_state:
        raise ValueError("the twin diverges")
    root = best.evidence().sqrt_information
    covariance = np.linalg.pinv(root.T @ root + np.linalg.pinv(predicted.prior().covariance))
    for slot, component in enumerate(problem.components):
        if component.periodic:
            phase = indices(problem, slot)[-1]
            sd = float(np.sqrt(max(covariance[phase, phase], 0.0)))
            predicted = predicted.reset_value(phase, float(best.parameters[phase]), sd)
    return replace(predicted, phase=advance)


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
