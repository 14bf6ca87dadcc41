"""A page from reports that were received says what the page from the database says, as far as few reports can."""

import pytest

from otolith.health.limits import Level
from otolith.health.schema import HealthDocument, PartDocument, ReportDocument
from otolith.publishing.received_history import ReceivedHistory, received_page
from otolith.storage.history import HOUR
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
