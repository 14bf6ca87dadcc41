"""Plots: one for each figure of the paper, and the errors by window length."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.discovery import Discovery
from benchmarks.paper.scenarios import PEAK
from benchmarks.paper.study import LENGTH, Curves, Kind, Study, errors
from otolith.acquisition.window import Array
from otolith_drivers.errors import ServiceError
from otolith_drivers.user_dirs import writable

DOTS_PER_INCH = 150
LEAD = 5  # windows shown before the onset of a component
SMALLEST = 1e-8  # share: the least error that a logarithmic axis shows
ESTIMATED, ACTUAL, PAPER, TARGET = "tab:blue", "black", "tab:red", "tab:green"


Picture = tuple[str, str, Figure]
"""Kind, the number of the paper's figure or an empty text, and the plot."""


def draw(studies: Sequence[Study], discoveries: Sequence[Discovery], folder: Path) -> list[Path]:
    """Write the plots into ``folder``; returns their paths.

    Raises:
        ServiceError: a plot cannot be written.
    """
    writable(folder)
    written = []
    figures: list[tuple[Study | Discovery, Picture]] = [(made, one) for made in studies for one in _figures(made)]
    figures += [(made, one) for made in discoveries for one in _of_discovery(made)]
    for result, (kind, number, figure) in figures:
        noisy = "noisy-" if result.job.kind is Kind.NOISY else ""
        path = folder / f"{noisy}{result.job.row.name}-{kind}{f'-fig-{number}' if number else ''}.png"
        try:
            figure.savefig(path, dpi=DOTS_PER_INCH)
        except OSError as error:
            raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
        written.append(path)
    return written


def _figures(study: Study) -> list[Picture]:
    value, error, outputs = study.job.row.figures
    return [
        ("value", value, _figure(study, value, _draw_value)),
        ("error", error, _figure(study, error, _draw_error)),
        ("outputs", outputs, _plot_outputs(study.curves, _title(study, outputs))),
        ("windows", "", _figure(study, "", _draw_windows)),
    ]


def _figure(study: Study, number: str, draw_into: Callable[[Study, Axes], None]) -> Figure:
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.subplots()
    draw_into(study, axes)
    axes.set_title(_title(study, number))
    axes.grid(visible=True, alpha=0.3)
    figure.legend(loc="outside lower center", ncols=5)
    return figure


def _of_discovery(discovery: Discovery) -> list[Picture]:
    """The outputs before and after the discovery, and the component's numbers over time."""
    before, after = discovery.job.row.figures
    curves, end = discovery.curves, discovery.curves.times[-1]
    adopted = end if discovery.adopted is None else discovery.adopted - LENGTH
    lead = max(discovery.begun - LEAD * LENGTH, 0.0)
    pictures = [("before", before, _plot_outputs(_between(curves, lead, adopted), _title(discovery, before)))]
    if discovery.adopted is not None:
        pictures.append(("after", after, _plot_outputs(_between(curves, adopted, end), _title(discovery, after))))
        pictures.append(("numbers", "", _numbers(discovery)))
    return pictures


def _between(curves: Curves, first: float, last: float) -> Curves:
    inside = (curves.times >= first - 1e-9) & (curves.times < last - 1e-9)
    return replace(
        curves, times=curves.times[inside], measured=curves.measured[inside], predicted=curves.predicted[inside]
    )


def _numbers(discovery: Discovery) -> Figure:
    figure = Figure(figsize=(9.0, 2.5 * len(discovery.courses)), layout="constrained")
    grid = figure.subplots(len(discovery.courses), 1, squeeze=False, sharex=True)
    ends = LENGTH * np.arange(1, len(discovery.courses[0].value) + 1)
    for axes, course in zip(grid[:, 0], discovery.courses, strict=True):
        known = np.isfinite(course.value)
        columns = (course.low, course.high, course.value, course.truth)
        low, high, value, truth = (column[known] - course.truth[known] for column in columns)
        axes.fill_between(ends[known], low, high, color=ESTIMATED, alpha=0.25, label="95 % interval")
        axes.plot(ends[known], value, color=ESTIMATED, label="found")
        axes.plot(ends[known], truth, color=ACTUAL, linestyle="--", linewidth=1.0, label="actual")
        axes.set_ylabel(f"{course.number.name} - actual, {course.unit}")
        axes.grid(visible=True, alpha=0.3)
        axes.legend(loc="upper right")
    grid[-1, 0].set_xlabel("time, s")
    figure.suptitle(_title(discovery, ""))
    return figure


def _title(result: Study | Discovery, number: str) -> str:
    compare = f" (figure{'s' if '-' in number else ''} {number} of the paper)" if number else ""
    return f"{result.job.row.title}, {result.job.kind}{compare}"


def _draw_value(study: Study, axes: Axes) -> None:
    track, name = study.track, study.job.row.parameter
    axes.fill_between(track.ends, track.low, track.high, color=ESTIMATED, alpha=0.25, label="95 % interval")
    axes.plot(track.ends, track.value, color=ESTIMATED, label=f"{name} estimated")
    axes.plot(track.ends, track.truth, color=ACTUAL, linestyle="--", linewidth=1.0, label=f"{name} actual")
    axes.set_xlabel("time, s")
    axes.set_ylabel(f"{name}, {study.unit}")


def _draw_error(study: Study, axes: Axes) -> None:
    track, row = study.track, study.job.row
    axes.plot(track.ends, _per_cent(track.raw, track.truth), color="tab:gray", linewidth=0.8, label="window alone")
    axes.plot(track.ends, _per_cent(track.value, track.truth), color=ESTIMATED, label="published")
    for share, colour, meaning in (
        (row.paper, PAPER, "paper: below, but for peaks"),
        (row.target, TARGET, "target for 99 %"),
        (PEAK * row.target, TARGET, "target for all"),
    ):
        line = ":" if meaning.endswith("all") else "--"
        axes.axhline(100.0 * share, color=colour, linestyle=line, linewidth=1.0, label=meaning)
    axes.set_yscale("log")
    axes.set_xlabel("time, s")
    axes.set_ylabel(f"relative error of {row.parameter}, %")


def _per_cent(values: Array, truth: Array) -> Array:
    return np.asarray(100.0 * np.maximum(errors(values, truth), SMALLEST))


def _draw_windows(study: Study, axes: Axes) -> None:
    lengths = [score.length for score in study.scores]
    for name, colour in (("raw", "tab:gray"), ("published", ESTIMATED)):
        spreads = [getattr(score, name) for score in study.scores]
        for share, line, meaning in (("median", "--", "median"), ("p99", "-", "99 % below")):
            values = [getattr(spread, share) for spread in spreads]
            known = [np.nan if value is None else 100.0 * max(value, SMALLEST) for value in values]
            label = f"{'window alone' if name == 'raw' else name}, {meaning}"
            axes.plot(lengths, known, color=colour, linestyle=line, marker="o", label=label)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xticks(lengths, [f"{length:g}" for length in lengths])
    axes.minorticks_off()
    axes.set_xlabel("length of the window, s")
    axes.set_ylabel(f"relative error of {study.job.row.parameter}, %")


def _plot_outputs(curves: Curves, title: str) -> Figure:
    """Each output measured and predicted, and the residual beside it."""
    figure = Figure(figsize=(12.0, 3.0 * len(curves.outputs)), layout="constrained")
    grid = figure.subplots(len(curves.outputs), 2, squeeze=False, sharex=True)
    for index, (name, unit) in enumerate(zip(curves.outputs, curves.units, strict=True)):
        both, left = grid[index]
        both.plot(curves.times, curves.measured[:, index], color=ACTUAL, label="measured")
        both.plot(curves.times, curves.predicted[:, index], color=ESTIMATED, linestyle="--", label="predicted")
        both.set_ylabel(f"{name}, {unit}")
        both.legend(loc="upper right")
        left.plot(curves.times, (curves.predicted - curves.measured)[:, index], color=ESTIMATED, linewidth=0.5)
        left.set_ylabel(f"{name} predicted - measured, {unit}")
        for axes in (both, left):
            axes.grid(visible=True, alpha=0.3)
    for axes in grid[-1]:
        axes.set_xlabel("time, s")
    figure.suptitle(title)
    return figure
