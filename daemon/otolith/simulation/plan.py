"""Planned inputs, and recorded ones, as the window that drives a simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, BridgeError, Quality, TimeGrid, Verdict, Window
from otolith.twin.definition import Definition

WHOLE = 1e-6  # of a sample period: a step between two rows that is longer by less needs no record within it
UNIFORM = 1e-6  # of a step: how much the steps of a uniform grid may differ, as times in a file are rounded
MAX_RECORDS = 1_000_000  # of a simulation; docs/reference/thresholds-simulation.md has its origin


def planned_window(twin: Definition, times: Array, columns: Mapping[str, Array], period: float, start: float) -> Window:
    """Return planned inputs as a window that begins at ``start`` (s, on the clock of the windows).

    ``times`` (rows,) rise; ``columns`` has the values (rows,) of each input of ``twin``, all finite. Between two rows
    that are more than a sample ``period`` apart there are records as well, so that outputs are predicted there. A
    command (``zoh``) keeps its value until the next row, other inputs go there along a line.

    Raises:
        ValueError: too many records, or fewer than two rows.
    """
    if len(times) < 2:
        raise ValueError("one row: a plan needs the times of two rows at least, the last of which is its end")
    parts = np.maximum(np.ceil(np.diff(times) / period - WHOLE), 1.0)
    if parts.sum() >= MAX_RECORDS:
        most = f"at most {MAX_RECORDS} are simulated: shorten it"
        raise ValueError(f"{times[-1] - times[0]:.6g} s at {period:g} s are {parts.sum() + 1.0:.0f} records: {most}")
    counts = parts.astype(np.int64)
    before = np.repeat(np.arange(len(counts)), counts)  # the row before each record but the last
    within = np.arange(len(before)) - np.repeat(np.cumsum(counts) - counts, counts)
    between = times[before] + within * (np.diff(times) / parts)[before]
    offsets = np.append(between, times[-1]) - times[0]
    values = np.full((len(offsets), len(twin.signals)), np.nan)
    for driven in twin.inputs:
        column = np.asarray(columns[driven.name])
        held = np.append(column[before], column[-1])
        values[:, twin.signals.index(driven.name)] = (
            held if driven.hold == "zoh" else np.interp(offsets, times - times[0], column)
        )
    missing = np.ones(values.shape, dtype=np.bool_)
    return Window(0, start, _grid(offsets, period), twin.signals, values, missing, Quality(Verdict.GOOD, 0, 0, 0, 0))


def _grid(offsets: Array, period: float) -> TimeGrid:
    """Return the grid of records at ``offsets``, uniform if they are; the last record counts as a ``period``."""
    steps = np.diff(offsets)
    mean = float(offsets[-1]) / len(steps)
    if np.abs(steps - mean).max() <= UNIFORM * mean:
        return TimeGrid.uniform(len(offsets), mean)
    return TimeGrid.at(offsets, float(offsets[-1]) + period)


def follows(window: Window, before: Window) -> bool:
    """Whether there is no gap between a window and the one before."""
    return abs(window.start - before.end) <= 0.5 * window.sample_period


def joined(windows: Sequence[Window]) -> Window:
    """Return windows that follow one another as one; those after the first gap are left out."""
    kept = [windows[0]]
    for window in windows[1:]:
        if not follows(window, kept[-1]):
            break
        kept.append(window)
    first = kept[0]
    if len({window.grid.period for window in kept}) == 1 and first.grid.period is not None:
        grid = TimeGrid.uniform(sum(window.records for window in kept), first.grid.period)
    else:
        offsets = np.concatenate([window.start - first.start + window.grid.offsets for window in kept])
        grid = TimeGrid.at(offsets, kept[-1].end - first.start)
    values, missing = (np.concatenate([getattr(window, name) for window in kept]) for name in ("values", "missing"))
    return replace(first, grid=grid, values=values, missing=missing, bridge_error=_joined_errors(kept))


def _joined_errors(windows: Sequence[Window]) -> BridgeError | None:
    """Return the errors of bridged inputs of all ``windows``; of one without any they are zero."""
    if all(window.bridge_error is None for window in windows):
        return None
    errors = []
    for window in windows:
        none = np.zeros(window.values.shape)
        errors.append(window.bridge_error or BridgeError(none + 1.0, none, none, none))
    names = ("noise_ratio", "variance", "held_variance", "expected_change")
    return BridgeError(*(np.concatenate([getattr(error, name) for error in errors]) for name in names))
