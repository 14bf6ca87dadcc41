"""What became of unknown components, as people read it."""

from collections.abc import Iterator, Sequence

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from otolith.paper.discovering import Course, Discovery
from otolith.paper.rows import Sensor
from otolith.paper.setting import percent, table, verdict_text
from otolith.paper.studies import LENGTH, Kind
from otolith.paper.unknowns import NOISE


def discovery_pages(found: Sequence[Discovery]) -> Iterator[RenderableType]:
    """All tables, first those with ideal sensors."""
    for kind in (Kind.IDEAL, Kind.NOISY):
        entries = [entry for entry in found if entry.job.kind is kind]
        if entries:
            if kind is Kind.NOISY:
                yield from (Text(f"noisy sensors in {entry.job.row.name}: {_sensors(entry)}") for entry in entries)
            yield _course_of_events(entries, kind)
            yield from map(_numbers, entries)
            yield _predictions(entries, kind)


def _course_of_events(found: Sequence[Discovery], kind: Kind) -> Table:
    title = f"unknown components, windows of {LENGTH:g} s, {kind}"
    made = table(title, "scenario", "equation in the end", "begun", "suspected", "adopted", "onset told", "besides", "")
    for entry in found:
        made.add_row(
            entry.job.row.name,
            _component(entry),
            *map(_moment, (entry.begun, entry.suspected, entry.adopted, entry.onset)),
            ", ".join(entry.others),
            verdict_text(met=entry.met),
        )
    made.caption = "s; suspected and adopted at the end of a window; besides: other components that were in the twin"
    return made


def _numbers(entry: Discovery) -> Table:
    kind = entry.job.kind
    title = f"numbers of {entry.job.row.name}, {kind}"
    made = table(
        title, "number", "", "found, 95 % interval", "truth", "error, %", "largest (target)", "in 95 %", "paper"
    )
    for course in entry.courses:
        for row in _rows(course, kind):
            made.add_row(*row)
    made.caption = "found in the last window; largest error since the discovery; errors of a phase are % of 1 rad"
    return made


def _rows(course: Course, kind: Kind) -> Iterator[tuple[str, ...]]:
    """One line, and another in the paper's unit if it has one of its own."""
    number = course.number
    target = number.noisy if kind is Kind.NOISY else number.target
    known = np.flatnonzero(np.isfinite(course.value))
    if not known.size:
        yield (number.name, course.unit, "none", f"{course.truth[-1]:.4g}", "", "", "", percent(number.paper))
        return
    last = int(known[-1])
    largest = percent(float(np.nanmax(course.errors)))
    yield (
        number.name,
        course.unit,
        *_figures(course, last, 1.0),
        percent(float(course.errors[last])),
        largest if target is None else f"{largest} ({percent(target)})",
        "" if course.coverage is None else f"{course.coverage:.0%}",
        percent(number.paper),
    )
    if number.over:
        yield ("", number.unit, *_figures(course, last, course.scale), "", "", "", "")


def _figures(course: Course, at: int, scale: float) -> tuple[str, str]:
    """Value and interval to two digits of the interval, and the truth to as many decimals."""
    value, high, truth = (scale * float(column[at]) for column in (course.value, course.high, course.truth))
    half = high - value
    decimals = max(0, 1 - int(np.floor(np.log10(half)))) if half > 0.0 else 6
    return f"{value:.{decimals}f} ± {half:.{decimals}f}", f"{truth:.{decimals}f}"


def _predictions(found: Sequence[Discovery], kind: Kind) -> Table:
    title = f"largest absolute error of the prediction, {kind}"
    made = table(title, "scenario", "output", "before (DT')", "after (DT'')", "target", "paper before", "paper after")
    for entry in found:
        row, curves = entry.job.row, entry.curves
        for name, unit in zip(curves.outputs, curves.units, strict=True):
            ours = name == row.output
            before, after = row.paper or (None, None)
            made.add_row(
                row.name if name == curves.outputs[0] else "",
                f"{name}, {unit}",
                _error(entry.before.get(name)),
                _error(entry.after.get(name)),
                _error(row.within) if ours and kind is Kind.IDEAL else "",
                _error(before) if ours else "",
                _error(after) if ours else "",
            )
    made.caption = "before: from the beginning of the component to its discovery; after: from there on"
    return made


def _component(entry: Discovery) -> str:
    return f"{entry.job.row.component.split('/')[0]}: {entry.equation}" if entry.equation else "not discovered"


def _moment(seconds: float | None) -> str:
    return "never" if seconds is None else f"{seconds:g}"


def _error(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _sensors(entry: Discovery) -> str:
    return ", ".join(map(_sensor, entry.job.row.sensors)) or f"{NOISE:.1%} of each output's standard deviation"


def _sensor(entry: Sensor) -> str:
    return f"{entry.signal} {entry.noise:g} {entry.unit} and 12 bit over {entry.low:g} to {entry.high:g} {entry.unit}"
