"""The table of drivers, and the entry points through which other packages add theirs."""

from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from otolith_drivers.base import DriverType
from otolith_drivers.errors import ConfigurationError, installation_of, nearest

ENTRY_POINT_GROUP = "otolith.drivers"

# A module is imported only when its driver is selected.
DRIVERS: dict[str, str] = {
    "can": "otolith_drivers.canbus.driver",
    "modbus": "otolith_drivers.modbus.driver",
    "mqtt": "otolith_drivers.mqtt",
    "opcua": "otolith_drivers.opcua.driver",
    "plant": "otolith_drivers.plant.driver",
    "replay": "otolith_drivers.replay.driver",
}
EXTRAS = ("mqtt", "opcua")
"""Drivers whose libraries come with the extra of the same name."""


def known() -> list[str]:
    """Return the names that a machine file may give as ``driver.type``."""
    return sorted({*DRIVERS, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))})


def find(name: str) -> DriverType:
    """Return the driver module called ``name``.

    Raises:
        ConfigurationError: no driver has this name, or its package cannot be imported.
    """
    try:
        if name in DRIVERS:
            return cast("DriverType", import_module(DRIVERS[name]))
        for point in entry_points(group=ENTRY_POINT_GROUP, name=name):
            return cast("DriverType", point.load())
    except ImportError as error:
        if name in EXTRAS:
            missing = f"driver {name!r} needs the extra {name!r}"
            raise ConfigurationError(f"{missing}: {installation_of(name)} ({error})") from error
        raise ConfigurationError(f"driver {name!r} cannot be loaded: {error}") from error
    text = f"unknown driver {name!r}: {nearest(name, known())}; a package that brings its own must be installed here"
    raise ConfigurationError(text)
