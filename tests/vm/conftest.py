"""Shared by the tests in the guest: a CAN bus of the kernel, and plant and daemon as processes on it."""

import os
import queue
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import CountersDocument, ParameterDocument, ReportDocument, Status
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection, Credentials
from tests.conftest import EXAMPLES, free_port

if TYPE_CHECKING:
    from tests.vm.service import Instance

CHANNEL = "vcan0"
STATISTICS = Path(f"/sys/class/net/{CHANNEL}/statistics")
PATIENCE = 300.0  # s for what takes a few; a busy computer may give the guest a tenth of a processor
NUMBA_STARTS = 1.5  # s that Python with Numba takes to start in the guest on an idle computer
RESISTANCE = 6.1  # ohm, of the plant; the machine file says 6.5
PUNCTUALLY = ("chrt", "--fifo", "10")  # before a program that stands for a machine, which no computation delays
OTOLITH = [sys.executable, "-m", "otolith"]
BUS = 'interface = "socketcan"\nchannel = "vcan0"\n'
# Short windows for short tests; the guest's only processor keeps the plant waiting for milliseconds.
WINDOW = '[window]\nlength = "1 s"\njitter_limit = "25 ms"\n'
SCENARIO = f"""
plant = "dc_motor"
seed = 7
dbc = "dc-motor.dbc"
set_points = [{{ at = "0 s", speed = "10 rad/s" }}, {{ at = "5 s", speed = "20 rad/s" }}]
repeat_every = "10 s"
parameters = {{ R_a = "{RESISTANCE} ohm" }}
noise = {{ current = "5 mA", speed = "0.02 rad/s", load_torque = "0.2 mN*m" }}
[bus]
{BUS}
"""

Reports = list[ReportDocument]


def run(*command: str, seconds: float = PATIENCE) -> str:
    """Standard output of a program that must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    assert done.returncode == 0, f"{command}: {done.stderr}"
    return done.stdout


def slowness() -> float:
    """How many times longer than on an idle computer a program takes to start here now; 1 at least."""
    begun = time.monotonic()
    run(sys.executable, "-c", "import numba")
    return max(1.0, (time.monotonic() - begun) / NUMBA_STARTS)


def transmitted() -> int:
    """Number of frames that anybody has sent since the bus was made."""
    return int((STATISTICS / "tx_packets").read_text(encoding="ascii"))


def resistance(reports: Reports) -> ParameterDocument:
    """R_a in the newest report."""
    return reports[-1].parameters["R_a"]


def counters(reports: Reports) -> CountersDocument:
    """Counters of the newest report."""
    found = reports[-1].counters
    assert found is not None
    return found


def good(reports: Reports) -> Reports:
    """Reports of good windows."""
    return [report for report in reports if report.window.quality.verdict is Verdict.GOOD]


def is_estimated(report: ReportDocument) -> bool:
    """Whether the window gave an estimate of R_a: some windows of a busy computer have late samples."""
    return report.parameters["R_a"].status is Status.ESTIMATED


def check_missed(before: CountersDocument, after: CountersDocument) -> None:
    """No window was missed; a busy computer may leave the worker behind."""
    assert after.windows_missed == before.windows_missed or slowness() > 1.0


@dataclass
class Program:
    """A process and its output."""

    process: "subprocess.Popen[bytes]"
    log: Path

    def text(self) -> str:
        """Its output so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_for_output(self, words: str, seconds: float = PATIENCE) -> None:
        """Wait until its output contains ``words``."""
        deadline = time.monotonic() + seconds
        while words not in self.text():
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline, f"no {words!r} within {seconds:g} s: {self.text()}"
            time.sleep(0.05)

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=20)


class ReportListener:
    """Receives the reports of a daemon over Zenoh."""

    def __init__(self, endpoint: str, alive: Callable[[], str], credentials: Credentials | None = None) -> None:
        """``alive`` returns why the daemon ended; empty while it runs."""
        self.reports: Reports = []
        self._alive = alive
        self._received: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscriber = Subscriber(Connection((endpoint,), credentials or Credentials()), self._received.put)

    def wait_for(self, enough: Callable[[Reports], bool], seconds: float = PATIENCE) -> Reports:
        """The reports, once there are enough of them."""
        deadline = time.monotonic() + seconds
        while not enough(self.reports):
            assert not (why := self._alive()), why
            said = [f"{report.window.index} {report.window.quality}" for report in self.reports]
            assert time.monotonic() < deadline, f"not enough in {seconds:g} s: {said}"
            try:
                self.reports.append(ReportDocument.from_json(self._received.get(timeout=0.5)))
            except queue.Empty:
                continue
        return self.reports

    def wait_for_good(self, count: int) -> Reports:
        """The reports, once ``count`` more good windows have come, and the newest one was estimated."""
        before = len(good(self.reports))
        return self.wait_for(lambda reports: len(good(reports)) >= before + count and is_estimated(reports[-1]))

    def wait_for_window(self) -> Reports:
        """The reports, once that of a window which begins after this call has come."""
        moment = time.time()
        return self.wait_for(lambda reports: reports[-1].window.start >= moment)

    def close(self) -> None:
        """End the session."""
        self._subscriber.__exit__(None, None, None)


class Machine:
    """A machine file and a scenario for the kernel's bus, and programs in the background, whose logs are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.file, self.scenario = folder / "machine.toml", folder / "scenario.toml"
        self.dbc = Path(shutil.copy(EXAMPLES / "dc-motor.dbc", folder))
        example = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
        text = example.replace('type = "can"\n', f'type = "can"\n{BUS}')
        self.file.write_text(f'{text}\n{WINDOW}[zenoh]\nlisten = ["{self.endpoint}"]\n', encoding="utf-8")
        self.scenario.write_text(SCENARIO, encoding="utf-8")
        self._programs: list[Program] = []
        self._listeners: list[ReportListener] = []

    def start(self, *command: str) -> Program:
        """A program in the background."""
        log = self.folder / f"{len(self._programs)}-{Path(command[0]).name}.log"
        with log.open("wb") as stream:
            environment = {**os.environ, "XDG_STATE_HOME": str(self.folder / "state")}
            process = subprocess.Popen(command, stdout=stream, stderr=subprocess.STDOUT, env=environment)
        self._programs.append(Program(process, log))
        return self._programs[-1]

    def plant(self) -> Program:
        """The simulated machine, once it is on the bus."""
        program = self.start(*PUNCTUALLY, *OTOLITH, "plant", str(self.scenario))
        program.wait_for_output("Ctrl-C ends it")
        return program

    def daemon(self, seconds: float = PATIENCE) -> tuple[Program, ReportListener]:
        """The daemon, once it has published its first report, and a listener to its reports."""
        program = self.start(*OTOLITH, "run", str(self.file))
        program.wait_for_output("reports on")
        listener = self.listener(lambda: "" if program.process.poll() is None else program.text())
        listener.wait_for(lambda reports: len(reports) >= 1, seconds)
        return program, listener

    def listener(self, alive: Callable[[], str]) -> ReportListener:
        """A listener to the reports of this machine's daemon."""
        self._listeners.append(ReportListener(self.endpoint, alive))
        return self._listeners[-1]

    def close(self) -> None:
        """End what still runs."""
        for listener in self._listeners:
            listener.close()
        for program in reversed(self._programs):
            program.stop()


@contextmanager
def machine_on_a_bus(folder: Path) -> Iterator[Machine]:
    """A CAN bus of the kernel with its counters at zero and no node on it."""
    run("ip", "link", "add", CHANNEL, "type", "vcan")
    machine = Machine(folder)
    try:
        run("ip", "link", "set", CHANNEL, "up")
        yield machine
    finally:
        machine.close()
        if STATISTICS.exists():
            run("ip", "link", "delete", CHANNEL)


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Kernels in the cache, so that no daemon of a test is behind for having to compile them."""
    begun = time.monotonic()
    with machine_on_a_bus(tmp_path_factory.mktemp("compiled")) as machine:
        machine.daemon(seconds=400.0)
    print(f"kernels compiled, or found, in {time.monotonic() - begun:.1f} s")


@pytest.fixture(scope="session")
def press(tmp_path_factory: pytest.TempPathFactory) -> "Instance":
    """A service that has estimated, raised an event, and found a component that is approved."""
    from tests.vm.service import learned_instance  # noqa: PLC0415 - it imports this module

    return learned_instance(tmp_path_factory.mktemp("press"))


@pytest.fixture
def machine(compiled: None, tmp_path: Path) -> Iterator[Machine]:
    """Plant and daemon to be started on a bus of their own."""
    with machine_on_a_bus(tmp_path) as made:
        yield made
