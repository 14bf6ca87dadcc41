"""Events of what comes and goes, of machines at rest, and of clocks that are set."""

import pytest

from otolith.discovery.alternatives import WindowDecision
from otolith.health.limits import Level
from otolith.health.observations import MIN_RETURNS, PERSISTENT_WINDOWS, RELEASE_WINDOWS
from otolith.health.schema import EventChange, FindingKind, Status
from otolith.health.text import duration_text
from tests.health.test_events import (
    LENGTH,
    NOMINAL,
    SENSOR,
    assessed,
    changes,
    events,
    of_length,
    report,
    sensor_reports,
)


def test_an_open_test_that_a_machine_at_rest_cannot_decide_does_not_clear_the_event_of_a_sensor() -> None:
    undecided = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": ""})
    at_rest = [report(index, findings=(undecided,)) for index in range(10, 100)]
    documents = assessed([*sensor_reports([True] * 10), *at_rest, report(100), report(101), report(102)])
    assert [(index, change) for index, change, _ in changes(documents)] == [
        (PERSISTENT_WINDOWS - 1, EventChange.RAISED),
        (102, EventChange.CLEARED),
    ]


def test_a_fault_that_comes_and_goes_is_raised_again_once_and_stays_until_it_is_mended() -> None:
    """A limit is passed in five of ten windows for ten minutes."""
    broken = 300
    values = [5.8 if index < broken and index % 10 >= 5 else NOMINAL for index in range(broken + 2 * RELEASE_WINDOWS)]
    documents = assessed(report(index, value) for index, value in enumerate(values))
    assert [(index, change) for index, change, _ in changes(documents)] == [
        (7, EventChange.RAISED),
        (12, EventChange.CLEARED),
        (17, EventChange.RAISED),
        (broken + RELEASE_WINDOWS - 1, EventChange.CLEARED),
    ]
    assert documents[broken + RELEASE_WINDOWS - 1].events[0].end == LENGTH * broken


@pytest.mark.parametrize("period", [4, 5, 7])
def test_changes_that_are_gone_before_they_are_an_event_of_their_own_are_one_together(period: int) -> None:
    doubt = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": "", "text": "R_a or V_a"})
    documents = assessed(
        report(index, decision=WindowDecision.SUSPECTED, findings=(doubt,))
        if 20 <= index < 100 and index % period < 2
        else report(index)
        for index in range(200)
    )
    raised, cleared = changes(documents)
    first = next(index for index in range(20, 30) if index % period < 2)
    assert raised == (first - first % period + (MIN_RETURNS - 1) * period, EventChange.RAISED, Level.WATCH)
    assert cleared[1] is EventChange.CLEARED
    assert 99 - period + RELEASE_WINDOWS <= cleared[0] <= 100 + RELEASE_WINDOWS
    event = events(documents[raised[0]])["machine"]
    assert event.condition == "a fault that comes and goes"
    assert event.start == LENGTH * first
    assert event.text.startswith(f"{MIN_RETURNS} times in ")
    assert event.formulas.endswith("R_a or V_a")


@pytest.mark.parametrize("between", ["missed", "bad"])
def test_a_doubt_goes_on_through_windows_that_cannot_be_judged(between: str) -> None:
    """As of a busy computer: one change, of which every second window is missing, does not come and go."""
    doubt = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": "", "text": "R_a or V_a"})
    windows = [report(index) for index in range(20)]
    for index in range(20, 40):
        if index % 2 == 0:
            windows.append(report(index, decision=WindowDecision.SUSPECTED, findings=(doubt,)))
        elif between == "bad":
            windows.append(report(index, decision=WindowDecision.BAD))
    assert changes(assessed([*windows, *(report(index) for index in range(40, 100))])) == []


def test_doubts_about_another_event_are_not_announced_as_well() -> None:
    doubt = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": ""})
    documents = assessed(
        report(index, 5.8, decision=WindowDecision.SUSPECTED, findings=(doubt,))
        if index > 9 and index % 2
        else report(index, 5.8)
        for index in range(60)
    )
    assert [part for document in documents for part in events(document)] == ["winding"] * len(documents[2:])


def test_an_interval_that_holds_the_healthy_value_as_well_says_nothing_about_the_event() -> None:
    """As of a machine at rest: the condition, its text and its advice stay those of the windows that showed it."""
    reports = [report(index, 5.8) for index in range(10)]
    documents = assessed([*reports, *(report(index, 6.4, 0.5) for index in range(10, 30))])
    assert len(changes(documents)) == 1
    before, after = (events(document)["winding"] for document in (documents[9], documents[-1]))
    assert after == before
    assert documents[9].events[0].change is None


def test_times_that_go_back_move_no_begin_and_no_event_ends_before_its_begin() -> None:
    """A log may begin again. What a window knows of the time before is not overwritten."""
    back = 3600.0
    reports = [report(index, 5.8 if 10 <= index < 30 else 6.5) for index in range(40)]
    for index in range(20, 40):
        window = reports[index].window
        moved = window.model_copy(update={"start": window.start - back, "end": window.end - back})
        reports[index] = reports[index].model_copy(update={"window": moved})
    documents = assessed(reports)
    assert [item[1] for item in changes(documents)] == [EventChange.RAISED, EventChange.CLEARED]
    for document in documents:
        assert document.health is not None
        begins = [part.since for part in (document.health, *document.health.parts.values())]
        assert min(begins) >= 0.0
        assert {event.start for event in document.events} <= {20.0}
        assert all(event.end is None or event.end >= event.since for event in document.events)


def test_no_data_that_comes_and_goes_is_no_state_of_windows_that_are_estimated() -> None:
    """The event stays, so that it is not raised again and again; but it says that it is not there at present."""
    last = 50
    documents = assessed(
        report(index, decision=WindowDecision.BAD, status=Status.HELD) if index < last and index % 10 >= 5
        else report(index) for index in range(last + 2 * RELEASE_WINDOWS)
    )  # fmt: skip
    assert [change for _, change, _ in changes(documents)].count(EventChange.RAISED) == 2
    for index, document in enumerate(documents[20:], 20):
        health = document.health
        assert health is not None
        present = {part.state is Level.NO_DATA for part in (health, *health.parts.values())}
        if index % 10 in (3, 4) or index >= last + PERSISTENT_WINDOWS - 1:  # estimated for three windows at least
            assert present == {False}, index
        elif index % 10 in (8, 9) and index < last:
            assert True in present, index
    held = documents[last + PERSISTENT_WINDOWS : last + RELEASE_WINDOWS - 1]
    assert held
    for index, document in enumerate(held, PERSISTENT_WINDOWS + 1):
        (event,) = document.events
        assert event.state is Level.NO_DATA
        assert "not seen for" in event.text
        assert duration_text(LENGTH * index) in event.text
    assert documents[-1].events == ()


def test_an_event_that_is_there_again_says_nothing_of_the_time_without_it() -> None:
    values = [5.8 if index % 10 >= 5 else NOMINAL for index in range(60)]
    documents = assessed(report(index, value) for index, value in enumerate(values))
    texts = [event.text for document in documents[40:] for event in document.events]
    assert any("not seen for" in text for text in texts)
    assert all(text.count("not seen for") <= 1 for text in texts)
    assert "not seen for" not in documents[48].events[0].text


@pytest.mark.parametrize(("pause", "expected"), [(0.3, 0), (1.5, 0), (4.0, 1)])
@pytest.mark.parametrize("length", [0.1, 0.5])
def test_what_is_gone_for_less_than_seconds_is_one_change_however_short_the_windows(
    length: float, pause: float, expected: int
) -> None:
    """A transient of 10 s with windows that agree between is one change; four that are seconds apart come and go."""
    doubt = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": "", "text": "R_a or V_a"})
    between = round(pause / length) + 1
    until = round((10.0 if expected == 0 else 25.0) / length)
    documents = assessed(
        of_length(
            report(index, decision=WindowDecision.SUSPECTED, findings=(doubt,))
            if index < until and index % between == 0
            else report(index),
            length,
        )
        for index in range(until + 20)
    )
    raised = [change for _, change, _ in changes(documents) if change is EventChange.RAISED]
    assert len(raised) == expected
