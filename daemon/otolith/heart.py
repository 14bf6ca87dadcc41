"""The heart: one pure function from a state and a window to the next state and a report.

Time comes in with the window and randomness with the seed, so that every run can be reproduced bit for bit, and the
work can move between processes without loss.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.estimate import WindowEstimate, estimate
from otolith.health.report import (
    CostDocument,
    FitDocument,
    ParameterDocument,
    Report,
    ReportDocument,
    Traces,
    window_document,
)
from otolith.health.status import Known, publish
from otolith.state import State
from otolith.twin.definition import Definition

FEWEST_RECORDS = 5
LARGEST = 1e12  # of a value, in the unit of its signal: no sensor says that
REFUSED = 4.0  # cost beyond which the window contradicts the twin, and nothing is taken from it
EXPLAINED = 1.5  # cost (RMSE over noise) up to which the residual counts as noise
UNEXPLAINED = "the twin does not explain the window up to the noise: another parameter, a component or a sensor is off"


def adapt(state: State, window: Window) -> tuple[State, Report]:
    """Adapt the twin to ``window``; a bad window leaves the state where it was and is reported."""
    twin = state.problem.twin
    reasons = window.quality.reasons if window.quality.verdict is Verdict.BAD else _senseless(window)
    if reasons:
        reason = "window not estimated from: " + "; ".join(reasons)
        return state, Report(_document(state, window, state.known, None, reason)[1], _measured(state, twin, window))
    warm = all(entry is not None for entry in state.known)
    found = estimate(state.problem, window, _start(state), warm=warm)
    known, document = _document(state, window, state.known, found, "")
    traces = Traces(_outputs(twin), found.measured, found.predicted, state.problem.noise)
    return replace(state, known=known), Report(document, traces)


def _senseless(window: Window) -> tuple[str, ...]:
    """Why nothing can be estimated from a window, however well it was sampled."""
    if window.records < FEWEST_RECORDS:
        return (f"{window.records} records are too few",)
    if not (np.abs(window.values) < LARGEST).all():  # not a number is not smaller either
        return (f"a value is not finite or beyond {LARGEST:g}",)
    return ()


def _start(state: State) -> Array:
    """Where the search begins: at what is known, else as configured."""
    pairs = zip(state.known, state.problem.free, strict=True)
    return np.array([entry.nominal if known is None else known.value for known, entry in pairs])


def _outputs(twin: Definition) -> tuple[str, ...]:
    return tuple(entry.name for entry in twin.outputs)


def _measured(state: State, twin: Definition, window: Window) -> Traces:
    columns = [np.where(window.missing_in(name), np.nan, window.column(name)) for name in _outputs(twin)]
    return Traces(_outputs(twin), np.column_stack(columns), None, state.problem.noise)


def _document(
    state: State, window: Window, known: tuple[Known | None, ...], found: WindowEstimate | None, reason: str
) -> tuple[tuple[Known | None, ...], ReportDocument]:
    parameters: dict[str, ParameterDocument] = {}
    next_known: list[Known | None] = []
    for index, entry in enumerate(state.problem.free):
        said = None if found is None else found.parameters[index]
        doubt = UNEXPLAINED if found is not None and found.cost > EXPLAINED else ""
        refused = found is not None and found.cost > REFUSED
        kept, parameters[entry.name] = publish(entry, said, known[index], reason or doubt, refused=refused)
        next_known.append(kept)
    document = ReportDocument(
        machine=state.machine,
        site=state.site,
        twin=state.problem.twin.name,
        model="DT" if all(kept is None for kept in next_known) else "DT'",
        window=window_document(window),
        parameters=parameters,
    )
    if found is not None:
        outputs = _outputs(state.problem.twin)
        document = document.model_copy(
            update={
                "fit": FitDocument(
                    rmse_configured=_finite(outputs, found.rmse_configured),
                    rmse_estimated=_finite(outputs, found.rmse_estimated),
                    explained=found.cost <= EXPLAINED,
                ),
                "cost": CostDocument(evaluations=found.evaluations, generations=found.generations),
            }
        )
    return tuple(next_known), document


def _finite(names: tuple[str, ...], values: tuple[float, ...]) -> dict[str, float]:
    return {name: value for name, value in zip(names, values, strict=True) if np.isfinite(value)}
