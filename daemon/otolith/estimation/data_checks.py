"""Single records that no machine makes: spikes are taken for missing, and a channel full of them is not believed.

A spike goes up and comes down within two sampling periods, so the second difference around it reads -1/2, 1, -1/2; the
kink that a step of voltage leaves in a current does not (compare F. R. Hampel, The influence curve and its role in
robust estimation, Journal of the American Statistical Association 69, 1974).

Sensors that lie: channels that stand still or at their limit.

What a sensor says is held against the twin as it was known before; a lie must not teach.

Records that only repeat the one before, bit for bit in every channel: an old image, read or sent again.

The errors of such records are one and the same error, so many of them say no more than a few. Taken for as many
measurements, the noise of a single reading becomes an offset that nothing but a component could explain.

Coarse channels repeat by chance, and then every record counts: those that are left would be the ones that have just
changed. An old image is told from that by its end, where all sensors jump at once and by any amount. The first and the
last of its records count, as the first alone would be off in the direction of the motion.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.objective import Objective, adc_step
from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition

SHORTEST_FROZEN_RUN = 5  # records of the same value that are looked at
STUCK = 0.05  # share of records beyond which a channel is not believed
FAR = 6.0  # standard deviations that the twin must move, or be away, while the channel stands still


def frozen_channels(problem: Problem, window: Window, parameters: Array) -> list[str]:
    """Which channels stand still while the twin, with ``parameters`` (free,), moves; a sentence for each."""
    found = []
    told: Array | None = None
    for index, entry in enumerate(problem.twin.outputs):
        values = window.column(entry.name)
        runs = [run for run in _runs(values) if not window.missing_in(entry.name)[run].any()]
        if sum(run.stop - run.start for run in runs) <= STUCK * window.records:
            continue
        if told is None:
            objective = Objective(replace(problem, open_loop=True), window, parameters)
            told = objective.simulate(objective.guess(parameters))
        far = FAR * problem.noise[index] + 2.0 * adc_step(values)
        lies = [run for run in runs if _disagrees(told[run, index], float(values[run.start]), far)]
        if sum(run.stop - run.start for run in lies) > STUCK * window.records:
            beyond = np.concatenate([told[run, index] for run in lies]) - values[lies[0].start]
            found.append(_sentence(entry.name, entry.unit, values, lies[0], float(np.median(beyond))))
    return found


def _runs(values: Array) -> list[slice]:
    """Stretches of one and the same value."""
    same = np.concatenate([[False], np.diff(values) == 0.0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    runs = [slice(int(start), int(end) + 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run.stop - run.start >= SHORTEST_FROZEN_RUN]


def _disagrees(told: Array, value: float, far: float) -> bool:
    """Whether the twin moves while the channel does not, and is away from it at that."""
    if not np.isfinite(told).all():
        return False
    return bool(np.ptp(told) > far and np.abs(told - value).max() > far)


def _sentence(name: str, unit: str, values: Array, lie: slice, beyond: float) -> str:
    """``beyond`` is how far the twin is above the value at which the channel stands still."""
    value = float(values[lie.start])
    clipped = np.ptp(values) > 0.0 and (
        (value == values.max() and beyond > 0.0) or (value == values.min() and beyond < 0.0)
    )
    kind = "is clipped at" if clipped else "is frozen at"
    return f"{name} {kind} {value:.6g} {unit} while the twin moves on: look at the sensor"


SHORTEST_REPEATED_RUN = 10  # records
UNMOVED = 0.3  # share of the records beside the runs in which a sensor repeats, from which on it is coarse
FEW = 2.0  # least steps, that a coarse sensor usually moves by


def drop_repeats(window: Window, twin: Definition) -> tuple[Window, list[str]]:
    """The window with the outputs of repeated records missing, and what there is to say of it."""
    measured = np.isin(window.signals, [entry.name for entry in twin.outputs])
    repeated = repeated_records(window, measured)
    count = int(repeated.sum())
    if not count:
        return window, []
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit, and do not count"
    return replace(window, missing=window.missing | (repeated[:, None] & measured)), [note]


def repeated_records(window: Window, measured: Mask) -> Mask:
    """(records,) which records are within a long run of the same that is no chance; neither its first nor its last.

    ``measured`` (signals,) are the sensors.
    """
    changes = np.abs(np.diff(window.values, axis=0))
    same = (changes == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    found = np.zeros(window.records, dtype=np.bool_)
    beside = np.ones(len(changes), dtype=np.bool_)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= SHORTEST_REPEATED_RUN:
            found[first + 1 : last] = True
            beside[first:last] = False
    if found.any() and _are_coarse(changes[beside][:, measured]):
        found[:] = False
    return found


def _are_coarse(changes: Array) -> bool:
    """Whether sensors with ``changes`` (records, sensors) beside long runs of the same repeat themselves by chance."""
    if not len(changes):
        return False
    steps = [column[column > 0.0] for column in changes.T]
    small = all(not len(column) or float(np.median(column)) <= FEW * float(column.min()) for column in steps)
    return small or bool((changes == 0.0).mean(axis=0).max() > UNMOVED)


HEIGHT = 12.0  # in units of what the channel's second difference usually is: a spike is at least this high
SHAPE = 0.35  # how far the neighbours' share may be from a half
SPIKING = 0.05  # share of records beyond which the channel is not believed
USUAL = 1.4826  # median absolute deviation of a normal distribution of unit variance, inverted
SECOND = 1.2247  # standard deviation of the second difference of unit noise: the root of 3/2


def drop_spikes(window: Window, twin: Definition, noise: tuple[float, ...]) -> tuple[Window, list[str], list[str]]:
    """The window with spikes missing; what there is to say of it; and why it should not be estimated from.

    ``noise`` is of the outputs. Commands (``zoh`` inputs) may jump as they like.
    """
    levels = {entry.name: level for entry, level in zip(twin.outputs, noise, strict=True)}
    levels |= {entry.name: 0.0 for entry in twin.inputs if entry.hold == "foh"}
    values, missing = window.values, window.missing
    notes, vetoes = [], []
    for name, level in levels.items():
        column = window.signals.index(name)
        found = spike_records(window.values[:, column], level) & ~window.missing[:, column]
        count = int(found.sum())
        if not count:
            continue
        if count > SPIKING * window.records:
            vetoes.append(f"{name} spikes in {count} of {window.records} records: look at its cable and its connector")
            continue
        if values is window.values:
            values, missing = values.copy(), missing.copy()
        values[:, column] = _bridged(values[:, column], found)
        missing[:, column] |= found
        notes.append(f"{name} has {count} spike{'s' if count > 1 else ''}, left out")
    return (window if values is window.values else replace(window, values=values, missing=missing)), notes, vetoes


def spike_records(values: Array, noise: float) -> Mask:
    """(records,) which of ``values`` (records,) are spikes over a ``noise`` of this standard deviation."""
    found = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 5:
        return found
    second = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    usual = max(USUAL * float(np.median(np.abs(second))), SECOND * noise)
    high = np.abs(second[1:-1]) > HEIGHT * max(usual, float(np.finfo(float).tiny))
    if not high.any():
        return found
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = second[:-2] / second[1:-1], second[2:] / second[1:-1]
    found[2:-2] = high & (np.abs(before + 0.5) < SHAPE) & (np.abs(after + 0.5) < SHAPE)
    return found


def _bridged(values: Array, gaps: Mask) -> Array:
    known = np.flatnonzero(~gaps)
    return np.interp(np.arange(len(values)), known, values[known])
