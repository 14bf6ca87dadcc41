"""Cramér-Rao bound of the samples that a window has, and the error of the estimate that reaches it.

The Fisher information comes from numerical derivatives of the exact plant by the free parameters and by the state at
the start of the window, which is a nuisance without a prior. Inputs that the samples do not fix are Gaussian nuisances
as well: noise of the load torque, the load torque as a random walk between its samples, and the time of a voltage
change whose row is missing. Their effect on the outputs is a dense covariance beside the noise of the sensors.

The efficient estimate is the linear one at the truth. Its error in a window comes from the same noise as that of the
twin's estimate, so both share what chance does to their coverage.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from benchmarks.sampling.plant import WALK, Inputs, Motor, load_response, simulate
from benchmarks.sampling.schedules import NOISE, OUTPUTS, Recording
from otolith.acquisition.window import Array, Mask

STEP = 1e-4  # relative step of the numerical derivatives
KNOWN_LOAD = 1e-9  # N·m: standard deviation of a sample without noise
UNKNOWN_LEVEL = 1.0  # N·m: standard deviation of the load torque before its samples


@dataclass(frozen=True, slots=True)
class EfficientEstimate:
    """What the samples of a window allow; arrays are (free,)."""

    bound: Array
    """Smallest standard deviation of an unbiased estimate; infinite where the samples do not determine it."""
    error: Array
    """Error of the estimate that reaches it, in this window; NaN without."""


def efficient_estimate(recording: Recording, start: float, end: float, free: Sequence[str]) -> EfficientEstimate:
    """Return the bound of each free parameter from the samples in [start, end) s, and what reaches it."""
    nothing = EfficientEstimate(np.full(len(free), np.inf), np.full(len(free), np.nan))
    times, values = _samples_of(recording, start, end)
    count = sum(map(len, times))
    if count < len(free) + 2:
        return nothing
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
    unknown, load_error = _load(recording, times, start, end)
    unexpected = np.concatenate(values) - truth + load_error
    for possible in _possible_inputs(recording, start, end):
        effects = np.array([outputs(recording.motor, state, inputs) for inputs in possible]) - truth
        unexpected -= effects.mean(axis=0)
        covariance = np.cov(effects, rowvar=False, bias=True)
        unknown = covariance if unknown is None else unknown + covariance
    weighted = _weighted(jacobian, sensors, unknown)
    fisher = jacobian.T @ weighted
    scale = np.sqrt(np.diag(fisher))
    if not (scale > 0.0).all() or np.linalg.cond(fisher / np.outer(scale, scale)) > 1e12:
        return nothing
    inverse = np.linalg.inv(fisher)
    nominal = np.array([getattr(recording.motor, name) for name in free])
    error = inverse @ (weighted.T @ unexpected)
    return EfficientEstimate(np.sqrt(np.diag(inverse))[: len(free)] * nominal, error[: len(free)] * nominal)


def _weighted(jacobian: Array, sensors: Array, unknown: Array | None) -> Array:
    """Return the inverse of the covariance times the derivatives; ``unknown`` is what inputs add to that of sensors."""
    if unknown is None:
        return np.asarray(jacobian / sensors[:, None] ** 2)
    return np.asarray(cho_solve(cho_factor(np.diag(sensors**2) + unknown), jacobian))


def _samples_of(recording: Recording, start: float, end: float) -> tuple[list[Array], list[Array]]:
    """Return true times and values of the fresh samples of each output whose stated times are in [start, end)."""
    samples = [recording.samples[name] for name in OUTPUTS]
    inside = [own.fresh & (own.stated >= start) & (own.stated < end) & (own.times >= start) for own in samples]
    pairs = list(zip(samples, inside, strict=True))
    return [own.times[part] for own, part in pairs], [own.values[part] for own, part in pairs]


def _load(recording: Recording, times: Sequence[Array], start: float, end: float) -> tuple[Array | None, Array]:
    """Return covariance and true value of what the load torque adds to the outputs beyond what its samples show.

    The covariance is None where they show all of it.
    """
    if not recording.load_noise and not recording.walk:
        return None, np.zeros(sum(map(len, times)))
    knots, loads = recording.inputs.load_times, recording.inputs.loads
    near = (knots >= start - 0.1) & (knots <= end + 0.1)
    effect = load_effect(recording.motor, knots[near], times, start)
    mean, covariance = _knots(recording, knots[near])
    return effect @ covariance @ effect.T, effect @ (loads[near] - mean)


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


def _knots(recording: Recording, knots: Array) -> tuple[Array, Array]:
    """Return mean and covariance of the load torque at ``knots``, given its samples; samples are at knots."""
    sample = recording.samples["T_load"]
    seen: Mask = np.isin(knots, sample.times)
    precision = np.zeros((len(knots), len(knots)))
    precision[0, 0] = UNKNOWN_LEVEL**-2
    for index, length in enumerate(np.diff(knots)):
        weight = 1.0 / (WALK**2 * length)
        precision[index : index + 2, index : index + 2] += weight * np.array([[1.0, -1.0], [-1.0, 1.0]])
    own = max(recording.load_noise, KNOWN_LOAD) ** -2
    precision[seen, seen] += own
    covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
    return covariance[:, seen] @ (own * sample.values[np.isin(sample.times, knots)]), covariance


def _possible_inputs(recording: Recording, start: float, end: float) -> Iterator[list[Inputs]]:
    """Yield for each voltage change of unknown time the inputs with it at each time at which it can have been."""
    times = recording.inputs.voltage_times
    for index, choices in enumerate(recording.possible_changes):
        if len(choices) < 2 or choices[-1] <= start or choices[0] >= end:
            continue
        low = times[index - 1] if index else -np.inf  # the order of the changes stays
        high = times[index + 1] if index + 1 < len(times) else np.inf
        moved = [times.copy() for _ in choices]
        for own, choice in zip(moved, np.clip(choices, low, high), strict=True):
            own[index] = choice
        yield [replace(recording.inputs, voltage_times=own) for own in moved]
