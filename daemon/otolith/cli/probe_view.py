"""What ``otolith probe`` shows: tables that fit a terminal, or one JSON document."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from otolith_drivers.canbus.bus import MOST_BAD_IN_A_ROW, BusOptions, is_gone, open_bus
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.canbus.probe import (
    ObservedFrames,
    Picture,
    can_driver_lines,
    can_signal_lines,
    fields_of,
    value_text,
    within,
)
from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus.client import FUNCTION_CODES
from otolith_drivers.modbus.options import HIGHEST_ADDRESS
from otolith_drivers.modbus.probe import (
    Answer,
    Block,
    ProbeClient,
    ProgressCallback,
    Speed,
    Stopped,
    Survey,
    Words,
    opened,
    possible_rate,
    scan,
    spans,
    speeds,
    survey,
    watch,
)
from otolith_drivers.modbus.probe_numbers import (
    COLUMNS,
    WIDE_COLUMNS,
    Number,
    Place,
    Reading,
    bytes_of,
    modbus_driver_lines,
    modbus_signal_lines,
    numbers_of,
    readings_at,
)
from otolith_drivers.modbus.protocol import LETTERS, TypeName
from otolith_drivers.number_inference import LayoutVerdict, number_text

PLAIN_WIDTH = 200  # columns where nobody looks at a terminal
GAP = 2  # columns between columns
LEFT = ("what", "remark")  # columns of words
WORDS = 24  # columns into which words are broken where there is no more room
STYLES = {"*": "bold green", "?": "yellow", "!": "bold red"}


@dataclass(slots=True)
class Row:
    """A row: what stands in every table, and what goes where there is room."""

    fixed: tuple[str, ...]
    cells: dict[str, str] = field(default_factory=dict)
    """By the name of the column, of which each word is a line."""
    marks: dict[str, str] = field(default_factory=dict)
    """By the name of the column: ``*``, ``?`` or ``!`` before what deserves it."""


def console() -> Console:
    """Standard output: as wide as the terminal, or as a file may be."""
    found = Console(highlight=False)
    return found if found.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def grids(heads: Sequence[str], rows: Sequence[Row], width: int) -> Iterator[Table]:
    """Tables of all rows, none wider than ``width`` as far as that is possible.

    Columns whose names begin alike stay in one table if one can hold them.
    """
    if not rows:
        return
    names = [name for name in dict.fromkeys(name for row in rows for name in row.cells) if _filled(rows, name)]
    fixed = sum(GAP + max(len(head), *(len(row.fixed[at]) for row in rows)) for at, head in enumerate(heads))
    families = groupby(names, key=lambda name: name.split()[0])
    together: list[str] = []
    room = width - fixed
    for family in (list(members) for _, members in families):
        whole = sum(_width(rows, name) for name in family)
        for name in family:
            needed = whole if name == family[0] and whole <= width - fixed else _width(rows, name)
            if together and needed > room:
                yield _grid(heads, rows, together)
                together, room = [], width - fixed
            together.append(name)
            room -= _width(rows, name)
    yield _grid(heads, rows, together)


def _filled(rows: Sequence[Row], name: str) -> bool:
    return any(row.cells.get(name) for row in rows)


def _width(rows: Sequence[Row], name: str) -> int:
    longest = max(len(row.cells.get(name, "")) + len(row.marks.get(name, "")) for row in rows)
    longest = min(longest, WORDS) if name in LEFT else longest
    return GAP + max([longest, *map(len, name.split())])


def _grid(heads: Sequence[str], rows: Sequence[Row], names: Sequence[str]) -> Table:
    table = Table(box=None, padding=(0, GAP, 0, 0), header_style="bold")
    for head in heads:
        table.add_column(head, no_wrap=True, vertical="bottom")
    for name in names:
        justify: Literal["left", "right"] = "left" if name in LEFT else "right"
        table.add_column(name.replace(" ", "\n"), justify=justify, no_wrap=name not in LEFT, vertical="bottom")
    for row in rows:
        table.add_row(*row.fixed, *(_cell(row, name) for name in names))
    return table


def _cell(row: Row, name: str) -> Text:
    mark = row.marks.get(name, "")
    text = row.cells.get(name, "")
    words = f"{mark} {text}" if mark and name in LEFT else f"{mark}{text}"
    return Text(words, style=STYLES.get(mark, "dim" if text == "·" else ""))


LONGEST_NUMBER = 4  # registers
FEWEST_ZEROS = 3  # registers in a row that are one row of the table
MARKS = {LayoutVerdict.CERTAIN: "*", LayoutVerdict.COUNTER: "*", LayoutVerdict.LIKELY: "?"}
ALONE = "a register alone may be half of a longer number: ask for its neighbours as well"
MODBUS_LEGEND = "* what it is, told by how it moves    ? likely, but it hardly moves    · a number that no machine has"


@dataclass(frozen=True)
class Probed:
    """A device, as far as it was looked at."""

    place: Place
    registers: tuple[int, int]
    """First and last that were asked for, on the wire."""
    survey: Survey
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


def probe_device(
    place: Place, registers: tuple[int, int], seconds: float, stopped: Stopped, told: ProgressCallback
) -> Probed:
    """Look at the registers (on the wire) of a device.

    Raises:
        DeviceError: the line cannot be opened, or the device does not answer.
    """
    with opened(place.options, told) as line:
        client = ProbeClient(line, place.options, place.device, place.table)
        first, last = registers
        if first == last:
            last = min(first + LONGEST_NUMBER - 1, HIGHEST_ADDRESS)
        found = survey(client, first, last, stopped, told)
        client.round_trips.clear()  # the first ones take longer
        begun = time.monotonic()
        readings = watch(client, found.blocks, seconds, stopped, told)
        elapsed = time.monotonic() - begun
        told("comparing")
        return Probed(place, registers, found, readings, numbers_of(readings), speeds(client, found.blocks), elapsed)


def scan_line(
    place: Place, devices: tuple[int, int], register: int, stopped: Stopped, told: ProgressCallback
) -> list[Answer]:
    """The devices on a line that answer when asked for ``register`` (on the wire).

    Raises:
        DeviceError: the line cannot be opened.
    """
    with opened(place.options, told) as line:
        client = ProbeClient(line, place.options, devices[0], place.table)
        return scan(client, range(devices[0], devices[1] + 1), register, stopped, told)


def show_scan(place: Place, devices: tuple[int, int], answers: Sequence[Answer], console: Console) -> None:
    """The answers, in words."""
    asked = devices[1] - devices[0] + 1
    console.print(f"{place.options.title()}: {len(answers)} of {asked} devices answer")
    for said in dict.fromkeys(answer.reply for answer in answers):
        alike = spans([answer.device for answer in answers if answer.reply == said], "device")
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
    for text in probed.survey.describe(place.first_address):
        console.print(text)
    if not probed.survey.blocks and not probed.survey.refused:
        console.print("ended before anything was read")
        return
    if not probed.survey.blocks:
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
    console.print(MODBUS_LEGEND, style="dim", soft_wrap=True)
    if probed.single:
        console.print(ALONE, style="dim", soft_wrap=True)
    console.print()
    for text in modbus_lines(probed):
        console.print(text, markup=False, soft_wrap=True)


def modbus_lines(probed: Probed) -> list[str]:
    """For the machine file."""
    return [*modbus_driver_lines(probed.place, probed.survey), "", *modbus_signal_lines(probed.place, probed.wanted)]


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


def modbus_document(probed: Probed) -> dict[str, Any]:
    """The same for machines; a number that is none is null."""
    place = probed.place
    return {
        "line": place.options.title(),
        "device": place.device,
        "table": place.table,
        "first_address": place.first_address,
        "readable": [[place.shown(block.address), place.shown(block.end - 1)] for block in probed.survey.blocks],
        "refused": {str(place.shown(at)): reason for at, reason in probed.survey.refused.items()},
        "most_registers": probed.survey.max_registers,
        "speed": [
            {"registers": speed.registers, "median_s": speed.median, "slow_s": speed.slow} for speed in probed.speeds
        ],
        "possible_hz": possible_rate(probed.speeds),
        "registers": [entry for block, words in probed.readings.items() for entry in _entries(place, block, words)],
        "numbers": [_number(place, number) for number in probed.wanted],
        "lines": modbus_lines(probed),
    }


def _entries(place: Place, block: Block, words: Words) -> Iterator[dict[str, Any]]:
    if not len(words):
        return
    data = bytes_of(words)
    for at in range(block.count):
        values = {reading.layout.name: _finite(reading.latest) for reading in readings_at(data, at, LETTERS)}
        yield {"register": place.shown(block.address + at), "raw": f"{words[-1, at]:04X}", "values": values}


def _number(place: Place, number: Number) -> dict[str, Any]:
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


RECEIVE_TIMEOUT = 0.1  # s; how late an end is noticed
REFRESH = 4.0  # Hz of the live table
MOST_NAMED = 12  # messages in a line
CAN_LEGEND = "[..] bytes that have changed    ± half of the width in which 19 of 20 periods lie"


def listen(
    options: BusOptions, database: Path | None, seconds: float, stopped: Callable[[], bool], live: Console | None
) -> Picture:
    """Hear what is on the bus for so many seconds, with a table on ``live`` meanwhile; nothing is sent.

    Raises:
        DeviceError: the bus cannot be opened, or breaks.
        ConfigurationError: the database cannot be read.
    """
    picture = Picture(load_dbc(database) if database is not None else None)
    bus = open_bus(options, listen_only=True)
    shown = Live(_Board(picture, options), console=live, refresh_per_second=REFRESH, transient=True) if live else None
    try:
        with shown or contextlib.nullcontext():
            _receive(bus, options, picture, seconds, stopped)
    finally:
        with contextlib.suppress(Exception):  # it is being given up, and what was heard is what counts
            bus.shutdown()
    return picture


def _receive(bus: Any, options: BusOptions, picture: Picture, seconds: float, stopped: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    bad = 0
    while (left := end - time.monotonic()) > 0.0 and not stopped():
        try:
            frame = bus.recv(min(left, RECEIVE_TIMEOUT))
        except Exception as error:  # interfaces raise whatever their vendor's library does
            bad += 1
            picture.unreadable += 1
            if is_gone(error) or bad > MOST_BAD_IN_A_ROW:
                raise DeviceError(f"CAN bus {options.title()}: {error}; was the interface taken down?") from error
            continue
        bad = 0
        if frame is not None:
            picture.take(frame, frame.timestamp or time.monotonic())


class _Board:
    """The tables as they are now."""

    def __init__(self, picture: Picture, options: BusOptions) -> None:
        self._picture, self._options = picture, options

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Drawn anew each time."""
        yield Text(f"{_title(self._options, self._picture)}; Ctrl-C ends it")
        yield Group(*tables(self._picture, options.max_width))


def _title(options: BusOptions, picture: Picture) -> str:
    identifiers = f"{len(picture.observed)} arbitration ID{'s' * (len(picture.observed) != 1)}"
    return f"CAN bus {options.title()}, only listening: {picture.frames} frames of {identifiers}"


def tables(picture: Picture, width: int) -> Iterator[RenderableType]:
    """Frames, and the signals in them that a database knows."""
    if picture.observed:
        yield from grids(("ID", "data"), [_frame(picture, heard) for heard in picture.ordered()], width)
    rows = [_signal(heard.message.name, signal, value) for heard, signal, value in picture.signals() if heard.message]
    if rows:
        yield Text("")
        yield from grids(("signal", "unit"), rows, width)
    yield from (Text(line, style="yellow") for line in remarks(picture))


def _frame(picture: Picture, heard: ObservedFrames) -> Row:
    lengths = sorted({min(heard.lengths, default=0), max(heard.lengths, default=0)})
    cells = {"bytes": " to ".join(map(str, lengths)), "frames": f"{heard.count}", "Hz": "", "period": ""}
    if heard.period is not None:
        cells["Hz"] = f"{1.0 / heard.period:.3g}"
        cells["period"] = f"{1e3 * heard.period:.3g} ms ± {1e3 * heard.jitter:.2g}" if heard.regular else "irregular"
    cells["what"] = _what(picture, heard)
    row = Row((heard.name, marked(heard)), cells)
    if heard.message is None and picture.has_database:
        row.marks["what"] = "!"
    return row


def _what(picture: Picture, heard: ObservedFrames) -> str:
    if heard.remote == heard.count:
        return "remote frames"
    if heard.message is not None:
        short = f"; {heard.undecodable} not decodable" if heard.undecodable else ""
        return f"{heard.message.name}{short}"
    unknown = "not in the database" if picture.has_database else ""
    return "; ".join(filter(None, [unknown, picture.guess(heard)]))


def marked(heard: ObservedFrames) -> str:
    """The latest data in hexadecimal digits, with the bytes that have changed in brackets."""
    text = ""
    for place, byte in enumerate(heard.latest):
        now, before = bool(heard.changed[place]), place > 0 and bool(heard.changed[place - 1])
        text += ("]" if before and not now else "") + (" " if place else "") + ("[" if now and not before else "")
        text += f"{byte:02X}"
    return text + ("]" if heard.latest and heard.changed[len(heard.latest) - 1] else "")


def _signal(message: str, signal: Any, value: Any) -> Row:
    low, high = signal.minimum, signal.maximum
    cells = {
        "now": value_text(signal, value.latest),
        "least": value_text(signal, value.low),
        "most": value_text(signal, value.high),
        "range": f"{low:g} to {high:g}" if low is not None and high is not None and low < high else "",
        "beyond": f"{value.beyond} times" if value.beyond else "",
    }
    row = Row((f"{message}.{signal.name}", signal.unit or ""), cells)
    if value.beyond:
        row.marks["beyond"] = "!"
    if not within(signal, value.latest):
        row.marks["now"] = "!"
    return row


def remarks(picture: Picture) -> Iterator[str]:
    """What else there is to say, a line each."""
    if picture.error_frames:
        kinds = ", ".join(f"{count} {name}" for name, count in picture.errors.most_common())
        yield f"{picture.error_frames} error frames: {kinds}"
    if picture.unreadable:
        yield f"{picture.unreadable} frames could not be unpacked"
    if picture.left_out:
        yield f"{picture.left_out} frames of further arbitration IDs are not shown"
    if missing := [message.name for message in picture.missing()]:
        shown = ", ".join(missing[:MOST_NAMED]) + (
            f" and {len(missing) - MOST_NAMED} more" * (len(missing) > MOST_NAMED)
        )
        yield f"in the database, but not heard: {shown}"


def show_bus(picture: Picture, options: BusOptions, database: Path | None, seconds: float, console: Console) -> None:
    """All that was heard, and lines for the machine file."""
    console.print(f"{_title(options, picture)} in {seconds:.1f} s")
    if not picture.frames:
        for line in (*remarks(picture), *silence(options, picture)):
            console.print(line, markup=False)
        return
    console.print()
    for table in tables(picture, console.width):
        console.print(table)
    console.print(CAN_LEGEND, style="dim", markup=False, soft_wrap=True)
    console.print()
    for line in can_lines(picture, options, database):
        console.print(line, markup=False, soft_wrap=True)


def can_lines(picture: Picture, options: BusOptions, database: Path | None) -> list[str]:
    """For the machine file."""
    lines = [
        *can_driver_lines(options, picture, str(database.absolute()) if database else None),
        "",
        *can_signal_lines(picture),
    ]
    quiet = [heard.name for heard in picture.ordered() if heard.message is None and not fields_of(heard)]
    if quiet:
        shown = ", ".join(quiet[:MOST_NAMED]) + (" ..." if len(quiet) > MOST_NAMED else "")
        lines.append(f"# no number moves smoothly in {shown}: move the machine and probe again")
    return lines


def silence(options: BusOptions, picture: Picture) -> Iterator[str]:
    """What to try where nothing was heard."""
    interface, channel = options.resolved()
    if interface == "udp_multicast":
        yield "nothing was heard: on this virtual bus only programs of this computer speak, such as 'otolith plant'"
        yield "for a real bus: --channel can0, or what 'ip -brief link show type can' lists"
        return
    if picture.error_frames:
        yield "only error frames were heard: the bit rate is most likely another one, or the wires are swapped"
    else:
        yield "nothing was heard; what to try:"
    if interface == "socketcan":
        yield f"- is it up, and at which bit rate? 'ip -details link show {channel}' says so"
        yield f"- another bit rate: 'ip link set {channel} down && ip link set {channel} up type can bitrate 500000'"
    else:
        yield "- another bit rate: --bitrate 250000, 500000 or 1000000"
    yield "- termination: 60 ohm between CAN-H and CAN-L while everything is switched off"
    yield "- does anybody send? A CANopen drive says nothing but heartbeats until a master starts it"


def can_document(picture: Picture, options: BusOptions, database: Path | None, seconds: float) -> dict[str, Any]:
    """The same for machines."""
    return {
        "bus": options.title(),
        "seconds": seconds,
        "frames": [_frame_document(picture, heard) for heard in picture.ordered()],
        "signals": [
            {
                "message": heard.message.name if heard.message else None,
                "signal": signal.name,
                "unit": signal.unit,
                "latest": value.latest,
                "low": value.low,
                "high": value.high,
                "beyond": value.beyond,
            }
            for heard, signal, value in picture.signals()
        ],
        "error_frames": picture.error_frames,
        "errors": dict(picture.errors),
        "unreadable": picture.unreadable,
        "not_heard": [message.name for message in picture.missing()],
        "lines": can_lines(picture, options, database) if picture.frames else [],
    }


def _frame_document(picture: Picture, heard: ObservedFrames) -> dict[str, Any]:
    return {
        "id": heard.name,
        "extended": heard.extended,
        "count": heard.count,
        "rate_hz": 1.0 / heard.period if heard.period else None,
        "period_s": heard.period,
        "jitter_s": heard.jitter,
        "lengths": sorted(heard.lengths),
        "data": heard.latest.hex(),
        "changed": bytes(heard.changed).hex(),
        "message": heard.message.name if heard.message else None,
        "undecodable": heard.undecodable,
        "guess": picture.guess(heard),
    }
