"""From what was learned of a window to the report of it."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Window
from otolith.adaptation.advice import Situation, advise
from otolith.adaptation.estimate import WindowEstimate
from otolith.adaptation.gate import Lesson, Memory
from otolith.adaptation.objective import EXPLAINED
from otolith.adaptation.prior import Prior
from otolith.adaptation.problem import Problem
from otolith.health.report import (
    CostDocument,
    FitDocument,
    ParameterDocument,
    ReportDocument,
    Status,
    Traces,
    window_document,
)
from otolith.health.status import Fused, Heard, Standing, publish
from otolith.state import State


@dataclass(frozen=True, slots=True)
class Learned:
    """What is known after a window, and how it came about."""

    memory: Memory
    before: Prior
    """What was known at the end of the window, but for the window."""
    after: Prior
    """What is known then."""
    found: WindowEstimate | None = None
    """None for a window that was not estimated from."""
    lesson: Lesson = Lesson.BAD
    reason: str = ""
    """What there is to say of the window as a whole."""


def document_of(state: State, window: Window, learned: Learned) -> tuple[tuple[Standing, ...], ReportDocument]:
    """The report of ``window`` after ``state``, and what it says of each parameter."""
    problem, memory, found = state.problem, learned.memory, learned.found
    parameters: dict[str, ParameterDocument] = {}
    standing: list[Standing] = []
    allowed = problem.determined_within * problem.scale
    for index, (entry, fused) in enumerate(zip(problem.free, _fused(learned), strict=True)):
        said = None if found is None else found.parameters[index]
        heard = Heard(said, learned.lesson, memory.contradictions, memory.belief.scatter, learned.reason)
        now, parameters[entry.name] = publish(entry, float(allowed[index]), fused, heard, state.standing[index])
        standing.append(now)
    _advise(problem, window, learned, parameters)
    document = ReportDocument(
        machine=state.machine,
        site=state.site,
        twin=problem.twin.name,
        model="DT'" if any(entry.known for entry in standing) else "DT",
        window=window_document(window),
        lesson=learned.lesson,
        parameters=parameters,
    )
    if found is not None:
        cost = CostDocument(evaluations=found.evaluations, generations=found.generations)
        document = document.model_copy(update={"fit": _fit(problem, found, memory), "cost": cost})
    return tuple(standing), document


def traces_of(state: State, window: Window, learned: Learned) -> Traces:
    """The curves behind the report."""
    found, noise = learned.found, state.problem.noise
    names = tuple(entry.name for entry in state.problem.twin.outputs)
    if found is not None:
        return Traces(names, found.measured, found.predicted, noise)
    columns = [np.where(window.missing_in(name), np.nan, window.column(name)) for name in names]
    return Traces(names, np.column_stack(columns), None, noise)


def _fused(learned: Learned) -> list[Fused]:
    """Of each free parameter, what is known at the end of the window, and what this window did to it."""
    after = learned.after
    free = len(after.mean) // 2
    sd, sd_before = (np.sqrt(np.diag(known.covariance)) for known in (after, learned.before))
    return [
        Fused(
            value=float(after.mean[index]),
            sd=float(sd[index]),
            trend=float(after.mean[free + index]),
            trend_sd=float(sd[free + index]),
            kept=float((sd[index] / sd_before[index]) ** 2),
        )
        for index in range(free)
    ]


def _advise(problem: Problem, window: Window, learned: Learned, documents: dict[str, ParameterDocument]) -> None:
    """Add what would pin down the parameters that this window did not."""
    found = learned.found
    wanted = [name for name, entry in documents.items() if entry.status in (Status.UNESTIMATED, Status.HELD)]
    if found is None or learned.lesson is not Lesson.LEARNED or not wanted or not np.isfinite(found.last_state).all():
        return
    inputs = np.array([window.column(entry.name)[-1] for entry in problem.twin.inputs])
    situation = Situation(inputs, found.last_state, window.records, window.sample_period)
    for name, text in advise(problem, learned.after, situation, wanted).items():
        documents[name] = documents[name].model_copy(update={"advice": text})


def _fit(problem: Problem, found: WindowEstimate, memory: Memory) -> FitDocument:
    outputs = tuple(entry.name for entry in problem.twin.outputs)
    return FitDocument(
        rmse_configured=_finite(outputs, found.rmse_configured),
        rmse_estimated=_finite(outputs, found.rmse_estimated),
        explained=found.cost <= EXPLAINED,
        cost=found.cost,
        scatter=memory.belief.scatter,
        outcome=found.outcome,
    )


def _finite(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}
