"""The driver that a machine file names: which it is, and what the file says to it."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from otolith.errors import ConfigurationError, nearest
from otolith.settings import MachineFile
from otolith.twin.definition import Definition
from otolith_drivers.base import DriverType, Setup, Signal
from otolith_drivers.registry import find
from otolith_drivers.toml_files import Context, Page, validate


@dataclass(frozen=True, slots=True)
class NamedDriver:
    """The driver of a machine file, and what the file says to it."""

    name: str
    module: DriverType
    options: Any
    setup: Setup
    page: Page

    @contextlib.contextmanager
    def faults_placed(self) -> Iterator[None]:
        """What a driver finds wrong is told with file and line."""
        try:
            yield
        except ConfigurationError as error:
            if error.key:
                Context(self.page).fail(error.key, str(error))
            raise


def named_driver(file: MachineFile, twin: Definition, page: Page) -> NamedDriver:
    """What ``[driver]`` and ``[signals]`` say.

    Raises:
        ConfigurationError: they are missing, or say something that cannot be meant.
    """
    context = Context(page)
    if not file.driver:
        way_out = "[driver] with type = \"can\" and the like, and [signals]; only 'otolith replay' does without"
        context.fail(("driver",), f"missing: say where the signals come from by {way_out}")
    wanted = list(twin.signals)
    for name in file.signals:
        if name not in wanted:
            context.fail(("signals", name), f"twin {twin.name!r} has no such signal: {nearest(name, wanted)}")
    for name in wanted:
        if name not in file.signals:
            context.fail(("signals",), f"{name} ({twin.unit_of(name)}) is missing: the twin needs {', '.join(wanted)}")
    with context.at("driver", "type"):
        kind = file.driver.get("type")
        if not isinstance(kind, str):
            raise ValueError('missing: write type = "can" or another driver')  # noqa: TRY004 - a user's slip, not a bug
        module = find(kind)
    rest = {key: value for key, value in file.driver.items() if key != "type"}
    options = validate(rest, module.Options, page, under=("driver",))
    sources = {name: validate(file.signals[name], module.Source, page, under=("signals", name)) for name in wanted}
    signals = tuple(Signal(name, twin.unit_of(name), source) for name, source in sources.items())
    setup = Setup(signals, page.path.parent, file.window.sample_period)
    return NamedDriver(kind, module, options, setup, page)
