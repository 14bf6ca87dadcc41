"""The daemon with a recording instead of a machine, and the replay of the daemon's recording."""

import queue
import subprocess
import sys
import time
from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import ParameterDocument, ReportDocument
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.cli.replays import MACHINE, PERIOD, recorded, written
from tests.conftest import OwnMachine
from tests.system.conftest import Running
from tests.waiting import PATIENCE

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


def is_good(report: ReportDocument) -> bool:
    """Whether the window of the report was good."""
    return report.window.quality.verdict is Verdict.GOOD


def width(parameter: ParameterDocument) -> float:
    """The width of the 95 % interval."""
    assert parameter.low is not None
    assert parameter.high is not None
    return parameter.high - parameter.low


def replayed(*arguments: object) -> list[ReportDocument]:
    """Return the reports of ``otolith replay``."""
    command = [sys.executable, "-m", "otolith", "replay", *map(str, arguments), "--json"]
    printed = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=True).stdout
    return [ReportDocument.from_json(line) for line in printed.splitlines()]


@pytest.mark.full
@pytest.mark.parametrize("transport", ["in-process", pytest.param("can", marks=(pytest.mark.full, pytest.mark.timed))])
def test_the_daemons_recording_replays_to_the_same_reports(transport: str, tmp_path: Path) -> None:
    """On a busy computer only the plant in the daemon's process has no jitter, which would move the windows."""
    running = Running(OwnMachine(tmp_path / "machine", transport), tmp_path)
    try:
        reports = list(running.wait_for(lambda reports: len(reports) >= 7))
        assert running.stop()[0] == 0
    finally:
        running.close()
    again = replayed(running.machine.machine, running.recording)
    compared = 0
    for report in reports:
        other = min(again, key=lambda document: abs(document.window.start - report.window.start))
        replayed_parameter, expected = other.parameters["R_a"], report.parameters["R_a"]
        assert other.window.start == pytest.approx(report.window.start, abs=PERIOD / 2)
        assert other.window.quality.verdict is report.window.quality.verdict
        assert replayed_parameter.status is expected.status
        if expected.value is not None:
            compared += 1
            assert replayed_parameter.value == pytest.approx(expected.value, rel=1e-6)
    assert compared >= 3


@pytest.mark.full
def test_a_real_time_replay_estimates_as_the_fast_one(
    tmp_path: Path, scenario: MotorScenario, own_machine: OwnMachine
) -> None:
    data = written(tmp_path, recorded(scenario, 20))  # more than a busy computer misses while it starts
    machine = tmp_path / "replayed.toml"
    text = MACHINE.read_text(encoding="utf-8") + DRIVER + f'\n[zenoh]\nlisten = ["{own_machine.endpoint}"]\n'
    machine.write_text(text, encoding="utf-8")
    expected = replayed(machine, data)
    received: queue.SimpleQueue[str] = queue.SimpleQueue()
    reports: list[ReportDocument] = []
    with (
        subprocess.Popen(
            [sys.executable, "-m", "otolith", "run", machine], stderr=subprocess.PIPE, text=True
        ) as daemon,
        Subscriber(Connection((own_machine.endpoint,)), received.put),
    ):
        deadline = time.monotonic() + 2 * PATIENCE
        while len(reports) < 4 or sum(map(is_good, reports)) < 2:
            assert time.monotonic() < deadline, reports
            reports.append(ReportDocument.from_json(received.get(timeout=2 * PATIENCE)))
        daemon.terminate()
        assert daemon.wait(timeout=PATIENCE) == 0
    for report in filter(is_good, reports):
        # A busy computer misses windows, so that the daemon has learned from fewer of them and is less sure.
        fast, ours = expected[report.window.index].parameters["R_a"], report.parameters["R_a"]
        assert ours.value == pytest.approx(fast.value, abs=max(width(fast), width(ours)))
