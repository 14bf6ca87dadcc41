"""The outlets that there are, one a row."""

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from otolith.site.collector import Collector
from otolith.site.outlets.base import Build, OutletSetup
from otolith.site.outlets.options import OutletsTable
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
    "webhook": OutletKind("otolith.site.outlets.webhook"),
    "mail": OutletKind("otolith.site.outlets.mail"),
    "opcua": OutletKind("otolith.site.outlets.opcua", "asyncua", "opcua"),
}


def runners_of(
    table: OutletsTable, setup: OutletSetup, collector: Collector, file: SourceFile | None
) -> list[OutletRunner]:
    """Return what runs the outlets of a file, not started.

    Raises:
        ConfigurationError: a file that one names cannot be used.
        ServiceError: a library is missing.
    """
    runners = []
    for name, kind in OUTLETS.items():
        if (options := getattr(table, name)) is not None:
            try:
                outlet = kind.build()(options, setup)
            except ConfigurationError as error:
                if file is not None:
                    Context(file).fail(("outlets", name, *error.key[1:]), str(error))
                raise
            runners.append(OutletRunner(name, outlet, collector, setup, options.per_hour))
    return runners


@contextmanager
def running(runners: list[OutletRunner]) -> Iterator[None]:
    """Outlets that run until the end of the block."""
    for runner in runners:
        runner.start()
    try:
        yield
    finally:
        for runner in runners:
            runner.stop()
