"""The same machine and scenario, however its signals come: the same armature resistance within its intervals."""

from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import ReportDocument, Status
from tests.conftest import TRANSPORTS, OwnMachine
from tests.system.conftest import Running
from tests.waiting import within

TRUE = 6.5  # ohm
SURE = 3.5  # standard deviations: one run in two thousand misses them by chance


def is_estimated(report: ReportDocument) -> bool:
    return report.parameters["R_a"].status is Status.ESTIMATED


def is_healthy(report: ReportDocument) -> bool:
    """Whether window, estimate and connection of this report are good."""
    good = is_estimated(report) and report.window.quality.verdict is Verdict.GOOD
    return good and report.driver is not None and report.driver.up and not report.driver.warnings


@pytest.mark.timed
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_the_armature_resistance_is_the_same_over_every_transport(transport: str, tmp_path: Path) -> None:
    running = Running(OwnMachine(tmp_path / transport, transport, faults=""), tmp_path)
    try:
        reports = running.wait_for(lambda reports: sum(map(is_estimated, reports)) >= 5 and is_healthy(reports[-1]))
        last = reports[-1]
        found = last.parameters["R_a"]
        assert found.value is not None
        assert found.sd is not None
        assert abs(found.value - TRUE) <= SURE * found.sd
        assert found.sd <= 0.005 * TRUE
        assert not last.components
        assert last.counters is not None
        # On a busy computer the simulated drive is late, and the driver rejects an image that has not changed.
        assert last.counters.bad <= (within(0.05) * last.counters.received if "modbus" in transport else 0)
    finally:
        running.close()
