"""How severe a condition is: what it does to the numbers of the machine, for how long, and what is not known."""

from dataclasses import replace

import pytest

from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import Outcome
from otolith.health.diagnosis import Rule
from otolith.health.events import HealthState
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.schema import EventChange, FindingKind, FitDocument, ParameterDocument, Status
from tests.health.test_events import (
    NOMINAL,
    PLAN,
    RESISTANCE,
    SHAFT,
    assessed,
    changes,
    finding,
    report,
    state_of,
    unbalance,
    undecided,
)
from tests.messages import assert_says


@pytest.mark.parametrize(("length", "expected"), [(0.25, 8), (0.5, 4), (1.0, 3), (2.0, 3)])
def test_short_windows_must_agree_for_seconds(length: float, expected: int) -> None:
    """Three windows of a quarter of a second are 0.75 s: a start takes longer."""
    documents = []
    for index in range(12):
        window = report(index).window.model_copy(update={"start": length * index, "end": length * (index + 1)})
        documents.append(report(index, 5.9).model_copy(update={"window": window}))
    assert [item[0] for item in changes(assessed(documents))] == [expected - 1]


def test_a_component_within_three_standard_deviations_is_no_event() -> None:
    """Seen: an amplitude of −47.6e-9 N·m ± 47e-9, to act on."""
    plan = replace(PLAN, sites={"shaft": replace(SHAFT, limits=())})
    for size, expected in ((2.1, []), (3.5, [EventChange.RAISED])):
        documents = assessed((report(index, components=(unbalance(size * 1e-5),)) for index in range(10)), plan=plan)
        assert [item[1] for item in changes(documents)] == expected


@pytest.mark.parametrize("decision", [WindowDecision.SENSOR, WindowDecision.TIMING])
def test_a_class_of_causes_ends_when_one_is_named(decision: WindowDecision) -> None:
    several = [undecided(index, WindowDecision.AMBIGUOUS, FindingKind.CLASS) for index in range(10)]
    fit = FitDocument(
        rmse_configured={}, rmse_estimated={}, explained=True, cost=1.0, variance_ratio=1.0, outcome=Outcome.AGREED
    )
    named = report(10, decision=decision).model_copy(update={"fit": fit})
    assert changes(assessed([*several, named]))[-1][:2] == (10, EventChange.CLEARED)
    refused = report(10, decision=decision)  # by the checks of the data: nothing is decided
    assert changes(assessed([*several, refused]))[-1][1] is EventChange.RAISED


@pytest.mark.parametrize(
    ("error", "level"), [(0.01, Level.WATCH), (-0.01, Level.WATCH), (0.2, Level.ACT), (None, Level.ACT)]
)
def test_the_severity_of_a_wrong_sensor_is_what_it_does_to_the_numbers(error: float | None, level: Level) -> None:
    """An error of 1 % moves no parameter beyond a limit 8 % away; a frozen signal has no size of its error."""
    wrong = finding(FindingKind.SENSOR, "i", 0.0).model_copy(update={"error": error})
    documents = assessed(report(index, findings=(wrong,)) for index in range(6))
    assert [item[2] for item in changes(documents)] == [level]


def test_a_wrong_command_is_no_broken_sensor() -> None:
    wrong = finding(FindingKind.SENSOR, "V_a", 0.0).model_copy(update={"error": 0.5})
    plan = replace(PLAN, commands=frozenset({"V_a"}))
    (event,) = assessed((report(index, findings=(wrong,)) for index in range(6)), plan=plan)[-1].events
    assert event.state is Level.WATCH
    assert_says(event.condition, "command")


@pytest.mark.parametrize(("delay", "level"), [(-0.005, Level.HINT), (0.005, Level.WATCH)])
def test_an_early_signal_is_a_matter_of_the_machine_file(delay: float, level: Level) -> None:
    """Nothing arrives before it was measured; a signal that becomes late is a change of the path of its data."""
    late = finding(FindingKind.TIMING, "A_valve", 100.0).model_copy(update={"error": delay})
    state = replace(HealthState(), known_since=50.0)
    documents = assessed((report(index, findings=(late,)) for index in range(60, 66)), state)
    assert [item[2] for item in changes(documents)] == [level]


@pytest.mark.parametrize(("kind", "subject"), [(FindingKind.TIMING, "A_valve"), (FindingKind.SENSOR, "i")])
def test_a_rule_of_the_machine_file_says_itself_how_severe_its_finding_is(kind: FindingKind, subject: str) -> None:
    """A delay of 20 ms is no error of 2 %; and a sensor that protects the machine may be off by no more than that."""
    texts = {"condition": "c", "cause": "c", "advice": "a", "source": "s"}
    own = Rule.model_validate({"id": "own", "finding": kind, "severity": "ACT", "is_own": True, **texts})
    wrong = finding(kind, subject, 0.0).model_copy(update={"error": 0.02})
    plan = replace(PLAN, rules=(own, *PLAN.rules))
    documents = assessed((report(index, findings=(wrong,)) for index in range(6)), plan=plan)
    assert [item[2] for item in changes(documents)] == [Level.ACT]


def test_a_part_with_a_limit_that_nothing_was_judged_by_is_not_well() -> None:
    """The friction of a guide rose by 70 %, and no window had ever determined it."""
    friction = MonitoredQuantity("winding", "friction", "N", 20.0, (Limit(Level.ACT, 30.0, False),))
    plan = replace(PLAN, parameters={"R_a": RESISTANCE, "F_c": friction})
    unknown = ParameterDocument(unit="N", nominal=20.0, status=Status.UNESTIMATED)
    documents = [report(index) for index in range(6)]
    documents = [item.model_copy(update={"parameters": {**item.parameters, "F_c": unknown}}) for item in documents]
    last = assessed(documents, plan=plan)[-1]
    assert last.health is not None
    assert last.health.parts["winding"].state is Level.NO_DATA
    assert last.health.parts["winding"].undetermined == ("F_c",)
    assert state_of(assessed(report(index) for index in range(6))[-1], "winding") is Level.OK


def test_a_value_that_may_be_healthy_says_nothing_and_one_that_is_ends_the_event() -> None:
    """Seen: "still near its limit" at +0.0 %, and to stop the machine."""
    low = [report(index, 5.9) for index in range(6)]
    vague = [report(index, NOMINAL, 0.6) for index in range(6, 16)]
    documents = assessed([*low, *vague])
    assert [item[1] for item in changes(documents)] == [EventChange.RAISED]
    assert documents[-1].events[0].text == documents[5].events[0].text
    clear = [report(index, NOMINAL, 0.05) for index in range(16, 20)]
    assert changes(assessed([*low, *vague, *clear]))[-1][1] is EventChange.CLEARED


def test_a_wrong_sensor_at_act_does_not_come_and_go_with_its_signal() -> None:
    """The share of an offset varies with the signal, as a set-point does."""
    errors = [0.2, 0.2, 0.2, 0.01, 0.01, 0.01, 0.2, 0.2, 0.2]
    own = finding(FindingKind.SENSOR, "i", 0.0)
    wrong = [own.model_copy(update={"error": error}) for error in errors]
    documents = assessed(report(index, findings=(item,)) for index, item in enumerate(wrong))
    assert [item[2] for item in changes(documents)] == [Level.ACT]
