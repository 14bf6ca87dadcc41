"""Several machines in one daemon: what is wrong with one of them harms no other."""

import os
import queue
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from otolith.cli.run import serve
from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith.storage.history import HistoryReader, history_path
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.messages import raises_saying
from tests.waiting import PATIENCE, wait_for

GOOD = ("one", "two")
LEARNED_BY_ANOTHER = "what another daemon has learned"
ENDPOINT = "unixsock-stream/{folder}/reports.sock"


def write(folder: Path, name: str, driver: str = "", **changes: str) -> None:
    """Write the file of a machine that is simulated in the daemon."""
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"dc-motor-in-process"', f'"{name}"').replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    if driver:
        text = text.replace(text[text.index("[driver]") : text.index("[signals]")], f"[driver]\n{driver}\n")
    endpoint = ENDPOINT.format(folder=folder.parent)
    (folder / f"{name}.toml").write_text(f'{text}\n[zenoh]\nlisten = ["{endpoint}"]\n', encoding="utf-8")


class RunningHall:
    """A daemon for the machines of a folder, and what it publishes of each."""

    def __init__(self, folder: Path) -> None:
        self.log = folder.parent / "daemon.log"
        with self.log.open("wb") as log:
            command = [sys.executable, "-m", "otolith", "run", str(folder), "--workers", "2"]
            self.daemon = subprocess.Popen(command, stdout=log, stderr=log)
        self._received: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscriber = Subscriber(Connection((ENDPOINT.format(folder=folder.parent),)), self._received.put)
        self.reports: defaultdict[str, list[ReportDocument]] = defaultdict(list)

    def have(self, count: int, *names: str) -> None:
        """Wait until each of the machines has published ``count`` further reports."""
        self.read()
        wanted = {name: len(self.reports[name]) + count for name in names}

        def enough() -> bool:
            assert self.daemon.poll() is None, self.log.read_text()
            self.read()
            return all(len(self.reports[name]) >= number for name, number in wanted.items())

        wait_for(enough, 3 * PATIENCE)

    def read(self) -> None:
        while not self._received.empty():
            report = ReportDocument.from_json(self._received.get())
            self.reports[report.machine].append(report)

    def children(self) -> list[psutil.Process]:
        """The workers and the recorder."""
        children = psutil.Process(self.daemon.pid).children()
        return sorted((p for p in children if "spawn_main" in " ".join(p.cmdline())), key=lambda p: p.create_time())

    def close(self) -> int:
        self._subscriber.__exit__(None, None, None)
        self.daemon.send_signal(signal.SIGTERM)
        return self.daemon.wait(timeout=PATIENCE)


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
    write(folder, "dead-bus", 'type = "modbus"\nhost = "127.0.0.1"\nport = 9')
    text = (folder / "dead-bus.toml").read_text(encoding="utf-8")
    units = {"ArmatureVoltage": "V", "LoadTorque": "N*m", "ArmatureCurrent": "A", "RotorSpeed": "rad/s"}
    for number, (name, unit) in enumerate(units.items()):
        own = f'{{ register = {2 * number}, type = "float32", unit = "{unit}" }}'
        text = text.replace(f'{{ signal = "{name}" }}', own)
    (folder / "dead-bus.toml").write_text(text, encoding="utf-8")
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
    assert "other-name.toml: not served" in log
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
        assert first.previous == before[name]  # what was published is in the history
    assert again.close() == 0


def test_no_usable_machine_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with raises_saying(ConfigurationError, "no machine", str(tmp_path / "empty")):
        serve([tmp_path / "empty"], None, None, None)
