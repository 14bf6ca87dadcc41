"""The components of a machine that have been adopted into its twin, and what the specialist has said of them."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.sequential_test import SequentialTest
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import base_model, equation, indices, site_of
from otolith.estimation.imm_filter import moment_match
from otolith.estimation.problem import Component, Problem

FADED = 3.0  # standard deviations of an amplitude under which there is nothing to be seen
SMALL = 0.05  # of the amplitude when it was found: the same
FADES_AFTER = 3  # windows in a row


class Approval(StrEnum):
    """What the specialist has said."""

    OPEN = "open"
    APPROVED = "approved"
    """It belongs to the healthy machine."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another explanation that the data could not tell apart."""

    reason: FaultType
    text: str
    probability: float


@dataclass(frozen=True, slots=True)
class AdoptedComponent:
    """An adopted component."""

    component: Component
    onset: float
    """Unix seconds."""
    probability: float = 1.0
    approval: Approval = Approval.OPEN
    alternatives: tuple[Alternative, ...] = ()
    fading: int = 0
    """Windows in a row in which it could hardly be seen."""


def adopt(
    case: SequentialTest, found: TrackedHypothesis, catalogue: tuple[AdoptedComponent, ...]
) -> tuple[AdoptedComponent, ...]:
    """The catalogue with the components of ``found`` that it does not have."""
    there = {component.key for component in found.problem.components}
    catalogue = tuple(entry for entry in catalogue if entry.component.key in there)
    known = {entry.component.key for entry in catalogue}
    share = case.probabilities[case.hypotheses.index(found)]
    others = alternatives(case, found)
    new = (component for component in found.problem.components if component.key not in known)
    return (*catalogue, *(AdoptedComponent(component, case.onset, share, alternatives=others) for component in new))


def with_approvals(catalogue: tuple[AdoptedComponent, ...], approved: frozenset[str]) -> tuple[AdoptedComponent, ...]:
    """The catalogue with what the specialist has approved, also of what was found again."""
    return tuple(
        replace(entry, approval=Approval.APPROVED) if entry.component.key in approved else entry for entry in catalogue
    )


def alternatives(case: SequentialTest, to: TrackedHypothesis) -> tuple[Alternative, ...]:
    """What could be instead, in words."""
    return tuple(Alternative(entry.reason, describe_hypothesis(entry), share) for entry, share in case.alternatives(to))


def describe_hypothesis(found: TrackedHypothesis) -> str:
    """What a hypothesis says, with its numbers."""
    if found.reason in (FaultType.NOTHING, FaultType.PARAMETER):
        return found.claim.name or str(found.reason)
    twin, problem = base_model(found.problem), found.problem
    if found.reason is FaultType.SENSOR and problem.components:
        return _of_sensor(found)
    values = moment_match(found.belief, problem).mean
    return "; ".join(
        f"{entry.site}: {equation(twin, entry, values[indices(problem, slot)].tolist())}"
        for slot, entry in enumerate(problem.components)
    )


def _of_sensor(found: TrackedHypothesis) -> str:
    """As an engineer would say it."""
    problem = found.problem
    slot = len(problem.components) - 1
    component = problem.components[slot]
    site = site_of(base_model(problem), component.site)
    value = float(moment_match(found.belief, problem).mean[indices(problem, slot)[0]])
    off = f"{value:+.1%}" if component.family == "linear" else f"{value:+.2g} {site.unit}"
    return f"{site.into} reads {off} off: look at the sensor and its scale"


def count_fading(
    catalogue: tuple[AdoptedComponent, ...], problem: Problem, known: Prior
) -> tuple[AdoptedComponent, ...]:
    """The catalogue with how long each component has hardly been seen; ``known`` is of the problem."""
    deviations = np.sqrt(np.diag(known.covariance))
    found = []
    for entry in catalogue:
        slot = slot_of(problem, entry.component)
        if slot is None:
            found.append(entry)
            continue
        place = indices(problem, slot)[0]
        amplitude, small = abs(float(known.mean[place])), SMALL * abs(entry.component.amplitude)
        doubt = FADED * float(deviations[place])
        visible = doubt < abs(entry.component.amplitude)  # else nobody could see whether it is there
        gone = amplitude < small or (visible and amplitude < doubt)
        found.append(replace(entry, fading=entry.fading + 1 if gone else 0))
    return tuple(found)


def slot_of(problem: Problem, component: Component) -> int | None:
    """Where a component sits in the twin, if it does."""
    keys = [entry.key for entry in problem.components]
    return keys.index(component.key) if component.key in keys else None
