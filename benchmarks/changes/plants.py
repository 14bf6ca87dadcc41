"""Machines integrated without the twins' kernels, many runs at a time, and what their sensors show.

The classical Runge-Kutta method on NumPy arrays (runs,), with equations of its own for each machine (``machines.py``).
Commands are held from record to record; measured loads are linear between records, as the twins assume.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from otolith.acquisition.window import Array, Window

Values = Mapping[str, Any]
"""Quantities by name: arrays (runs,), or numbers that all runs share."""
START = 1e6  # s: Unix time of the first record


def states(x: Values, u: Values, q: Values) -> Values:
    """Return the outputs of a machine whose sensors show its states."""
    return x


@dataclass(frozen=True, slots=True)
class Plant:
    """A machine, its operation and its sampling."""

    name: str
    twin: str
    """Of the library, or of the folder ``twins``."""
    parameters: Mapping[str, float]
    sites: tuple[str, ...]
    """Places at which a term enters; its value is zero in a healthy machine."""
    initial: Mapping[str, float]
    """State at the first record."""
    rates: Callable[[Values, Values, Values], Values]
    """Derivatives of the states, from states, inputs and parameters with the terms."""
    operate: Callable[[np.random.Generator, Array], Mapping[str, Array]]
    """Inputs and set-points of one run at the times of its records."""
    held: tuple[str, ...]
    """Inputs that are held from record to record; the others are linear between records."""
    outputs: Callable[[Values, Values, Values], Values] = states
    """What the sensors show, from the same; by default the states."""
    period: float = 0.01
    """s, of the records."""
    records: int = 200
    """Per window."""
    steps: int = 5
    """Of the integrator, per record."""
    control: Callable[[Values, Values], Values] | None = None
    """Held inputs from states and set-points at a record."""


@dataclass(frozen=True, slots=True)
class Term:
    """A component of the machine that its twin lacks, in the families of the paper's Table 1."""

    family: str
    source: str = ""
    """A state or an input, ``t``, or nothing."""
    amplitude: float = 0.0
    inner: float = 0.0
    """Rate, exponent, frequency (rad/s), or the width within which dry friction changes its sign."""

    def __call__(self, time: float, signals: Values) -> Array | float:
        """Return the value at ``time``, s since the first record."""
        x = time if self.source == "t" else signals.get(self.source, 0.0)
        return self.amplitude * SHAPES[self.family](x, self.inner)


SHAPES: Mapping[str, Callable[[Array | float, float], Array | float]] = {
    "constant": lambda x, b: 1.0,
    "linear": lambda x, b: x,
    "exponential": lambda x, b: np.exp(b * x),
    "power": lambda x, b: np.sign(x) * np.abs(x) ** b,
    "periodic": lambda x, b: np.sin(b * x),
    "Coulomb": lambda x, b: np.tanh(x / b),
}


@dataclass(frozen=True, slots=True)
class Change:
    """What differs after the change; nothing by default."""

    parameters: Mapping[str, float] = field(default_factory=dict)
    """New values."""
    gains: Mapping[str, float] = field(default_factory=dict)
    """Factors of sensors."""
    offsets: Mapping[str, float] = field(default_factory=dict)
    """Added to what sensors show."""
    terms: Mapping[str, Term] = field(default_factory=dict)
    """By site."""
    ramps: Mapping[str, float] = field(default_factory=dict)
    """Growth of parameters per second, as shares of their values in the healthy machine."""
    since: float = 0.0
    """s since the first record: when the growth began."""

    def grown(self, values: Mapping[str, float], time: float) -> dict[str, float]:
        """Return the parameters of the machine at ``time`` (s since the first record), of healthy ones."""
        own, elapsed = {**values, **self.parameters}, max(time - self.since, 0.0)
        return own | {name: own[name] * (1.0 + rate * elapsed) for name, rate in self.ramps.items()}

    def measured(self, name: str, values: Array) -> Array:
        """Return what the sensor of a signal shows without noise."""
        shown: Array = values * self.gains.get(name, 1.0) + self.offsets.get(name, 0.0)
        return shown


HEALTHY = Change()


def generator(seed: int, name: str, run: int) -> np.random.Generator:
    """Return the random numbers of one run."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), run])


def simulate(
    plant: Plant,
    randoms: Sequence[np.random.Generator],
    records: int,
    before: Change,
    after: Change,
    at: int,
    later: Sequence[tuple[int, Change]] = (),
) -> dict[str, Array]:
    """Return each signal without noise, (runs, records), of one run for each generator.

    The change comes at record ``at``; ``later`` has further ones with their records, each of the healthy machine.
    """
    changes = ((0, before), (at, after), *later)
    times = np.arange(records + 1, dtype=np.float64) * plant.period
    runs = [plant.operate(random, times) for random in randoms]
    given = {name: np.array([run[name] for run in runs]) for name in runs[0]}
    each: Any = 0 if len(runs) == 1 else slice(None)  # numbers are five times as fast as arrays of one number
    state: dict[str, Any] = {name: np.full(len(runs), value)[each] for name, value in plant.initial.items()}
    rows: dict[str, Array] = {}
    for record in range(records):
        change = next(own for first, own in reversed(changes) if record >= first)
        now = {name: values[each, record] for name, values in given.items()}
        if plant.control is not None:
            now |= plant.control(state, now)
        linear = {name: (now[name], given[name][each, record + 1]) for name in given if name not in plant.held}
        signals = now | dict(state) | dict(plant.outputs(state, now, _values(plant, change, 0.0, now, state)))
        for name, values in signals.items():
            rows.setdefault(name, np.empty((len(runs), records)))[:, record] = change.measured(name, values)
        state = _advance(plant, change, float(times[record]), state, now, linear)
    return rows


def _advance(
    plant: Plant,
    change: Change,
    time: float,
    state: dict[str, Any],
    now: dict[str, Any],
    linear: Mapping[str, tuple[Any, Any]],
) -> dict[str, Any]:
    """Return the state one record later."""
    step = plant.period / plant.steps

    def derivative(part: float, state: dict[str, Any]) -> Values:
        inputs = now | {name: first + part * (last - first) for name, (first, last) in linear.items()}
        moment = time + part * plant.period
        return plant.rates(state, inputs, _values(plant, change, moment, inputs, state))

    for number in range(plant.steps):
        first, middle, last = ((number + share) / plant.steps for share in (0.0, 0.5, 1.0))
        a = derivative(first, state)
        b = derivative(middle, {name: value + 0.5 * step * a[name] for name, value in state.items()})
        c = derivative(middle, {name: value + 0.5 * step * b[name] for name, value in state.items()})
        d = derivative(last, {name: value + step * c[name] for name, value in state.items()})
        state = {
            name: value + step / 6.0 * (a[name] + 2.0 * b[name] + 2.0 * c[name] + d[name])
            for name, value in state.items()
        }
    return state


def _values(plant: Plant, change: Change, time: float, inputs: Values, state: Values) -> Values:
    """Return parameters, and the value of the term at each site."""
    signals = {**inputs, **state} if change.terms else {}
    values = {**change.grown(plant.parameters, time), **dict.fromkeys(plant.sites, 0.0)}
    return values | {site: term(time, signals) for site, term in change.terms.items()}


def levels(random: np.random.Generator, times: Array, low: float, high: float, hold: float) -> Array:
    """Return levels that each last ``hold`` seconds on average."""
    steps = random.random(len(times)) < (times[1] - times[0]) / hold
    drawn: Array = random.uniform(low, high, len(times))[np.cumsum(steps)]
    return drawn


def smooth(random: np.random.Generator, times: Array, low: float, high: float, period: float) -> Array:
    """Return a sum of three sines between ``low`` and ``high`` with periods from ``period`` (s) up."""
    total = np.zeros(len(times))
    for share in (0.5, 0.3, 0.2):
        total += share * np.sin(2.0 * np.pi * (times / (period * random.uniform(1.0, 4.0)) + random.random()))
    return 0.5 * (low + high) + 0.5 * (high - low) * total


def cut(plant: Plant, rows: Mapping[str, Array], signals: tuple[str, ...]) -> list[Window]:
    """Return the windows of one run, signals (records,) each."""
    values = np.column_stack([rows[name] for name in signals])
    pieces = [values[first : first + plant.records] for first in range(0, len(values), plant.records)]
    length = plant.records * plant.period
    return [Window.whole(k, START + k * length, plant.period, signals, own.copy()) for k, own in enumerate(pieces)]
