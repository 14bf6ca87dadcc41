"""The same machine and scenario give the same armature resistance over every transport."""

from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import ReportDocument
from tests.conftest import TRANSPORTS, OwnMachine
from tests.system.conftest import Running, is_estimated
from tests.waiting import EXACT, within

TRUE = 6.5  # ohm
OFTEN = ("can", "modbus-rtu")  # no other test of make test estimates over the latter
MAX_DEVIATION = 3.5  # standard deviations: one run in two thousand exceeds them by chance


def is_healthy(report: ReportDocument) -> bool:
    """Whether window, estimate and connection of the report are good."""
    good = is_estimated(report) and report.window.quality.verdict is Verdict.GOOD
    connected = report.driver is not None and report.driver.up
    return good and connected and (report.driver is None or not report.driver.warnings or not EXACT)


@pytest.mark.timed
@pytest.mark.parametrize(
    "transport", [pytest.param(name, marks=() if name in OFTEN else pytest.mark.full) for name in TRANSPORTS]
)
def test_every_transport_gives_the_same_resistance(transport: str, tmp_path: Path) -> None:
    running = Running(OwnMachine(tmp_path / transport, transport, faults=""), tmp_path)
    try:
        reports = running.wait_for(lambda reports: sum(map(is_estimated, reports)) >= 5 and is_healthy(reports[-1]))
        last = reports[-1]
        parameter = last.parameters["R_a"]
        assert parameter.value is not None
        assert parameter.sd is not None
        assert abs(parameter.value - TRUE) <= MAX_DEVIATION * parameter.sd
        assert parameter.sd <= 0.005 * TRUE
        assert not last.components
        assert last.counters is not None
        # On a busy computer the simulated drive is late, and repeated register values are counted as bad.
        assert last.counters.bad <= (within(0.05) * last.counters.received if "modbus" in transport else 0)
    finally:
        running.close()
