"""SIGHUP to a hall: machines are added, changed and removed, and the others notice nothing."""

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path

import pytest

from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from otolith.storage.state_store import store_of
from tests.conftest import OwnMachine
from tests.drivers.modbus.test_shared_line import line_of
from tests.system.halls import ENDPOINT, RunningHall, write, write_modbus
from tests.waiting import PATIENCE

DONE = "machines are served"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "machines").mkdir()
    for name in ("one", "two", "three"):
        write(tmp_path / "machines", name)
    return tmp_path / "machines"


@pytest.fixture
def hall(folder: Path) -> Iterator[RunningHall]:
    running = RunningHall(folder)
    yield running
    if running.daemon.poll() is None:
        running.close()


def follow(reports: Sequence[ReportDocument]) -> bool:
    """Whether each report is the one after the one before it."""
    return all(after.previous == before.sequence for before, after in pairwise(reports))


def test_machines_are_added_changed_and_removed_without_touching_the_others(hall: RunningHall, folder: Path) -> None:
    hall.have(1, "one", "two", "three")
    store = store_of(load_machine(folder / "three.toml", with_driver=False))
    (folder / "three.toml").unlink()
    write(folder, "four")
    write(folder, "bad", estimate="estimat")
    write(folder, "two", **{"[driver]": '[window]\nlength = "3 s"\n[driver]'})
    hall.reload(DONE)
    hall.have(2, "one", "two", "four", "bad")
    bad = hall.reports["bad"][-1]
    assert bad.health is not None
    assert bad.health.state is Level.NO_DATA
    assert "estimat" in bad.health.reason
    assert "bad.toml" in bad.health.reason
    assert bad.daemon == hall.reports["one"][-1].daemon
    lengths = [report.window.end - report.window.start for report in hall.reports["two"]]
    assert max(lengths) > 2.5 > min(lengths)
    assert follow(hall.reports["two"])  # which goes on from its history
    with store.locked():  # another daemon may serve it
        count = len(hall.reports["three"])
    hall.have(1, "one", "two", "four")
    assert len(hall.reports["three"]) == count
    write(folder, "bad")
    (folder / "one.toml").write_text("[machine", encoding="utf-8")
    hall.reload(DONE)
    hall.have(1, "one", "two", "bad")
    hall.says("one.toml", "one")  # which goes on as before
    bad = hall.reports["bad"][-1]
    assert bad.health is not None
    assert bad.sequence is not None
    assert "estimat" not in bad.health.reason
    assert follow(hall.reports["one"])
    counters, windows = hall.reports["one"][-1].counters, [report.window for report in hall.reports["one"]]
    assert counters is not None
    assert (counters.lost, counters.reconnects, counters.worker_restarts) == (0, 0, 0)
    gaps = [after.index - before.index - 1 for before, after in pairwise(windows)]
    assert 0 <= sum(gaps) <= counters.windows_missed  # a busy computer misses windows, and none is taken twice
    ends = [after.start - before.end for (before, after), gap in zip(pairwise(windows), gaps, strict=True) if not gap]
    assert ends == pytest.approx([0.0] * len(ends), abs=1e-3)
    assert len(hall.children()) == 3  # nobody else was started
    folder.rename(folder.with_name("away"))
    hall.reload(DONE)
    hall.have(1, "one", "two", "four", "bad")
    hall.says("there is no machine file", "one", "two")
    assert hall.close() == 0


def write_on_bus(own: OwnMachine, folder: Path, name: str) -> None:
    """Write the file of a machine on the CAN channel of the simulated plant."""
    text = own.machine.read_text(encoding="utf-8").replace('name = "dc-motor"', f'name = "{name}"', 1)
    endpoint = ENDPOINT.format(folder=folder.parent)
    (folder / f"{name}.toml").write_text(text.replace(own.endpoint, endpoint), encoding="utf-8")


def write_on_line(folder: Path, name: str, serial: Path, device: int) -> None:
    """Write the file of a machine on a serial line."""
    write_modbus(folder, name, f'serial = "{serial}"\ndevice = {device}\nbaudrate = 115200')


def test_machines_that_share_a_line_or_a_channel_go_on(own_machine: OwnMachine, folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        path.unlink()
    with line_of(3, None) as (line, asked), ExitStack() as stack:
        plant = subprocess.Popen([sys.executable, "-m", "otolith", "plant", str(own_machine.scenario)])
        stack.callback(plant.wait, PATIENCE)
        stack.callback(plant.terminate)
        (tmp_path / "line").symlink_to(line)
        write_on_line(folder, "pump-1", Path(line), 1)
        write_on_line(folder, "pump-2", tmp_path / "line", 2)  # another spelling of the same port
        write_on_bus(own_machine, folder, "motor-1")
        write_on_bus(own_machine, folder, "motor-2")
        hall = RunningHall(folder)
        stack.callback(hall.close)
        hall.have(1, "pump-1", "pump-2", "motor-1", "motor-2")
        for name in ("pump-1", "motor-1"):
            (folder / f"{name}.toml").unlink()
        write_on_line(folder, "pump-3", Path(line), 3)
        hall.reload(DONE)
        before = asked[1]
        hall.have(2, "pump-2", "pump-3", "motor-2")
        assert asked[1] == before
        for name in ("pump-2", "pump-3", "motor-2"):
            driver, counters = hall.reports[name][-1].driver, hall.reports[name][-1].counters
            assert driver is not None
            assert driver.up, driver.reason
            assert counters is not None
            assert counters.reconnects == 0


def test_all_machines_of_a_hall_may_change_at_once(folder: Path) -> None:
    for name in ("two", "three"):
        (folder / f"{name}.toml").unlink()
    hall = RunningHall(folder)
    try:
        hall.have(1, "one")
        write(folder, "one", **{"[driver]": '[window]\nlength = "3 s"\n[driver]'})
        hall.reload(DONE)
        hall.have(2, "one")
        assert follow(hall.reports["one"])
        window = hall.reports["one"][-1].window
        assert window.end - window.start > 2.5
    finally:
        hall.close()
