"""The history of a machine as one HTML page that refers to no other file: state in words, curves, events, equations.

The page is ``report.html``, a template that has the texts and escapes what it inserts. This module computes what it
shows. Times are Unix seconds, or those of a log without a time of day. Positions are in percent of a plot, from its
left and from its top.
"""

import math
import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from itertools import pairwise
from typing import Any, Protocol

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from otolith import __version__
from otolith.acquisition.quality import is_of_calendar
from otolith.estimation.information import QUANTILE
from otolith.health import text
from otolith.health.conditions import ConditionPage, pages_of
from otolith.health.diagnosis import Rule
from otolith.health.limits import Level
from otolith.health.schema import (
    ComponentDocument,
    EventDocument,
    Language,
    ParameterDocument,
    PartDocument,
    ReportDocument,
    Status,
)
from otolith.health.text import Texts, texts_in
from otolith.health.times import clock_in, in_local_time
from otolith.machine import load_rules
from otolith.storage.history import DAY, HOUR, PERFORMANCE, RESOLUTIONS, HistorySample, PartState
from otolith_drivers.common.time_zones import comes_twice, local_moment
from otolith_drivers.outside_text import visible
from otolith_drivers.units import Scale, equation_text, formula_text, quantity_text, scale_of

# Engineering choices, see docs/reference/thresholds-runtime.md.
SILENT_WINDOWS = 3  # lengths of a window without a report until the state is NO DATA
MAX_POINTS = 300  # of a curve
MAX_ROWS = 40  # events or findings in a table
LATEST_REPORTS = 200  # that are searched for advice
GAP = 2.5  # median times between two values, from which a curve is interrupted
FORECAST_SHARE = 0.3  # of the time that is shown, by which forecasts extend it
NEAR_LIMITS = 3.0  # times the range of the values, or the distance to the nearest limit, within which limits are shown
MARGIN = 0.12  # of the range of values, above and below it
LABEL_HEIGHT = 10.0  # percent of a plot
MAX_TICKS = 5
STEPS = (1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 10_800, 21_600, 43_200, 86_400, 172_800, 345_600,
         604_800, 1_209_600, 2_592_000, 5_184_000, 10_368_000, 31_536_000, 63_072_000, 157_680_000)  # s  # fmt: skip
WHOLE = re.compile(  # a date; a number with its interval and a short unit
    r"(\d{4}-\d\d-\d\d(?: [\d:.]+)?"
    r"|\d[\d.,]*(?:e-?\d+)? ± \d[\d.,e-]*(?: [^\s\d.,;()±]{1,11})?"
    r"|\d[\d.]*(?:,\d+)?(?:e-?\d+)?(?: (?:%|°C|[pnµmkMG]?[ΩAVWN]\b|[nµm]?s\b))?)"
)
UNBROKEN = Markup('<span class="whole">{}</span>')
MAX_WHOLE = 26  # characters: a line of a phone in the type of a value; engineering choice
TRUSTED = frozenset({Status.ESTIMATED, "adopted"})  # the others are drawn pale

Span = tuple[float, float]  # Begin and end of a time


@dataclass(frozen=True, slots=True)
class Axis:
    """The time from left to right."""

    begin: float
    now: float  # End of what is known; forecasts are beyond it
    end: float
    zone: str | None = None  # That of the plant; None for that of this computer

    def x(self, seconds: float) -> float:
        """Return the position of a time."""
        return round(100.0 * (seconds - self.begin) / (self.end - self.begin), 2)

    def span(self, begin: float, end: float) -> Span:
        """Return position and length of what is on the axis of a time."""
        first, last = (self.x(min(max(at, self.begin), self.end)) for at in (begin, end))
        return first, round(last - first, 2)

    def ticks(self, texts: Texts) -> list[tuple[float, str]]:
        """Return position and text of the marks of time, at round local times."""
        span = self.end - self.begin
        step = next((step for step in STEPS if span / step < MAX_TICKS), STEPS[-1])
        if not is_of_calendar(self.begin):
            first = math.ceil(self.begin / step) * step
            return [(self.x(at), f"{at} s") for at in range(first, math.floor(self.end) + 1, step)]
        form = "%H:%M:%S" if step < 60 else "%H:%M" if span < DAY else texts("day_and_time" if step < DAY else "day")
        form = texts("month") if step > 30 * DAY else form
        offset = local_moment(self.begin, self.zone).utcoffset()
        ahead = 0 if offset is None else int(offset.total_seconds())
        first = math.ceil((self.begin + ahead) / step) * step - ahead
        times = (first + index * step for index in range(MAX_TICKS + 1))
        return [(self.x(at), _moment(at, self.zone, form)) for at in times if at <= self.end]


@dataclass(frozen=True, slots=True)
class Mark:
    """The nominal value, a limit or the present value: a line and an area beyond it, and a label beside the plot."""

    style: str
    value: float
    line: float
    area: Span = (0.0, 0.0)  # Begin and height
    label: float = 0.0


@dataclass(frozen=True, slots=True)
class Curve:
    """A parameter, or the amplitude of a component, over time."""

    name: str
    parameter: ParameterDocument | None
    component: ComponentDocument | None  # None of a component that has left the twin
    limits: tuple[tuple[Level, float, bool], ...]  # Level, value, and whether values below it are beyond it
    last: HistorySample | None
    away: Mapping[str, float]  # Percent of the windows with another status than estimated
    scale: Scale  # In which its present value and all beside it are written
    present: str = ""  # The number of its present value, rounded to its interval
    plot: Mapping[str, Sequence[Any]] | None = None
    """``band``: polygons of the 95 % interval; ``lines``: whether the value was estimated then, and points; ``marks``;
    ``forecast``: the polygon of its 80 % intervals and the points of its medians; all as SVG takes them."""


class PageSource(Protocol):
    """What a page reads: a :class:`HistoryReader`, or reports that were received."""

    site: str
    machine: str

    def language_and_zone(self) -> tuple[Language | None, str | None]:
        """Return language and zone of the page; None for English, and for the zone of this computer."""

    def latest(self, count: int) -> list[ReportDocument]:
        """Return the last reports, the newest first."""

    def states(self, since: float) -> list[PartState]:
        """Return the states of the parts in the order in which they were entered."""

    def events(self, since: float) -> list[EventDocument]:
        """Return the changes of events since a time, in their order."""

    def findings(self, since: float) -> list[dict[str, Any]]:
        """Return the findings since a time."""

    def counters(self, since: float) -> list[dict[str, Any]]:
        """Return the last counters of each hour and start of the daemon since a time."""

    def description(self) -> dict[str, Any]:
        """Return what reports do not repeat; empty if it is not known."""

    def own_rules(self) -> tuple[Rule, ...]:
        """Return the rules of the machine file."""


def html_report(reader: PageSource, samples: Iterable[HistorySample], interval: str, since: float, now: float) -> str:
    """Return the page about the time from ``since`` to ``now``, from ``samples`` of each ``interval``.

    If nobody continues the history, ``now`` is the end of its last window.

    Raises:
        ConfigurationError: the history cannot be read.
        ValueError: a document in it cannot be read.
    """
    reports, states, description = reader.latest(LATEST_REPORTS), reader.states(since), reader.description()
    latest = reports[0] if reports else None
    length = next(seconds for seconds, name in RESOLUTIONS.items() if name == interval)
    rows = [row for row in samples if since - length < row.time <= now + DAY]
    silence = now - latest.window.end if latest else 0.0
    is_silent = latest is None or silence > SILENT_WINDOWS * (latest.window.end - latest.window.start)
    begins = [row.time for row in rows[:1]] + [row.entered for row in states[:1]]
    begin = since if "log" in description else max(since, min([*begins, latest.window.start if latest else since]))
    until = latest.window.end if latest and not is_silent and silence > -DAY else now
    language, zone_of_page = reader.language_and_zone()
    axis = _axis(min(begin, until - 1.0), until, latest, zone_of_page)
    gaps = _gaps(sorted({row.time for row in rows}), length) + ([(latest.window.end, until)] if latest else [])
    told = _events(reader, latest, since)
    events = [row for row in told if row[1] is not Level.HINT]
    urgent = {event.id.rpartition("@")[0] for event, _, _ in events if event.end is None}
    curves = list(_curves(axis, gaps, rows, latest, description))
    curves.sort(key=lambda row: not urgent & {f"limit/{row.name}", f"component/{row.name.rpartition('/')[0]}"})

    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=lambda value: _shown(value, say),
    )
    say = texts_in(language or "en")
    is_dated = is_of_calendar(axis.begin)
    own_when = (lambda seconds: _moment(seconds, axis.zone, "%F %T")) if is_dated else clock_in(axis.zone)
    own: dict[str, Any] = {"when": own_when, "part": say.part}
    own["words"] = say.translated
    own["performance_texts"] = partial(text.performance_texts, zone=axis.zone)
    own["note"] = lambda written: whole(say.decimals(written))  # in the words of a person, whose times stay
    own["whole"] = lambda written: whole(say.decimals(in_local_time(written, axis.zone)))
    environment.filters |= vars(text) | {"quantity_text": quantity_text} | own
    template = environment.from_string((files(__package__) / "report.html").read_text(encoding="utf-8"))
    zone = f"{local_moment(now, axis.zone):%Z}" if is_dated else ""
    is_over = latest is not None and now <= latest.window.end
    return template.render(
        own_when=own_when,
        say=say, machine=reader.machine, site=reader.site, latest=latest, is_silent=is_silent, silence=silence, now=now,
        description=description, interval=interval, version=__version__, axis=axis, levels=Level, max_rows=MAX_ROWS,
        zone=zone, lanes=list(_lanes(axis, latest, states)), curves=curves, is_over=is_over,
        gaps=[(*axis.span(*gap), *gap) for gap in gaps if axis.begin < gap[1] > gap[0]], events=events,
        conditions=_conditions(reader, told, say), condition_of=_conditions_of(latest),
        hints=[event for event, worst, _ in told if worst is Level.HINT],
        findings=reader.findings(since),
        undetermined=_undetermined(reports), equations=_equations(latest, description),
        losses=_losses(reader.counters(since), since),
    )  # fmt: skip


def _conditions(
    reader: PageSource, told: Iterable[tuple[EventDocument, Level, object]], texts: Texts
) -> list[ConditionPage]:
    """Return what the conditions of events mean, by the rules of the machine."""
    rules = (*reader.own_rules(), *load_rules(texts.language))
    return pages_of(dict.fromkeys(event.condition_id for event, _, _ in told), rules, texts)


def _conditions_of(latest: ReportDocument | None) -> dict[str, str]:
    """Return the conditions of components by their ids, where an event says which one of their family it is."""
    known = {event.id.rpartition("@")[0]: event.condition for event in (latest.events if latest else ())}
    own = {row.id: known.get(f"component/{row.id.rpartition('/')[0]}") for row in (latest.components if latest else ())}
    return {key: condition for key, condition in own.items() if condition}


def _moment(seconds: float, zone: str | None, form: str) -> str:
    """Return a local time, which names its zone in an hour that comes twice; the head of the page names that of all."""
    return local_moment(seconds, zone).strftime(f"{form} %Z" if comes_twice(seconds, zone) else form)


def whole(written: str) -> Markup:
    """Return a text in which no line ends within a date, or a number and its unit; a long interval has its own."""
    texts = [Markup.escape(part) for part in WHOLE.split(visible(written))]
    for index in range(1, len(texts), 2):  # what matches
        parts = re.split(" (?=±)", texts[index]) if len(texts[index]) > MAX_WHOLE else [texts[index]]
        texts[index] = Markup(" ").join(UNBROKEN.format(part) if set("- ") & set(part) else part for part in parts)
    return Markup("").join(texts)


def _shown(value: object, texts: Texts) -> object:
    """Return what the template inserts with its controls escaped; the engine escapes the signs of HTML."""
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return visible(texts.decimals(str(value))) if is_text else value


def _axis(begin: float, now: float, latest: ReportDocument | None, zone: str | None) -> Axis:
    """Return the axis with room for the forecasts."""
    forecasts = [row.forecast for row in (latest.parameters.values() if latest else ()) if row.forecast]
    ends = [row.high or row.at for item in forecasts for row in (item.watch, item.act) if row and row.at > now]
    room = min(max(ends, default=now) - now, FORECAST_SHARE * (now - begin))
    return Axis(begin, now, now + max(room, 0.0), zone)


def _gaps(times: Sequence[float], length: float) -> list[Span]:
    """Return the times without values, each of an interval of ``length`` seconds."""
    pauses = sorted(after - before for before, after in pairwise(times))
    longest = GAP * pauses[len(pauses) // 2] if pauses else math.inf
    return [(before + length, after) for before, after in pairwise(times) if after - before > longest]


def _events(
    reader: PageSource, latest: ReportDocument | None, since: float
) -> list[tuple[EventDocument, Level, list[tuple[float, Level]]]]:
    """Return events, their most severe states and all states with their begin: the open ones first, then the newest."""
    rows = {event.id: event for event in (*reader.events(since), *(latest.events if latest else ()))}
    states: dict[str, list[tuple[float, Level]]] = {key: [] for key in rows}
    for change in reader.events(min((event.start for event in rows.values()), default=since)):
        if change.id in rows and change.end is None and (change.since, change.state) not in states[change.id]:
            states[change.id].append((change.since, change.state))
    ordered = sorted(rows.values(), key=lambda event: (event.end is not None, -event.state.rank, -event.start))
    worst = {key: max((level for _, level in own), key=lambda level: level.rank, default=rows[key].state)
             for key, own in states.items()}  # fmt: skip
    return [(event, worst[event.id], states[event.id]) for event in ordered]


def _lanes(
    axis: Axis, latest: ReportDocument | None, states: Sequence[PartState]
) -> Iterator[tuple[str, Level, list[tuple[Level, float, float, float, float]]]]:
    """Yield each part with its present state, and its states with position, length, begin and end.

    A part outside the twin is in a report only while it is not well: it has a lane if it was in another state.
    """
    health = latest.health if latest else None
    named: dict[str, PartDocument | PartState] = {"": health, **health.parts} if health else {}
    others: dict[str, PartDocument | PartState]
    others = {row.part: row for row in states if named and row.part not in named}  # as each was last
    for part, present in {**named, **others}.items():
        own = [(row.entered, row.state) for row in states if row.part == part]
        pieces = [(state, *axis.span(begin, end), begin, end)
                  for begin, end, state in _pieces(own or [(present.since, present.state)], axis.now)
                  if end > axis.begin]  # fmt: skip
        if part in named or any(state is not Level.OK for state, *_ in pieces):
            yield part, present.state, pieces


def _pieces(entered: Sequence[tuple[float, Level]], now: float) -> Iterator[tuple[float, float, Level]]:
    """Yield begin, end and state from when each was entered, in this order, to when the next one was.

    A state does not begin with its cause, which may be older. Where the clock was set meanwhile, a state is shown only
    as long as it is known.
    """
    times = sorted(begin for begin, _ in entered)
    ends = (*(begin for begin, _ in entered[1:]), now)
    for (begin, state), following in zip(entered, ends, strict=True):
        later = bisect_right(times, begin)
        end = min((following, *times[later : later + 1]))
        if begin < end:
            yield begin, end, state


def _curves(
    axis: Axis, gaps: Sequence[Span], samples: Iterable[HistorySample], latest: ReportDocument | None,
    description: Mapping[str, Any],
) -> Iterator[Curve]:  # fmt: skip
    """Yield the curves of parameters and components that have values, or that the latest report has."""
    parameters = latest.parameters if latest else {}
    components = {row.id: row for row in latest.components} if latest else {}
    rows: dict[str, list[HistorySample]] = {name: [] for name in parameters}
    for sample in samples:
        if sample.name.startswith(PERFORMANCE):  # the page states their present values
            continue
        rows.setdefault(sample.name, []).append(sample)
    for name, own in rows.items():
        parameter, component = parameters.get(name), components.get(name)
        stated = description.get("limits", {}).get(component.site if component else name, ())
        limits = tuple((Level(level), value, is_lower) for level, value, is_lower in stated)
        same = [row for row in own if row.unit == own[-1].unit]
        counts: Counter[str] = Counter()
        for row in same:
            counts[row.status] += row.count
        away = {name: 100.0 * count / counts.total() for name, count in counts.items() if name not in TRUSTED}
        scale, last = _scale(parameter, same), same[-1] if same else None
        curve = Curve(name, parameter, component, limits, last, away, scale, _present(scale, parameter, component))
        points = list(_thinned(axis, same))
        yield replace(curve, plot=_plot(axis, gaps, points, curve)) if points else curve


def _scale(parameter: ParameterDocument | None, samples: Sequence[HistorySample]) -> Scale:
    """Return how the numbers of a curve are written, by its present value; by its nominal value if it has none."""
    if parameter is not None:
        size, sd = (parameter.nominal, 0.0) if parameter.value is None else (parameter.value, parameter.sd or 0.0)
        return scale_of(size, parameter.unit, QUANTILE * sd)
    return scale_of(samples[-1].last, samples[-1].unit) if samples else Scale(0, "")


def _present(scale: Scale, parameter: ParameterDocument | None, component: ComponentDocument | None) -> str:
    """Return the number of a present value, rounded to its interval; empty if there is none."""
    item = component.values["amplitude"] if component else parameter
    if item is None or item.value is None or item.sd is None:
        return ""
    return scale.numbers(item.value, QUANTILE * item.sd)[0]


def _thinned(axis: Axis, samples: Iterable[HistorySample]) -> Iterator[HistorySample]:
    """Yield at most some hundred values: of each piece of the axis the mean, and the ends of the intervals."""
    pieces: dict[int, list[HistorySample]] = {}
    for row in samples:
        pieces.setdefault(int(MAX_POINTS / 100.0 * axis.x(row.time)), []).append(row)
    for _, rows in sorted(pieces.items()):
        mean = sum(row.mean * row.count for row in rows) / sum(row.count for row in rows)
        low = min(row.mean if row.low is None else row.low for row in rows)
        high = max(row.mean if row.high is None else row.high for row in rows)
        yield replace(rows[-1], mean=mean, low=low, high=high)


def _plot(axis: Axis, gaps: Sequence[Span], points: Sequence[HistorySample], curve: Curve) -> dict[str, Sequence[Any]]:
    """Return what is drawn of the ``points`` of a curve: with nominal value, near limits and forecast."""
    last, parameter = points[-1].mean, curve.parameter
    stated = 0.0 if parameter is None else parameter.nominal if parameter.baseline is None else parameter.baseline
    seen = [stated, *(row.mean for row in points)]
    near = max(max(seen) - min(seen), min((abs(value - last) for _, value, _ in curve.limits), default=0.0))
    shown = [row for row in curve.limits if abs(row[1] - last) <= NEAR_LIMITS * near]
    seen += [value for _, value, _ in shown]
    half = 0.5 * (max(seen) - min(seen)) * (1.0 + 2.0 * MARGIN) or abs(last) * MARGIN or 1.0
    top = 0.5 * (max(seen) + min(seen)) + half

    def y(value: float) -> float:
        return round(min(max(50.0 * (top - value) / half, -1e4), 1e4), 2)  # a band may be far outside

    def line(places: Iterable[tuple[float, float | None]]) -> Markup:  # numbers of SVG, which no language changes
        return Markup(" ").join(f"{axis.x(at)},{y(value or 0.0)}" for at, value in places)

    band, lines = [], []
    for run in _runs(points, gaps):
        upper, lower = [(row.time, row.high) for row in run], [(row.time, row.low) for row in run]
        band.append(line((*upper, *reversed(lower))))
        trusted = [row.status in TRUSTED for row in run]
        changes = [index for index in range(1, len(run)) if trusted[index] is not trusted[index - 1]]
        for begin, end in pairwise((0, *changes, len(run))):
            lines.append((trusted[begin], line((row.time, row.mean) for row in run[begin : end + 1])))
    marks = [Mark("nominal", stated, y(stated)), Mark("value", points[-1].last, y(last))]
    marks += [Mark(level.name, value, y(value), (y(value), 100.0 - y(value)) if is_lower else (0.0, y(value)))
              for level, value, is_lower in shown]  # fmt: skip
    forecast = parameter.forecast if parameter else None
    both = (forecast.watch, forecast.act) if forecast else ()
    ahead = sorted((row for row in both if row is not None and row.at > axis.now), key=lambda row: row.at)
    now, far = (points[-1].time, last), 2.0 * axis.end - axis.begin
    median = line((now, *((row.at, row.limit) for row in ahead)))
    early = line((now, *((max(row.low, axis.now), row.limit) for row in ahead)))
    late = line((row.high or far, row.limit) for row in reversed(ahead))
    future = (Markup(" ").join((early, late)), median) if ahead else ()
    return {"band": band, "lines": lines, "marks": list(_labelled(marks)), "forecast": future}


def _runs(points: Sequence[HistorySample], gaps: Iterable[Span]) -> Iterator[Sequence[HistorySample]]:
    """Yield the points between the gaps."""
    ends = [begin for begin, _ in gaps]
    cuts = [index for index in range(1, len(points))
            if any(points[index - 1].time <= end < points[index].time for end in ends)]  # fmt: skip
    for begin, end in pairwise((0, *cuts, len(points))):
        yield points[begin:end]


def _labelled(marks: Iterable[Mark]) -> Iterator[Mark]:
    """Yield the marks from top to bottom with their labels, none of which covers another."""
    ordered = sorted(marks, key=lambda mark: mark.line)
    lowest = 100.0 - 0.5 * LABEL_HEIGHT
    places = [min(max(mark.line, 0.5 * LABEL_HEIGHT), lowest) for mark in ordered]
    for index in range(1, len(places)):
        places[index] = max(places[index], places[index - 1] + LABEL_HEIGHT)
    for index in reversed(range(len(places))):
        places[index] = lowest = min(places[index], lowest)
        lowest -= LABEL_HEIGHT
    yield from (replace(mark, label=round(place, 1)) for mark, place in zip(ordered, places, strict=True))


def _undetermined(reports: Sequence[ReportDocument]) -> dict[tuple[int, int, str, str], list[str]]:
    """Return the parameters that some reports did not determine, by: how many, of how many, why, and advice."""
    names: dict[tuple[int, int, str, str], list[str]] = {}
    for name in reports[0].parameters if reports else ():
        own = [report.parameters[name] for report in reports if name in report.parameters]
        missing = [row for row in own if row.status is not Status.ESTIMATED]
        if missing:
            reason = next((row.reason for row in missing if row.reason), "")
            advice = next((row.advice for row in missing if row.advice), "")
            names.setdefault((len(missing), len(own), reason, advice), []).append(name)
    return names


def _equations(latest: ReportDocument | None, description: Mapping[str, Any]) -> list[str]:
    """Return the equations of the twin with its components, a line each."""
    equations, sites = dict(description.get("equations", ())), description.get("sites", {})
    lines = []
    for number, row in enumerate(latest.components if latest else (), 1):
        into, mode, through = sites.get(row.site, ("", "", ""))
        if into in equations:
            factor = f"({through}) * " if set("+-/") & set(through) else "" if through == "1" else f"{through} * "
            multiplied = f"({equations[into]}) * (1 + U{number})"
            equations[into] = multiplied if mode == "multiplicative" else f"{equations[into]} + {factor}U{number}"
        lines.append(f"U{number} = {equation_text(row.equation)}")
    sides = {f"d{left[4:-1]}/dt" if left.startswith("der(") else left: right for left, right in equations.items()}
    return [*(f"{left} = {formula_text(right)}" for left, right in sides.items()), *lines]


def _losses(counters: Iterable[Mapping[str, Any]], since: float) -> Mapping[str, int]:
    """Return what was counted since a time, to the hour: counters begin at zero with each start of the daemon."""
    first: dict[int, Mapping[str, Any]] = {}
    last: dict[int, Mapping[str, Any]] = {}
    for row in counters:
        if row["hour"] + HOUR <= since or (row["run"] < since and row["run"] not in first):
            first[row["run"]] = row
        last[row["run"]] = row
    sums: Counter[str] = Counter()
    for run, row in last.items():
        before = first.get(run, {})
        sums.update({name: value - before.get(name, 0) for name, value in row.items() if name not in {"hour", "run"}})
    return sums
