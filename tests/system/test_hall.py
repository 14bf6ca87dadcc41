"""Several machines in one daemon: what is wrong with one of them harms no other."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.cli.run import serve
from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from otolith.storage.history import HistoryReader, history_path
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from tests.messages import raises_saying
from tests.system.halls import RunningHall, write, write_modbus

GOOD = ("one", "two")
LEARNED_BY_ANOTHER = "what another daemon has learned"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "machines").mkdir()
    for name in GOOD:
        write(tmp_path / "machines", name)
    return tmp_path / "machines"


@pytest.fixture
def hall(folder: Path) -> Iterator[RunningHall]:
    write(folder, "bad-file", estimate="estimat")
    write_modbus(folder, "dead-bus", 'host = "127.0.0.1"\nport = 9')
    write(folder, "busy")
    other = store_of(load_machine(folder / "busy.toml", with_driver=False))
    write(folder, "other-name")
    (folder / "other-name.toml").write_text((folder / "one.toml").read_text(encoding="utf-8"), encoding="utf-8")
    with other.locked():  # by this process, as by another daemon
        other.components_path.write_text(LEARNED_BY_ANOTHER, encoding="utf-8")
        running = RunningHall(folder)
        running.have(1, *GOOD)
    yield running
    if running.daemon.poll() is None:
        running.close()


def test_what_is_wrong_with_a_machine_harms_no_other(hall: RunningHall, folder: Path) -> None:
    hall.have(2, *GOOD, "dead-bus")
    log = hall.log.read_text(encoding="utf-8")
    assert "bad-file.toml" in log
    assert "demo.one: machine one" in log
    assert "demo.busy: not served" in log
    assert "other-name.toml" in log
    hall.have(1, "bad-file")
    bad = hall.reports["bad-file"][-1].health
    assert bad is not None
    assert bad.state is Level.NO_DATA
    assert "estimat" in bad.reason
    dead = hall.reports["dead-bus"][-1]
    assert dead.health is not None
    assert dead.health.state is Level.NO_DATA
    assert dead.driver is not None
    assert not dead.driver.up
    before = {name: hall.reports[name][-1].counters for name in GOOD}
    worker, _, recorder = hall.children()
    os.kill(worker.pid, signal.SIGKILL)
    os.kill(recorder.pid, signal.SIGKILL)
    hall.have(3, *GOOD, "dead-bus")
    for name in GOOD:
        first, last = before[name], hall.reports[name][-1].counters
        assert first is not None
        assert last is not None
        assert (last.windows_missed, last.lost, last.worker_restarts) == (first.windows_missed, 0, 1)
    assert hall.close() == 0
    assert not hall.reports["busy"]
    (learned,) = (folder.parent / "state" / "otolith" / "components").glob("demo.busy*json")
    assert learned.read_text(encoding="utf-8") == LEARNED_BY_ANOTHER
    assert not history_path("demo", "busy").exists()
    for name in GOOD:
        kept = HistoryReader(history_path("demo", name)).messages("report", 1000)
        assert {report.sequence for report in hall.reports[name]} <= {
            ReportDocument.from_json(each).sequence for each in kept
        }
        assert list((folder.parent / "state" / "otolith" / "components").glob(f"demo.{name}.json"))


@pytest.mark.full
def test_a_daemon_that_is_killed_goes_on_where_it_was(hall: RunningHall, folder: Path) -> None:
    hall.have(3, *GOOD)
    hall.daemon.kill()
    hall.daemon.wait()
    before = {name: hall.reports[name][-1].sequence for name in GOOD}
    again = RunningHall(folder)
    again.have(2, *GOOD)
    for name in GOOD:
        first = again.reports[name][0]
        assert first.sequence is not None
        assert first.sequence > (before[name] or 0)
        assert first.previous is not None
        assert first.previous >= (before[name] or 0)  # what was published is in the history
    assert again.close() == 0


def test_no_usable_machine_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with raises_saying(ConfigurationError, "no machine", str(tmp_path / "empty")):
        serve([tmp_path / "empty"], None, None, None)
