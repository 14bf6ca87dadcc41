"""What is carried from window to window. Plain and frozen: it pickles, and no process owns it.

What the specialist says of components, made part of the state: pure, as the heart.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from otolith.discovery.adopted import AdoptedComponent, Approval, slot_of
from otolith.discovery.phase_tracking import phase_unknown, without_slot
from otolith.discovery.sequential_test import FilterState, initial_filter_state
from otolith.estimation.augmented import augment, indices
from otolith.estimation.imm_filter import moment_match, remap_parameters, reset_marginal
from otolith.estimation.problem import Component, Problem, WindowOptions
from otolith.health.status import PreviousStatus

FEWEST_ON_A_COARSE_GRID = 50  # records; a window of fewer says little, however long the sample period


@dataclass(frozen=True, slots=True, eq=False)
class AdaptationState:
    """All that is carried from window to window. Plain and frozen: it pickles."""

    machine: str
    site: str
    problem: Problem
    memory: FilterState
    standing: dict[str, PreviousStatus]
    """Of each free parameter, by its label."""
    records: int
    """Of the next window."""
    restricted: frozenset[str] = frozenset()
    """Keys of components that the machine file rules out."""
    approved: frozenset[str] = frozenset()
    """Keys of components that the specialist has approved."""
    catalogue: tuple[AdoptedComponent, ...] = ()
    """Of the components in the twin."""


def with_sample_grid(state: AdaptationState, configured: WindowOptions, ratio: float) -> AdaptationState:
    """The state for windows with ``ratio`` times the configured sample period: as long in seconds, never too short."""

    def scaled(records: int) -> int:
        return max(round(records / ratio), min(records, FEWEST_ON_A_COARSE_GRID))

    window = WindowOptions(scaled(configured.records), scaled(configured.shortest), scaled(configured.longest))
    return replace(state, problem=replace(state.problem, window=window), records=window.records)


def initial_state(machine: str, site: str, problem: Problem) -> AdaptationState:
    """The state before the first window."""
    standing = {entry.label: PreviousStatus() for entry in problem.free}
    memory, records = initial_filter_state(problem), problem.window.records
    return AdaptationState(machine, site, problem, memory, standing, records, problem.excluded)


def without_component(state: AdaptationState, component: Component) -> AdaptationState:
    """The state without a component; a case, which was about another twin, is dropped."""
    rest = tuple(entry for entry in state.catalogue if entry.component.key != component.key)
    slot = slot_of(state.problem, component)
    if slot is None:
        return replace(state, catalogue=rest)
    problem, belief, turned = without_slot(state.problem, state.memory.belief, state.memory.turned, slot)
    memory = replace(state.memory, belief=belief, turned=turned, case=None)
    return replace(state, problem=problem, memory=memory, catalogue=rest)


OLDER = 3.0  # times the standard deviations before a restart: nobody has looked meanwhile


@dataclass(frozen=True, slots=True)
class OperatorDecisions:
    """What the specialist has said, by the keys of components."""

    approved: frozenset[str] = frozenset()
    """They belong to the healthy machine."""
    rejected: frozenset[str] = frozenset()
    """They are no components, and not to be looked for."""
    forgotten: Mapping[str, float] = field(default_factory=dict)
    """Unix seconds: what was found before then is to be found anew."""


@dataclass(frozen=True, slots=True)
class ComponentRecord:
    """A component as it was known before a restart."""

    adopted: AdoptedComponent
    values: tuple[float, ...]
    """Amplitude, and inner number and phase as far as it has them."""
    deviations: tuple[float, ...]


def apply_decisions(state: AdaptationState, decisions: OperatorDecisions) -> AdaptationState:
    """The state after the specialist's word."""
    for entry in state.catalogue:
        key = entry.component.key
        if key in decisions.rejected or decisions.forgotten.get(key, -np.inf) > entry.onset:
            state = without_component(state, entry.component)
    approvals = tuple(
        replace(entry, approval=Approval.APPROVED if entry.component.key in decisions.approved else Approval.OPEN)
        for entry in state.catalogue
    )
    problem, memory = replace(state.problem, excluded=state.restricted | decisions.rejected), state.memory
    if problem.excluded != state.problem.excluded:  # an open case was sought under other rules
        memory = replace(memory, case=None)
    return replace(state, problem=problem, memory=memory, catalogue=approvals, approved=decisions.approved)


def restore_components(state: AdaptationState, kept: tuple[ComponentRecord, ...]) -> AdaptationState:
    """A state that begins with what is ``kept`` of components; their phases have to be found again."""
    if not kept:
        return state
    problem = augment(state.problem, [entry.adopted.component for entry in kept])
    belief = remap_parameters(state.memory.belief, state.problem, problem)
    for slot, entry in enumerate(kept):
        where = indices(problem, slot)
        for number, (at, value, sd) in enumerate(zip(where, entry.values, entry.deviations, strict=True)):
            if number == 2:
                belief = phase_unknown(belief, problem, at)  # a phase
            else:
                belief = reset_marginal(belief, at, OLDER * sd / problem.scale[at], value / problem.scale[at])
    catalogue = tuple(entry.adopted for entry in kept)
    return replace(state, problem=problem, memory=replace(state.memory, belief=belief), catalogue=catalogue)


def component_records(state: AdaptationState) -> tuple[ComponentRecord, ...]:
    """What is to be kept of the components in the twin."""
    problem, found = state.problem, []
    known = moment_match(state.memory.belief, problem)
    deviations = np.sqrt(np.diag(known.covariance))
    for entry in state.catalogue:
        slot = slot_of(problem, entry.component)
        if slot is not None:
            at = indices(problem, slot)
            found.append(ComponentRecord(entry, tuple(known.mean[at].tolist()), tuple(deviations[at].tolist())))
    return tuple(found)
