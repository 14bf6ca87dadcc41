"""The decision after a window, which update of the posterior it leads to, and the components adopted by it.

Of an adopted component: since when and how surely it is in the twin, approved or not, and whether it fades.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum, StrEnum

from otolith.discovery.hypotheses import FaultType, TrackedHypothesis, describe_hypothesis
from otolith.discovery.sequential_test import MAX_OPEN_WINDOWS, SequentialTest
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, indices, site_of, slot_of

MAX_COST = 4.0  # RMSE in units of the noise above which no hypothesis is accepted
STEP_WINDOWS, STEP_PROBABILITY = 2, 0.8  # windows that must agree on a moved parameter, and its probability
COMPONENT_WINDOWS, COMPONENT_PROBABILITY = 3, 0.95  # windows that must agree on a component, and its probability
TIMING_WINDOWS = 2  # windows that must agree on a late signal
DATA_FAULT_PROBABILITY = 0.8  # of a faulty sensor or a late signal, if no other type explains the windows as well
YOUNG_WINDOWS = 3  # learned windows that do not outweigh more windows that agree with each other
AMBIGUOUS_WINDOWS = 3  # windows that several causes explain equally
INSIGNIFICANT = 3.0  # standard deviations of an amplitude below which the component is not seen
INSIGNIFICANT_SHARE = 0.05  # of the discovered amplitude, below which it is not seen either
FADED_AFTER = 3  # consecutive windows
BEYOND_BOUNDS = 3.0  # times the bounds of a positive parameter: beyond it no sensor, delay or component is accepted


class WindowDecision(StrEnum):
    """What a window led to."""

    LEARNED = "learned"
    SUSPECTED = "it contradicts the prediction: a sudden change or a wrong window; further windows decide"
    STEPPED = "two windows agree on a sudden change"
    DISCOVERED = "several windows agree on a new component"
    FADED = "a component is no longer there"
    NOISIER = "several windows agree that a signal is less certain than stated"
    AMBIGUOUS = "several hypotheses explain the windows equally well: what they agree on is estimated"
    SENSOR = "a sensor is wrong: its error does not count as a change of a parameter"
    TIMING = "a signal is late: its delay does not count as a change of a parameter"
    BAD = "the window is not good enough: it does not update the estimates"
    REFUSED = "nothing explains the window, neither parameters nor components: it does not update the estimates"

    @property
    def in_words(self) -> str:
        """What a person reads; the value is what programs read."""
        return IN_WORDS.get(self, self.value)


IN_WORDS = {
    WindowDecision.SUSPECTED: (
        "this window differs from the prediction: it may be a sudden change or an outlier, and the next windows decide"
    ),
    WindowDecision.STEPPED: "two windows show the same sudden change",
    WindowDecision.DISCOVERED: "several windows show the same new component",
    WindowDecision.NOISIER: "several windows show other noise than is stated",
    WindowDecision.AMBIGUOUS: (
        "several hypotheses explain the windows equally well: estimated is what they have in common"
    ),
}
"""What people read where the value, which programs read, has to be read twice."""


class PosteriorUpdate(Enum):
    """How a window changes the posterior."""

    NONE = "the posterior of the window before stays"
    FILTER = "the filter is updated with the window"
    HYPOTHESIS = "the posterior of the accepted hypothesis replaces the filter's"


UPDATES = {
    WindowDecision.LEARNED: PosteriorUpdate.FILTER,
    WindowDecision.STEPPED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.DISCOVERED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.FADED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.NOISIER: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.SUSPECTED: PosteriorUpdate.NONE,
    WindowDecision.AMBIGUOUS: PosteriorUpdate.NONE,
    WindowDecision.SENSOR: PosteriorUpdate.NONE,
    WindowDecision.TIMING: PosteriorUpdate.NONE,
    WindowDecision.BAD: PosteriorUpdate.NONE,
    WindowDecision.REFUSED: PosteriorUpdate.NONE,
}
DATA_FAULTS = {FaultType.SENSOR: (WindowDecision.SENSOR, 0), FaultType.TIMING: (WindowDecision.TIMING, TIMING_WINDOWS)}
"""For each type of hypothesis about faulty data: its decision, and how many windows must agree."""
ACCEPTED = frozenset(decision for decision, update in UPDATES.items() if update is not PosteriorUpdate.NONE)


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
    if is_young and 0 < learned < test.counts.tested and (anew := _all_moved(test)) is not None:
        return WindowOutcome(WindowDecision.STEPPED, anew)
    if best.type is FaultType.NOTHING:
        return WindowOutcome(WindowDecision.LEARNED, best)
    if best.cost > MAX_COST:
        return WindowOutcome(WindowDecision.REFUSED, best)
    if test.is_ambiguous:
        several = test.counts.since_search >= AMBIGUOUS_WINDOWS
        return WindowOutcome(WindowDecision.AMBIGUOUS if several else WindowDecision.SUSPECTED, best)
    agreed = test.counts.leading >= STEP_WINDOWS and test.probability(best.type) >= STEP_PROBABILITY
    if best.type is FaultType.NOISE and agreed:
        return WindowOutcome(WindowDecision.NOISIER, best)
    own, known = ({parameter.label for parameter in problem.free} for problem in (best.problem, test.problem))
    if best.type is FaultType.PARAMETER and agreed and own <= known:  # fewer if a component became insignificant
        return WindowOutcome(WindowDecision.STEPPED if own == known else WindowDecision.FADED, best)
    # If it leaves structure, the cause may be none of the hypotheses.
    if not best.leaves_structure and (fault := _data_fault(test, is_young=is_young)) is not None:
        return fault if _is_plausible(fault.hypothesis) else WindowOutcome(WindowDecision.SUSPECTED, fault.hypothesis)
    if _is_component_accepted(test) and (chosen := _without_undecided_terms(test)).type is FaultType.COMPONENT:
        return WindowOutcome(WindowDecision.DISCOVERED if _is_plausible(chosen) else WindowDecision.SUSPECTED, chosen)
    return WindowOutcome(WindowDecision.SUSPECTED, best)


def _data_fault(test: SequentialTest, *, is_young: bool) -> WindowOutcome | None:
    """Return the decision for a faulty sensor or a late signal; None if neither is probable enough.

    If ``is_young``, few windows have updated the filter, and sensors are as little known as components.
    """
    for kind, (decision, windows) in DATA_FAULTS.items():
        needed = COMPONENT_WINDOWS if is_young and kind is FaultType.SENSOR else windows
        if test.probability(kind) >= DATA_FAULT_PROBABILITY and test.counts.leading >= needed:
            accepted = next(item for item in test.hypotheses if item.type is kind)
            return WindowOutcome(WindowDecision.SUSPECTED if _is_below_noise(accepted) else decision, accepted)
    return None


def _is_plausible(hypothesis: TrackedHypothesis) -> bool:
    """Whether no positive parameter is far beyond its bounds: a mass that nothing excites may become negative."""
    rows = zip(hypothesis.problem.free, hypothesis.posterior.prior().mean.tolist(), strict=False)  # then come trends
    own = [(free, value) for free, value in rows if free.low > 0.0 and not free.name.startswith("_")]
    return all(free.low / BEYOND_BOUNDS <= value <= free.high * BEYOND_BOUNDS for free, value in own)


def _is_component_accepted(test: SequentialTest) -> bool:
    """Whether windows agree on a component, and no other hypothesis explains them as well."""
    leads = test.best.type is FaultType.COMPONENT and test.counts.leading >= COMPONENT_WINDOWS
    probable = test.probability(FaultType.COMPONENT) >= COMPONENT_PROBABILITY
    return leads and probable and (test.counts.tested >= MAX_OPEN_WINDOWS or not test.alternatives(test.best))


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
    counted = []
    for item in adopted:
        slot = slot_of(posterior.problem, item.component)
        if slot is not None:
            index = indices(posterior.problem, slot)[0]
            amplitude, discovered = abs(float(prior.mean[index])), abs(item.component.amplitude)
            doubt = INSIGNIFICANT * float(prior.sd[index])
            visible = doubt < discovered  # otherwise no window could show it
            gone = amplitude < INSIGNIFICANT_SHARE * discovered or (visible and amplitude < doubt)
            item = replace(item, fading=item.fading + 1 if gone else 0)  # noqa: PLW2901 - the counted item
        counted.append(item)
    return tuple(counted)
