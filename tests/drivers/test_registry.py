"""The registry of drivers."""

import re
import sys

import pytest

from otolith_drivers import base
from otolith_drivers.errors import ConfigurationError


def test_unknown_driver_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'can'"):
        base.find_driver("cam")


@pytest.mark.parametrize(("name", "library"), [("opcua", "asyncua"), ("mqtt", "paho.mqtt")])
def test_a_missing_library_is_named_with_its_extra(name: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [module for module in sys.modules if module.startswith((f"otolith_drivers.{name}", library))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigurationError, match=re.escape(f"{sys.executable} -m pip install 'otolith[{name}]'")):
        base.find_driver(name)
