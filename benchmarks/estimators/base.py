"""The interface of the methods that are compared."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem


class Estimate(NamedTuple):
    """Estimates of the unknown parameters after a window."""

    values: Array
    """(free,); not a number without an estimate."""
    sd: Array | None = None
    """(free,) standard deviations; None if the method gives no interval."""


class Estimator(Protocol):
    """The estimator of one machine."""

    def fit(self, window: Window) -> tuple[Estimate, ...]:
        """One estimate for each row of the table; only this call is timed."""


@dataclass(frozen=True, slots=True)
class Method:
    """A method of estimation."""

    rows: tuple[str, ...]
    """Its names in the table, one for each kind of result."""
    create: Callable[[Problem], Estimator]
    """A new estimator without any previous window. Not timed."""
    stateful: bool = False
    """It carries a state from window to window, so it gets all of them."""
    slow: bool = False
    """It takes seconds per window, so it gets few of them."""
    scale: float = 1.0
    """Factor on its time, if its budget was cut."""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Budget:
    """Size of the comparison."""

    windows: int = 200
    """Scored windows."""
    slow: int = 20
    """Of these, for slow methods."""
    generations: int = 1000
    """Generations of the paper's swarm."""
    drift: float = 0.0
    """Of each parameter, relative, per hour."""
