"""Components that have been adopted into the twin: since when, how surely, approved or not, and whether they fade."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.discovery.hypotheses import FaultType, TrackedHypothesis, describe_hypothesis
from otolith.discovery.sequential_test import SequentialTest
from otolith.estimation.augmented import indices, slot_of
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component

INSIGNIFICANT = 3.0  # standard deviations of an amplitude below which the component is not seen
INSIGNIFICANT_SHARE = 0.05  # of the discovered amplitude: the same, however certain
FADED_AFTER = 3  # consecutive windows


class Approval(StrEnum):
    """What the operator decided."""

    OPEN = "open"
    APPROVED = "approved"
    """The component belongs to the healthy machine."""


@dataclass(frozen=True, slots=True)
class Alternative:
    """Another hypothesis that the data do not distinguish."""

    type: FaultType
    text: str
    probability: float


@dataclass(frozen=True, slots=True)
class AdoptedComponent:
    """A component in the twin, with its history."""

    component: Component
    onset: float
    """Unix seconds."""
    probability: float = 1.0
    """When it was adopted."""
    approval: Approval = Approval.OPEN
    alternatives: tuple[Alternative, ...] = ()
    fading: int = 0
    """Consecutive windows in which it was not significant."""

    @property
    def has_faded(self) -> bool:
        """Whether it may leave the twin."""
        return self.fading >= FADED_AFTER


def adopt(
    adopted: tuple[AdoptedComponent, ...], test: SequentialTest, accepted: TrackedHypothesis
) -> tuple[AdoptedComponent, ...]:
    """Return the components of ``accepted``: those known already, then the new ones."""
    kept = keep_present(adopted, accepted.problem.components)
    known = {item.component.key for item in kept}
    share, others = test.probabilities[test.hypotheses.index(accepted)], alternatives_of(test, accepted)
    new = (component for component in accepted.problem.components if component.key not in known)
    return (*kept, *(AdoptedComponent(component, test.onset, share, alternatives=others) for component in new))


def keep_present(
    adopted: tuple[AdoptedComponent, ...], components: Iterable[Component]
) -> tuple[AdoptedComponent, ...]:
    """Return those whose components are in the twin."""
    present = {component.key for component in components}
    return tuple(item for item in adopted if item.component.key in present)


def with_approvals(adopted: tuple[AdoptedComponent, ...], approved: frozenset[str]) -> tuple[AdoptedComponent, ...]:
    """Return the components, approved where the operator approved their keys."""
    return tuple(
        replace(item, approval=Approval.APPROVED) if item.component.key in approved else item for item in adopted
    )


def alternatives_of(test: SequentialTest, to: TrackedHypothesis) -> tuple[Alternative, ...]:
    """Return what the data do not distinguish from ``to``, in words."""
    return tuple(Alternative(item.type, describe_hypothesis(item), share) for item, share in test.alternatives(to))


def count_fading(adopted: tuple[AdoptedComponent, ...], posterior: Posterior) -> tuple[AdoptedComponent, ...]:
    """Return the components with the number of windows in which each was not significant."""
    prior = posterior.prior()
    deviations = np.sqrt(np.diag(prior.covariance))
    counted = []
    for item in adopted:
        slot = slot_of(posterior.problem, item.component)
        if slot is not None:
            index = indices(posterior.problem, slot)[0]
            amplitude, discovered = abs(float(prior.mean[index])), abs(item.component.amplitude)
            doubt = INSIGNIFICANT * float(deviations[index])
            visible = doubt < discovered  # otherwise no window could show it
            gone = amplitude < INSIGNIFICANT_SHARE * discovered or (visible and amplitude < doubt)
            item = replace(item, fading=item.fading + 1 if gone else 0)  # noqa: PLW2901 - the counted item
        counted.append(item)
    return tuple(counted)
