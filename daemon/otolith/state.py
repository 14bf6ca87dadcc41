"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it."""

from dataclasses import dataclass

from otolith.adaptation.catalogue import Entry
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
    standing: dict[str, Standing]
    """Of each free parameter, by its label."""
    records: int
    """Of the next window."""
    restricted: frozenset[str] = frozenset()
    """Keys of components that the machine file rules out."""
    approved: frozenset[str] = frozenset()
    """Keys of components that the specialist has approved."""
    catalogue: tuple[Entry, ...] = ()
    """Of the components in the twin."""


def begin(machine: str, site: str, problem: Problem) -> State:
    """The state before the first window."""
    standing = {entry.label: Standing() for entry in problem.free}
    memory, records = begin_memory(problem), problem.window.records
    return State(machine, site, problem, memory, standing, records, problem.excluded)
