"""The process of outlets: the daemon neither waits for it nor ends with it."""

import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from otolith.cli.terminal import LogFormatter
from otolith.machine import load_machine
from otolith.runtime.hall import outlet_process
from otolith.runtime.hall.outlet_process import OutletProcess
from otolith.site.outlets.process import KeptLines
from tests.conftest import EXAMPLES
from tests.messages import assert_says
from tests.sites.machines import report_of
from tests.sites.outlets.rigs import MqttRig, PrometheusRig, Rig
from tests.waiting import wait_for

HEAVY = ("paho", "asyncua", "starlette", "uvicorn", "otolith.site", "smtplib")


def answer_nothing(connection: Any, _: Any) -> None:
    """What runs in a process that hangs, and is large."""
    kept = bytearray(64 << 20)
    connection.recv()
    time.sleep(600.0)
    del kept


def answer_with_a_fault(connection: Any, _: Any) -> None:
    """What runs in a process of which an outlet has a fault of its own."""
    lines, log = KeptLines(), logging.getLogger("otolith.test")
    log.addHandler(lines)
    try:
        float(f"{'x' * 100_000} the end")
    except ValueError:
        log.exception("%s: a fault of its own", "\x1b[2Jmqtt")
    connection.recv()
    connection.send((None, lines.taken()))
    connection.recv()


def machine_file(folder: Path, rig: Rig) -> Path:
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    file = folder / "machine.toml"
    file.write_text(f"{text}\n[outlets.{rig.name}]\n{rig.table()}\n", encoding="utf-8")
    return file


@pytest.fixture
def rig(tmp_path: Path) -> PrometheusRig:
    return PrometheusRig(tmp_path)


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Iterator[OutletProcess]:
    monkeypatch.setattr(outlet_process, "LOOK_PAUSE", 0.0)
    monkeypatch.setattr(outlet_process, "MEMORY_PAUSE", 0.1)
    made = OutletProcess()
    yield made
    made.stop(1.0)


def looking(process: OutletProcess, enough: Any) -> None:
    def looked() -> bool:
        process.poll(time.monotonic())
        return bool(enough())

    wait_for(looked)


def test_reports_are_passed_on_also_after_the_process_was_killed(
    process: OutletProcess, rig: PrometheusRig, tmp_path: Path
) -> None:
    machine = load_machine(machine_file(tmp_path, rig))
    identity, number = machine.file.machine, 0
    process.serve(machine)

    def states() -> dict[str, str]:
        nonlocal number
        number += 1
        process.offer(report_of(identity.name, number, time.time(), site=identity.site))
        return rig.states()

    looking(process, lambda: states() == {identity.name: "OK"})
    (child,) = [each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())]
    child.kill()
    looking(process, lambda: process.child.starts == 2)
    looking(process, lambda: states() == {identity.name: "OK"})
    process.leave(f"{identity.site}/{identity.name}", is_gone=True)
    wait_for(lambda: rig.states() == {})


@pytest.mark.parametrize("removed", ["while it runs", "while it is dead", "before the next one has passed it on"])
@pytest.mark.parametrize("is_moved", [False, True])
def test_what_is_gone_is_taken_back_whatever_has_happened_to_the_process(
    process: OutletProcess, tmp_path: Path, removed: str, is_moved: bool
) -> None:
    broker = MqttRig(tmp_path)
    broker.start()
    machine = load_machine(machine_file(tmp_path, broker))
    identity, text = machine.file.machine, machine.path.read_text(encoding="utf-8")
    key = f"{identity.site}/{identity.name}"

    def kept() -> set[str]:
        return {topic for topic in broker.retained() if topic.startswith(f"otolith/{key}/") and "status" not in topic}

    def is_passed_on() -> bool:
        process.offer(report_of(identity.name, None, time.time(), site=identity.site))
        return f"otolith/{key}/state" in kept()

    try:
        process.serve(machine)
        looking(process, is_passed_on)
        if removed != "while it runs":
            (child,) = [each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())]
            child.kill()
            wait_for(lambda: child.status() == psutil.STATUS_ZOMBIE)
        if removed == "before the next one has passed it on":
            looking(process, lambda: process.child.starts == 2)
        if is_moved:
            own = text.replace('host = "127.0.0.1"', 'host = "127.0.0.1"\nprefix = "other"')
            machine.path.write_text(own, encoding="utf-8")
            process.serve(load_machine(machine.path))
        else:
            process.leave(key, is_gone=True)
        looking(process, lambda: not kept())
        if not is_moved:
            looking(process, lambda: not process.child.alive)
            starts = process.child.starts
            process.poll(time.monotonic() + 100.0)
            assert process.child.starts == starts
    finally:
        process.stop(1.0)
        broker.stop()


def test_a_machine_without_outlets_starts_no_process(process: OutletProcess) -> None:
    process.serve(load_machine(EXAMPLES / "dc-motor-in-process.toml"))
    process.poll(time.monotonic())
    process.offer(report_of())
    assert (process.child.starts, process.dropped) == (0, 0)


@pytest.mark.parametrize("bounds", [{"OUTLET_TIMEOUT": 1.0}, {"OUTLET_MEMORY": 60e6}])
def test_a_process_that_hangs_or_is_too_large_is_killed_and_delays_nobody(
    monkeypatch: pytest.MonkeyPatch, rig: PrometheusRig, tmp_path: Path, bounds: dict[str, float]
) -> None:
    for name, bound in (bounds | {"LOOK_PAUSE": 0.0, "MEMORY_PAUSE": 0.0}).items():
        monkeypatch.setattr(outlet_process, name, bound)
    process, machine = OutletProcess(f"{__name__}:answer_nothing"), load_machine(machine_file(tmp_path, rig))
    identity = machine.file.machine
    process.serve(machine)
    process.poll(time.monotonic())
    try:
        while not process.dropped:  # also what waits in the pipe is bounded; a call that waits for it would not return
            process.offer(report_of(identity.name, site=identity.site))
        looking(process, lambda: process.child.starts >= 2)
    finally:
        process.stop(0.1)


def test_a_process_without_any_table_ends_and_begins_again_with_one(
    process: OutletProcess, rig: PrometheusRig, tmp_path: Path
) -> None:
    file = machine_file(tmp_path, rig)
    machine, without = load_machine(file), load_machine(EXAMPLES / "dc-motor-in-process.toml")
    key = f"{machine.file.machine.site}/{machine.file.machine.name}"
    for starts in (1, 2):
        process.serve(machine)
        looking(process, rig.is_open)
        process.leave(key, is_gone=False)  # a machine that cannot be served has its outlets, which say so
        process.serve(machine)
        if starts == 1:
            process.serve(without)
        else:
            process.leave(key, is_gone=True)
        looking(process, lambda: not process.child.alive)
        assert (process.child.starts, process.outage(key), rig.is_open()) == (starts, "", False)
    process.poll(time.monotonic())
    assert (process.child.starts, process.dropped) == (2, 0)


def test_a_machine_that_cannot_be_served_keeps_its_outlets(
    process: OutletProcess, rig: PrometheusRig, tmp_path: Path
) -> None:
    machine = load_machine(machine_file(tmp_path, rig))
    identity = machine.file.machine
    process.serve(machine)

    def state() -> str | None:
        if identity.name in served:
            process.offer(report_of(identity.name, None, time.time(), site=identity.site))
        return rig.states().get(identity.name)

    served = {identity.name}
    looking(process, lambda: state() == "OK")
    served.clear()
    process.leave(f"{identity.site}/{identity.name}", is_gone=False)
    looking(process, lambda: state() == "NO DATA")
    process.serve(load_machine(EXAMPLES / "dc-motor-in-process.toml"))  # begun anew, without a table
    looking(process, lambda: not process.child.alive)


def test_a_change_of_a_machine_waits_until_there_is_room(
    process: OutletProcess, rig: PrometheusRig, tmp_path: Path
) -> None:
    file = machine_file(tmp_path, rig)
    machine, before = load_machine(file), rig.port
    identity = machine.file.machine
    process.serve(machine)
    looking(process, rig.is_open)
    other = PrometheusRig(tmp_path)
    file.write_text(file.read_text(encoding="utf-8").replace(str(before), str(other.port)), encoding="utf-8")
    (child,) = [each for each in psutil.Process().children() if "spawn_main" in " ".join(each.cmdline())]
    child.suspend()
    while not process.dropped:
        process.offer(report_of(identity.name, site=identity.site))
    process.serve(load_machine(file))
    child.resume()
    looking(process, lambda: other.is_open() and not rig.is_open())
    child.suspend()
    dropped = process.dropped
    while process.dropped == dropped:
        process.offer(report_of(identity.name, site=identity.site))
    process.leave(f"{identity.site}/{identity.name}", is_gone=True)
    child.resume()
    looking(process, lambda: not other.is_open())
    assert process.child.starts == 1


def test_why_an_outlet_fails_is_known_to_the_daemon(process: OutletProcess, rig: PrometheusRig, tmp_path: Path) -> None:
    machine = load_machine(machine_file(tmp_path, rig))
    key = f"{machine.file.machine.site}/{machine.file.machine.name}"
    rig.prevent()
    process.serve(machine)

    def is_told() -> bool:
        process.offer(report_of(machine.file.machine.name, None, time.time(), site=machine.file.machine.site))
        return f"127.0.0.1:{rig.port}" in process.outage(key)

    looking(process, is_told)
    rig.start()
    looking(process, lambda: not (is_told() or process.outage(key)))


def test_a_fault_of_an_outlet_is_in_the_log_with_its_traceback(
    rig: PrometheusRig, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    process, machine = OutletProcess(f"{__name__}:answer_with_a_fault"), load_machine(machine_file(tmp_path, rig))
    identity = machine.file.machine
    process.serve(machine)

    def is_told() -> bool:
        process.offer(report_of(identity.name, site=identity.site))
        return bool(caplog.records)

    try:
        looking(process, is_told)
    finally:
        process.stop(0.1)
    written = LogFormatter("%(levelname)s %(message)s").format(caplog.records[0])
    assert_says(written, "ERROR \\x1b[2Jmqtt: a fault of its own\n", "answer_with_a_fault", "\nValueError", "the end")
    assert len(written) < 10_000


def test_a_daemon_imports_no_library_of_an_outlet(tmp_path: Path, rig: PrometheusRig) -> None:
    file = machine_file(tmp_path, rig)
    script = (
        "import sys\nfrom pathlib import Path\nfrom otolith.machine import load_machine\n"
        "import otolith.runtime.hall.daemon, otolith.runtime.worker\n"
        f"assert load_machine(Path({str(file)!r})).file.outlets.names == ('prometheus',)\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
