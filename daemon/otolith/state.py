"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it."""

from dataclasses import dataclass

from otolith.adaptation.problem import Problem
from otolith.health.status import Known


@dataclass(frozen=True, slots=True)
class State:
    """All that is carried from window to window. Plain and frozen: it pickles."""

    machine: str
    site: str
    problem: Problem
    known: tuple[Known | None, ...]
    """Of each free parameter."""


def begin(machine: str, site: str, problem: Problem) -> State:
    """The state before the first window."""
    return State(machine, site, problem, tuple(None for _ in problem.free))
