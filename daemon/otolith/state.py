"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it."""

from dataclasses import dataclass, replace

from otolith.adaptation.catalogue import Entry
from otolith.adaptation.gate import Memory, begin_memory
from otolith.adaptation.problem import Problem, WindowOptions
from otolith.health.status import Standing

FEWEST_ON_A_COARSE_GRID = 50  # records; a window of fewer says little, however long the sample period


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


def regridded(state: State, ratio: float) -> State:
    """The state for windows with a sample period ``ratio`` times as long: as long in seconds, but never too short."""
    options = state.problem.window

    def scaled(records: int) -> int:
        return max(round(records / ratio), min(records, FEWEST_ON_A_COARSE_GRID))

    window = WindowOptions(scaled(options.records), scaled(options.shortest), scaled(options.longest))
    return replace(state, problem=replace(state.problem, window=window), records=scaled(state.records))


def begin(machine: str, site: str, problem: Problem) -> State:
    """The state before the first window."""
    standing = {entry.label: Standing() for entry in problem.free}
    memory, records = begin_memory(problem), problem.window.records
    return State(machine, site, problem, memory, standing, records, problem.excluded)
