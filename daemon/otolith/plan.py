"""What a machine file means: its twin, its estimation problem, its driver. Faults are told with file, line and key."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from otolith.acquisition.alignment import Limits
from otolith.adaptation.learned import LearnedNoise
from otolith.adaptation.problem import Problem, SwarmOptions, WindowOptions
from otolith.errors import ConfigurationError, nearest
from otolith.named_driver import named_driver
from otolith.restrictions import excluded
from otolith.settings import MachineFile, ParameterTable, WindowTable, Written
from otolith.twin.definition import Definition, Parameter, Role
from otolith.twins import find_twin, load_twin
from otolith_drivers.base import Driver
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Context, Page, expect, parse, read, validate

VALUED = ("dbc", "eds", "order", "first_address", "device")  # keys of a driver, that values of signals depend on
SMALLEST_NOISE = 1e-12  # of an output: without any, no residual could be weighed


@dataclass(frozen=True, slots=True)
class Plan:
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
    def heard(self) -> str:
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


def load_plan(path: Path, *, with_driver: bool = True) -> Plan:
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
    return Plan(
        path=path,
        file=file,
        twin=twin,
        problem=problem,
        records=problem.window.records,
        limits=Limits(table.missing_limit, table.gap_limit, table.jitter_limit),
        source=_driver(file, twin, page) if with_driver else None,
    )


def with_noise(plan: Plan, found: LearnedNoise) -> Plan:
    """The plan with the levels of noise that were learned."""
    outputs = {level.name: level.value for level in found.outputs}
    states = {level.name: level.value for level in found.states}
    problem = replace(
        plan.problem,
        noise=tuple(outputs[entry.name] for entry in plan.twin.outputs),
        process_noise=tuple(states[entry.name] for entry in plan.twin.states),
    )
    return replace(plan, problem=problem)


def _twin(file: MachineFile, context: Context) -> Definition:
    if (file.twin.name is None) == (file.twin.file is None):
        context.fail(("twin",), 'write either name = "dc_motor" or the like, or file = "my-twin.toml"')
    if file.twin.file is not None:
        return load_twin(context.page.path.parent / file.twin.file)
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


def _driver(file: MachineFile, twin: Definition, page: Page) -> Driver:
    named = named_driver(file, twin, page)
    with named.faults_placed():
        return named.module.build(named.options, named.setup)
