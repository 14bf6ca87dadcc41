"""What ``otolith probe`` prints: tables that fit the terminal, lines for the machine file, or a JSON document."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from cantools.database import Signal
from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

from otolith.cli.console import Terminal
from otolith_drivers.canbus import probe as canbus
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.errors import counted, some_names
from otolith_drivers.modbus import probe as modbus
from otolith_drivers.modbus.client import BUSY_CODES, EXCEPTIONS, FUNCTION_CODES
from otolith_drivers.modbus.options import LETTERS, TypeName
from otolith_drivers.number_inference import LayoutVerdict, number_text

PLAIN_WIDTH = 200  # columns of output that goes into a file
GAP = 2  # characters between columns
TEXT_COLUMNS = ("what", "remark")  # aligned left and wrapped
TEXT_WIDTH = 24  # characters to which a text column may shrink
MIN_ZERO_RUN = 3  # registers in a row that are always zero and share a row of the table
STYLES = {"*": "bold green", "?": "yellow", "!": "bold red", "·": "dim"}  # by the first character of a cell
MARKS = {LayoutVerdict.CERTAIN: "*", LayoutVerdict.COUNTER: "*", LayoutVerdict.LIKELY: "?"}
MODBUS_LEGEND = "* inferred from its changes    ? likely, but it hardly changes    · not a plausible number"
SINGLE_LEGEND = "a single register may be half of a longer number: probe its neighbours as well"
CAN_LEGEND = "[..] bytes that have changed    ± half of the width that holds 19 of 20 periods"

Row = dict[str, str]  # Cells by the name of their column; a header has one line for each word of the name


def stdout_console() -> Console:
    """Standard output, as wide as the terminal or ``PLAIN_WIDTH``."""
    console = Terminal()
    return console if console.is_terminal else Terminal(width=PLAIN_WIDTH)


def fitted_tables(fixed: tuple[str, ...], rows: Sequence[Row], width: int) -> Iterator[Table]:
    """Tables of all rows, no wider than ``width`` where possible; the ``fixed`` columns stand in each.

    Columns whose names begin alike stay in one table if one can hold them.
    """
    names = [name for name in dict.fromkeys(name for row in rows for name in row) if name not in fixed]
    widths = {name: _width(rows, name) for name in names if any(row.get(name) for row in rows)}
    room = width - sum(_width(rows, name) for name in fixed)
    chosen: list[str] = []
    for _, members in groupby(widths, key=lambda name: name.split()[0]):
        family = list(members)
        whole = sum(widths[name] for name in family) <= room
        for group in [family] if whole else [[name] for name in family]:
            if chosen and sum(widths[name] for name in (*chosen, *group)) > room:
                yield _table(fixed, chosen, rows)
                chosen = []
            chosen += group
    if rows:
        yield _table(fixed, chosen, rows)


def _width(rows: Sequence[Row], name: str) -> int:
    longest = max((len(row.get(name, "")) for row in rows), default=0)
    longest = min(longest, TEXT_WIDTH) if name in TEXT_COLUMNS else longest
    return GAP + max(longest, *map(len, name.split()))


def _table(fixed: tuple[str, ...], names: Sequence[str], rows: Sequence[Row]) -> Table:
    table = Table(box=None, padding=(0, GAP, 0, 0), header_style="bold")
    for name in (*fixed, *names):
        left = name in fixed or name in TEXT_COLUMNS
        table.add_column(Group(*name.split()), justify="left" if left else "right", vertical="bottom",
                         no_wrap=name not in TEXT_COLUMNS)  # fmt: skip
    for row in rows:
        cells = [row.get(name, "") for name in names]
        styled = [Text(cell, style=STYLES.get(cell[:1], "")) for cell in cells]
        table.add_row(*(Text(row[name]) for name in fixed), *styled)
    return table


@dataclass(frozen=True)
class DeviceProbe:
    """What was read from a Modbus device."""

    place: modbus.Place
    registers: tuple[int, int]  # Addresses (on the wire) of the first and the last register asked for
    survey: modbus.Survey
    readings: dict[modbus.Block, modbus.Words]
    changes: dict[modbus.Block, modbus.Changes]
    speeds: list[modbus.Speed]
    seconds: float  # Time spent reading
    numbers: list[modbus.Number]

    @property
    def single(self) -> bool:
        """Whether only one register was asked for."""
        return self.registers[0] == self.registers[1]

    @property
    def requested(self) -> list[modbus.Number]:
        """The numbers asked for; with a single register only the one that begins there."""
        return [number for number in self.numbers if not self.single or number.address == self.registers[0]]


def show_device(probe: DeviceProbe, console: Console, *, wide: bool) -> None:
    """Print which registers there are, their values, and lines for the machine file."""
    place, survey = probe.place, probe.survey
    title = f"{place.options.title()}, device {place.device}, {place.table} registers"
    console.print(f"{title}, read only (function code {FUNCTION_CODES[place.table]})")
    for line in survey.describe(place.first_address):
        console.print(line)
    if not survey.blocks:
        other = "input" if place.table == "holding" else "holding"
        remedy = f"the device is there, but not these registers: try others by --registers, or --table {other}"
        if set(survey.refused.values()) <= {EXCEPTIONS[code] for code in BUSY_CODES}:
            remedy = "the device is there, but busy: try again later"
        console.print(remedy if survey.refused else "ended before anything was read")
        return
    for line in _speed_lines(probe):
        console.print(line)
    console.print()
    kinds = modbus.COLUMNS + modbus.WIDE_COLUMNS if wide else modbus.COLUMNS
    fixed, rows = ("register", "raw"), list(_register_rows(probe, kinds))
    if probe.single:
        fixed, rows = ("type", "order"), _type_rows(probe)
    for table in fitted_tables(fixed, rows, console.width):
        console.print(table, "")
    console.print(MODBUS_LEGEND, style="dim", soft_wrap=True)
    if probe.single:
        console.print(SINGLE_LEGEND, style="dim", soft_wrap=True)
    for line in ("", *_modbus_lines(probe)):
        console.print(line, soft_wrap=True)


def _modbus_lines(probe: DeviceProbe) -> list[str]:
    """The tables ``[driver]`` and ``[signals]``."""
    driver = modbus.modbus_driver_lines(probe.place, probe.survey)
    return [*driver, "", *modbus.modbus_signal_lines(probe.place, probe.requested)]


def _speed_lines(probe: DeviceProbe) -> list[str]:
    """How often it was read, how fast it answered, and which polling rate that allows."""
    count = max((len(words) for words in probe.readings.values()), default=0)
    lines = [f"{counted(count, 'reading')} in {probe.seconds:.1f} s"]
    lines += [speed.describe() for speed in dict.fromkeys(probe.speeds)]
    if rate := modbus.possible_rate(probe.speeds):
        lines[-1] += f", so {rate:g} Hz is possible" + (" for all of it" if len(probe.speeds) > 1 else "")
    return lines


def _register_rows(probe: DeviceProbe, kinds: Sequence[TypeName]) -> Iterator[Row]:
    """A row for each register, and one for each run of registers that are always zero."""
    numbers = {number.address: number for number in probe.numbers}
    for block, words in probe.readings.items():
        at = 0
        while len(words) and at < block.count:
            address = block.address + at
            label = str(probe.place.shown(address))
            zeros = int(np.argmax(np.append(words[:, at:].any(axis=0), True)))
            if zeros >= MIN_ZERO_RUN:
                last = probe.place.shown(address + zeros - 1)
                yield {"register": f"{label} to {last}", "raw": "0000", kinds[0]: "0"}
                at += zeros
                continue
            row = {"register": label, "raw": f"{words[-1, at]:04X}"}
            for reading in modbus.readings_at(modbus.bytes_of(words), at, kinds):
                usable = not reading.fault and math.isfinite(reading.latest)
                row[reading.layout.name] = number_text(reading.latest, reading.layout) if usable else "·"
            part = numbers[address].part if address in numbers else None
            if part is not None and part.layout is not None and part.verdict in MARKS:
                text = row.get(part.layout.name, number_text(part.latest, part.layout))
                row[part.layout.name] = MARKS[part.verdict] + text
            yield row
            at += 1


def _type_rows(probe: DeviceProbe) -> list[Row]:
    """A single register in every type and order, a row each."""
    block = next((block for block in probe.readings if block.address == probe.registers[0]), None)
    if block is None or not len(probe.readings[block]):
        return []
    part = next((number.part for number in probe.requested), None)
    rows = []
    for reading in modbus.readings_at(modbus.bytes_of(probe.readings[block]), 0, LETTERS):
        layout, step = reading.layout, reading.high - reading.low
        inferred = part is not None and part.layout is not None and part.layout.name == layout.name
        mark = MARKS.get(part.verdict, "") if part is not None and inferred else ""
        rows.append({
            "type": layout.kind,
            "order": layout.order,
            "now": mark + number_text(reading.latest, layout, step),
            "least": number_text(reading.low, layout, step),
            "most": number_text(reading.high, layout, step),
            "remark": reading.fault,
        })  # fmt: skip
    return rows


def modbus_document(probe: DeviceProbe) -> dict[str, Any]:
    """All that was read, for JSON; a number that is not finite is None."""
    place, survey = probe.place, probe.survey
    return {
        "line": place.options.title(),
        "device": place.device,
        "table": place.table,
        "first_address": place.first_address,
        "readable": [[place.shown(block.address), place.shown(block.end - 1)] for block in survey.blocks],
        "refused": {str(place.shown(address)): reason for address, reason in survey.refused.items()},
        "most_registers": survey.max_registers,
        "speed": [
            {"registers": speed.registers, "median_s": speed.median, "slow_s": speed.slow} for speed in probe.speeds
        ],
        "possible_hz": modbus.possible_rate(probe.speeds),
        "registers": [
            {
                "register": place.shown(block.address + at),
                "raw": f"{words[-1, at]:04X}",
                "values": {
                    reading.layout.name: _finite(reading.latest)
                    for reading in modbus.readings_at(modbus.bytes_of(words), at, LETTERS)
                },
            }
            for block, words in probe.readings.items()
            for at in range(block.count if len(words) else 0)
        ],
        "numbers": [_number_document(place, number) for number in probe.requested],
        "lines": _modbus_lines(probe),
    }


def _number_document(place: modbus.Place, number: modbus.Number) -> dict[str, Any]:
    layout, part = number.part.layout, number.part
    return {
        "register": place.shown(number.address),
        "count": number.count,
        "verdict": part.verdict,
        "type": layout.kind if layout else None,
        "order": layout.order if layout else None,
        "latest": _finite(part.latest),
        "low": _finite(part.low),
        "high": _finite(part.high),
        "others": [
            {"register": place.shown(address), "type": other.kind, "order": other.order, "latest": _finite(latest)}
            for address, other, latest in number.others
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def bus_title(options: BusOptions, picture: canbus.Picture) -> str:
    """The bus, and how many frames came."""
    frames, identifiers = counted(picture.frames, "frame"), counted(len(picture.observed), "arbitration ID")
    return f"CAN bus {options.title()}, only listening: {frames} of {identifiers}"


def tables(picture: canbus.Picture, width: int) -> Iterator[RenderableType]:
    """Frames, the signals in them that a database knows, and remarks."""
    yield from fitted_tables(("ID", "data"), [_frame_row(picture, frames) for frames in picture.ordered()], width)
    rows = [_signal_row(frames, signal, value) for frames, signal, value in picture.signals()]
    if rows:
        yield Text("")
        yield from fitted_tables(("signal", "unit"), rows, width)
    yield from (Text(line, style="yellow") for line in remarks(picture))


def _frame_row(picture: canbus.Picture, frames: canbus.ObservedFrames) -> Row:
    lengths = sorted({min(frames.lengths, default=0), max(frames.lengths, default=0)})
    rate = period = ""
    if frames.period is not None:
        rate = f"{1.0 / frames.period:.3g}"
        period = f"{1e3 * frames.period:.3g} ms ± {1e3 * frames.jitter:.2g}" if frames.regular else "irregular"
    return {
        "ID": frames.name,
        "data": marked(frames),
        "bytes": " to ".join(map(str, lengths)),
        "frames": str(frames.count),
        "Hz": rate,
        "period": period,
        "what": _content(picture, frames),
    }


def _content(picture: canbus.Picture, frames: canbus.ObservedFrames) -> str:
    """The message that the database names, or what the arbitration ID suggests."""
    unknown = "! not in the database" if picture.has_database and frames.message is None else ""
    if frames.remote == frames.count:
        return f"{'! ' if unknown else ''}remote frames"
    if frames.message is not None:
        return frames.title + (f"; {frames.undecodable} not decodable" if frames.undecodable else "")
    return "; ".join(filter(None, [unknown, picture.guess(frames)]))


def marked(frames: canbus.ObservedFrames) -> str:
    """The latest data in hexadecimal digits, with the bytes that have changed in brackets."""
    runs = []
    for changed, run in groupby(enumerate(frames.latest), key=lambda item: bool(frames.changed[item[0]])):
        text = " ".join(f"{byte:02X}" for _, byte in run)
        runs.append(f"[{text}]" if changed else text)
    return " ".join(runs)


def _signal_row(frames: canbus.ObservedFrames, signal: Signal, value: canbus.ObservedValue) -> Row:
    low, high = signal.minimum, signal.maximum
    message = frames.message.name if frames.message else frames.name
    return {
        "signal": f"{message}.{signal.name}{frames.source}",
        "unit": signal.unit or "",
        "now": ("" if canbus.within(signal, value.latest) else "!") + canbus.value_text(signal, value.latest),
        "least": canbus.value_text(signal, value.low),
        "most": canbus.value_text(signal, value.high),
        "range": f"{low:g} to {high:g}" if low is not None and high is not None and low < high else "",
        "beyond": f"!{value.beyond} times" if value.beyond else "",
    }


def remarks(picture: canbus.Picture) -> Iterator[str]:
    """Error frames, frames that are not shown, and messages of the database that did not come; a line each."""
    if picture.error_frames:
        kinds = ", ".join(f"{count} {name}" for name, count in picture.errors.most_common())
        yield f"{counted(picture.error_frames, 'error frame')}: {kinds}"
    if picture.unreadable:
        yield f"{counted(picture.unreadable, 'frame')} could not be unpacked"
    if picture.left_out:
        yield f"not shown: {counted(picture.left_out, 'frame')} of further arbitration IDs"
    if missing := [message.name for message in picture.missing()]:
        yield f"in the database, but not received: {some_names(missing)}"


def show_bus(
    picture: canbus.Picture, options: BusOptions, database: Path | None, seconds: float, console: Console
) -> None:
    """Print the frames that came, the signals in them, and lines for the machine file."""
    console.print(f"{bus_title(options, picture)} in {seconds:.1f} s")
    console.print()
    if not picture.frames:
        return
    console.print(Group(*tables(picture, console.width)))
    console.print(CAN_LEGEND, style="dim", soft_wrap=True)
    for line in ("", *_can_lines(picture, options, database)):
        console.print(line, soft_wrap=True)


def _can_lines(picture: canbus.Picture, options: BusOptions, database: Path | None) -> list[str]:
    """The tables ``[driver]`` and ``[signals]``."""
    driver = canbus.can_driver_lines(options, picture, str(database.absolute()) if database else None)
    return [*driver, "", *canbus.can_signal_lines(picture)]


def can_document(picture: canbus.Picture, options: BusOptions, database: Path | None, seconds: float) -> dict[str, Any]:
    """All that came, for JSON."""
    return {
        "bus": options.title(),
        "seconds": seconds,
        "frames": [_frame_document(picture, frames) for frames in picture.ordered()],
        "signals": [
            {"message": frames.message.name if frames.message else None, "signal": signal.name, "unit": signal.unit}
            | asdict(value)
            for frames, signal, value in picture.signals()
        ],
        "error_frames": picture.error_frames,
        "errors": dict(picture.errors),
        "unreadable": picture.unreadable,
        "not_received": [message.name for message in picture.missing()],
        "lines": _can_lines(picture, options, database) if picture.frames else [],
    }


def _frame_document(picture: canbus.Picture, frames: canbus.ObservedFrames) -> dict[str, Any]:
    return {
        "id": frames.name,
        "extended": frames.extended,
        "count": frames.count,
        "rate_hz": 1.0 / frames.period if frames.period else None,
        "period_s": frames.period,
        "jitter_s": frames.jitter,
        "lengths": sorted(frames.lengths),
        "data": frames.latest.hex(),
        "changed": bytes(frames.changed).hex(),
        "message": frames.message.name if frames.message else None,
        "undecodable": frames.undecodable,
        "guess": picture.guess(frames),
    }
