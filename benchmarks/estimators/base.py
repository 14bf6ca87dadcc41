"""What a rival is and what it is asked."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem


class Said(NamedTuple):
    """What an estimator says of the unknown parameters after a window."""

    values: Array
    """(free,); not a number where it says nothing."""
    sd: Array | None = None
    """(free,) standard deviations, from those who give an interval."""


class Estimator(Protocol):
    """One machine's estimator."""

    def fit(self, window: Window) -> tuple[Said, ...]:
        """One for each row of the table; this call is what is timed."""


@dataclass(frozen=True, slots=True)
class Rival:
    """A way to estimate."""

    rows: tuple[str, ...]
    """Its names in the table, one for each kind of result."""
    begin: Callable[[Problem], Estimator]
    """A fresh estimator, for a machine nothing is known of. Not timed."""
    remembers: bool = False
    """It learns from window to window, so it sees every one."""
    dear: bool = False
    """It takes seconds a window, so it sees few."""
    scale: float = 1.0
    """What its time is multiplied by, if its budget was cut."""
    note: str = ""


@dataclass(frozen=True, slots=True)
class Budget:
    """How much is run."""

    windows: int = 200
    """That are scored."""
    dear: int = 20
    """Of these, for rivals that take seconds each."""
    generations: int = 1000
    """Of the paper's swarm."""
    drift: float = 0.0
    """Of each parameter, in shares of it an hour."""
