"""The decision after a window, which update of the posterior it leads to, and the components adopted by it.

Of an adopted component: since when and how surely it is in the twin, approved or not, and whether it fades.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

from otolith.discovery.alternatives import (
    ALTERNATIVES,
    COMPONENT_WINDOWS,
    UPDATES,
    AlternativeRow,
    PosteriorUpdate,
    WindowDecision,
    describe_hypothesis,
)
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.sequential_test import MAX_OPEN_WINDOWS, SequentialTest
from otolith.estimation.evidence import CHANCE_DEVIATE, DECISIVE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, indices, site_of, slot_of

MAX_COST = 4.0  # RMSE in units of the noise above which no hypothesis is accepted
YOUNG_WINDOWS = 3  # learned windows that do not outweigh more windows that agree with each other
INSIGNIFICANT_SHARE = 0.05  # of the discovered amplitude, below which it is not seen either
BEYOND_BOUNDS = 3.0  # times the bounds of a positive parameter: beyond it no hypothesis is accepted


@dataclass(frozen=True, slots=True, eq=False)
class WindowOutcome:
    """A decision with the hypothesis that it rests on."""

    decision: WindowDecision
    hypothesis: TrackedHypothesis

    @property
    def update(self) -> PosteriorUpdate:
        """How the window changes the posterior."""
        return UPDATES[self.decision]


def decide(test: SequentialTest, learned: int) -> WindowOutcome:
    """Return the decision that the evidence so far allows, where the filter had ``learned`` windows before the test.

    The first rule that applies decides; ``docs/explanation/discovery.md`` has them as a table.
    """
    best, is_young = test.best, learned <= YOUNG_WINDOWS
    if is_young and 0 < learned < test.counts.tested and (anew := _all_moved(test)) is not None and is_plausible(anew):
        return WindowOutcome(WindowDecision.STEPPED, anew)
    if best.type is FaultType.NOTHING:
        return WindowOutcome(WindowDecision.LEARNED, best)
    if best.cost > MAX_COST:
        return WindowOutcome(WindowDecision.REFUSED, best)
    if test.is_ambiguous:
        several = test.counts.since_search >= COMPONENT_WINDOWS
        return WindowOutcome(WindowDecision.AMBIGUOUS if several else WindowDecision.SUSPECTED, best)
    for kind, row in ALTERNATIVES.items():
        if _is_agreed(test, row, kind, is_young=is_young) and (outcome := _outcome(test, row, kind)) is not None:
            return outcome
    return WindowOutcome(WindowDecision.SUSPECTED, best)


def _is_agreed(test: SequentialTest, row: AlternativeRow, kind: FaultType, *, is_young: bool) -> bool:
    """Whether enough windows agree that a hypothesis of type ``kind`` is probable enough.

    If ``is_young``, few windows have updated the filter. Where even the best hypothesis leaves structure, the cause may
    be none of the hypotheses: then no data are wrong, and no parameter has moved. A sudden change that explains windows
    for as long as a test distinguishes causes is accepted beside what the twin always leaves.
    """
    best, needed = test.best, max(row.windows, row.windows_while_young if is_young else 0)
    is_lasting = test.counts.leading >= MAX_OPEN_WINDOWS and best.is_explained
    needs_all = row.is_of_data or (row.decision is WindowDecision.STEPPED and not is_lasting)
    may_be = (row.is_of_data or best.type is kind) and not (needs_all and best.leaves_structure)
    return may_be and test.counts.leading >= needed and test.probability(kind) >= row.probability


def _outcome(test: SequentialTest, row: AlternativeRow, kind: FaultType) -> WindowOutcome | None:
    """Return the decision for the best hypothesis of a type on which windows agree; None where it is not certain."""
    accepted, decision = next(item for item in test.hypotheses if item.type is kind), row.decision
    if decision is WindowDecision.STEPPED:
        own, known = ({parameter.label for parameter in each.free} for each in (accepted.problem, test.problem))
        if not own <= known:
            return None
        decision = WindowDecision.FADED if own < known else decision  # a component is insignificant
    if decision is WindowDecision.DISCOVERED:
        is_alone = test.counts.tested >= MAX_OPEN_WINDOWS or not test.alternatives(accepted)
        accepted = _without_undecided_terms(test)
        if not is_alone or accepted.type is not kind:
            return None
    is_certain = is_plausible(accepted) and not _is_below_noise(accepted)
    return WindowOutcome(decision if is_certain else WindowDecision.SUSPECTED, accepted)


def is_plausible(hypothesis: TrackedHypothesis) -> bool:
    """Whether no positive parameter is far beyond its bounds: a mass that nothing excites may become negative."""
    rows = zip(hypothesis.problem.free, hypothesis.posterior.prior().mean.tolist(), strict=False)  # then come trends
    own = [(free, value) for free, value in rows if free.low > 0.0 and not free.name.startswith("_")]
    return all(free.low / BEYOND_BOUNDS <= value <= free.high * BEYOND_BOUNDS for free, value in own)


def _is_below_noise(hypothesis: TrackedHypothesis) -> bool:
    """Whether a hypothesis states an error of an output below the noise of one sample: that is no fault of its sensor.

    In a short window, a small structure of another cause is as constant as an offset.
    """
    problem, slot = hypothesis.problem, len(hypothesis.problem.components) - 1
    if hypothesis.type is not FaultType.SENSOR or slot < 0 or problem.components[slot].family == "linear":
        return False
    site = site_of(problem.base_model, problem.components[slot].site)
    error = abs(float(hypothesis.posterior.prior().mean[indices(problem, slot)[0]]))
    rows = zip(problem.base_model.outputs, problem.noise, strict=True)
    return any(output.name == site.into and site.through == "1" and error < noise for output, noise in rows)


def _all_moved(test: SequentialTest) -> TrackedHypothesis | None:
    """Return the hypothesis that nothing was known of any parameter, if it explains the windows as well as the best."""
    free = len(test.problem.free)
    return next(
        (
            item
            for item in test.hypotheses
            if item.type is FaultType.PARAMETER and item.hypothesis.added == free == len(item.problem.free)
            if item.misfit <= DECISIVE and item.is_explained
        ),
        None,
    )


def _without_undecided_terms(test: SequentialTest) -> TrackedHypothesis:
    """Return the hypothesis with the fewest components of the best one from which evidence does not set it apart.

    Each component needs decisive evidence of its own, whichever others came with it. The null hypothesis has none.
    """
    own = _components(test.best)
    smaller = [item for item in test.hypotheses if item.type in (FaultType.COMPONENT, FaultType.NOTHING)]
    equal = [item for item in smaller if _components(item) <= own and item.deviance <= DECISIVE]
    return min(equal, key=lambda item: len(_components(item)), default=test.best)


def _components(hypothesis: TrackedHypothesis) -> frozenset[str]:
    return frozenset(component.key for component in hypothesis.problem.components)


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
    onset: float  # Service time, s
    probability: float = 1.0  # When it was adopted
    approval: Approval = Approval.OPEN
    alternatives: tuple[Alternative, ...] = ()
    fading: int = 0  # Consecutive windows in which it was not significant

    @property
    def has_faded(self) -> bool:
        """Whether it may leave the twin."""
        return self.fading >= COMPONENT_WINDOWS


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


def _left(posterior: Posterior, slot: int) -> float:
    """Return which share of its amplitude a component still has: what dies away has an effect for a while only."""
    component = posterior.problem.components[slot]
    if component.family != "negative exponential" or component.source != "t":
        return 1.0
    rate, age = (
        float(posterior.prior().mean[indices(posterior.problem, slot)[1]]),
        posterior.belief.end - component.origin,
    )
    return math.exp(-max(rate * age, 0.0))


def count_fading(adopted: tuple[AdoptedComponent, ...], posterior: Posterior) -> tuple[AdoptedComponent, ...]:
    """Return the components with the number of windows in which each was not significant."""
    prior = posterior.prior()
    counted = []
    for item in adopted:
        slot = slot_of(posterior.problem, item.component)
        if slot is not None:
            index = indices(posterior.problem, slot)[0]
            amplitude, discovered = abs(float(prior.mean[index])), abs(item.component.amplitude)
            doubt = CHANCE_DEVIATE * float(prior.sd[index])
            visible = doubt < discovered  # otherwise no window could show it
            effect = amplitude * _left(posterior, slot)
            gone = effect < INSIGNIFICANT_SHARE * discovered or (visible and amplitude < doubt)
            item = replace(item, fading=item.fading + 1 if gone else 0)  # noqa: PLW2901 - the counted item
        counted.append(item)
    return tuple(counted)
