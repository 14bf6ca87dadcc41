"""From adopted components and open cases to what is published of them."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from otolith.adaptation.case import Case
from otolith.adaptation.catalogue import Alternative, Approval, Entry, alternatives, words
from otolith.adaptation.claims import Reason
from otolith.adaptation.completion import equation, places, plain, site_of, source_of
from otolith.adaptation.component import Component
from otolith.adaptation.information import QUANTILE
from otolith.adaptation.prior import Prior
from otolith.adaptation.problem import Problem
from otolith.health.finding import (
    AlternativeDocument,
    ComponentDocument,
    ComponentStatus,
    FindingDocument,
    NumberDocument,
    Severity,
)
from otolith.twin.metamodels import Kind


def component_documents(problem: Problem, known: Prior, catalogue: Sequence[Entry]) -> tuple[ComponentDocument, ...]:
    """Of the components in the twin, of whose numbers ``known`` is known."""
    entries = {entry.component.key: entry for entry in catalogue}
    found = []
    for slot, component in enumerate(problem.components):
        entry = entries.get(component.key, Entry(component, component.origin))
        numbers = numbers_of(problem, known, slot)
        if all(math.isfinite(number.value + number.sd) for number in numbers.values()):
            found.append(_document(problem, component, numbers, entry))
    return tuple(found)


def _document(
    problem: Problem, component: Component, numbers: Mapping[str, NumberDocument], entry: Entry
) -> ComponentDocument:
    twin = plain(problem)
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
    place = source_of(plain(problem), component.source).kind is Kind.PLACE
    inner = component.model.inner
    names = ["amplitude", "order" if periodic and place else "inner" if inner is None else inner.meaning, "phase"]
    deviations = np.sqrt(np.maximum(np.diag(known.covariance), 0.0))
    found = {}
    for name, at in zip(names, places(problem, slot), strict=False):
        value, sd = float(known.mean[at]), float(deviations[at])
        low, high = value - QUANTILE * sd, value + QUANTILE * sd
        found[name] = NumberDocument(value=value, sd=sd, low=low, high=high, unit=problem.free[at].unit)
    return found


def explanations_of(case: Case | None) -> tuple[AlternativeDocument, ...]:
    """What could have happened, the most probable first, while it is not decided."""
    if case is None or case.best.reason is Reason.NOTHING:
        return ()
    share = case.probabilities[0]
    best = Alternative(case.best.reason, words(case.best), share)
    return _documents((best, *alternatives(case, case.best)))


def _documents(found: Sequence[Alternative]) -> tuple[AlternativeDocument, ...]:
    return tuple(
        AlternativeDocument(reason=entry.reason, text=entry.text, probability=entry.probability) for entry in found
    )


def findings_of(
    components: Sequence[ComponentDocument],
    explanations: Sequence[AlternativeDocument],
    case: Case | None,
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
        severity = Severity.WARNING if best.reason is not Reason.SENSOR else Severity.FAULT
        found.append(FindingDocument(
            id="case", severity=severity, condition="something has happened that is not decided yet", text=text,
            since=case.onset, advice="; ".join(filter(None, (experiment, _of_the_file(case)))),
        ))  # fmt: skip
    return tuple(found)


def _of_the_file(case: Case) -> str:
    """What to do where a parameter seems to have moved that the machine file takes as known."""
    known = {name for entry in case.hypotheses if entry.reason is Reason.NOTHING for name, _ in entry.problem.known}
    if case.best.reason is not Reason.PARAMETER:
        return ""
    names = ", ".join(entry.name for entry in case.best.problem.free if entry.name in known)
    return names and f"if nothing has happened to the machine, {names} in its file is off: correct it or estimate it"


def _of_component(entry: ComponentDocument) -> FindingDocument:
    text = f"new {entry.meaning}: {entry.equation}"
    return FindingDocument(
        id=entry.id, severity=Severity.WARNING, condition=entry.conditions, text=text, since=entry.onset
    )
