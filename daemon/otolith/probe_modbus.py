"""What ``otolith probe modbus`` says: registers in every reading, and lines for the machine file."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.console import Console

from otolith.probe_grids import Row, grids
from otolith_drivers.modbus_line import FUNCTION_CODES
from otolith_drivers.modbus_options import HIGHEST_ADDRESS
from otolith_drivers.modbus_types import LETTERS, TypeName
from otolith_drivers.probe_line import Answer, Asker, Stopped, Told, opened, scan
from otolith_drivers.probe_modbus import Block, Speed, Survey, Words, possible_rate, spans, speeds, survey, watch
from otolith_drivers.probe_numbers import Verdict
from otolith_drivers.probe_registers import (
    COLUMNS,
    WIDE_COLUMNS,
    Number,
    Place,
    Reading,
    bytes_of,
    driver_lines,
    numbers_of,
    readings_at,
    signal_lines,
)
from otolith_drivers.probe_text import number_text

LONGEST_NUMBER = 4  # registers
FEWEST_ZEROS = 3  # registers in a row that are one row of the table
MARKS = {Verdict.TOLD: "*", Verdict.COUNTS: "*", Verdict.LIKELY: "?"}
ALONE = "a register alone may be half of a longer number: ask for its neighbours as well"
LEGEND = "* what it is, told by how it moves    ? likely, but it hardly moves    · a number that no machine has"


@dataclass(frozen=True)
class Probed:
    """A device, as far as it was looked at."""

    place: Place
    registers: tuple[int, int]
    """First and last that were asked for, on the wire."""
    found: Survey
    readings: dict[Block, Words]
    numbers: list[Number]
    speeds: list[Speed]
    seconds: float

    @property
    def single(self) -> bool:
        """Whether only one register was asked for."""
        return self.registers[0] == self.registers[1]

    @property
    def wanted(self) -> list[Number]:
        """The numbers that were asked for: with a single register only that which begins there."""
        return [number for number in self.numbers if not self.single or number.address == self.registers[0]]


def probe_device(place: Place, registers: tuple[int, int], seconds: float, stopped: Stopped, told: Told) -> Probed:
    """Look at the registers (on the wire) of a device.

    Raises:
        DeviceError: the line cannot be opened, or the device does not answer.
    """
    with opened(place.options, told) as line:
        asker = Asker(line, place.options, place.device, place.table)
        first, last = registers
        if first == last:
            last = min(first + LONGEST_NUMBER - 1, HIGHEST_ADDRESS)
        found = survey(asker, first, last, stopped, told)
        asker.round_trips.clear()  # the first ones take longer
        begun = time.monotonic()
        readings = watch(asker, found.blocks, seconds, stopped, told)
        elapsed = time.monotonic() - begun
        told("comparing")
        return Probed(place, registers, found, readings, numbers_of(readings), speeds(asker, found.blocks), elapsed)


def scan_line(place: Place, devices: tuple[int, int], register: int, stopped: Stopped, told: Told) -> list[Answer]:
    """The devices on a line that answer when asked for ``register`` (on the wire).

    Raises:
        DeviceError: the line cannot be opened.
    """
    with opened(place.options, told) as line:
        asker = Asker(line, place.options, devices[0], place.table)
        return scan(asker, range(devices[0], devices[1] + 1), register, stopped, told)


def show_scan(place: Place, devices: tuple[int, int], answers: Sequence[Answer], console: Console) -> None:
    """The answers, in words."""
    asked = devices[1] - devices[0] + 1
    console.print(f"{place.options.title()}: {len(answers)} of {asked} devices answer")
    for said in dict.fromkeys(answer.said for answer in answers):
        alike = spans([answer.device for answer in answers if answer.said == said], "device")
        console.print(alike + (f" (that register is refused: {said})" if said else ""), markup=False)
    if len(answers) == asked > 1:
        console.print("everybody answers: it seems that this host does not look at the device number")
    if not answers:
        other = "is it the right host, or is it a gateway with framing = rtu?"
        serial = "are baud rate, parity and stop bits right, and the two wires not swapped?"
        console.print(serial if place.options.host is None else other)


def show_device(probed: Probed, console: Console, *, wide: bool) -> None:
    """All that was found, in words, tables and lines for the machine file."""
    place = probed.place
    title = f"{place.options.title()}, device {place.device}, {place.table} registers"
    console.print(f"{title}, read only (function code {FUNCTION_CODES[place.table]})")
    for text in probed.found.describe(place.first_address):
        console.print(text)
    if not probed.found.blocks and not probed.found.refused:
        console.print("ended before anything was read")
        return
    if not probed.found.blocks:
        other = "input" if place.table == "holding" else "holding"
        console.print(f"the device is there, but not these registers: try others by --registers, or --table {other}")
        return
    for text in speed_lines(probed):
        console.print(text)
    console.print()
    kinds: tuple[TypeName, ...] = COLUMNS + WIDE_COLUMNS if wide else COLUMNS
    heads, rows = _list(probed) if probed.single else (("register", "raw"), list(_rows(probed, kinds)))
    for grid in grids(heads, rows, console.width):
        console.print(grid)
        console.print()
    console.print(LEGEND, style="dim", soft_wrap=True)
    if probed.single:
        console.print(ALONE, style="dim", soft_wrap=True)
    console.print()
    for text in lines_of(probed):
        console.print(text, markup=False, soft_wrap=True)


def lines_of(probed: Probed) -> list[str]:
    """For the machine file."""
    return [*driver_lines(probed.place, probed.found), "", *signal_lines(probed.place, probed.wanted)]


def speed_lines(probed: Probed) -> list[str]:
    """How often it was read, how fast it answered, and what rate that allows."""
    most = max((len(words) for words in probed.readings.values()), default=0)
    lines = [f"{most} readings in {probed.seconds:.1f} s"]
    lines += [speed.describe() for speed in dict.fromkeys(probed.speeds)]
    if rate := possible_rate(probed.speeds):
        lines[-1] += f", so {rate:g} Hz is possible" + (" for all of it" if len(probed.speeds) > 1 else "")
    return lines


def _rows(probed: Probed, kinds: Sequence[TypeName]) -> Iterator[Row]:
    """A row for each register, and one for many that are always zero."""
    numbers = {number.address: number for number in probed.numbers}
    for block, words in probed.readings.items():
        if not len(words):
            continue
        data = bytes_of(words)
        zeros = [not words[:, at].any() for at in range(block.count)]
        at = 0
        while at < block.count:
            run = next((end for end in range(at, block.count) if not zeros[end]), block.count) - at
            label = f"{probed.place.shown(block.address + at)}"
            if run >= FEWEST_ZEROS:
                yield Row((f"{label} to {probed.place.shown(block.address + at + run - 1)}", "0000"), {kinds[0]: "0"})
                at += run
                continue
            row = Row((label, f"{words[-1, at]:04X}"))
            for reading in readings_at(data, at, kinds):
                row.cells[reading.layout.name] = _short(reading)
            _mark(row, numbers.get(block.address + at))
            yield row
            at += 1


def _mark(row: Row, number: Number | None) -> None:
    """Show which of the numbers in a row it is."""
    if number is not None and number.part.layout is not None and (mark := MARKS.get(number.part.verdict)):
        name = number.part.layout.name
        row.cells.setdefault(name, number_text(number.part.latest, number.part.layout))
        row.marks[name] = mark


def _short(reading: Reading) -> str:
    """In a table there is no room for what cannot be."""
    return "·" if reading.fault or not math.isfinite(reading.latest) else number_text(reading.latest, reading.layout)


def _list(probed: Probed) -> tuple[tuple[str, ...], list[Row]]:
    """A single register in every type and order, a row each."""
    block, words = next(
        (pair for pair in probed.readings.items() if pair[0].address == probed.registers[0]), (None, None)
    )
    rows = []
    number = next(iter(probed.wanted), None)
    for reading in [] if block is None or words is None or not len(words) else readings_at(bytes_of(words), 0, LETTERS):
        row = Row((reading.layout.kind, reading.layout.order))
        for name, value in (("now", reading.latest), ("least", reading.low), ("most", reading.high)):
            row.cells[name] = number_text(value, reading.layout, reading.high - reading.low)
        row.cells["remark"] = reading.fault
        if number is not None and number.part.layout is not None and number.part.layout.name == reading.layout.name:
            row.marks["now"] = MARKS.get(number.part.verdict, "")
        rows.append(row)
    return ("type", "order"), rows
