"""Cramér-Rao bound of the samples that a window has: the smallest standard deviation of an unbiased estimate.

The Fisher information comes from numerical derivatives of the exact plant by the free parameters and by the state at
the start of the window, which is a nuisance without a prior. Inputs that the samples do not fix are Gaussian nuisances
as well: noise of the load torque, the load torque as a random walk between its samples, and the time of a voltage
change whose row is missing. Their effect on the outputs is a dense covariance beside the noise of the sensors.

A slow load torque is a straight line between its samples. The bound uses this, though the samples do not show it:
``cases.WIDER_SPREAD`` lists the parameters of which no estimate can therefore reach it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from benchmarks.sampling.plant import WALK, Inputs, Motor, load_response, simulate
from benchmarks.sampling.schedules import NOISE, OUTPUTS, Recording
from otolith.acquisition.window import Array, Mask

STEP = 1e-4  # relative step of the numerical derivatives
KNOWN_LOAD = 1e-9  # N·m: standard deviation of a sample without noise
UNKNOWN_LEVEL = 1.0  # N·m: standard deviation of the load torque before its samples


def lower_bounds(recording: Recording, start: float, end: float, free: Sequence[str]) -> Array:
    """Return the bound of the standard deviation of each free parameter from the samples in [start, end) s: (free,).

    It is infinite where they do not determine the parameters.
    """
    times = _times_of(recording, start, end)
    count = sum(map(len, times))
    if count < len(free) + 2:
        return np.full(len(free), np.inf)
    union = np.unique(np.concatenate(times))
    state = simulate(recording.motor, recording.initial, 0.0, recording.inputs, np.array([start]))[0]

    def outputs(motor: Motor, initial: Array, inputs: Inputs) -> Array:
        states = simulate(motor, initial, start, inputs, union)
        return np.concatenate([states[np.searchsorted(union, own), column] for column, own in enumerate(times)])

    columns = []
    for name in free:
        value = float(getattr(recording.motor, name))
        up, down = (replace(recording.motor, **{name: value * (1.0 + sign * STEP)}) for sign in (1.0, -1.0))
        difference = outputs(up, state, recording.inputs) - outputs(down, state, recording.inputs)
        columns.append(difference / (2.0 * STEP))  # by the relative change
    truth = outputs(recording.motor, state, recording.inputs)
    columns += [outputs(recording.motor, state + unit, recording.inputs) - truth for unit in np.eye(2)]
    jacobian = np.column_stack(columns)
    sensors = np.concatenate([np.full(len(own), NOISE[name]) for name, own in zip(OUTPUTS, times, strict=True)])
    late = [outputs(recording.motor, state, inputs) - truth for inputs in _late_changes(recording, start, end)]
    covariance = _load_covariance(recording, times, start, end) + sum(np.outer(effect, effect) for effect in late)
    fisher = _fisher(jacobian, sensors, covariance)
    scale = np.sqrt(np.diag(fisher))
    if not (scale > 0.0).all() or np.linalg.cond(fisher / np.outer(scale, scale)) > 1e12:
        return np.full(len(free), np.inf)
    values = np.array([getattr(recording.motor, name) for name in free])
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(fisher)))[: len(free)] * values)


def _fisher(jacobian: Array, sensors: Array, covariance: Array | float) -> Array:
    """Return the information of outputs with independent noise ``sensors`` (outputs,) beside ``covariance``."""
    if np.ndim(covariance) == 0:
        whitened = jacobian / sensors[:, None]
        return np.asarray(whitened.T @ whitened)
    return np.asarray(jacobian.T @ cho_solve(cho_factor(np.diag(sensors**2) + covariance), jacobian))


def _times_of(recording: Recording, start: float, end: float) -> list[Array]:
    """Return the true times of the fresh samples of each output whose stated times are in [start, end)."""
    samples = [recording.samples[name] for name in OUTPUTS]
    parts = [own.times[own.fresh & (own.stated >= start) & (own.stated < end)] for own in samples]
    return [part[part >= start] for part in parts]


def _load_covariance(recording: Recording, times: Sequence[Array], start: float, end: float) -> Array | float:
    """Return the covariance of the outputs from what the samples leave open of the load torque."""
    if not recording.load_noise and not recording.walk:
        return 0.0
    knots = recording.inputs.load_times
    near = (knots >= start - 0.1) & (knots <= end + 0.1)
    effect = load_effect(recording.motor, knots[near], times, start)
    return np.asarray(effect @ _knot_covariance(recording, knots[near]) @ effect.T)


def load_effect(motor: Motor, knots: Array, times: Sequence[Array], start: float) -> Array:
    """Return the change of the outputs at ``times`` per change of the load at each knot: (outputs, knots).

    The load is linear between the knots, and the states at ``start`` are given.
    """

    def responses(origins: Array, *, ramp: bool) -> Array:
        elapsed = [own[:, None] - np.maximum(origins, start) for own in times]
        return np.vstack([load_response(motor, own, ramp=ramp)[column] for column, own in enumerate(elapsed)])

    ramps, slopes = responses(knots, ramp=True), 1.0 / np.diff(knots)
    parts = slopes * (ramps[:, :-1] - ramps[:, 1:])  # of a change by one in each segment; none before the start
    effect = np.zeros(ramps.shape)
    effect[:, 1:] += parts
    effect[:, :-1] -= parts
    shares = np.array([np.interp(start, knots, unit) for unit in np.eye(len(knots))])  # of each knot in the level
    levels: Array = responses(np.full(1, start), ramp=False)
    return np.asarray(effect + levels * shares)


def _knot_covariance(recording: Recording, knots: Array) -> Array:
    """Return the covariance of the load torque at ``knots``, given its samples; samples are at knots."""
    sample = recording.samples["T_load"]
    seen: Mask = np.isin(knots, sample.times)
    precision = np.zeros((len(knots), len(knots)))
    precision[0, 0] = UNKNOWN_LEVEL**-2
    for index, length in enumerate(np.diff(knots)):
        weight = 1.0 / (WALK**2 * length)
        precision[index : index + 2, index : index + 2] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
    precision[seen, seen] += max(recording.load_noise, KNOWN_LOAD) ** -2
    return np.asarray(np.linalg.inv(precision))


def _late_changes(recording: Recording, start: float, end: float) -> list[Inputs]:
    """Return the inputs with each voltage change of unknown time later by one standard deviation of it."""
    inputs = recording.inputs
    times, uncertainty = inputs.voltage_times, recording.change_sd
    changed = []
    for index in np.flatnonzero((uncertainty > 0.0) & (times > start) & (times < end)):
        later = times.copy()
        later[index] += uncertainty[index]
        if index + 1 < len(times):  # the order of the changes stays
            later[index] = min(later[index], times[index + 1] - 1e-6)
        changed.append(replace(inputs, voltage_times=later))
    return changed
