"""What a site knows of machines: which documents count, which machines keep their place, what becomes of events."""

import json
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.site.known import (
    ESTABLISHED,
    FORGET_AFTER,
    MAX_BYTES,
    MAX_EVENT_ID,
    MAX_EVENT_TEXT,
    MAX_EVENTS,
    MAX_MACHINES,
    MAX_POINTS,
    MAX_TOTAL_BYTES,
    MAX_TRENDS,
    MAX_WINDOW,
    RIVAL_SPAN,
    Knowledge,
    KnownMachine,
    RefusedFor,
    Trace,
)
from tests.hostile import HOSTILE, hostile_text
from tests.sites.machines import raised, report_of, sent
from tests.storage.histories import MACHINE, SITE, START

WINDOW = 2.0  # s, of report_of


def take(knowledge: Knowledge, report: ReportDocument, now: float | None = None) -> KnownMachine | None:
    return knowledge.take(*sent(report), report.window.end if now is None else now)


def only(knowledge: Knowledge) -> KnownMachine:
    (machine,) = knowledge
    return machine


def speak(knowledge: Knowledge, machine: str, count: int, start: float = START) -> None:
    for index in range(count):
        take(knowledge, report_of(machine, index + 1, start + WINDOW * index))


def test_a_report_makes_its_machine_known_with_its_state() -> None:
    knowledge = Knowledge()
    machine = take(knowledge, report_of(state=Level.WATCH))
    assert machine is only(knowledge)
    assert (machine.site, machine.name, machine.state(START)) == (SITE, MACHINE, Level.WATCH)
    assert machine.nearest == ("R_a", 0.0)


@pytest.mark.parametrize(
    ("key", "content", "refusal"),
    [
        (f"otolith/{SITE}/{MACHINE}/report", b"\xff\xfe", RefusedFor.UNREADABLE),
        (f"otolith/{SITE}/{MACHINE}/report", b"{}", RefusedFor.UNREADABLE),
        (f"otolith/{SITE}/{MACHINE}/report", b"[" * 100_000, RefusedFor.UNREADABLE),
        (f"otolith/{SITE}/{MACHINE}/event", sent(report_of())[1], RefusedFor.UNREADABLE),
        (f"otolith/{SITE}/{MACHINE}/report", b" " * MAX_BYTES + sent(report_of())[1], RefusedFor.TOO_LARGE),
        (f"otolith/{SITE}/another/report", sent(report_of())[1], RefusedFor.OTHER_NAME),
        (f"otolith/other/{MACHINE}/report", sent(report_of())[1], RefusedFor.OTHER_NAME),
    ],
)  # fmt: skip
def test_a_document_that_does_not_count_is_counted_by_its_reason(key: str, content: bytes, refusal: RefusedFor) -> None:
    knowledge = Knowledge()
    assert knowledge.take(key, content, START) is None
    assert dict(knowledge.refused) == {refusal: 1}
    assert len(knowledge) == 0


@pytest.mark.parametrize("name", [*HOSTILE[:-1], "..", "", "a" * 65, "*", "**"])
def test_a_name_that_no_machine_file_may_have_is_not_known(name: str) -> None:
    knowledge = Knowledge()
    for key in (f"otolith/{SITE}/{name}/report", f"otolith/{name}/{MACHINE}/report"):
        assert knowledge.take(key, sent(report_of(name))[1], START) is None
        assert knowledge.take_alive(key.replace("/report", "/alive"), START, is_alive=True) is None
    assert len(knowledge) == 0


@given(text=hostile_text)
def test_whatever_a_report_says_is_taken_or_refused(text: str) -> None:
    knowledge = Knowledge()
    for report in forged(text):
        content = json.dumps(report).encode(errors="surrogatepass")
        knowledge.take(f"otolith/{SITE}/{MACHINE}/report", content, START)
    assert knowledge.taken + knowledge.refused.total() == len(list(forged(text)))


def forged(text: str) -> Iterator[dict[str, object]]:
    """Reports with a text in each of the places that may have one."""
    plain = json.loads(report_of(events=(raised(),)).to_json())
    for place in ("twin", "model", "decision", "machine", "parameters", "notes", "events"):
        kind = type(plain.get(place))
        yield {**plain, place: {text: text} if kind is dict else [text] if kind is list else text}
    yield {**plain, "parameters": {text: {**plain["parameters"]["R_a"], "unit": text, "reason": text}}}
    yield {**plain, "events": [{**plain["events"][0], "condition": text, "advice": text, "part": text}]}


def test_a_later_version_may_write_more() -> None:
    knowledge, document = Knowledge(), json.loads(report_of().to_json())
    content = json.dumps(document | {"colour": "blue"}).encode()
    assert knowledge.take(f"otolith/{SITE}/{MACHINE}/report", content, START) is not None


def test_a_machine_is_at_no_data_after_three_windows_without_a_report_and_when_its_daemon_ends() -> None:
    knowledge = Knowledge()
    machine = take(knowledge, report_of())
    assert machine is not None
    assert machine.state(START + 10.0) is Level.OK
    assert machine.state(START + 12.0) is Level.NO_DATA
    knowledge.take_alive(f"otolith/{SITE}/{MACHINE}/alive", START, is_alive=False)
    assert machine.state(START) is Level.NO_DATA
    knowledge.take_alive(f"otolith/{SITE}/{MACHINE}/alive", START, is_alive=True)
    assert machine.state(START) is Level.OK


def test_a_window_of_years_keeps_nobody_from_being_silent() -> None:
    window = report_of().window.model_copy(update={"start": 0.0})
    machine = take(Knowledge(), report_of().model_copy(update={"window": window}))
    assert machine is not None
    assert machine.is_silent(START + 3.0 * MAX_WINDOW + 6.0)


def test_an_answer_about_the_past_is_as_old_as_its_window() -> None:
    knowledge = Knowledge()
    machine = knowledge.take(*sent(report_of()), START + 3600.0, answered=START + 3600.0)
    assert machine is not None
    assert machine.is_silent(START + 3600.0)


def test_an_answer_replaces_no_later_report() -> None:
    knowledge = Knowledge()
    take(knowledge, report_of(number=5, end=START + 10.0, state=Level.ACT))
    knowledge.take(*sent(report_of(number=3)), START + 11.0, answered=START + 11.0)
    assert only(knowledge).state(START + 11.0) is Level.ACT


def test_a_daemon_that_lost_its_numbers_is_heard_again_with_its_second_report() -> None:
    knowledge = Knowledge()
    speak(knowledge, MACHINE, 20)
    assert take(knowledge, report_of(number=1, end=START + 60.0, state=Level.ACT)) is None
    assert take(knowledge, report_of(number=2, end=START + 62.0, state=Level.ACT)) is not None
    assert only(knowledge).state(START + 62.0) is Level.ACT
    assert not only(knowledge).has_rival(START + 62.0)


def test_two_reports_that_come_late_on_two_days_replace_no_later_one() -> None:
    """Only the report after one that was refused shows that a daemon counts anew."""
    knowledge, day = Knowledge(), 86_400.0
    for index in range(2):
        now = START + index * day
        take(knowledge, report_of(number=100 * index + 9, end=now, state=Level.ACT))
        assert take(knowledge, report_of(number=100 * index + 8, end=now - WINDOW), now) is None
    assert only(knowledge).state(now) is Level.ACT


def test_a_forged_number_does_not_silence_a_machine_and_the_conflict_is_seen() -> None:
    """Whatever number a stranger writes, and whether it is once or after each report of the true machine."""
    knowledge, shown = Knowledge(), 0
    for index in range(1, 30):
        now = START + WINDOW * index
        shown += take(knowledge, report_of(number=index, end=now, state=Level.ACT)) is not None
        take(knowledge, report_of(number=10**9 + index, end=now), now)
    assert shown >= 12
    assert only(knowledge).has_rival(now)
    assert not only(knowledge).has_rival(now + RIVAL_SPAN + WINDOW)
    once = Knowledge()
    take(once, report_of(number=10**12))
    for index in range(1, 4):
        take(once, report_of(number=index, end=START + WINDOW * index, state=Level.ACT))
    assert only(once).state(START + 3 * WINDOW) is Level.ACT
    assert not only(once).has_rival(START + 3 * WINDOW)


def test_reports_of_a_replay_have_no_numbers_and_all_count() -> None:
    knowledge = Knowledge()
    assert all(take(knowledge, report_of(number=None, end=START + index)) for index in range(5))


def test_invented_machines_take_no_place_from_those_that_report() -> None:
    knowledge = Knowledge()
    speak(knowledge, "true", ESTABLISHED)
    now = START + WINDOW * ESTABLISHED
    for index in range(3 * MAX_MACHINES):
        take(knowledge, report_of(f"ghost-{index}", end=now + 0.1 * index))
        knowledge.take_alive(f"otolith/{SITE}/alive-{index}/alive", now + 0.1 * index, is_alive=True)
    assert len(knowledge) == MAX_MACHINES
    assert knowledge.get(SITE, "true") is not None
    assert knowledge.refused[RefusedFor.TOO_MANY] + knowledge.forgotten >= 5 * MAX_MACHINES
    late = now + 0.1 * 3 * MAX_MACHINES + 60.0
    assert take(knowledge, report_of("new", end=late)) is not None
    assert len(knowledge) == MAX_MACHINES


def test_a_machine_that_is_off_for_the_week_end_keeps_its_place_and_after_a_week_loses_it() -> None:
    knowledge = Knowledge()
    for index in range(MAX_MACHINES):
        speak(knowledge, f"m-{index}", ESTABLISHED)
    assert take(knowledge, report_of("new", end=START + FORGET_AFTER / 2.0)) is None
    assert take(knowledge, report_of("new", end=START + FORGET_AFTER + 60.0)) is not None
    assert len(knowledge) == MAX_MACHINES


def test_a_site_that_names_its_machines_takes_no_others_and_shows_who_never_reports() -> None:
    knowledge = Knowledge([f"{SITE}/{MACHINE}", f"{SITE}/press-4"])
    assert take(knowledge, report_of("ghost")) is None
    assert take(knowledge, report_of()) is not None
    assert {machine.name: machine.state(START) for machine in knowledge} == {
        MACHINE: Level.OK, "press-4": Level.NO_DATA,
    }  # fmt: skip


def test_large_reports_do_not_fill_the_memory() -> None:
    knowledge, content = Knowledge(), {}
    for index in range(MAX_TOTAL_BYTES // MAX_BYTES + 50):
        report = report_of(f"m-{index}").model_copy(update={"notes": ("x" * (MAX_BYTES - 4000),)})
        content[report.machine] = len(sent(report)[1])
        take(knowledge, report)
    assert sum(content[machine.name] for machine in knowledge) <= MAX_TOTAL_BYTES
    assert knowledge.refused[RefusedFor.TOO_MANY] > 0


def test_a_curve_and_the_events_of_a_machine_are_bounded() -> None:
    knowledge = Knowledge()
    for index in range(2 * MAX_EVENTS):
        own = raised(time=START + index).model_copy(update={"id": f"limit/R_a@{index}"})
        take(knowledge, report_of(number=index + 1, end=START + index, events=(own,)))
    machine = only(knowledge)
    assert len(machine.events) == MAX_EVENTS
    assert min(event.start for event in machine.events.values()) == START + MAX_EVENTS
    many = {f"p{index}": report_of().parameters["R_a"] for index in range(3 * MAX_TRENDS)}
    take(knowledge, report_of(number=500, end=START + 900.0).model_copy(update={"parameters": many}))
    assert len(machine.trends) == MAX_TRENDS


def test_the_texts_of_events_do_not_fill_the_memory() -> None:
    """Nobody writes an id of such a length, and of a long text its begin says what it is about."""
    knowledge = Knowledge()
    texts = ("part", "condition", "condition_id", "text", "cause", "advice", "setting", "formulas", "source", "reason")
    note = {"by": "x" * 5000, "at": START, "text": "x" * 5000}
    content = json.loads(raised().model_dump_json(exclude_none=True)) | dict.fromkeys(texts, "x" * 5000)
    content |= {"acknowledged": note, "comments": [note] * 9}
    key = f"otolith/{SITE}/{MACHINE}/event"
    assert knowledge.take(key, json.dumps(content).encode(), START) is not None
    (event,) = only(knowledge).events.values()
    assert event.text == "x" * MAX_EVENT_TEXT
    assert len(event.model_dump_json()) < 8 * MAX_EVENT_TEXT
    content["id"] = "x" * (MAX_EVENT_ID + 1)
    assert knowledge.take(key, json.dumps(content).encode(), START) is None
    report = report_of(number=2, events=(raised().model_copy(update={"id": content["id"]}),))
    assert take(knowledge, report) is None
    assert knowledge.refused == {RefusedFor.TOO_LARGE: 2}


def test_of_too_many_events_those_that_are_over_go_first() -> None:
    knowledge = Knowledge()
    first = raised(time=START).model_copy(update={"id": "open", "start": START})
    for index in range(2 * MAX_EVENTS):
        time = START + 1.0 + index
        over = raised(time=time).model_copy(update={"id": f"over@{index}", "start": time, "end": time})
        take(knowledge, report_of(number=index + 1, end=time, events=(first, over)))
    assert len(only(knowledge).events) == MAX_EVENTS
    assert only(knowledge).events["open"].end is None


@given(st.lists(st.floats(0.1, 4000.0), min_size=1, max_size=400))
def test_a_curve_has_few_points_in_the_order_of_time_and_ends_near_the_last(pauses: list[float]) -> None:
    trend, time = Trace(), START
    for pause in pauses:
        time += pause
        trend.add(time, time)
    assert 1 <= len(trend.times) <= MAX_POINTS
    assert list(trend.times) == sorted(trend.times) == list(trend.values)
    assert time - trend.times[-1] <= max(trend.pause, 1e-9) + max(pauses)


def test_an_event_of_which_the_end_was_missed_ends() -> None:
    knowledge = Knowledge()
    take(knowledge, report_of(number=1, events=(raised(),)))
    take(knowledge, report_of(number=9, end=START + 16.0))
    (event,) = only(knowledge).events.values()
    assert event.end == START + 14.0


def test_the_worst_comes_first_and_of_equals_the_one_that_waits_for_longest() -> None:
    knowledge = Knowledge()
    for name, state in (("a", Level.OK), ("b", Level.ACT), ("c", Level.WATCH), ("d", Level.ACT)):
        take(knowledge, report_of(name, state=state))
    health = report_of(state=Level.ACT).health
    assert health is not None
    take(knowledge, report_of("e").model_copy(update={"health": health.model_copy(update={"since": 0.0})}))
    knowledge.take_alive(f"otolith/{SITE}/f/alive", START, is_alive=True)
    assert "".join(machine.name for machine in knowledge.worst_first(START)) == "ebdcfa"


def test_machines_that_are_well_are_ordered_as_people_count() -> None:
    knowledge = Knowledge()
    for number in (10, 2, 1):
        report = report_of(f"press-{number}")
        assert report.health is not None
        health = report.health.model_copy(update={"since": float(number % 10)})  # since when is not shown
        take(knowledge, report.model_copy(update={"health": health}))
    assert [machine.name for machine in knowledge.worst_first(START)] == ["press-1", "press-2", "press-10"]
