"""The shipped unit under a booted systemd. Runs in the guest, as root."""

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import PIPE

import pytest

from otolith.health.schema import Status
from tests.vm.conftest import Machine, resistance, run
from tests.vm.service import STRANGER, Instance

HOLD = """
import socket, sys, time
held = []
for _ in range(600):
    held.append(socket.create_connection((sys.argv[1], int(sys.argv[2])), 60.0))
    held[-1].sendall(bytes(1))
print("held", flush=True)
time.sleep(3600.0)
"""


@pytest.fixture
def bench(machine: Machine) -> Iterator[Instance]:
    bench = Instance("bench")
    bench.install(Path(shutil.copy(machine.file, machine.file.with_name("bench.toml"))))
    yield bench
    run("systemctl", "disable", "--now", bench.unit)


@contextmanager
def held_open(endpoint: str) -> Iterator[None]:
    """Connections of another user that never finish their handshake, more than the daemon waits for at a time."""
    host, _, port = endpoint.removeprefix("tcp/").partition(":")
    command = [sys.executable, "-c", HOLD, host, port]
    with subprocess.Popen(command, user=int(STRANGER), group=int(STRANGER), extra_groups=(), stdout=PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        try:
            yield
        finally:
            process.kill()


def test_the_shipped_unit_serves_and_comes_back(machine: Machine, bench: Instance) -> None:
    machine.plant()
    begun = time.monotonic()
    run("systemctl", "enable", "--now", bench.unit)  # returns when the daemon has said that it is ready
    print(f"ready after {time.monotonic() - begun:.1f} s")
    assert (bench.shown("ActiveState"), bench.shown("SubState"), bench.shown("Type")) == ("active", "running", "notify")
    listener = machine.listener(bench.failure)
    reports = listener.wait_for_good(3)
    assert resistance(reports).status is Status.ESTIMATED
    assert "R_a" in bench.shown("StatusText")
    first = bench.shown("MainPID")
    status = Path(f"/proc/{first}/status").read_text(encoding="ascii")
    user = run("id", "--user", "otolith").strip()
    assert f"\nUid:\t{user}\t{user}\t{user}\t{user}\n" in status
    assert "\nSeccomp:\t2\n" in status
    sockets = run("ss", "--no-header", "--numeric", "--processes", "--listening", "--tcp", "--udp").splitlines()
    assert [machine.endpoint.removeprefix("tcp/") in line for line in sockets if "otolith" in line] == [True]

    with held_open(machine.endpoint):
        machine.listener(bench.failure).wait_for(lambda reports: len(reports) >= 2)

    run("kill", "-KILL", first)
    begun = time.monotonic()
    while bench.shown("MainPID") in {"0", first}:
        assert time.monotonic() < begun + 30.0, bench.failure()
        time.sleep(0.1)
    index = reports[-1].window.index
    reports = listener.wait_for(lambda reports: reports[-1].window.index < index)
    listener.wait_for_good(2)
    print(f"good again {time.monotonic() - begun:.1f} s after it was killed")
    assert bench.shown("NRestarts") == "1"

    begun = time.monotonic()
    run("systemctl", "stop", bench.unit)
    print(f"stopped in {time.monotonic() - begun:.1f} s")
    assert (bench.shown("ActiveState"), bench.shown("Result")) == ("inactive", "success")
    assert "Traceback" not in bench.log()
