"""What an installed service has learned survives the ways in which it may end. Runs in the guest, as root."""

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.publishing import attacker
from tests.vm.conftest import PATIENCE, run, slowness
from tests.vm.service import PROGRAM, SHARE, STRANGER, Instance, install_wheel, simulated_machine
from tests.waiting import wait_for, within

READY = 3.0  # s from the start to readiness, if all kernels are compiled
WINDOW_LENGTH, FIRST_REPORT = 1.0, 2.0  # s: of `WINDOW`; from the end of the first window to its report


def test_nobody_else_reads_or_publishes(press: Instance) -> None:
    """A user of no group can open neither the socket nor the files, and nothing of the service listens elsewhere."""
    (endpoint,) = Path("/run/otolith/press").glob("*.sock")
    given = {"connect": f"unixsock-stream/{endpoint}", "uid": int(STRANGER)}
    command = [sys.executable, attacker.__file__, json.dumps(given)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.stdout, done.returncode) == ("refused\n", 0), done.stderr
    (database,) = press.state.rglob("*.history.sqlite")
    # Its process starts with the first report, after which a busy computer may take many windows to load it.
    wait_for(lambda: any(press.state.rglob("*.rrd")), PATIENCE)
    (recording, *_) = press.state.rglob("*.rrd")
    for path in (endpoint, press.state, database, recording):
        assert (
            run("setpriv", "--reuid", STRANGER, "--regid", STRANGER, "--clear-groups", "test", "!", "-r", str(path))
            == ""
        )
    network = ("nsenter", "--net", "--target", press.shown("MainPID"))
    assert run(*network, "ss", "--no-header", "--all", "--tcp", "--udp", "--raw", "--packet") == ""
    assert run(*network, "ip", "-brief", "link").split()[0] == "lo"


def test_the_sandbox_is_tight(press: Instance) -> None:
    shown = run("systemd-analyze", "security", "--no-pager", press.unit)
    exposure = re.search(r"exposure level for \S+: ([\d.]+)", shown)
    assert exposure is not None
    print(f"exposure {exposure[1]}")
    assert float(exposure[1]) <= 1.0


def test_what_was_learned_survives_a_kill(press: Instance) -> None:
    before, first = press.before(), press.shown("MainPID")
    run("kill", "-KILL", first)
    press.check_continued(before)
    assert press.shown("MainPID") != first


@pytest.mark.timed
def test_what_was_learned_survives_a_restart_which_is_ready_in_3_s(press: Instance) -> None:
    press.wait_for_reports(3, after=press.last().sequence or 0)
    before, slow = press.before(), slowness()
    begun = time.monotonic()
    run("systemctl", "stop", press.unit)
    stopped = time.monotonic()
    run("systemctl", "start", press.unit)  # returns when the daemon is ready
    ready, wall = time.monotonic(), time.time()
    print(f"stopped in {stopped - begun:.1f} s, ready after {ready - stopped:.1f} s")
    first = press.check_continued(before)[0]
    published = first.window.end + (first.cost.latency_s or 0.0)
    print(f"the first report came {published - wall:.1f} s after it was ready, of a window of {WINDOW_LENGTH:g} s")
    slow = max(slow, slowness())
    print(f"{slow:.1f} times slower than on an idle computer")
    assert ready - stopped <= slow * within(READY)
    assert published - wall <= WINDOW_LENGTH + slow * within(FIRST_REPORT)


def test_all_processes_take_at_most_300_mb(press: Instance) -> None:
    """With all kernels on disk, as after an installation: a daemon that has compiled takes 130 MB more."""
    processes = Path(f"/sys/fs/cgroup{press.shown('ControlGroup')}/cgroup.procs").read_text(encoding="ascii").split()
    rows = [Path(f"/proc/{process}/smaps_rollup").read_text(encoding="ascii") for process in processes]
    taken = [int(re.findall(r"^Pss: +(\d+) kB$", text, re.MULTILINE)[0]) / 1024 for text in rows]
    print(f"{sum(taken):.0f} MB: {taken}")
    assert len(taken) == 4
    assert sum(taken) <= 300.0


def test_what_was_learned_survives_removal_and_upgrade(press: Instance) -> None:
    """As docs/service.md says; a second installation has nothing to do."""
    before, source = press.before(), Path.home() / "press"
    source.mkdir()
    file = simulated_machine(source)
    drop_in = Path(f"/etc/systemd/system/{press.unit}.service.d")
    run("systemctl", "disable", "--now", press.unit)
    press.file.unlink()
    shutil.rmtree(drop_in)
    install_wheel(*map(str, SHARE.glob("*.whl")))
    shown = run(PROGRAM, "install", "--dry-run", str(file))
    assert f"to write: {press.file}\n" in shown
    assert not press.file.exists()
    press.install(file)
    again = run(PROGRAM, "install", str(file), seconds=300.0)
    assert "write: " not in again
    assert "replace: " not in again
    run("systemctl", "enable", "--now", press.unit)
    press.check_continued(before)
