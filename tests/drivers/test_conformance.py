"""Every driver of the registry keeps the contract; a new driver is tested as soon as it has a row and a rig."""

from collections.abc import Callable

import pytest

from otolith_drivers import conformance, registry
from otolith_drivers.conformance import CONTRACT, Rig
from tests.conftest import OwnMachine
from tests.drivers.rigs import RIGS
from tests.waiting import PATIENCE, within


@pytest.mark.timed
@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", sorted(registry.DRIVERS))
def test_driver_keeps_the_contract(
    name: str, check: Callable[[Rig], None], own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conformance, "SAMPLES_TIMEOUT", PATIENCE)
    monkeypatch.setattr(conformance, "CLOSE_TIMEOUT", within(conformance.CLOSE_TIMEOUT))
    with RIGS[name](own_machine) as rig:
        check(rig)
        rig.driver.close()
