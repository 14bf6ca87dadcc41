"""A twin as its author wrote it, and nothing derived: plain, frozen, hashable, so that it pickles."""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal


class Role(StrEnum):
    """How a parameter's value is come by, in the paper's words."""

    INSTRUMENTED = "instrumented"
    """Instrumented known: given or measured."""
    ESTIMATED = "estimated"
    """Non-instrumented known: estimated from windows."""
    SETTING = "setting"
    """A choice, of which no derivative is taken: what sits in a slot for components."""


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

    @property
    def label(self) -> str:
        """For people: a number of a component is called by what it means."""
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
    """What the machine remembers from one instant to the next."""

    name: str
    unit: str
    meaning: str
    initial: float = 0.0
    """Where the search for the initial state begins if no output shows the state."""
    low: float = -1e3
    high: float = 1e3


@dataclass(frozen=True, slots=True)
class Input:
    """A signal that drives the machine."""

    name: str
    unit: str
    meaning: str
    hold: Literal["zoh", "foh"]
    """Between two records: ``zoh`` keeps the value (a command), ``foh`` runs straight to the next (a measurement)."""
    low: float = -1.0
    """Between ``low`` and ``high`` the signal lies in ordinary operation."""
    high: float = 1.0


@dataclass(frozen=True, slots=True)
class Output:
    """A signal that the twin predicts."""

    name: str
    unit: str
    meaning: str
    noise: float
    """Standard deviation of an ordinary sensor, in ``unit``: what a machine file that says nothing gets."""


@dataclass(frozen=True, slots=True)
class Site:
    """A place where an unknown component may enter."""

    name: str
    unit: str
    """Of the component there; ``1`` for a multiplicative one."""
    meaning: str
    into: str
    """``der(state)``, a definition or an output."""
    mode: Literal["additive", "multiplicative"]
    """Additive: the right side becomes ``right + through * U``; multiplicative: ``right * (1 + U)`` (Eq. 18)."""
    through: str = "1"
    """What turns the component's unit into that of the right side: ``1/J`` for a torque in ``der(omega)``."""


@dataclass(frozen=True, slots=True)
class Definition:
    """The page of equations."""

    name: str
    title: str
    source: str
    validity: str
    states: tuple[StateVariable, ...]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    parameters: tuple[Parameter, ...]
    equations: tuple[tuple[str, str], ...]
    """Left and right sides: ``der(state)`` for every state, an output's name for every output that is no state."""
    constants: tuple[Constant, ...] = ()
    definitions: tuple[tuple[str, str, str], ...] = ()
    """Name, expression and meaning of helper quantities, in the author's order."""
    sites: tuple[Site, ...] = field(default=())
    plain: "Definition | None" = None
    """Of a twin with slots for components (see :mod:`otolith.twin.augmentation`): the twin without them."""

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of all inputs and outputs: what a machine file must say where to read."""
        return (*(entry.name for entry in self.inputs), *(entry.name for entry in self.outputs))

    def unit_of(self, name: str) -> str:
        """Of a state, input, output, parameter or constant."""
        return self.units()[name]

    def units(self) -> dict[str, str]:
        """Every named quantity and its unit."""
        groups = (self.states, self.inputs, self.outputs, self.parameters, self.constants)
        return {entry.name: entry.unit for group in groups for entry in group}

    @property
    def settings(self) -> int:
        """How many of the parameters, the last ones, have no derivatives."""
        return sum(entry.role is Role.SETTING for entry in self.parameters)

    def parameter(self, name: str) -> Parameter:
        """By its name."""
        return next(entry for entry in self.parameters if entry.name == name)
