"""The registry of drivers."""

import re
import shlex
import sys
import tomllib

import pytest

from otolith_drivers import base
from otolith_drivers.errors import ConfigurationError, installation_of
from tests.conftest import EXAMPLES


def test_unknown_driver_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'can'"):
        base.find_driver("cam")


@pytest.mark.parametrize(("name", "library"), [("opcua", "asyncua"), ("mqtt", "paho.mqtt")])
def test_a_missing_library_is_named_with_its_extra(name: str, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in [module for module in sys.modules if module.startswith((f"otolith_drivers.{name}", library))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ConfigurationError, match=re.escape(installation_of(name))):
        base.find_driver(name)


def test_an_extra_is_installed_by_its_libraries_as_otolith_is_in_no_index() -> None:
    extras = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"][
        "optional-dependencies"
    ]
    for name in ("mf4", "mqtt", "opcua"):
        interpreter, *words, library = shlex.split(installation_of(name))
        assert [interpreter, *words] == [sys.executable, "-m", "pip", "install"]
        (declared,) = extras[name]
        assert sorted(re.findall(r"[\w.-]+|[<>=]+[\d.]+", library)) == sorted(
            re.findall(r"[\w.-]+|[<>=]+[\d.]+", declared)
        )
