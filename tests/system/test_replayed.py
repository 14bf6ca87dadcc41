"""The daemon over a recording instead of a machine."""

import queue
import subprocess
import sys
import time
from pathlib import Path

import pytest

from otolith.health.report import ReportDocument
from otolith.outlets.zenoh_session import Listener
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.conftest import OwnMachine
from tests.replays import MACHINE, recorded, written

DRIVER = """
[driver]
type = "replay"
file = "data.csv"

[signals]
V_a = {}
T_load = {}
i = {}
omega = {}

[recording]
enabled = false
"""


def test_a_recording_in_real_time_says_what_its_replay_says(
    tmp_path: Path, scenario: MotorScenario, own_machine: OwnMachine
) -> None:
    data = written(tmp_path, recorded(scenario))
    machine = tmp_path / "replayed.toml"
    text = MACHINE.read_text(encoding="utf-8") + DRIVER + f'\n[zenoh]\nlisten = ["{own_machine.endpoint}"]\n'
    machine.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "otolith"]
    printed = subprocess.run(
        [*command, "replay", machine, data, "--json"], capture_output=True, text=True, check=True
    ).stdout
    replayed = [ReportDocument.from_json(line) for line in printed.splitlines()]
    heard: queue.SimpleQueue[str] = queue.SimpleQueue()
    reports: list[ReportDocument] = []
    with (
        subprocess.Popen([*command, "run", machine], stderr=subprocess.PIPE, text=True) as daemon,
        Listener([own_machine.endpoint], "otolith/**/report", heard.put),
    ):
        deadline = time.monotonic() + 60.0
        while len(reports) < 4:
            assert time.monotonic() < deadline, reports
            reports.append(ReportDocument.from_json(heard.get(timeout=60.0)))
        daemon.terminate()
        assert daemon.wait(timeout=10) == 0
    good = [report for report in reports if report.window.quality.verdict == "good"]
    assert len(good) >= 2
    for report in good:
        again = replayed[report.window.index].parameters["R_a"]
        found = report.parameters["R_a"]
        assert again.low is not None
        assert again.high is not None
        assert found.value == pytest.approx(again.value, abs=again.high - again.low)
