"""Figures of performance: what the machine costs or yields now, when it was healthy, and with a parameter at a limit.

A figure is an expression of the twin. What ``at`` states is its operating point. All other signals are those of the
window, and the figure is the mean over it; they are the same for each comparison, so that only parameters differ. One
evaluation with a row per set of parameters gives all numbers. The interval is that of the parameters by the delta
method (C. M. Bishop, Pattern Recognition and Machine Learning, section 4.5.2 has the same linearisation).
"""

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.twin.definition import Definition, Figure
from otolith.twin.expressions import evaluate, names_in, parse
from otolith.twin.rates import ordered_equations
from otolith_drivers.units import to_base

SEARCHED, REFINEMENTS = 33, 4  # values of a parameter at which a figure is compared with what is required, and rounds
MIN_STEP = 1e-6  # of the size of a parameter: of its central difference. docs/reference/thresholds-simulation.md


@dataclass(frozen=True, slots=True)
class ReferenceValues:
    """What the value of a parameter is compared with, in its unit, at the present temperature."""

    healthy: float | None = None  # None if it is not known
    limits: tuple[float, ...] = ()  # Beyond which action is required


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """Known and estimated values of the parameters of a twin, each in its unit."""

    values: Mapping[str, float]  # Of all parameters
    free: tuple[str, ...]  # The estimated ones
    covariance: Array  # (free, free)
    references: Mapping[str, ReferenceValues]  # Of the estimated ones


@dataclass(frozen=True, slots=True)
class FigureValue:
    """One figure, in its unit; no value if ``reason`` says why there is none."""

    figure: Figure
    parameters: tuple[str, ...]  # The estimated ones that it depends on
    value: float | None = None
    sd: float | None = None
    healthy: float | None = None  # With the healthy values of the parameters
    at_limit: float | None = None  # With the parameter ``limited`` at its limit, which is the worst of those
    limited: str = ""
    limit: float | None = None  # In the unit of that parameter
    is_mean: bool = False  # Whether it is a mean over the window
    reason: str = ""
    kept: Mapping[str, tuple[float | None, float | None]] = field(default_factory=dict)
    """The values of each parameter, in its unit, between which the required value is kept, others as they are; None
    where no bound of the twin is beyond. Empty if nothing is required, or it is not kept now."""


def figures_of(twin: Definition, estimates: Estimates, window: Window, predicted: Array | None) -> list[FigureValue]:
    """Return the figures of performance of a twin in a window; ``predicted`` (records, outputs) are its outputs."""
    return [_figure(twin, figure, estimates, window, predicted) for figure in twin.performance]


@lru_cache(maxsize=64)
def _needed(twin: Definition, figure: Figure) -> tuple[ast.expr, tuple[tuple[str, ast.expr], ...], frozenset[str]]:
    """Return the tree of a figure, the definitions that it needs in their order, and the names that these use."""
    tree = parse(figure.expression)
    names, own = names_in(tree), {name for name, _, _ in twin.definitions}
    needed = []
    for name, inner in reversed([row for row in ordered_equations(twin)[0] if row[0] in own]):
        if name in names:
            needed.append((name, inner))
            names |= names_in(inner)
    return tree, tuple(reversed(needed)), frozenset(names - own)


def _figure(
    twin: Definition, figure: Figure, estimates: Estimates, window: Window, predicted: Array | None
) -> FigureValue:
    names, at = _needed(twin, figure)[2], dict(figure.at)
    free = [index for index, name in enumerate(estimates.free) if name in names]
    own = tuple(estimates.free[index] for index in free)
    signals_of_twin = [*(row.name for row in twin.states), *(row.name for row in twin.inputs)]
    driving = [name for name in signals_of_twin if name in names and name not in at]
    signals = _signals(twin, driving, window, predicted)
    if isinstance(signals, str):
        return FigureValue(figure, own, is_mean=True, reason=signals)
    rows, cases = _rows(estimates, own, np.sqrt(np.diagonal(estimates.covariance))[free])
    columns = {name: np.array([[value]]) for name, value in at.items() if name in names}
    columns |= {name: column[None, :] for name, column in signals.items()}
    for parameter in twin.parameters:
        if parameter.name in names:
            values = [row.get(parameter.name, estimates.values[parameter.name]) for row in rows]
            columns[parameter.name] = np.array(values)[:, None]
    means = _evaluated(twin, figure, columns, len(rows))
    if not np.isfinite(means[: 1 + 2 * len(own)]).all():
        return FigureValue(figure, own, is_mean=bool(driving), reason="it has no finite value here")
    steps = np.array([rows[1 + 2 * k][name] - rows[2 + 2 * k][name] for k, name in enumerate(own)])
    slopes = (means[1 : 1 + 2 * len(own) : 2] - means[2 : 2 + 2 * len(own) : 2]) / steps
    with np.errstate(over="ignore", invalid="ignore"):
        variance = float(slopes @ estimates.covariance[np.ix_(free, free)] @ slopes)
    if not np.isfinite(variance):
        return FigureValue(figure, own, is_mean=bool(driving), reason="it has no finite interval here")
    compared = [(float(value), *case) for value, case in zip(means[1 + 2 * len(own) :], cases, strict=True)]
    healthy = next((value for value, name, _ in compared if not name and np.isfinite(value)), None)
    sign = 1.0 if figure.better == "lower" else -1.0
    worst = max(
        (row for row in compared if row[1] and np.isfinite(row[0])), key=lambda row: sign * row[0], default=None
    )
    at_limit, limited, limit = worst or (None, "", None)
    numbers = float(means[0]), max(variance, 0.0) ** 0.5, healthy, at_limit, limited, limit
    kept = {} if figure.required is None or not figure.meets(float(means[0])) else _kept(twin, figure, own, columns)
    return FigureValue(figure, own, *numbers, is_mean=bool(driving), kept=kept)


def _kept(
    twin: Definition, figure: Figure, own: Sequence[str], columns: Mapping[str, Array]
) -> dict[str, tuple[float | None, float | None]]:
    """Return between which values of each parameter a figure keeps its required value, which it does now.

    ``columns`` begin with the present values. From there on to both bounds of the twin, the interval between two of
    :data:`SEARCHED` values in which it is first not kept is divided again and again.
    """
    present = {name: column[:1] for name, column in columns.items()}
    ranges = {}
    for name in own:
        parameter, value = twin.parameter(name), float(present[name][0, 0])
        ends = [_end(twin, figure, name, (value, bound), present) for bound in (parameter.low, parameter.high)]
        if any(end is not None for end in ends):
            ranges[name] = (ends[0], ends[1])
    return ranges


def _end(
    twin: Definition, figure: Figure, name: str, ends: tuple[float, float], present: Mapping[str, Array]
) -> float | None:
    """Return the first value of a parameter on the way between two at which a figure lacks its required value."""
    begin, end = ends
    if not np.isfinite(end):
        return None
    for _ in range(REFINEMENTS):
        values = np.linspace(begin, end, SEARCHED)
        means = _evaluated(twin, figure, {**present, name: values[:, None]}, SEARCHED)
        lacks = np.flatnonzero([np.isfinite(mean) and not figure.meets(float(mean)) for mean in means])
        if not len(lacks):
            return None
        begin, end = float(values[max(lacks[0] - 1, 0)]), float(values[lacks[0]])
    return end


def _signals(twin: Definition, names: Sequence[str], window: Window, predicted: Array | None) -> dict[str, Array] | str:
    """Return the columns of signals in the records in which all of them are known; or why there are none.

    Where the twin predicts an output, its prediction counts, which has less noise than the sensor.
    """
    outputs, columns = [output.name for output in twin.outputs], []
    for name in names:
        if name not in window.signals:
            return f"{name} is not measured: write its value into at = {{ {name} = ... }}"
        column = window.measured((name,))[:, 0]
        if name in outputs and predicted is not None and len(predicted) == len(column):
            column = np.where(np.isfinite(own := predicted[:, outputs.index(name)]), own, column)
        columns.append(column)
    if not columns:
        return {}
    table = np.array(columns)
    table = table[:, np.isfinite(table).all(axis=0)]
    if not table.shape[1]:
        return "the window has no record with all signals that it needs"
    return dict(zip(names, table, strict=True))


def _rows(
    estimates: Estimates, own: Sequence[str], deviations: Array
) -> tuple[list[dict[str, float]], list[tuple[str, float | None]]]:
    """Return the sets of parameters: the present one, two for each slope, and those of comparisons.

    Each comparison is named by the parameter that is at a limit, with the limit; by no name where all are healthy.
    """
    rows: list[dict[str, float]] = [{}]
    for name, sd in zip(own, deviations, strict=True):
        step = max(float(sd), MIN_STEP * max(abs(estimates.values[name]), MIN_STEP))
        rows += [{name: estimates.values[name] + step}, {name: estimates.values[name] - step}]
    cases: list[tuple[str, float | None]] = []
    known = {name: estimates.references.get(name, ReferenceValues()) for name in own}
    healthy = {name: item.healthy for name, item in known.items() if item.healthy is not None}
    if own and len(healthy) == len(own):
        rows.append(healthy)
        cases.append(("", None))
    for name, item in known.items():
        for limit in item.limits:
            rows.append({name: limit})
            cases.append((name, limit))
    return rows, cases


def _evaluated(twin: Definition, figure: Figure, columns: Mapping[str, Array], rows: int) -> Array:
    """Return the mean of a figure over the records for each row (rows,), in its unit; not finite where it has none."""
    tree, definitions, _ = _needed(twin, figure)
    scales = ordered_equations(twin)[1]
    values = {name: [column * scales[name]] for name, column in columns.items()}
    values |= {fixed.name: [np.array([[fixed.value * scales[fixed.name]]])] for fixed in twin.constants}
    with np.errstate(all="ignore"):
        for name, inner in definitions:
            values[name] = [evaluate(inner, values)]
        result = evaluate(tree, values) / to_base(figure.unit)[0]
    table = np.broadcast_to(np.atleast_2d(result), (rows, np.shape(result)[-1]))
    return np.asarray(table.mean(axis=1))
