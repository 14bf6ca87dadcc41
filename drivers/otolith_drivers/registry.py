"""The table of drivers: one lazy row each, and the entry points of other people's packages."""

from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from otolith_drivers.base import DriverType
from otolith_drivers.errors import ConfigurationError, nearest

ENTRY_POINT_GROUP = "otolith.drivers"

# The module is imported only when its driver is chosen.
DRIVERS: dict[str, str] = {
    "can": "otolith_drivers.canbus.driver",
    "modbus": "otolith_drivers.modbus.driver",
    "plant": "otolith_drivers.plant.driver",
    "replay": "otolith_drivers.replay.driver",
}


def known() -> list[str]:
    """The names a machine file may give as ``driver.type``."""
    return sorted({*DRIVERS, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))})


def find(name: str) -> DriverType:
    """The driver called ``name``.

    Raises:
        ConfigurationError: there is none of that name, or its package cannot be imported.
    """
    try:
        if name in DRIVERS:
            return cast("DriverType", import_module(DRIVERS[name]))
        for point in entry_points(group=ENTRY_POINT_GROUP, name=name):
            return cast("DriverType", point.load())
    except ImportError as error:
        raise ConfigurationError(f"driver {name!r} cannot be loaded: {error}") from error
    text = f"unknown driver {name!r}: {nearest(name, known())}; a package that brings its own must be installed here"
    raise ConfigurationError(text)
