"""A window as it would have been recorded if some of its signals had other delays, and which delays are tried.

Each sample moves in time with its value; nothing measured is interpolated. Inputs are evaluated at the new records by
their hold. ``docs/explanation/delays.md`` has the equations.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from otolith.acquisition.time_grid import TimeGrid
from otolith.acquisition.window import Array, BridgeError, Mask, Window
from otolith.twin.definition import Definition

# Values, units, origins and guarding tests: docs/reference/thresholds-estimation.md.
SAME_RECORD_STEPS = 1e-6  # mean steps: times that differ by less are one record
MAX_DELAY, MAX_DELAY_SHARE = 0.2, 0.125  # s, and of a window: largest delay that is searched
DELAY_RATIO = 1.5  # between two delays that are tried; the first is half a record


def largest_delay(length: float) -> float:
    """Return the largest delay, s, that is searched in a window of ``length`` s."""
    return min(MAX_DELAY, MAX_DELAY_SHARE * length)


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
    length, tolerance = window.grid.length, SAME_RECORD_STEPS * window.sample_period
    of_inputs = [delays.get(driven.name, 0.0) for driven in twin.inputs]
    start, end = max([0.0, *(-delay for delay in of_inputs)]), length - max([0.0, *of_inputs])
    distinct = sorted({delays.get(signal, 0.0) for signal in window.signals})
    times = np.sort(np.concatenate([window.grid.offsets - delay for delay in distinct]))
    times = times[(times >= start - tolerance) & (times < end - tolerance)]
    if not len(times):
        return window
    times = times[np.concatenate([[True], np.diff(times) > tolerance])]
    grid = _grid(times, end, tolerance)
    values, missing, errors = [], [], []
    holds = {driven.name: driven.hold for driven in twin.inputs}
    for signal in window.signals:
        own = window.grid.offsets - delays.get(signal, 0.0)
        before = np.clip(np.searchsorted(own, times + tolerance, side="right") - 1, 0, len(own) - 1)
        fresh = (np.abs(times - own[before]) <= tolerance) & ~window.missing_in(signal)[before]
        value = window.column(signal)[before]
        if holds.get(signal) == "foh":
            value = np.where(
                np.abs(times - own[before]) > tolerance, np.interp(times, own, window.column(signal)), value
            )
        values.append(value)
        missing.append(~fresh)
        errors.append(_bridge_error(window, signal, before, grid.steps))
    error = BridgeError(*(np.column_stack(columns) for columns in zip(*errors, strict=True)))
    whole = replace(window, start=window.start + float(times[0]), grid=grid)
    return replace(whole, values=np.column_stack(values), missing=np.column_stack(missing), bridge_error=error)


def _grid(times: Array, end: float, tolerance: float) -> TimeGrid:
    offsets, length = times - times[0], end - float(times[0])
    step = length / len(times)
    if np.abs(offsets - step * np.arange(len(times))).max() <= tolerance:
        return TimeGrid.uniform(len(times), step)
    return TimeGrid.at(offsets, length)


def _bridge_error(
    window: Window, signal: str, before: "np.ndarray[tuple[int], np.dtype[np.intp]]", steps: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the error of a signal at the new records: the same noise lasts as long as before."""
    old, error = window.grid.steps, window.bridge_error
    if error is None:
        none = np.zeros(len(steps))
        return np.maximum(old[before], steps) / steps, none, none, none
    column = window.signals.index(signal)
    ratio, variance, held = (part[:, column] for part in (error.noise_ratio, error.variance, error.held_variance))
    spacing = np.maximum((ratio * old)[before], steps)
    duration = np.divide(held * old, variance, out=np.zeros(len(old)), where=variance > 0.0)[before]
    change = error.expected_change[:, column][before]
    return spacing / steps, variance[before], variance[before] * np.maximum(1.0, duration / steps), change


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
