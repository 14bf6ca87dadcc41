"""The same parameter in machines of the same twin, and the events of the last week."""

import statistics
from collections.abc import Iterator
from dataclasses import dataclass

from otolith.acquisition.window import Verdict
from otolith.estimation.information import QUANTILE
from otolith.health.limits import Level
from otolith.health.schema import CountersDocument, Language, ParameterDocument
from otolith.health.text import event_in, texts_in, value_text, zone_of
from otolith.health.times import in_local_time, moment_text
from otolith.site.known import Knowledge, KnownMachine, share_of
from otolith_drivers.outside_text import visible
from otolith_drivers.units import quantity_text

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MIN_PEERS = 4  # machines of a twin, from which one can differ from the others
OUTLIER = 3.5  # distance to the median over the normal-consistent median absolute deviation
CONSISTENT = 0.6745  # median absolute deviation of a normal distribution of standard deviation 1
MAX_ROWS = 200  # events, and machines of a table
WEEK = 604_800.0  # s


@dataclass(frozen=True, slots=True)
class Peer:
    """A parameter of a machine beside that of its peers."""

    machine: KnownMachine
    value: str
    healthy: str
    limit: str
    state: str
    is_outlier: bool


@dataclass(frozen=True, slots=True)
class TimedEvent:
    """An event, in words."""

    machine: KnownMachine
    time: str
    part: str
    condition: str
    state: str


@dataclass(frozen=True, slots=True)
class DataQuality:
    """What is wrong with the data of a machine, in words."""

    machine: KnownMachine
    verdict: str
    missing: str  # Share of the records of the last window without a sample
    reason: str
    bad: int  # Windows since the daemon started that were not estimated from because of their quality
    missed: int  # Windows not estimated from because the worker was down or busy


def poor_data(knowledge: Knowledge, now: float, language: Language, zone: str | None) -> list[DataQuality]:
    """Return the machines that report, and of which the last window was bad or a source is down."""
    say, found = texts_in(language), []
    for machine in knowledge.worst_first(now):
        report = machine.report
        if report is None or machine.is_silent(now):
            continue
        quality, driver, counters = report.window.quality, report.driver, report.counters or CountersDocument()
        reasons = [*quality.reasons, *([] if driver is None or driver.up else [driver.reason])]
        if quality.verdict is Verdict.BAD or reasons:
            own_zone = zone or zone_of(report)
            written = (in_local_time(say.translated(reason), own_zone) for reason in dict.fromkeys(reasons))
            words = visible(say.decimals("; ".join(written)))
            missing = say.decimals(f"{quality.missing:.0%}")
            verdict = say.translated(quality.verdict)
            own = DataQuality(machine, verdict, missing, words, counters.windows_bad, counters.windows_missed)
            found.append(own)
    return found[:MAX_ROWS]


def peers(knowledge: Knowledge, now: float, language: Language) -> dict[tuple[str, str], list[Peer]]:
    """Return the machines of each twin and parameter with a limit, the nearest to its limit first."""
    groups: dict[tuple[str, str], list[tuple[KnownMachine, ParameterDocument, float]]] = {}
    for machine in knowledge:
        for name, row in machine.report.parameters.items() if machine.report else ():
            if (share := share_of(row)) is not None:
                groups.setdefault((machine.report.twin if machine.report else "", name), []).append(
                    (machine, row, share)
                )
    say, found = texts_in(language), {}
    for key, rows in sorted(groups.items()):
        if len(rows) < 2:
            continue
        rows.sort(key=lambda row: -row[2])
        away = _outliers([share for *_, share in rows], [_reach(row) for _, row, _ in rows])
        found[key] = [
            Peer(
                machine, visible(say.decimals(say.translated(value_text(row)))),
                say.decimals(quantity_text(row.nominal if row.baseline is None else row.baseline, row.unit)),
                "" if row.limit is None else say.decimals(quantity_text(row.limit, row.unit)),
                say.translated(machine.state(now)), is_outlier,
            )
            for (machine, row, _), is_outlier in list(zip(rows, away, strict=True))[:MAX_ROWS]
        ]  # fmt: skip
    return found


def _reach(parameter: ParameterDocument) -> float:
    """Return half of the 95 % interval of a parameter with a limit, as a share of the way to this."""
    healthy = parameter.nominal if parameter.baseline is None else parameter.baseline
    return QUANTILE * (parameter.sd or 0.0) / abs((parameter.limit or 0.0) - healthy)


def _outliers(shares: list[float], reaches: list[float]) -> list[bool]:
    """Return which values differ from the others, by the modified z-score of Iglewicz and Hoaglin (1993).

    One whose interval, of half ``reaches``, holds the median of the others does not.
    """
    if len(shares) < MIN_PEERS:
        return [False] * len(shares)
    middle = statistics.median(shares)
    spread = statistics.median(abs(share - middle) for share in shares)
    least = OUTLIER * max(spread, 1e-3) / CONSISTENT
    return [abs(share - middle) > max(least, reach) for share, reach in zip(shares, reaches, strict=True)]


def week(knowledge: Knowledge, now: float, language: Language, zone: str | None) -> list[TimedEvent]:
    """Return the events that were open in the week before ``now``, Unix s, the newest first; without hints."""
    found = sorted(_recent(knowledge, now), key=lambda row: -row[0])
    return [event for _, event in _worded(found[:MAX_ROWS], language, zone)]


def _recent(knowledge: Knowledge, now: float) -> Iterator[tuple[float, KnownMachine, str]]:
    for machine in knowledge:
        for key, event in machine.events.items():
            if not event.is_hint and (event.end is None or event.end > now - WEEK):
                yield event.start, machine, key


def _worded(
    rows: list[tuple[float, KnownMachine, str]], language: Language, zone: str | None
) -> Iterator[tuple[float, TimedEvent]]:
    say = texts_in(language)
    for start, machine, key in rows:
        event = event_in(machine.events[key], language, zone)
        state = say.translated(event.state if event.end is None else Level.OK)
        time, part = moment_text(start, event.timezone), say.part(event.part)
        yield start, TimedEvent(machine, time, visible(part), visible(event.condition), state)
