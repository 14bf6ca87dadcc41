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
from otolith.estimation.evidence import (
    DECISIVE,
    NO_EVIDENCE,
    STRUCTURE,
    LogEvidence,
    discount,
    log_determinant,
    penalty,
    prior_deviance,
)
from otolith.estimation.information import QUANTILE, Evidence, Prior, extend_prior, initial_prior, orthonormal_basis
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, Problem, amplitude_indices, augment, equation, indices, site_of
from otolith.estimation.timing import delay_response, delayable, largest_delay
from otolith.estimation.window_fit import Fit
from otolith_drivers.units import equation_text, unit_text

MAX_GAIN_OF_INFORMATION = 1e7  # ratio of prior to window uncertainty above which the twin all but diverges
SIGNIFICANT = 4.0  # standard deviations: a component or a change nearer to zero is not significant
MAX_DEVIANCE = 30.0  # in -2 log evidence behind the best: a worse hypothesis is not tracked
MAX_DELAY_CHANGE = 5.0  # standard deviations: a delay that differs more between windows is no delay
MAX_DELAY_SDS = 100  # windows whose delays count for the parameters
MIN_DELAY_SHARE = 1e-6  # of the response to a delay that is left beside those to parameters; less shows no delay
NARROWEST = 1.01  # of the least width of a hump: as narrow as its range allows
MS = 1e3  # ms in a second
CHANGING, POLLED = "{} changes between its samples", 'write times = "polled" under [signals] {}'
DISCRIMINATES = 4.0  # in -2 log evidence of one window: a smaller difference does not discriminate


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
    stated = FaultHypothesis(kind, _names(wider), len(wider.free) - len(base.free), alternatives)
    return Proposal(stated, wider, extended, extended.mean)


def _names(problem: Problem) -> str:
    return " and ".join(component.key for component in problem.components)


def largest_chi_square(least: float, count: float) -> float:
    """Return the χ² above which a hypothesis is far less likely than the best one, which leaves ``least``."""
    return least + MAX_DEVIANCE * discount(least, count)


def evidence_factor(fitted: Iterable[FittedHypothesis]) -> float:
    """Return by what the evidence of a search is divided, at least one: what even the best hypothesis leaves.

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

    @property
    def places(self) -> tuple[str, ...]:
        """Sites of its components, of errors of sensors their signals, and signals of its delays."""
        twin, read = self.problem.base_model, self.type is FaultType.SENSOR
        own = [site_of(twin, item.site).into if read else item.site for item in self.problem.components]
        return (*own, *(signal for signal, _ in self.problem.delays))

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
        return tracked if self.tracked.type is not FaultType.TIMING else _with_delay(tracked, own)


def is_usable(hypothesis: FaultHypothesis, predicted: Posterior, evidence: Evidence) -> bool:
    """Whether ``evidence`` can update the prediction without losing all digits; always for the null hypothesis."""
    if hypothesis.type is FaultType.NOTHING:
        return True
    relative = np.abs(evidence.sqrt_information) * predicted.prior().sd
    return bool((relative < MAX_GAIN_OF_INFORMATION).all())  # also false for not-a-number


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
    tracked = _with_window(tracked, fitted.fit)
    return tracked if fitted.type is not FaultType.TIMING else _with_delay(tracked, fitted.fit)


def _with_window(tracked: TrackedHypothesis, fitted: Fit) -> TrackedHypothesis:
    """Return the hypothesis with what it leaves of its last window."""
    return replace(tracked, cost=fitted.cost, inflation=fitted.inflation, is_explained=fitted.is_explained)


def _with_delay(tracked: TrackedHypothesis, fitted: Fit) -> TrackedHypothesis | None:
    """Return the hypothesis with what the window of ``fitted`` adds to the estimate of its delay.

    None if the window contradicts the delay, or if it may be zero, is beyond those that are searched, or has changed
    its sign: that another signal is late is another statement.
    """
    ((signal, delay),) = tracked.problem.delays
    own = delay_score(fitted, signal)
    before = tracked.delay_information
    information = before + own.information
    if not information > 0.0 or own.step**2 * before * own.information > MAX_DELAY_CHANGE**2 * information:
        return None
    moved = delay + own.information * own.step / information
    limit = largest_delay(fitted.window.grid.length, fitted.window.sample_period)
    if not QUANTILE / np.sqrt(information) < moved * np.sign(delay) <= limit:
        return None
    problem = replace(tracked.problem, delays=((signal, moved),))
    posterior = replace(tracked.posterior.moved((moved - delay) * np.array(own.shift)), problem=problem)
    sds = (*tracked.delay_sds, (before or own.information) ** -0.5)[-MAX_DELAY_SDS:]
    return replace(
        tracked,
        posterior=posterior,
        delay_information=information,
        delay_sds=sds,
        shift_by_delay=tuple(zip((free.label for free in problem.free), own.shift, strict=False)),
    )


@dataclass(frozen=True, slots=True)
class DelayScore:
    """Estimate of a delay from one window, around the one that it was fitted with."""

    step: float  # To the best delay, s
    information: float  # 1/s²; less if the window is not explained
    shift: tuple[float, ...]  # (2 free,) how far the best parameters and trends move with the delay, per second


def delay_score(fitted: Fit, signal: str) -> DelayScore:
    """Return the step of the delay of ``signal``, with what parameters, trends and initial state explain left out."""
    free, index = len(fitted.problem.free), delayable(fitted.problem.base_model).index(signal)
    jacobian, residuals = fitted.result.jacobian, fitted.result.residuals
    of_window = delay_response(fitted.objective, fitted.guess)[:, index]
    response = np.concatenate([of_window, np.zeros(len(residuals) - len(of_window))])  # that of the prior is zero
    basis = orthonormal_basis(jacobian)
    projected = response - basis @ (basis.T @ response)
    size = float(projected @ projected)
    if size <= MIN_DELAY_SHARE * float(response @ response):
        return DelayScore(0.0, 0.0, (0.0,) * (2 * free))
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    shift = -np.linalg.lstsq(jacobian / scale, response, rcond=None)[0] / scale
    step, information = -float(projected @ residuals) / size, size / fitted.discount
    return DelayScore(step, information, tuple(shift[: 2 * free].tolist()))


def complexity_penalty(predicted: Posterior, evidence: Evidence) -> float:
    """Return ln|I + R P Rᵀ|: the term of -2 log evidence that penalises an uncertain prediction."""
    information = evidence.sqrt_information @ predicted.prior().covariance @ evidence.sqrt_information.T
    return float(log_determinant(np.eye(len(information)) + information))


def prune(tracked: Sequence[TrackedHypothesis], deviances: Sequence[float]) -> list[TrackedHypothesis]:
    """Drop hypotheses that have become equal to the null hypothesis and explained the window no better.

    A window that was itself wrong may be explained by something that does not return. Quiet windows do not
    discriminate, so evidence alone would keep such a hypothesis for ever. A parameter of the null hypothesis follows a
    ramp too late: one that has moved stays as long as all windows together are decisively for it.
    """
    at = next((at for at, item in enumerate(tracked) if item.type is FaultType.NOTHING), None)
    if at is None:
        return list(tracked)
    null = tracked[at]
    return [
        item
        for item, deviance in zip(tracked, deviances, strict=True)
        if item is null
        or deviance < deviances[at] - DISCRIMINATES
        or (item.type is FaultType.PARAMETER and item.deviance < null.deviance - DECISIVE)
        or not _equals_null(item, null)
    ]


def without_insignificant(tracked: TrackedHypothesis) -> TrackedHypothesis:
    """Return the hypothesis without its weakest component, if that is not significant (the paper's "deactivated")."""
    if len(tracked.problem.components) < 2:
        return tracked
    significance = _significance(tracked.posterior)
    weakest = int(np.argmin(significance))
    if significance[weakest] >= SIGNIFICANT:
        return tracked
    posterior, hypothesis = tracked.posterior.without_slot(weakest), tracked.hypothesis
    if hypothesis.type in (FaultType.COMPONENT, FaultType.SENSOR):  # other types do not name components
        hypothesis = replace(hypothesis, name=_names(posterior.problem))
    return replace(tracked, hypothesis=hypothesis, posterior=posterior)


def _significance(posterior: Posterior) -> Array:
    """Return the amplitudes (components,) in their standard deviations."""
    prior, amplitudes = posterior.prior(), amplitude_indices(posterior.problem)
    return np.abs(prior.mean[amplitudes]) / prior.sd[amplitudes]


def _equals_null(tracked: TrackedHypothesis, null: TrackedHypothesis) -> bool:
    """Whether neither its additional components nor its delay nor its shifts of parameters are significant."""
    known, own = ([item.key for item in each.problem.components] for each in (null, tracked))
    if own[: len(known)] != known:  # it states that a component is gone
        return False
    if any(abs(delay) * np.sqrt(tracked.delay_information) >= SIGNIFICANT for _, delay in tracked.problem.delays):
        return False
    added = _significance(tracked.posterior)[len(known) :]
    return bool((added < SIGNIFICANT).all() and (_shifts(tracked, null) < SIGNIFICANT).all())


def _shifts(tracked: TrackedHypothesis, null: TrackedHypothesis) -> Array:
    """Return how far its parameters (parameters,) are from those of ``null``, in standard deviations."""
    own, other = tracked.posterior.prior(), null.posterior.prior()
    expected = {name: (value, 0.0) for name, value in null.problem.known}
    for at, parameter in enumerate(null.problem.free):
        expected[parameter.name] = float(other.mean[at]), float(other.covariance[at, at])
    shifts = []
    for at, parameter in enumerate(tracked.problem.free):
        if parameter.name in expected:  # others belong to a component that it adds
            value, variance = expected[parameter.name]
            shifts.append(abs(own.mean[at] - value) / np.sqrt(own.covariance[at, at] + variance))
    return np.array(shifts)


def describe_hypothesis(tracked: TrackedHypothesis) -> str:
    """Return what the hypothesis states, with its values."""
    if tracked.type in (FaultType.NOTHING, FaultType.PARAMETER):
        return tracked.hypothesis.name or str(tracked.type)
    if tracked.type is FaultType.TIMING:
        return _describe_delay(tracked)
    if tracked.type is FaultType.NOISE:
        return describe_noise(tracked.problem)
    problem, twin = tracked.problem, tracked.problem.base_model
    values = tracked.posterior.prior().mean
    if tracked.type is FaultType.SENSOR and problem.components:
        component = problem.components[-1]
        site, at = site_of(twin, component.site), indices(problem, len(problem.components) - 1)
        error = float(values[at[0]])
        if component.periodic:
            off = equation_text(equation(twin, component, values[at].tolist()))
        else:
            off = f"{error:+.1%}" if component.family == "linear" else f"{error:+.2g} {unit_text(site.unit)}".rstrip()
        return f"{site.into} reads {off} off: look at the sensor and its scale"
    return "; ".join(
        f"{component.site}: {equation_text(equation(twin, component, values[indices(problem, slot)].tolist()))}"
        for slot, component in enumerate(problem.components)
    )


def describe_noise(problem: Problem) -> str:
    """Return which levels of noise are not as stated, and which commands change between their samples."""
    return "; ".join([*describe_levels(problem), *map(CHANGING.format, problem.changing)])


def is_noisier_than_stated(problem: Problem) -> bool:
    """Whether the noise of something is larger than the machine file states; stating none is no statement."""
    return any(noise > stated > 0.0 for noise, stated in zip(problem.levels, problem.stated_levels, strict=True))


def describe_levels(problem: Problem) -> list[str]:
    """Return a text for each input, output and state whose noise is not as stated, with both levels."""
    twin = problem.base_model
    units = {name: "" if unit == "1" else f" {unit_text(unit)}" for name, unit in twin.units().items()}
    rows = [(f"{own} is less noisy than stated", f"{own} is noisier than stated", units[own]) for own in twin.signals]
    rows += [
        (f"{name} is disturbed less than stated", f"{name} is disturbed more than stated", f"{units[name]}/√s")
        for name in (state.name for state in twin.states)
    ]
    return [
        f"{more if noise > stated else less}: {noise:.2g}{unit} instead of {stated:.2g}"
        for (less, more, unit), noise, stated in zip(rows, problem.levels, problem.stated_levels, strict=True)
        if noise != stated
    ]


def _describe_delay(tracked: TrackedHypothesis) -> str:
    ((signal, delay),) = tracked.problem.delays
    value, low, high = _delay_numbers(tracked)
    return f"{signal} is {value} {'ms late' if delay > 0.0 else 'ms early'} ({low} to {high})"


def _delay_numbers(tracked: TrackedHypothesis) -> tuple[str, str, str]:
    """Return the size of a delay and the ends of its 95 % interval, ms."""
    ((_, delay),) = tracked.problem.delays
    reach = QUANTILE / np.sqrt(tracked.delay_information) if tracked.delay_information > 0.0 else np.inf
    digits, size = max(0, int(np.ceil(-np.log10(MS * reach)))) if 0.0 < reach < np.inf else 1, abs(delay)
    value, low, high = (f"{MS * number:.{digits}f}" for number in (size, size - reach, size + reach))
    return value, low, high


def describe_setting(tracked: TrackedHypothesis) -> str:
    """Return the delay of a late or early signal, as it is written into the machine file; empty without one."""
    if not tracked.problem.delays:
        return ""
    ((signal, delay),) = tracked.problem.delays
    place = f"[signals] {signal}" if delay > 0.0 else f"every other signal in [signals], as {signal} is the first"
    return f'write delay = "{_delay_numbers(tracked)[0]} ms" under {place}'
