"""Results of the studies as tables, and as one JSON document."""

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
from benchmarks.paper.study import LENGTH, OTHERS_NOISE_FACTOR, Kind, Limit, NoiseBracket, Score, Spread, Study, verdict
from otolith.health.schema import Status

SCHEMA = "otolith.paper/1"


def pages(results: Sequence[Study | Limit | Discovery]) -> Iterator[RenderableType]:
    """All tables in reading order."""
    ideal, noisy, discoveries, limits = _by_kind(results)
    if ideal:
        yield _against_the_paper(ideal)
        yield _circumstances(ideal, "ideal sensors")
        yield _windows(ideal, "ideal sensors")
    if noisy:
        for machine in dict.fromkeys(study.job.row.machine for study in noisy):
            yield Text(f"noisy sensors of {machine}: {_sensors(SENSORS[machine])}")
        yield _circumstances(noisy, "noisy sensors")
        yield _windows(noisy, "noisy sensors")
    yield from (Text(limit_in_words(limit)) for limit in limits)
    yield from _discovery_pages(discoveries)
    missed = _missed(ideal, discoveries)
    yield (
        Text(f"targets not met: {', '.join(missed)}", style="red")
        if missed
        else Text("every target is met", style="green")
    )


def _by_kind(
    results: Sequence[Study | Limit | Discovery],
) -> tuple[list[Study], list[Study], list[Discovery], list[Limit]]:
    """Studies with ideal sensors, studies with noisy ones, discoveries, limits."""
    studies = [result for result in results if isinstance(result, Study)]
    return (
        [study for study in studies if study.job.kind is Kind.IDEAL],
        [study for study in studies if study.job.kind is Kind.NOISY],
        [result for result in results if isinstance(result, Discovery)],
        [result for result in results if isinstance(result, Limit)],
    )


def _missed(studies: Sequence[Study], discoveries: Sequence[Discovery]) -> list[str]:
    """Scenarios that do not meet their target."""
    missed = [study.job.row.name for study in studies if not verdict(study.job.row, study.score)]
    return missed + [
        f"{discovery.job.row.name} ({discovery.job.kind})" for discovery in discoveries if not discovery.met
    ]


def _against_the_paper(studies: Sequence[Study]) -> Table:
    title = f"relative error of the published value, windows of {LENGTH:g} s, ideal sensors, % (target)"
    made = _table(title, "scenario", "parameter", "median", "99 % below", "largest", "", "paper")
    for study in studies:
        row, error = study.job.row, study.score.published
        met = verdict(row, study.score)
        made.add_row(
            row.name,
            row.parameter,
            _percent(error.median),
            f"{_percent(error.p99)} ({_percent(row.target)})",
            f"{_percent(error.maximum)} ({_percent(PEAK * row.target)})",
            _verdict_text(met=met),
            _percent(row.paper),
        )
    made.caption = "paper: bound of its error, without peaks"
    return made


def _circumstances(studies: Sequence[Study], sensors: str) -> Table:
    title = f"windows and intervals, windows of {LENGTH:g} s, {sensors}"
    made = _table(
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
    for study in studies:
        score = study.score
        units = dict(zip(study.curves.outputs, study.curves.units, strict=True))
        made.add_row(
            study.job.row.name,
            str(score.begun) if score.begun < score.windows else "never",
            "never" if score.first is None else str(score.first),
            "" if score.worst is None else str(score.worst),
            str(score.published.missing),
            str(score.statuses[Status.HELD]),
            str(score.statuses[Status.INVALID]),
            "" if score.coverage is None else f"{score.coverage:.1%}",
            "\n".join(f"{name} {value:.2g} {units[name]}" for name, value in score.rmse.items()),
        )
    made.caption = "first and worst are indices of windows; the others count from the first excited window on"
    return made


def _windows(studies: Sequence[Study], sensors: str) -> Table:
    title = f"error by length of the window, {sensors}, %"
    made = _table(title, "scenario", "window", "", "median", "99 % below", "largest", "without")
    for study in studies:
        for score in study.scores:
            for number, (name, error) in enumerate((("alone", score.raw), ("published", score.published))):
                made.add_row(
                    study.job.row.name if score is study.scores[0] and not number else "",
                    "" if number else f"{score.length:g} s",
                    name,
                    _percent(error.median),
                    _percent(error.p99),
                    _percent(error.maximum),
                    str(error.missing or ""),
                    end_section=score is study.scores[-1] and number == 1,
                )
    made.caption = "alone: from one window, as in the paper; published: with the windows before it"
    return made


def limit_in_words(limit: Limit) -> str:
    """The noise at which the parameter is lost."""
    sensor, machine = limit.sensor, limit.job.row.machine
    others = ", ".join(f"{other.signal} {other.noise:g} {other.unit}" for other in SENSORS[machine] if other != sensor)
    limits = (
        f"every window alone {_bracket(limit.alone, sensor.unit)}",
        f"all together {_bracket(limit.together, sensor.unit)}",
        f"all together with {OTHERS_NOISE_FACTOR:g} times that on the others {_bracket(limit.unaided, sensor.unit)}",
    )
    lost = f"{limit.job.row.parameter} is lost (95 % interval beyond 10 %) in noise of {sensor.signal}"
    return f"{machine}: {lost}, beside noise of {others}, to {'; to '.join(limits)}"


def _bracket(edge: NoiseBracket, unit: str) -> str:
    if edge.lost is None:
        return f"not even at {edge.kept:.3g} {unit}"
    return f"{'at' if edge.kept is not None else 'below'} {edge.lost:.3g} {unit}"


def _discovery_pages(discoveries: Sequence[Discovery]) -> Iterator[RenderableType]:
    """All tables of discoveries, those with ideal sensors first."""
    for kind in (Kind.IDEAL, Kind.NOISY):
        selected = [discovery for discovery in discoveries if discovery.job.kind is kind]
        if selected:
            if kind is Kind.NOISY:
                proportional = f"{NOISE:.1%} of each output's standard deviation"
                for row in (discovery.job.row for discovery in selected):
                    yield Text(f"noisy sensors in {row.name}: {_sensors(row.sensors) or proportional}")
            yield _course_of_events(selected, kind)
            yield from map(_numbers, selected)
            yield _predictions(selected, kind)


def _course_of_events(discoveries: Sequence[Discovery], kind: Kind) -> Table:
    title = f"unknown components, windows of {LENGTH:g} s, {kind}"
    made = _table(
        title, "scenario", "equation in the end", "onset", "suspected", "adopted", "published onset", "others", ""
    )
    for discovery in discoveries:
        made.add_row(
            discovery.job.row.name,
            _component(discovery),
            *map(_moment, (discovery.begun, discovery.suspected, discovery.adopted, discovery.onset)),
            ", ".join(discovery.others),
            _verdict_text(met=discovery.met),
        )
    made.caption = "s; suspected and adopted at the end of a window; others: other components that were adopted"
    return made


def _numbers(discovery: Discovery) -> Table:
    kind = discovery.job.kind
    title = f"numbers of {discovery.job.row.name}, {kind}"
    made = _table(
        title, "number", "", "estimate, 95 % interval", "truth", "error, %", "largest (target)", "in 95 %", "paper"
    )
    for course in discovery.courses:
        for row in _rows(course, kind):
            made.add_row(*row)
    made.caption = "estimate of the last window; largest error since the discovery; errors of a phase are % of 1 rad"
    return made


def _rows(course: Course, kind: Kind) -> Iterator[tuple[str, ...]]:
    """One row, and a second one if the paper uses another unit."""
    number = course.number
    target = number.noisy if kind is Kind.NOISY else number.target
    known = np.flatnonzero(np.isfinite(course.value))
    if not known.size:
        yield (number.name, course.unit, "none", f"{course.truth[-1]:.4g}", "", "", "", _percent(number.paper))
        return
    last = int(known[-1])
    largest = _percent(float(np.nanmax(course.errors)))
    yield (
        number.name,
        course.unit,
        *_figures(course, last, 1.0),
        _percent(float(course.errors[last])),
        largest if target is None else f"{largest} ({_percent(target)})",
        "" if course.coverage is None else f"{course.coverage:.0%}",
        _percent(number.paper),
    )
    if number.over:
        yield ("", number.unit, *_figures(course, last, course.scale), "", "", "", "")


def _figures(course: Course, at: int, scale: float) -> tuple[str, str]:
    """Value and interval to two digits of the interval, and the truth to as many decimals."""
    value, high, truth = (scale * float(column[at]) for column in (course.value, course.high, course.truth))
    half = high - value
    decimals = max(0, 1 - int(np.floor(np.log10(half)))) if half > 0.0 else 6
    return f"{value:.{decimals}f} ± {half:.{decimals}f}", f"{truth:.{decimals}f}"


def _predictions(discoveries: Sequence[Discovery], kind: Kind) -> Table:
    title = f"largest absolute error of the prediction, {kind}"
    made = _table(title, "scenario", "output", "before (DT')", "after (DT'')", "target", "paper before", "paper after")
    for discovery in discoveries:
        row, curves = discovery.job.row, discovery.curves
        for name, unit in zip(curves.outputs, curves.units, strict=True):
            ours = name == row.output
            before, after = row.paper or (None, None)
            made.add_row(
                row.name if name == curves.outputs[0] else "",
                f"{name}, {unit}",
                _error(discovery.before.get(name)),
                _error(discovery.after.get(name)),
                _error(row.within) if ours and kind is Kind.IDEAL else "",
                _error(before) if ours else "",
                _error(after) if ours else "",
            )
    made.caption = "before: from the onset to the discovery; after: from the discovery on"
    return made


def _component(discovery: Discovery) -> str:
    return (
        f"{discovery.job.row.component.split('/')[0]}: {discovery.equation}" if discovery.equation else "not discovered"
    )


def _moment(seconds: float | None) -> str:
    return "never" if seconds is None else f"{seconds:g}"


def _error(value: float | None) -> str:
    return "" if value is None else f"{value:.2g}"


def _sensors(sensors: Sequence[Sensor]) -> str:
    return ", ".join(
        f"{each.signal} {each.noise:g} {each.unit} and 12 bit over {each.low:g} to {each.high:g} {each.unit}"
        for each in sensors
    )


def _table(title: str, *columns: str) -> Table:
    """An empty table; all columns but the first two are right-aligned."""
    made = Table(title=title, title_justify="left", caption_justify="left")
    for number, column in enumerate(columns):
        made.add_column(column, justify="right" if number > 1 else "left", no_wrap=True)
    return made


def _percent(share: float | None) -> str:
    """A share in per cent with three digits."""
    return "" if share is None else f"{100.0 * share:.3g}"


def _verdict_text(*, met: bool) -> Text:
    """The word for a target that is met or not."""
    return Text("met", style="green") if met else Text("not met", style="red")


def document(results: Sequence[Study | Limit | Discovery], plots: Sequence[Path]) -> str:
    """All results as one line of JSON. Errors are shares, not per cent; a value that does not exist is absent."""
    ideal, noisy, discoveries, limits = _by_kind(results)
    by_sensors = {kind: [discovery for discovery in discoveries if discovery.job.kind is kind] for kind in Kind}
    whole = {
        "schema": SCHEMA,
        "met": not _missed(ideal, discoveries),
        "scenarios": [_scenario(study) | _targets(study) for study in ideal],
        "noisy": [_scenario(study) | _sensor_fields(study) for study in noisy],
        "unknown": [_discovery(discovery) for discovery in by_sensors[Kind.IDEAL]],
        "unknown_noisy": [_discovery(discovery) for discovery in by_sensors[Kind.NOISY]],
        "lost_in_noise": [_limit(limit) for limit in limits],
        "plots": [str(path) for path in plots],
    }
    return json.dumps(_content(whole), allow_nan=False)


def _content(value: Any) -> Any:
    """``value`` without keys that are None."""
    if isinstance(value, dict):
        return {key: _content(item) for key, item in value.items() if item is not None}
    return [_content(item) for item in value] if isinstance(value, list) else value


def _scenario(study: Study) -> dict[str, Any]:
    row = study.job.row
    return {
        "name": row.name,
        "parameter": row.parameter,
        "seconds": study.job.seconds,
        **_score(study.score),
        "window_study": [_score(score) for score in study.scores],
    }


def _targets(study: Study) -> dict[str, Any]:
    row = study.job.row
    target = {"p99": row.target, "maximum": PEAK * row.target}
    return {"target": target, "met": verdict(row, study.score), "paper": row.paper}


def _sensor_fields(study: Study) -> dict[str, Any]:
    return {
        "sensors": {
            sensor.signal: {"unit": sensor.unit, "noise": sensor.noise, "range": [sensor.low, sensor.high], "bits": 12}
            for sensor in SENSORS[study.job.row.machine]
        }
    }


def _score(score: Score) -> dict[str, Any]:
    return {
        "window_s": score.length,
        "windows": score.windows,
        "first_excited": score.begun if score.begun < score.windows else None,
        "first_estimated": score.first,
        "worst": score.worst,
        "published": _spread(score.published),
        "raw": _spread(score.raw),
        "coverage": score.coverage,
        "statuses": score.statuses,
        "determined_alone": score.alone,
        "rmse": score.rmse,
    }


def _spread(error: Spread) -> dict[str, Any]:
    return {"median": error.median, "p99": error.p99, "maximum": error.maximum, "missing": error.missing}


def _limit(limit: Limit) -> dict[str, Any]:
    return {
        "machine": limit.job.row.machine,
        "parameter": limit.job.row.parameter,
        "sensor": limit.sensor.signal,
        "unit": limit.sensor.unit,
        "alone": {"kept": limit.alone.kept, "lost": limit.alone.lost},
        "together": {"kept": limit.together.kept, "lost": limit.together.lost},
        "unaided": {"kept": limit.unaided.kept, "lost": limit.unaided.lost},
    }


def _discovery(discovery: Discovery) -> dict[str, Any]:
    row, noisy = discovery.job.row, discovery.job.kind is Kind.NOISY
    before, after = row.paper or (None, None)
    return {
        "name": row.name,
        "component": row.component,
        "seconds": discovery.job.seconds,
        "noise_share": NOISE if noisy and not row.sensors else None,
        "begun_s": discovery.begun,
        "suspected_s": discovery.suspected,
        "adopted_s": discovery.adopted,
        "onset_s": discovery.onset,
        "kept": discovery.kept,
        "others": list(discovery.others),
        "equation": discovery.equation,
        "numbers": {course.number.name: _course(course, noisy=noisy) for course in discovery.courses},
        "largest_error": {"before": discovery.before, "after": discovery.after},
        "target": None if noisy else {row.output: row.within},
        "paper": {"before": before, "after": after},
        "met": discovery.met,
    }


def _course(course: Course, *, noisy: bool) -> dict[str, Any]:
    """The numbers of the last window, and the largest error since the discovery."""
    known = np.isfinite(course.value)
    if not known.any():
        return {"truth": float(course.truth[-1])}
    last = int(np.flatnonzero(known)[-1])
    return {
        "value": float(course.value[last]),
        "low": float(course.low[last]),
        "high": float(course.high[last]),
        "unit": course.unit,
        "truth": float(course.truth[last]),
        "error": float(course.errors[last]),
        "largest_error": float(np.nanmax(course.errors)),
        "target": course.number.noisy if noisy else course.number.target,
        "paper": course.number.paper,
        "coverage": course.coverage,
    }
