"""What is to be estimated, the same for every window. Plain: it pickles.

An unknown component, as it was found.
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.twin.component_families import ComponentFamily, family_of
from otolith.twin.definition import Definition, Parameter


@dataclass(frozen=True, slots=True)
class Component:
    """A component: where it enters, which family, of what, and its numbers when it was found."""

    site: str
    family: str
    source: str
    """Empty for nothing, ``t``, ``angle(omega)`` or the name of a signal or state."""
    amplitude: float
    """In the unit of the site."""
    inner: float = 0.0
    phase: float = 0.0
    """rad, at the first record of the window it was found in."""
    low: float = 0.0
    """Of the inner number."""
    high: float = 0.0
    origin: float = 0.0
    """Unix seconds at which a time that does not repeat itself counts zero."""

    @property
    def key(self) -> str:
        """What tells it from others of the machine."""
        return key_of(self.site, self.family, self.source)

    @property
    def model(self) -> ComponentFamily:
        """Its family."""
        return family_of(self.family)

    @property
    def repeats(self) -> bool:
        """Whether it has a phase."""
        return len(self.model.phases) > 1


def key_of(site: str, family: str, source: str) -> str:
    """``site/family/source``, without the source if there is none."""
    return f"{site}/{family}/{source}".rstrip("/")


LEAST_SCALE = 0.01  # of the width of the bounds: what stands for the size of a parameter whose nominal value is about 0


@dataclass(frozen=True, slots=True)
class SwarmOptions:
    """Particle swarm settings, Table 2 of the paper."""

    size: int = 15
    generations: int = 1000
    inertia: float = 0.9
    cognitive: float = 2.0
    social: float = 2.0
    tolerance: float = 0.1
    """The swarm is done when the best guesses of its particles lie within this share of χ²: all are in one valley then,
    and the polish finds its floor."""


@dataclass(frozen=True, slots=True)
class WindowOptions:
    """How many records a window has."""

    records: int = 200
    """Of the first, and of all if there is nothing to choose."""
    shortest: int = 200
    longest: int = 200


@dataclass(frozen=True, slots=True)
class Problem:
    """A machine's estimation problem."""

    twin: Definition
    known: tuple[tuple[str, float], ...]
    """Parameters that are given: name and value."""
    free: tuple[Parameter, ...]
    """Parameters to be estimated, with the nominal values and bounds of this machine."""
    noise: tuple[float, ...]
    """Standard deviation of each output's sensor."""
    input_noise: tuple[float, ...] = ()
    """Standard deviation of each input; empty for none."""
    process_noise: tuple[float, ...] = ()
    """Of each state, per square root of a second; empty for none."""
    open_loop: bool = False
    """The paper's cost: nothing corrects the twin within a window, whatever disturbs the machine."""
    determined_within: float = 0.1
    """A parameter is determined when the half of its 95 % interval is at most this share of its nominal value."""
    components: tuple[Component, ...] = ()
    """That complete the twin; their numbers are free as well, with names that begin with "_"."""
    excluded: frozenset[str] = frozenset()
    """Keys of components that are not looked for."""
    discover: bool = True
    """Whether components are looked for at all."""
    window: WindowOptions = WindowOptions()
    swarm: SwarmOptions = SwarmOptions()
    seed: int = 1

    @property
    def scale(self) -> Array:
        """(free,) what each parameter's accuracy is measured against."""
        return np.array([max(abs(entry.nominal), LEAST_SCALE * (entry.high - entry.low)) for entry in self.free])

    @property
    def nominal(self) -> Array:
        """(free,) the values of the machine file."""
        return np.array([entry.nominal for entry in self.free])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """(free,) lowest and highest values."""
        return np.array([entry.low for entry in self.free]), np.array([entry.high for entry in self.free])
