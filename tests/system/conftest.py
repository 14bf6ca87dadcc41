"""Real processes: plant and daemon, started as a user starts them, observed from outside."""

import os
import queue
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from otolith.health.schema import ReportDocument, Status
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from tests.conftest import OwnMachine
from tests.waiting import PATIENCE, wait_for

OTOLITH = [sys.executable, "-m", "otolith"]


class Running:
    """Plant and daemon of one machine, and what the daemon publishes."""

    def __init__(self, machine: OwnMachine, folder: Path) -> None:
        self.machine, self.folder = machine, folder
        self.recording, self.truth, self.log = folder / "run.rrd", folder / "truth.csv", folder / "daemon.log"
        self.summary = folder / "summary.json"
        self.daemon = self._start("daemon", "run", str(machine.machine), "--recording", str(self.recording))
        # The clock of the plant starts when the daemon listens, however long a busy computer takes until then.
        wait_for(lambda: "reports on" in self.log.read_text() or self.daemon.poll() is not None)
        plays = [*machine.plays, "--truth", str(self.truth), "--summary", str(self.summary)]
        self.plant = self._start("plant", "plant", *plays) if machine.plays else None
        self._received: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscriber = Subscriber(Connection((machine.endpoint,)), self._received.put)
        self.reports: list[ReportDocument] = []

    def _start(self, name: str, *arguments: str) -> "subprocess.Popen[bytes]":
        with (self.folder / f"{name}.log").open("wb") as log:
            return subprocess.Popen([*OTOLITH, *arguments], stdout=log, stderr=subprocess.STDOUT)

    def wait_for(
        self, enough: Callable[[list[ReportDocument]], bool], seconds: float = 3 * PATIENCE
    ) -> list[ReportDocument]:
        """Return all reports once ``enough`` accepts them; fail with the daemon's log after ``seconds``."""
        deadline = time.monotonic() + seconds
        while not enough(self.reports):
            left = deadline - time.monotonic()
            assert self.daemon.poll() is None, self.log.read_text()
            assert left > 0, f"{len(self.reports)} reports; {self.log.read_text()}"
            try:
                self.reports.append(ReportDocument.from_json(self._received.get(timeout=min(left, 1.0))))
            except queue.Empty:
                continue
        return self.reports

    def child(self, name: str) -> psutil.Process:
        """Return a child process of the daemon: ``worker`` or ``recorder``."""
        index = {"worker": 0, "recorder": 1}[name]
        spawned = [p for p in psutil.Process(self.daemon.pid).children() if "spawn_main" in " ".join(p.cmdline())]
        return sorted(spawned, key=lambda process: process.create_time())[index]

    def stop(self, number: signal.Signals = signal.SIGTERM) -> tuple[int, float]:
        """Stop the daemon; return its exit code and the seconds until it ended."""
        begun = time.monotonic()
        self.daemon.send_signal(number)
        return self.daemon.wait(timeout=PATIENCE), time.monotonic() - begun

    def close(self) -> None:
        """End all processes."""
        self._subscriber.__exit__(None, None, None)
        for process in (self.daemon, self.plant):
            if process is not None and process.poll() is None:
                process.terminate()
                process.wait(timeout=PATIENCE)


def is_estimated(report: ReportDocument) -> bool:
    """Whether the window of the report gave an estimate of the armature resistance."""
    return report.parameters["R_a"].status is Status.ESTIMATED


@pytest.fixture
def running(own_machine: OwnMachine, tmp_path: Path) -> Iterator[Running]:
    """A plant and a daemon; both end with the test."""
    machine = Running(own_machine, tmp_path)
    yield machine
    machine.close()


def descendants() -> set[int]:
    """Return the ids of all descendants of this process."""
    return {process.pid for process in psutil.Process(os.getpid()).children(recursive=True)}
