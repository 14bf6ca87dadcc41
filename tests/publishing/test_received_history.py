"""A page from reports that were received says what the page from the database says, as far as few reports can."""

import re

import pytest

from otolith.health.limits import Level
from otolith.health.schema import (
    CrossingDocument,
    ForecastDocument,
    HealthDocument,
    Language,
    ParameterDocument,
    PartDocument,
    ReportDocument,
    Status,
)
from otolith.publishing.received_history import ReceivedHistory, received_page
from otolith.storage.history import HOUR
from tests.sites.machines import raised
from tests.storage.histories import MACHINE, SITE, START, document


def at(time: float, state: Level, since: float, *, index: int = 1) -> ReportDocument:
    part = PartDocument(state=state, since=since)
    health = HealthDocument(state=state, since=since, parts={"winding": part})
    return document(index, START + time).model_copy(update={"health": health})


def history(*reports: ReportDocument) -> ReceivedHistory:
    return ReceivedHistory(SITE, MACHINE, reports, [])


@pytest.mark.parametrize(
    ("since", "entered"),
    [
        (START + 90.0, START + 90.0),  # between two reports, of which there are more
        (START + 20.0, START + 60.0),  # the cause is older than the last report without it
        (START + 500.0, START + 120.0),  # a time that cannot be: not before the report
    ],
)
def test_a_state_was_entered_between_the_report_without_it_and_the_one_with_it(since: float, entered: float) -> None:
    rows = history(at(60.0, Level.OK, START), at(120.0, Level.ACT, since)).states(START)
    assert [(row.part, row.state) for row in rows] == [
        ("", Level.OK), ("winding", Level.OK), ("", Level.ACT), ("winding", Level.ACT),
    ]  # fmt: skip
    assert {row.entered for row in rows if row.state is Level.ACT} == {entered}


def test_a_part_that_a_report_no_longer_has_is_well() -> None:
    report = at(120.0, Level.OK, START)
    assert report.health is not None
    without = report.model_copy(update={"health": report.health.model_copy(update={"parts": {}})})
    rows = history(at(60.0, Level.WATCH, START), without).states(START)
    assert [(row.part, row.state) for row in rows][-2:] == [("", Level.OK), ("winding", Level.OK)]


def test_findings_and_losses_are_counted_over_the_reports_that_came() -> None:
    reports = [document(index, START + 10.0 * index) for index in (1, 2, 3, 1, 2)]
    received = ReceivedHistory(SITE, MACHINE, reports, [])
    (finding,) = received.findings(0.0)
    assert finding["count"] == 3
    assert [row["windows"] for row in received.counters(START - HOUR)] == [3, 2]  # a start between them


def test_a_page_without_a_report_says_so() -> None:
    assert "OK" not in received_page(history(), START, START + HOUR).partition("<h2")[0].partition("<body")[2][:400]


def page_in(language: Language | None, zone: str | None) -> str:
    """The page of a machine with a forecast, an open event and a part of which nothing is known."""
    crossing = CrossingDocument(limit=6.1, at=START + 307.3, low=START + 303.1, high=START + 311.7)
    later = crossing.model_copy(update={"limit": 6.0, "at": START + 330.7})
    row = ParameterDocument(
        value=6.51, unit="ohm", nominal=6.5, sd=0.01, low=6.49, high=6.53, limit=6.0, status=Status.ESTIMATED,
        forecast=ForecastDocument(computed=START, watch=crossing, act=later),
    )  # fmt: skip
    event = raised().model_copy(update={"condition": "short circuit between turns of the winding",
                                        "condition_id": "winding-turns", "timezone": "UTC"})  # fmt: skip
    reports = []
    for index in range(4):
        parts = {"winding": PartDocument(state=Level.ACT, since=START, reason=event.condition),
                 "shaft": PartDocument(state=Level.NO_DATA, since=START, reason="not determined yet: D")}  # fmt: skip
        health = HealthDocument(state=Level.ACT, since=START, reason=event.condition, parts=parts)
        own = {"health": health, "events": (event,), "parameters": {"R_a": row}}
        reports.append(document(index, START + 100.0 * index).model_copy(update=own))
    return received_page(ReceivedHistory(SITE, MACHINE, reports, [event], (language, zone)), START, START + 300.0)


def test_a_page_is_in_language_and_zone_of_its_reader() -> None:
    english, german = page_in(None, None), page_in("de", "Asia/Tokyo")
    assert [needle in english for needle in ('lang="en"', "short circuit between turns", "not determined yet: D")] == [
        True, True, True
    ]  # fmt: skip
    for needle in ('lang="de"', "HANDELN", "Windungsschluss in der Wicklung", "noch nicht bestimmt: D", "07:13:20"):
        assert needle in german
    assert "short circuit" not in german
    assert 'lang="de"' in received_page(ReceivedHistory(SITE, MACHINE, [], [], ("de", None)), START, START + 300.0)


def test_no_language_changes_what_is_drawn() -> None:
    """A decimal comma in the points of a curve would draw another one."""
    drawn = [re.findall(r'(?:points|x1|x2|y1|y2|y|height)="([^"]*)"', page_in(language, "UTC"))
             for language in ("en", "de")]  # fmt: skip
    assert drawn[0] == drawn[1]
    assert any(text.count(" ") > 3 for text in drawn[0])
