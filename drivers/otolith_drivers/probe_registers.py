"""From readings of Modbus registers to numbers, and to lines of a machine file. Pure."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith_drivers.modbus_options import MOST_REGISTERS, LineOptions, Table
from otolith_drivers.modbus_types import TypeName
from otolith_drivers.probe_layouts import REGISTERS, Bytes, Layout, register_layouts
from otolith_drivers.probe_modbus import Block, Survey, Words, spans
from otolith_drivers.probe_numbers import Part, Verdict, parts
from otolith_drivers.probe_text import number_text, quoted, spread

# A device that has one order for some numbers hardly ever has another for others: bits, once and for each reading.
OTHER_ORDER, OTHER_ORDER_OF_EACH = 8.0, 1.5
VOTES = {Verdict.TOLD: 3, Verdict.LIKELY: 1}  # for the order of all
COLUMNS: tuple[TypeName, ...] = ("int16", "uint16", "int32", "float32")
REMARKS = {
    Verdict.STILL: "cannot be told, as nothing changes there: move the machine and probe again",
    Verdict.WILD: "jumps over its whole range: part of something larger, or noise",
}
WIDE_COLUMNS: tuple[TypeName, ...] = ("int64", "float64")


@dataclass(frozen=True, slots=True)
class Number:
    """Registers that are one number, or of which nothing is known."""

    address: int
    part: Part
    others: tuple[tuple[int, Layout, float], ...] = ()
    """What else they could be: address, layout, latest value."""

    @property
    def count(self) -> int:
        """Registers."""
        return self.part.width // 2


def numbers_of(readings: Mapping[Block, Words]) -> list[Number]:
    """All numbers in the readings (rounds by registers, of each block)."""
    blocks = {block: bytes_of(words) for block, words in readings.items() if len(words)}
    found = _numbers(blocks, REGISTERS)
    orders = Counter[str]()
    for number in found:
        if number.part.layout is not None and number.count > 1:
            orders[number.part.layout.order] += VOTES.get(number.part.verdict, 0)
    if not orders:
        return found
    common = orders.most_common(1)[0][0]
    extra = OTHER_ORDER + OTHER_ORDER_OF_EACH * max(len(data) for data in blocks.values())
    return _numbers(blocks, [_less_likely_unless(common, layout, extra) for layout in REGISTERS])


def bytes_of(words: Words) -> Bytes:
    """Readings by bytes, the high one of each register first."""
    return words.astype(">u2").view(np.uint8).reshape(len(words), -1)


def _less_likely_unless(order: str, layout: Layout, extra: float) -> Layout:
    if layout.width == 2 or layout.order == order:
        return layout
    return replace(layout, handicap=layout.handicap + extra)


def _numbers(blocks: Mapping[Block, Bytes], layouts: Sequence[Layout]) -> list[Number]:
    return [
        Number(
            block.address + part.start // 2,
            part,
            tuple((block.address + other.start // 2, other.layout, other.latest) for other in part.others),
        )
        for block, data in blocks.items()
        for part in parts(data, layouts, 2)
    ]


@dataclass(frozen=True, slots=True)
class Reading:
    """A register, or several, read in one way."""

    layout: Layout
    latest: float
    low: float
    high: float
    fault: str
    """Why no machine says this; empty where one could."""


def readings_at(data: Bytes, at: int, kinds: Iterable[TypeName]) -> list[Reading]:
    """What begins with register ``at`` of a block with readings ``data``, in each of the types and every order."""
    found = []
    for kind in kinds:
        for layout in register_layouts(kind):
            end = 2 * at + layout.width
            if end <= data.shape[1]:
                numbers = layout.numbers(data[:, 2 * at : end])
                finite = numbers[np.isfinite(numbers)]
                low, high = (float(finite.min()), float(finite.max())) if len(finite) else (math.nan, math.nan)
                found.append(Reading(layout, float(numbers[-1]), low, high, layout.fault(numbers)))
    return found


@dataclass(frozen=True, slots=True)
class Place:
    """What of the machine file all registers have in common."""

    options: LineOptions
    device: int
    table: Table
    first_address: int

    def shown(self, address: int) -> int:
        """The register's number in the file."""
        return address + self.first_address


def driver_lines(place: Place, found: Survey) -> list[str]:
    """The table ``[driver]``."""
    options = place.options
    lines = ["[driver]", 'type = "modbus"']
    keys = ("host", "port", "framing") if options.host is not None else ("serial", "baudrate", "parity", "stop_bits")
    for key in keys:
        value = getattr(options, key)
        if key in ("host", "serial", "baudrate", "parity") or value != LineOptions.model_fields[key].default:
            lines.append(f"{key} = {quoted(value)}")
    lines.append(f"device = {place.device}")
    if place.first_address:
        lines.append(f"first_address = {place.first_address}")
    if found.most < MOST_REGISTERS:
        lines.append(f"max_registers = {found.most}")
    return lines


def signal_lines(place: Place, numbers: Sequence[Number]) -> list[str]:
    """The table ``[signals]``: a line for every number that moves, and remarks on the others."""
    lines = ["[signals]"]
    for number in numbers:
        layout, part = number.part.layout, number.part
        if layout is None or part.verdict is Verdict.WILD:
            continue
        order = f', order = "{layout.order}"' if layout.width > 2 or layout.order != "ABCD" else ""
        table = f', table = "{place.table}"' if place.table != "holding" else ""
        register = f"register = {place.shown(number.address)}{table}"
        comment = f"{spread(part)}{_perhaps(place, number)}"
        lines.append(f'NAME = {{ {register}, type = "{layout.kind}"{order}, unit = "?" }}  # {comment}')
    for verdict, words in REMARKS.items():
        addresses = [
            place.shown(at)
            for number in numbers
            if number.part.verdict is verdict
            for at in range(number.address, number.address + number.count)
        ]
        if addresses:
            lines.append(f"# {spans(addresses)}: {words}")
    return lines


def _perhaps(place: Place, number: Number) -> str:
    """What else it could be, as the end of a sentence."""
    texts = []
    for address, layout, latest in number.others:
        where = "" if address == number.address else f" of register {place.shown(address)}"
        texts.append(f"{layout.name}{where} ({number_text(latest, layout)})")
    return f"; or {', '.join(texts)}" if texts else ""
