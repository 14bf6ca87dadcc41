"""From readings of Modbus registers to numbers, and to lines of a machine file. Pure."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith_drivers.modbus.options import MAX_REGISTERS, LineOptions, Table
from otolith_drivers.modbus.probe import Block, Survey, Words, spans
from otolith_drivers.modbus.protocol import TypeName
from otolith_drivers.number_inference import (
    REGISTERS,
    Bytes,
    Layout,
    LayoutVerdict,
    Part,
    number_text,
    parts,
    quoted,
    register_layouts,
    spread,
)

# A device that has one byte order for some numbers seldom has another for others. Engineering choices, guarded by
# tests/drivers/test_number_inference.py (adjacent numbers of all types).
OTHER_ORDER_BITS, OTHER_ORDER_BITS_PER_READING = 8.0, 1.5
VOTES = {LayoutVerdict.CERTAIN: 3, LayoutVerdict.LIKELY: 1}  # of a number for the device's order

COLUMNS: tuple[TypeName, ...] = ("int16", "uint16", "int32", "float32")
WIDE_COLUMNS: tuple[TypeName, ...] = ("int64", "float64")
REMARKS = {
    LayoutVerdict.STILL: "cannot be told, as nothing changes there: move the machine and probe again",
    LayoutVerdict.ERRATIC: "jumps over its whole range: part of something larger, or noise",
}


@dataclass(frozen=True, slots=True)
class Number:
    """Registers that are one number, or whose type is unknown."""

    address: int
    part: Part
    word: int
    """The latest content of its first register."""

    @property
    def count(self) -> int:
        """Number of registers."""
        return self.part.width // 2

    @property
    def others(self) -> list[tuple[int, Layout, float]]:
        """Alternatives: address, layout, latest value."""
        base = self.address - self.part.start // 2
        return [(base + other.start // 2, other.layout, other.latest) for other in self.part.others]


def numbers_of(readings: Mapping[Block, Words]) -> list[Number]:
    """Return all numbers in the readings (rounds by registers) of each block."""
    blocks = {block.address: bytes_of(words) for block, words in readings.items() if len(words)}

    def infer(layouts: Sequence[Layout]) -> list[Number]:
        return [
            Number(at + part.start // 2, part, int.from_bytes(data[-1, part.start : part.start + 2].tobytes()))
            for at, data in blocks.items()
            for part in parts(data, layouts, 2)
        ]

    numbers, orders = infer(REGISTERS), Counter[str]()
    for part in (number.part for number in numbers):
        if part.layout is not None and part.layout.width > 2:
            orders[part.layout.order] += VOTES.get(part.verdict, 0)
    if not orders:
        return numbers
    common = orders.most_common(1)[0][0]
    extra = OTHER_ORDER_BITS + OTHER_ORDER_BITS_PER_READING * max(map(len, blocks.values()))
    return infer([
        layout if layout.width == 2 or layout.order == common else replace(layout, prior=layout.prior + extra)
        for layout in REGISTERS
    ])  # fmt: skip


def bytes_of(words: Words) -> Bytes:
    """Return readings by bytes, the high byte of each register first."""
    return words.astype(">u2").view(np.uint8).reshape(len(words), -1)


@dataclass(frozen=True, slots=True)
class Reading:
    """Registers read as one type in one order."""

    layout: Layout
    latest: float
    low: float
    high: float
    fault: str
    """Why no machine has these numbers; empty if one could."""


def readings_at(data: Bytes, at: int, kinds: Iterable[TypeName]) -> Iterator[Reading]:
    """Yield what starts at register ``at`` of a block with readings ``data``, in each type and order."""
    for layout in (layout for kind in kinds for layout in register_layouts(kind)):
        span = data[:, 2 * at : 2 * at + layout.width]
        if span.shape[1] == layout.width:
            numbers = layout.numbers(span)
            finite = numbers[np.isfinite(numbers)]
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (math.nan, math.nan)
            yield Reading(layout, float(numbers[-1]), low, high, layout.fault(numbers))


@dataclass(frozen=True, slots=True)
class Place:
    """Line, device, table and address base of all probed registers."""

    options: LineOptions
    device: int
    table: Table
    first_address: int

    def shown(self, address: int) -> int:
        """Return the register's number in the machine file."""
        return address + self.first_address


def modbus_driver_lines(place: Place, survey: Survey) -> list[str]:
    """Return the table ``[driver]`` of a machine file."""
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
    if survey.max_registers < MAX_REGISTERS:
        lines.append(f"max_registers = {survey.max_registers}")
    return lines


def modbus_signal_lines(place: Place, numbers: Sequence[Number]) -> list[str]:
    """Return the table ``[signals]``: a line for each number that moves, and remarks on other registers."""
    lines = ["[signals]"]
    for number in numbers:
        layout, part = number.part.layout, number.part
        if layout is None or part.verdict is LayoutVerdict.ERRATIC:
            continue
        order = f', order = "{layout.order}"' if layout.width > 2 or layout.order != "ABCD" else ""
        table = f', table = "{place.table}"' if place.table != "holding" else ""
        register = f"register = {place.shown(number.address)}{table}"
        longer = _longer_readings(place, number, numbers)
        mark = "? " if longer or part.verdict is LayoutVerdict.LIKELY else ""
        comment = f"{mark}{spread(part)}{_alternatives(place, number)}{longer}"
        lines.append(f'NAME = {{ {register}, type = "{layout.kind}"{order}, unit = "?" }}  # {comment}')
    for verdict, remark in REMARKS.items():
        unknown = [number for number in numbers if number.part.verdict is verdict]
        if unknown:
            addresses = [number.address + offset for number in unknown for offset in range(number.count)]
            lines.append(f"# {spans(map(place.shown, addresses))}: {remark}")
    return lines


def _longer_readings(place: Place, number: Number, numbers: Sequence[Number]) -> str:
    """Return numbers of 32 bits whose high word may be a still register beside ``number``, as the end of a sentence."""
    layout = number.part.layout
    if layout is None or layout.width > 2 or layout.order != "ABCD":
        return ""
    texts = []
    kind = layout.kind.replace("16", "32")
    for offset, order in ((-1, ""), (1, " CDAB")):
        high = next((other for other in numbers if other.address == number.address + offset), None)
        if high is not None and high.part.verdict is LayoutVerdict.STILL:
            whole = (high.word << 16) + (int(number.part.latest) & 0xFFFF)
            whole -= 1 << 32 if layout.signed and high.word >> 15 else 0
            texts.append(f"{kind}{order} of register {place.shown(min(number.address, high.address))} ({whole})")
    return "".join(f"; or {text}" for text in texts)


def _alternatives(place: Place, number: Number) -> str:
    """Return the alternatives as the end of a sentence."""
    texts = []
    for address, layout, latest in number.others:
        where = "" if address == number.address else f" of register {place.shown(address)}"
        texts.append(f"{layout.name}{where} ({number_text(latest, layout)})")
    return f"; or {', '.join(texts)}" if texts else ""
