"""What a machine file means: its twin, its estimation problem, its driver. Faults are told with file, line and key.

The driver that a machine file names: which it is, and what the file says to it.

What a machine file rules out of the search for components.

Where twins come from: the library that travels with Otolith, and a specialist's own files.

Where recordings go.
"""

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from otolith.acquisition.alignment import Limits
from otolith.estimation.problem import Problem, SwarmOptions, WindowOptions, key_of
from otolith.machine_file import DiscoveryTable, MachineFile, ParameterTable, WindowTable, Written
from otolith.twin.augmentation import sources
from otolith.twin.component_families import NAMES
from otolith.twin.definition import Definition, Parameter, Role
from otolith.twin.language import read_twin
from otolith_drivers.base import Driver, DriverType, Setup, Signal
from otolith_drivers.config_files import Context, SourceFile, expect, parse, read, validate
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.registry import find
from otolith_drivers.units import Quantity
from otolith_drivers.user_dirs import state_directory


@dataclass(frozen=True, slots=True)
class NamedDriver:
    """The driver of a machine file, and what the file says to it."""

    name: str
    module: DriverType
    options: Any
    setup: Setup
    page: SourceFile

    @contextlib.contextmanager
    def faults_placed(self) -> Iterator[None]:
        """What a driver finds wrong is told with file and line."""
        try:
            yield
        except ConfigurationError as error:
            if error.key:
                Context(self.page).fail(error.key, str(error))
            raise


def named_driver(file: MachineFile, twin: Definition, page: SourceFile) -> NamedDriver:
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


def excluded(table: DiscoveryTable, twin: Definition, fail: Callable[[str, str], None]) -> frozenset[str]:
    """Keys of components that are not to be looked for; ``fail`` is told the key of the table and what is wrong."""
    places = [entry.name for entry in twin.sites]
    inputs = [entry.name for entry in sources(twin) if entry.name]
    asked = (("families", table.families, NAMES), ("sites", table.sites, places), ("inputs", table.inputs, inputs))
    for key, names, known in asked:
        for name in names or ():
            if name not in known:
                fail(key, f"{name!r} is none of them: {nearest(name, list(known))}")
    return frozenset(
        key_of(site, family, source.name)
        for site in places
        for family in NAMES
        for source in sources(twin)
        if (table.families is not None and family not in table.families)
        or (table.sites is not None and site not in table.sites)
        or (table.inputs is not None and bool(source.name) and source.name not in table.inputs)
    )


LIBRARY = Path(__file__).parent / "twin" / "library"


def names() -> list[str]:
    """The twins of the library."""
    return sorted(path.stem for path in LIBRARY.glob("*.toml"))


def find_twin(name: str) -> Definition:
    """The twin called ``name`` in the library.

    Raises:
        ConfigurationError: there is none of that name.
    """
    if name not in names():
        raise ConfigurationError(f"unknown twin {name!r}: {nearest(name, names())}")
    return load_twin(LIBRARY / f"{name}.toml")


def load_twin(path: Path) -> Definition:
    """The twin in a file.

    Raises:
        ConfigurationError: unreadable or wrong, one line per fault.
    """
    return read_twin(read(path))


VALUED = ("dbc", "eds", "order", "first_address", "device")  # keys of a driver, that values of signals depend on
SMALLEST_NOISE = 1e-12  # of an output: without any, no residual could be weighed


@dataclass(frozen=True, slots=True)
class LoadedMachine:
    """A machine file understood: everything the service needs to begin."""

    path: Path
    file: MachineFile
    twin: Definition
    problem: Problem
    records: int
    limits: Limits
    source: Driver | None
    """None where the file was loaded without its driver."""

    @property
    def driver(self) -> Driver:
        """Where the signals come from.

        Raises:
            ConfigurationError: the file was loaded without it.
        """
        if self.source is None:
            raise ConfigurationError(f"{self.path}: loaded without its driver")
        return self.source

    @property
    def signal_fingerprint(self) -> str:
        """A fingerprint of what the values of signals depend on; empty where the file does not say where they are."""
        file = self.file
        if not file.signals:
            return ""
        said = {key: file.driver.get(key) for key in VALUED}
        return hashlib.sha256(json.dumps([file.signals, said], sort_keys=True, default=str).encode()).hexdigest()[:16]

    @property
    def recording_folder(self) -> Path | None:
        """Where the file says that recordings go."""
        folder = self.file.recording.folder
        return None if folder is None else self.path.parent / folder


def load_machine(path: Path, *, with_driver: bool = True) -> LoadedMachine:
    """The machine file at ``path``, its twin, its estimation problem and its driver (not yet opened).

    Without ``with_driver`` nobody looks at ``[driver]`` and ``[signals]``, and they may be absent.

    Raises:
        ConfigurationError: anything in it that cannot be meant, one line per fault.
    """
    page = read(path)
    data = parse(page)
    expect(page, data, "machine")
    file = validate(data, MachineFile, page)
    context = Context(page)
    twin = _twin(file, context)
    problem = _problem(file, twin, context)
    table = file.window
    return LoadedMachine(
        path=path,
        file=file,
        twin=twin,
        problem=problem,
        records=problem.window.records,
        limits=Limits(table.missing_limit, table.gap_limit, table.jitter_limit),
        source=_driver(file, twin, page) if with_driver else None,
    )


def _twin(file: MachineFile, context: Context) -> Definition:
    if (file.twin.name is None) == (file.twin.file is None):
        context.fail(("twin",), 'write either name = "dc_motor" or the like, or file = "my-twin.toml"')
    if file.twin.file is not None:
        return load_twin(context.file.path.parent / file.twin.file)
    with context.at("twin", "name"):
        return find_twin(file.twin.name or "")


def _problem(file: MachineFile, twin: Definition, context: Context) -> Problem:
    known_names = [entry.name for entry in twin.parameters]
    for name in file.parameters:
        if name not in known_names:
            context.fail(
                ("parameters", name), f"twin {twin.name!r} has no such parameter: {nearest(name, known_names)}"
            )
    known: list[tuple[str, float]] = []
    free: list[Parameter] = []
    for entry in twin.parameters:
        table = file.parameters.get(entry.name, ParameterTable())
        estimated = table.value is None and entry.role is Role.ESTIMATED if table.estimate is None else table.estimate
        parameter = _parameter(entry, table, context, estimated=estimated)
        if estimated:
            free.append(parameter)
        else:
            known.append((entry.name, parameter.nominal))
    if not free:
        context.fail(("parameters",), "nothing is to be estimated: write R_a = { estimate = true } or the like")
    sensors = _sensor_noise(file, twin, context)
    estimation = file.estimation
    return Problem(
        twin=twin,
        known=tuple(known),
        free=tuple(free),
        noise=sensors[0],
        input_noise=sensors[1],
        process_noise=_process_noise(file, twin, context),
        open_loop=estimation.open_loop,
        determined_within=estimation.determined_within,
        excluded=excluded(file.discovery, twin, lambda key, fault: context.fail(("discovery", key), fault)),
        discover=file.discovery.enabled,
        window=_window(file.window, context),
        swarm=SwarmOptions(
            file.swarm.size, file.swarm.generations, file.swarm.inertia, file.swarm.cognitive, file.swarm.social
        ),
        seed=file.swarm.seed,
    )


def _window(table: WindowTable, context: Context) -> WindowOptions:
    found = {}
    for key, length in (("length", table.length), ("shortest", table.shortest), ("longest", table.longest)):
        whole = table.length if length is None else length
        records = round(whole / table.sample_period)
        if abs(records * table.sample_period - whole) > 1e-6 * whole or not 10 <= records <= 1_000_000:
            context.fail(("window", key), f"{whole:g} s must be 10 to 1000000 times {table.sample_period:g} s")
        found[key] = records
    if not found["shortest"] <= found["length"] <= found["longest"]:
        context.fail(("window", "length"), f"{table.length:g} s must lie between shortest and longest")
    return WindowOptions(found["length"], found["shortest"], found["longest"])


def _parameter(entry: Parameter, table: ParameterTable, context: Context, *, estimated: bool) -> Parameter:
    given: dict[str, float] = {"value": entry.nominal, "low": entry.low, "high": entry.high}
    for key, written in (("low", table.low), ("high", table.high), ("value", table.value)):
        if written is not None:
            with context.at("parameters", entry.name, key):
                given[key] = Quantity(entry.unit)(written)
    where = ("parameters", entry.name)
    if not estimated and given["value"] <= 0.0 < entry.low:
        context.fail(where, f"{given['value']:g} {entry.unit}: {entry.meaning} must be above zero")
    if given["low"] >= given["high"]:
        context.fail(where, f"low {given['low']:g} {entry.unit} is not under high {given['high']:g} {entry.unit}")
    if estimated and not given["low"] <= given["value"] <= given["high"]:
        bounds = f"between {given['low']:g} and {given['high']:g} {entry.unit}"
        context.fail(
            where, f"{given['value']:g} {entry.unit} is out of bounds: it must lie {bounds}, or move the bounds"
        )
    return replace(entry, nominal=given["value"], low=given["low"], high=given["high"])


def _levels(
    table: str, written: Mapping[str, Written], entries: Mapping[str, tuple[str, float]], context: Context
) -> dict[str, float]:
    """Noise levels: ``entries`` has the unit of each name that may be given, and its level if it is not."""
    for name in written:
        if name not in entries:
            context.fail((table, name), f"the twin has no such signal or state: {nearest(name, list(entries))}")
    found = {}
    for name, (unit, level) in entries.items():
        with context.at(table, name):
            low = 0.0 if level == 0.0 else SMALLEST_NOISE
            found[name] = Quantity(unit, low=low, difference=True)(written[name]) if name in written else level
    return found


def _sensor_noise(file: MachineFile, twin: Definition, context: Context) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Of the outputs, and of the inputs."""
    signals = {entry.name: (entry.unit, 0.0) for entry in twin.inputs}
    signals |= {entry.name: (entry.unit, entry.noise) for entry in twin.outputs}
    found = _levels("noise", file.noise, signals, context)
    return tuple(found[entry.name] for entry in twin.outputs), tuple(found[entry.name] for entry in twin.inputs)


def _process_noise(file: MachineFile, twin: Definition, context: Context) -> tuple[float, ...]:
    states = {entry.name: (f"({entry.unit})/s^0.5", 0.0) for entry in twin.states}
    return tuple(_levels("process_noise", file.process_noise, states, context).values())


def _driver(file: MachineFile, twin: Definition, page: SourceFile) -> Driver:
    named = named_driver(file, twin, page)
    with named.faults_placed():
        return named.module.build(named.options, named.setup)


def recording_folder(plan: LoadedMachine) -> Path:
    """Where the machine file says, else in the state directory."""
    return (plan.recording_folder or state_directory() / "recordings").absolute()
