"""The report of a window: from the result of the adaptation to the published document and the recorded traces."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from otolith.acquisition.window import Window, larger_sizes
from otolith.adaptation.state import AdaptationState
from otolith.discovery.alternatives import (
    ACCEPTED,
    ALTERNATIVES,
    CHANGING,
    COMPONENT_PROBABILITY,
    COMPONENT_WINDOWS,
    DATA_FAULTS,
    NO_EVIDENCE,
    POLLED,
    UPDATES,
    PosteriorUpdate,
    WindowDecision,
    describe_hypothesis,
    describe_levels,
    describe_setting,
    is_noisier_than_stated,
)
from otolith.discovery.decision import AdoptedComponent, Alternative, Approval, alternatives_of, is_plausible
from otolith.discovery.experiment_design import Situation, advise, deciding_experiment
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.sequential_test import SequentialTest
from otolith.estimation.data_checks import FaultySensor
from otolith.estimation.information import QUANTILE, Prior, required_half_widths
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, Problem, equation, indices, site_of, source_of, wrapped
from otolith.estimation.window_fit import WindowEstimate
from otolith.health.schema import (
    AlternativeDocument,
    ComponentDocument,
    ComponentStatus,
    CostDocument,
    FindingDocument,
    FindingKind,
    FitDocument,
    NumberDocument,
    ParameterDocument,
    PerformanceDocument,
    Report,
    ReportDocument,
    Severity,
    Status,
    Traces,
    window_document,
)
from otolith.health.status import (
    MarginalPosterior,
    PreviousStatus,
    WindowEvidence,
    publish,
    publish_performance,
    reference_values,
    some_parameter_is_determined,
    without_traded_at_a_bound,
)
from otolith.simulation.performance import Estimates, figures_of
from otolith.twin.components import SourceKind
from otolith_drivers.units import equation_text

DISAGREEING_RATIO = 3.0  # ratio of variances above which windows disagree with each other
DISAGREEMENT = (
    "the estimates of windows differ {:.1f} times more than their intervals allow: the twin or [noise] is wrong"
)
UNEXPLAINED = "the twin does not explain the window up to the noise: a parameter, component, sensor or [noise] is wrong"
NEVER_EXPLAINED = "check unit and scale in [signals], and the levels in [noise]"
UNDECIDED_WINDOWS = 4  # in a row, from which on the stated levels may be the cause
LEVELS_TOO_SMALL = (
    "{} windows in a row differ from their prediction by more than [noise] and [process_noise] allow: "
    "if the machine is well, these levels are too small: 'otolith noise' identifies them from a record"
)
OPEN = DATA_FAULTS | {WindowDecision.SUSPECTED, WindowDecision.AMBIGUOUS}
"""Decisions after which the hypotheses of a test go on, and their mixture is published."""
CHANGED = "something has changed"
NOT_EXPLAINED = "no hypothesis explains the data up to the noise: the cause may be one that is not among them"
NEAREST = "not explained: the nearest hypothesis, {hypothesis}, leaves errors of {factor:.1f} times the noise"
SENSOR_CONDITION = "its samples cannot be true"
NOISE_CONDITION = "the noise is not as large as [noise] or [process_noise] says"
NOISE_SETTING = "if the machine is well, write what was found into [noise] or [process_noise]"
AMBIGUOUS_CONDITION = "these explain the data equally well: what was recorded so far cannot distinguish them"


@dataclass(frozen=True, slots=True, eq=False)
class WindowResult:
    """What a window led to."""

    decision: WindowDecision
    posterior: Posterior  # For the next window
    before: Prior
    """Prior at the end of the window, without the window; equal to ``after`` where another posterior replaced it."""
    after: Prior  # What is known there with the window
    adopted: tuple[AdoptedComponent, ...]
    estimate: WindowEstimate | None = None  # None for a window that was not estimated from
    test: SequentialTest | None = None
    """The sequential test that is open, or that this window decided. If the filter was updated, it may still close."""
    reason: str = ""  # Why the window was not estimated from
    faulty_sensors: tuple[FaultySensor, ...] = ()  # Those whose samples made it unusable
    notes: tuple[str, ...] = ()  # What the data checks left out
    is_mixture: bool = False  # Whether after is the mixture of the hypotheses of an open test
    searched: bool = False  # Whether other hypotheses were compared
    sizes: Mapping[str, float] = field(default_factory=dict)  # AdaptationState.sizes before the window

    @classmethod
    def unchanged(  # noqa: PLR0913 - the optional parts of a result
        cls,
        state: AdaptationState,
        predicted: Posterior,
        decision: WindowDecision,
        *,
        estimate: WindowEstimate | None = None,
        test: SequentialTest | None = None,
        reason: str = "",
    ) -> "WindowResult":
        """Return the result of a window that does not update the posterior: values are held, intervals grow."""
        prior = state.posterior.held(predicted)
        return cls(decision, state.posterior, prior, prior, state.adopted, estimate, test, reason)

    @property
    def is_accepted(self) -> bool:
        """Whether the window updated the posterior."""
        return self.decision in ACCEPTED

    @property
    def update(self) -> PosteriorUpdate:
        """How the window changed the posterior."""
        return UPDATES[self.decision]

    @property
    def is_explained(self) -> bool:
        """Whether the best hypothesis of an open test explains the window up to the noise."""
        return self.test is None or self.test.explains_window

    def contradictions(self, state: AdaptationState) -> int:
        """Return how many windows in a row, with this one, did not update the posterior; bad data are not counted."""
        return 0 if self.is_accepted else state.contradictions + (self.decision not in NO_EVIDENCE)

    def noisier_since(self, state: AdaptationState) -> float | None:
        """Return from when on more noise than stated is accepted, service time in s; None if none is."""
        if self.decision is not WindowDecision.NOISIER or not self.posterior.problem.stated_noise:
            return state.noisier_since
        return self.test.onset if self.test else state.noisier_since or self.posterior.belief.end


def make_report(
    state: AdaptationState, window: Window, result: WindowResult
) -> tuple[dict[str, PreviousStatus], Report]:
    """Return the status of each free parameter by its label, and the report of ``window`` after ``state``."""
    problem = result.posterior.problem
    traces = _traces(state.posterior.problem, window, result.estimate)
    situation = _situation(result.estimate)
    previous, parameters = _parameters(state, result)
    _add_advice(parameters, result, situation)
    components = _component_documents(problem, result.after, result.adopted)
    undecided = None if result.is_accepted and not result.is_mixture else result.test
    document = ReportDocument(
        machine=state.machine,
        site=state.site,
        twin=problem.twin.name,
        model=_model_name(problem, previous),
        window=window_document(window),
        decision=result.decision,
        parameters=parameters,
        performance=_performance(state, window, result, parameters),
        components=components,
        explanations=_explanations(undecided),
        findings=(
            *(_sensor_finding(sensor, window.start) for sensor in result.faulty_sensors),
            *(_polled_finding(command, window.start) for command in problem.changing),
            *_findings(components, undecided, result, result.noisier_since(state), _experiment(undecided, situation)),
        ),
        **_fit_and_cost(problem, result),
    )
    return previous, Report(document, traces)


def _situation(estimated: WindowEstimate | None) -> Situation | None:
    """Return where the machine is at the end of the window, or None if that is not known."""
    if estimated is None or not np.isfinite(estimated.last_state).all():
        return None
    inputs, window = estimated.fit.objective.excitation.inputs[-1], estimated.fit.window
    return Situation(inputs, estimated.last_state, window.records, window.sample_period, window.end)


def _parameters(
    state: AdaptationState, result: WindowResult
) -> tuple[dict[str, PreviousStatus], dict[str, ParameterDocument]]:
    """Return status and document of each free parameter."""
    problem, estimated = result.posterior.problem, result.estimate
    documents: dict[str, ParameterDocument] = {}
    previous: dict[str, PreviousStatus] = {}
    count = len(problem.free)
    required = required_half_widths(problem, result.after.mean[:count])
    if result.is_mixture:  # a change that is not accepted yet allows no less accuracy than the value before it
        required = np.minimum(required, required_half_widths(problem, result.posterior.prior().mean[:count]))
    contradictions = result.contradictions(state)
    variance_ratio, reason = result.posterior.belief.variance_ratio, _reason(state, result)
    for index, (parameter, marginal) in enumerate(zip(problem.free, _marginals(result), strict=True)):
        alone = None if estimated is None else estimated.parameters[index]
        evidence = WindowEvidence(
            alone, result.decision, contradictions, variance_ratio, result.is_mixture, result.is_explained, reason
        )
        before = state.previous.get(parameter.label, PreviousStatus())
        previous[parameter.label], document = publish(parameter, float(required[index]), marginal, evidence, before)
        if not parameter.name.startswith("_"):
            documents[parameter.name] = document
    if estimated is not None:
        documents = without_traded_at_a_bound(documents, estimated.parameters)
    for parameter in problem.free:
        if parameter.name in documents:
            status = documents[parameter.name].status
            previous[parameter.label] = replace(previous[parameter.label], status=status)
    return previous, documents


def _performance(
    state: AdaptationState, window: Window, result: WindowResult, documents: Mapping[str, ParameterDocument]
) -> dict[str, PerformanceDocument] | None:
    """Return the figures of performance, with the values of the parameters as they are published."""
    problem, observed = result.posterior.problem, window_document(window).observed or {}
    twin = problem.base_model
    if not twin.performance:
        return None
    free = [item.name for item in problem.free[: len(documents)]]
    own, sd = result.after.covariance[: len(free), : len(free)], result.after.sd[: len(free)]
    stated = np.array([documents[name].sd if documents[name].sd is not None else sd[k] for k, name in enumerate(free)])
    values = dict(problem.known) | dict(zip(free, result.after.mean[: len(free)].tolist(), strict=True))
    values |= {name: item.value for name, item in documents.items() if item.value is not None}
    covariance = own * np.outer(stated / sd, stated / sd)
    references = reference_values(state.plan.parameters, documents, observed)
    predicted = None if result.estimate is None else result.estimate.predicted
    estimates = Estimates(values, tuple(free), covariance, references)
    return publish_performance(figures_of(twin, estimates, window, predicted), documents)


def _marginals(result: WindowResult) -> list[MarginalPosterior]:
    """Return what is known of each free parameter at the end of the window."""
    after, free = result.after, len(result.after.mean) // 2
    sd, sd_before = after.sd, result.before.sd
    return [
        MarginalPosterior(
            value=float(after.mean[index]),
            sd=float(sd[index]),
            trend=float(after.mean[free + index]),
            trend_sd=float(sd[free + index]),
            variance_left=float((sd[index] / sd_before[index]) ** 2),
        )
        for index in range(free)
    ]


def _reason(state: AdaptationState, result: WindowResult) -> str:
    """Return the remarks on the window as a whole."""
    if result.estimate is None:
        return result.reason
    decision, test = result.decision, result.test
    reasons = [*result.notes]
    if decision is not WindowDecision.LEARNED:
        reasons.append(decision.in_words)
    if test is not None and result.is_mixture:
        reasons.append(_hypotheses_text(test))
    if not result.estimate.is_explained and decision is not WindowDecision.REFUSED:
        reasons.append(UNEXPLAINED)
    variance_ratio = result.posterior.belief.variance_ratio
    if variance_ratio > DISAGREEING_RATIO:
        reasons.append(DISAGREEMENT.format(variance_ratio**0.5))
    if decision is WindowDecision.SUSPECTED and (windows := result.contradictions(state)) >= UNDECIDED_WINDOWS:
        reasons.append(LEVELS_TOO_SMALL.format(windows))
    if decision is WindowDecision.REFUSED and not some_parameter_is_determined(state.previous):
        reasons.append(NEVER_EXPLAINED)
    return "; ".join(reasons)


def _add_advice(documents: dict[str, ParameterDocument], result: WindowResult, situation: Situation | None) -> None:
    """Add the experiment that would determine each parameter that this window did not."""
    wanted = [name for name, item in documents.items() if item.status in (Status.UNESTIMATED, Status.HELD)]
    if situation is None or result.decision is not WindowDecision.LEARNED or not wanted:
        return
    for name, text in advise(result.posterior.problem, result.after, situation, wanted).items():
        documents[name] = documents[name].model_copy(update={"advice": text})


def _model_name(problem: Problem, previous: Mapping[str, PreviousStatus]) -> str:
    """Return the paper's name of the twin: as configured, with estimated parameters, or with components."""
    if problem.components:
        return "DT''"
    return "DT'" if some_parameter_is_determined(previous) else "DT"


def _fit_and_cost(problem: Problem, result: WindowResult) -> dict[str, FitDocument | CostDocument]:
    """Return the documents of fit and cost by their keys; none for a window that was not estimated from."""
    estimated = result.estimate
    if estimated is None:
        return {}
    outputs = tuple(output.name for output in problem.twin.outputs)
    completed = _finite(outputs, estimated.rmse_completed) if problem.components else None
    fit = FitDocument(
        rmse_configured=_finite(outputs, estimated.rmse_configured),
        rmse_estimated=_finite(outputs, estimated.rmse_estimated),
        rmse_completed=completed,
        explained=estimated.is_explained,
        cost=estimated.cost,
        variance_ratio=result.posterior.belief.variance_ratio,
        outcome=estimated.outcome,
        units={output.name: output.unit for output in problem.twin.outputs},
    )
    cost = CostDocument(evaluations=estimated.evaluations, generations=estimated.generations, searched=result.searched)
    return {"fit": fit, "cost": cost}


def _finite(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}


def _component_documents(
    problem: Problem, known: Prior, adopted: Sequence[AdoptedComponent]
) -> tuple[ComponentDocument, ...]:
    """Return the documents of the components in the twin whose values are finite."""
    histories = {item.component.key: item for item in adopted}
    documents = []
    for slot, component in enumerate(problem.components):
        history = histories.get(component.key, AdoptedComponent(component, component.origin))
        values = _component_values(problem, known, slot)
        if all(math.isfinite(number.value + number.sd) for number in values.values()):
            documents.append(_component_document(problem, component, values, history))
    return tuple(documents)


def _component_values(problem: Problem, known: Prior, slot: int) -> dict[str, NumberDocument]:
    """Return amplitude, inner parameter and phase, as far as the component has them."""
    component = problem.components[slot]
    place = source_of(problem.base_model, component.source).kind is SourceKind.PLACE
    inner = component.model.inner
    inner_name = "order" if component.periodic and place else "inner" if inner is None else inner.meaning
    deviations = np.sqrt(np.maximum(np.diag(known.covariance), 0.0))
    values = {}
    for name, at in zip(("amplitude", inner_name, "phase"), indices(problem, slot), strict=False):
        value, sd = float(known.mean[at]), float(deviations[at])
        value = wrapped(value) if name == "phase" and component.periodic else value
        values[name] = _number(value, sd, problem.free[at].unit)
    return values


def _component_document(
    problem: Problem, component: Component, values: Mapping[str, NumberDocument], history: AdoptedComponent
) -> ComponentDocument:
    twin = problem.base_model
    site = site_of(twin, component.site)
    return ComponentDocument(
        id=component.key,
        site=component.site,
        meaning=site.meaning,
        mode=site.mode,
        family=component.family,
        input=component.source,
        equation=equation(twin, component, [number.value for number in values.values()]),
        values=dict(values),
        conditions=component.model.conditions,
        domain=component.model.domain,
        status=ComponentStatus.FADING if history.fading else ComponentStatus.ADOPTED,
        approval=history.approval,
        probability=history.probability,
        onset=history.onset,
        alternatives=_alternative_documents(history.alternatives),
    )


def _explanations(test: SequentialTest | None) -> tuple[AlternativeDocument, ...]:
    """Return the competing hypotheses, the most probable first; none if even that does not explain the window."""
    if test is None or test.best.type is FaultType.NOTHING or not test.explains_window:
        return ()
    best = Alternative(test.best.type, describe_hypothesis(test.best), test.probabilities[0])
    return _alternative_documents((best, *alternatives_of(test, test.best)), 1.0 - test.wrong_probability)


def _hypotheses_text(test: SequentialTest) -> str:
    """Return the most probable hypotheses in words; without probabilities if none explains the window."""
    items = _explanations(test)[:3]
    stated = [
        f"{'' if before is not None and before.reason == item.reason else f'{item.reason}: '}{item.text} "
        f"({_share(item.probability)})"
        for before, item in zip((None, *items), items, strict=False)
    ]
    return "; or ".join(stated) or NEAREST.format(hypothesis=describe_hypothesis(test.best), factor=test.best.cost)


def _alternative_documents(alternatives: Sequence[Alternative], right: float = 1.0) -> tuple[AlternativeDocument, ...]:
    """Return the documents of ``alternatives``, of which one holds with the probability ``right``."""
    return tuple(
        AlternativeDocument(reason=item.type, text=item.text, probability=right * item.probability)
        for item in alternatives
    )


def _sensor_finding(sensor: FaultySensor, start: float) -> FindingDocument:
    return FindingDocument(
        id=f"{FindingKind.SENSOR}/{sensor.signal}",
        kind=FindingKind.SENSOR,
        subject=sensor.signal,
        severity=Severity.FAULT,
        condition=SENSOR_CONDITION,
        text=sensor.text,
        since=start,
        advice=sensor.advice,
        setting=sensor.setting,
    )


def _findings(
    components: Sequence[ComponentDocument],
    undecided: SequentialTest | None,
    result: WindowResult,
    noisier_since: float | None,
    experiment: str,
) -> tuple[FindingDocument, ...]:
    """Return a finding for each component that is not approved, for noise that is not as stated, and for an open test.

    ``undecided`` is the test if it is still open, and ``experiment`` what would decide it.
    """
    findings = [
        _component_finding(component)
        for component in components
        if component.approval is Approval.OPEN and component.status is ComponentStatus.ADOPTED
    ]
    if noisier_since is not None:
        findings.append(_noise_finding(result.posterior.problem, noisier_since))
    if undecided is not None and undecided.best.type is not FaultType.NOTHING:
        findings.append(_open_finding(undecided, result, experiment))
    return tuple(findings)


def _noise_finding(problem: Problem, since: float) -> FindingDocument:
    return FindingDocument(
        id="noise",
        kind=FindingKind.NOISE,
        severity=Severity.WARNING,
        condition=NOISE_CONDITION,
        text="; ".join(describe_levels(problem)),
        since=since,
        setting=NOISE_SETTING,
        of_file=not is_noisier_than_stated(problem),
    )


def _polled_finding(command: str, since: float) -> FindingDocument:
    return FindingDocument(
        id=f"{FindingKind.POLLED}/{command}",
        kind=FindingKind.POLLED,
        subject=command,
        severity=Severity.WARNING,
        condition=CHANGING.format(command),
        text=CHANGING.format(command),
        since=since,
        setting=POLLED.format(command),
        of_file=True,
    )


def _open_finding(test: SequentialTest, result: WindowResult, experiment: str) -> FindingDocument:
    """Return the finding of a test that is still open after the decision of ``result``."""
    decision = result.decision
    fault = _data_fault(decision, test)
    kind, subject = _kind_and_subject(decision, test, fault)
    text = _hypotheses_text(test)
    condition = AMBIGUOUS_CONDITION if fault is None else str(fault.type)
    condition = condition if test.explains_window else NOT_EXPLAINED
    return FindingDocument(
        id=f"{kind}/{subject}" if subject else "undecided",
        kind=kind,
        subject=subject,
        severity=Severity.FAULT if decision in DATA_FAULTS else Severity.WARNING,
        condition=_what_is_new(test) if kind is FindingKind.OPEN else condition,
        text=text.removeprefix(f"{test.best.type}: ") if decision in DATA_FAULTS else text,
        since=test.onset,
        error=_error(fault, result),
        advice=experiment,
        setting=describe_setting(fault or test.best) or _corrected_value(test),
        value=_moved_value(test, subject) if kind is FindingKind.MOVED else None,
    )


def _what_is_new(test: SequentialTest) -> str:
    """Return what all candidates of an open test agree on, in words; they may agree on nothing but a change."""
    twin, before = test.problem.base_model, {item.key for item in test.problem.components}
    candidates = [test.best, *(other for other, _ in test.alternatives(test.best))]
    new = [[item for item in each.problem.components if item.key not in before] for each in candidates]
    sites = {item.site for each in new for item in each}
    is_agreed = all(new) and all(each.type is FaultType.COMPONENT for each in candidates) and len(sites) == 1
    return f"new {site_of(twin, sites.pop()).meaning}" if is_agreed and test.explains_window else CHANGED


def _share(probability: float) -> str:
    """A probability; what is undecided has no 100 %, and an alternative that is named no 0 %."""
    return ">99%" if probability > 0.99 else "<1%" if probability < 0.01 else f"{probability:.0%}"


def _data_fault(decision: WindowDecision, test: SequentialTest) -> TrackedHypothesis | None:
    """Return the hypothesis that data are wrong on which ``decision`` rests; None if it rests on none."""
    own = (item for item in test.hypotheses if decision in DATA_FAULTS)
    return next((item for item in own if ALTERNATIVES[item.type].decision is decision), None)


def _kind_and_subject(
    decision: WindowDecision, test: SequentialTest, fault: TrackedHypothesis | None
) -> tuple[FindingKind, str]:
    """Return what an open test is about: wrong data, a class of hypotheses, or not known yet."""
    if decision is WindowDecision.AMBIGUOUS:
        return FindingKind.CLASS, ""
    if fault is not None:
        return FindingKind[fault.type.name], (ALTERNATIVES[fault.type].places(fault) or ("",))[-1]
    return (FindingKind.MOVED, moved) if (moved := _moved_known(test)) else (FindingKind.OPEN, "")


def _error(fault: TrackedHypothesis | None, result: WindowResult) -> float | None:
    """Return the delay of a late signal, s, or the error of a sensor over the size of its signal.

    That of an offset is its share of the largest root mean square of the signal in a window; None without a size.
    """
    if fault is None or not (fault.problem.components or fault.problem.delays):
        return None
    if fault.problem.delays:
        return fault.problem.delays[0][1]
    slot = len(fault.problem.components) - 1
    component, amplitude = fault.problem.components[slot], fault.posterior.prior().mean[indices(fault.problem, slot)[0]]
    site = site_of(fault.problem.base_model, component.site)
    if component.family == "linear" or site.mode == "multiplicative":
        return float(amplitude)
    size = result.sizes.get(site.into, 0.0)
    if result.estimate is not None:
        size = larger_sizes(result.sizes, result.estimate.fit.window).get(site.into, 0.0)
    return float(amplitude) / size if size > 0.0 else None


def _moved_known(test: SequentialTest) -> str:
    """Return the parameter that the machine file gives as known and that has moved for all that the test shows."""
    names = {parameter.name for parameter in test.best.problem.free} & {name for name, _ in test.problem.known}
    probable = test.probability(FaultType.PARAMETER) >= COMPONENT_PROBABILITY
    is_sure = probable and test.counts.leading >= COMPONENT_WINDOWS
    is_alone = test.explains_window and test.best.type is FaultType.PARAMETER and len(names) == 1
    is_alone = is_alone and is_plausible(test.best)
    return names.pop() if is_alone and is_sure else ""


def _moved_value(test: SequentialTest, name: str) -> NumberDocument:
    """Return the value that the leading hypothesis gives a parameter."""
    problem, prior = test.best.problem, test.best.posterior.prior()
    index = [item.name for item in problem.free].index(name)
    return _number(float(prior.mean[index]), math.sqrt(float(prior.covariance[index, index])), problem.free[index].unit)


def _number(value: float, sd: float, unit: str) -> NumberDocument:
    reach = QUANTILE * sd
    return NumberDocument(value=value, sd=sd, low=value - reach, high=value + reach, unit=unit)


def _component_finding(component: ComponentDocument) -> FindingDocument:
    return FindingDocument(
        id=component.id,
        kind=FindingKind.COMPONENT,
        subject=component.site,
        severity=Severity.WARNING,
        condition=component.conditions,
        text=f"new {component.meaning}: {equation_text(component.equation)}",
        since=component.onset,
    )


def _corrected_value(test: SequentialTest) -> str:
    """Return what to write where a parameter seems to have moved that the machine file gives as known."""
    null = [item.problem.known for item in test.hypotheses if item.type is FaultType.NOTHING]
    known = {name for pairs in null for name, _ in pairs}
    if test.best.type is not FaultType.PARAMETER:
        return ""
    names = ", ".join(parameter.name for parameter in test.best.problem.free if parameter.name in known)
    return names and f"if nothing has happened to the machine, {names} in its file is wrong: correct it or estimate it"


def _experiment(test: SequentialTest | None, situation: Situation | None) -> str:
    """Return the experiment that would distinguish the most probable hypothesis from the next one."""
    if test is None or situation is None or not test.explains_window:
        return ""
    others = test.alternatives(test.best)
    return deciding_experiment(test.best, others[0][0], situation) if others else ""


def _traces(problem: Problem, window: Window, estimated: WindowEstimate | None) -> Traces:
    """Return the curves of the window as it was recorded, spikes included, so that it can be replayed from them."""
    twin = problem.base_model
    outputs, inputs = tuple(output.name for output in twin.outputs), tuple(source.name for source in twin.inputs)
    predicted = None if estimated is None else estimated.predicted
    measured, driving = window.measured(outputs), window.measured(inputs)
    return Traces(window.grid.offsets, outputs, measured, predicted, problem.noise, inputs, driving)
