"""What the specialist says of components, made part of the state: pure, as the heart."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from otolith.adaptation.catalogue import Approval, Entry, slot_of
from otolith.adaptation.completion import completed, places, without
from otolith.adaptation.fusion import Belief, rebased
from otolith.adaptation.tracking import UNKNOWN
from otolith.state import State

OLDER = 3.0  # times the standard deviations before a restart: nobody has looked meanwhile


@dataclass(frozen=True, slots=True)
class Decisions:
    """What the specialist has said, by the keys of components."""

    approved: frozenset[str] = frozenset()
    """They belong to the healthy machine."""
    rejected: frozenset[str] = frozenset()
    """They are no components, and not to be looked for."""
    forgotten: Mapping[str, float] = field(default_factory=dict)
    """Unix seconds: what was found before then is to be found anew."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A component as it was known before a restart."""

    entry: Entry
    values: tuple[float, ...]
    """Amplitude, and inner number and phase as far as it has them."""
    deviations: tuple[float, ...]


def decided(state: State, decisions: Decisions) -> State:
    """The state after the specialist's word."""
    for entry in state.catalogue:
        key = entry.component.key
        if key in decisions.rejected or decisions.forgotten.get(key, -np.inf) > entry.onset:
            state = _left_out(state, entry)
    approvals = tuple(
        replace(entry, approval=Approval.APPROVED if entry.component.key in decisions.approved else Approval.OPEN)
        for entry in state.catalogue
    )
    problem, memory = replace(state.problem, excluded=state.restricted | decisions.rejected), state.memory
    if problem.excluded != state.problem.excluded:  # an open case was sought under other rules
        memory = replace(memory, case=None)
    return replace(state, problem=problem, memory=memory, catalogue=approvals, approved=decisions.approved)


def _left_out(state: State, entry: Entry) -> State:
    """Without a component of the catalogue; a case, which was about another twin, is dropped."""
    slot = slot_of(state.problem, entry.component)
    rest = tuple(other for other in state.catalogue if other is not entry)
    if slot is None:
        return replace(state, catalogue=rest)
    fewer = without(state.problem, state.problem.components[slot])
    turned = state.memory.turned
    if turned is not None:
        turned = replace(turned, by=tuple(by for index, by in enumerate(turned.by) if index != slot))
    belief = rebased(state.memory.belief, state.problem, fewer)
    memory = replace(state.memory, belief=belief, turned=turned, case=None)
    return replace(state, problem=fewer, memory=memory, catalogue=rest)


def restored(state: State, kept: tuple[Kept, ...]) -> State:
    """A state that begins with what is ``kept`` of components; their phases have to be found again."""
    if not kept:
        return state
    problem = completed(state.problem, [entry.entry.component for entry in kept])
    belief = rebased(state.memory.belief, state.problem, problem)
    for slot, entry in enumerate(kept):
        where = places(problem, slot)
        for number, (at, value, sd) in enumerate(zip(where, entry.values, entry.deviations, strict=True)):
            lost = number == 2  # a phase
            belief = _known(
                belief, at, value / problem.scale[at], (UNKNOWN if lost else OLDER * sd) / problem.scale[at]
            )
    catalogue = tuple(entry.entry for entry in kept)
    return replace(state, problem=problem, memory=replace(state.memory, belief=belief), catalogue=catalogue)


def _known(belief: Belief, at: int, value: float, sd: float) -> Belief:
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    mean[:, at] = value
    covariance[:, at, :] = covariance[:, :, at] = 0.0
    covariance[:, at, at] = sd**2
    return replace(belief, mean=mean, covariance=covariance)


def kept(state: State) -> tuple[Kept, ...]:
    """What is to be kept of the components in the twin."""
    belief, problem = state.memory.belief, state.problem
    size = np.tile(problem.scale, 2)
    mean = (belief.weight @ belief.mean) * size
    deviations = np.sqrt(np.einsum("m,mii->i", belief.weight, belief.covariance)) * size
    found = []
    for entry in state.catalogue:
        slot = slot_of(problem, entry.component)
        if slot is not None:
            at = places(problem, slot)
            found.append(Kept(entry, tuple(mean[at].tolist()), tuple(deviations[at].tolist())))
    return tuple(found)
