"""Hints: what is wrong in the machine file is told to the specialist once, and is the state of no part."""

from collections.abc import Sequence
from dataclasses import replace
from io import StringIO

import pytest
from rich.console import Console

from otolith.cli.operation.live_table import LiveTable
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import Outcome
from otolith.health.diagnosis import FindingFeatures, OwnRule, Rule, severity
from otolith.health.events import KNOWN_WINDOWS, HealthState, assess
from otolith.health.limits import Level
from otolith.health.schema import (
    EventChange,
    FindingDocument,
    FindingKind,
    FitDocument,
    HealthDocument,
    Language,
    ReportDocument,
    Severity,
    Status,
)
from otolith.health.text import event_text, headline, texts_in
from otolith.machine import load_rules
from otolith.publishing.recorder import operator_text, report_text
from tests.health.test_events import LENGTH, PLAN, assessed, changes, report

FIT = FitDocument(
    rmse_configured={}, rmse_estimated={}, explained=True, cost=1.0, variance_ratio=1.0, outcome=Outcome.CONTINUED
)
SETTING = 'write delay = "9.7 ms" under every other signal in [signals]'


def late(since: float, kind: FindingKind = FindingKind.TIMING, *, of_file: bool = False) -> FindingDocument:
    return FindingDocument(
        id=f"{kind}/V_a", kind=kind, subject="V_a", severity=Severity.WARNING, condition="c", since=since,
        text="V_a is 9.7 ms early (9 to 10)", setting=SETTING, of_file=of_file,
    )  # fmt: skip


def agreeing(count: int, first: int = 0, status: Status = Status.ESTIMATED) -> list[ReportDocument]:
    """Windows in which the signals are as the machine file says."""
    windows = (report(index, status=status) for index in range(first, first + count))
    return [window.model_copy(update={"fit": FIT}) for window in windows]


def with_finding(finding: FindingDocument, first: int, count: int = 8) -> list[ReportDocument]:
    return [report(index, findings=(finding,)) for index in range(first, first + count)]


def health_of(document: ReportDocument) -> HealthDocument:
    assert document.health is not None
    return document.health


def shown(document: ReportDocument, *, details: bool, width: int = 120) -> str:
    console = Console(file=StringIO(), width=width)
    table = LiveTable(lambda: "", details=details)
    table.add(document.to_json())
    console.print(table)
    assert isinstance(console.file, StringIO)
    return " ".join(console.file.getvalue().split())


@pytest.mark.parametrize("kind", [FindingKind.TIMING, FindingKind.NOISE, FindingKind.POLLED])
def test_what_was_so_from_the_start_is_a_hint_and_no_state(kind: FindingKind) -> None:
    last = assessed([*agreeing(KNOWN_WINDOWS - 1), *with_finding(late(0.0, kind), KNOWN_WINDOWS - 1)])[-1]
    (hint,) = last.hints
    assert (hint.state, hint.setting) == (Level.HINT, SETTING)
    assert last.open_events == ()
    assert {part.state for part in health_of(last).parts.values()} == {health_of(last).state} == {Level.OK}
    assert health_of(last).reason == ""


@pytest.mark.parametrize(("kind", "part"), [(FindingKind.TIMING, "bus"), (FindingKind.NOISE, "sensors")])
def test_what_begins_after_the_signals_agreed_for_long_is_a_change(kind: FindingKind, part: str) -> None:
    since = LENGTH * KNOWN_WINDOWS
    last = assessed([*agreeing(KNOWN_WINDOWS), *with_finding(late(since, kind), KNOWN_WINDOWS)])[-1]
    assert [(event.part, event.state) for event in last.events] == [(part, Level.WATCH)]
    assert health_of(last).state is Level.WATCH
    only_file = with_finding(late(since, kind, of_file=True), KNOWN_WINDOWS)
    assert assessed([*agreeing(KNOWN_WINDOWS), *only_file])[-1].hints


def test_parameters_that_are_never_determined_at_once_do_not_keep_a_change_a_hint() -> None:
    def one_of_two(index: int) -> ReportDocument:
        (window,) = agreeing(1, index)
        own = window.parameters["R_a"]
        held = own.model_copy(update={"status": Status.HELD})
        both = {"R_a": own, "J": held} if index % 5 else {"R_a": held, "J": own}
        return window.model_copy(update={"parameters": both})

    rare = 5 * KNOWN_WINDOWS - 4  # windows in which J is determined for the last time that is needed
    early = [*map(one_of_two, range(rare - 1)), *with_finding(late(LENGTH * (rare - 1)), rare - 1)]
    assert assessed(early)[-1].hints
    last = assessed([*map(one_of_two, range(rare)), *with_finding(late(LENGTH * rare), rare)])[-1]
    assert [(event.part, event.state) for event in last.open_events] == [("bus", Level.WATCH)]


def test_windows_that_may_hide_a_delay_do_not_show_that_there_was_none() -> None:
    """At a constant speed no parameter of the dynamics is determined, and no delay is seen."""
    still = agreeing(2 * KNOWN_WINDOWS, status=Status.HELD)
    assert assessed([*still, *with_finding(late(LENGTH * len(still)), len(still))])[-1].hints


def test_a_hint_is_given_once() -> None:
    """The finding comes and goes with the excitation."""
    windows: list[ReportDocument] = []
    for first in range(0, 400, 20):
        windows += [*with_finding(late(0.0), first, 5), *agreeing(15, first + 5)]
    assert [change[1:] for change in changes(assessed(windows))] == [(EventChange.RAISED, Level.HINT)]


def test_a_hint_hides_no_fault_that_comes_and_goes() -> None:
    def unsteady(index: int) -> ReportDocument:
        return report(index, decision=WindowDecision.SUSPECTED if index % 5 == 0 else WindowDecision.LEARNED)

    last = assessed([*with_finding(late(0.0), 0), *map(unsteady, range(8, 41))])[-1]
    assert [(event.part, event.condition_id) for event in last.open_events] == [("machine", "returns")]
    assert last.hints


def test_a_report_says_whether_what_begins_now_is_a_change() -> None:
    reports = assessed([*agreeing(KNOWN_WINDOWS), *with_finding(late(LENGTH * KNOWN_WINDOWS), KNOWN_WINDOWS)])
    flags = [health_of(document).has_agreed for document in reports]
    assert flags == [None] * (KNOWN_WINDOWS - 1) + [True] * 9
    state = _state_after(agreeing(KNOWN_WINDOWS)).without_hints("the noise in the machine file has changed")
    assert health_of(assessed(agreeing(1, KNOWN_WINDOWS), state)[-1]).has_agreed is None


def test_another_machine_file_drops_the_hints_of_the_one_before() -> None:
    windows = [*agreeing(KNOWN_WINDOWS), *with_finding(late(0.0), KNOWN_WINDOWS)]
    state = _state_after(windows)
    assert state.known_since is not None
    state = state.without_hints("the noise in the machine file has changed")
    assert state.known_since is None
    after = assessed(agreeing(1, len(windows)), state)[-1]
    (event,) = after.events
    assert (event.change, event.reason) == (EventChange.CLEARED, "the noise in the machine file has changed")


def _state_after(windows: Sequence[ReportDocument]) -> HealthState:
    state = HealthState()
    for window in windows:
        state, _ = assess(PLAN, state, window)
    return state


@pytest.mark.parametrize("language", ["en", "de"])
def test_hints_are_for_the_specialist_alone(language: Language) -> None:
    plan = replace(PLAN, language=language, rules=load_rules(language))
    last = assessed(with_finding(late(0.0), 0), plan=plan)[-1]
    (hint,) = last.hints
    assert hint.setting in event_text(hint, details=True)
    assert hint.setting not in event_text(hint)
    word = texts_in(hint.language).translated(Level.HINT)
    for text in (headline(health_of(last)), operator_text(last), shown(last, details=False)):
        assert word not in text
        assert "delay" not in text
    for text in (report_text(last), shown(last, details=True)):
        assert word in text
        assert "delay" in text


def test_what_to_do_has_no_line_of_the_machine_file() -> None:
    """A frozen sensor is an event of the operator; how its check is turned off is not."""
    last = assessed(with_finding(late(0.0, FindingKind.SENSOR), 0))[-1]
    (event,) = last.open_events
    assert event.setting == SETTING
    assert "delay" not in event.advice + event.cause + event.condition + operator_text(last)
    assert "delay" not in shown(last, details=False)
    assert "delay" in shown(last, details=True)


def test_only_rules_about_the_machine_file_are_hints() -> None:
    assert {rule.id for rule in load_rules() if rule.severity == "HINT"} == {
        "early-signal", "early-signal-from-start", "late-signal-from-start", "noise-from-start", "polled-command",
        "winding-colder", "magnets-colder",
    }  # fmt: skip


def test_a_class_is_a_hint_only_if_each_member_is() -> None:
    def rows(*levels: str) -> list[Rule]:
        texts = {"condition": "c", "cause": "c", "advice": "a", "source": "s"}
        return [Rule.model_validate({"id": level, "finding": "noise", "severity": level, **texts}) for level in levels]

    features = FindingFeatures(FindingKind.NOISE)
    assert severity(rows("HINT"), features) is Level.HINT
    assert severity(rows("HINT", "WATCH"), features) is Level.WATCH
    own = OwnRule.model_validate(
        {"id": "own", "finding": "class", "severity": "HINT", "condition": "c", "cause": "c", "advice": "a"}
    )
    assert own.severity == "HINT"
