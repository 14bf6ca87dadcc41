"""A twin as its author wrote it: frozen, hashable and picklable dataclasses, nothing derived."""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from otolith.fmu.reference import FmuReference


class Role(StrEnum):
    """Where the value of a parameter comes from, in the paper's words."""

    INSTRUMENTED = "instrumented"  # Instrumented known: given or measured
    ESTIMATED = "estimated"  # Non-instrumented known: estimated from windows
    SETTING = "setting"  # Selects a component of an augmented twin; no derivative is taken by it


@dataclass(frozen=True, slots=True)
class Parameter:
    """A physical parameter."""

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    meaning: str
    role: Role = Role.INSTRUMENTED
    part: str = ""  # The part of the machine that it describes, as winding
    watch: tuple[str | float, ...] = ()  # Limits beyond which the part is watched, as written: absolute or relative
    act: tuple[str | float, ...] = ()  # Limits beyond which action is required
    temperature_coefficient: float = 0.0  # Relative change per kelvin

    @property
    def label(self) -> str:
        """The name for people: the meaning if the parameter belongs to a component."""
        return self.meaning if self.name.startswith("_") else self.name


@dataclass(frozen=True, slots=True)
class Constant:
    """A number of nature or of the design that no machine file changes."""

    name: str
    unit: str
    value: float
    meaning: str


@dataclass(frozen=True, slots=True)
class StateVariable:
    """A state of the differential equations."""

    name: str
    unit: str
    meaning: str
    initial: float = 0.0  # Where the search for the initial state begins if no output shows the state
    low: float = -1e3
    high: float = 1e3
    process_noise: float = 0.0  # Per square root of a second, where a machine file gives none


@dataclass(frozen=True, slots=True)
class Input:
    """A signal that drives the machine."""

    name: str
    unit: str
    meaning: str
    hold: Literal["zoh", "foh"]  # Between records zoh holds the value (a command), foh interpolates (a measurement)
    low: float = -1.0  # Lower end of the range in ordinary operation
    high: float = 1.0
    has_range: bool = True  # Whether the twin states the range


@dataclass(frozen=True, slots=True)
class Output:
    """A signal that the twin predicts."""

    name: str
    unit: str
    meaning: str
    noise: float  # Standard deviation of the sensor in unit, used where a machine file gives none


@dataclass(frozen=True, slots=True)
class Site:
    """A place in the equations where an unknown component may enter."""

    name: str
    unit: str  # Unit of the component; 1 for a multiplicative one
    meaning: str
    into: str  # der(state), a definition or an output
    mode: Literal["additive", "multiplicative"]  # Right side: right + through * U, or right * (1 + U) (Eq. 18)
    through: str = "1"  # Turns the unit of the component into that of the right side: 1/J for a torque in der(omega)
    part: str = ""  # The part of the machine where such a component arises; its own name by default


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of performance: what the owner of the machine pays for or gets, as a loss or a speed that it reaches."""

    name: str
    unit: str
    meaning: str
    expression: str
    better: Literal["lower", "higher"]
    at: tuple[tuple[str, float], ...] = ()
    """Values of inputs and states, the operating point; the others are those of the window, and the figure its mean."""
    required: float | None = None  # In unit: the value that the machine must keep, or a better one

    def meets(self, value: float) -> bool:
        """Whether a value is at least as good as the required one, which there must be."""
        assert self.required is not None  # noqa: S101 - for mypy
        return value <= self.required if self.better == "lower" else value >= self.required


@dataclass(frozen=True, slots=True)
class OperatingRange:
    """Where the equations hold: while a signal is within a range, in its unit."""

    signal: str
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, slots=True)
class Definition:
    """A twin: its quantities and equations."""

    name: str
    title: str
    source: str
    validity: str
    states: tuple[StateVariable, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    equations: tuple[tuple[str, str], ...]  # Left and right sides: der(state), or an output that is no state
    constants: tuple[Constant, ...] = ()
    definitions: tuple[tuple[str, str, str], ...] = ()  # Name, expression and meaning, in the author's order
    sites: tuple[Site, ...] = ()
    performance: tuple[Figure, ...] = ()
    operation: tuple[OperatingRange, ...] = ()  # Outside of any of them, a machine may do what no equation says
    base: "Definition | None" = None  # The author's twin, if this one is augmented (see otolith.twin.components)
    fmu: FmuReference | None = None  # What computes the right sides that are written ``fmu(...)``

    def __hash__(self) -> int:
        """Of the name alone, as what is prepared once for a twin is looked up several times in each window."""
        return hash(self.name)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all inputs and outputs; a machine file says where each is read."""
        return (*(driven.name for driven in self.inputs), *(output.name for output in self.outputs))

    def unit_of(self, name: str) -> str:
        """Unit of a state, input, output, parameter or constant."""
        return self.units()[name]

    def ordinary_range(self, name: str) -> tuple[float, float] | None:
        """Range of an input in ordinary operation, infinite if it is not stated; None for another quantity."""
        driven = next((item for item in self.inputs if item.name == name), None)
        if driven is None:
            return None
        return (driven.low, driven.high) if driven.has_range else (-math.inf, math.inf)

    def units(self) -> dict[str, str]:
        """Every named quantity and its unit."""
        groups = (self.states, self.inputs, self.outputs, self.parameters, self.constants)
        return {quantity.name: quantity.unit for group in groups for quantity in group}

    @property
    def settings(self) -> int:
        """Number of settings; they are the last parameters, and no derivative is taken by them."""
        return sum(parameter.role is Role.SETTING for parameter in self.parameters)

    def parameter(self, name: str) -> Parameter:
        """The parameter of that name."""
        return next(parameter for parameter in self.parameters if parameter.name == name)
