"""The heart: one pure function from a state and a window to the next state and a report.

Time comes in with the window and randomness with the seed, so that every run can be reproduced bit for bit, and the
work can move between processes without loss.
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Verdict, Window
from otolith.adaptation.estimate import WindowEstimate, estimate
from otolith.adaptation.fusion import carried, overall
from otolith.adaptation.gate import REFUSED, Lesson, Memory, doubt, is_surprising, learn, refuse
from otolith.adaptation.prior import Prior
from otolith.adaptation.problem import Problem
from otolith.adaptation.sensors import stuck, wrong_scale
from otolith.adaptation.spikes import without_spikes
from otolith.health.report import (
    CostDocument,
    FitDocument,
    ParameterDocument,
    Report,
    ReportDocument,
    Traces,
    window_document,
)
from otolith.health.status import Fused, Heard, Standing, publish
from otolith.state import State
from otolith.twin.definition import Definition

FEWEST_RECORDS = 5
LARGEST = 1e12  # of a value, in the unit of its signal: no sensor says that
EXPLAINED = 1.5  # cost (RMSE over noise) up to which the residual counts as noise
SCATTERED = 3.0  # ratio of variances: windows disagree that much more than they say
CONTRADICTORY = "windows disagree with each other {:.1f} times more than they should: the twin lacks something"
UNEXPLAINED = "the twin does not explain the window up to the noise: another parameter, a component or a sensor is off"


def adapt(state: State, window: Window) -> tuple[State, Report]:
    """Adapt the twin to ``window``; a bad window leaves what is known where it was and is reported."""
    reasons = window.quality.reasons if window.quality.verdict is Verdict.BAD else _senseless(window)
    if reasons:
        reason = "window not estimated from: " + "; ".join(reasons)
        standing, document = _document(state, window, _Learned(state.memory, reason=reason))
        return replace(state, standing=standing), Report(document, _measured(state, window))
    learned = _judge(state, window)
    standing, document = _document(state, window, learned)
    found = learned.found
    traces = _measured(state, window) if found is None else _traces(state, found)
    return replace(state, memory=learned.memory, standing=standing), Report(document, traces)


@dataclass(frozen=True, slots=True)
class _Learned:
    """What is known after a window, and how it came about."""

    memory: Memory
    found: WindowEstimate | None = None
    lesson: Lesson | None = None
    reason: str = ""


def _judge(state: State, window: Window) -> _Learned:
    """Sensors are looked at first: what lies must not teach."""
    problem, memory = state.problem, state.memory
    window, notes, vetoes = without_spikes(window, problem.twin, problem.noise)
    if not vetoes:
        vetoes = stuck(problem, window, _start(overall(carried(memory.belief, window.end), problem), problem))
    if vetoes:
        return _Learned(refuse(memory), reason="; ".join(["window not estimated from", *vetoes]), lesson=Lesson.SENSOR)
    learned = _learn(state, window)
    return replace(learned, reason="; ".join(filter(None, (*notes, learned.reason))))


def _learn(state: State, window: Window) -> _Learned:
    problem, memory = state.problem, state.memory
    expected = carried(memory.belief, window.end)
    prior = overall(expected, problem)
    warm = any(entry.known for entry in state.standing)
    found = estimate(problem, window, _start(prior, problem), prior, warm=warm)
    refused = found.cost > REFUSED
    if not refused and not is_surprising(expected, found.evidence, problem):
        return _learned(learn(memory, expected, found.evidence, problem), found, Lesson.LEARNED)
    fault = wrong_scale(problem, window, prior, found.chi_square, memory.lying) if warm else None
    if fault is not None:
        return _Learned(refuse(memory, fault.output), found, Lesson.SENSOR, str(fault))
    if refused:
        return _learned(refuse(memory), found, Lesson.REFUSED)
    alone = estimate(problem, window, np.array([entry.value for entry in found.parameters]), warm=True)
    after, lesson = doubt(memory, expected, alone.evidence, problem)
    return _learned(after, alone, lesson)


def _learned(memory: Memory, found: WindowEstimate, lesson: Lesson) -> _Learned:
    """With what there is to say of the window as a whole."""
    reasons = [] if lesson is Lesson.LEARNED else [lesson.value]
    if found.cost > EXPLAINED and lesson is not Lesson.REFUSED:
        reasons.append(UNEXPLAINED)
    if memory.belief.scatter > SCATTERED:
        reasons.append(CONTRADICTORY.format(memory.belief.scatter**0.5))
    return _Learned(memory, found, lesson, "; ".join(reasons))


def _senseless(window: Window) -> tuple[str, ...]:
    """Why nothing can be estimated from a window, however well it was sampled."""
    if window.records < FEWEST_RECORDS:
        return (f"{window.records} records are too few",)
    if not (np.abs(window.values) < LARGEST).all():  # not a number is not smaller either
        return (f"a value is not finite or beyond {LARGEST:g}",)
    return ()


def _start(prior: Prior, problem: Problem) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(free,) where the search begins."""
    return np.clip(prior.mean[: len(problem.free)], *problem.bounds)


def _outputs(twin: Definition) -> tuple[str, ...]:
    return tuple(entry.name for entry in twin.outputs)


def _traces(state: State, found: WindowEstimate) -> Traces:
    return Traces(_outputs(state.problem.twin), found.measured, found.predicted, state.problem.noise)


def _measured(state: State, window: Window) -> Traces:
    names = _outputs(state.problem.twin)
    columns = [np.where(window.missing_in(name), np.nan, window.column(name)) for name in names]
    return Traces(names, np.column_stack(columns), None, state.problem.noise)


def _document(state: State, window: Window, learned: _Learned) -> tuple[tuple[Standing, ...], ReportDocument]:
    problem, memory, found, lesson = state.problem, learned.memory, learned.found, learned.lesson
    parameters: dict[str, ParameterDocument] = {}
    standing: list[Standing] = []
    allowed = problem.determined_within * problem.scale
    for index, (entry, fused) in enumerate(zip(problem.free, _fused(state, memory, window.end), strict=True)):
        said = None if found is None else found.parameters[index]
        heard = Heard(said, lesson, memory.contradictions, memory.belief.scatter, learned.reason)
        now, parameters[entry.name] = publish(entry, float(allowed[index]), fused, heard, state.standing[index])
        standing.append(now)
    document = ReportDocument(
        machine=state.machine,
        site=state.site,
        twin=problem.twin.name,
        model="DT'" if any(entry.known for entry in standing) else "DT",
        window=window_document(window),
        parameters=parameters,
    )
    if found is not None and lesson is not None:
        document = document.model_copy(update=_fit(found, lesson, memory, _outputs(problem.twin)))
    return tuple(standing), document


def _fused(state: State, memory: Memory, end: float) -> list[Fused]:
    """Of each free parameter, what is known at ``end`` (Unix s), and what this window did to it."""
    free = len(state.problem.free)
    before = overall(carried(state.memory.belief, end), state.problem)
    after = overall(carried(memory.belief, end), state.problem) if memory is not state.memory else before
    sd, sd_before = (np.sqrt(np.diag(known.covariance)) for known in (after, before))
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


def _fit(found: WindowEstimate, lesson: Lesson, memory: Memory, outputs: tuple[str, ...]) -> dict[str, object]:
    return {
        "fit": FitDocument(
            rmse_configured=_finite(outputs, found.rmse_configured),
            rmse_estimated=_finite(outputs, found.rmse_estimated),
            explained=found.cost <= EXPLAINED,
            cost=found.cost,
            scatter=memory.belief.scatter,
            outcome=found.outcome,
            lesson=lesson,
        ),
        "cost": CostDocument(evaluations=found.evaluations, generations=found.generations),
    }


def _finite(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}
