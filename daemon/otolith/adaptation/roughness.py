"""Where the search for levels of noise begins: what the signals themselves tell before any twin is fitted."""

from collections.abc import Sequence

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.likelihood import noisy
from otolith.adaptation.objective import Objective
from otolith.adaptation.problem import Problem

ORDER = 4  # of the differences: a signal that a cubic follows over five records is gone
GAIN = np.sqrt(70.0)  # of fourth differences for white noise: the root of 1 + 16 + 36 + 16 + 1
MEDIAN = 0.6745  # of the absolute value of a normal deviate
DECADES = range(-14, 3)  # of process noise, in widths of the state's bounds
FELT = np.log(2.0)  # of an innovation's variance: process noise adds as much as was there
HALVINGS = 3


def sensor_levels(problem: Problem, windows: Sequence[Window]) -> Array:
    """(outputs,) standard deviation of what changes from record to record; 0 where nothing does, NaN without samples.

    An upper estimate if the machine itself is as quick as that.
    """
    return np.array([_rough(entry.name, windows) for entry in problem.twin.outputs])


def _rough(output: str, windows: Sequence[Window]) -> float:
    found = []
    for window in windows:
        missing, values = window.missing_in(output), window.column(output)
        holes = np.convolve(missing, np.ones(ORDER + 1))[ORDER : len(values)] > 0.5
        differences = np.diff(values, ORDER)[~holes] / GAIN
        if len(differences):
            typical = float(np.median(np.abs(differences))) / MEDIAN
            found.append(typical or float(np.std(differences)))
    return float(np.median(found)) if found else float("nan")


def felt_levels(problem: Problem, outputs: Array, window: Window) -> Array:
    """(states,) process noise that doubles the variance of the innovations; NaN where none does.

    With much less, the noise of the sensors (outputs,) hides it.
    """
    states = problem.twin.states
    quiet = np.concatenate([outputs, np.zeros(len(states))])
    least = _uncertainty(problem, quiet, window) + FELT

    def is_felt(index: int, decade: float) -> bool:
        levels = quiet.copy()
        levels[len(outputs) + index] = (states[index].high - states[index].low) * 10.0**decade
        return bool(_uncertainty(problem, levels, window) >= least)

    found = np.full(len(states), np.nan)
    for index, state in enumerate(states):
        decade = next((float(decade) for decade in DECADES if is_felt(index, decade)), None)
        if decade is None:
            continue
        low, high = decade - 1.0, decade
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if is_felt(index, middle) else (middle, high)
        found[index] = (state.high - state.low) * 10.0**high
    return found


def _uncertainty(problem: Problem, levels: Array, window: Window) -> float:
    """Mean logarithm of the innovations' variances."""
    objective = Objective(noisy(problem, levels), window, problem.nominal)
    return objective.correction.log_determinant / objective.count
