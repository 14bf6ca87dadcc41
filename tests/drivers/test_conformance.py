"""The contract every driver keeps, parametrised over the registry: a new driver is tested by being there."""

from collections.abc import Callable

import pytest

from otolith_drivers import conformance, registry
from otolith_drivers.conformance import CONTRACT, Rig
from otolith_drivers.errors import ConfigurationError
from tests.conftest import OwnMachine
from tests.drivers.rigs import RIGS
from tests.waiting import PATIENCE, within


@pytest.mark.timed
@pytest.mark.parametrize("promise", CONTRACT, ids=lambda promise: promise.__name__)
@pytest.mark.parametrize("name", sorted(registry.DRIVERS))
def test_every_driver_keeps_the_contract(
    name: str, promise: Callable[[Rig], None], own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conformance, "PATIENCE", PATIENCE)
    monkeypatch.setattr(conformance, "STOPS_WITHIN", within(conformance.STOPS_WITHIN))
    with RIGS[name](own_machine) as rig:
        promise(rig)
        rig.driver.close()


def test_an_unknown_driver_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'can'"):
        registry.find("cam")
