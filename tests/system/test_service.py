"""The service with systemd, its recorder and its disk."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import namedtuple
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from otolith.adaptation.state import ComponentRecord, OperatorDecisions
from otolith.discovery.decision import AdoptedComponent, Approval
from otolith.estimation.problem import Component
from otolith.health.schema import Status
from otolith.machine import RecordedMachine, find_twin, load_machine
from otolith.publishing import recorder
from otolith.runtime.hall.daemon import Daemon
from otolith.runtime.hall.pool import COMPILE_TIMEOUT, STALL_TIMEOUT
from otolith.runtime.service import Service
from otolith.storage.recording_files import Ended, Opened
from otolith.storage.state_store import StateStore
from otolith_drivers.base import Sampling
from otolith_drivers.errors import ServiceError
from tests.conftest import OwnMachine
from tests.system.conftest import Running
from tests.waiting import PATIENCE, wait_for, within

IMPORTS = "import click, numpy, pint, pydantic, zenoh"
# Processor time over that of these imports, which take 0.25 s on a free core of a PC: 2.5 and 10 were measured. So a
# core half as fast is ready in 2 s, and computes its first report at the latest 2 s after a window of 5 s.
MAX_READY, MAX_FIRST_REPORT = 4.0, 16.0
# Friction near standstill: a turning shaft gives no evidence against it, so it is not removed during the test.
FRICTION = Component("shaft", "Stribeck", "omega", -0.004, inner=0.01, low=0.005, high=0.02)


@pytest.fixture
def running_with_component(own_machine: OwnMachine, tmp_path: Path) -> Iterator[tuple[Running, StateStore]]:
    """A daemon that starts with a saved component."""
    machine = load_machine(own_machine.machine, with_driver=False)
    store = StateStore(machine.file.machine.site, machine.file.machine.name, machine.twin)
    store.save_components((ComponentRecord(AdoptedComponent(FRICTION, 5.0), (-0.004, 0.01), (1e-3, 1e-3)),))
    running = Running(own_machine, tmp_path)
    yield running, store
    running.close()


def test_systemd_gets_readiness_progress_and_stop(own_machine: OwnMachine, tmp_path: Path) -> None:
    """A datagram socket stands in for systemd; tests/vm runs the unit in a booted system."""
    plant = subprocess.Popen(
        [sys.executable, "-m", "otolith", "plant", str(own_machine.scenario)], stderr=subprocess.DEVNULL
    )
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(2 * PATIENCE)
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "4000000"}
        command = [sys.executable, "-m", "otolith", "run", str(own_machine.machine)]
        daemon = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
        messages: list[str] = []
        while sum("WATCHDOG=1" in text for text in messages) < 4 or not any(
            re.search(r"window \d+ good", text) for text in messages
        ):
            messages.append(manager.recv(4096).decode())
        daemon.send_signal(signal.SIGTERM)
        assert daemon.wait(timeout=PATIENCE) == 0
        while not any("STOPPING=1" in text for text in messages):
            messages.append(manager.recv(4096).decode())
    plant.terminate()
    plant.wait(timeout=PATIENCE)
    assert messages[0].startswith("READY=1\nSTATUS=listening: CAN bus udp_multicast")
    assert f"MAINPID={daemon.pid}" in messages[0]


def processor_time(*processes: psutil.Process) -> float:
    """Return the seconds that the processes, and those of their children that have ended, have computed."""
    return sum(sum(process.cpu_times()[:4]) for process in processes)


@pytest.mark.timed
def test_a_warm_start_takes_little_of_the_processor(tmp_path: Path) -> None:
    """Ratios within one run hold on a busy computer as well."""
    machine = OwnMachine(tmp_path / "machine", "in-process", faults="").machine
    subprocess.run([sys.executable, "-m", "otolith", "compile", str(machine)], check=True, capture_output=True)
    before = processor_time(psutil.Process())
    subprocess.run([sys.executable, "-c", IMPORTS], check=True)
    imports = processor_time(psutil.Process()) - before
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(2 * PATIENCE)
        environment = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify")}
        command = [sys.executable, "-m", "otolith", "run", str(machine)]
        with subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL) as daemon:
            process = psutil.Process(daemon.pid)
            assert manager.recv(4096).startswith(b"READY=1\n")
            ready = processor_time(process) / imports
            while not re.search(rb"window \d+ good", manager.recv(4096)):
                continue
            report = processor_time(process, *process.children()) / imports
            daemon.terminate()
    assert ready <= MAX_READY
    assert report <= MAX_FIRST_REPORT


def test_the_watchdog_is_fed_by_finished_windows_only(
    own_machine: OwnMachine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rule itself, without waiting for half a minute."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "4000000")
        text = own_machine.machine.read_text(encoding="utf-8") + "\n[recording]\nenabled = false\n"
        own_machine.machine.write_text(text, encoding="utf-8")
        hall = Daemon([Service(load_machine(own_machine.machine))])
        (machine,) = hall._services

        def fed() -> bool:
            try:
                return manager.recv(4096) == b"WATCHDOG=1"
            except BlockingIOError:
                return False

        (worker,) = hall._pool.workers
        worker.stall.begin(1000.0, 0.0)
        hall._feed_watchdog(1002.0)
        assert fed()
        patience = STALL_TIMEOUT + 3 * 2.0 + COMPILE_TIMEOUT
        hall._feed_watchdog(1000.0 + patience - 0.1)
        assert fed()
        hall._feed_watchdog(1000.0 + patience + 0.1)
        assert not fed()
        machine.missed += 1
        hall._feed_watchdog(1000.0 + patience + 3.0)
        assert not fed()
        hall._pool.progress += 1  # a kernel is compiled: time for the next one
        hall._feed_watchdog(1000.0 + patience + 6.0)
        assert fed()
        hall._feed_watchdog(1000.0 + 2 * patience + 5.9)
        assert fed()
        hall._pool.progress += 1  # a window is finished
        worker.is_compiling = False
        hall._feed_watchdog(1000.0 + 2 * patience + 8.0)
        assert fed()
        hall._feed_watchdog(1000.0 + 2 * patience + 8.0 + STALL_TIMEOUT + 3 * 2.0 + 0.1)
        assert not fed()
        hall._notifier.close()


def replaced_by_file(folder: Path) -> bool:
    """Whether a file took the place of ``folder``, which the daemon may have made again meanwhile."""
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.write_text("no folder any more", encoding="utf-8")
    except IsADirectoryError:
        return False
    return True


@pytest.mark.timed
def test_windows_without_a_recorder_are_counted_as_dropped(running: Running) -> None:
    before = running.wait_for(lambda reports: len(reports) >= 2)[-1].counters
    os.kill(running.child("recorder").pid, signal.SIGKILL)
    wait_for(lambda: replaced_by_file(running.folder / "state"))
    reports = running.wait_for(
        lambda reports: bool(reports and reports[-1].counters and reports[-1].counters.recordings_dropped >= 2)
    )
    last = reports[-1].counters
    assert before is not None
    assert last is not None
    assert (last.windows_missed, last.lost) == (before.windows_missed, 0)
    code, seconds = running.stop()
    assert code == 0
    assert seconds < within(3.0)


@pytest.mark.timed
def test_components_are_saved_and_decisions_apply_at_run_time(
    running_with_component: tuple[Running, StateStore],
) -> None:
    running, store = running_with_component
    first = running.wait_for(lambda reports: len(reports) >= 1)
    assert [component.id for component in first[0].components] == [FRICTION.key]
    assert f"started with saved components: {FRICTION.key}; 'otolith components forget'" in running.log.read_text()
    store.components_path.unlink()
    store.operator.write(OperatorDecisions(approved=frozenset({FRICTION.key})))
    running.wait_for(lambda reports: reports[-1].components[0].approval is Approval.APPROVED)
    running.wait_for(lambda reports: all(each.status is not Status.INVALID for each in reports[-1].parameters.values()))
    code, seconds = running.stop()
    assert (code, seconds < within(3.0)) == (0, True)
    assert [record.adopted.component.key for record in store.components()] == [FRICTION.key]  # saved again at the end


def is_locked(store: StateStore) -> bool:
    """Whether the lock was taken in the place of a daemon's, whose file is removed."""
    store.lock_path.unlink(missing_ok=True)
    try:
        store.lock()
    except ServiceError:  # the daemon has taken it again
        return False
    return True


def test_a_daemon_whose_lock_another_has_taken_ends(running: Running) -> None:
    """Its file was removed with the state: both would write the same files."""
    running.wait_for(lambda reports: len(reports) >= 1)
    machine = load_machine(running.machine.machine, with_driver=False)
    store = StateStore(machine.file.machine.site, machine.file.machine.name, machine.twin)
    wait_for(lambda: is_locked(store))
    assert running.daemon.wait(timeout=PATIENCE) == 2
    assert f"process {os.getpid()} of Otolith already uses its state: stop it" in running.log.read_text()
    store.unlock()


class Pipe:
    """A connection to the recorder process: what it receives, and what it sends."""

    def __init__(self, *received: object) -> None:
        self._received, self.sent = list(received), list[object]()

    def recv(self) -> object:
        return self._received.pop(0) if self._received else None

    def send(self, message: object) -> None:
        self.sent.append(message)


def test_a_recording_ends_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", ["total", "used", "free"])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(1 << 40, 1 << 40, 1 << 20))
    twin = find_twin("dc_motor")
    machine = RecordedMachine("full", twin, twin.parameters[:1], Sampling.TRUE, {})
    pipe = Pipe(("here.full", 1, Opened(tmp_path / "full.rrd", machine, None)))
    recorder.main(pipe)
    assert pipe.sent == [("here.full", 1, Ended(""))]
    assert not (tmp_path / "full.rrd").exists()


def test_sighup_is_ignored_under_nohup(own_machine: OwnMachine) -> None:
    command = ["/usr/bin/nohup", sys.executable, "-m", "otolith", "run", str(own_machine.machine)]
    daemon = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert daemon.stderr is not None
    while "reports on" not in (line := daemon.stderr.readline()):
        assert line
    daemon.send_signal(signal.SIGHUP)
    time.sleep(0.5)  # long enough for it to have ended
    assert daemon.poll() is None
    daemon.terminate()
    assert daemon.wait(timeout=PATIENCE) == 0
    daemon.stderr.close()


def test_sighup_reloads_the_machine_file(own_machine: OwnMachine) -> None:
    file = own_machine.machine
    text = file.read_text(encoding="utf-8") + "\n[recording]\nenabled = false\n"
    file.write_text(text, encoding="utf-8")
    # The daemon ignores SIGHUP where nohup does so for the tests.
    command = ["env", "--default-signal=HUP", sys.executable, "-m", "otolith", "run", str(file)]
    daemon = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    stderr = daemon.stderr
    assert stderr is not None

    def logged(part: str) -> str:
        while part not in (line := stderr.readline()):
            assert line
        return line

    logged("reports on")
    file.write_text(text.replace("enabled = false", "enabled = 7"), encoding="utf-8")
    daemon.send_signal(signal.SIGHUP)
    assert "recording.enabled" in logged("not reloaded, the daemon goes on as before")
    file.write_text(text.replace("enabled = false", "enabled = true"), encoding="utf-8")
    daemon.send_signal(signal.SIGHUP)
    logged("reloaded, recording changed")
    logged("recording to")
    daemon.terminate()
    assert daemon.wait(timeout=PATIENCE) == 0
    stderr.close()


def test_a_wrong_machine_file_has_an_exit_code_of_its_own(own_machine: OwnMachine) -> None:
    """So that systemd does not start it for ever, as it does where a bus is missing."""
    own_machine.machine.write_text("[machine]\n", encoding="utf-8")
    command = [sys.executable, "-m", "otolith", "run", str(own_machine.machine)]
    assert subprocess.run(command, capture_output=True, check=False).returncode == os.EX_CONFIG
    unit = (Path(__file__).parents[2] / "systemd" / "otolith@.service").read_text(encoding="utf-8")
    assert f"\nRestartPreventExitStatus={os.EX_CONFIG:d}\n" in unit
