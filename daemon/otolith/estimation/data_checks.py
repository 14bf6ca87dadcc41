"""Faulty data are rejected before estimating: bad windows, spikes, frozen or clipped channels, repeated records.

- A **spike** rises and falls within two sampling periods, so the second difference around it reads -1/2, 1, -1/2. The
  kink that a voltage step leaves in a current does not (compare F. R. Hampel, The influence curve and its role in
  robust estimation, Journal of the American Statistical Association 69, 1974). Single spikes count as missing.
- A channel is **frozen** where it stands still while the twin, simulated with the parameters known before, moves.
- **Repeated records** are an old image that was read or sent again: every channel repeats bit for bit. Their errors are
  one and the same error, so only the first and the last of a run count; the first alone would be biased in the
  direction of motion. Coarse channels repeat by chance, and dropping those would bias them, so then all records count.
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Verdict, Window
from otolith.estimation.augmented import base_model
from otolith.estimation.objective import Objective, adc_step
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition

MIN_RECORDS = 5
MAX_VALUE = 1e12  # magnitude of a value, in the unit of its signal
SPIKE_HEIGHT = 12.0  # times the usual second difference of the channel: least height of a spike
SPIKE_SHAPE = 0.35  # largest distance of the neighbours' share from a half
MAX_SPIKE_SHARE = 0.05  # share of records above which the channel is rejected
MAD_TO_SD = 1.4826  # standard deviation over median absolute deviation of a normal distribution
SECOND_DIFFERENCE_SD = 1.2247  # standard deviation of the second difference of unit noise, the root of 3/2
MIN_FROZEN_RUN = 5  # records of one value
MAX_FROZEN_SHARE = 0.05  # share of records above which the channel is rejected
FROZEN_DISTANCE = 6.0  # standard deviations that the twin must move, and be away, while the channel stands still
MIN_REPEATED_RUN = 10  # records
COARSE_REPEATS = 0.3  # share of the other records in which a coarse sensor repeats its value
COARSE_STEPS = 2.0  # least steps that a coarse sensor usually moves by


@dataclass(frozen=True, slots=True)
class CheckedWindow:
    """A window without faulty records, and what the checks say of it."""

    window: Window
    notes: tuple[str, ...] = ()
    """What was left out."""
    bad: tuple[str, ...] = ()
    """Why the sampling or the values make the window unusable."""
    faulty_sensors: tuple[str, ...] = ()
    """Which sensors make the window unusable, and why."""

    @property
    def is_usable(self) -> bool:
        """Whether the window may be estimated from."""
        return not self.bad and not self.faulty_sensors


def check_window(window: Window, predicted: Posterior) -> CheckedWindow:
    """Check ``window`` against its prediction, and drop faulty records."""
    problem = predicted.problem
    bad = window.quality.reasons if window.quality.verdict is Verdict.BAD else _unusable_values(window)
    if bad:
        return CheckedWindow(window, bad=bad)
    cleaned, notes, faulty = drop_spikes(window, base_model(problem), problem.noise)
    faulty = faulty or frozen_channels(problem, cleaned, predicted.start())
    if faulty:
        return CheckedWindow(cleaned, faulty_sensors=tuple(faulty))
    cleaned, repeated = drop_repeats(cleaned, base_model(problem))
    return CheckedWindow(cleaned, (*notes, *repeated))


def _unusable_values(window: Window) -> tuple[str, ...]:
    if window.records < MIN_RECORDS:
        return (f"{window.records} records are too few",)
    if not (np.abs(window.values) < MAX_VALUE).all():  # also false for not-a-number
        return (f"a value is not finite or beyond {MAX_VALUE:g}",)
    return ()


def drop_spikes(window: Window, twin: Definition, noise: tuple[float, ...]) -> tuple[Window, list[str], list[str]]:
    """Return the window with spikes missing, notes, and a sentence for each channel with too many spikes.

    ``noise`` holds the standard deviations of the outputs. Commands (``zoh`` inputs) may jump.
    """
    levels = {output.name: level for output, level in zip(twin.outputs, noise, strict=True)}
    levels |= {source.name: 0.0 for source in twin.inputs if source.hold == "foh"}
    values, missing = window.values.copy(), window.missing.copy()
    notes, faulty = [], []
    for name, level in levels.items():
        column = window.signals.index(name)
        spikes = spike_records(window.values[:, column], level) & ~window.missing[:, column]
        count = int(spikes.sum())
        if count > MAX_SPIKE_SHARE * window.records:
            faulty.append(f"{name} spikes in {count} of {window.records} records: look at its cable and its connector")
        elif count:
            values[:, column] = _bridge(values[:, column], spikes)
            missing[:, column] |= spikes
            notes.append(f"{name} has {count} spike{'s' if count > 1 else ''}, left out")
    return (replace(window, values=values, missing=missing) if notes else window), notes, faulty


def spike_records(values: Array, noise: float) -> Mask:
    """Return which of ``values`` (records,) are spikes above a ``noise`` of that standard deviation."""
    spikes = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 5:
        return spikes
    second = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    usual = max(MAD_TO_SD * float(np.median(np.abs(second))), SECOND_DIFFERENCE_SD * noise)
    high = np.abs(second[1:-1]) > SPIKE_HEIGHT * max(usual, float(np.finfo(float).tiny))
    if not high.any():
        return spikes
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = second[:-2] / second[1:-1], second[2:] / second[1:-1]
    spikes[2:-2] = high & (np.abs(before + 0.5) < SPIKE_SHAPE) & (np.abs(after + 0.5) < SPIKE_SHAPE)
    return spikes


def _bridge(values: Array, gaps: Mask) -> Array:
    known = np.flatnonzero(~gaps)
    return np.interp(np.arange(len(values)), known, values[known])


def frozen_channels(problem: Problem, window: Window, parameters: Array) -> list[str]:
    """Return a sentence for each channel that stands still while the twin with ``parameters`` (free,) moves."""
    sentences = []
    simulated: Array | None = None
    for index, output in enumerate(problem.twin.outputs):
        values = window.column(output.name)
        runs = [run for run in _constant_runs(values) if not window.missing_in(output.name)[run].any()]
        if _records_in(runs) <= MAX_FROZEN_SHARE * window.records:
            continue
        if simulated is None:
            objective = Objective(replace(problem, open_loop=True), window, parameters)
            simulated = objective.simulate(objective.guess(parameters))
        distance = FROZEN_DISTANCE * problem.noise[index] + 2.0 * adc_step(values)
        frozen = [run for run in runs if _twin_moves(simulated[run, index], float(values[run.start]), distance)]
        if _records_in(frozen) > MAX_FROZEN_SHARE * window.records:
            excess = np.concatenate([simulated[run, index] for run in frozen]) - values[frozen[0].start]
            at, kind = float(values[frozen[0].start]), _frozen_or_clipped(values, frozen[0], float(np.median(excess)))
            moves = "while the twin moves on: look at the sensor"
            sentences.append(f"{output.name} is {kind} at {at:.6g} {output.unit} {moves}")
    return sentences


def _constant_runs(values: Array) -> list[slice]:
    """Return the runs of one and the same value that are long enough."""
    same = np.concatenate([[False], np.diff(values) == 0.0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    runs = [slice(int(start), int(end) + 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run.stop - run.start >= MIN_FROZEN_RUN]


def _records_in(runs: list[slice]) -> int:
    return sum(run.stop - run.start for run in runs)


def _twin_moves(simulated: Array, value: float, distance: float) -> bool:
    """Whether the twin moves by more than ``distance`` while the channel does not, and is that far from it."""
    if not np.isfinite(simulated).all():
        return False
    return bool(np.ptp(simulated) > distance and np.abs(simulated - value).max() > distance)


def _frozen_or_clipped(values: Array, run: slice, excess: float) -> str:
    """Return the kind of fault; ``excess`` is how far the twin is above the value of the run."""
    value = float(values[run.start])
    above, below = value == values.max() and excess > 0.0, value == values.min() and excess < 0.0
    return "clipped" if np.ptp(values) > 0.0 and (above or below) else "frozen"


def drop_repeats(window: Window, twin: Definition) -> tuple[Window, list[str]]:
    """Return the window with the outputs of repeated records missing, and notes."""
    outputs = np.isin(window.signals, [output.name for output in twin.outputs])
    repeated = repeated_records(window, outputs)
    count = int(repeated.sum())
    if not count:
        return window, []
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit, and do not count"
    return replace(window, missing=window.missing | (repeated[:, None] & outputs)), [note]


def repeated_records(window: Window, outputs: Mask) -> Mask:
    """Return which records (records,) lie inside a long run of repeats; ``outputs`` (signals,) marks the sensors."""
    changes = np.abs(np.diff(window.values, axis=0))
    same = (changes == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    repeated = np.zeros(window.records, dtype=np.bool_)
    elsewhere = np.ones(len(changes), dtype=np.bool_)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= MIN_REPEATED_RUN:
            repeated[first + 1 : last] = True
            elsewhere[first:last] = False
    if repeated.any() and _are_coarse(changes[elsewhere][:, outputs]):
        repeated[:] = False
    return repeated


def _are_coarse(changes: Array) -> bool:
    """Whether sensors with ``changes`` (records, sensors) outside the runs repeat their values by chance."""
    if not len(changes):
        return False
    steps = [column[column > 0.0] for column in changes.T]
    small = all(not len(column) or float(np.median(column)) <= COARSE_STEPS * float(column.min()) for column in steps)
    return small or bool((changes == 0.0).mean(axis=0).max() > COARSE_REPEATS)
