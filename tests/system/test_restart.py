"""A daemon that is killed, stopped or started twice, with real processes and files."""

import json
import math
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.adaptation.state import OperatorDecisions
from otolith.health.events import ConditionRecord, HealthState
from otolith.health.limits import Level
from otolith.health.schema import (
    EventDocument,
    EvidenceDocument,
    QualityDocument,
    ReportDocument,
    Status,
    WindowDocument,
)
from otolith.machine import load_machine
from otolith.runtime.service import Service
from otolith.storage.evidence import read_bundle
from otolith.storage.history import HistoryReader, history_path
from otolith.storage.state_store import StateStore
from otolith_drivers.user_dirs import state_directory
from tests.conftest import OwnMachine
from tests.system.conftest import OTOLITH, Running, is_estimated
from tests.waiting import PATIENCE, wait_for

RESISTANCE = 6.5  # ohm
Start = Callable[[], Running]


@pytest.fixture
def healthy(tmp_path: Path) -> OwnMachine:
    """A motor of which nothing changes, simulated by the daemon itself."""
    return OwnMachine(tmp_path / "machine", "in-process", faults="")


@pytest.fixture
def store(healthy: OwnMachine) -> StateStore:
    machine = load_machine(healthy.machine, with_driver=False)
    return StateStore(machine.file.machine.site, machine.file.machine.name, machine.twin)


@pytest.fixture
def start(healthy: OwnMachine, tmp_path: Path) -> Iterator[Start]:
    """Function that starts a daemon of the motor; all end with the test."""
    started: list[Running] = []

    def begin() -> Running:
        folder = tmp_path / f"daemon-{len(started)}"
        folder.mkdir()
        started.append(Running(healthy, folder))
        return started[-1]

    yield begin
    for running in started:
        running.close()


def holds_truth(report: ReportDocument) -> bool:
    """Whether the report has an interval that holds the resistance of the motor."""
    resistance = report.parameters["R_a"]
    return (
        resistance.low is not None and resistance.high is not None and resistance.low <= RESISTANCE <= resistance.high
    )


def is_saved(store: StateStore) -> bool:
    """Whether the resistance is saved as determined."""
    if not store.components_path.exists():
        return False
    learned = json.loads(store.components_path.read_text(encoding="utf-8"))["filter"]
    return learned is not None and all(before["known"] for before in learned["previous"])


@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.full)])
def test_the_first_reports_after_a_restart_hold_the_truth(
    start: Start, store: StateStore, number: signal.Signals
) -> None:
    first = start()
    first.wait_for(lambda reports: bool(reports) and is_estimated(reports[-1]))
    wait_for(lambda: is_saved(store), 2 * PATIENCE)
    first.stop(number)
    second = start()
    reports = second.wait_for(lambda reports: len(reports) >= 2)
    assert holds_truth(reports[0]) or holds_truth(reports[1])
    assert reports[0].parameters["R_a"].status in {Status.ESTIMATED, Status.HELD}
    assert "started with what was learned up to" in second.log.read_text()
    assert reports[0].notes == ()
    before, after = first.reports[-1].sequence, reports[0].sequence
    assert before is not None
    assert after is not None
    assert before <= (reports[0].previous or 0) < after  # the history has what was published after the last one here
    history = HistoryReader(history_path("demo", "dc-motor"))
    expected = {report.to_json() for report in (*first.reports, *reports)}
    wait_for(lambda: expected <= set(history.messages("report", 1000)))  # the last one may still be written


def bundles_about(part: str) -> list[Path]:
    """Return the evidence of events of a part."""
    paths = (state_directory() / "evidence").glob("*.zip")
    return [path for path in paths if any(event.part == part for event in read_bundle(path).events)]


@pytest.mark.full
def test_the_evidence_of_a_killed_daemon_is_reproduced_by_another_process(start: Start, healthy: OwnMachine) -> None:
    text = healthy.machine.read_text(encoding="utf-8")
    healthy.machine.write_text(text.replace('R_a = { value = "6.5 ohm"', 'R_a = { value = "3.8 ohm"'), encoding="utf-8")
    running = start()
    wait_for(lambda: bool(bundles_about("winding")) or running.daemon.poll() is not None, 3 * PATIENCE)
    running.stop(signal.SIGKILL)
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo"}
    command = [*OTOLITH, "reproduce", str(bundles_about("winding")[0])]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "raised: ACT: winding: " in done.stdout
    assert "the same to the last bit: " in done.stdout


@pytest.mark.full
def test_a_second_daemon_of_the_same_name_ends_with_an_error(start: Start, healthy: OwnMachine) -> None:
    first = start()
    command = [*OTOLITH, "run", str(healthy.machine), "--listen", "tcp/127.0.0.1:0"]
    second = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert second.returncode == 2
    assert f"process {first.daemon.pid} of Otolith already uses its state: stop it" in second.stderr
    first.stop(signal.SIGKILL)
    start()


@pytest.mark.full
def test_a_file_that_is_refused_is_published_and_kept_with_the_decisions(start: Start, store: StateStore) -> None:
    store.operator.write(OperatorDecisions(rejected=frozenset({"shaft/Coulomb/omega"})))
    store.components_path.write_text('{"version": 99}', encoding="utf-8")
    running = start()
    (report, *_) = running.wait_for(lambda reports: len(reports) >= 1)
    (note,) = report.notes
    assert "version 99" in note
    assert note in running.log.read_text()
    (kept,) = store.components_path.parent.glob("*.kept.json")
    assert kept.name in note
    assert kept.read_text(encoding="utf-8") == '{"version": 99}'
    running.stop()
    assert json.loads(store.components_path.read_text(encoding="utf-8"))["version"] == 2
    assert store.decisions().rejected == {"shaft/Coulomb/omega"}


@pytest.mark.full
def test_unreadable_decisions_do_not_cost_the_learned_state(start: Start, store: StateStore) -> None:
    first = start()
    first.wait_for(lambda reports: bool(reports) and is_estimated(reports[-1]))
    first.stop()
    store.decisions_path.write_text("half a fi", encoding="utf-8")
    second = start()
    (report, *_) = second.wait_for(lambda reports: len(reports) >= 1)
    assert report.parameters["R_a"].value is not None
    assert any("decisions" in note for note in report.notes)
    assert store.decisions_path.read_text(encoding="utf-8") == "half a fi"


@pytest.mark.full
def test_a_reset_reaches_a_running_daemon(start: Start, healthy: OwnMachine, store: StateStore) -> None:
    running = start()
    running.wait_for(lambda reports: bool(reports) and is_estimated(reports[-1]))
    command = [*OTOLITH, "reset", str(healthy.machine), "R_a"]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True)
    assert shown.stdout == "R_a is forgotten\n"
    applied = store.decisions().resets["R_a"] + 2.0  # s: decisions are read twice a second
    running.wait_for(lambda reports: reports[-1].window.start > applied)
    running.stop()
    learned = json.loads(store.components_path.read_text(encoding="utf-8"))
    assert learned["resets"] == store.decisions().resets


def test_a_state_that_windows_contradict_is_not_saved(healthy: OwnMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    service, requested = Service(load_machine(healthy.machine)), list[object]()
    monkeypatch.setattr(service._writer, "save", requested.append)
    service._save(1e6)
    assert requested == []  # before the first window
    service.machine.finished += 1
    state = service.machine.state
    before = state.previous["R_a"]
    refuted = type(before)(known=True, status=Status.INVALID)
    service.machine.state = replace(state, previous={**state.previous, "R_a": refuted})
    service._save(1e6)
    assert requested == []
    service.machine.state = state
    valid = service.machine.packed
    service._save(1e6)
    service._save(1e6 + 59.0)
    assert requested == [valid]
    service._save(1e6 + 61.0)
    assert requested == [valid, valid]
    service._save(1e6 + 62.0)
    service.machine.state = replace(state, previous={**state.previous, "R_a": refuted})
    service._save(math.inf)  # at the end: the last state that nothing contradicts
    assert requested == [valid, valid, valid]
    service._save(math.inf)
    assert requested == [valid, valid, valid]


def test_an_event_is_saved_at_once(healthy: OwnMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    service, requested = Service(load_machine(healthy.machine)), list[object]()
    monkeypatch.setattr(service._writer, "save", requested.append)
    service.machine.finished += 1
    service._save(1e6)
    quality = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)
    window = WindowDocument(index=3, start=0.0, end=2.0, records=200, quality=quality)
    for state in (Level.WATCH, Level.ACT):
        event = EventDocument(
            id="limit/R_a@0.0", part="winding", state=state, start=0.0, since=0.0, condition="", text="",
            evidence=EvidenceDocument(windows=(window.index, window.index)),
        )  # fmt: skip
        health = HealthState(records={"limit/R_a": ConditionRecord(state, ((state, window),), event)})
        service.machine.state = replace(service.machine.state, health=health)
        service._save(1e6 + 1.0)
        service._save(1e6 + 2.0)
    assert len(requested) == 3
