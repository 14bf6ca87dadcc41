"""What the hall says of a machine: state, since when, why, what to do, and the parameter nearest to its limit."""

from collections.abc import Iterable
from dataclasses import dataclass

from otolith.health.limits import Level
from otolith.health.schema import Language, ReportDocument
from otolith.health.text import Texts, report_in, texts_in, undecided_advice, undecided_text, zone_of
from otolith.health.times import in_local_time, moment_text
from otolith.site.known import KnownMachine, Trace, share_of
from otolith.site.words import words_in
from otolith_drivers.outside_text import visible

MAX_SHOWN = 240  # characters of a text on a card: engineering choice, four lines of a phone
WIDTH, HEIGHT = 100.0, 24.0  # of a curve, in its own units
SYMBOLS = {Level.OK: "✓", Level.HINT: "i", Level.NO_DATA: "?", Level.WATCH: "▲", Level.ACT: "■"}
"""The shape of each state, so that nobody has to tell colours apart."""


@dataclass(frozen=True, slots=True)
class Card:
    """What is shown of a machine; the texts are for people, not yet escaped for HTML."""

    site: str
    name: str
    state: Level
    symbol: str
    word: str
    since: str
    what: str
    advice: str
    parameter: str = ""  # Nearest to its limit, with its share of the way there
    parameter_long: str = ""  # The same in a sentence
    curve: str = ""  # Points of an SVG line, from top to bottom

    @property
    def id(self) -> str:
        """The id of its element."""
        return f"m-{self.site}.{self.name}"


def card_of(machine: KnownMachine, now: float, language: Language, zone: str | None = None) -> Card:
    """Return the card of a machine."""
    texts, state = texts_in(language), machine.state(now)
    report = None if machine.report is None else report_in(machine.report, language, zone)
    own_zone = zone or (zone_of(report) if report else None)
    since, what, advice = "", texts("no_report"), f"{texts('start_daemon')}: otolith run"
    if report is not None and machine.is_silent(now):
        what = texts("silent", time=moment_text(report.window.end, own_zone), duration=_age(now - machine.heard))
        advice = texts("check_daemon")
    elif report is not None:
        health = report.health
        since = "" if health is None else moment_text(health.since, own_zone)
        what, advice = _reason(report, texts, own_zone)
    if machine.has_rival(now):
        what, advice = words_in(language)["rival"], words_in(language)["rival_advice"]
    nearest, near = machine.nearest, ("", "")
    if nearest is not None:
        share = {"name": nearest[0], "share": f"{max(0.0, nearest[1]):.0%}".replace("%", " %")}
        words = words_in(language)
        near = words["limit_share"].format(**share), words["limit_share_long"].format(**share)
    return Card(
        site=machine.site, name=machine.name, state=state, symbol=SYMBOLS[state], word=texts.translated(state),
        since=texts("since", time=since) if since else "", what=_short(what, texts), advice=_short(advice, texts),
        parameter=_short(near[0], texts), parameter_long=_short(near[1], texts),
        curve="" if nearest is None else _points(machine, nearest[0]),
    )  # fmt: skip


def _reason(report: ReportDocument, texts: Texts, zone: str | None) -> tuple[str, str]:
    """Return why a machine is in its state, and what to do."""
    events = report.open_events
    if events:
        more = f" (+{len(events) - 1})" if len(events) > 1 else ""
        return in_local_time(f"{texts.part(events[0].part)}: {events[0].condition}{more}", zone), events[0].advice
    if undecided := undecided_text(report):
        return undecided, undecided_advice(report)
    if report.health is None:
        return texts("no_state"), ""
    is_well = report.health.state is Level.OK
    reason = in_local_time(report.health.reason, zone)
    return reason or (texts("all_well") if is_well else ""), texts("nothing") if is_well else ""


def _age(seconds: float) -> str:
    """Return a duration that changes rarely, so that a silent machine is not sent anew each second."""
    minutes = int(max(seconds, 0.0) // 60.0)
    hours = minutes // 60
    return "< 1 min" if minutes < 1 else f"{minutes} min" if hours < 2 else f"{hours} h"


def _short(text: str, texts: Texts) -> str:
    shown = visible(texts.decimals(text))
    return shown if len(shown) <= MAX_SHOWN else f"{shown[: MAX_SHOWN - 1]}…"


def _points(machine: KnownMachine, name: str) -> str:
    """Return the line of a parameter: its healthy value is at the bottom, and its limit at the top."""
    trend, report = machine.trends.get(name), machine.report
    if trend is None or report is None or len(trend.times) < 2:
        return ""
    row = report.parameters[name]
    return " ".join(_scaled(trend, (
        share_of(row.model_copy(update={"value": value, "referred": None})) or 0.0 for value in trend.values
    )))  # fmt: skip


def _scaled(trend: Trace, shares: Iterable[float]) -> Iterable[str]:
    begin, end = trend.times[0], trend.times[-1]
    for time, share in zip(trend.times, shares, strict=True):
        x = WIDTH * (time - begin) / max(end - begin, 1e-9)
        yield f"{x:.0f},{HEIGHT * (1.0 - min(max(share, 0.0), 1.0)):.1f}"
