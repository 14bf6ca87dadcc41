"""The description of a twin: everything a user or another part of the house may ask of a machine's equations."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

from otolith.acquisition.window import Array

Simulate = Callable[[Array, Array, Array, float], Array]
"""``simulate(parameters, initial, inputs, sample_period) -> outputs``.

Shapes (particles, parameters), (particles, states), (records, inputs) -> (particles, records, outputs); s.
``outputs[:, 0]`` belongs to the initial state; a particle that diverges gets values that are not finite.
"""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A physical parameter of a twin."""

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    meaning: str


@dataclass(frozen=True, slots=True)
class Input:
    """A signal that drives the twin."""

    name: str
    unit: str
    meaning: str
    hold: Literal["zoh", "foh"]
    """Between two records: ``zoh`` keeps the value (a command), ``foh`` runs straight to the next (a measurement)."""


@dataclass(frozen=True, slots=True)
class Output:
    """A signal that the twin predicts."""

    name: str
    unit: str
    meaning: str
    noise: float
    """Standard deviation of an ordinary sensor, in ``unit``: what a machine file that says nothing gets."""


@dataclass(frozen=True, slots=True)
class Twin:
    """A white-box model of a machine."""

    name: str
    title: str
    source: str
    parameters: tuple[Parameter, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    states: tuple[str, ...]
    """Each state is an output of the same name, so that a window's records tell where it starts."""
    equations: tuple[str, ...]
    kernel: str
    """The module with the compiled kernel, loaded on first use: who only reads a twin does not load a compiler."""

    @property
    def simulate(self) -> Simulate:
        """The compiled kernel."""
        found: Simulate = import_module(self.kernel).simulate
        return found

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all inputs and outputs: what a machine file must say where to read."""
        return (*(entry.name for entry in self.inputs), *(entry.name for entry in self.outputs))

    def unit_of(self, signal: str) -> str:
        """Of an input or output."""
        units = {entry.name: entry.unit for entry in self.inputs} | {entry.name: entry.unit for entry in self.outputs}
        return units[signal]

    def parameter(self, name: str) -> Parameter:
        """By its name."""
        return next(entry for entry in self.parameters if entry.name == name)
