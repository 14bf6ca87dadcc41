"""The same machine and scenario, however its signals come: the same armature resistance within its intervals."""

from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import Status
from tests.conftest import TRANSPORTS, OwnMachine
from tests.system.conftest import Running

TRUE = 6.5  # ohm
SURE = 3.5  # standard deviations: one run in two thousand misses them by chance


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_the_armature_resistance_is_the_same_over_every_transport(transport: str, tmp_path: Path) -> None:
    running = Running(OwnMachine(tmp_path / transport, transport, faults=""), tmp_path)
    try:
        reports = running.wait_for(
            lambda reports: sum(report.parameters["R_a"].status is Status.ESTIMATED for report in reports) >= 5, 120.0
        )
        last = reports[-1]
        found = last.parameters["R_a"]
        assert found.value is not None
        assert found.sd is not None
        assert abs(found.value - TRUE) <= SURE * found.sd
        assert found.sd <= 0.005 * TRUE
        assert not last.components
        assert last.window.quality.verdict is Verdict.GOOD
        assert last.counters is not None
        # A computer that is busy lets the simulated drive be late, and an old image is not believed.
        assert last.counters.bad <= (0.05 * last.counters.received if "modbus" in transport else 0)
        assert last.driver is not None
        assert last.driver.up
        assert not last.driver.warnings
    finally:
        running.close()
