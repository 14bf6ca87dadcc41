"""What was learned is lost or forgotten: the state before it is used, or its events are cleared everywhere."""

import io
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from rich.console import Console

from otolith.adaptation.state import (
    EVERYTHING,
    AdaptationState,
    OperatorDecisions,
    apply_decisions,
    initial_state,
)
from otolith.cli.commissioning.commission import _review
from otolith.cli.main import cli
from otolith.cli.operation.live_table import LiveTable
from otolith.health.events import HealthState, assess
from otolith.health.schema import EventChange, EventDocument, ReportDocument
from otolith.health.text import event_text
from otolith.machine import LoadedMachine, load_machine
from otolith.publishing.html_report import html_report
from otolith.storage.history import WINDOW, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith.storage.state_store import StateStore
from tests.conftest import EXAMPLES
from tests.health.test_events import report

SOURCE = Path(__file__).parents[1] / "golden" / "state_files" / "version-2" / "demo.dc-motor-in-process.json"
"""What was learned of a motor with two open events."""
LIMIT, COMPONENT = "limit/R_a@1795452938.2", "component/shaft/periodic@1795452821.2"
END = 1_795_452_960.2  # of its last window, Unix s
REASON = "the saved state was lost"
Drop = Callable[[StateStore, AdaptationState], AdaptationState]


@pytest.fixture(scope="module")
def motor() -> LoadedMachine:
    return load_machine(EXAMPLES / "dc-motor-in-process.toml", with_driver=False)


@pytest.fixture
def store(motor: LoadedMachine, tmp_path: Path) -> StateStore:
    shutil.copy(SOURCE, tmp_path)
    names = motor.file.machine
    return StateStore(names.site, names.name, motor.twin, tmp_path)


def cold(motor: LoadedMachine) -> AdaptationState:
    return initial_state(motor.file.machine.name, motor.file.machine.site, motor.problem, motor.plan)


def warm(motor: LoadedMachine, store: StateStore) -> AdaptationState:
    state, note = store.restore(cold(motor))
    assert note == ""
    assert {event.id for event in state.health.open_events} == {LIMIT, COMPONENT}
    return state


def next_report(motor: LoadedMachine, state: AdaptationState, index: int = 0) -> tuple[HealthState, ReportDocument]:
    """State and report of a window that determines nothing."""
    names, document = motor.file.machine, report(index, None)
    window = document.window.model_copy(update={"start": END + 50.0 + 2.0 * index, "end": END + 52.0 + 2.0 * index})
    update = {"machine": names.name, "site": names.site, "window": window}
    return assess(motor.plan, state.health, document.model_copy(update=update))


def cleared(document: ReportDocument) -> dict[str, str | None]:
    return {event.id: event.reason for event in document.events if event.change is EventChange.CLEARED}


def damage(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_damaged_file_costs_no_more_than_what_was_saved_last(motor: LoadedMachine, store: StateStore) -> None:
    state = warm(motor, store)
    store.save(state)
    end = state.posterior.belief.end
    store.save(
        replace(state, posterior=replace(state.posterior, belief=replace(state.posterior.belief, end=end + 9.0)))
    )
    damage(store.components_path)
    assert [known.adopted.component.key for known in store.components()] == ["shaft/periodic/t"]  # for the commands
    again, note = store.restore(cold(motor))
    assert again.posterior.belief.end == end
    assert again.health.open_events == state.health.open_events
    (kept,) = store.components_path.parent.glob("*.kept.json")
    assert kept.name in note
    assert "saved before it" in note
    once_more, note = store.restore(cold(motor))  # it ended before it saved anything
    assert (note, once_more.posterior.belief.end) == ("", end)
    store.save(again)
    damage(store.components_path)
    store.earlier_path.write_text("[]")
    last, note = store.restore(cold(motor))
    assert last.health.open_events == ()
    assert len(list(store.components_path.parent.glob("*.kept.json"))) == 3
    assert all(path.name in note for path in store.components_path.parent.glob("*.kept.json") if path != kept)


def test_a_file_that_was_moved_away_starts_without_it(motor: LoadedMachine, store: StateStore) -> None:
    store.save(warm(motor, store))
    assert store.earlier_path.exists()
    store.components_path.unlink()
    state, note = store.restore(cold(motor))
    assert (state.adopted, note) == ((), "")


def test_a_state_is_saved_where_there_are_no_links(
    motor: LoadedMachine, store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("os.link", refuse)
    before = store.components_path.stat().st_ino
    store.save(warm(motor, store))
    assert store.components_path.stat().st_ino != before


def reset(*names: str) -> Drop:
    decisions = OperatorDecisions(resets=dict.fromkeys(names, END + 45.0))
    return lambda _, state: apply_decisions(state, decisions)


def forget(_: StateStore, state: AdaptationState) -> AdaptationState:
    return apply_decisions(state, OperatorDecisions(forgotten={"shaft/periodic/t": END + 45.0}))


@pytest.mark.parametrize(
    ("drop", "dropped"),
    [
        (reset(EVERYTHING), {LIMIT: "reset", COMPONENT: "reset"}),
        (reset("R_a"), {LIMIT: "R_a"}),
        (reset("shaft/periodic/t"), {COMPONENT: "shaft/periodic/t"}),
        (forget, {COMPONENT: "removed"}),
    ],
    ids=["everything", "parameter", "component", "forgotten"],
)
def test_who_forgets_what_was_learned_clears_its_events(
    motor: LoadedMachine, store: StateStore, drop: Drop, dropped: dict[str, str]
) -> None:
    before = warm(motor, store)
    state = drop(store, before)
    store.save(state)  # the daemon ends before the next window
    state, _ = store.restore(cold(motor))
    health, document = next_report(motor, state)
    reasons = cleared(document)
    assert reasons.keys() == dropped.keys()
    assert all(word in (reasons[key] or "") for key, word in dropped.items())
    assert {event.id for event in document.events if event.end is None} == {LIMIT, COMPONENT} - dropped.keys()
    assert all(event.end == document.window.start for event in document.events if event.id in dropped)
    _, after = next_report(motor, replace(state, health=health), 1)
    assert cleared(after) == {}


def test_a_reset_leaves_what_the_data_show(motor: LoadedMachine, store: StateStore) -> None:
    state = warm(motor, store)
    key = "source/pump"
    records = {**state.health.records, key: state.health.records["limit/R_a"]}
    state = replace(state, health=replace(state.health, records=records))
    assert reset(EVERYTHING)(store, state).health.records.keys() == {key}


def test_another_twin_clears_the_events_of_the_one_before(motor: LoadedMachine, store: StateStore) -> None:
    state = warm(motor, store)
    store.save(state)
    edited = replace(motor.twin, parameters=motor.twin.parameters[::-1])
    other = StateStore(state.site, state.machine, edited, store.components_path.parent)
    state, note = other.restore(cold(motor))
    assert "twin has changed" in note
    _, document = next_report(motor, state)
    reasons = cleared(document)
    assert reasons.keys() == {LIMIT, COMPONENT}
    assert all("twin has changed" in (reason or "") for reason in reasons.values())
    german = replace(motor.plan, language="de")
    _, document = assess(german, state.health, document.model_copy(update={"events": ()}))
    assert all("Zwilling" in event_text(event) for event in document.events)


def test_notes_that_were_taken_over_are_so_also_where_a_state_is_refused(
    motor: LoadedMachine, store: StateStore
) -> None:
    state = warm(motor, store)
    store.save(replace(state, health=replace(state.health, taken=("a", "b"))))
    edited = replace(motor.twin, parameters=motor.twin.parameters[::-1])
    other = StateStore(state.site, state.machine, edited, store.components_path.parent)
    assert other.taken() == ("a", "b")
    refused, note = other.restore(cold(motor))
    assert "twin has changed" in note
    assert refused.health.taken == ("a", "b")


def test_a_commissioning_keeps_which_notes_were_taken_over(motor: LoadedMachine, store: StateStore) -> None:
    state = warm(motor, store)
    store.save(replace(state, health=replace(state.health, taken=("a", "b"))))
    _review(motor, store, state, (), decide=lambda: True)
    again, note = store.restore(cold(motor))
    assert (note, again.health.taken, again.health.open_events) == ("", ("a", "b"), ())


def published(event: EventDocument, **update: object) -> EventDocument:
    return event.model_copy(update={"change": EventChange.RAISED, **update})


def test_what_was_published_and_the_state_agree_after_a_start(motor: LoadedMachine, store: StateStore) -> None:
    health = warm(motor, store).health
    first, second = health.open_events
    unknown = published(first, id="limit/D@1795452940.0")
    ended = published(second, end=END)
    agreed = health.agreeing({event.id: event for event in (unknown, ended, published(first))}, REASON)
    assert agreed.open_events == (first,)
    assert [(event.id, event.reason) for event in agreed.dropped] == [(unknown.id, REASON)]
    assert health.agreeing({}, REASON) == health  # without a history


def test_screen_page_and_list_agree_on_an_event_whose_state_is_lost(motor: LoadedMachine, store: StateStore) -> None:
    """An event whose state is lost is cleared with the reason for who looks now, who reads the page, and who lists."""
    state = warm(motor, store)
    writer = HistoryWriter(history_path(state.site, state.machine), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(END)
    _, document = next_report(motor, state)
    events = tuple(published(event) for event in document.events)
    assert len(events) == 2
    writer.add(numbers.number(document.model_copy(update={"events": events})))
    writer._write_waiting()
    damage(store.components_path)

    state, _ = store.restore(cold(motor))
    state = replace(state, health=state.health.agreeing(writer.last_changes(), REASON))
    _, document = next_report(motor, state, 1)
    document = numbers.number(document)
    writer.add(document)
    writer._write_waiting()
    writer._close()
    now, reader = document.window.end, writer.reader
    assert [event.change for event in reader.events(0.0)] == ["raised", "raised", "cleared", "cleared"]
    assert not [event for event in reader.last_changes().values() if event.end is None]
    page = re.sub(r"<[^>]*>", " ", html_report(reader, reader.samples(WINDOW, 0.0), "window", END, now))
    assert "not cleared" not in page
    assert page.count(REASON) == 2
    table, output = LiveTable(lambda: ""), io.StringIO()
    table.add(document.to_json())
    Console(file=output, width=250).print(table)
    assert "balance the rotor" not in output.getvalue()
    since = time.strftime("%F", time.localtime(END - 86_400.0))
    for details in ([], ["--details"]):
        arguments = ["history", state.machine, "--events", "--since", since, *details]
        listed = CliRunner().invoke(cli, arguments, env={"COLUMNS": "500"}, standalone_mode=False).stdout
        assert " ".join(listed.split()).count(REASON) == 2
