"""The outlets that there are, one a row."""

import importlib
import importlib.util
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from otolith.outlet_tables import OutletsTable
from otolith.site.outlets.base import Build, Known, Outlet, OutletSetup
from otolith.site.outlets.runner import OutletRunner
from otolith_drivers.config_files import Context, SourceFile
from otolith_drivers.errors import ConfigurationError, ServiceError, installation_of


@dataclass(frozen=True, slots=True)
class OutletKind:
    """An outlet, by the name of its table."""

    module: str  # Has ``build``, which takes its options and an :class:`OutletSetup`
    library: str = ""  # That it needs beside the extra 'site', and the extra that has it
    extra: str = ""

    def build(self) -> Build:
        """Return what builds it; raise ServiceError if its library is missing."""
        if self.library and importlib.util.find_spec(self.library) is None:
            raise ServiceError(f"{self.library} is missing: {installation_of(self.extra)}")
        build: Build = importlib.import_module(self.module).build
        return build


OUTLETS = {
    "mqtt": OutletKind("otolith.site.outlets.mqtt", "paho", "mqtt"),
    "sparkplug": OutletKind("otolith.site.outlets.sparkplug", "paho", "mqtt"),
    "webhook": OutletKind("otolith.site.outlets.webhook"),
    "mail": OutletKind("otolith.site.outlets.mail"),
    "opcua": OutletKind("otolith.site.outlets.opcua", "asyncua", "opcua"),
    "prometheus": OutletKind("otolith.site.outlets.prometheus", "uvicorn", "site"),
}


def configured(table: OutletsTable) -> dict[str, Any]:
    """Return the options of the outlets that a file has, by their names."""
    return {name: options for name in OUTLETS if (options := getattr(table, name)) is not None}


def built(name: str, options: Any, setup: OutletSetup, file: SourceFile | None) -> Outlet:
    """Return an outlet of a file.

    Raises:
        ConfigurationError: a file that it names cannot be used.
        ServiceError: its library is missing.
    """
    try:
        return OUTLETS[name].build()(options, setup)
    except ConfigurationError as error:
        if file is not None:
            Context(file).fail(("outlets", name, *error.key[1:]), str(error))
        raise


def runners_of(table: OutletsTable, setup: OutletSetup, known: Known, file: SourceFile | None) -> list[OutletRunner]:
    """Return what runs the outlets of a file, not started; raise as :func:`built`."""
    return [
        OutletRunner(name, built(name, options, setup, file), known, setup, options.per_hour)
        for name, options in configured(table).items()
    ]


@contextmanager
def running(runners: list[OutletRunner]) -> Iterator[None]:
    """Outlets that run until the end of the block."""
    for runner in runners:
        runner.start()
    try:
        yield
    finally:
        stop(runners)


def stop(runners: Sequence[OutletRunner]) -> None:
    """End outlets, all at the same time."""
    for runner in runners:
        runner.end()
    for runner in runners:
        runner.stop()
