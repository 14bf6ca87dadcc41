"""How the innovations of a window depend on the delays of its signals, to first order.

A signal that is late by a delay shows at time t what was true before. Taken back, an output is ``y(t) + delay · dy/dt``
and an input ``u(t) + delay · du/dt``. The slope of an output is that of the prediction, as that of the measurement is
mostly noise. ``docs/explanation/delays.md`` has the equations.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.time_grid import TimeGrid
from otolith.acquisition.window import Array
from otolith.estimation.objective import Objective
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation

# Values, units, origins and guarding tests: docs/reference/thresholds-estimation.md.
SLOPE_SHARE = 0.02  # of a step: length of the difference before a record that gives the slope of an output
PROBE = 1e-3  # of the mean step: delay of the finite difference


def delayable(twin: Definition) -> list[str]:
    """Return the signals of a base model in the order of :func:`delay_response`: outputs, then inputs."""
    return [*(output.name for output in twin.outputs), *(driven.name for driven in twin.inputs)]


def delay_response(objective: Objective, guess: Array) -> Array:
    """Return the derivatives (residuals, outputs + inputs) of the whitened innovations by each delay, per second.

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
    early = grid.offsets[1:] - SLOPE_SHARE * np.diff(grid.offsets)
    times = np.concatenate([grid.offsets, early])
    order = np.argsort(times, kind="stable")
    count = len(grid.offsets)
    source = np.concatenate([np.arange(count), np.arange(count - 1)])[order]
    is_record = order < count
    inputs = excitation.inputs[source]
    held = [driven.hold == "zoh" for driven in objective.kernel.definition.inputs]
    following = excitation.inputs[np.minimum(source + 1, count - 1)]
    between = np.where(held, inputs, inputs + (1.0 - SLOPE_SHARE) * (following - inputs))
    gain, measured = excitation.gain, excitation.measured
    finer = Excitation(
        np.where(is_record[:, None], inputs, between),
        TimeGrid.at(times[order], grid.length),
        excitation.substeps,
        None if measured is None else np.where(is_record[:, None], measured[source], np.nan),
        None if gain is None else np.where(is_record[:, None, None], gain[source], 0.0),
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
