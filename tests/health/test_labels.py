"""Unix times as labels: each time in a report has one, and a time is found by its label."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.health.labels import MAX_SPANS, TimeLabels, baseline_event, clock_event, expiry_event
from otolith.health.limits import Level
from otolith.health.schema import (
    CrossingDocument,
    EventChange,
    ForecastDocument,
    HealthDocument,
    PartDocument,
    ReportDocument,
)
from otolith.health.text import event_text, texts_in
from tests.messages import assert_says
from tests.storage.histories import START, document

TIME = st.floats(-1e9, 1e9).map(lambda value: round(value, 3))
SPANS = st.lists(st.tuples(TIME, TIME), max_size=6, unique_by=lambda span: span[0]).map(
    lambda spans: TimeLabels(tuple(sorted(spans)))
)


def numbers(content: Any, place: str = "") -> Iterator[tuple[str, float]]:
    """All numbers in a JSON document, with their places."""
    if isinstance(content, dict | list):
        for key, item in content.items() if isinstance(content, dict) else enumerate(content):
            yield from numbers(item, f"{place}.{key}")
    elif isinstance(content, int | float):
        yield place, float(content)


def test_every_time_in_a_report_gets_its_label() -> None:
    report = document(51, START, change=EventChange.RAISED)
    crossing = CrossingDocument(limit=6.0, at=START + 9.0, low=START + 8.0, high=START + 10.0)
    forecast = ForecastDocument(computed=START, family="linear", watch=crossing, act=crossing)
    parameter = report.parameters["R_a"].model_copy(update={"forecast": forecast})
    part = PartDocument(state=Level.OK, since=START - 5.0)
    event = report.events[0].model_copy(update={"end": START})
    report = report.model_copy(
        update={
            "parameters": {"R_a": parameter},
            "events": (event,),
            "health": HealthDocument(**dict(part), parts={"winding": part}),
        }
    )
    labelled = TimeLabels(((START - 100.0, 3600.0),)).of_report(report)
    before, after = (dict(numbers(json.loads(item.to_json()))) for item in (report, labelled))
    times = {place for place, number in before.items() if number > 1e9}
    assert len(times) > 12
    assert {place for place in before if after[place] != before[place]} == times
    assert all(after[place] - before[place] == 3600.0 for place in times)
    assert ReportDocument.from_json(labelled.to_json()) == labelled
    assert TimeLabels().of_report(report) is report


@given(SPANS, TIME)
def test_a_time_is_found_by_its_label(labels: TimeLabels, unix: float) -> None:
    first, last = labels.first(unix), labels.last(unix)
    times = np.concatenate([[begin, begin - 1e-3] for begin, _ in labels.spans] or [[unix]])
    times = np.concatenate([times, [first, last, first - 1e-3, last + 1e-3]])
    for time in times:
        assert labels.unix(time) < unix + 1e-6 or time >= first
        assert labels.unix(time) > unix - 1e-6 or time <= last + 1e-6


@given(SPANS, TIME, TIME)
def test_a_shift_moves_the_labels_from_then_on_and_no_others(labels: TimeLabels, since: float, by: float) -> None:
    shifted = labels.shifted(since, by)
    assert shifted.is_plausible
    for time in [since, since - 1.0, *(begin for begin, _ in labels.spans)]:
        expected = labels.unix(time) + (by if time >= since else 0.0)
        assert shifted.unix(time) == pytest.approx(expected, abs=1e-6)


def test_of_too_many_labels_those_that_differ_least_are_joined() -> None:
    labels = TimeLabels()
    for index in range(3 * MAX_SPANS):
        labels = labels.since(10.0 * index, 1000.0 * index + (1.0 if index == 7 else 0.0))
        assert labels.is_plausible
    assert labels.unix(1e6) == 1e6 + 1000.0 * (3 * MAX_SPANS - 1)
    assert not TimeLabels(((2.0, 1.0), (1.0, 2.0))).is_plausible


def test_the_event_of_a_clock_that_was_set_says_by_how_much() -> None:
    event = clock_event(START, 3600.0, 7, "en")
    assert (event.change, event.end, event.evidence.value) == (EventChange.NOTED, START, 3600.0)
    assert "+3600 s" in event_text(event)
    assert "+3600 s" in event_text(clock_event(START, 3600.0, 7, "de"))
    assert "-31536000 s" in event_text(clock_event(START, -31_536_000.0, 7, "en"))


def test_the_event_of_a_certificate_names_it_and_its_end_in_each_language() -> None:
    for language in ("en", "de"):
        event = expiry_event(START, "press.crt", 1_801_353_600.0, 7, language)
        assert (event.change, event.end, event.state, event.part) == (EventChange.NOTED, START, Level.OK, "daemon")
        assert_says(event_text(event), "press.crt", "2027-01-31")


def test_the_hint_of_a_baseline_that_waits_is_the_matter_of_a_specialist_in_each_language() -> None:
    for language in ("en", "de"):
        for key in ("baseline_waits", "baseline_is_of_other_values"):
            text = texts_in(language)(key, names="R_a", file="motor.toml")
            event = baseline_event(START, text, 7, language)
            assert (event.change, event.end, event.is_silent) == (EventChange.NOTED, START, True)
            assert_says(event_text(event), "R_a", "motor.toml")
