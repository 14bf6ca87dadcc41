"""A picture for each figure of the paper, and one for the study of windows."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from otolith.acquisition.window import Array
from otolith.errors import ServiceError
from otolith.paper.rows import PEAK
from otolith.paper.score import errors
from otolith.paper.studies import Kind, Study
from otolith.paths import writable

DOTS_PER_INCH = 150
SMALLEST = 1e-8  # share: what a logarithmic axis shows of an error of nothing
ESTIMATED, ACTUAL, PAPER, TARGET = "tab:blue", "black", "tab:red", "tab:green"


def draw(studies: Sequence[Study], folder: Path) -> list[Path]:
    """Write the pictures into ``folder``, and say what they are called.

    Raises:
        ServiceError: they cannot be written.
    """
    writable(folder)
    written = []
    for entry in studies:
        for kind, number, figure in _figures(entry):
            noisy = "noisy-" if entry.job.kind is Kind.NOISY else ""
            path = folder / f"{noisy}{entry.job.row.name}-{kind}{f'-fig-{number}' if number else ''}.png"
            try:
                figure.savefig(path, dpi=DOTS_PER_INCH)
            except OSError as error:
                raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
            written.append(path)
    return written


def _figures(entry: Study) -> list[tuple[str, str, Figure]]:
    value, error, outputs = entry.job.row.figures
    return [
        ("value", value, _figure(entry, value, _draw_value)),
        ("error", error, _figure(entry, error, _draw_error)),
        ("outputs", outputs, _outputs(entry, outputs)),
        ("windows", "", _figure(entry, "", _draw_windows)),
    ]


def _figure(entry: Study, number: str, draw_into: Callable[[Study, Axes], None]) -> Figure:
    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.subplots()
    draw_into(entry, axes)
    axes.set_title(_title(entry, number))
    axes.grid(visible=True, alpha=0.3)
    figure.legend(loc="outside lower center", ncols=5)
    return figure


def _title(entry: Study, number: str) -> str:
    compare = f" (figure{'s' if '-' in number else ''} {number} of the paper)" if number else ""
    return f"{entry.job.row.title}, {entry.job.kind}{compare}"


def _draw_value(entry: Study, axes: Axes) -> None:
    found, name = entry.track, entry.job.row.parameter
    axes.fill_between(found.ends, found.low, found.high, color=ESTIMATED, alpha=0.25, label="95 % interval")
    axes.plot(found.ends, found.value, color=ESTIMATED, label=f"{name} estimated")
    axes.plot(found.ends, found.truth, color=ACTUAL, linestyle="--", linewidth=1.0, label=f"{name} actual")
    axes.set_xlabel("time, s")
    axes.set_ylabel(f"{name}, {entry.unit}")


def _draw_error(entry: Study, axes: Axes) -> None:
    found, row = entry.track, entry.job.row
    axes.plot(found.ends, _per_cent(found.raw, found.truth), color="tab:gray", linewidth=0.8, label="window alone")
    axes.plot(found.ends, _per_cent(found.value, found.truth), color=ESTIMATED, label="published")
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


def _draw_windows(entry: Study, axes: Axes) -> None:
    lengths = [found.length for found in entry.scores]
    for name, colour in (("raw", "tab:gray"), ("published", ESTIMATED)):
        spreads = [getattr(found, name) for found in entry.scores]
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
    axes.set_ylabel(f"relative error of {entry.job.row.parameter}, %")


def _outputs(entry: Study, number: str) -> Figure:
    """Each output measured and predicted, and beside it what is left between them."""
    curves = entry.curves
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
    figure.suptitle(_title(entry, number))
    return figure
