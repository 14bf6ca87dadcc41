"""A case: several explanations of what was not to be expected, followed from window to window until one is right.

Each explanation foretells the next window with what it has learned so far, so that evidence is gathered over windows
that nothing was fitted to before (prequential: A. P. Dawid, Journal of the Royal Statistical Society A 147, 1984).

Whether a window may teach: what is made of one, by what healthy change foretold and by what else could explain it.

A window that no healthy change explains is either wrong or the first after something has happened. So nothing is
learned from it: a case is opened (see :mod:`otolith.discovery.sequential_test`), and the next windows decide it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import compress

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import CLEARLY
from otolith.discovery.hypotheses import (
    FaultHypothesis,
    FaultType,
    FittedHypothesis,
    TrackedHypothesis,
    begun,
    cost_of,
    evidence_of,
    fit_hypothesis,
    is_usable,
    occam,
    prune,
    pruned,
    residual_variance_factor,
)
from otolith.discovery.phase_tracking import PhaseAdvance, phase_advance, propagate_phases
from otolith.discovery.search import ScreeningResult, onset, screening_test, search
from otolith.estimation.arrival_cost import Evidence, Prior
from otolith.estimation.imm_filter import (
    ImmPosterior,
    inflate_variance,
    initial_posterior,
    moment_match,
    nis,
    predict,
    update,
)
from otolith.estimation.objective import EXPLAINED
from otolith.estimation.problem import Problem

MOST = 7  # explanations that are followed
WORTH = 30.0  # in -2 log evidence: an explanation worse than the best by more is not followed
MOST_OF_ONE = 20.0  # the same, of one window: none decides alone
MOST_OF_FIRST = 15.0  # the same, of the first: if it was wrong, the second one outweighs it
DIVERGED = 1e12  # χ² of a twin that explains nothing at all
SEEN_AGAIN = 3  # windows, after which an explanation must be more than what nothing would be
LONGEST_MEMORY = 60.0  # the same: how far behind one may fall, so that it can come back when things change


@dataclass(frozen=True, slots=True)
class Told:
    """How well a window is explained by what explains it best."""

    chi_square: float = 0.0
    price: float = 0.0
    """Of the explanation, in -2 log evidence."""
    records: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class SequentialTest:
    """What could have happened. Plain: it pickles."""

    hypotheses: tuple[TrackedHypothesis, ...]
    """The best first."""
    onset: float
    """Unix seconds."""
    windows: int = 1
    """That these hypotheses have been followed."""
    leading: int = 1
    """Windows in a row in which the best was the best."""
    last: Told = Told()
    """Of the last window."""
    surprise: float = 1.0
    """Of the first window under "nothing has happened", χ² per record."""

    @property
    def best(self) -> TrackedHypothesis:
        """The most probable one."""
        return self.hypotheses[0]

    @property
    def probabilities(self) -> list[float]:
        """Of each hypothesis."""
        weights = np.exp(-0.5 * np.array([entry.deviance for entry in self.hypotheses]))
        found: list[float] = (weights / weights.sum()).tolist()
        return found

    def probability(self, reason: FaultType) -> float:
        """Of all hypotheses of that reason."""
        return sum(
            share for share, entry in zip(self.probabilities, self.hypotheses, strict=True) if entry.reason is reason
        )

    @property
    def doubts_parameters(self) -> bool:
        """Whether parameters may have moved."""
        near = [self.best, *(entry for entry, _ in self.alternatives(self.best))]
        return any(entry.reason is FaultType.PARAMETER for entry in near)

    @property
    def open(self) -> bool:
        """Whether something of another kind could as well have happened."""
        return any(entry.reason is not self.best.reason for entry, _ in self.alternatives(self.best))

    def alternatives(self, to: TrackedHypothesis) -> list[tuple[TrackedHypothesis, float]]:
        """The others, with their probabilities, that are hardly less likely than ``to`` (a Bayes factor of 150)."""
        pairs = zip(self.hypotheses, self.probabilities, strict=True)
        data = [entry.deviance - entry.claim.odds for entry in self.hypotheses]
        own = data[self.hypotheses.index(to)]
        return [
            pair
            for pair, deviance in zip(pairs, data, strict=True)
            if pair[0] is not to and abs(deviance - own) <= CLEARLY
        ]


def opened(
    explanations: Sequence[FittedHypothesis], problem: Problem, expected: ImmPosterior, window: Window
) -> SequentialTest:
    """A case on ``window``; ``expected`` is what was known, carried to its end."""
    explanations = [*explanations[:1], *(entry for entry in explanations[1:] if entry.chi_square < DIVERGED)]
    records = explanations[0].informed.count
    left = residual_variance_factor([entry.chi_square for entry in explanations], records)
    deviances = [entry.deviance(records, left) for entry in explanations]
    order = np.argsort(deviances, kind="stable").tolist()
    least = deviances[order[0]]
    kept = [at for at in order if deviances[at] <= least + WORTH][:MOST]
    kept += [
        at for at in order if explanations[at].reason in (FaultType.NOTHING, FaultType.PARAMETER) and at not in kept
    ]
    tried = [
        begun(explanations[at], problem, expected, window, min(deviances[at] - least, MOST_OF_FIRST)) for at in kept
    ]
    found = [entry for entry in tried if entry is not None]
    surprise = explanations[0].chi_square / max(records, 1.0)
    best = explanations[order[0]]
    last = Told(best.chi_square, least - best.chi_square / left, records)
    return SequentialTest(_sorted(found), window.start, last=last, surprise=max(surprise, 1.0))


def followed(case: SequentialTest, window: Window) -> SequentialTest:
    """The case after one more window."""
    fits, told = _explained(case, window)
    if not fits:
        return replace(case, windows=case.windows + 1)
    records = fits[0][2].informed.count
    left = residual_variance_factor([fit.chi_square for _, _, fit in fits], records)
    deviances = [
        fit.chi_square / left + occam(belief, evidence, entry.problem)
        for (entry, belief, fit), (evidence, _) in zip(fits, told, strict=True)
    ]
    least = min(deviances)
    best_chi = fits[int(np.argmin(deviances))][2].chi_square
    case = replace(case, last=Told(best_chi, least - best_chi / left, records))
    found = []
    for (entry, belief, fit), (evidence, last), deviance in zip(fits, told, deviances, strict=True):
        after = update(belief, evidence, entry.problem)
        more = min(deviance - least, MOST_OF_ONE)
        found.append(replace(
            entry, belief=after, turned=phase_advance(entry.problem, window, last), cost=cost_of(fit),
            deviance=entry.deviance + more,
        ))  # fmt: skip
    if case.windows + 1 >= SEEN_AGAIN:
        found = prune(found, deviances)
    hypotheses = _sorted([pruned(entry) for entry in found])
    leading = case.leading + 1 if hypotheses[0].claim.name == case.best.claim.name else 1
    case = replace(case, leading=leading)
    best = next((fit for entry, _, fit in fits if entry.claim == hypotheses[0].claim), None)
    if best is None:  # it has lost a component, and there was none of it in the window
        return replace(case, hypotheses=hypotheses, windows=case.windows + 1)
    gain = screening_test(best.problem, window, best.prior, best.fit.guess).gain
    hypotheses = (replace(hypotheses[0], silent=gain <= 0.0), *hypotheses[1:])
    return replace(case, hypotheses=hypotheses, windows=case.windows + 1)


def _explained(
    case: SequentialTest, window: Window
) -> tuple[list[tuple[TrackedHypothesis, ImmPosterior, FittedHypothesis]], list[tuple[Evidence, Array]]]:
    """Each hypothesis that can use the window, with its belief carried there and its fit, and what that tells."""
    fits = []
    for entry in case.hypotheses:
        belief = predict(propagate_phases(entry.belief, entry.problem, entry.turned, window), window.end)
        prior = moment_match(belief, entry.problem)
        fits.append((entry, belief, fit_hypothesis(replace(entry.claim, numbers=0), entry.problem, window, prior)))
    fits = [fit for fit in fits if fit[2].chi_square < DIVERGED] or fits[:1]
    told = [evidence_of(fit) for _, _, fit in fits]
    usable = [
        is_usable(entry.claim, belief, evidence, entry.problem)
        for (entry, belief, _), (evidence, _) in zip(fits, told, strict=True)
    ]
    return list(compress(fits, usable)), list(compress(told, usable))


def joined(case: SequentialTest, fresh: SequentialTest) -> SequentialTest:
    """A case with what a new search has found in its last window, if that is clearly better than what was followed."""
    old, new = case.last, fresh.last
    better = (
        (old.chi_square - new.chi_square) / residual_variance_factor([new.chi_square], old.records)
        + old.price
        - new.price
    )
    if better <= CLEARLY:
        return case
    known = {entry.claim.name for entry in case.hypotheses}
    more = [entry for entry in fresh.hypotheses if entry.claim.name not in known]
    lead = min(better, MOST_OF_ONE)
    hypotheses = _sorted([*(replace(entry, deviance=entry.deviance + lead) for entry in case.hypotheses), *more])
    leading = case.leading if hypotheses[0].claim.name == case.best.claim.name else 1
    return replace(case, hypotheses=hypotheses[: 2 * MOST], leading=leading)


def _sorted(found: list[TrackedHypothesis]) -> tuple[TrackedHypothesis, ...]:
    least = min(entry.deviance for entry in found)
    ordered = sorted(found, key=lambda entry: entry.deviance)
    return tuple(replace(entry, deviance=min(entry.deviance - least, LONGEST_MEMORY)) for entry in ordered)


DEVIATE = 6.0  # of the standard normal distribution: once in a thousand million windows
REFUSED = 4.0  # cost beyond which a window contradicts whatever is held against it
STEP_AFTER, COMPONENT_AFTER = 2, 3  # windows that must agree
STEP_SURE, COMPONENT_SURE = 0.8, 0.95  # probabilities
SENSOR_SURE, SENSOR_LIKELY = 0.95, 0.5  # the same; the second one suffices where nothing else explains the windows
SHORTEST = 60  # records of what has begun within a window, that tell anything
PATIENCE = 8  # windows for which a component is not adopted while another one explains everything as well


class WindowDecision(StrEnum):
    """What was made of a window."""

    LEARNED = "learned"
    SUSPECTED = "it contradicts what was known: a sudden change or a wrong window; further windows decide"
    STEPPED = "two windows agree on a sudden change"
    DISCOVERED = "several windows agree on a new component"
    FADED = "a component is no longer there"
    SENSOR = "a sensor is wrong: nothing is learned from the window"
    BAD = "the window is not good enough: nothing is learned from it"
    REFUSED = "nothing explains the window, neither parameters nor components: nothing is learned from it"


ACCEPTED = frozenset({WindowDecision.LEARNED, WindowDecision.STEPPED, WindowDecision.DISCOVERED, WindowDecision.FADED})


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """What is carried from window to window. Plain: it pickles."""

    belief: ImmPosterior
    turned: PhaseAdvance | None = None
    """How far the sources of components have come."""
    case: SequentialTest | None = None
    """What could have happened, while it is not decided."""
    contradictions: int = 0
    """Windows in a row that taught nothing because they contradict twin or belief."""


def initial_filter_state(problem: Problem) -> FilterState:
    """Before the first window."""
    return FilterState(initial_posterior(problem))


def limit(problem: Problem) -> float:
    """The surprise (χ² of 2 free degrees) that healthy windows do not reach (E. B. Wilson, M. M. Hilferty, 1931)."""
    degrees = 2.0 * len(problem.free)
    return float(degrees * (1.0 - 2.0 / (9.0 * degrees) + DEVIATE * np.sqrt(2.0 / (9.0 * degrees))) ** 3)


def is_surprising(expected: ImmPosterior, evidence: Evidence, problem: Problem) -> bool:
    """Whether no model of change foretold the window; ``expected`` is the belief carried to its end."""
    return nis(expected, evidence, problem) > limit(problem)


def learn(
    memory: FilterState, expected: ImmPosterior, evidence: Evidence, problem: Problem, now: PhaseAdvance
) -> FilterState:
    """After a window that was to be expected."""
    belief = expected
    if memory.case is not None:  # the window before was wrong, and nobody knows why
        belief = inflate_variance(belief, memory.case.surprise)
    return FilterState(update(belief, evidence, problem), now)


def refuse(memory: FilterState, case: SequentialTest | None = None) -> FilterState:
    """After a window that teaches nothing, with what could have happened."""
    return replace(memory, case=case, contradictions=memory.contradictions + 1)


def considered(
    memory: FilterState, problem: Problem, window: Window, expected: ImmPosterior, known: tuple[Prior, ScreeningResult]
) -> SequentialTest:
    """What could have happened, after ``window``; ``known`` is the prior and a glance at what components would gain.

    Where the explanations of a case do not foretell the window, new ones are sought: something may have begun since.
    """
    prior, seen = known
    if memory.case is None:
        begun = onset(problem, window, prior)
        if begun:
            late = window.records - begun < SHORTEST
            begun = max(min(begun, window.records - SHORTEST), 0)
            expected = _cut(problem, window, expected, begun)
            prior, window = moment_match(expected, problem), window.since(begun)
            if late:  # what has begun in the last moments is for the next window to tell
                return opened(
                    [fit_hypothesis(FaultHypothesis(FaultType.NOTHING), problem, window, prior)],
                    problem,
                    expected,
                    window,
                )
            seen = screening_test(problem, window, prior, prior.mean)
        return opened(search(problem, window, prior, seen), problem, expected, window)
    case = followed(memory.case, window)
    if case.best.silent and case.best.cost <= EXPLAINED:
        return case
    return joined(case, opened(search(problem, window, prior, seen), problem, expected, window))


def _cut(problem: Problem, window: Window, expected: ImmPosterior, begun: int) -> ImmPosterior:
    """What is expected of the window from the record ``begun`` on: phases have run on until then."""
    if not begun or not problem.components:
        return expected
    before = window.until(begun)
    tried = fit_hypothesis(FaultHypothesis(FaultType.NOTHING), problem, before, moment_match(expected, problem))
    now = phase_advance(problem, before, tried.informed.last_state(tried.fit))
    return propagate_phases(expected, problem, now, window.since(begun))


def is_sure_of_some(case: SequentialTest) -> bool:
    """Whether there is a component, whichever it is."""
    return case.windows >= COMPONENT_AFTER and case.probability(FaultType.COMPONENT) >= COMPONENT_SURE


def decided(case: SequentialTest, problem: Problem) -> tuple[WindowDecision, TrackedHypothesis]:
    """What a case comes to by now for a machine of ``problem``, and the hypothesis that it rests on."""
    best = case.best
    if best.reason is FaultType.NOTHING:
        return WindowDecision.LEARNED, best
    if best.cost > REFUSED:
        return WindowDecision.REFUSED, best
    own, known = ({entry.label for entry in each.free} for each in (best.problem, problem))
    agreed = case.leading >= STEP_AFTER and case.probability(best.reason) >= STEP_SURE
    if best.reason is FaultType.PARAMETER and agreed and own <= known:  # fewer if a component has moved down to nothing
        return WindowDecision.STEPPED if own == known else WindowDecision.FADED, best
    if case.probability(FaultType.SENSOR) >= (SENSOR_SURE if case.open else SENSOR_LIKELY):
        return WindowDecision.SENSOR, next(entry for entry in case.hypotheses if entry.reason is FaultType.SENSOR)
    sure = case.leading >= COMPONENT_AFTER and case.probability(FaultType.COMPONENT) >= COMPONENT_SURE
    if best.reason is FaultType.COMPONENT and sure and (case.windows >= PATIENCE or not case.alternatives(best)):
        return WindowDecision.DISCOVERED, best
    return WindowDecision.SUSPECTED, best
