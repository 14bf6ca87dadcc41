"""SIGHUP to a hall: machines are added, changed and removed, and the others notice nothing."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from otolith.storage.state_store import store_of
from tests.system.halls import RunningHall, write
from tests.waiting import wait_for

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
    return all(after.previous == before.sequence for before, after in zip(reports, reports[1:], strict=False))


def test_machines_are_added_changed_and_removed_without_touching_the_others(hall: RunningHall, folder: Path) -> None:
    hall.have(2, "one", "two", "three")
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
    hall.have(2, "one", "two", "bad")
    hall.says("one.toml", "one")  # which goes on as before
    bad = hall.reports["bad"][-1]
    assert bad.health is not None
    assert bad.sequence is not None
    assert "estimat" not in bad.health.reason
    one = [report.counters for report in hall.reports["one"] if report.counters is not None]
    assert follow(hall.reports["one"])
    assert all(after.windows == before.windows + 1 for before, after in zip(one, one[1:], strict=False))
    assert {(each.windows_missed, each.lost, each.reconnects) for each in one[1:]} == {(one[0].windows_missed, 0, 0)}
    assert len(hall.children()) == 3  # nobody else was started
    assert hall.close() == 0


def test_a_folder_without_files_ends_no_machine(hall: RunningHall, folder: Path) -> None:
    hall.have(1, "one", "two", "three")
    folder.rename(folder.with_name("away"))
    hall.reload("goes on as before")
    hall.have(1, "one", "two", "three")
    assert hall.close() == 0


def test_a_bad_file_is_published_from_the_start(folder: Path) -> None:
    (folder / "two.toml").write_text('[machine]\nname = "two"\nsite = "demo"\nlanguage = "de"\nx = 1', encoding="utf-8")
    hall = RunningHall(folder)
    hall.have(1, "one", "three")
    hall.have(1, "two")
    two = hall.reports["two"][-1].health
    assert two is not None
    assert (two.state, two.language) == (Level.NO_DATA, "de")
    wait_for(lambda: hall.daemon.poll() is None)
    assert hall.close() == 0
