"""Sensors whose reading stays although what they measure moves: dead bands, coarse steps, speeds from edge times.

- A sensor with a **dead band** gives a new reading when the measured value has departed from the last one by more than
  the band. A reading that stays says that the value is within the band around it.
- A speed **from edge times** is renewed at each edge of an encoder, which comes after a certain distance: between two
  edges the reading stays, and at standstill the last one remains.

The samples that repeat such a reading have one error, so only the first of them counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array, Window
from otolith.twin.definition import Definition
from otolith.twin.expressions import dimension_of, names_in, parse

MIN_CHANGES = 5  # of a reading, from which on the least of them is a property of the sensor
CHANGE_NOISES = 2.0  # standard deviations of the noise: five changes above that come by chance once in 10 000 times
MIN_REPEATED_SHARE = 0.5  # of the samples that repeat the one before, from which on a sensor is one that stays
MIN_SHOWN_CHANGES = 20  # of a reading, from which on a sensor model is proposed
MAX_DISTANCE_SPREAD = 0.1  # median relative deviation of the distances between edges
MIN_WAIT_RATIO = 1.5  # between long and short times from edge to edge: at one speed any sensor looks alike
MIN_BAND_STEPS = 2.0  # between the nearest levels that a dead band is wider than: a coarse converter has its steps
RENEWED_DISTANCES = 3.0  # between edges, that a machine must have moved without one before a sensor is frozen


@dataclass(frozen=True, slots=True)
class SensorModel:
    """How the reading of a sensor follows what it measures, as a machine file states it; 0 for what is not stated."""

    resolution: float = 0.0  # Step of its converter, in the unit of the signal
    dead_band: float = 0.0  # By which the measured value departs from a reading before the next one, in the same unit
    renewed: float = 0.0  # Distance between two edges, in the unit of the signal times s

    @property
    def holds(self) -> bool:
        """Whether a reading stays between renewals, so that its repetitions are no readings of their own."""
        return self.dead_band > 0.0 or self.renewed > 0.0

    def step(self, values: Array, noise: float) -> float:
        """Return by how much ``values`` (samples,) may differ from what is measured, all in all, beside ``noise``."""
        return max(self.resolution, 2.0 * self.dead_band, least_change(values, noise))


def least_change(values: Array, noise: float) -> float:
    """Return the least change of a reading that mostly stays, as one with a dead band; 0 for any other sensor.

    The readings of a sensor with ``noise`` (standard deviation) change by any small amount.
    """
    changes = np.abs(np.diff(values))
    moved = changes[changes > 0.0]
    if len(moved) < MIN_CHANGES or len(moved) > (1.0 - MIN_REPEATED_SHARE) * len(changes):
        return 0.0
    least = float(moved.min())
    return least if least >= CHANGE_NOISES * noise else 0.0


def shown_model(windows: Sequence[Window], name: str, noise: float) -> SensorModel:
    """Return the dead band or the distance between edges that ``windows`` show of a signal; empty if they show neither.

    The reading of a speed from edge times, times the time since the one before, is one and the same distance.
    """
    present = [~window.missing_in(name) for window in windows]
    values = [window.column(name)[mask] for window, mask in zip(windows, present, strict=True)]
    moments = [window.grid.offsets[mask] for window, mask in zip(windows, present, strict=True)]
    changes = [np.flatnonzero(np.diff(column)) + 1 for column in values]
    count, samples = sum(map(len, changes)), sum(map(len, values))
    if count < MIN_SHOWN_CHANGES or count > (1.0 - MIN_REPEATED_SHARE) * samples:
        return SensorModel()
    readings = np.concatenate([np.abs(column[at])[1:] for column, at in zip(values, changes, strict=True)])
    waits = np.concatenate([np.diff(times[at]) for times, at in zip(moments, changes, strict=True)])
    distances, middle = readings * waits, float(np.median(readings * waits)) if len(waits) else 0.0
    if middle > 0.0:
        spread = float(np.median(np.abs(distances / middle - 1.0)))
        low, high = np.percentile(waits, (10.0, 90.0))
        if spread < MAX_DISTANCE_SPREAD and high > MIN_WAIT_RATIO * low:
            return SensorModel(renewed=middle)
    moved = np.concatenate([np.abs(column[at] - column[at - 1]) for column, at in zip(values, changes, strict=True)])
    levels = np.unique(np.concatenate(values))
    least, finest = float(moved.min()), float(np.diff(levels).min())
    is_band = least >= CHANGE_NOISES * noise and least > MIN_BAND_STEPS * finest
    return SensorModel(dead_band=least) if is_band else SensorModel()


def new_readings(window: Window, held: frozenset[str]) -> Window:
    """Return the window in which the signals ``held`` are missing where they repeat their reading."""
    missing = window.missing.copy()
    for name in held:
        column = window.signals.index(name)
        present = np.flatnonzero(~window.missing[:, column])
        missing[present[1:][np.diff(window.values[present, column]) == 0.0], column] = True
    return replace(window, missing=missing)


def distance(prediction: Array, times: Array, run: NDArray[np.int64]) -> float:
    """Return the distance that a speed ``prediction`` (records,) covers in the records ``run``, at ``times`` (s)."""
    inside = slice(run[0], run[-1] + 1)
    return float(np.trapezoid(np.abs(prediction[inside]), times[inside]))


def is_driven_position(twin: Definition, name: str) -> bool:
    """Whether the signal ``name`` is a position whose speed the twin computes, as that of a lift from its valve.

    Such a machine stands at any value as long as the computed speed is zero. A state which its own value drives, or
    whose unit contains a time, as a speed, has a value of its own at rest.
    """
    equations = dict(twin.equations) | {defined: expression for defined, expression, _ in twin.definitions}
    rate, states = equations.get(f"der({name})"), {state.name: state.unit for state in twin.states}
    if rate is None or rate.strip() in states or name in _names_behind(rate, equations):
        return False
    return not dimension_of(states[name]).get("[time]", 0)


def _names_behind(expression: str, equations: dict[str, str]) -> set[str]:
    """Return the names in an expression, and in the definitions of those."""
    known, waiting = set[str](), [expression]
    while waiting:
        for found in names_in(parse(waiting.pop())) - known:
            known.add(found)
            if found in equations:
                waiting.append(equations[found])
    return known
