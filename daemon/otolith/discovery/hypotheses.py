"""Hypotheses about a window: nothing, parameters moved, a component appeared, a sensor is wrong, a signal is late.

A hypothesis is fitted to a window under its own prior and compared by evidence (:mod:`otolith.estimation.evidence`). A
fitted hypothesis becomes a tracked one, which carries its own posterior from window to window.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.candidates import Candidate
from otolith.discovery.linear_response import MIN_REMAINDER
from otolith.estimation.evidence import (
    DECISIVE,
    STRUCTURE,
    Elimination,
    LogEvidence,
    discount,
    penalty,
    prior_deviance,
)
from otolith.estimation.information import Prior, extend_prior, initial_prior
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, Problem, augment, indices
from otolith.estimation.timing import delay_response, delayable
from otolith.estimation.window_fit import Fit

MAX_DEVIANCE = 3.0 * DECISIVE  # in -2 log evidence behind the best: a worse hypothesis is not tracked
NARROWEST = 1.01  # of the least width of a hump: as narrow as its range allows


class FaultType(StrEnum):
    """What kind of change a hypothesis states."""

    NOTHING = "nothing has happened"
    PARAMETER = "parameters have moved"
    COMPONENT = "a component has appeared"
    SENSOR = "a sensor is wrong"
    TIMING = "a signal is late"
    NOISE = "signals are less certain than stated"


@dataclass(frozen=True, slots=True)
class FaultHypothesis:
    """What a hypothesis states."""

    type: FaultType
    name: str = ""  # Names of the parameters, or keys of the components
    added: int = 0  # Number of values that it estimates in addition
    alternatives: float = 1.0  # Number of hypotheses of the same type

    @property
    def prior_deviance(self) -> float:
        """-2 log of the prior odds against the null hypothesis; those of a type share its probability."""
        return 0.0 if self.type is FaultType.NOTHING else float(prior_deviance(self.alternatives))

    def penalty(self, count: float) -> float:
        """Return the penalty of its values, of which nothing was known before ``count`` measured ones, and its odds."""
        return 0.0 if self.type is FaultType.NOTHING else float(penalty(self.added, count, self.alternatives))


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """A hypothesis with what its fit starts from."""

    hypothesis: FaultHypothesis
    problem: Problem
    prior: Prior  # Of all free parameters of ``problem``
    start: Array  # (free, ...)


@dataclass(frozen=True, slots=True, eq=False)
class FittedHypothesis:
    """A hypothesis fitted to one window."""

    hypothesis: FaultHypothesis
    fit: Fit
    normalisation: float = 0.0
    """What is added to χ² to compare -2 log likelihood with that of the null hypothesis: the log determinant of a
    larger noise, and the expected χ² of the measured values that a delay moves out of the window."""

    @property
    def type(self) -> FaultType:
        """What kind of change it states."""
        return self.hypothesis.type

    @property
    def name(self) -> str:
        """Names of the parameters, or keys of the components."""
        return self.hypothesis.name

    @property
    def problem(self) -> Problem:
        """The problem with what the hypothesis adds."""
        return self.fit.problem

    @property
    def chi_square(self) -> float:
        """-2 log likelihood of window and prior, up to a constant: χ² with its normalisation."""
        return self.fit.chi_square + self.normalisation

    @property
    def unexplained(self) -> float:
        """χ² that is left, in the noise of the hypothesis."""
        return self.fit.chi_square if self.type is FaultType.NOISE else self.chi_square

    def evidence(self, count: float, divisor: float) -> LogEvidence:
        """Return the evidence of ``count`` measured values, with ``divisor`` as the discount."""
        return LogEvidence(self.chi_square, self.hypothesis.penalty(count), divisor)


def nothing_happened(problem: Problem, prior: Prior) -> Proposal:
    """Return the null hypothesis."""
    return Proposal(FaultHypothesis(FaultType.NOTHING), problem, prior, prior.mean)


def all_parameters_moved(problem: Problem, start: Array) -> Proposal:
    """Return the hypothesis that nothing is known of any free parameter."""
    names = ", ".join(parameter.name for parameter in problem.free if not parameter.name.startswith("_"))
    moved = FaultHypothesis(FaultType.PARAMETER, names, len(problem.free))
    return Proposal(moved, problem, initial_prior(problem), start)


def with_candidate(
    base: Problem, prior: Prior, candidate: Candidate, before: FittedHypothesis | None = None
) -> Proposal:
    """Return the hypothesis of ``base`` with one more component; ``before`` is a fit of ``base`` to start from."""
    kind = FaultType.SENSOR if candidate.of_sensor else FaultType.COMPONENT
    alone = with_components(base, prior, [candidate.component], candidate.competing, kind)
    if before is None:
        return alone
    start, order = alone.start.copy(), [parameter.name for parameter in alone.problem.free]
    for value, parameter in zip(before.fit.parameters, base.free, strict=True):
        start[order.index(parameter.name)] = value
    own, others = alone.hypothesis, before.hypothesis
    both = replace(own, added=own.added + others.added, alternatives=own.alternatives * others.alternatives)
    return replace(alone, hypothesis=both, start=start)


def is_possible(problem: Problem, values: Array) -> bool:
    """Whether the components of ``problem`` lie within their physical ranges where the free parameters are ``values``.

    A component at a bound of its range describes another effect. Beside dry friction, a hump at rest that is as narrow
    as its range allows describes only how the friction is rounded off.
    """
    friction = {(item.site, item.source) for item in problem.components if item.model.threshold_like}
    for slot, component in enumerate(problem.components):
        amplitude, *rest = (float(values[at]) for at in indices(problem, slot))
        if not component.amplitude_low < amplitude < component.amplitude_high:
            return False
        is_hump = component.model.threshold_at_rest and (component.site, component.source) in friction
        if is_hump and rest[0] <= NARROWEST * component.low:
            return False
    return True


def with_components(
    base: Problem, prior: Prior, components: Sequence[Component], alternatives: float, kind: FaultType
) -> Proposal:
    """Return the hypothesis of ``base`` with several more components, all at once."""
    wider = augment(base, components)
    extended = extend_prior(prior, base, wider)
    stated = FaultHypothesis(kind, names_of(wider.components), len(wider.free) - len(base.free), alternatives)
    return Proposal(stated, wider, extended, extended.mean)


def names_of(components: Iterable[Component]) -> str:
    """Return the name of a hypothesis that states ``components``."""
    return " and ".join(component.key for component in components)


def largest_chi_square(least: float, count: float) -> float:
    """Return the χ² above which a hypothesis is far less likely than the best one, which leaves ``least``."""
    return least + MAX_DEVIANCE * discount(least, count)


def evidence_factor(fitted: Iterable[FittedHypothesis]) -> float:
    """Return the factor, at least one, by which the evidence of a search is discounted: what the best one leaves.

    What exceeds the noise is correlated, and its samples are no independent evidence: its long-run variance counts.
    """
    return min(fitted, key=lambda item: item.unexplained).fit.inflation ** 2


@dataclass(frozen=True, slots=True, eq=False)
class TrackedHypothesis:
    """A hypothesis with its posterior after some windows. Plain: it pickles."""

    hypothesis: FaultHypothesis
    posterior: Posterior
    deviance: float  # -2 log evidence of all windows so far, relative to the best hypothesis
    misfit: float  # The same from the data alone: without prior weight and complexity
    cost: float  # RMSE of the last window in units of the noise
    inflation: float = 1.0  # Of standard deviations, by what it leaves of the last window: see inflation_of
    delay_information: float = 0.0  # About the delay that the hypothesis states, 1/s²; 0 if it states none
    delay_sds: tuple[float, ...] = ()  # Standard deviation, in s, of the delay with which each window was fitted
    shift_by_delay: tuple[tuple[str, float], ...] = ()
    """How far the parameters of each label move with that delay, per second; empty if it states none."""
    is_explained: bool = True  # Whether it leaves no more than noise of the last window
    leaves_only_noise: bool = True  # Whether the screening test found nothing in what it left of the last window

    @property
    def type(self) -> FaultType:
        """What kind of change it states."""
        return self.hypothesis.type

    @property
    def problem(self) -> Problem:
        """The problem with what the hypothesis adds."""
        return self.posterior.problem

    @property
    def leaves_structure(self) -> bool:
        """Whether what it leaves of the last window is more than noise: then the cause may be another."""
        return self.inflation > STRUCTURE

    def known(self, problem: Problem) -> Prior:
        """Return what is known of the free parameters of ``problem`` under the hypothesis.

        Its delay is estimated as well, and the parameters move with it. The errors of the delays with which the windows
        were fitted are taken as one.
        """
        prior = self.posterior.remap_parameters(problem).prior()
        if not self.delay_sds:
            return prior
        shifts = dict(self.shift_by_delay)
        moved = np.array([shifts.get(free.label, 0.0) for free in problem.free] + [0.0] * len(problem.free))
        variance = float(np.mean(self.delay_sds)) ** 2
        return replace(prior, covariance=prior.covariance + variance * np.outer(moved, moved))

    def worse_by(self, deviance: float, misfit: float) -> "TrackedHypothesis":
        """Return the hypothesis with more deviance and misfit."""
        return replace(self, deviance=self.deviance + deviance, misfit=self.misfit + misfit)


@dataclass(frozen=True, slots=True)
class DelayScore:
    """Estimate of a delay from one window, around the one that it was fitted with."""

    step: float  # To the best delay, s
    information: float  # 1/s²; less if the window is not explained
    shift: tuple[float, ...]  # (2 free,) how far the best parameters and trends move with the delay, per second


def delay_score(fitted: Fit, signal: str) -> DelayScore:
    """Return the step of the delay of ``signal``, with what parameters, trends and initial state explain left out."""
    free, index = len(fitted.problem.free), delayable(fitted.problem.base_model).index(signal)
    unknowns, residuals = Elimination.of(fitted.result.jacobian), fitted.result.residuals
    of_window = delay_response(fitted.objective, fitted.guess)[:, index]
    response = np.concatenate([of_window, np.zeros(len(residuals) - len(of_window))])  # that of the prior is zero
    projected = unknowns.left(response)
    size = float(projected @ projected)
    if size <= MIN_REMAINDER * float(response @ response):
        return DelayScore(0.0, 0.0, (0.0,) * (2 * free))
    step, information = -float(projected @ residuals) / size, size / fitted.discount
    return DelayScore(step, information, tuple((-unknowns.explaining(response))[: 2 * free].tolist()))
