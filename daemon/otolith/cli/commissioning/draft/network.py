"""What a Modbus device, an OPC UA server and an MQTT broker offer. All are only read."""

import asyncio
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.offers import Offer, OfferedSource, unit_in
from otolith.cli.commissioning.draft.writing import USUAL_PERIOD
from otolith.cli.commissioning.probe import NUMBER, address_keys, opened_server, read_registers
from otolith.cli.common import StopSignal, progress_line
from otolith_drivers.base import find_driver
from otolith_drivers.config_files import validated
from otolith_drivers.errors import ConfigurationError, DeviceError, counted
from otolith_drivers.grammars.toml_lines import toml_key, toml_value
from otolith_drivers.units import is_unit

if TYPE_CHECKING:
    from otolith_drivers.modbus.probe import Number
    from otolith_drivers.mqtt_probe import ObservedNumber
    from otolith_drivers.opcua.connection import OpcuaOptions, Variable
    from otolith_drivers.opcua.watching import VariableChanges

MAX_VARIABLES = 500  # of a server that are read
RENEWALS = "that with which its registers change while the machine moves, as far as the device answers so often"
CHANGES = "that with which the variables change while the machine moves"
ADDRESSING = ("device", "first_address")  # keys of [driver] beside those of the line


def device_offers(
    target: str,
    registers: tuple[int, int] | None,
    table: str,
    keys: Mapping[str, Any],
    seconds: float,
    stop: StopSignal,
) -> OfferedSource:
    """Return the numbers that change in the registers of a device; raise DeviceError if it does not answer."""
    from otolith_drivers.modbus.options import LineOptions
    from otolith_drivers.modbus.probe import Place, modbus_driver_lines, number_keys, possible_rate, renewal_of

    line = {name: value for name, value in keys.items() if name not in ADDRESSING}
    options = validated(address_keys(target) | line, LineOptions, ())
    device, base = _whole(keys, "device", 1), _whole(keys, "first_address", 0)
    place = Place(options, device, "holding" if table == "holding" else "input", base)
    first, last = _span(registers, keys)
    probed = read_registers(place, (first - base, last - base), seconds, stop)
    rate = possible_rate(probed.speeds)
    fastest = 1.0 / rate if rate else 0.0

    def interval(number: "Number") -> float | None:
        """Return the time in s from one new value to the next; without one, that of answers if it is long."""
        renewal = renewal_of(number, probed.changes)
        return (fastest if fastest > USUAL_PERIOD else None) if renewal is None else max(renewal, fastest)

    offers = [
        Offer(
            str(place.shown(number.address)),
            None,
            number_keys(place, number.address, number.part.layout),
            number.part.numbers[np.isfinite(number.part.numbers)],
            interval(number),
        )
        for number in probed.requested
        if number.part.layout is not None
    ]
    if not probed.survey.blocks:
        remedy = "choose those of the manual by --registers FIRST..LAST, or --table input"
        raise DeviceError(f"{options.title()}: {'; '.join(probed.survey.describe(base))}: {remedy}")
    if not offers:
        which = "; ".join(probed.survey.describe(base))
        remedy = "let the machine move, or choose others by --registers"
        raise DeviceError(f"{options.title()}: no register changes ({which}): {remedy}")
    lines = modbus_driver_lines(place, probed.survey)
    lines += [
        row for row in _rows(keys) if row.partition(" = ")[0] not in {known.partition(" = ")[0] for known in lines}
    ]
    still = {
        str(place.shown(block.address + int(at))): float(words[-1, at].astype(np.int16))
        for block, words in probed.readings.items()
        for at in (np.flatnonzero(np.ptp(words, axis=0) == 0) if len(words) else ())
    }
    title = f"{options.title()}, device {device}: {counted(len(offers), 'number')} that change"
    remark = (
        "registers have neither names nor units: read the display of the drive, and give --display SIGNAL=VALUE; "
        "or --signal SIGNAL=REGISTER, --unit REGISTER=UNIT and --scale, from a manual"
    )
    return OfferedSource(title, lines, offers, 0.0, remarks=[remark], period=RENEWALS, still=still)


def with_registers(answers: Answers, registers: tuple[int, int] | None, keys: Mapping[str, Any]) -> Answers:
    """Return the answers with registers as decimal numbers, as the device offers them.

    Raises:
        ConfigurationError: what is no register, or none of those that are read.
    """
    first, last = _span(registers, keys)

    def register(option: str, text: str) -> str:
        if re.fullmatch(NUMBER, text) is None:
            raise ConfigurationError(f"--{option} {text!r} is no register: write its number, like {first}")
        number = int(text, 16 if "x" in text else 10)
        if not first <= number <= last:
            read = f"{first} to {last} are read: choose --registers that contain it"
            raise ConfigurationError(f"--{option}: register {text}: registers {read}")
        return str(number)

    return replace(
        answers,
        signals={name: register(f"signal {name}", text) for name, text in answers.signals.items()},
        units={register("unit", text): unit for text, unit in answers.units.items()},
        scales={register("scale", text): scale for text, scale in answers.scales.items()},
    )


def _span(registers: tuple[int, int] | None, keys: Mapping[str, Any]) -> tuple[int, int]:
    """Return the first and the last register to read; raise ConfigurationError if there is no such first one."""
    base = _whole(keys, "first_address", 0)
    first, last = registers or (base, base + 63)
    if first < base:
        raise ConfigurationError(f"--registers: with first_address = {base} there is no register {first}")
    return first, last


def server_offers(
    endpoint: str, keys: Mapping[str, Any], seconds: float, folder: Path, stop: StopSignal
) -> OfferedSource:
    """Return the numbers of an OPC UA server; raise DeviceError if it cannot be read."""
    find_driver("opcua")  # names the extra that is missing
    from otolith_drivers.opcua.connection import OpcuaOptions

    options = validated({"endpoint": endpoint} | dict(keys), OpcuaOptions, ())
    with progress_line(f"reading {endpoint}") as show:
        numbers = asyncio.run(_watched(options, folder, seconds, stop, show))
    if not numbers:
        raise DeviceError(f"OPC UA {endpoint}: no variable with a number; 'otolith probe opcua' shows what there is")
    names = Counter(variable.path.rpartition("/")[2] for variable, _ in numbers)
    offers = []
    for variable, changes in numbers:
        short = variable.path.rpartition("/")[2]
        series = np.array(changes.values or [float(variable.value)])
        unit = variable.unit if variable.unit and is_unit(variable.unit) else unit_in(short)
        name = short if names[short] == 1 else variable.path
        offers.append(Offer(name, unit, {"node": variable.node}, series[np.isfinite(series)], changes.interval))
    lines = ["[driver]", 'type = "opcua"', f"endpoint = {toml_value(endpoint)}", *_rows(keys)]
    return OfferedSource(f"OPC UA {endpoint}: {counted(len(offers), 'number')}", lines, offers, 0.0, period=CHANGES)


async def _watched(
    options: "OpcuaOptions", folder: Path, seconds: float, stop: StopSignal, show: Callable[[str], None]
) -> "list[tuple[Variable, VariableChanges]]":
    """Return the variables of a server that are numbers, and how they change."""
    from otolith_drivers.opcua.connection import browse
    from otolith_drivers.opcua.watching import is_number, watch

    async with opened_server(options, folder) as client:
        numbers = [variable for variable in await browse(client, MAX_VARIABLES) if is_number(variable.value)]
        show(f"reading {options.endpoint}: {counted(len(numbers), 'number')} for {seconds:g} s")
        changes = await watch(client, numbers, seconds, stop.received) if numbers else []
        return list(zip(numbers, changes, strict=True))


def broker_offers(
    target: str, topics: str, keys: Mapping[str, Any], seconds: float, folder: Path, stop: StopSignal
) -> OfferedSource:
    """Return the numbers in the messages of a broker; raise DeviceError if there is none, or it sends no number."""
    module = find_driver("mqtt")  # names the extra that is missing
    from otolith_drivers.mqtt_probe import observe

    host, _, port = target.rpartition(":") if target.rpartition(":")[2].isdecimal() else (target, "", "")
    place: dict[str, Any] = {"host": host} | ({"port": int(port)} if port else {})
    options: Any = validated(place | dict(keys), module.Options, ())
    with progress_line(f"listening to {target}"):
        messages = observe(options, folder, seconds, stop.received, topics)
    offers, whole = list[Offer](), [_name(number) for number in messages.numbers.values()]
    names = Counter(short for _, short in whole)
    for number, (path, short) in zip(messages.numbers.values(), whole, strict=True):
        name = short if names[short] == 1 else path
        source = {"topic": number.topic} | ({} if number.path is None else {"field": number.path})
        steps = np.diff(number.times)
        interval = float(np.median(steps)) if len(steps) and np.median(steps) > 0.0 else None
        series = np.array(number.values)
        offers.append(Offer(name, unit_in(path), source, series[np.isfinite(series)], interval))
    if not offers:
        raise DeviceError(f"{options.title()}: no message with a number in {seconds:g} s in topics {topics}")
    lines = ["[driver]", 'type = "mqtt"', *_rows(place), *_rows(keys)]
    left = [f"{counted(messages.left_out, 'number')} of further topics left out"] if messages.left_out else []
    return OfferedSource(f"{options.title()}: {counted(len(offers), 'number')}", lines, offers, 0.0, remarks=left)


def _name(number: "ObservedNumber") -> tuple[str, str]:
    """Return the whole name of a number in messages, and the field or the last level of the topic alone."""
    if number.path is None:
        return number.topic, number.topic.rpartition("/")[2]
    return f"{number.topic} {number.path}", number.path


def _rows(keys: Mapping[str, Any]) -> list[str]:
    return [f"{toml_key(name)} = {toml_value(value)}" for name, value in keys.items()]


def _whole(keys: Mapping[str, Any], name: str, default: int) -> int:
    value = keys.get(name, default)
    if not isinstance(value, int):
        raise ConfigurationError(f"--driver {name}={value}: write a whole number")
    return value


def driver_keys(written: Mapping[str, str]) -> dict[str, Any]:
    """Return keys of ``[driver]`` with what their texts mean: a whole number, true, false, else the text."""
    words: Mapping[str, Any] = {"true": True, "false": False}
    return {name: int(text) if text.isdecimal() else words.get(text, text) for name, text in written.items()}
