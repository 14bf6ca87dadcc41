"""An output of the daemon that does not work is an event of the daemon: the machine is judged as before."""

from dataclasses import replace

import pytest

from otolith.discovery.alternatives import WindowDecision
from otolith.health.events import HealthState
from otolith.health.limits import Level
from otolith.health.observations import DAEMON, PERSISTENT_WINDOWS
from otolith.health.schema import EventChange, FindingKind, ReportDocument
from otolith.machine import load_rules
from tests.health.test_events import PLAN, SENSOR, assessed, changes, report

REASON = "/var/lib/otolith: cannot be created: Read-only file system"


def with_outages(document: ReportDocument, *names: str) -> ReportDocument:
    outages = dict.fromkeys(names, REASON) or None
    return document.model_copy(update={"window": document.window.model_copy(update={"outages": outages})})


@pytest.mark.parametrize("decision", [WindowDecision.LEARNED, WindowDecision.BAD])
def test_an_outage_is_one_event_until_it_is_over_whatever_the_machine_does(decision: WindowDecision) -> None:
    down, up = range(5, 25), range(25, 40)
    before = [report(index) for index in range(5)]
    failing = [with_outages(report(index, decision=decision), "state", "history") for index in down]
    documents = assessed([*before, *failing, *(report(index, decision=decision) for index in up)])
    own = [document.model_copy(update={"events": tuple(event for event in document.events if event.part == DAEMON)})
           for document in documents]  # fmt: skip
    raised, cleared = down.start + PERSISTENT_WINDOWS - 1, up.start + PERSISTENT_WINDOWS - 1
    assert (
        changes(own)
        == [(raised, EventChange.RAISED, Level.WATCH)] * 2 + [(cleared, EventChange.CLEARED, Level.WATCH)] * 2
    )
    (first, second) = own[raised].events
    assert {first.text.partition(":")[0], second.text.partition(":")[0]} == {"state", "history"}
    assert REASON in first.text
    assert all(text for text in (first.condition, first.cause, first.advice))
    health = documents[raised].health
    assert health is not None
    assert health.parts["winding"].state is not Level.WATCH
    assert health.parts[DAEMON].state is Level.WATCH


def test_a_german_operator_reads_german() -> None:
    plan = replace(PLAN, language="de", rules=load_rules("de"))
    last = assessed([with_outages(report(index), "recording") for index in range(5)], plan=plan)[-1]
    (event,) = last.open_events
    assert event.text == "Aufzeichnung: /var/lib/otolith: kann nicht angelegt werden: Read-only file system"


def test_a_day_on_which_everything_works_has_no_part_for_it() -> None:
    documents = assessed([report(index) for index in range(10)])
    assert all(document.health and DAEMON not in document.health.parts for document in documents)
    assert changes(documents) == []


def test_an_outage_hides_no_fault_of_the_machine_that_comes_and_goes() -> None:
    doubt = SENSOR.model_copy(update={"id": "undecided", "kind": FindingKind.OPEN, "subject": ""})
    reports = [
        report(index, decision=WindowDecision.SUSPECTED, findings=(doubt,)) if index % 5 < 2 else report(index)
        for index in range(10, 60)
    ]
    expected = [change for change in changes(assessed(reports)) if change[1] is EventChange.RAISED]
    documents = assessed([with_outages(document, "recording") for document in reports])
    assert len(expected) == 1
    assert expected[0] in changes(documents)


def test_an_outage_that_is_over_at_once_is_no_event() -> None:
    documents = assessed([with_outages(report(index), *(["history"] if index % 3 else [])) for index in range(30)])
    assert changes(documents) == []
    assert assessed([report(0)], HealthState())[0].events == ()
