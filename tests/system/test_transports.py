"""The same machine and scenario give the same armature resistance over every transport."""

from pathlib import Path

import pytest

from otolith.acquisition.window import Verdict
from otolith.health.schema import ReportDocument
from tests.conftest import TRANSPORTS, OwnMachine
from tests.system.conftest import Running, is_estimated
from tests.variants import often
from tests.waiting import EXACT, within

TRUE = 6.5  # ohm
OFTEN = ("can", "modbus-rtu")  # no other test of make test estimates over the latter
OTHERS = tuple(name for name in TRANSPORTS if name not in OFTEN)
MAX_DEVIATION = 3.5  # standard deviations: one run in two thousand exceeds them by chance


def is_healthy(report: ReportDocument) -> bool:
    """Whether window, estimate and connection of the report are good."""
    good = is_estimated(report) and report.window.quality.verdict is Verdict.GOOD
    connected = report.driver is not None and report.driver.up
    return good and connected and (report.driver is None or not report.driver.warnings or not EXACT)


@pytest.mark.timed
@pytest.mark.parametrize("transports", often([OFTEN], [OFTEN, OTHERS]), ids=" and ".join)
def test_every_transport_gives_the_same_resistance(
    transports: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two machines at a time, which have nothing in common but the computer."""
    running: dict[str, Running] = {}
    try:
        for transport in transports:
            monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / f"state of {transport}"))
            (tmp_path / transport).mkdir()
            machine = OwnMachine(tmp_path / transport / "machine", transport, faults="")
            running[transport] = Running(machine, tmp_path / transport)
        for transport, one in running.items():
            assert_right(transport, one)
    finally:
        for one in running.values():
            one.close()


def assert_right(transport: str, running: Running) -> None:
    """The resistance, soon."""
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
