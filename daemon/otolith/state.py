"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it."""

from dataclasses import dataclass, replace

from otolith.adaptation.catalogue import Entry, slot_of
from otolith.adaptation.component import Component
from otolith.adaptation.gate import Memory, begin_memory
from otolith.adaptation.problem import Problem, WindowOptions
from otolith.adaptation.tracking import left_out
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


def regridded(state: State, configured: WindowOptions, ratio: float) -> State:
    """The state for windows with ``ratio`` times the configured sample period: as long in seconds, never too short."""

    def scaled(records: int) -> int:
        return max(round(records / ratio), min(records, FEWEST_ON_A_COARSE_GRID))

    window = WindowOptions(scaled(configured.records), scaled(configured.shortest), scaled(configured.longest))
    return replace(state, problem=replace(state.problem, window=window), records=window.records)


def begin(machine: str, site: str, problem: Problem) -> State:
    """The state before the first window."""
    standing = {entry.label: Standing() for entry in problem.free}
    memory, records = begin_memory(problem), problem.window.records
    return State(machine, site, problem, memory, standing, records, problem.excluded)


def without_component(state: State, component: Component) -> State:
    """The state without a component; a case, which was about another twin, is dropped."""
    rest = tuple(entry for entry in state.catalogue if entry.component.key != component.key)
    slot = slot_of(state.problem, component)
    if slot is None:
        return replace(state, catalogue=rest)
    problem, belief, turned = left_out(state.problem, state.memory.belief, state.memory.turned, slot)
    memory = replace(state.memory, belief=belief, turned=turned, case=None)
    return replace(state, problem=problem, memory=memory, catalogue=rest)
