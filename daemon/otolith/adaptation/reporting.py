"""From what was learned of a window to the report of it.

From adopted components and open cases to what is published of them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.state import AdaptationState
from otolith.discovery.adopted import AdoptedComponent, Alternative, Approval, alternatives, describe_hypothesis
from otolith.discovery.experiment_design import Situation, advise, deciding_experiment
from otolith.discovery.hypotheses import FaultType
from otolith.discovery.sequential_test import FilterState, SequentialTest, WindowDecision
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import base_model, equation, indices, input_matrix, site_of, source_of
from otolith.estimation.information import QUANTILE
from otolith.estimation.objective import EXPLAINED
from otolith.estimation.problem import Component, Problem
from otolith.estimation.window_fit import WindowEstimate
from otolith.health.schema import (
    AlternativeDocument,
    ComponentDocument,
    ComponentStatus,
    CostDocument,
    FindingDocument,
    FitDocument,
    NumberDocument,
    ParameterDocument,
    ReportDocument,
    Severity,
    Status,
    Traces,
    window_document,
)
from otolith.health.status import MarginalPosterior, PreviousStatus, WindowEvidence, publish
from otolith.twin.component_families import SourceKind


def component_documents(
    problem: Problem, known: Prior, catalogue: Sequence[AdoptedComponent]
) -> tuple[ComponentDocument, ...]:
    """Of the components in the twin, of whose numbers ``known`` is known."""
    entries = {entry.component.key: entry for entry in catalogue}
    found = []
    for slot, component in enumerate(problem.components):
        entry = entries.get(component.key, AdoptedComponent(component, component.origin))
        numbers = numbers_of(problem, known, slot)
        if all(math.isfinite(number.value + number.sd) for number in numbers.values()):
            found.append(_document(problem, component, numbers, entry))
    return tuple(found)


def _document(
    problem: Problem, component: Component, numbers: Mapping[str, NumberDocument], entry: AdoptedComponent
) -> ComponentDocument:
    twin = base_model(problem)
    site = site_of(twin, component.site)
    return ComponentDocument(
        id=component.key,
        site=component.site,
        meaning=site.meaning,
        mode=site.mode,
        family=component.family,
        input=component.source,
        equation=equation(twin, component, [number.value for number in numbers.values()]),
        values=dict(numbers),
        conditions=component.model.conditions,
        domain=component.model.domain,
        status=ComponentStatus.FADING if entry.fading else ComponentStatus.ADOPTED,
        approval=entry.approval,
        probability=entry.probability,
        onset=entry.onset,
        alternatives=_documents(entry.alternatives),
    )


def numbers_of(problem: Problem, known: Prior, slot: int) -> dict[str, NumberDocument]:
    """Amplitude, and inner number and phase as far as the component has them."""
    component = problem.components[slot]
    periodic = component.repeats
    place = source_of(base_model(problem), component.source).kind is SourceKind.PLACE
    inner = component.model.inner
    names = ["amplitude", "order" if periodic and place else "inner" if inner is None else inner.meaning, "phase"]
    deviations = np.sqrt(np.maximum(np.diag(known.covariance), 0.0))
    found = {}
    for name, at in zip(names, indices(problem, slot), strict=False):
        value, sd = float(known.mean[at]), float(deviations[at])
        low, high = value - QUANTILE * sd, value + QUANTILE * sd
        found[name] = NumberDocument(value=value, sd=sd, low=low, high=high, unit=problem.free[at].unit)
    return found


def explanations_of(case: SequentialTest | None) -> tuple[AlternativeDocument, ...]:
    """What could have happened, the most probable first, while it is not decided."""
    if case is None or case.best.reason is FaultType.NOTHING:
        return ()
    share = case.probabilities[0]
    best = Alternative(case.best.reason, describe_hypothesis(case.best), share)
    return _documents((best, *alternatives(case, case.best)))


def _documents(found: Sequence[Alternative]) -> tuple[AlternativeDocument, ...]:
    return tuple(
        AlternativeDocument(reason=entry.reason, text=entry.text, probability=entry.probability) for entry in found
    )


def findings_of(
    components: Sequence[ComponentDocument],
    explanations: Sequence[AlternativeDocument],
    case: SequentialTest | None,
    experiment: str,
) -> tuple[FindingDocument, ...]:
    """What an operator should read: one line for each component that is new, and one for an open case.

    ``experiment`` is what would decide it.
    """
    found = [_of_component(entry) for entry in components if entry.approval is Approval.OPEN]
    if explanations and case is not None:
        best = explanations[0]
        others = "".join(f"; or {entry.text} ({entry.probability:.0%})" for entry in explanations[1:3])
        text = f"{best.reason}: {best.text} ({best.probability:.0%}){others}"
        severity = Severity.WARNING if best.reason is not FaultType.SENSOR else Severity.FAULT
        found.append(FindingDocument(
            id="case", severity=severity, condition="something has happened that is not decided yet", text=text,
            since=case.onset, advice="; ".join(filter(None, (experiment, _of_the_file(case)))),
        ))  # fmt: skip
    return tuple(found)


def _of_the_file(case: SequentialTest) -> str:
    """What to do where a parameter seems to have moved that the machine file takes as known."""
    known = {name for entry in case.hypotheses if entry.reason is FaultType.NOTHING for name, _ in entry.problem.known}
    if case.best.reason is not FaultType.PARAMETER:
        return ""
    names = ", ".join(entry.name for entry in case.best.problem.free if entry.name in known)
    return names and f"if nothing has happened to the machine, {names} in its file is off: correct it or estimate it"


def _of_component(entry: ComponentDocument) -> FindingDocument:
    text = f"new {entry.meaning}: {entry.equation}"
    return FindingDocument(
        id=entry.id, severity=Severity.WARNING, condition=entry.conditions, text=text, since=entry.onset
    )


@dataclass(frozen=True, slots=True)
class WindowResult:
    """What is known after a window, and how it came about."""

    memory: FilterState
    before: Prior
    """What was known at the end of the window, but for the window."""
    after: Prior
    """What is known then."""
    problem: Problem
    """With the components that are in the twin then."""
    catalogue: tuple[AdoptedComponent, ...] = ()
    """Of these components."""
    found: WindowEstimate | None = None
    """None for a window that was not estimated from."""
    decision: WindowDecision = WindowDecision.BAD
    reason: str = ""
    """What there is to say of the window as a whole."""
    case: SequentialTest | None = None
    """What could have happened, if that is a question."""
    searched: bool = False
    """Whether it was asked what else could have happened."""


def document_of(
    state: AdaptationState, window: Window, learned: WindowResult
) -> tuple[dict[str, PreviousStatus], ReportDocument]:
    """The report of ``window`` after ``state``, and what it says of each parameter."""
    problem, memory, found = learned.problem, learned.memory, learned.found
    parameters: dict[str, ParameterDocument] = {}
    standing: dict[str, PreviousStatus] = {}
    allowed = problem.determined_within * problem.scale
    sure = learned.case is not None and not learned.case.doubts_parameters
    contradictions = 0 if sure else memory.contradictions
    for index, (entry, fused) in enumerate(zip(problem.free, _fused(learned), strict=True)):
        said = None if found is None else found.parameters[index]
        heard = WindowEvidence(said, learned.decision, contradictions, memory.belief.variance_ratio, learned.reason)
        before = state.standing.get(entry.label, PreviousStatus())
        standing[entry.label], said_of_it = publish(entry, float(allowed[index]), fused, heard, before)
        if not entry.name.startswith("_"):
            parameters[entry.name] = said_of_it
    _advise(problem, window, learned, parameters)
    components = component_documents(problem, learned.after, learned.catalogue)
    undecided = (
        learned.case
        if learned.decision in (WindowDecision.SUSPECTED, WindowDecision.SENSOR, WindowDecision.REFUSED)
        else None
    )
    explanations = explanations_of(undecided)
    experiment = _experiment(window, learned, undecided)
    document = ReportDocument(
        machine=state.machine,
        site=state.site,
        twin=problem.twin.name,
        model=_model(problem, standing),
        window=window_document(window),
        decision=learned.decision,
        parameters=parameters,
        components=components,
        explanations=explanations,
        findings=findings_of(components, explanations, learned.case, experiment),
    )
    if found is not None:
        cost = CostDocument(evaluations=found.evaluations, generations=found.generations, searched=learned.searched)
        document = document.model_copy(update={"fit": _fit(problem, found, memory), "cost": cost})
    return standing, document


def _model(problem: Problem, standing: dict[str, PreviousStatus]) -> str:
    """The paper's names."""
    if problem.components:
        return "DT''"
    return "DT'" if any(entry.known for entry in standing.values()) else "DT"


def traces_of(state: AdaptationState, window: Window, learned: WindowResult) -> Traces:
    """The curves behind the report; of the window as it came, with its spikes, so that it can be replayed from them."""
    found, twin = learned.found, base_model(state.problem)
    outputs, inputs = tuple(entry.name for entry in twin.outputs), tuple(entry.name for entry in twin.inputs)
    predicted = None if found is None else found.predicted
    return Traces(outputs, _present(window, outputs), predicted, state.problem.noise, inputs, _present(window, inputs))


def _present(window: Window, names: tuple[str, ...]) -> Array:
    """(records, names): not a number where nothing was measured."""
    columns = [np.where(window.missing_in(name), np.nan, window.column(name)) for name in names]
    return np.column_stack(columns) if columns else np.zeros((window.records, 0))


def _fused(learned: WindowResult) -> list[MarginalPosterior]:
    """Of each free parameter, what is known at the end of the window, and what this window did to it."""
    after = learned.after
    free = len(after.mean) // 2
    sd, sd_before = (np.sqrt(np.diag(known.covariance)) for known in (after, learned.before))
    return [
        MarginalPosterior(
            value=float(after.mean[index]),
            sd=float(sd[index]),
            trend=float(after.mean[free + index]),
            trend_sd=float(sd[free + index]),
            kept=float((sd[index] / sd_before[index]) ** 2),
        )
        for index in range(free)
    ]


def _advise(problem: Problem, window: Window, learned: WindowResult, documents: dict[str, ParameterDocument]) -> None:
    """Add what would pin down the parameters that this window did not."""
    found = learned.found
    wanted = [name for name, entry in documents.items() if entry.status in (Status.UNESTIMATED, Status.HELD)]
    if (
        found is None
        or learned.decision is not WindowDecision.LEARNED
        or not wanted
        or not np.isfinite(found.last_state).all()
    ):
        return
    inputs = input_matrix(problem.twin, window)[-1]
    situation = Situation(inputs, found.last_state, window.records, window.sample_period)
    for name, text in advise(problem, learned.after, situation, wanted).items():
        documents[name] = documents[name].model_copy(update={"advice": text})


def _experiment(window: Window, learned: WindowResult, case: SequentialTest | None) -> str:
    """What would tell the most probable explanation from the next one."""
    found = learned.found
    if case is None or found is None or not np.isfinite(found.last_state).all():
        return ""
    others = case.alternatives(case.best)
    if not others:
        return ""
    inputs = input_matrix(learned.problem.twin, window)[-1]
    situation = Situation(inputs, found.last_state, window.records, window.sample_period)
    return deciding_experiment(case.best, others[0][0], situation)


def _fit(problem: Problem, found: WindowEstimate, memory: FilterState) -> FitDocument:
    outputs = tuple(entry.name for entry in problem.twin.outputs)
    return FitDocument(
        rmse_configured=_finite(outputs, found.rmse_configured),
        rmse_estimated=_finite(outputs, found.rmse_estimated),
        rmse_completed=_finite(outputs, found.rmse_completed) if problem.components else None,
        explained=found.cost <= EXPLAINED,
        cost=found.cost,
        variance_ratio=memory.belief.variance_ratio,
        outcome=found.outcome,
    )


def _finite(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}
