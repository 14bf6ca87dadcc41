"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it."""

from dataclasses import dataclass

from otolith.adaptation.gate import Memory, begin_memory
from otolith.adaptation.problem import Problem
from otolith.health.status import Standing


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All that is carried from window to window. Plain and frozen: it pickles."""

    machine: str
    site: str
    problem: Problem
    memory: Memory
    standing: tuple[Standing, ...]
    """Of each free parameter."""
    records: int
    """Of the next window."""


def begin(machine: str, site: str, problem: Problem) -> State:
    """The state before the first window."""
    standing = tuple(Standing() for _ in problem.free)
    return State(machine, site, problem, begin_memory(problem), standing, problem.window.records)
