"""Delays of signals: windows as other delays would give them, and how innovations depend on a delay.

A command that changes between its samples is late by another time at each change.

Each sample moves in time with its value; nothing measured is interpolated. Inputs are evaluated at the new records by
their hold. ``docs/explanation/delays.md`` has the equations.
"""

from collections.abc import Collection, Mapping
from dataclasses import fields, replace

import numpy as np

from otolith.acquisition.bridging import NOTHING_LOST, InputKind, InputSamples, bridge
from otolith.acquisition.samples import Series, interval_of
from otolith.acquisition.window import Array, BridgeError, Mask, TimeGrid, Window
from otolith.estimation.objective import Objective
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, Indices

# Values, units, origins and guarding tests: docs/reference/thresholds-estimation.md.
SAME_RECORD_STEPS = 1e-6  # mean steps: times that differ by less are one record
MAX_DELAY, MAX_DELAY_RECORDS, MAX_DELAY_SHARE = 0.2, 20, 0.125  # s or records, and of a window: largest one searched
DELAY_RATIO = 1.5  # between two delays that are tried; the first is half a record
SLOPE_SHARE = 0.02  # of a step: length of the difference before a record that gives the slope of an output
PROBE = 1e-3  # of the mean step: delay of the finite difference


def largest_delay(length: float, period: float) -> float:
    """Return the largest delay, s, that is searched in a window of ``length`` s with a record every ``period`` s."""
    return min(max(MAX_DELAY, MAX_DELAY_RECORDS * period), MAX_DELAY_SHARE * length)


def trial_delays(period: float, limit: float) -> Array:
    """Return delays (delays,) of both signs, s, from half a ``period`` up to ``limit``, which is the last pair."""
    count = np.ceil(np.log(max(2.0 * limit / period, 1.0)) / np.log(DELAY_RATIO))
    grid = 0.5 * period * DELAY_RATIO ** np.arange(count)
    return np.concatenate([grid, -grid, [limit, -limit]])


def shifted(twin: Definition, window: Window, delays: Mapping[str, float]) -> Window:
    """Return the window with the samples of each signal ``delays[signal]`` s earlier; a negative delay is later.

    Where an input would have to come from outside of the window, the window becomes shorter. A window that is too short
    for the delays is returned as it is.
    """
    if not any(delays.values()):
        return window
    tolerance = SAME_RECORD_STEPS * window.sample_period
    of_inputs = [delays.get(driven.name, 0.0) for driven in twin.inputs]
    start, end = max([0.0, *(-delay for delay in of_inputs)]), window.grid.length - max([0.0, *of_inputs])
    times = _record_times(window, {delays.get(signal, 0.0) for signal in window.signals}, (start, end))
    if not len(times):
        return window
    grid = _grid(times, end, tolerance)
    late = [delays.get(signal, 0.0) for signal in window.signals]
    last = {delay: _last_samples(window.grid.offsets - delay, times, tolerance) for delay in set(late)}
    before = np.column_stack([last[delay][0] for delay in late])
    is_between = np.column_stack([last[delay][1] for delay in late])
    rows = before, np.arange(len(late))
    values, missing = window.values[rows], is_between | window.missing[rows]
    for driven in twin.inputs:
        column = window.signals.index(driven.name)
        between = is_between[:, column]
        if driven.hold == "foh" and between.any():
            sampled = window.grid.offsets - late[column]
            values[between, column] = np.interp(times[between], sampled, window.values[:, column])
    error = _bridge_error(window, before, grid.steps[:, None])
    start = window.start + float(times[0])
    return replace(window, start=start, grid=grid, values=values, missing=missing, bridge_error=error)


def _last_samples(sampled: Array, times: Array, tolerance: float) -> tuple[Indices, Mask]:
    """Return which of the times ``sampled`` is the last up to each of ``times``, and whether the two differ."""
    before = np.clip(np.searchsorted(sampled, times + tolerance, side="right") - 1, 0, len(sampled) - 1)
    return before, np.abs(times - sampled[before]) > tolerance


def _record_times(window: Window, delays: Collection[float], ends: tuple[float, float]) -> Array:
    """Return the times (records,) at which a signal with one of the ``delays`` has a sample, between the ``ends``."""
    tolerance = SAME_RECORD_STEPS * window.sample_period
    times = np.sort(np.concatenate([window.grid.offsets - delay for delay in sorted(delays)]))
    times = times[(times >= ends[0] - tolerance) & (times < ends[1] - tolerance)]
    is_first = np.diff(times, prepend=-np.inf) > tolerance  # of those that are one record
    return np.asarray(times[is_first])


def _grid(times: Array, end: float, tolerance: float) -> TimeGrid:
    offsets, length = times - times[0], end - float(times[0])
    step = length / len(times)
    if np.abs(offsets - step * np.arange(len(times))).max() <= tolerance:
        return TimeGrid.uniform(len(times), step)
    return TimeGrid.at(offsets, length)


def _bridge_error(window: Window, before: Indices, steps: Array) -> BridgeError:
    """Return the errors at the new records, whose ``steps`` are (records, 1): the same noise lasts as long as before.

    ``before`` (records, signals) are the old records of their samples.
    """
    old, error, rows = window.grid.steps[:, None], window.bridge_error, (before, np.arange(before.shape[1]))
    if error is None:
        none = np.zeros(before.shape)
        return BridgeError(np.maximum(window.grid.steps[before], steps) / steps, none, none, none)
    spacing, variance = np.maximum((error.noise_ratio * old)[rows], steps), error.variance[rows]
    lasting = np.zeros(error.variance.shape)
    np.divide(error.held_variance * old, error.variance, out=lasting, where=error.variance > 0.0)
    held = variance * np.maximum(1.0, lasting[rows] / steps)
    return BridgeError(spacing / steps, variance, held, error.expected_change[rows])


def with_changes_between(window: Window, commands: Collection[str]) -> Window:
    """Return the window with ``commands`` that may change at any time between two of their samples, as polled ones."""
    grid, values = window.grid, window.values.copy()
    before = window.bridge_error or BridgeError(np.ones(values.shape), *(np.zeros(values.shape) for _ in range(3)))
    error = BridgeError(*(getattr(before, item.name).copy() for item in fields(before)))
    for name in commands:
        column, sampled = window.signals.index(name), ~window.missing_in(name)
        series = Series(grid.offsets[sampled], window.readings(name)[sampled])
        if len(series.times) < 2:
            continue
        samples = InputSamples(series, InputKind.POLLED, 0.0, interval_of(series.times), NOTHING_LOST)
        bridged = bridge(samples, grid.offsets, grid.steps)
        values[:, column] = bridged.values
        for item in fields(error):
            getattr(error, item.name)[:, column] = getattr(bridged.error, item.name)
    return replace(window, values=values, bridge_error=error)


def same_measurements(
    twin: Definition, window: Window, delays: Mapping[str, float], offset: float, between: tuple[float, float]
) -> Window:
    """Return a window shifted by ``delays``, with the outputs recorded ``between`` two times only.

    The times count from the start of the window before it was shifted; ``offset`` is how much later this one starts.
    Windows shifted by other delays then have the same measurements. The first and the last record have one.
    """
    missing = window.missing.copy()
    for output in twin.outputs:
        recorded = window.grid.offsets + offset + delays.get(output.name, 0.0)
        missing[:, window.signals.index(output.name)] |= (recorded < between[0]) | (recorded > between[1])
    present: Mask = ~np.column_stack([missing[:, window.signals.index(output.name)] for output in twin.outputs])
    kept = np.flatnonzero(present.any(axis=1))
    marked = replace(window, missing=missing)
    if not len(kept):
        return marked
    return marked.until(int(kept[-1]) + 1).since(int(kept[0]))


def delayable(twin: Definition) -> list[str]:
    """Return the signals of a base model in the order of :func:`delay_response`: outputs, then inputs."""
    return [*(output.name for output in twin.outputs), *(driven.name for driven in twin.inputs)]


def delay_response(objective: Objective, guess: Array) -> Array:
    """Return the derivatives (residuals, outputs + inputs) of the whitened innovations by each delay, per second.

    A signal that is late shows at time t what was true before. Taken back, an output is ``y(t) + delay · dy/dt``, an
    input ``u(t) + delay · du/dt``. The slope of an output is that of the prediction: that of the measurement is noise.
    ``guess`` (free + states,) as in :class:`Objective`. A derivative that is not finite is zero.
    """
    parameters, initial = objective.parameters(guess[None]), guess[None, objective.free :]
    kernel, excitation = objective.kernel, objective.excitation
    measured, inputs = objective.measured, excitation.inputs
    probe = PROBE * excitation.grid.mean_step

    def residuals(moved: Array, driven: Array) -> Array:
        shown = replace(excitation, inputs=driven, measured=np.where(objective.present, moved, np.nan))
        innovations = np.where(objective.present, moved - kernel.simulate(parameters, initial, shown)[0], 0.0)
        return np.asarray(np.einsum("rop,rp->ro", objective.whitening, innovations).ravel())

    with np.errstate(over="ignore", invalid="ignore"):
        here = residuals(measured, inputs)
        columns = []
        for slope, index in zip(output_slopes(objective, guess).T, range(measured.shape[1]), strict=True):
            moved = measured.copy()
            moved[:, index] += probe * slope
            columns.append(residuals(moved, inputs))
        for slope, index in zip(input_slopes(objective).T, range(inputs.shape[1]), strict=True):
            driven = inputs.copy()
            driven[:, index] += probe * slope
            columns.append(residuals(measured, driven))
        derivatives = (np.array(columns) - here).T / probe
    return np.where(np.isfinite(derivatives).all(axis=0), derivatives, 0.0)


def output_slopes(objective: Objective, guess: Array) -> Array:
    """Return the slopes (records, outputs) of the prediction just before each record, in units per second."""
    excitation, grid = objective.excitation, objective.excitation.grid
    if grid.records < 2:
        return np.zeros(objective.measured.shape)
    count, before = grid.records, grid.offsets[1:] - SLOPE_SHARE * np.diff(grid.offsets)
    times = np.concatenate([grid.offsets, before])
    order = np.argsort(times, kind="stable")
    is_record = order < count
    record = np.concatenate([np.arange(count), np.arange(count - 1)])[order]  # in whose step a time lies
    inputs, following = excitation.inputs[record], excitation.inputs[np.minimum(record + 1, count - 1)]
    held = [driven.hold == "zoh" for driven in objective.kernel.definition.inputs]
    between = np.where(held, inputs, inputs + (1.0 - SLOPE_SHARE) * (following - inputs))
    gain, measured = excitation.gain, excitation.measured
    finer = Excitation(
        np.where(is_record[:, None], inputs, between),
        TimeGrid.at(times[order], grid.length),
        excitation.substeps,
        None if measured is None else np.where(is_record[:, None], measured[record], np.nan),
        None if gain is None else np.where(is_record[:, None, None], gain[record], 0.0),
    )
    predicted = objective.kernel.simulate(objective.parameters(guess[None]), guess[None, objective.free :], finer)[0]
    rise = predicted[is_record][1:] - predicted[~is_record]
    slopes = rise / (SLOPE_SHARE * np.diff(grid.offsets))[:, None]
    return np.concatenate([slopes[:1], slopes])


def input_slopes(objective: Objective) -> Array:
    """Return the slopes (records, inputs) of the inputs, in units per second.

    A command that changes between two records changes the mean of a step by the share of the step. The mean of the
    steps before and after is taken, as a delay may be too large or too small.
    """
    grid, inputs = objective.excitation.grid, objective.excitation.inputs
    slopes = np.zeros(inputs.shape)
    if grid.records < 2:
        return slopes
    change = np.diff(inputs, axis=0)
    for index, driven in enumerate(objective.kernel.definition.inputs):
        if driven.name.startswith("_"):  # of the slots for components
            continue
        if driven.hold == "zoh":
            slopes[:-1, index] += 0.5 * change[:, index] / grid.steps[:-1]
            slopes[1:, index] += 0.5 * change[:, index] / grid.steps[1:]
        else:
            slopes[:, index] = np.gradient(inputs[:, index], grid.offsets)
    return slopes
