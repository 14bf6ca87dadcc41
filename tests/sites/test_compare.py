"""Machines of one twin beside each other, and the events of a week."""

import re

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.limits import Level
from otolith.health.schema import DriverDocument
from otolith.site.compare import MIN_PEERS, WEEK, peers, poor_data, week
from otolith.site.hall import PAGES
from otolith.site.known import Knowledge
from otolith.site.words import words_in
from tests.sites.machines import raised, report_of, sent
from tests.storage.histories import START


def known(*values: float) -> Knowledge:
    knowledge = Knowledge()
    for index, value in enumerate(values):
        knowledge.take(*sent(report_of(f"m-{index}", value=value)), START)
    return knowledge


@pytest.mark.parametrize(
    ("values", "marked"),
    [
        ((6.50, 6.51, 6.52, 6.49, 6.50, 7.2), {"m-5"}),
        ((6.50, 6.51, 6.52, 6.49, 6.50, 6.53), set()),
        ((6.5, 6.5, 6.5, 6.5), set()),
        ((6.5, 6.5, 7.2), set()),  # of three it would be decided by one
    ],
)
def test_a_machine_that_differs_from_its_peers_is_marked(values: tuple[float, ...], marked: set[str]) -> None:
    (rows,) = peers(known(*values), START, "en").values()
    assert {row.machine.name for row in rows if row.is_outlier} == marked
    assert len(rows) == len(values)
    assert len(values) >= MIN_PEERS or not marked
    assert rows[0].machine.name == f"m-{values.index(max(values))}"  # the nearest to its limit first


@pytest.mark.parametrize(("sd", "is_marked"), [(0.001, True), (0.05, False)])
def test_a_machine_whose_interval_holds_the_median_does_not_differ(sd: float, is_marked: bool) -> None:
    knowledge, report = known(*(6.5,) * 6), report_of("wide", value=6.53)
    row = report.parameters["R_a"].model_copy(update={"sd": sd})
    knowledge.take(*sent(report.model_copy(update={"parameters": {"R_a": row}})), START)
    (rows,) = peers(knowledge, START, "en").values()
    assert [row.machine.name for row in rows if row.is_outlier] == ["wide"] * is_marked


def test_the_nearest_to_a_limit_and_those_that_differ_are_seen_at_once_and_each_machine_once() -> None:
    knowledge = known(*(6.5 + 0.001 * index for index in range(20)), 4.0)
    html = PAGES.get_template("compare.html").render(
        certificates=[], versions=[],
        peers=peers(knowledge, START, "en"), poor=[], events=[], first=3, here="compare", language="en", refused={},
        words=words_in("en"), title="Works", time="now", dropped=0,
    )  # fmt: skip
    seen = re.findall(r">(m-\d+)</a>", html.partition("<details")[0])
    assert seen[:3] == ["m-19", "m-18", "m-17"]
    assert [row.machine.name for row in peers(knowledge, START, "en")["dc_motor", "R_a"] if row.is_outlier] == seen[3:]
    assert sorted(re.findall(r">(m-\d+)</a>", html)) == sorted(f"m-{index}" for index in range(21))


def test_one_machine_has_no_peers() -> None:
    assert peers(known(6.5), START, "en") == {}


def test_the_events_of_a_week_are_the_newest_first_without_hints_and_older_ones() -> None:
    knowledge = Knowledge()
    day = WEEK / 7.0
    own = [raised(time=START - age * day).model_copy(update={"id": str(age), "end": START - age * day + 60.0})
           for age in (8, 3, 1)]  # fmt: skip
    hint = raised(Level.HINT, START - 2.0 * day).model_copy(update={"id": "hint"})
    still_open = raised(time=START - 30.0 * day).model_copy(update={"id": "open"})
    knowledge.take(*sent(report_of(events=(*own, hint, still_open))), START)
    rows = week(knowledge, START, "en", "UTC")
    assert [row.state for row in rows] == ["OK", "OK", "ACT"]
    assert [row.time[:10] for row in rows] == ["2023-11-13", "2023-11-11", "2023-10-15"]


def test_a_machine_of_incomplete_data_is_named_with_its_reason() -> None:
    knowledge = known(6.5, 6.5, 6.5)
    window = report_of().window
    bad = window.quality.model_copy(update={"verdict": Verdict.BAD, "missing": 0.4, "reasons": ("omega: 40% missing",)})
    own = {"window": window.model_copy(update={"quality": bad})}
    knowledge.take(*sent(report_of("m-1", 2).model_copy(update=own)), START)
    down = {"driver": DriverDocument(up=False, reason="no frame for 5 s")}
    knowledge.take(*sent(report_of("m-2", 2).model_copy(update=down)), START)
    rows = poor_data(knowledge, START, "en", None)
    assert [(row.machine.name, row.missing, row.reason) for row in rows] == [
        ("m-1", "40%", "omega: 40% missing"), ("m-2", "0%", "no frame for 5 s"),
    ]  # fmt: skip
    twice = {"window": window.model_copy(update={"quality": bad.model_copy(update={"reasons": ("no frame for 5 s",)})})}
    knowledge.take(*sent(report_of("m-2", 3).model_copy(update=down | twice)), START)
    assert [row.reason for row in poor_data(knowledge, START, "en", None)] == ["omega: 40% missing", "no frame for 5 s"]
    assert poor_data(knowledge, START + 3600.0, "en", None) == []  # silent: nothing is known of its data
