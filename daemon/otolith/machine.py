"""A machine file, loaded and checked: its twin, its estimation problem and its driver.

Errors name file, line and key.
"""

import hashlib
import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.samples import Check, SignalPlan
from otolith.estimation.problem import Problem, SwarmOptions, key_of
from otolith.estimation.sensor_models import SensorModel
from otolith.fmu.description import read_fmu
from otolith.fmu.trial import FmuTrial, try_fmu
from otolith.fmu_twin import twin_of_fmu
from otolith.health.diagnosis import COMMAND, LIMITS, MonitoringPlan, Rule, RulesFile, worded
from otolith.health.limits import MACHINE, Level, Limit, MonitoredQuantity
from otolith.health.schema import Language
from otolith.health.text import texts_in
from otolith.machine_file import (
    DiscoveryTable,
    LimitsTable,
    MachineFile,
    ParameterTable,
    RawQuantity,
    SignalTable,
    UnmeasuredTable,
    build_driver,
    driver_configs,
    observed_signals,
    own_keys,
    signal_units,
    window_options,
)
from otolith.service_file import SERVICE_FILE, with_service_file
from otolith.twin.components import FAMILY_NAMES, gain_site, sensor_site, sites, sources
from otolith.twin.definition import Definition, Parameter, Role
from otolith.twin.language import MAX_COEFFICIENT, read_twin
from otolith.twin.unmeasured import Assumption, UnmeasuredInput, without_sensor
from otolith_drivers.base import Driver, Sampling, sampling_of
from otolith_drivers.config_files import Context, SourceFile, expect, parse, read, validate
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import Quantity, are_of_one_quantity, limit_values
from otolith_drivers.user_dirs import state_directory

LIBRARY = Path(__file__).parent / "twin" / "library"
RULES = Path(__file__).parent / "health" / "rules.toml"
FINGERPRINT_KEYS = ("dbc", "eds", "order", "first_address", "device")  # driver options that signal values depend on
TWIN_LIMITS, OWN_LIMITS = "the limits of the twin do not fit this value", "write watch and act here"

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MIN_OUTPUT_NOISE = 1e-12  # in the unit of the output: the residual is divided by the noise


@dataclass(frozen=True, slots=True)
class RecordedMachine:
    """What a recording has beside the reports. It can be sent to another process."""

    title: str  # Name and site of the machine, for people
    twin: Definition
    parameters: Sequence[Parameter]  # Those that are estimated
    sampling: Sampling | Mapping[str, Sampling]  # Meaning of its sample times, the same for all signals or by signal
    delays: Mapping[str, float]  # Of its signals, s: they are subtracted from the times of the records
    all_curves: bool = False  # Whether every curve has all records, instead of the extremes of some
    plan: MonitoringPlan = field(default_factory=MonitoringPlan)  # Limits of its parameters


@dataclass(frozen=True, slots=True)
class LoadedMachine:
    """A checked machine file: everything the service needs to start."""

    path: Path
    file: MachineFile
    twin: Definition
    problem: Problem
    plan: MonitoringPlan  # Limits of parameters and components, and the rules of the diagnosis
    signal_tables: Mapping[str, SignalTable]  # Of each signal of the twin
    built_driver: Driver | None  # None if the file was loaded without its driver
    complete: Definition  # The twin as its author wrote it, with inputs that no sensor measures
    unmeasured: tuple[UnmeasuredInput, ...] = ()  # Those inputs
    of_service: tuple[str, ...] = ()  # Tables that are in the file of the service beside the machine file

    @property
    def driver(self) -> Driver:
        """The driver, built and not yet opened; raise ConfigurationError if the file was loaded without its driver."""
        if self.built_driver is None:
            raise ConfigurationError(f"{self.path}: loaded without its driver")
        return self.built_driver

    def try_fmu(self) -> FmuTrial | None:
        """Return what a child process found of the FMU of the twin; None if the twin has none.

        Raises:
            ConfigurationError: the FMU cannot be used; with the reason.
        """
        return None if self.twin.fmu is None else try_fmu(self.twin.fmu)

    def path_of(self, table: str) -> Path:
        """Return the file that has a table."""
        return self.path.with_name(SERVICE_FILE) if table in self.of_service else self.path

    @property
    def title(self) -> str:
        """Name and site of the machine, for people."""
        return f"{self.file.machine.name}, {self.file.machine.site}"

    @property
    def observed(self) -> tuple[str, ...]:
        """The temperatures, which are signals beside those of the twin; each in K."""
        return observed_signals(self.file)

    @property
    def records(self) -> int:
        """Records of the first window."""
        return self.problem.window.records

    def recorded(self, sampling: Sampling | Mapping[str, Sampling]) -> RecordedMachine:
        """Return what a recording has beside the reports; ``sampling`` is the meaning of the times of the source."""
        delays = {name: self.signal_tables[name].delay for name in self.twin.signals}
        all_curves = self.file.recording.all_curves
        return RecordedMachine(self.title, self.twin, self.problem.free, sampling, delays, all_curves, self.plan)

    @property
    def limits(self) -> QualityLimits:
        """Bounds that a good window keeps."""
        window = self.file.window
        return QualityLimits(
            missing=window.missing_limit,
            gap=window.gap_limit,
            jitter=window.jitter_limit,
            surplus=window.surplus_limit,
            irregularity=window.irregularity_limit,
            same_time=window.same_time_limit,
        )

    def plans(self, sampling: Sampling | Mapping[str, Sampling]) -> tuple[SignalPlan, ...]:
        """Return how each signal is sampled; ``sampling`` is the meaning of the times of the source."""
        twin, problem = self.twin, self.problem
        holds = {driven.name: driven.hold for driven in twin.inputs}
        noise = dict(zip(holds, problem.input_noise, strict=True))
        has_sources = len(self.file.drivers) > 1
        return tuple(
            SignalPlan(
                name=name,
                hold=holds.get(name),
                sampling=self.signal_tables[name].times or self.file.window.times or sampling_of(sampling, name),
                delay=self.signal_tables[name].delay,
                on_change=self.signal_tables[name].on_change,
                noise=noise.get(name, 0.0),
                checks=frozenset(self.signal_tables[name].checks),
                source=(self.signal_tables[name].source or "") if has_sources else "",
            )
            for name in twin.signals
        )

    @property
    def signal_fingerprint(self) -> str:
        """Hash of everything in the file that signal values depend on; empty if the file has no signals."""
        if not self.file.read_signals:
            return ""
        tables = self.file.drivers or ({},)
        used = {name: table for name, table in self.file.read_signals.items() if name in self.twin.signals}
        options: list[Any] = [{key: table.get(key) for key in FINGERPRINT_KEYS} for table in tables]
        read: dict[str, Any] = {name: own_keys(table) for name, table in used.items()}
        if len(tables) > 1:
            options = [[table["name"], options[number]] for number, table in enumerate(tables)]
            read = {name: [table.get("source"), read[name]] for name, table in used.items()}
        text = json.dumps([read, *options], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @property
    def recording_folder(self) -> Path:
        """Absolute folder for recordings: that of the file, else one in the state directory."""
        folder = self.file.recording.folder
        return (state_directory() / "recordings" if folder is None else self.path.parent / folder).absolute()


def load_machine(path: Path, *, with_driver: bool = True, for_replay: bool = False) -> LoadedMachine:
    """Load the machine file at ``path`` with its twin, its estimation problem and its driver, which is not opened.

    Without ``with_driver``, ``[driver]`` and ``[signals]`` are not checked and may be absent. With ``for_replay`` they
    are checked unless both are absent.

    Raises:
        ConfigurationError: something in the file is wrong; one line per fault.
    """
    source = read(path)
    data = parse(source)
    if path.name == SERVICE_FILE and "machine" not in data:
        data.setdefault("service", {})  # so that the error names a file of a service
    expect(source, data, "machine")
    file, of_service = with_service_file(validate(data, MachineFile, source), path)
    context = Context(source)
    complete = file.applied_to(_twin(file, path, context), context)
    unmeasured = _unmeasured(file, complete, source)
    for name in (item.name for item in unmeasured if item.name in file.operation):
        context.fail(("operation", name), "no sensor measures it: give a range of a signal that is measured")
    twin = _without_sensors(file, complete, unmeasured, context)
    signals = {
        name: validate(_common(table), SignalTable, source, under=("signals", name))
        for name, table in file.read_signals.items()
    }
    tables = {name: signals.get(name, SignalTable()) for name in twin.signals}
    sensors = _sensors(tables, twin, context)
    problem = replace(_problem(file, twin, context), unchecked=_unchecked(tables), sensors=sensors)
    driver = None
    if with_driver and (file.drivers or file.read_signals or not for_replay):
        driver = build_driver(driver_configs(file, twin, source))
    varying = frozenset(item.name for item in unmeasured if item.assumption is Assumption.CONSTANT)
    plan = _plan(file, twin, complete, problem, context).with_held(file.held_beside(twin, context), varying)
    return LoadedMachine(path, file, twin, problem, plan, tables, driver, complete, unmeasured, of_service)


def _unmeasured(file: MachineFile, twin: Definition, source: SourceFile) -> tuple[UnmeasuredInput, ...]:
    """Return the inputs without a sensor; raise ConfigurationError if one is none, or has other keys."""
    inputs, found = [driven.name for driven in twin.inputs], []
    for name, written in file.unmeasured.items():
        table = validate(written, UnmeasuredTable, source, under=("signals", name))
        if name not in inputs:
            what = "an output, which must be measured" if name in twin.signals else nearest(name, inputs)
            fault = f"only an input of the twin may be without a sensor: {what}"
            Context(source).fail(("signals", name), fault)
        assumption = Assumption.PROPORTIONAL if table.unknown is None else Assumption(table.unknown)
        found.append(UnmeasuredInput(name, assumption, table.proportional_to or ""))
    return tuple(found)


def _without_sensors(
    file: MachineFile, twin: Definition, unmeasured: Sequence[UnmeasuredInput], context: Context
) -> Definition:
    """Return the twin with the inputs that no sensor measures replaced by what is assumed of them."""
    for item in unmeasured:
        if item.name in file.noise:
            context.fail(("noise", item.name), f"{item.name} is not measured, so it has no noise: remove this line")
        key = "proportional_to" if item.assumption is Assumption.PROPORTIONAL else "unknown"
        with context.at("signals", item.name, key):
            twin = without_sensor(twin, item)
    return twin


def _common(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a signal that every driver has."""
    return {key: value for key, value in table.items() if key in SignalTable.model_fields}


def _unchecked(tables: Mapping[str, SignalTable]) -> frozenset[tuple[str, Check]]:
    """Return the checks that are turned off, each with its signal."""
    return frozenset((name, check) for name, table in tables.items() for check in Check if check not in table.checks)


def _sensors(
    tables: Mapping[str, SignalTable], twin: Definition, context: Context
) -> tuple[tuple[str, SensorModel], ...]:
    """Return the sensors whose reading may stay while what they measure moves, each with its signal."""
    outputs = {output.name: output.unit for output in twin.outputs}
    sensors = []
    for name, table in tables.items():
        written = {key: getattr(table, key) for key in ("resolution", "dead_band", "renewed")}
        stated: dict[str, float] = {}
        for key, value in written.items():
            if value is None:
                continue
            if name not in outputs:
                context.fail(("signals", name, key), f"{name} is an input of the twin: {key!r} is of an output")
                continue
            unit = f"({outputs[name]})*s" if key == "renewed" else outputs[name]
            with context.at("signals", name, key):
                stated[key] = Quantity(unit, low=0.0, difference=True)(value)
        if stated:
            sensors.append((name, SensorModel(**stated)))
    return tuple(sensors)


def library_twins() -> list[str]:
    """Return the names of the twins in the library."""
    return sorted(path.stem for path in LIBRARY.glob("*.toml"))


def find_twin(name: str) -> Definition:
    """Return the twin ``name`` of the library; raise ConfigurationError if the library has no such twin."""
    if name not in library_twins():
        raise ConfigurationError(f"unknown twin {name!r}: {nearest(name, library_twins())}")
    return load_twin(LIBRARY / f"{name}.toml")


def load_twin(path: Path) -> Definition:
    """Return the twin in a file; raise ConfigurationError if the file is unreadable or wrong; one line per fault."""
    return read_twin(read(path))


def _twin(file: MachineFile, path: Path, context: Context) -> Definition:
    if sum(key is not None for key in (file.twin.name, file.twin.file, file.twin.fmu)) != 1:
        choice = 'name = "dc_motor", a twin of the library, or file = "my-twin.toml", or fmu = "motor.fmu"'
        context.fail(("twin",), f"write either {choice}")
    for key, is_written in (("variables", bool(file.twin.variables)), ("step", file.twin.step is not None)):
        if is_written and file.twin.fmu is None:
            context.fail(("twin", key), "is of an FMU: write fmu as well, or leave it out")
    if file.twin.fmu is not None:
        with context.at("twin", "fmu"):
            description = read_fmu(path.parent / file.twin.fmu)
        if file.twin.step is not None:
            if not description.is_stepped:
                context.fail(("twin", "step"), "is of an FMU that must make steps: leave it out")
            description = replace(description, step=file.twin.step, own_step=file.twin.step)
        bounded = {name: (row.low is not None, row.high is not None) for name, row in file.parameters.items()}
        return twin_of_fmu(description, file.twin.variables, bounded, context.fail)
    if file.twin.file is not None:
        with context.at("twin", "file"):
            page = read(path.parent / file.twin.file)
        return read_twin(page)
    with context.at("twin", "name"):
        return find_twin(file.twin.name or "")


def _problem(file: MachineFile, twin: Definition, context: Context) -> Problem:
    known, free = _parameters(file, twin, context)
    inputs = {signal.name: (signal.unit, 0.0) for signal in twin.inputs}
    outputs = {signal.name: (signal.unit, signal.noise) for signal in twin.outputs}
    noise = _noise("noise", file.noise, inputs | outputs, context)
    states = {state.name: (f"({state.unit})/s^0.5", state.process_noise) for state in twin.states}
    return Problem(
        twin=twin,
        known=known,
        free=free,
        noise=tuple(noise[name] for name in outputs),
        input_noise=tuple(noise[name] for name in inputs),
        process_noise=tuple(_noise("process_noise", file.process_noise, states, context).values()),
        open_loop=file.estimation.open_loop,
        determined_within=file.estimation.determined_within,
        excluded=_excluded(file.discovery, twin, context),
        discover=file.discovery.enabled,
        window=window_options(file.window, context),
        swarm=SwarmOptions(**file.swarm.model_dump(exclude={"seed"})),
        seed=file.swarm.seed,
    )


def _parameters(
    file: MachineFile, twin: Definition, context: Context
) -> tuple[tuple[tuple[str, float], ...], tuple[Parameter, ...]]:
    """Return the known parameters with their values, and the free ones with nominal values and bounds."""
    names = [parameter.name for parameter in twin.parameters]
    for name in file.parameters:
        if name not in names:
            context.fail(("parameters", name), f"twin {twin.name!r} has no such parameter: {nearest(name, names)}")
    known: list[tuple[str, float]] = []
    free: list[Parameter] = []
    for parameter in twin.parameters:
        table = file.parameters.get(parameter.name, ParameterTable())
        by_default = table.value is None and parameter.role is Role.ESTIMATED
        estimated = by_default if table.estimate is None else table.estimate
        adapted = _parameter(parameter, table, context, estimated=estimated)
        if estimated:
            free.append(adapted)
        else:
            known.append((parameter.name, adapted.nominal))
    if not free:
        context.fail(
            ("parameters",), f"no parameter is estimated: write for example {names[0]} = {{ estimate = true }}"
        )
    return tuple(known), tuple(free)


def _parameter(parameter: Parameter, table: ParameterTable, context: Context, *, estimated: bool) -> Parameter:
    """Return the parameter of the twin with value and bounds of the file."""
    where, unit = ("parameters", parameter.name), parameter.unit
    numbers: dict[str, float] = {"value": parameter.nominal, "low": parameter.low, "high": parameter.high}
    for key, written in (("low", table.low), ("high", table.high), ("value", table.value)):
        if written is not None:
            with context.at(*where, key):
                numbers[key] = Quantity(unit)(written)
    value, low, high = numbers["value"], numbers["low"], numbers["high"]
    if not estimated and value <= 0.0 < parameter.low:
        context.fail(where, f"{value:g} {unit}: {parameter.meaning} must be above zero")
    if low >= high:
        context.fail(where, f"low {low:g} {unit} must be below high {high:g} {unit}")
    if estimated and not low <= value <= high:
        remedy = f"write a value between {low:g} and {high:g} {unit}, or change low and high"
        context.fail(where, f"{value:g} {unit} is out of bounds: {remedy}")
    return replace(parameter, nominal=value, low=low, high=high)


def _plan(
    file: MachineFile, twin: Definition, complete: Definition, problem: Problem, context: Context
) -> MonitoringPlan:
    """Return the limits of the file, or those of the twin where it has none, and the rules of the diagnosis."""
    free, sites = {parameter.name: parameter for parameter in problem.free}, {site.name: site for site in twin.sites}
    for name, table in file.parameters.items():
        for key, written in (("watch", table.watch), ("act", table.act), ("temperature", table.temperature)):
            if written and name not in free:
                what = "temperature" if key == "temperature" else "limit"
                context.fail(("parameters", name, key), f"{name} is not estimated: write estimate = true, or no {what}")
    for name in file.components:
        if name not in sites:
            context.fail(("components", name), f"twin {twin.name!r} has no such site: {nearest(name, list(sites))}")
    parameters = {
        name: _monitored(row, file.parameters.get(name, LimitsTable()), ("parameters", name), context)
        for name, row in free.items()
    }
    own = _own_values(file, twin, complete)
    parameters = _with_waiting_limits(parameters, own)
    for name, quantity in parameters.items():
        table = file.parameters.get(name, ParameterTable())
        parameters[name] = _with_temperature(quantity, free[name], table, twin, context)
    amplitudes = {
        name: Parameter(name, row.unit, 0.0, 0.0, math.inf, row.meaning, part=row.part) for name, row in sites.items()
    }
    components = {
        name: _monitored(row, file.components.get(name, LimitsTable()), ("components", name), context)
        for name, row in amplitudes.items()
    }
    known = {name: _known(replace(twin.parameter(name), nominal=value), context) for name, value in problem.known}
    known = _with_waiting_limits(known, own)
    signals = {row.name: row.meaning for row in twin.inputs} | {row.name: row.meaning for row in twin.outputs}
    language, zone = file.machine.language, file.machine.timezone
    _check_rules(file, twin, context)
    rules = (
        *(Rule(**rule.model_dump(), is_own=True) for rule in file.rule),
        *(_with_units_of(twin, rule) for rule in load_rules(language)),
    )
    commands = frozenset(row.name for row in twin.inputs if row.hold == "zoh")
    return MonitoringPlan(
        parameters, components, rules, language=language, timezone=zone, known=known, signals=signals, commands=commands
    )


def _with_units_of(twin: Definition, rule: Rule) -> Rule:
    """Return a packaged rule for the units in which ``twin`` writes the same quantities, as Nm."""
    same = (site.unit for site in twin.sites for unit in rule.unit if are_of_one_quantity(site.unit, unit))
    return rule.model_copy(update={"unit": tuple(dict.fromkeys((*rule.unit, *same)))})


def _own_values(file: MachineFile, twin: Definition, complete: Definition) -> frozenset[str]:
    """Return the parameters whose nominal values are those of this machine, so that they may be judged by them.

    The file states them, or the user's own twin; a twin of the library has those of an example. A friction that stands
    for an unmeasured load too is not known from a data sheet of the motor, unless limits are stated beside its value.
    """
    tables = file.parameters
    written = {name for name, table in tables.items() if table.value is not None}
    limited = {name for name in written if tables[name].watch is not None or tables[name].act is not None}
    written |= {row.name for row in complete.parameters} if file.twin.name is None else set()
    return frozenset(name for name in written if name in limited or not stands_for_load(name, twin, complete))


def stands_for_load(name: str, twin: Definition, complete: Definition) -> bool:
    """Whether a parameter of the ``complete`` twin stands in ``twin`` for an unmeasured load too."""
    own = next((row for row in complete.parameters if row.name == name), None)
    return own is not None and twin.parameter(name) != own


def _with_waiting_limits(
    quantities: Mapping[str, MonitoredQuantity], own: Collection[str]
) -> dict[str, MonitoredQuantity]:
    """Return the quantities; the value of those that are not ``own`` is an example's, whose percentages wait."""
    found = dict(quantities)
    for name in quantities.keys() - own:
        limits, quantity = {True: list[Limit](), False: list[Limit]()}, quantities[name]
        for limit in quantity.limits:
            limits[limit.is_relative].append(limit)
        found[name] = replace(quantity, limits=tuple(limits[False]), waiting=tuple(limits[True]), is_example=True)
    return found


def _known(parameter: Parameter, context: Context) -> MonitoredQuantity:
    """Return part and limits of a parameter that is not estimated; no limits if those of the twin do not fit it."""
    try:
        return _monitored(parameter, LimitsTable(), ("parameters", parameter.name), context)
    except ConfigurationError:
        return MonitoredQuantity(parameter.part or MACHINE, parameter.meaning, parameter.unit, parameter.nominal)


def _with_temperature(
    quantity: MonitoredQuantity, parameter: Parameter, table: ParameterTable, twin: Definition, context: Context
) -> MonitoredQuantity:
    """Return a parameter with what the file states of its temperature."""
    where, coefficient = ("parameters", parameter.name), parameter.temperature_coefficient
    if table.temperature_coefficient is not None:
        with context.at(*where, "temperature_coefficient"):
            coefficient = Quantity("1/K", *MAX_COEFFICIENT)(table.temperature_coefficient)
    if table.temperature is not None:
        if table.temperature in twin.signals or not table.temperature:
            fault = f"{table.temperature!r} must be a signal of [signals] beside those of the twin"
            context.fail((*where, "temperature"), fault)
        if coefficient == 0.0:
            fault = f'{parameter.name} has no temperature_coefficient: write one, like "0.393 %/K" of copper'
            context.fail((*where, "temperature"), fault)
    temperature, reference = table.temperature or "", table.reference_temperature
    coldest, thermal_time = table.temperature_range, table.thermal_time_constant
    quantity = replace(quantity, coldest=coldest, thermal_time=thermal_time)
    return replace(quantity, temperature_coefficient=coefficient, temperature=temperature, reference=reference)


def _check_rules(file: MachineFile, twin: Definition, context: Context) -> None:
    """Raise ConfigurationError if a rule has the id of another, no effect, or names what this machine does not have."""
    subjects = [row.name for row in twin.parameters] + [row.name for row in twin.sites] + [*signal_units(file, twin)]
    subjects += [str(table.get("name", table.get("type"))) for table in file.drivers]
    inputs = [source.name.partition("(")[0] for source in sources(twin) if source.name]
    units = [row.unit for row in twin.sites]
    known = {"twin": [twin.name], "subject": subjects, "unit": units, "family": list(FAMILY_NAMES)}
    known["input"] = [*inputs, COMMAND]
    ids = [rule.id for rule in file.rule]
    for number, rule in enumerate(file.rule):
        if (first := ids.index(rule.id)) < number:
            context.fail(("rule", number, "id"), f"{rule.id!r} is the id of rule[{first}] too: write another")
        if rule.severity == "HINT" and rule.finding in LIMITS:
            fault = f"'HINT' is no level of {rule.finding.value!r}, whose limits give WATCH or ACT: leave severity out"
            context.fail(("rule", number, "severity"), fault)
        for key, names in known.items():
            for name in [name for name in getattr(rule, key) if name not in names][:1]:
                context.fail(("rule", number, key), f"unknown name {name!r}: {nearest(name, names)}")


def load_rules(language: Language = "en") -> tuple[Rule, ...]:
    """Return the rules of the diagnosis."""
    source = read(RULES)
    return worded(validate(parse(source), RulesFile, source).rule, texts_in(language))


def _monitored(parameter: Parameter, table: LimitsTable, where: tuple[str, ...], context: Context) -> MonitoredQuantity:
    """Return part and limits of a parameter or amplitude; limits of the file replace all limits of the twin."""
    unit, nominal, limits = parameter.unit, parameter.nominal, []
    is_written = table.watch is not None or table.act is not None
    defaults = (parameter.watch, parameter.act) if nominal != 0.0 and not is_written else ((), ())
    for level, written, default in zip((Level.WATCH, Level.ACT), (table.watch, table.act), defaults, strict=True):
        try:
            values = limit_values(default if written is None else written, unit, nominal)
        except ValueError as error:
            fault = str(error) if is_written else f"{TWIN_LIMITS}: {level.lower()}: {error}: {OWN_LIMITS}"
            context.fail((*where, level.lower()) if is_written else where, fault)
        relative = [str(text).strip().endswith("%") for text in (default if written is None else written)]
        limits += [
            Limit(level, value, value < nominal, is_relative)
            for value, is_relative in zip(values, relative, strict=True)
        ]
        for value in values:
            if is_written and not parameter.low < value < parameter.high:
                bounds = f"the bounds {parameter.low:g} to {parameter.high:g} {unit}"
                fault = f"{value:g} {unit} is outside {bounds}: no estimate can pass it: write one within them"
                context.fail((*where, level.lower()), fault)
    acts = [limit for limit in limits if limit.level is Level.ACT]
    for watch in (limit for limit in limits if limit.level is Level.WATCH):
        if any(act.is_lower is watch.is_lower and act.excess(watch.value) >= 0.0 for act in acts):
            fault = f"{watch.value:g} {unit} is not passed before act"
            if not is_written:
                context.fail(where, f"{TWIN_LIMITS}: watch {fault}: {OWN_LIMITS}")
            context.fail((*where, "watch"), f"{fault}: write a limit nearer to the nominal value {nominal:g} {unit}")
    return MonitoredQuantity(parameter.part or MACHINE, parameter.meaning, unit, nominal, tuple(limits))


def _noise(
    table: str, written: Mapping[str, RawQuantity], defaults: Mapping[str, tuple[str, float]], context: Context
) -> dict[str, float]:
    """Return the noise level of each name in ``defaults``, which has unit and default level of every allowed name."""
    for name in written:
        if name not in defaults:
            context.fail((table, name), f"the twin has no such signal or state: {nearest(name, list(defaults))}")
    levels = {}
    for name, (unit, default) in defaults.items():
        with context.at(table, name):
            if math.isnan(default) and name not in written:
                raise ValueError(f'an FMU states no noise of its outputs: write {name} = "0.05 {unit}", or so')
            low = 0.0 if default == 0.0 else MIN_OUTPUT_NOISE
            levels[name] = Quantity(unit, low=low, difference=True)(written[name]) if name in written else default
    return levels


def _excluded(table: DiscoveryTable, twin: Definition, context: Context) -> frozenset[str]:
    """Return the keys of the components that discovery must not search for."""

    def allowed(key: str, names: tuple[str, ...] | None, known: Collection[str]) -> Collection[str]:
        for name in names or ():
            if name not in known:
                context.fail(("discovery", key), f"unknown name {name!r}: {nearest(name, list(known))}")
        return known if names is None else names

    inputs = [source.name for source in sources(twin)]
    families = allowed("families", table.families, FAMILY_NAMES)
    allowed_sites = allowed("sites", table.sites, [site.name for site in twin.sites])
    allowed_inputs = allowed("inputs", table.inputs, [name for name in inputs if name])
    doubted = {of(name) for name in allowed("sensors", table.sensors, twin.signals) for of in (sensor_site, gain_site)}

    drifting = {state.name for state in twin.states if state.process_noise}  # what follows the data explains nothing

    def is_allowed(site: str, family: str, name: str) -> bool:
        of_site = site in allowed_sites and family in families and (not name or name in allowed_inputs)
        return of_site or site in doubted

    return frozenset(
        key_of(site.name, family, name)
        for site in sites(twin)
        for family in FAMILY_NAMES
        for name in inputs
        if name in drifting or not is_allowed(site.name, family, name)
    )
