"""The drivers of a machine file: one, or several, each with the signals that it reads.

Errors name file, line and key.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from otolith.machine_file import MachineFile, SignalTable, check_name
from otolith.twin.definition import Definition
from otolith_drivers.base import Driver, DriverType, Setup, Signal, find_driver
from otolith_drivers.config_files import Context, SourceFile, validate
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.several_sources import NamedSource, SeveralSources

TEMPERATURE_UNIT = "K"


@dataclass(frozen=True, slots=True)
class DriverConfig:
    """A driver that a machine file names, with its validated options."""

    name: str
    """Of the source; the type of the driver if the file has no name."""
    place: tuple[int | str, ...]
    """Where the file has its table."""
    kind: str
    """Its ``type``."""
    module: DriverType
    options: Any
    """Instance of the module's ``Options``."""
    setup: Setup
    file: SourceFile

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that the driver reads."""
        return tuple(signal.name for signal in self.setup.signals)

    def build(self) -> Driver:
        """Return the driver, which is not open."""
        with self.located_errors():
            return self.module.build(self.options, self.setup)

    @contextlib.contextmanager
    def located_errors(self) -> Iterator[None]:
        """Add file and line to the errors of a driver, which knows only the key."""
        try:
            yield
        except ConfigurationError as error:
            if error.key:
                is_option = error.key[:1] == ("driver",)
                Context(self.file).fail((*self.place, *error.key[1:]) if is_option else error.key, str(error))
            raise


def driver_configs(file: MachineFile, twin: Definition, source: SourceFile) -> tuple[DriverConfig, ...]:
    """Return what ``[driver]`` or each ``[[driver]]`` configures, with its signals of ``[signals]``.

    Raises:
        ConfigurationError: a table is missing, or has an unknown or invalid key, or does not fit the twin.
    """
    context = Context(source)
    if not file.drivers:
        remedy = "write [driver] with type = \"can\" or another driver, and [signals]; only 'otolith replay' needs none"
        context.fail(("driver",), f"missing: {remedy}")
    units = signal_units(file, twin)
    needed = list(units)
    for name in file.signals:
        if name not in needed:
            context.fail(("signals", name), f"twin {twin.name!r} has no such signal: {nearest(name, needed)}")
    for name, unit in units.items():
        if name not in file.signals:
            reason = f"the twin needs {', '.join(twin.signals)}" if name in twin.signals else "[parameters] names it"
            context.fail(("signals",), f"{name} ({unit}) is missing: {reason}")
    names = source_names(file, context)
    readers = {name: _source_of(name, file, names, context) for name in needed}
    for number, name in enumerate(names):
        if name not in readers.values():
            remedy = f'write source = "{name}" for a signal in [signals], or remove this [[driver]]'
            context.fail(_place(file, number), f"no signal comes from source {name!r}: {remedy}")
    return tuple(
        _driver_config(number, [signal for signal in needed if readers[signal] == name], file, twin, source)
        for number, name in enumerate(names)
    )


def signal_units(file: MachineFile, twin: Definition) -> dict[str, str]:
    """Return the signals that the drivers read, with their units: those of the twin, and the observed ones."""
    return {name: twin.unit_of(name) for name in twin.signals} | dict.fromkeys(observed_signals(file), TEMPERATURE_UNIT)


def observed_signals(file: MachineFile) -> tuple[str, ...]:
    """Return the signals of the temperatures that parameters depend on."""
    names = (table.temperature for table in file.parameters.values())
    return tuple(dict.fromkeys(name for name in names if name))


def source_names(file: MachineFile, context: Context) -> list[str]:
    """Return the names of the drivers in the order of the file; a single driver without a name has that of its type.

    Raises:
        ConfigurationError: a name is missing, invalid or used twice.
    """
    names: list[str] = []
    for number, table in enumerate(file.drivers):
        where = (*_place(file, number), "name")
        name = table.get("name")
        if not isinstance(name, str) and (name is not None or isinstance(file.driver, tuple)):
            context.fail(where, 'missing: each [[driver]] needs a name of its own, like name = "drive"')
        with context.at(*where):
            names.append(str(table.get("type")) if name is None else check_name(name))
        if name in names[:-1]:
            context.fail(where, f"{name!r} is the name of another [[driver]] too: give each a name of its own")
    return names


def _place(file: MachineFile, number: int) -> tuple[int | str, ...]:
    """Return where the file has its driver of that number."""
    return ("driver",) if isinstance(file.driver, dict) else ("driver", number)


def _source_of(signal: str, file: MachineFile, names: Sequence[str], context: Context) -> str:
    """Return the name of the driver that reads ``signal``."""
    written = file.signals[signal].get("source")
    if written is None and len(names) == 1:
        return names[0]
    if written is None:
        text = f"missing: the file has {len(names)} drivers, so each signal names its own: {' or '.join(names)}"
        context.fail(("signals", signal, "source"), text)
    if written not in names:
        text = f"no [[driver]] has the name {written!r}: {nearest(str(written), list(names))}"
        context.fail(("signals", signal, "source"), text)
    return str(written)


def _driver_config(
    number: int, signals: Sequence[str], file: MachineFile, twin: Definition, source: SourceFile
) -> DriverConfig:
    """Return the driver of that number in the file, which reads ``signals``."""
    place, table = _place(file, number), file.drivers[number]
    with Context(source).at(*place, "type"):
        kind = table.get("type")
        if not isinstance(kind, str):
            raise ValueError('missing: write type = "can" or another driver')  # noqa: TRY004 - a fault of the file
        module = find_driver(kind)
    written = {key: value for key, value in table.items() if key not in ("type", "name")}
    options = validate(written, module.Options, source, under=place)
    units = signal_units(file, twin)
    own = tuple(
        Signal(
            signal,
            units[signal],
            validate(own_keys(file.signals[signal]), module.Source, source, under=("signals", signal)),
            twin.ordinary_range(signal),
        )
        for signal in signals
    )
    setup = Setup(own, source.path.parent, file.window.sample_period)
    return DriverConfig(table.get("name", kind), place, kind, module, options, setup, source)


def build_driver(configs: Sequence[DriverConfig]) -> Driver:
    """Return the driver of a machine: one, or several as one."""
    if len(configs) == 1:
        return configs[0].build()
    return SeveralSources(tuple(NamedSource(config.name, config.build(), config.signals) for config in configs))


def own_keys(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a signal by which its driver reads it."""
    return {key: value for key, value in table.items() if key not in SignalTable.model_fields}
