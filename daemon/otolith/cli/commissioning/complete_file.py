"""A machine file with all its defaults: a line with ``#`` has one, ``##`` is prose, all others are of the file."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from otolith.cli.commissioning.values import written_value
from otolith.machine import LoadedMachine
from otolith.machine_file import MachineFile, driver_configs, own_keys
from otolith.twin.definition import Parameter, Role
from otolith_drivers.config_files import SourceFile, parse
from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value

OF_THE_MACHINE = (
    "machine",
    "driver",
    "signals",
    "twin",
    "parameters",
    "components",
    "performance",
    "operation",
    "rule",
    "noise",
    "process_noise",
)
Table = Mapping[str, Any]


def complete_lines(machine: LoadedMachine, source: SourceFile) -> Iterator[str]:
    """Yield the lines of the machine file with all its defaults."""
    data = parse(source)
    yield from _table(("machine",), machine.file.machine, data["machine"])
    yield from _drivers(machine, source)
    yield from _signals(machine, source)
    yield from _table(("twin",), machine.file.twin, data["twin"])
    for parameter in machine.twin.parameters:
        if parameter.role is not Role.SETTING:
            yield from _parameter(machine, parameter, data.get("parameters", {}).get(parameter.name, {}))
    for kind in ("components", "performance", "operation"):
        for name, table in data.get(kind, {}).items():
            yield from (_header((kind, name)), *_written(table), "")
    for rule in data.get("rule", ()):
        yield from ("[[rule]]", *_written(rule), "")
    yield from _noise(machine, data)
    for name in MachineFile.model_fields:
        if name in machine.of_service:
            yield from (_prose(f"[{name}]: as in {machine.path_of(name).name}, as long as it is not written here"), "")
        elif name not in OF_THE_MACHINE:
            yield from _table((name,), getattr(machine.file, name), data.get(name, {}))


def _header(path: Sequence[str]) -> str:
    return f"[{'.'.join(map(toml_key, path))}]"


def _prose(text: str) -> str:
    return f"#{toml_comment(text)}"


def _written(table: Table) -> Iterator[str]:
    yield from (f"{toml_key(name)} = {toml_value(value)}" for name, value in table.items())


def _default(name: str, value: str) -> str:
    return f"# {toml_key(name)} = {value}"


def _table(path: Sequence[str], model: BaseModel, written: Table) -> Iterator[str]:
    """Yield a table of the schema and those in it."""
    yield _header(path)
    yield from _rows(model, written)
    yield ""
    for name in type(model).model_fields:
        value = getattr(model, name)
        if isinstance(value, BaseModel):
            yield from _table((*path, name), value, written.get(name, {}))


def _rows(model: BaseModel, written: Table) -> Iterator[str]:
    """Yield a line for each key that is no table: as written, else the default, unless the written ones exclude it."""
    for attribute, field in type(model).model_fields.items():
        value, name = getattr(model, attribute), field.alias or attribute
        if isinstance(value, BaseModel):
            continue
        if name in written:
            yield from _written({name: written[name]})
        elif value is None or value in ((), {}):
            yield _prose(f"{name}: not set")
        elif _is_allowed(type(model), written, name, text := written_value(field, value)):
            yield _default(name, text)


def _is_allowed(kind: type[BaseModel], written: Table, name: str, text: str) -> bool:
    """Whether a table may have a key with this value of TOML beside the written ones."""
    try:
        kind.model_validate({**written, **tomllib.loads(f"{toml_key(name)} = {text}")})
    except ValidationError:
        return False
    return True


def _drivers(machine: LoadedMachine, source: SourceFile) -> Iterator[str]:
    """Yield the drivers with all keys that theirs have."""
    file = machine.file
    for driver, table in zip(_configs(machine, source), file.drivers, strict=False):
        yield "[driver]" if isinstance(file.driver, dict) else "[[driver]]"
        yield from _written({name: table[name] for name in ("type", "name") if name in table})
        keys = {name: value for name, value in table.items() if name not in ("type", "name")}
        yield from _rows(driver.options, keys)
        yield from _written(_beside(driver.options, keys))
        yield ""
    if machine.built_driver is not None:
        yield from (_prose(line) for line in machine.driver.describe())
        yield ""


def _configs(machine: LoadedMachine, source: SourceFile) -> tuple[Any, ...]:
    return driver_configs(machine.file, machine.twin, source) if machine.file.drivers else ()


def _beside(model: BaseModel, written: Table) -> Table:
    """Return the written keys that are tables, or that a driver takes without naming them; they stay as they are."""
    rows = {
        field.alias or name
        for name, field in type(model).model_fields.items()
        if not isinstance(getattr(model, name), BaseModel)
    }
    return {name: value for name, value in written.items() if name not in rows}


def _signals(machine: LoadedMachine, source: SourceFile) -> Iterator[str]:
    """Yield the signals that a driver reads with all keys that theirs have, and those that no sensor measures."""
    file = machine.file
    for driver in _configs(machine, source):
        for signal in driver.setup.signals:
            table = file.read_signals[signal.name]
            keys = own_keys(table)
            yield _header(("signals", signal.name))
            yield from _rows(signal.source, keys)
            yield from _written(_beside(signal.source, keys))
            common = {name: value for name, value in table.items() if name not in keys}
            if signal.name in machine.signal_tables:
                yield from _rows(machine.signal_tables[signal.name], common)
            else:
                yield from _written(common)
            yield ""
    for name, table in file.unmeasured.items():
        yield from (_header(("signals", name)), *_written(table), "")


def _parameter(machine: LoadedMachine, parameter: Parameter, written: Any) -> Iterator[str]:
    """Yield a parameter with its value, and one that is estimated with its bounds and limits."""
    free = {row.name: row for row in machine.problem.free}
    table: Table = written if isinstance(written, dict) else {"value": written}
    used = free.get(parameter.name, parameter)
    numbers = {"value": used.nominal, "low": used.low, "high": used.high}
    if parameter.name not in free:
        numbers = {"value": dict(machine.problem.known)[parameter.name]}
    defaults = {name: toml_value(f"{number:.9g} {parameter.unit}") for name, number in numbers.items()}
    defaults["estimate"] = toml_value(parameter.name in free)
    if parameter.name in free and not {"watch", "act"} & table.keys():
        limits = {"watch": parameter.watch, "act": parameter.act}
        defaults |= {name: toml_value(list(values)) for name, values in limits.items() if values}
    yield _header(("parameters", parameter.name))
    yield _prose(parameter.meaning)
    yield from _written(table)
    is_example = {**machine.plan.known, **machine.plan.parameters}[parameter.name].is_example
    for name, value in defaults.items():
        if name not in table:
            # Written into the file, the value would be that of this machine, and judged.
            of_example = is_example and name == "value"
            yield _prose(f"{name} = {value}, of the twin's example") if of_example else _default(name, value)
    yield ""


def _noise(machine: LoadedMachine, data: Table) -> Iterator[str]:
    """Yield the noise of all sensors, and of the equations of all states."""
    twin, problem = machine.twin, machine.problem
    levels = {row.name: (row.unit, level) for row, level in zip(twin.outputs, problem.noise, strict=True)}
    levels |= {row.name: (row.unit, level) for row, level in zip(twin.inputs, problem.input_noise, strict=True)}
    states = zip(twin.states, problem.process_noise, strict=True)
    process = {row.name: (f"({row.unit})/s^0.5", level) for row, level in states}
    for name, defaults in (("noise", levels), ("process_noise", process)):
        table = data.get(name, {})
        yield _header((name,))
        yield from _written(table)
        for key, (unit, level) in defaults.items():
            if key not in table:
                yield _default(key, toml_value(f"{level:.9g} {unit}"))
        yield ""
