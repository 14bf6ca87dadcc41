"""The path of docs/modbus.md, command by command: from a drive without a manual to a fault that is named."""

import queue
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymodbus.client import ModbusTcpClient

from otolith.acquisition.window import Verdict
from otolith.health.limits import Level
from otolith.health.schema import EventDocument, ReportDocument, Status
from otolith.health.text import announcements, awaits_commissioning
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from tests.cli.commands import otolith, tables
from tests.conftest import free_port
from tests.system import modbus_drive
from tests.waiting import PATIENCE, wait_for

PAGE = Path(__file__).parents[2] / "docs" / "modbus.md"
COMMANDS = [shlex.split(line)[1:] for line in re.findall(r"^    (otolith .*)$", PAGE.read_text("utf-8"), re.MULTILINE)]
HOST = "192.168.0.10"  # of the page
WINDOWS = 25  # that are recorded before commissioning; the page waits for five minutes
SHORT = ("--seconds", "2", "--sample-period", "20 ms", "--window", "1 s")
FACTOR = 1.6  # on the resistance
LARGEST_ERROR = 0.1  # of a value that 'otolith commission' writes
TRUTH = {"R_a": modbus_drive.R, "L_a": modbus_drive.L, "J": modbus_drive.J, "K_e": modbus_drive.K}


@contextmanager
def running(*command: object) -> Iterator["subprocess.Popen[str]"]:
    """A process that is ended at the end."""
    texts = [sys.executable, "-m", *map(str, command)]
    with subprocess.Popen(texts, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.terminate()


def display(port: int) -> dict[str, str]:
    """What the display of the drive shows."""
    with ModbusTcpClient("127.0.0.1", port=port) as client:
        wait_for(client.connect)
        registers = client.read_holding_registers(modbus_drive.FIRST, count=modbus_drive.COUNT).registers
    return {
        "V_a": f"{registers[1] / 100:.1f} V",
        "i": f"{registers[2] / 1000:.2f} A",
        "omega": f"{registers[3] / 10:.0f} rpm",
    }


class Reports:
    """The reports of the daemons of this test, in order."""

    def __init__(self) -> None:
        self._texts: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.subscriber = Subscriber(Connection(), self._texts.put)

    def until(self, is_enough: Callable[[list[ReportDocument]], bool]) -> list[ReportDocument]:
        """Return the next reports until they are enough."""
        found = list[ReportDocument]()
        while not is_enough(found):
            found.append(ReportDocument.from_json(self._texts.get(timeout=3 * PATIENCE)))
        return found


def good(reports: list[ReportDocument]) -> int:
    return sum(report.window.quality.verdict is Verdict.GOOD for report in reports)


def is_estimated(reports: list[ReportDocument]) -> bool:
    """Whether the winding is known, and well."""
    return bool(reports) and reports[-1].parameters["R_a"].status is Status.ESTIMATED and not reports[-1].open_events


def alarms(reports: list[ReportDocument]) -> list[EventDocument]:
    return [event for report in reports for event in announcements(report) if event.state in (Level.WATCH, Level.ACT)]


def test_the_commands_of_the_page_lead_to_a_fault_that_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    init, check, run, commission, again, watch = COMMANDS
    assert (run, watch) == (again, ["watch", "drive"])
    order, port, reports = tmp_path / "order", free_port(socket.SOCK_STREAM), Reports()
    order.write_text("steady 1.0", encoding="ascii")
    with running("tests.system.modbus_drive", port, order), reports.subscriber:
        shown = display(port)
        monkeypatch.chdir(tmp_path)
        told = [re.sub(r"^(V_a|i|omega)=.*", lambda match: f"{match[1]}={shown[match[1]]}", text) for text in init]
        otolith(*(f"127.0.0.1:{port}" if text == HOST else text for text in told), "--registers", "100..104", *SHORT)
        order.write_text("cycle 1.0", encoding="ascii")
        assert otolith(*check).return_value == 0
        with running("otolith", *run):
            before = reports.until(lambda found: good(found) >= WINDOWS)
        assert any(map(awaits_commissioning, before))
        assert alarms(before) == []
        otolith(*commission)
        written = {name: float(str(row["value"] if isinstance(row, dict) else row).split()[0])
                   for name, row in tables(tmp_path / "drive.toml")["parameters"].items()}  # fmt: skip
        for name, truth in TRUTH.items():
            assert written[name] == pytest.approx(truth, rel=LARGEST_ERROR), name
        with running("otolith", *again):
            healthy = reports.until(is_estimated)
            assert alarms(healthy) == []
            assert not any(map(awaits_commissioning, healthy[-1:]))
            order.write_text(f"cycle {FACTOR}", encoding="ascii")
            ill = reports.until(lambda found: bool(alarms(found)))
    (alarm,) = alarms(ill)
    assert alarm.part == "winding"
    assert alarm.advice
