"""An output that fails for a while is no event: disks are full for a minute, networks and clocks come after a boot."""

import pytest

from otolith.machine import load_machine
from otolith.runtime.service import OUTAGE_AFTER, Service
from otolith_drivers.errors import ServiceError
from tests.conftest import EXAMPLES
from tests.waiting import PATIENCE, wait_for


def test_an_output_has_an_outage_once_it_has_failed_for_long_until_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("otolith.storage.disk.WRITE_RETRY", 0.0)
    service = Service(load_machine(EXAMPLES / "dc-motor-in-process.toml"))
    writer = service._writer
    assert service._outages(0.0) == {}
    writer.fail(ServiceError("the disk is busy"))
    assert service._outages(10.0) == {}
    writer.fail(ServiceError("the disk is full"))
    assert service._outages(9.9 + OUTAGE_AFTER) == {}
    ((name, reason),) = service._outages(10.0 + OUTAGE_AFTER).items()
    assert name == "state"
    assert "the disk is full" in reason

    writer.start()
    wait_for(lambda: not writer.outage)
    writer.stop(PATIENCE)
    assert service._outages(1000.0) == {}
    writer.fail(ServiceError("the disk is full"))
    assert service._outages(1010.0) == {}
