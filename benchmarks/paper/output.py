"""What the studies found, as people read it.

How tables and their figures are set.

What became of unknown components, as people read it.

What the studies found, as one JSON document. Errors are shares, not per cent; what is unknown is absent.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from benchmarks.paper.discovery import Course, Discovery
from benchmarks.paper.scenarios import NOISE, PEAK, SENSORS, Sensor
from benchmarks.paper.study import BLUNT, LENGTH, Edge, Kind, Limit, Score, Spread, Study, verdict
from otolith.health.schema import Status


def table(title: str, *columns: str) -> Table:
    """An empty one; all columns but the first two are figures."""
    made = Table(title=title, title_justify="left", caption_justify="left")
    for number, column in enumerate(columns):
        made.add_column(column, justify="right" if number > 1 else "left", no_wrap=True)
    return made


def percent(share: float | None) -> str:
    """Three digits."""
    return "" if share is None else f"{100.0 * share:.3g}"


def verdict_text(*, met: bool) -> Text:
    """Whether a target is met."""
    return Text("met", style="green") if met else Text("not met", style="red")


def discovery_pages(found: Sequence[Discovery]) -> Iterator[RenderableType]:
    """All tables, first those with ideal sensors."""
    for kind in (Kind.IDEAL, Kind.NOISY):
        entries = [entry for entry in found if entry.job.kind is kind]
        if entries:
            if kind is Kind.NOISY:
                yield from (
                    Text(f"noisy sensors in {entry.job.row.name}: {_discovery_sensors(entry)}") for entry in entries
                )
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


def _discovery_sensors(entry: Discovery) -> str:
    return ", ".join(map(_sensor, entry.job.row.sensors)) or f"{NOISE:.1%} of each output's standard deviation"


def _sensor(entry: Sensor) -> str:
    return f"{entry.signal} {entry.noise:g} {entry.unit} and 12 bit over {entry.low:g} to {entry.high:g} {entry.unit}"


SCHEMA = "otolith.paper/1"


def document(found: Sequence[Study | Limit | Discovery], plots: Sequence[Path]) -> str:
    """One line."""
    studies = [entry for entry in found if isinstance(entry, Study)]
    ideal = [entry for entry in studies if entry.job.kind is Kind.IDEAL]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    whole = {
        "schema": SCHEMA,
        "met": all(verdict(entry.job.row, entry.score) for entry in ideal) and all(entry.met for entry in discoveries),
        "scenarios": [_scenario(entry) | _targets(entry) for entry in ideal],
        "noisy": [_scenario(entry) | _sensor_fields(entry) for entry in studies if entry.job.kind is Kind.NOISY],
        "unknown": [_discovery(entry) for entry in discoveries if entry.job.kind is Kind.IDEAL],
        "unknown_noisy": [_discovery(entry) for entry in discoveries if entry.job.kind is Kind.NOISY],
        "lost_in_noise": [_limit(entry) for entry in found if isinstance(entry, Limit)],
        "plots": [str(path) for path in plots],
    }
    return json.dumps(_content(whole), allow_nan=False)


def _content(value: Any) -> Any:
    """Without what is None."""
    if isinstance(value, dict):
        return {key: _content(entry) for key, entry in value.items() if entry is not None}
    return [_content(entry) for entry in value] if isinstance(value, list) else value


def _scenario(entry: Study) -> dict[str, Any]:
    row = entry.job.row
    return {
        "name": row.name,
        "parameter": row.parameter,
        "seconds": entry.job.seconds,
        **_score(entry.score),
        "window_study": [_score(found) for found in entry.scores],
    }


def _targets(entry: Study) -> dict[str, Any]:
    row = entry.job.row
    target = {"p99": row.target, "maximum": PEAK * row.target}
    return {"target": target, "met": verdict(row, entry.score), "paper": row.paper}


def _sensor_fields(entry: Study) -> dict[str, Any]:
    return {
        "sensors": {
            sensor.signal: {"unit": sensor.unit, "noise": sensor.noise, "range": [sensor.low, sensor.high], "bits": 12}
            for sensor in SENSORS[entry.job.row.machine]
        }
    }


def _score(found: Score) -> dict[str, Any]:
    return {
        "window_s": found.length,
        "windows": found.windows,
        "first_excited": found.begun if found.begun < found.windows else None,
        "first_estimated": found.first,
        "worst": found.worst,
        "published": _spread(found.published),
        "raw": _spread(found.raw),
        "coverage": found.coverage,
        "statuses": found.statuses,
        "determined_alone": found.alone,
        "rmse": found.rmse,
    }


def _spread(error: Spread) -> dict[str, Any]:
    return {"median": error.median, "p99": error.p99, "maximum": error.maximum, "missing": error.missing}


def _limit(found: Limit) -> dict[str, Any]:
    return {
        "machine": found.job.row.machine,
        "parameter": found.job.row.parameter,
        "sensor": found.sensor.signal,
        "unit": found.sensor.unit,
        "alone": {"kept": found.alone.kept, "lost": found.alone.lost},
        "together": {"kept": found.together.kept, "lost": found.together.lost},
        "unaided": {"kept": found.unaided.kept, "lost": found.unaided.lost},
    }


def _discovery(entry: Discovery) -> dict[str, Any]:
    row, noisy = entry.job.row, entry.job.kind is Kind.NOISY
    before, after = row.paper or (None, None)
    return {
        "name": row.name,
        "component": row.component,
        "seconds": entry.job.seconds,
        "noise_share": NOISE if noisy and not row.sensors else None,
        "begun_s": entry.begun,
        "suspected_s": entry.suspected,
        "adopted_s": entry.adopted,
        "onset_s": entry.onset,
        "kept": entry.kept,
        "others": list(entry.others),
        "equation": entry.equation,
        "numbers": {course.number.name: _course(course, noisy=noisy) for course in entry.courses},
        "largest_error": {"before": entry.before, "after": entry.after},
        "target": None if noisy else {row.output: row.within},
        "paper": {"before": before, "after": after},
        "met": entry.met,
    }


def _course(found: Course, *, noisy: bool) -> dict[str, Any]:
    """The numbers of the last window, and the largest error since the discovery."""
    known = np.isfinite(found.value)
    if not known.any():
        return {"truth": float(found.truth[-1])}
    last = int(np.flatnonzero(known)[-1])
    return {
        "value": float(found.value[last]),
        "low": float(found.low[last]),
        "high": float(found.high[last]),
        "unit": found.unit,
        "truth": float(found.truth[last]),
        "error": float(found.errors[last]),
        "largest_error": float(np.nanmax(found.errors)),
        "target": found.number.noisy if noisy else found.number.target,
        "paper": found.number.paper,
        "coverage": found.coverage,
    }


def pages(found: Sequence[Study | Limit | Discovery]) -> Iterator[RenderableType]:
    """All tables, in the order in which they are read."""
    studies = [entry for entry in found if isinstance(entry, Study)]
    ideal = [entry for entry in studies if entry.job.kind is Kind.IDEAL]
    noisy = [entry for entry in studies if entry.job.kind is Kind.NOISY]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    if ideal:
        yield _against_the_paper(ideal)
        yield _circumstances(ideal, "ideal sensors")
        yield _windows(ideal, "ideal sensors")
    if noisy:
        for machine in dict.fromkeys(entry.job.row.machine for entry in noisy):
            yield Text(f"noisy sensors of {machine}: {_machine_sensors(machine)}")
        yield _circumstances(noisy, "noisy sensors")
        yield _windows(noisy, "noisy sensors")
    for entry in found:
        if isinstance(entry, Limit):
            yield Text(limit_in_words(entry))
    yield from discovery_pages(discoveries)
    yield _judgement(ideal, discoveries)


def _against_the_paper(studies: Sequence[Study]) -> Table:
    title = f"relative error of the published value, windows of {LENGTH:g} s, ideal sensors, % (target)"
    made = table(title, "scenario", "parameter", "median", "99 % below", "largest", "", "paper")
    for entry in studies:
        row, error = entry.job.row, entry.score.published
        met = verdict(row, entry.score)
        made.add_row(
            row.name,
            row.parameter,
            percent(error.median),
            f"{percent(error.p99)} ({percent(row.target)})",
            f"{percent(error.maximum)} ({percent(PEAK * row.target)})",
            verdict_text(met=met),
            percent(row.paper),
        )
    made.caption = "paper: what it says that its error stays below, but for peaks"
    return made


def _circumstances(studies: Sequence[Study], sensors: str) -> Table:
    title = f"how it came about, windows of {LENGTH:g} s, {sensors}"
    made = table(
        title,
        "scenario",
        "first\nexcited",
        "first\nestimated",
        "worst",
        "missing",
        Status.HELD,
        Status.INVALID,
        "in 95 %",
        "RMSE",
    )
    for entry in studies:
        found = entry.score
        units = dict(zip(entry.curves.outputs, entry.curves.units, strict=True))
        made.add_row(
            entry.job.row.name,
            str(found.begun) if found.begun < found.windows else "never",
            "never" if found.first is None else str(found.first),
            "" if found.worst is None else str(found.worst),
            str(found.published.missing),
            str(found.statuses[Status.HELD]),
            str(found.statuses[Status.INVALID]),
            "" if found.coverage is None else f"{found.coverage:.1%}",
            "\n".join(f"{name} {value:.2g} {units[name]}" for name, value in found.rmse.items()),
        )
    made.caption = "first and worst are numbers of windows, all others counts from the first excited one on"
    return made


def _windows(studies: Sequence[Study], sensors: str) -> Table:
    title = f"error by length of the window, {sensors}, %"
    made = table(title, "scenario", "window", "", "median", "99 % below", "largest", "without")
    for entry in studies:
        for found in entry.scores:
            for number, (name, error) in enumerate((("alone", found.raw), ("published", found.published))):
                made.add_row(
                    entry.job.row.name if found is entry.scores[0] and not number else "",
                    "" if number else f"{found.length:g} s",
                    name,
                    percent(error.median),
                    percent(error.p99),
                    percent(error.maximum),
                    str(error.missing or ""),
                    end_section=found is entry.scores[-1] and number == 1,
                )
    made.caption = "alone: what each window says by itself, as the paper reports it; published: with those before it"
    return made


def limit_in_words(found: Limit) -> str:
    """At which noise the parameter is lost."""
    sensor, machine = found.sensor, found.job.row.machine
    others = ", ".join(f"{entry.signal} {entry.noise:g} {entry.unit}" for entry in SENSORS[machine] if entry != sensor)
    said = (
        f"every window alone {_edge(found.alone, sensor.unit)}",
        f"all together {_edge(found.together, sensor.unit)}",
        f"all together with {BLUNT:g} times that on the others {_edge(found.unaided, sensor.unit)}",
    )
    lost = f"{found.job.row.parameter} is lost (95 % interval beyond 10 %) in noise of {sensor.signal}"
    return f"{machine}: {lost}, beside noise of {others}, to {'; to '.join(said)}"


def _edge(edge: Edge, unit: str) -> str:
    if edge.lost is None:
        return f"not even at {edge.kept:.3g} {unit}"
    return f"{'at' if edge.kept is not None else 'below'} {edge.lost:.3g} {unit}"


def _judgement(studies: Sequence[Study], discoveries: Sequence[Discovery]) -> Text:
    missed = [entry.job.row.name for entry in studies if not verdict(entry.job.row, entry.score)]
    missed += [f"{entry.job.row.name} ({entry.job.kind})" for entry in discoveries if not entry.met]
    if missed:
        return Text(f"targets not met: {', '.join(missed)}", style="red")
    return Text("every target is met", style="green")


def _machine_sensors(machine: str) -> str:
    return ", ".join(
        f"{entry.signal} {entry.noise:g} {entry.unit} and 12 bit over {entry.low:g} to {entry.high:g} {entry.unit}"
        for entry in SENSORS[machine]
    )
