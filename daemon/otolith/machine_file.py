"""The machine file: its schema, typed, bounded, closed, every value with its unit; and the drivers that it names.

``docs/reference/machine-file.md`` explains every key; paths are relative to the machine file.
"""

import contextlib
import ipaddress
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from otolith.acquisition.samples import Check
from otolith.estimation.problem import AlgorithmName, WindowOptions
from otolith.fmu_twin import VARIABLES, Variables
from otolith.health.diagnosis import OwnRule
from otolith.health.limits import COLDEST, THERMAL_TIME
from otolith.health.schema import Language
from otolith.outlet_tables import OutletsTable
from otolith.twin.definition import Definition
from otolith.twin.language import OperationTable, OwnFigureTable, with_operation, with_performance
from otolith_drivers.base import Driver, DriverType, Sampling, Setup, Signal, find_driver
from otolith_drivers.common.guard import GuardedSource
from otolith_drivers.common.time_zones import check_time_zone
from otolith_drivers.config_files import Context, Limits, SourceFile, StrictModel, check_name, validate
from otolith_drivers.errors import ConfigurationError, counted, nearest
from otolith_drivers.sources import SeveralSources
from otolith_drivers.units import Quantity

PROTOCOLS = ("tcp", "tls", "udp", "quic", "ws", "unixsock-stream")
LOCAL = "local"  # The socket of the machine on this computer, instead of an endpoint to listen on


def _endpoint(text: str) -> str:
    if not re.fullmatch(rf"({'|'.join(PROTOCOLS)})/\S+", text):
        raise ValueError(f'{text!r} is not an endpoint: write it like "tcp/127.0.0.1:7447" ({", ".join(PROTOCOLS)})')
    if not text.startswith("unixsock-stream/") and not re.search(r":\d{1,5}$", text):
        raise ValueError(f'{text!r} has no port: write it like "tcp/127.0.0.1:7447"')
    return text


def host_of(endpoint: str) -> str:
    """Return the host of an endpoint like ``tcp/[::1]:7447``; empty for a socket of this computer."""
    protocol, _, rest = endpoint.partition("/")
    place = re.split(r"[?#]", rest)[0]
    return "" if protocol.startswith("unix") else place.rpartition(":")[0].strip("[]")


def address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the address that ``host`` is; None for a name."""
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _listening(text: str) -> str:
    return text if text == LOCAL else _endpoint(text)


def _network(text: str) -> str:
    try:
        return str(ipaddress.ip_network(text))
    except ValueError as error:
        raise ValueError(f'{error}: write a network like "192.168.7.0/24"') from error


def _command(command: tuple[str, ...]) -> tuple[str, ...]:
    if command and not command[0].startswith("/"):
        raise ValueError(f'{command[0]!r} is not an absolute path: write it like ["/usr/bin/logger", "-t", "otolith"]')
    return command


def _expand_value(written: object) -> object:
    """Expand ``"6.5 ohm"``, the short form of ``{ value = "6.5 ohm" }``."""
    return written if isinstance(written, dict) else {"value": written}


Name = Annotated[str, AfterValidator(check_name)]
Endpoint = Annotated[str, AfterValidator(_endpoint)]
Listening = Annotated[str, AfterValidator(_listening)]
RawQuantity = str | float | None  # A quantity as written; converted once the twin gives its unit
WindowLength = Annotated[float, BeforeValidator(Quantity("s", 0.1, 600.0))]


# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MIN_WINDOW_RECORDS, MAX_WINDOW_RECORDS = 10, 1_000_000
MAX_GRID_ERROR = 1e-6  # share of a window's length by which it may differ from a multiple of the sample period


class MachineTable(StrictModel):
    """Identity of the machine; both names become part of Zenoh keys and file names."""

    name: Name
    site: Name = "site"
    language: Language = "en"  # Of states, events and advice
    timezone: Annotated[str, AfterValidator(check_time_zone)] = ""
    """IANA name of the plant's zone, in which people read times; also of dates in logs that name none."""
    on_event: Annotated[tuple[str, ...], AfterValidator(_command)] = ()  # Command and arguments, run for each event


class TwinTable(StrictModel):
    """The twin: either the name of one in the library, or a file, or an FMU with names for its variables."""

    name: str | None = None
    file: Path | None = None
    fmu: Path | None = None
    step: Annotated[float | None, BeforeValidator(Quantity("s", 1e-6, 10.0))] = None  # Of an FMU that makes steps
    variables: Variables = VARIABLES


class LimitsTable(StrictModel):
    """Limits of a parameter, or of the amplitude of components at a site; without any, those of the twin."""

    watch: Limits | None = None
    act: Limits | None = None


class ParameterTable(LimitsTable):
    """What the file states of one parameter; the rest is that of the twin."""

    value: RawQuantity = None  # Value of a known parameter, or start of the search for an estimated one
    estimate: bool | None = None  # By default one without a value has the role of the twin, one with a value is known
    low: RawQuantity = None
    high: RawQuantity = None
    temperature: str | None = None  # Signal that measures the temperature on which the parameter depends
    temperature_coefficient: RawQuantity = None  # Relative change per kelvin; without it that of the twin
    reference_temperature: Annotated[float, BeforeValidator(Quantity("K", 0.0, 5000.0))] = 293.15
    """K, for which value and limits are stated."""
    temperature_range: Annotated[float, BeforeValidator(Quantity("K", 0.0, 500.0, difference=True))] = COLDEST
    """By how much it may be colder than at the reference temperature, K, if that is not measured."""
    as_right_as: tuple[str, ...] = ()
    """Known parameters that the data of commissioning did not tell from this one: they must be right as well."""
    thermal_time_constant: Annotated[float, BeforeValidator(Quantity("s", 1.0, 1e6))] = THERMAL_TIME


class SignalTable(StrictModel):
    """What the daemon needs to know of a signal, beside the keys by which the driver reads it."""

    source: str | None = None  # Name of the driver that reads it; needed if there are several
    delay: Annotated[float, BeforeValidator(Quantity("s", 0.0, 60.0))] = 0.0
    """Time by which the signal is late against the others; it is subtracted from the time of each sample."""
    times: Sampling | None = None  # Meaning of the times of its samples; without it what the source gives
    on_change: bool | None = None  # Whether a command is recorded only when it changes; by default the record shows it
    checks: tuple[Check, ...] = tuple(Check)  # The checks of its data; an empty list turns them off
    resolution: RawQuantity | None = None  # Step of its readings
    dead_band: RawQuantity | None = None  # By which what it measures departs from a reading before the next one
    renewed: RawQuantity | None = None  # Distance after which a speed from edge times has a new reading


class UnmeasuredTable(StrictModel):
    """What stands in place of the keys of a signal if no sensor measures it: exactly one of two keys."""

    unknown: Literal["constant", "slow", "friction"] | None = None
    proportional_to: str | None = None  # An expression in the twin language

    @model_validator(mode="after")
    def _has_one_key(self) -> "UnmeasuredTable":
        if (self.unknown is None) == (self.proportional_to is None):
            raise ValueError('write either unknown = "constant" or proportional_to = "omega^2"')
        return self


class WindowTable(StrictModel):
    """Length and grid of windows, and the quality that estimation needs."""

    length: WindowLength = 2.0
    shortest: WindowLength | None = None
    longest: WindowLength | None = None  # With shortest or longest the length adapts, starting at length
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-4, 10.0))] = 0.01
    times: Sampling | None = None  # Meaning of the times of all samples; without it what the source gives
    missing_limit: Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))] = 1.0
    gap_limit: Annotated[float, BeforeValidator(Quantity("s", 0.0, 600.0))] = 600.0
    jitter_limit: Annotated[float, BeforeValidator(Quantity("s", 0.0, 10.0))] = 0.005
    surplus_limit: Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))] = 0.02
    irregularity_limit: Annotated[float, BeforeValidator(Quantity("1", 0.0, 100.0))] = 0.3
    same_time_limit: Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))] = 0.25


class EstimationTable(StrictModel):
    """Options of the estimator."""

    open_loop: bool = False  # Use the paper's cost: no innovation correction within a window, and sensor noise only
    determined_within: Annotated[float, BeforeValidator(Quantity("1", 1e-6, 1.0))] = 0.1
    """A parameter is determined when half its 95 % interval is at most this share of its value; see Problem."""


class DiscoveryTable(StrictModel):
    """Which components discovery searches for; None stands for all."""

    enabled: bool = True
    families: tuple[str, ...] | None = None
    sites: tuple[str, ...] | None = None
    inputs: tuple[str, ...] | None = None
    sensors: tuple[str, ...] | None = None


class SwarmTable(StrictModel):
    """The global search of a window without a prediction; the defaults are Table 2 of the paper."""

    algorithm: AlgorithmName = "pso"
    size: Annotated[int, Field(ge=3, le=1000)] = 15
    generations: Annotated[int, Field(ge=1, le=100_000)] = 1000
    inertia: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.9
    cognitive: Annotated[float, Field(ge=0.0, le=4.0)] = 2.0
    social: Annotated[float, Field(ge=0.0, le=4.0)] = 2.0
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1

    @model_validator(mode="after")
    def _has_keys_of_its_algorithm(self) -> "SwarmTable":
        for key in ("inertia", "cognitive", "social") if self.algorithm != "pso" else ():
            if (value := getattr(self, key)) != type(self).model_fields[key].default:
                own = f'{key} = {value:g} has no effect with algorithm = "{self.algorithm}"'
                raise ValueError(f'{own}, only with "pso", the particle swarm: remove {key}')
        return self


class TlsTable(StrictModel):
    """Certificates of ``tls/`` and ``quic/`` endpoints, in PEM form."""

    ca: Path  # The authority that clients and routers must be certified by
    certificate: Path
    key: Path
    clients: bool = True  # Whether a client needs a certificate


class AccessTable(StrictModel):
    """Who may read the reports, and send commands; nobody but the daemon may write under its keys."""

    passwords: Path | None = None  # File of lines name:password; with it, every connection needs one of them
    readers: tuple[str, ...] | None = None  # Names of certificates and users that may read; by default all that connect
    commands: tuple[str, ...] = ()  # Names of certificates that may send commands; by default nobody may
    networks: tuple[Annotated[str, AfterValidator(_network)], ...] | None = None  # That the service accepts


class ZenohTable(StrictModel):
    """Endpoints of the Zenoh session; by default it listens on a socket that only its user and group may open."""

    listen: tuple[Listening, ...] = (LOCAL,)
    connect: tuple[Endpoint, ...] = ()
    tls: TlsTable | None = None
    access: AccessTable = AccessTable()


class RecordingTable(StrictModel):
    """Rerun recordings."""

    enabled: bool = True
    folder: Path | None = None
    all_curves: bool = False
    max_gigabytes: Annotated[float, Field(gt=0.0, le=100_000.0)] = 10.0
    max_days: Annotated[float, Field(gt=0.0, le=3650.0)] = 14.0
    rotate_megabytes: Annotated[float, Field(ge=1.0, le=10_000.0)] = 256.0
    rotate_minutes: Annotated[float, Field(ge=1.0, le=1440.0)] = 60.0


class HistoryTable(StrictModel):
    """The history of estimates, reports and events."""

    enabled: bool = True
    max_megabytes: Annotated[int, Field(ge=20, le=1_000_000)] = 200  # Size of its files
    days: Annotated[int, Field(ge=1, le=36_500)] = 3650  # Age of what is kept longest: days, events and findings
    resend_hours: Annotated[int, Field(ge=1, le=8760)] = 24  # Age of whole reports, for subscribers that were away


class EvidenceTable(StrictModel):
    """Bundles with the evidence of each event."""

    max_megabytes: Annotated[int, Field(ge=0, le=1_000_000)] = 100  # with 0 there are none


class OwnTables(StrictModel):
    """What a machine file states of its twin, beside parameters and signals."""

    performance: Annotated[dict[str, OwnFigureTable], Field(default_factory=dict)]
    """Figures of performance, and other keys of those of the twin, by name."""
    operation: Annotated[dict[str, OperationTable], Field(default_factory=dict)]
    """Ranges of signals in which the equations of the twin hold."""

    def applied_to(self, twin: Definition, context: Context) -> Definition:
        """Return the twin as this machine has it; raise ConfigurationError at the first fault."""
        twin = with_operation(twin, self.operation, context.fail)
        return with_performance(twin, self.performance, context.fail) if self.performance else twin


class MachineFile(OwnTables):
    """The whole file."""

    machine: MachineTable
    driver: Annotated[dict[str, Any] | tuple[dict[str, Any], ...], Field(default_factory=dict)]
    """``type`` and the options of that driver, or several of them, each with a ``name``; a replay needs none."""
    signals: Annotated[dict[str, dict[str, Any]], Field(default_factory=dict)]
    """Where the driver finds each input and output of the twin, and the keys of :class:`SignalTable`; a replay does not
    need it."""
    twin: TwinTable
    parameters: Annotated[
        dict[str, Annotated[ParameterTable, BeforeValidator(_expand_value)]], Field(default_factory=dict)
    ]
    components: Annotated[dict[str, LimitsTable], Field(default_factory=dict)]  # Limits of amplitudes, by site
    rule: tuple[OwnRule, ...] = ()  # Of the diagnosis, before the packaged ones
    noise: Annotated[dict[str, RawQuantity], Field(default_factory=dict)]  # Standard deviation of each sensor
    process_noise: Annotated[dict[str, RawQuantity], Field(default_factory=dict)]  # In the state's unit per s^0.5
    window: WindowTable = WindowTable()
    estimation: EstimationTable = EstimationTable()
    discovery: DiscoveryTable = DiscoveryTable()
    swarm: SwarmTable = SwarmTable()
    zenoh: ZenohTable = ZenohTable()
    recording: RecordingTable = RecordingTable()
    history: HistoryTable = HistoryTable()
    evidence: EvidenceTable = EvidenceTable()
    outlets: OutletsTable = OutletsTable()

    @property
    def drivers(self) -> tuple[dict[str, Any], ...]:
        """The tables ``[[driver]]``, or the table ``[driver]`` alone; empty without any."""
        if isinstance(self.driver, tuple):
            return self.driver
        return (self.driver,) if self.driver else ()

    def held_beside(self, twin: Definition, context: Context) -> dict[str, tuple[str, ...]]:
        """Return the parameters with which others are right or wrong; ConfigurationError for one that is none."""
        names = [row.name for row in twin.parameters]
        for name, table in self.parameters.items():
            for other in set(table.as_right_as).difference(names):
                fault = f"twin {twin.name!r} has no parameter {other!r}: {nearest(other, names)}"
                context.fail(("parameters", name, "as_right_as"), fault)
        return {name: table.as_right_as for name, table in self.parameters.items() if table.as_right_as}

    @property
    def unmeasured(self) -> dict[str, dict[str, Any]]:
        """The tables of ``[signals]`` of inputs that no sensor measures, see :class:`UnmeasuredTable`."""
        known = UnmeasuredTable.model_fields.keys()
        return {name: table for name, table in self.signals.items() if table.keys() & known}

    @property
    def read_signals(self) -> dict[str, dict[str, Any]]:
        """The tables of ``[signals]`` of what a driver reads."""
        unmeasured = self.unmeasured
        return {name: table for name, table in self.signals.items() if name not in unmeasured}


TEMPERATURE_UNIT = "K"


@dataclass(frozen=True, slots=True)
class DriverConfig:
    """A driver that a machine file names, with its validated options."""

    name: str  # Of the source; the type of the driver if the file has no name
    place: tuple[int | str, ...]  # Where the file has its table
    kind: str  # Its type
    module: DriverType
    options: Any  # Instance of the module's Options
    setup: Setup
    file: SourceFile

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals that the driver reads."""
        return tuple(signal.name for signal in self.setup.signals)

    def build(self) -> GuardedSource:
        """Return the driver, which is not open, behind its guard."""
        with self.located_errors():
            return GuardedSource.built(
                self.name, self.signals, self.setup.sample_period, partial(self.module.build, self.options, self.setup)
            )

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
    """Return what each table of ``[driver]`` configures; raise ConfigurationError if one is wrong or missing."""
    context = Context(source)
    if not file.drivers:
        remedy = "write [driver] with type = \"can\" or another driver, and [signals]; only 'otolith replay' needs none"
        context.fail(("driver",), f"missing: {remedy}")
    units = signal_units(file, twin)
    needed = list(units)
    read = file.read_signals
    for name in read:
        if name not in needed:
            context.fail(("signals", name), f"twin {twin.name!r} has no such signal: {nearest(name, needed)}")
    for name, unit in units.items():
        if name not in read:
            reason = f"the twin needs {', '.join(twin.signals)}" if name in twin.signals else "[parameters] names it"
            if twin.ordinary_range(name) is not None:
                reason += f'; if no sensor measures it, write {name} = {{ unknown = "constant" }}, "slow" or "friction"'
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
    """Return the names of the drivers, by default their types; raise ConfigurationError if one is wrong or repeated."""
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
    setup = Setup(own, source.path.parent, file.window.sample_period, file.machine.timezone)
    return DriverConfig(table.get("name", kind), place, kind, module, options, setup, source)


def build_driver(configs: Sequence[DriverConfig]) -> Driver:
    """Return the driver of a machine: one, or several as one."""
    sources = tuple(config.build() for config in configs)
    return sources[0] if len(sources) == 1 else SeveralSources(sources)


def own_keys(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a signal by which its driver reads it."""
    return {key: value for key, value in table.items() if key not in SignalTable.model_fields}


def window_options(table: WindowTable, context: Context) -> WindowOptions:
    """Return the lengths of windows in records; raise ConfigurationError if one does not fit the sample period."""
    records = {}
    for key, length in (("length", table.length), ("shortest", table.shortest), ("longest", table.longest)):
        seconds = table.length if length is None else length
        records[key] = round(seconds / table.sample_period)
        if problem := _length_problem(seconds, table.sample_period):
            context.fail(("window", key), problem)
    if not records["shortest"] <= records["length"] <= records["longest"]:
        context.fail(("window", "length"), f"{table.length:g} s must lie between window.shortest and window.longest")
    return WindowOptions(records["length"], records["shortest"], records["longest"], table.sample_period)


def whole_length(length: float, period: float) -> float:
    """Return the nearest length in s that a machine file accepts."""
    records = max(round(length / period), MIN_WINDOW_RECORDS, math.ceil(0.1 / period))
    return float(f"{records * period:.9g}")


def _length_problem(seconds: float, period: float) -> str:
    """Return why a window of ``seconds`` has no grid of ``period`` (s), with lengths that have one; empty if it has."""
    count = round(seconds / period)
    given = f"{seconds:.9g} s at {period:g} s give {counted(count, 'record')}"
    if seconds < MIN_WINDOW_RECORDS * period * (1.0 - MAX_GRID_ERROR):
        least = f"write at least {MIN_WINDOW_RECORDS * period:.9g} s, or shorten sample_period"
        return f"{given}: a window needs {MIN_WINDOW_RECORDS}: {least}"
    if count > MAX_WINDOW_RECORDS:
        most = f"write at most {MAX_WINDOW_RECORDS * period:.9g} s, or lengthen sample_period"
        return f"{given}: more than {MAX_WINDOW_RECORDS}: {most}"
    if abs(count * period - seconds) <= MAX_GRID_ERROR * seconds:
        return ""
    below = math.floor(seconds / period)
    proposed = f"write {below * period:.9g} s or {(below + 1) * period:.9g} s"
    return f"{seconds:.9g} s is no whole multiple of the sample period {period:g} s: {proposed}"
