"""The sequential test: competing hypotheses for windows that the prediction does not explain.

A test opens with a window that contradicts the prediction, or that is worth a search. Every hypothesis then predicts
each further window with its own posterior, so that evidence is gathered over windows to which nothing was fitted before
(prequential: A. P. Dawid, Journal of the Royal Statistical Society A 147, 1984). ``docs/explanation/discovery.md`` has
the equations.

Hypotheses of different types or places may explain the same windows: a resistance of the pipe that has risen, and a
gain of the sensor of the throttle. Their prior weights and numbers of values must not decide between them. They form a
class: the best hypothesis of each place has the same probability. What is published of a parameter is the mixture of
all hypotheses. It is certain where they agree, and its interval holds all of them where they differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.alternatives import AGREEING_WINDOWS, ALTERNATIVES, COMPONENT_WINDOWS
from otolith.discovery.hypotheses import (
    MAX_DEVIANCE,
    FaultHypothesis,
    FaultType,
    FittedHypothesis,
    Proposal,
    TrackedHypothesis,
    evidence_factor,
    is_possible,
)
from otolith.discovery.noise_hypothesis import is_white, normalisation
from otolith.discovery.same_statement import prune, without_insignificant, without_repetitions
from otolith.discovery.screening import ScreeningResult
from otolith.discovery.search import explained_again, fit_hypotheses, screening_test, search, search_from_onset
from otolith.estimation.evidence import (
    DECISIVE,
    NO_EVIDENCE,
    LogEvidence,
    discount,
    likelihood_ratios,
    log_determinant,
)
from otolith.estimation.imm_filter import MAX_PRECISION
from otolith.estimation.information import QUANTILE, Evidence, Prior
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit

MAX_HYPOTHESES = 7  # that are tracked after a search
MAX_FIRST_EVIDENCE = 1.5 * DECISIVE  # in -2 log evidence: of the first window, so that the second one can outweigh it
MAX_WINDOW_EVIDENCE = 2.0 * DECISIVE  # in -2 log evidence: of any window, so that none decides alone
MAX_TOTAL_DEVIANCE = 3.0 * MAX_WINDOW_EVIDENCE  # in -2 log evidence: a hypothesis can return when things change
DIVERGED = 1e12  # χ² of a twin that explains nothing
MAX_OPEN_WINDOWS = 8  # windows after which a test tracks only the best hypothesis of each place
MIN_WEIGHT = 0.05  # of a hypothesis whose own interval the published one contains
WRONG_WINDOW = 0.5  # probability that the window that opened a test is itself wrong


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisStep:
    """Prediction, fit and evidence of one tracked hypothesis for one window."""

    tracked: TrackedHypothesis
    predicted: Posterior
    fitted: FittedHypothesis
    evidence: Evidence
    log_evidence: LogEvidence = NO_EVIDENCE  # Of this window

    @property
    def is_usable(self) -> bool:
        """Whether the prediction can be updated without losing all digits; always for the null hypothesis."""
        return is_usable(self.tracked.hypothesis, self.predicted, self.evidence)

    def updated(self, deviance: float, misfit: float) -> TrackedHypothesis | None:
        """Return the hypothesis after the window, with so much more deviance and misfit.

        None if the window contradicts the delay that it states, or a component leaves its physical range.
        """
        posterior = self.predicted.update(self.predicted.innovation(self.evidence), self.fitted.fit.advance())
        own = self.fitted.fit
        tracked = _with_window(replace(self.tracked, posterior=posterior), own)
        tracked = tracked.worse_by(deviance, misfit)
        if self.tracked.type is FaultType.COMPONENT and not is_possible(posterior.problem, posterior.prior().mean):
            return None
        return ALTERNATIVES[tracked.type].after_window(tracked, own)


def is_usable(hypothesis: FaultHypothesis, predicted: Posterior, evidence: Evidence) -> bool:
    """Whether ``evidence`` can update the prediction without losing all digits; always for the null hypothesis."""
    if hypothesis.type is FaultType.NOTHING:
        return True
    relative = np.abs(evidence.sqrt_information) * predicted.prior().sd
    return bool((relative < MAX_PRECISION).all())  # also false for not-a-number


@dataclass(frozen=True, slots=True)
class FilterEvidence:
    """Evidence for and against the filter, which has not learned from the window that opened the test.

    That window may itself have been wrong. So only those after it count, each by the difference that it makes between
    the filter and the best hypothesis, Δ = (χ² of the filter - χ² of the best) / discount::

        deviance ← deviance + Δ                  -2 log likelihood of the filter, relative to the best hypothesis
        cusum    ← cusum + Δ - DECISIVE          cumulative sum: it falls in windows that give less

    (E. S. Page, Biometrika 41, 1954.) ``docs/explanation/discovery.md`` has the bounds.
    """

    deviance: float = 0.0
    cusum: float = -MAX_WINDOW_EVIDENCE  # below zero: it must exceed the complexity penalty of a hypothesis as well

    def after(self, chi_square: float, best: LogEvidence) -> "FilterEvidence":
        """Return the evidence after a window, of which the filter leaves ``chi_square``."""
        more = LogEvidence(chi_square, best.penalty).over(best)
        deviance = self.deviance + np.clip(more, -MAX_WINDOW_EVIDENCE, MAX_WINDOW_EVIDENCE)
        cusum = self.cusum + np.clip(more - DECISIVE, -MAX_WINDOW_EVIDENCE, MAX_WINDOW_EVIDENCE)
        return FilterEvidence(
            float(np.clip(deviance, -MAX_TOTAL_DEVIANCE, MAX_TOTAL_DEVIANCE)),
            float(np.clip(cusum, -MAX_WINDOW_EVIDENCE, MAX_TOTAL_DEVIANCE)),
        )

    def worse_by(self, deviance: float) -> "FilterEvidence":
        """Return the evidence with more deviance, as the best hypothesis has become another."""
        return replace(self, deviance=self.deviance + deviance)

    @property
    def is_against(self) -> bool:
        """Whether the windows are decisive evidence against the filter."""
        return self.cusum > DECISIVE

    @property
    def is_for(self) -> bool:
        """Whether the windows are decisive evidence for the filter."""
        return self.deviance < -DECISIVE

    @property
    def probability(self) -> float:
        """Probability of the filter: that the window that opened the test was itself wrong."""
        return float(WRONG_WINDOW / (WRONG_WINDOW + (1.0 - WRONG_WINDOW) * np.exp(0.5 * self.deviance)))


@dataclass(frozen=True, slots=True)
class WindowCounts:
    """How many windows, up to the last one, agree with each other. The one that opens a test is the first."""

    tested: int = 1  # Since the test was opened; hypotheses that a later search added are younger
    leading: int = 1  # In a row with the same best hypothesis; of a component, since it last left structure
    since_search: int = 1  # Since a hypothesis of a new search took the lead
    resolved: int = AGREEING_WINDOWS  # In a row after which one cause explained all windows best
    expected: int = 0  # In a row that the filter expected, and that did not confirm the test

    def after(self, before: TrackedHypothesis, best: TrackedHypothesis, *, is_resolved: bool) -> "WindowCounts":
        """Return the counts after a tested window, by the best hypothesis ``before`` it and the ``best`` one now."""
        is_same = best.hypothesis.name == before.hypothesis.name
        leaves_structure = best.type is FaultType.COMPONENT and best.leaves_structure
        return replace(
            self,
            leading=(0 if leaves_structure else self.leading + 1) if is_same else 1,
            since_search=self.since_search + 1,
            resolved=self.resolved + 1 if is_resolved else 0,
        )


@dataclass(frozen=True, eq=False)  # no slots: probabilities are computed once
class SequentialTest:
    """The competing hypotheses. Plain: it pickles."""

    problem: Problem  # Of the filter, without what the hypotheses add
    hypotheses: tuple[TrackedHypothesis, ...]  # The best first
    onset: float  # Service time, s
    last: LogEvidence = NO_EVIDENCE  # Of the last window, for the best hypothesis
    counts: WindowCounts = WindowCounts()
    filter_evidence: FilterEvidence = FilterEvidence()
    null_reduced_chi_square: float = 1.0
    """χ² per measured value of the first window under the null hypothesis; at least one."""
    has_explained_unexpected: bool = True
    """Whether a hypothesis has explained a window that the filter did not expect; else the cause is none of them."""

    @property
    def best(self) -> TrackedHypothesis:
        """The most probable hypothesis."""
        return self.hypotheses[0]

    @cached_property
    def groups(self) -> list[list[int]]:
        """Indices of the hypotheses that explain the windows equally well, grouped by type and place."""
        return interchangeable(self.hypotheses)

    @cached_property
    def probabilities(self) -> list[float]:
        """Of each hypothesis."""
        return probabilities(self.hypotheses, self.groups)

    @property
    def has_equal_causes(self) -> bool:
        """Whether hypotheses of several types, or several sets of moved parameters, explain the windows equally."""
        types = [self.hypotheses[group[0]].type for group in self.groups]
        return len(set(types)) > 1 or types.count(FaultType.PARAMETER) > 1

    @property
    def is_ambiguous(self) -> bool:
        """Whether hypotheses of several causes explain the windows equally, or did so one window before."""
        return self.counts.resolved < AGREEING_WINDOWS or self.has_equal_causes

    @property
    def explains_window(self) -> bool:
        """Whether the best hypothesis explains the last window up to the noise."""
        return self.best.is_explained

    def probability(self, kind: FaultType) -> float:
        """Return the probability of all hypotheses of one type."""
        return sum(share for share, item in zip(self.probabilities, self.hypotheses, strict=True) if item.type is kind)

    @property
    def is_null_possible(self) -> bool:
        """Whether no hypothesis explains the windows decisively better than that nothing has happened."""
        null = min((item.deviance for item in self.hypotheses if item.type is FaultType.NOTHING), default=np.inf)
        return null <= DECISIVE

    @property
    def wrong_probability(self) -> float:
        """Probability that none of the hypotheses holds; one window alone is as likely to be wrong itself."""
        is_sure = self.explains_window and self.counts.since_search > 1
        return self.filter_evidence.probability if is_sure else max(self.filter_evidence.probability, WRONG_WINDOW)

    def with_steps(self, steps: tuple[float, ...]) -> "SequentialTest":
        """Return the test with the steps of converters that windows have shown since."""
        hypotheses = tuple(
            replace(item, posterior=replace(item.posterior, problem=replace(item.problem, steps=steps)))
            for item in self.hypotheses
        )
        return replace(self, problem=replace(self.problem, steps=steps), hypotheses=hypotheses)

    def with_filter(self, filtered: Fit) -> "SequentialTest":
        """Return the test after its last window, of which the filter leaves ``filtered``."""
        return replace(self, filter_evidence=self.filter_evidence.after(filtered.chi_square, self.last))

    def after_expected(self) -> "SequentialTest":
        """Return the test after a window that the filter expected, and that did not confirm the test."""
        return replace(self, counts=replace(self.counts, expected=self.counts.expected + 1))

    def after_unexpected(self) -> "SequentialTest":
        """Return the test after a window that the filter did not expect, or that confirmed the test."""
        has_explained_unexpected = self.has_explained_unexpected or self.explains_window
        return replace(self, counts=replace(self.counts, expected=0), has_explained_unexpected=has_explained_unexpected)

    def alternatives(self, to: TrackedHypothesis) -> list[tuple[TrackedHypothesis, float]]:
        """Return the others that the data do not distinguish decisively from ``to``, with their probabilities."""
        data = [item.deviance - item.hypothesis.prior_deviance for item in self.hypotheses]
        at = self.hypotheses.index(to)
        equal = {group[0] for group in self.groups}
        near = {other for other, deviance in enumerate(data) if abs(deviance - data[at]) <= DECISIVE}
        chosen = sorted((near | equal if at in equal else near) - {at})
        return [(self.hypotheses[other], self.probabilities[other]) for other in chosen]


def open_test(predicted: Posterior, screening: ScreeningResult) -> SequentialTest:
    """Return the test that the screened window opens."""
    predicted, fitted = search_from_onset(predicted, screening)
    return new_test(fitted, predicted)


def continue_test(test: SequentialTest, predicted: Posterior, screening: ScreeningResult) -> SequentialTest:
    """Return the test after the screened window.

    Where the tracked hypotheses do not explain the window, a new search adds others: something may have begun since.
    If no hypothesis has explained any window, the test begins again.
    """
    if not test.has_explained_unexpected:
        return replace(open_test(predicted, screening), onset=test.onset)
    test = follow(test, screening.fitted.window)
    if test.best.leaves_only_noise and test.explains_window:
        return test
    return join(test, new_test(search(screening), predicted))


def new_test(fitted: Sequence[FittedHypothesis], predicted: Posterior) -> SequentialTest:
    """Return a test of the ``fitted`` hypotheses; the first one is the null hypothesis.

    The null hypothesis and those of moved parameters are tracked however improbable they are.
    """
    null = fitted[0]
    fitted = [null, *(item for item in fitted[1:] if item.chi_square < DIVERGED)]
    count = null.fit.count
    divisor = evidence_factor(fitted)
    evidence = {item: item.evidence(count, divisor) for item in fitted}
    ordered = sorted(fitted, key=lambda item: evidence[item].deviance)
    best, least_misfit = ordered[0], min(own.misfit for own in evidence.values())
    least = evidence[best].deviance
    kept = [item for item in ordered if evidence[item].deviance <= least + MAX_DEVIANCE][:MAX_HYPOTHESES]
    kept += [item for item in ordered if ALTERNATIVES[item.type].is_always_tracked and item not in kept]
    tracked = []
    for item in kept:
        deviance = min(evidence[item].deviance - least, MAX_FIRST_EVIDENCE)
        misfit = min(evidence[item].misfit - least_misfit, MAX_FIRST_EVIDENCE)
        tracked.append(track(item, predicted, deviance, misfit))
    usable = [item for item in tracked if item is not None]
    return SequentialTest(
        predicted.problem,
        _sorted(without_repetitions(usable, predicted.problem)),
        best.fit.window.start,
        last=evidence[best],
        null_reduced_chi_square=discount(null.chi_square, count),
        has_explained_unexpected=best.fit.is_explained,
    )


def track(fitted: FittedHypothesis, predicted: Posterior, deviance: float, misfit: float) -> TrackedHypothesis | None:
    """Return the hypothesis after its first window, or None if its twin all but diverges.

    ``predicted`` is the prediction of what was known before the hypothesis.
    """
    evidence = fitted.fit.evidence()
    own = predicted.remap_parameters(fitted.problem).set_prior(fitted.fit.prior)
    if not is_usable(fitted.hypothesis, own, evidence):
        return None
    posterior = own.update(own.innovation(evidence), fitted.fit.advance())
    tracked = TrackedHypothesis(fitted.hypothesis, posterior, deviance, misfit, fitted.fit.cost)
    return ALTERNATIVES[fitted.type].after_window(_with_window(tracked, fitted.fit), fitted.fit)


def _with_window(tracked: TrackedHypothesis, fitted: Fit) -> TrackedHypothesis:
    """Return the hypothesis with what it leaves of its last window."""
    return replace(tracked, cost=fitted.cost, inflation=fitted.inflation, is_explained=fitted.is_explained)


def follow(test: SequentialTest, window: Window) -> SequentialTest:
    """Return the test after one more window: predict, fit and update every hypothesis, then compare them."""
    test = replace(test, counts=replace(test.counts, tested=test.counts.tested + 1))
    steps = [step for step in _steps(test, window) if step.is_usable]
    if not steps:
        return test
    steps = _with_evidence(steps)
    last = min((step.log_evidence for step in steps), key=lambda own: own.deviance)
    tracked, deviances = _updated(steps)
    if not tracked:
        return test
    if test.counts.tested >= COMPONENT_WINDOWS:
        tracked = prune(tracked, deviances)
    tracked = without_repetitions(tracked, test.problem)
    evidence = test.filter_evidence.worse_by(-min(item.deviance for item in tracked))
    hypotheses = _sorted([without_insignificant(item) for item in tracked])
    if test.counts.tested > MAX_OPEN_WINDOWS:
        hypotheses = without_duplicates(hypotheses, interchangeable(hypotheses))
    followed = replace(test, hypotheses=_screened(hypotheses, steps), last=last, filter_evidence=evidence)
    counts = test.counts.after(test.best, followed.best, is_resolved=not followed.has_equal_causes)
    return replace(followed, counts=counts)


def _updated(steps: Sequence[HypothesisStep]) -> tuple[list[TrackedHypothesis], list[float]]:
    """Return the hypotheses after a window, without those that it excludes, and their deviances in it."""
    least = min(step.log_evidence.deviance for step in steps)
    least_misfit = min(step.log_evidence.misfit for step in steps)
    tracked, deviances = [], []
    for step in steps:
        own = step.log_evidence
        deviance = min(own.deviance - least, MAX_WINDOW_EVIDENCE)
        item = step.updated(deviance, min(own.misfit - least_misfit, MAX_WINDOW_EVIDENCE))
        if item is not None:
            tracked.append(item)
            deviances.append(own.deviance)
    return tracked, deviances


def _steps(test: SequentialTest, window: Window) -> list[HypothesisStep]:
    """Return each hypothesis with its prediction, its fit and its evidence; a twin that diverges is dropped."""
    predicted = [item.posterior.predict(window) for item in test.hypotheses]
    proposals = [_continued(item, posterior) for item, posterior in zip(test.hypotheses, predicted, strict=True)]
    fitted = [
        explained_again(own, proposal, window, item.posterior)
        if item.is_explained and not own.fit.is_explained
        else own
        for own, proposal, item in zip(fit_hypotheses(proposals, window), proposals, test.hypotheses, strict=True)
    ]
    rows = list(zip(test.hypotheses, predicted, fitted, strict=True))
    finite = [row for row in rows if row[2].chi_square < DIVERGED] or rows[:1]
    return _with_noise([HypothesisStep(item, posterior, own, own.fit.evidence()) for item, posterior, own in finite])


def _continued(item: TrackedHypothesis, predicted: Posterior) -> Proposal:
    """Return a tracked hypothesis, to be fitted under its prediction: it adds no value any more."""
    prior = predicted.prior()
    return Proposal(replace(item.hypothesis, added=0), predicted.problem, prior, prior.mean)


def _with_noise(steps: list[HypothesisStep]) -> list[HypothesisStep]:
    """Return the steps with the likelihood of a larger noise; one whose innovations are not white is dropped."""
    stated = next((step.fitted.fit for step in steps if step.tracked.type is FaultType.NOTHING), None)
    kept = []
    for step in steps:
        own = step.fitted
        if step.tracked.type is not FaultType.NOISE:
            kept.append(step)
        elif stated is not None and is_white(own.fit):
            kept.append(replace(step, fitted=replace(own, normalisation=normalisation(own.fit, stated))))
    return kept


def _with_evidence(steps: list[HypothesisStep]) -> list[HypothesisStep]:
    """Return the steps with the evidence of the window."""
    divisor = evidence_factor(step.fitted for step in steps)
    penalties = (complexity_penalty(step.predicted, step.evidence) for step in steps)
    return [
        replace(step, log_evidence=LogEvidence(step.fitted.chi_square, penalty, divisor))
        for step, penalty in zip(steps, penalties, strict=True)
    ]


def complexity_penalty(predicted: Posterior, evidence: Evidence) -> float:
    """Return ln|I + R P Rᵀ|: the term of -2 log evidence that penalises an uncertain prediction."""
    information = evidence.sqrt_information @ predicted.prior().covariance @ evidence.sqrt_information.T
    return float(log_determinant(np.eye(len(information)) + information))


def _screened(hypotheses: tuple[TrackedHypothesis, ...], steps: list[HypothesisStep]) -> tuple[TrackedHypothesis, ...]:
    """Return the hypotheses with the screening test of what the best one leaves of the window.

    A best hypothesis that has just lost a component is not tested: it was not fitted in this form.
    """
    best = next((step for step in steps if step.tracked.hypothesis == hypotheses[0].hypothesis), None)
    if best is None:
        return hypotheses
    screening = screening_test(best.fitted.fit.linearised_at_end())
    return (replace(hypotheses[0], leaves_only_noise=not screening.is_positive), *hypotheses[1:])


def join(test: SequentialTest, fresh: SequentialTest) -> SequentialTest:
    """Return the test with the hypotheses of a new search in its last window, if that explains it decisively better.

    If the filter alone explains the window, but not the leading hypothesis, what opened the test has ended.
    """
    gain = test.last.over(fresh.last)  # of the window alone
    if fresh.best.type is FaultType.NOTHING and fresh.best.is_explained and not test.best.is_explained:
        return fresh
    if gain <= DECISIVE:
        return test
    lead = min(gain, MAX_WINDOW_EVIDENCE)
    together = _best_of_each([*(item.worse_by(lead, lead) for item in test.hypotheses), *fresh.hypotheses])
    together = without_repetitions(together, test.problem)
    hypotheses = _sorted(together)[: 2 * MAX_HYPOTHESES]
    evidence = test.filter_evidence.worse_by(lead).worse_by(-min(item.deviance for item in together))
    joined = replace(test, hypotheses=hypotheses, filter_evidence=evidence)
    if any(item.posterior is joined.best.posterior for item in fresh.hypotheses):
        return replace(joined, counts=replace(test.counts, leading=1, since_search=1))
    is_same = joined.best.hypothesis.name == test.best.hypothesis.name
    return joined if is_same else replace(joined, counts=replace(test.counts, leading=1))


def _best_of_each(tracked: Sequence[TrackedHypothesis]) -> list[TrackedHypothesis]:
    """Return the hypotheses without the worse of two that state the same.

    A new fit may be better: a parameter that has moved along a ramp may have stopped, or moved again.
    """
    best: dict[str, TrackedHypothesis] = {}
    for item in tracked:
        other = best.setdefault(item.hypothesis.name, item)
        if item.deviance < other.deviance:
            best[item.hypothesis.name] = item
    return list(best.values())


def _sorted(tracked: list[TrackedHypothesis]) -> tuple[TrackedHypothesis, ...]:
    """Return the hypotheses, the best first, with deviances and misfits relative to the least."""
    least, least_misfit = min(item.deviance for item in tracked), min(item.misfit for item in tracked)
    return tuple(
        replace(
            item,
            deviance=min(item.deviance - least, MAX_TOTAL_DEVIANCE),
            misfit=min(item.misfit - least_misfit, MAX_TOTAL_DEVIANCE),
        )
        for item in sorted(tracked, key=lambda item: item.deviance)
    )


def interchangeable(hypotheses: Sequence[TrackedHypothesis]) -> list[list[int]]:
    """Return the indices of the hypotheses that explain the windows equally well, grouped by type and place.

    Their misfits are at most ``DECISIVE`` above the least. The hypothesis of least deviance belongs to them even if its
    misfit is larger: then only its fewer values make it the best. The best of each group comes first. A component is in
    a group only if nothing with fewer values explains the windows as well. Otherwise its deviance decides, with the
    complexity penalty. The null hypothesis is contained in all others, so it is in no group.
    """
    others = [at for at, item in enumerate(hypotheses) if item.type is not FaultType.NOTHING]
    least = min((hypotheses[at].misfit for at in others), default=0.0)
    best = min(others, key=lambda at: hypotheses[at].deviance, default=-1)
    equal = [at for at in others if hypotheses[at].misfit <= least + DECISIVE or at == best]
    least_values = min((hypotheses[at].hypothesis.added for at in equal), default=0)
    moved = [hypotheses[at] for at in equal if hypotheses[at].type is FaultType.PARAMETER]
    simplest = min(moved, key=lambda item: (item.hypothesis.added, item.deviance), default=None)
    groups: dict[tuple[FaultType, tuple[str, ...]], list[int]] = {}
    for at in sorted(equal, key=lambda at: hypotheses[at].deviance):
        item = hypotheses[at]
        if item.type is not FaultType.COMPONENT or item.hypothesis.added <= least_values:
            groups.setdefault((item.type, _place(item, simplest)), []).append(at)
    return list(groups.values())


def _place(item: TrackedHypothesis, simplest: TrackedHypothesis | None) -> tuple[str, ...]:
    """Return what ``item`` is about: of moved parameters their names.

    More moved parameters than those of the ``simplest`` hypothesis of moved parameters are a variant of it.
    """
    is_variant = item.type is FaultType.PARAMETER and simplest and item.hypothesis.added > simplest.hypothesis.added
    return ALTERNATIVES[item.type].places(simplest if simplest and is_variant else item)


def probabilities(hypotheses: Sequence[TrackedHypothesis], groups: Sequence[Sequence[int]]) -> list[float]:
    """Return the probability of each hypothesis; ``groups`` of interchangeable ones are equally probable."""
    deviances = np.array([item.deviance for item in hypotheses])
    totals = [-2.0 * float(np.logaddexp.reduce(-0.5 * deviances[list(group)])) for group in groups]
    for group, total in zip(groups, totals, strict=True):
        deviances[list(group)] += min(totals) - total
    weights = likelihood_ratios(deviances)
    shares: list[float] = (weights / weights.sum()).tolist()
    return shares


def without_duplicates(
    hypotheses: tuple[TrackedHypothesis, ...], groups: Sequence[Sequence[int]]
) -> tuple[TrackedHypothesis, ...]:
    """Return the hypotheses with only the best of each of the ``groups`` of interchangeable ones."""
    worse = {at for group in groups for at in group[1:]}
    return tuple(item for at, item in enumerate(hypotheses) if at not in worse)


def mixture(
    hypotheses: Sequence[TrackedHypothesis], shares: Sequence[float], problem: Problem, before: Prior, wrong: float
) -> Prior:
    """Return the moment-matched mixture of what the hypotheses know of the free parameters of ``problem``.

    ``shares`` are their probabilities if the window that opened the test is right. With probability ``wrong`` it is
    not, and ``before`` holds, which is known without it.
    """
    priors = [*(item.known(problem) for item in hypotheses), before]
    weights = np.append((1.0 - wrong) * np.array(shares), wrong)
    means = np.array([prior.mean for prior in priors])
    mean: Array = weights @ means
    offsets = means - mean
    own = np.array([prior.covariance for prior in priors])
    covariance = np.einsum("h,hij->ij", weights, own + offsets[:, :, None] * offsets[:, None, :])
    sd = np.sqrt(np.diag(covariance))
    reach = np.abs(offsets) / QUANTILE + np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    wider = np.maximum(reach[weights >= MIN_WEIGHT].max(axis=0, initial=0.0) / np.where(sd > 0.0, sd, 1.0), 1.0)
    return Prior(mean, covariance * np.outer(wider, wider))
