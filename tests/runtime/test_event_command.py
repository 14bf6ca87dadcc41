"""The command of ``on_event``: it gets the event, and neither a failing nor a hanging one holds anything up."""

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument, EvidenceDocument
from otolith.machine import load_machine
from otolith.runtime.process import MAX_RUNNING, MAX_WAITING_EVENTS, EventCommand
from otolith_drivers.errors import ConfigurationError
from tests.conftest import OwnMachine
from tests.waiting import wait_for

EVENT = EventDocument(
    id="limit/R_a@1.0",
    part="winding",
    state=Level.ACT,
    change=EventChange.RAISED,
    start=1.0,
    since=1.0,
    condition="short circuit",
    text="R_a is 5 ohm",
    evidence=EvidenceDocument(windows=(1, 3), value=5.0),
)


@pytest.fixture
def commands() -> Iterator[list[EventCommand]]:
    started: list[EventCommand] = []
    yield started
    for command in started:
        command.stop(0.0)


def shell(script: str, started: list[EventCommand], timeout: float = 30.0) -> EventCommand:
    started.append(EventCommand(["/bin/sh", "-c", script], "press-3", "hall", timeout))
    return started[-1]


def test_the_command_gets_the_event_as_json(tmp_path: Path, commands: list[EventCommand]) -> None:
    target = tmp_path / "event.json"
    command = shell(f"cat > {target}.new && mv {target}.new {target}", commands)
    command.run(EVENT)
    wait_for(target.exists)
    document = json.loads(target.read_text(encoding="utf-8"))
    assert (document["machine"], document["site"]) == ("press-3", "hall")
    assert EventDocument.model_validate(document["event"]) == EVENT
    command.stop(5.0)
    assert command.failed == 0


def test_without_a_command_nothing_runs() -> None:
    command = EventCommand((), "m", "s")
    command.run(EVENT)
    command.stop(0.0)
    assert command.failed == 0


@pytest.mark.parametrize("program", ["/bin/false", "/no/such/program", "/tmp", "/bin/\0"])  # noqa: S108 - a folder
def test_failures_are_counted_and_logged_once(program: str, caplog: pytest.LogCaptureFixture) -> None:
    command = EventCommand([program], "m", "s")
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            command.run(EVENT)
        wait_for(lambda: command.failed == 5)
    assert len(caplog.records) == 1
    assert program in caplog.records[0].getMessage()


def test_a_command_that_reads_nothing_and_one_that_succeeds_after_a_failure(
    tmp_path: Path, commands: list[EventCommand], caplog: pytest.LogCaptureFixture
) -> None:
    command = shell(f"test -e {tmp_path}/well", commands)
    command.run(EVENT)
    wait_for(lambda: command.failed == 1)
    (tmp_path / "well").touch()
    command.run(EVENT)
    wait_for(lambda: not command.outage)
    (tmp_path / "well").unlink()
    command.run(EVENT)
    wait_for(lambda: len(caplog.records) == 2)  # it is logged after it is counted
    assert command.failed == 2


def test_a_command_that_hangs_is_killed_with_its_children(tmp_path: Path, commands: list[EventCommand]) -> None:
    started = tmp_path / "child"
    command = shell(f"sleep 600 & echo $! > {started}; sleep 600", commands, timeout=0.5)

    def has_begun() -> bool:
        """Whether the shell came so far within the timeout, which it may not on a busy computer."""
        failed = command.failed
        command.run(EVENT)
        wait_for(lambda: command.failed > failed)
        return bool(started.exists() and started.read_text(encoding="ascii").strip())

    wait_for(has_begun)
    child = int(started.read_text(encoding="ascii"))
    wait_for(lambda: not is_running(child))


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def test_many_events_wait_without_holding_up_the_caller(tmp_path: Path, commands: list[EventCommand]) -> None:
    command = shell(f"echo x >> {tmp_path}/started; sleep 600", commands)
    for _ in range(MAX_RUNNING + MAX_WAITING_EVENTS + 40):
        command.run(EVENT)
    assert command.failed >= 38
    wait_for((tmp_path / "started").exists)
    command.stop(0.1)
    assert len((tmp_path / "started").read_text(encoding="ascii").split()) <= MAX_RUNNING


def test_the_command_cannot_speak_for_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, commands: list[EventCommand]
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", "/run/systemd/notify")
    command = shell(f"env > {tmp_path}/env.new; mv {tmp_path}/env.new {tmp_path}/env", commands)
    command.run(EVENT)
    wait_for((tmp_path / "env").exists)
    assert "NOTIFY_SOCKET" not in (tmp_path / "env").read_text(encoding="utf-8")
    assert os.environ["NOTIFY_SOCKET"]


def test_a_relative_command_is_refused(own_machine: OwnMachine) -> None:
    text = own_machine.machine.read_text(encoding="utf-8")
    own_machine.machine.write_text(text.replace("[machine]", '[machine]\non_event = ["notify"]'), encoding="utf-8")
    with pytest.raises(ConfigurationError, match="'notify' is not an absolute path"):
        load_machine(own_machine.machine, with_driver=False)
