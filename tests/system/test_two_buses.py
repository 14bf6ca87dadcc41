"""One motor on two buses at once: current and voltage over CAN, speed over Modbus TCP; each is unplugged and back."""

import json
from collections.abc import Callable
from itertools import pairwise, starmap
from pathlib import Path

import pytest

from otolith.health.schema import ReportDocument, SourceDocument, Status
from tests.conftest import EXAMPLES, OwnMachine
from tests.system.conftest import Running

TRUTH = {"R_a": 6.5, "D": 0.00143, "J": 0.001171}
MAX_DEVIATION = 3.5  # standard deviations: one run in two thousand exceeds them by chance
GONE = '[[faults]]\nkind = "gone"\non = "{}"\nstart = "{} s"\nuntil = "{} s"\n'
BEGIN, CYCLE, CYCLES = 8, 16, 12  # s; a daemon whose kernels are compiled first misses some of the cycles
SPANS = {"modbus-tcp": (0, 4), "can": (7, 12)}  # s of each cycle


class TwoBuses(OwnMachine):
    """The example for two buses, on ports of its own; the one and the other is unplugged, in turn."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        bus = f'dbc = "{self.dbc}"\n{self._bus()}'
        text = (EXAMPLES / "dc-motor-two-buses.toml").read_text(encoding="utf-8")
        text = text.replace('dbc = "dc-motor.dbc"\n', bus).replace("port = 1502", f"port = {self.tcp_port}")
        self.machine.write_text(f'{text}\n[zenoh]\nlisten = ["{self.endpoint}"]\n', encoding="utf-8")
        text = (EXAMPLES / "scenarios" / "two-buses.toml").read_text(encoding="utf-8")
        text = text.replace('dbc = "../dc-motor.dbc"', f'dbc = "{self.dbc}"')
        text = text.replace("[noise]", f"[bus]\n{self._bus()}\n[modbus]\nport = {self.tcp_port}\n\n[noise]")
        text = text.partition('[[faults]]\nkind = "gone"')[0]
        for begin in range(BEGIN, BEGIN + CYCLE * CYCLES, CYCLE):
            text += "".join(GONE.format(on, begin + start, begin + until) for on, (start, until) in SPANS.items())
        self.scenario.write_text(text, encoding="utf-8")

    @property
    def plays(self) -> list[str]:
        return [str(self.scenario), "--as", "can", "--as", "modbus-tcp"]


def source(report: ReportDocument, name: str) -> SourceDocument:
    assert report.driver is not None
    return report.driver.sources[name]


@pytest.mark.timed
def test_each_bus_may_be_unplugged_and_come_back(tmp_path: Path) -> None:
    running = Running(TwoBuses(tmp_path / "machine"), tmp_path)
    try:
        begun = first(running, lambda report: all_up(report) and is_healthy(report))
        down = first(running, lambda report: not source(report, "encoder").up)
        assert down.driver is not None
        assert down.driver.up
        assert any("source 'encoder' is down" in warning for warning in down.driver.warnings)
        back = running.wait_for(lambda reports: any(starmap(encoder_alone_is_back, pairwise(reports))))[-1]
        assert source(back, "drive").received > source(down, "drive").received > source(begun, "drive").received
        silent = first(running, lambda report: is_named(report, "drive"))
        assert source(silent, "encoder").up
        back = first(running, lambda report: all_up(report) and is_healthy(report))
        assert source(back, "drive").reconnects > source(begun, "drive").reconnects
        for name, value in TRUTH.items():
            parameter = back.parameters[name]
            assert parameter.value is not None
            assert parameter.sd is not None
            assert abs(parameter.value - value) <= MAX_DEVIATION * parameter.sd, name
        assert not back.components
    finally:
        running.close()
    nodes = json.loads(running.summary.read_text(encoding="utf-8"))["nodes"]
    assert [node["transport"] for node in nodes] == ["can", "modbus-tcp"]


def first(running: Running, is_meant: Callable[[ReportDocument], bool]) -> ReportDocument:
    """The next report that is meant."""
    seen = len(running.reports)
    return running.wait_for(lambda reports: len(reports) > seen and is_meant(reports[-1]))[-1]


def encoder_alone_is_back(before: ReportDocument, after: ReportDocument) -> bool:
    """Whether the encoder was connected again between two reports, and the drive was not."""
    more = {name: source(after, name).reconnects - source(before, name).reconnects for name in ("encoder", "drive")}
    return more == {"encoder": 1, "drive": 0}


def all_up(report: ReportDocument) -> bool:
    """Whether no source is down."""
    return source(report, "encoder").up and source(report, "drive").up


def is_named(report: ReportDocument, name: str) -> bool:
    """Whether the report gives an absent source as the cause why a parameter is not estimated."""
    return any(f"source {name!r} (" in parameter.reason for parameter in report.parameters.values())


def is_healthy(report: ReportDocument) -> bool:
    """Whether the window gave an estimate of the armature resistance."""
    return report.parameters["R_a"].status is Status.ESTIMATED
