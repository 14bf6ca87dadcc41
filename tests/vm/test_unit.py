"""The shipped unit under a booted systemd. Runs in the guest, as root."""

import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.health.schema import Status
from tests.vm.conftest import Machine, resistance, run

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = "otolith@bench"


def shown(name: str) -> str:
    """A property of the unit."""
    return run("systemctl", "show", "--value", f"--property={name}", UNIT).strip()


@pytest.fixture
def installed(machine: Machine) -> Iterator[Machine]:
    """As README.md says; /opt/otolith is there already. Kernels that are compiled are taken over."""
    file = machine.file.with_name("bench.toml")
    if file != machine.file:
        shutil.copy(machine.file, file)
    run("systemd-sysusers", str(SYSTEMD / "otolith.sysusers.conf"))
    cache = Path("/var/cache/otolith/bench")
    cache.parent.mkdir(exist_ok=True)
    shutil.copytree(Path.home() / ".cache" / "otolith", cache)
    run("chown", "--recursive", "otolith:otolith", str(cache))
    run("/opt/otolith/bin/otolith", "install", str(file), seconds=600.0)
    yield machine
    run("systemctl", "disable", "--now", UNIT)


def failure() -> str:
    return "" if shown("ActiveState") in {"active", "activating"} else run("journalctl", "--unit", UNIT, "--no-pager")


def test_the_shipped_unit_serves_and_comes_back(installed: Machine) -> None:
    installed.plant()
    begun = time.monotonic()
    run("systemctl", "enable", "--now", UNIT)  # returns when the daemon has said that it is ready
    print(f"ready after {time.monotonic() - begun:.1f} s")
    assert (shown("ActiveState"), shown("SubState"), shown("Type")) == ("active", "running", "notify")
    listener = installed.listener(failure)
    reports = listener.wait_for_good(3)
    assert resistance(reports).status is Status.ESTIMATED
    assert "R_a" in shown("StatusText")
    first = shown("MainPID")
    status = Path(f"/proc/{first}/status").read_text(encoding="ascii")
    user = run("id", "--user", "otolith").strip()
    assert f"\nUid:\t{user}\t{user}\t{user}\t{user}\n" in status
    assert "\nSeccomp:\t2\n" in status

    run("kill", "-KILL", first)
    begun = time.monotonic()
    while shown("MainPID") in {"0", first}:
        assert time.monotonic() < begun + 30.0, failure()
        time.sleep(0.1)
    index = reports[-1].window.index
    reports = listener.wait_for(lambda reports: reports[-1].window.index < index)
    listener.wait_for_good(2)
    print(f"good again {time.monotonic() - begun:.1f} s after it was killed")
    assert shown("NRestarts") == "1"

    begun = time.monotonic()
    run("systemctl", "stop", UNIT)
    print(f"stopped in {time.monotonic() - begun:.1f} s")
    assert (shown("ActiveState"), shown("Result")) == ("inactive", "success")
    assert "Traceback" not in run("journalctl", "--unit", UNIT, "--no-pager")
