"""A daemon for several machines that are simulated in it, and what it publishes."""

import queue
import signal
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import psutil

from otolith.health.schema import ReportDocument
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from tests.conftest import EXAMPLES
from tests.waiting import PATIENCE, wait_for

ENDPOINT = "unixsock-stream/{folder}/reports.sock"


def write(folder: Path, name: str, driver: str = "", **changes: str) -> None:
    """Write the file of a machine that is simulated in the daemon."""
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"dc-motor-in-process"', f'"{name}"').replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    if driver:
        text = text.replace(text[text.index("[driver]") : text.index("[signals]")], f"[driver]\n{driver}\n")
    endpoint = ENDPOINT.format(folder=folder.parent)
    (folder / f"{name}.toml").write_text(f'{text}\n[zenoh]\nlisten = ["{endpoint}"]\n', encoding="utf-8")


UNITS = {"ArmatureVoltage": "V", "LoadTorque": "N*m", "ArmatureCurrent": "A", "RotorSpeed": "rad/s"}


def write_modbus(folder: Path, name: str, options: str) -> None:
    """Write the file of a machine whose signals are registers of a Modbus device."""
    write(folder, name, f'type = "modbus"\n{options}')
    text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    for signal_name, unit in UNITS.items():
        own = f'{{ register = 0, type = "float32", unit = "{unit}" }}'
        text = text.replace(f'{{ signal = "{signal_name}" }}', own)
    (folder / f"{name}.toml").write_text(text, encoding="utf-8")


class RunningHall:
    """A daemon for the machines of a folder, and what it publishes of each."""

    def __init__(self, folder: Path) -> None:
        self.log = folder.parent / "daemon.log"
        with self.log.open("wb") as log:
            # A daemon ignores SIGHUP where nohup does so for the tests.
            daemon = [sys.executable, "-m", "otolith", "run", str(folder), "--workers", "2"]
            command = ["env", "--default-signal=HUP", *daemon]
            self.daemon = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        self._received: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._subscriber = Subscriber(Connection((ENDPOINT.format(folder=folder.parent),)), self._received.put)
        self.reports: defaultdict[str, list[ReportDocument]] = defaultdict(list)

    def have(self, count: int, *names: str) -> None:
        """Wait until each of the machines has published ``count`` further reports."""
        self.read()
        wanted = {name: len(self.reports[name]) + count for name in names}

        def enough() -> bool:
            assert self.daemon.poll() is None, self.log.read_text()
            self.read()
            return all(len(self.reports[name]) >= number for name, number in wanted.items())

        wait_for(enough, 3 * PATIENCE)

    def says(self, text: str, *names: str) -> None:
        """Wait until the latest report of each of the machines says a text: in its state or in its notes."""

        def said(name: str) -> bool:
            latest = self.reports[name][-1:]
            return any(text in (report.health.reason if report.health else "") or text in " ".join(report.notes)
                       for report in latest)  # fmt: skip

        def enough() -> bool:
            assert self.daemon.poll() is None, self.log.read_text()
            self.read()
            return all(map(said, names))

        wait_for(enough, PATIENCE)

    def reload(self, until: str) -> None:
        """Have it read its files again, and wait for a further line of its log with a text."""
        before = self.log.read_text(encoding="utf-8").count(until)
        self.daemon.send_signal(signal.SIGHUP)
        wait_for(lambda: self.log.read_text(encoding="utf-8").count(until) > before, PATIENCE)

    def read(self) -> None:
        while not self._received.empty():
            report = ReportDocument.from_json(self._received.get())
            self.reports[report.machine].append(report)

    def children(self) -> list[psutil.Process]:
        """The workers and the recorder."""
        children = psutil.Process(self.daemon.pid).children()
        return sorted((p for p in children if "spawn_main" in " ".join(p.cmdline())), key=lambda p: p.create_time())

    def close(self) -> int:
        self._subscriber.__exit__(None, None, None)
        self.daemon.send_signal(signal.SIGTERM)
        return self.daemon.wait(timeout=PATIENCE)
