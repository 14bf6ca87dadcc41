"""When each signal of a recording is sampled, and the recording as a table.

A sample has two times: when its value was true, and the time that the table states. They differ by a constant delay
only. Jitter moves both.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from benchmarks.sampling.plant import Inputs, Load, Motor, Voltage, loads, simulate, voltages
from otolith.acquisition.window import Array, Mask

OUTPUTS = ("i", "omega")
NOISE = {"i": 0.005, "omega": 0.02, "T_load": 2e-4}  # A, rad/s, N·m: the sensors of config/dc-motor.toml
MICROSECONDS = 6  # decimals of the times in a table
CHOICES = 8  # times between two readings that stand for all
KNOT_PERIOD = 0.002  # s between the times at which a smooth load torque is computed
COMMAND_PERIOD = 0.01  # s between the times at which a command can change


@dataclass(frozen=True, slots=True)
class Timing:
    """When samples are taken: every ``period`` s, moved at random by up to ``jitter`` periods, with a share missing."""

    period: float = 0.01
    missing: float = 0.0
    jitter: float = 0.0
    delay: float = 0.0
    """s by which the stated time is later than the true one."""
    renewed_every: int = 1
    """Each value is repeated in the samples up to this one."""

    def times(self, length: float, random: np.random.Generator, *, from_zero: bool) -> Array:
        """Return the times of all samples of ``length`` s, of those that will be missing too."""
        phase = 0.0 if from_zero else random.uniform(0.0, self.period)
        count = int(length / self.period)
        times = phase + self.period * (np.arange(count) + random.uniform(-self.jitter, self.jitter, count))
        return np.unique(np.round(np.maximum(times, 0.0), MICROSECONDS))


@dataclass(frozen=True, slots=True)
class Schedule:
    """A way to record the motor. Without ``rows`` every signal has times of its own."""

    rows: Timing | None = None
    """Times of rows that have all signals; the commands change at them, and a random walk of the load bends at them."""
    i: Timing = field(default_factory=Timing)
    omega: Timing = field(default_factory=Timing)
    voltage: Voltage = "levels"
    load: Load = "slow"
    load_period: float = 0.01
    """s between the times at which the load torque is measured, if there are no ``rows``."""
    load_noise: bool = False
    commands_on_change: bool = False
    """Whether the voltage has a sample at each of its changes and at no other time; otherwise with each of the load."""
    polled: bool = False
    """Whether the voltage changes at times of its own, between the readings."""
    copies: int = 1
    """How often each row is written."""


@dataclass(frozen=True, slots=True)
class Samples:
    """The samples of one signal that a table has."""

    times: Array
    """s, true."""
    values: Array
    stated: Array
    """s, as in the table."""
    fresh: Mask
    """False for a value that repeats the one before it."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A simulated recording: the truth and the samples."""

    motor: Motor
    initial: Array
    inputs: Inputs
    samples: dict[str, Samples]
    load_noise: float
    """N·m: standard deviation of the samples of the load torque."""
    walk: bool
    """Whether the load torque is a random walk; otherwise it is known between its samples."""
    possible_changes: tuple[Array, ...]
    """When each change of the voltage can have been, given the samples of the voltage: some equally likely times, s."""
    copies: int = 1

    def rows(self, *, shift: float = 0.0, first: float = -np.inf) -> list[list[str]]:
        """Return the cells of the table: ``t`` in s later by ``shift``, then the signals; blank without a sample.

        ``first`` is the first time (s) to return.
        """
        times = np.unique(np.concatenate([sample.stated for sample in self.samples.values()]))
        cells = [[""] * (len(self.samples) + 1) for _ in times]
        for row, time in zip(cells, times.tolist(), strict=True):
            row[0] = f"{time + shift:.{MICROSECONDS}f}"
        for column, sample in enumerate(self.samples.values(), 1):
            for at, value in zip(np.searchsorted(times, sample.stated), sample.values.tolist(), strict=True):
                cells[at][column] = repr(value)
        return [row for row, time in zip(cells, times, strict=True) if time >= first for _ in range(self.copies)]

    @property
    def header(self) -> list[str]:
        """Names of the columns of :meth:`rows`."""
        return ["t", *self.samples]

    def table(self) -> str:
        """Return the recording as the text of a CSV file."""
        return "".join(",".join(row) + "\n" for row in [self.header, *self.rows()])

    def delayed(self, delays: Mapping[str, float]) -> Self:
        """Return the recording whose table states the times of some signals later, each by its delay in s."""
        later = {
            name: replace(self.samples[name], stated=np.round(self.samples[name].stated + delay, MICROSECONDS))
            for name, delay in delays.items()
        }
        return replace(self, samples={**self.samples, **later})

    def without(self, first: float, last: float) -> Self:
        """Return the recording without the samples between two times, s."""
        kept = {}
        for name, sample in self.samples.items():
            outside = (sample.times < first) | (sample.times >= last)
            kept[name] = Samples(*(getattr(sample, key)[outside] for key in ("times", "values", "stated", "fresh")))
        return replace(self, samples=kept)


def record(schedule: Schedule, motor: Motor, length: float, random: np.random.Generator) -> Recording:
    """Return ``length`` s of the motor, recorded as the schedule says."""
    rows = schedule.rows
    full = (rows or Timing(schedule.load_period)).times(length, random, from_zero=True)
    kept = _kept(full, 0.0 if rows is None else rows.missing, random)
    command_times = full if rows is not None else np.round(np.arange(0.0, length, COMMAND_PERIOD), MICROSECONDS)
    if schedule.polled:
        command_times = np.sort(random.uniform(0.0, length, int(length / COMMAND_PERIOD)))
    knots = full
    if schedule.load == "slow":
        knots = np.union1d(full, np.round(np.arange(0.0, full[-1], KNOT_PERIOD), MICROSECONDS))
    inputs = Inputs(*voltages(schedule.voltage, command_times, random), knots, loads(schedule.load, knots, random))
    timings = {name: getattr(schedule, name) for name in OUTPUTS}
    times = {name: _output_times(timings[name], full, kept, length, random, rows=rows is not None) for name in OUTPUTS}
    initial: Array = random.uniform([0.5, 3.0], [2.0, 15.0])
    noise = NOISE["T_load"] if schedule.load_noise else 0.0
    seen = inputs.voltage_times if schedule.commands_on_change else full[kept]
    load_values = inputs.load(full[kept]) + random.normal(size=int(kept.sum())) * noise
    samples = {
        "V_a": _plain(seen, inputs.voltage(seen)),
        "T_load": _plain(full[kept], load_values),
        **_measure(motor, initial, inputs, times, timings, random),
    }
    changes, walk = inputs.voltage_times, schedule.load == "walk"
    if schedule.commands_on_change:
        choices = tuple(changes[:, None])
    else:
        choices = tuple(_possible_changes(changes, None if schedule.polled else full, seen))
    return Recording(motor, initial, inputs, samples, noise, walk, choices, schedule.copies)


def _kept(times: Array, missing: float, random: np.random.Generator) -> Mask:
    """Return which samples are not missing; the first never is."""
    kept = random.uniform(size=len(times)) >= missing
    kept[:1] = True
    return kept


def _output_times(
    timing: Timing, full: Array, kept: Mask, length: float, random: np.random.Generator, *, rows: bool
) -> Array:
    if rows:
        return full[kept & _kept(full, timing.missing, random)]
    times = timing.times(length, random, from_zero=False)
    return times[_kept(times, timing.missing, random)]


def _measure(
    motor: Motor,
    initial: Array,
    inputs: Inputs,
    times: dict[str, Array],
    timings: dict[str, Timing],
    random: np.random.Generator,
) -> dict[str, Samples]:
    """Return the samples of the outputs: the states at their times with the noise of their sensors."""
    union = np.unique(np.concatenate(list(times.values())))
    states = simulate(motor, initial, 0.0, inputs, union)
    samples = {}
    for column, name in enumerate(OUTPUTS):
        own, timing = times[name], timings[name]
        values = states[np.searchsorted(union, own), column] + random.normal(size=len(own)) * NOISE[name]
        source = np.arange(len(own)) // timing.renewed_every * timing.renewed_every
        stated = np.round(own + timing.delay, MICROSECONDS)
        samples[name] = Samples(own, values[source], stated, source == np.arange(len(own)))
    return samples


def _plain(times: Array, values: Array) -> Samples:
    return Samples(times, values, times, np.ones(len(times), dtype=np.bool_))


def _possible_changes(changes: Array, possible: Array | None, seen: Array) -> Iterator[Array]:
    """Yield when each change of the voltage can have been: at times of ``possible``, or at any time.

    A change comes after the last time of ``seen`` before it, up to the next one.
    """
    after = np.clip(np.searchsorted(seen, changes), 1, len(seen) - 1)
    for time, first, last in zip(changes, seen[after - 1], seen[after], strict=True):
        if not first < time <= last:
            yield np.array([time])
        elif possible is None:
            yield first + (np.arange(CHOICES) + 0.5) / CHOICES * (last - first)
        else:
            yield possible[(possible > first) & (possible <= last)]
