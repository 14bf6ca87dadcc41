"""Report texts: values with interval and unit, findings, and the summary line of the daemon's log."""

import re

import pytest

from otolith.discovery.hypotheses import FaultType
from otolith.health.limits import MACHINE, Level
from otolith.health.schema import (
    LANGUAGES,
    AlternativeDocument,
    DriverDocument,
    EventChange,
    EventDocument,
    EvidenceDocument,
    FindingDocument,
    FindingKind,
    HealthDocument,
    Language,
    ParameterDocument,
    PartDocument,
    Severity,
    Status,
)
from otolith.health.text import (
    announcements,
    brief,
    event_text,
    finding_text,
    headline,
    summary,
    texts_in,
    undecided_text,
    value_cells,
    value_text,
)
from otolith.health.times import moment_text
from tests.health.test_events import report
from tests.messages import assert_says

ESTIMATED = ParameterDocument(value=5.98561, sd=0.00382, unit="ohm", nominal=6.5, status=Status.ESTIMATED)
UNKNOWN = ParameterDocument(unit="ohm", nominal=6.5, status=Status.UNESTIMATED, reason="no current")
LEAK = FindingDocument(
    id="s/f",
    kind=FindingKind.COMPONENT,
    severity=Severity.FAULT,
    condition="leak",
    text="a leak",
    since=0.0,
    advice="close it",
)


def test_value_text_has_unit_and_95_percent_interval() -> None:
    assert value_text(ESTIMATED) == "5.9856 ± 0.0075 Ω"
    assert value_cells(ESTIMATED) == ("5.9856", "0.0075", "Ω", "-7.91%")


def test_unknown_value_text_has_no_number() -> None:
    assert value_text(UNKNOWN) == "unknown"
    assert value_cells(UNKNOWN) == ("unknown", "", "Ω", "")


@pytest.mark.parametrize("value", [6.5001, 6.4999])
def test_zero_change_text_has_no_sign(value: float) -> None:
    assert value_cells(ESTIMATED.model_copy(update={"value": value}))[3] == "0.00%"


def test_finding_text_has_severity_and_advice() -> None:
    assert finding_text(LEAK) == "fault: a leak; close it"
    assert finding_text(LEAK.model_copy(update={"advice": ""})) == "fault: a leak"


def test_summary_is_one_line_with_reasons_and_warnings() -> None:
    driver = DriverDocument(up=False, reason="unplugged", warnings=("slow", "late", "odd"))
    document = report(3).model_copy(
        update={"parameters": {"R_a": ESTIMATED, "L_a": UNKNOWN}, "findings": (LEAK,), "driver": driver}
    )
    assert summary(document) == (
        "window 3 good, R_a 5.9856 ± 0.0075 Ω, L_a unknown (unestimated: no current), fault: a leak; close it, "
        "no connection: unplugged, slow, and 2 more warnings"
    )


def test_a_line_does_not_repeat_what_the_line_before_has_said() -> None:
    driver = DriverDocument(up=True, warnings=("slow",))
    update = {"parameters": {"R_a": ESTIMATED, "L_a": UNKNOWN}, "findings": (LEAK,), "driver": driver}
    first, second = (report(index).model_copy(update=update) for index in (3, 4))
    assert summary(second, first) == "window 4 good, R_a 5.9856 ± 0.0075 Ω, L_a unknown, 2 as before"
    other = second.model_copy(update={"driver": DriverDocument(up=True, warnings=("late",))})
    assert summary(other, first).endswith("late, 1 as before")


@pytest.mark.parametrize("level", Level)
@pytest.mark.parametrize("language", LANGUAGES)
def test_lines_of_the_log_have_the_state_as_people_read_it(level: Level, language: Language) -> None:
    health = HealthDocument(state=level, since=0.0, reason="", parts={}, language=language)
    document = report(3).model_copy(update={"health": health})
    word = {Level.NO_DATA: "UNKNOWN"}.get(level, level.value)
    assert summary(document).startswith(f"{word}, window 3")
    assert f" {word} window 3" in brief(document)


EVENT = EventDocument(
    id="limit/R_a@54.0",
    part="winding",
    state=Level.ACT,
    change=EventChange.RAISED,
    start=54.0,
    since=74.0,
    condition="short circuit between turns",
    text="R_a is 5.9 ohm",
    advice="plan a replacement",
    evidence=EvidenceDocument(windows=(27, 39), probability=0.984),
)


def test_an_event_is_one_sentence_with_state_begin_certainty_and_advice() -> None:
    assert event_text(EVENT) == (
        "ACT: winding: short circuit between turns since t = 74 s: R_a is 5.9 ohm "
        "(beyond the limit with 98.4 % probability); plan a replacement"
    )
    certain = EVENT.model_copy(update={"evidence": EvidenceDocument(windows=(27, 39), probability=1.0)})
    assert "(beyond the limit with over 99.9 % probability)" in event_text(certain)


def test_a_cleared_event_has_begin_and_end() -> None:
    cleared = EVENT.model_copy(update={"change": EventChange.CLEARED, "end": 90.0})
    assert event_text(cleared) == "cleared: winding: short circuit between turns, from t = 54 s to t = 90 s"


def test_the_headline_names_the_parts_in_the_state_of_the_machine() -> None:
    parts = {
        "winding": PartDocument(state=Level.ACT, since=74.0, reason="short circuit between turns"),
        "shaft": PartDocument(state=Level.OK, since=0.0),
    }
    health = HealthDocument(state=Level.ACT, since=74.0, parts=parts)
    assert headline(health) == "ACT since t = 74 s: winding: short circuit between turns"
    assert headline(HealthDocument(state=Level.OK, since=0.0, parts=parts)) == "OK since t = 0 s"


def of_parts(state: Level, **reasons: str) -> HealthDocument:
    parts = {name: PartDocument(state=state, since=74.0, reason=reason) for name, reason in reasons.items()}
    return HealthDocument(state=state, since=74.0, parts=parts)


def test_the_headline_gives_a_reason_once() -> None:
    down = of_parts(Level.NO_DATA, winding="no usable data", shaft="no usable data", bus="no usable data")
    assert headline(down).count("no usable data") == 1
    assert "winding" not in headline(down)  # it is so everywhere
    well = {**down.parts, "sensors": PartDocument(state=Level.OK, since=0.0)}
    assert "winding, shaft, bus: no usable data" in headline(down.model_copy(update={"parts": well}))


def test_the_headline_does_not_repeat_events_that_have_lines_of_their_own() -> None:
    health = of_parts(Level.ACT, winding=EVENT.condition)
    assert EVENT.condition in headline(health)
    assert headline(health, events=(EVENT,)) == "ACT since t = 74 s"
    assert "worn" in headline(of_parts(Level.ACT, winding=EVENT.condition, shaft="worn"), events=(EVENT,))


def unknown(names: str) -> PartDocument:
    own = tuple(names.split(", "))
    return PartDocument(state=Level.NO_DATA, since=0.0, reason=f"not determined yet: {names}", undetermined=own)


def test_what_is_not_determined_is_said_once() -> None:
    parts = {"winding": unknown("R_a"), "shaft": unknown("J"), "bearing": unknown("D, T_c")}
    text = headline(HealthDocument(state=Level.NO_DATA, since=0.0, parts=parts, undetermined=("R_a",)))
    assert text.endswith(": not determined yet: R_a, J, D, T_c")
    assert text.count("determined") == 1


def test_a_state_of_the_daemon_hides_no_missing_data() -> None:
    failing = PartDocument(state=Level.WATCH, since=9.0, reason="the daemon cannot write")
    health = HealthDocument(state=Level.WATCH, since=9.0, parts={"winding": unknown("R_a"), "daemon": failing})
    assert_says(headline(health), "WATCH", "daemon: the daemon cannot write", "UNKNOWN", "winding", "R_a")
    told = EVENT.model_copy(update={"state": Level.WATCH, "condition": failing.reason})
    assert_says(headline(health, events=(told,)), "WATCH", "UNKNOWN", "winding", "R_a")
    assert "UNKNOWN" not in headline(of_parts(Level.ACT, winding="worn"))


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_whole_machine_and_the_rest_of_it_have_different_names(language: Language) -> None:
    texts = texts_in(language)
    assert len({texts.part(""), texts.part(MACHINE), texts.part("winding"), texts.translated("parameter")}) == 4


def test_while_undecided_there_is_one_line_without_formulas() -> None:
    formulas = "; or ".join(f"COMPONENT: shaft: 0.00{n}·sin(1·θ) N·m (33%)" for n in (1, 2, 3))
    finding = LEAK.model_copy(
        update={"id": "undecided", "kind": FindingKind.OPEN, "condition": "new torque on the shaft", "text": formulas,
                "since": 74.0})  # fmt: skip
    causes = tuple(
        AlternativeDocument(reason=FaultType.COMPONENT, text=text, probability=0.3) for text in formulas.split("; or ")
    )
    document = report(3).model_copy(update={"findings": (finding,), "explanations": causes})
    text = undecided_text(document)
    assert_says(text, "new torque on the shaft", "since t = 74 s", "not yet known", "3 possible causes")
    assert "sin(" not in text
    assert undecided_text(report(3)) == ""
    unexplained = document.model_copy(update={"explanations": ()})
    assert "candidate" not in undecided_text(unexplained)


@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_a_brief_line_has_time_state_and_at_most_100_characters(count: int) -> None:
    named = {f"a_rather_long_name_{index}": ESTIMATED for index in range(count)}
    health = of_parts(Level.OK, winding="")
    document = report(3).model_copy(update={"parameters": named, "health": health})
    line = brief(document)
    assert len(line) <= 100
    assert_says(line, moment_text(document.window.end), "OK", "window 3")
    assert line.count("Ω") + int(next(iter(re.findall(r"and (\d+) more", line)), 0)) == count


def test_only_a_change_is_announced() -> None:
    document = report(3).model_copy(update={"events": (EVENT, EVENT.model_copy(update={"change": None}))})
    assert announcements(document) == [EVENT]
