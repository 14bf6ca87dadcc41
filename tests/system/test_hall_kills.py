"""What may happen to a hall: its processes are killed or stopped, its disk is full, its machines are hostile.

Nothing that was learned is lost, and the other machines go on to publish.
"""

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path

import psutil
import pytest

from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith.storage.history import HistoryReader, history_path
from tests.hostile import HOSTILE
from tests.system.halls import RunningHall, write, write_modbus
from tests.variants import often_rows
from tests.waiting import PATIENCE, wait_for

DISK = 64  # MB of the state directory
SHORT = {"[driver]": '[window]\nlength = "1 s"\n[driver]'}
DIVERGES = {
    "D = {": 'J = "1e-9 kg*m^2"\nD = {'
}  # The speed of its twin changes a million times faster than the windows


@contextmanager
def small_disk(folder: Path) -> Iterator[None]:
    """A disk of its own in a folder, which can be filled."""
    if (
        os.geteuid() != 0
        or subprocess.run(
            ["/bin/mount", "-t", "tmpfs", "-o", f"size={DISK}M,mode=700", "tmpfs", str(folder)], check=False
        ).returncode
    ):
        pytest.skip("only root can mount a disk")
    try:
        yield
    finally:
        subprocess.run(["/bin/umount", "--lazy", str(folder)], check=True)


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    (tmp_path / "state").mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    with small_disk(tmp_path / "state"):
        yield tmp_path / "state"


def hall_of(folder: Path, count: int) -> tuple[RunningHall, list[str]]:
    """A hall of so many machines that are well, and of some that are not."""
    folder.mkdir()
    well = [f"well-{number}" for number in range(count)]
    for name in well:
        write(folder, name, **SHORT)
    write(folder, "diverges", **DIVERGES)
    write_modbus(folder, "dead", 'host = "127.0.0.1"\nport = 9')
    for number, text in enumerate(HOSTILE):
        file = f"[machine]\nname = {json.dumps(text)}\n[twin]\nname = {json.dumps(text)}\n"
        (folder / f"hostile-{number}.toml").write_bytes(file.encode("utf-8", "surrogatepass"))
    (folder / "service.toml").write_text(f'[recording]\nfolder = "{folder.parent}/recordings"\n', encoding="utf-8")
    return RunningHall(folder), well


def follow(reports: list[ReportDocument]) -> bool:
    """Whether each report is the one after the one before it."""
    return all(after.previous == before.sequence for before, after in pairwise(reports))


def fill(disk: Path) -> Path:
    """Fill a disk, and return the file that does it."""
    with suppress(OSError), (disk / "ballast").open("wb", buffering=0) as ballast:  # ENOSPC
        while True:
            ballast.write(bytes(1 << 16))
    return disk / "ballast"


def freeze(process: psutil.Process) -> None:
    process.suspend()
    wait_for(lambda: process.status() == psutil.STATUS_STOPPED)


def gone(process: psutil.Process) -> bool:
    return not process.is_running()


def learned(hall: RunningHall, well: list[str]) -> None:
    """No machine has lost a sample, a connection, a number or what it has learned."""
    for name in well:
        last = hall.reports[name][-1]
        assert last.counters is not None
        assert (last.counters.lost, last.counters.reconnects) == (0, 0)
        assert follow(hall.reports[name]), name
        assert last.parameters["R_a"].value is not None


@pytest.mark.parametrize(("count", "is_long"), often_rows([(3, False)], [(3, False), (3, True)]))
def test_what_is_killed_stopped_or_full_costs_nothing_that_was_learned(
    tmp_path: Path, state: Path, count: int, is_long: bool
) -> None:
    hall, well = hall_of(tmp_path / "machines", count)
    try:
        hall.have(4, *well)
        wait_for(lambda: any((tmp_path / "recordings").glob("*.rrd")), PATIENCE)
        worker, _, recorder = hall.children()
        os.kill(worker.pid, signal.SIGKILL)
        hall.have(2, *well)
        os.kill(recorder.pid, signal.SIGKILL)
        hall.have(2, *well)
        if is_long:
            ballast = fill(state)
            hall.have(3, *well)
            ballast.unlink()
            for stopped in hall.children():
                freeze(stopped)
                hall.have(3, *well)  # at last the machine whose window it has
                wait_for(partial(gone, stopped), 3 * PATIENCE)
                hall.have(2, *well)
        freeze(psutil.Process(hall.daemon.pid))
        hall.daemon.send_signal(signal.SIGCONT)
        hall.have(2, *well, "dead")
        learned(hall, well)
        dead = hall.reports["dead"][-1]
        assert dead.health is not None
        assert dead.health.state is Level.NO_DATA
        assert hall.log.read_text(encoding="utf-8").count("Traceback") == 0
    finally:
        hall.daemon.kill()
        hall.daemon.wait()
    hall.read()
    last = {name: hall.reports[name][-1].sequence or 0 for name in well}
    again = RunningHall(tmp_path / "machines")
    try:
        again.have(2, *well)
        for name in well:
            first = again.reports[name][0]
            assert first.previous is not None
            assert first.previous >= last[name]  # what was published is in the history
            assert f"demo.{name}: started with what was learned" in again.log.read_text(encoding="utf-8")
    finally:
        assert again.close() == 0
    for name in well:
        kept = HistoryReader(history_path("demo", name)).messages("report", 10_000)
        numbers = {ReportDocument.from_json(each).sequence for each in kept}
        assert {report.sequence for report in (*hall.reports[name], *again.reports[name])} <= numbers
