"""Questions to Modbus devices, timed, and a line that is opened anew where it has to be.

Everything goes through :class:`otolith_drivers.modbus.client.Line`, which can read and nothing else.

What a Modbus device has: which registers can be read, what is in them over some seconds, how fast it answers.

From readings of Modbus registers to numbers, and to lines of a machine file. Pure.
"""

import contextlib
import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus.client import Line
from otolith_drivers.modbus.options import MOST_REGISTERS, LineOptions, Table
from otolith_drivers.modbus.protocol import EXCEPTIONS, GATEWAY_CODES, Broken, Refused, Silent, TypeName
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

MOST_TIMES = 1000  # kept of each length of request
BUSY, MOST_BUSY, BUSY_PAUSE = (5, 6), 5, 0.1  # exceptions that say "later"; how often; s
Stopped = Callable[[], bool]
"""Whether the user has seen enough."""
ProgressCallback = Callable[[str], None]
"""Takes what is being done, for a line of progress."""


class Client:
    """One table of one device, asked again and again; counts and times the answers."""

    def __init__(self, line: Line, options: LineOptions, device: int, table: Table) -> None:
        self._line = line
        self.options, self.device, self.table = options, device, table
        self.round_trips: dict[int, deque[float]] = {}
        """s, by the number of registers asked for."""
        self.alive = False
        """Whether the device has ever answered, be it with an exception."""
        self._answered: int | None = None

    def read(self, address: int, count: int) -> list[int]:
        """The registers.

        Raises:
            Refused: the device answers with an exception.
            Silent: it does not answer; the line is ready for the next question.
            DeviceError: the line is gone and cannot be opened anew.
        """
        for _ in range(MOST_BUSY):
            try:
                return self._once(address, count)
            except Refused as error:
                self.alive = True
                if error.code not in BUSY:
                    raise
                time.sleep(BUSY_PAUSE)
        return self._once(address, count)

    def _once(self, address: int, count: int) -> list[int]:
        begun = time.perf_counter()
        try:
            words = self._line.read(self.device, self.table, address, count)
        except Silent:
            self._again()
            raise
        except Broken:
            self._again()
            words = self._second(address, count)
        self.alive, self._answered = True, self.device
        self.round_trips.setdefault(count, deque(maxlen=MOST_TIMES)).append(time.perf_counter() - begun)
        if self.options.pause:
            time.sleep(self.options.pause)
        return words

    def _again(self) -> None:
        """An answer that comes late must not be taken for that to another question to the same device."""
        if self._answered == self.device:
            self._line.drain()
        self._line.close()
        open_line(self._line, self.options)

    def _second(self, address: int, count: int) -> list[int]:
        """Some servers close a connection that has been idle, or after every answer."""
        try:
            return self._line.read(self.device, self.table, address, count)
        except Broken as error:
            raise Silent(f"{error} instead of an answer") from error


def open_line(line: Line, options: LineOptions) -> None:
    """Open it.

    Raises:
        DeviceError: it cannot be opened; with the way out.
    """
    try:
        line.connect()
    except Broken as error:
        raise DeviceError(f"{options.title()} cannot be opened: {error}; {_way_out(options, str(error))}") from error


@contextmanager
def opened(options: LineOptions, told: ProgressCallback) -> Iterator[Line]:
    """The line, open, and closed at the end.

    Raises:
        DeviceError: it cannot be opened; with the way out.
    """
    line = Line(options)
    told(f"opening {options.title()}")
    open_line(line, options)
    try:
        yield line
    finally:
        line.close()


def _way_out(options: LineOptions, cause: str) -> str:
    if options.host is not None:
        if "refused" in cause:
            return f"the host is there, but nobody listens on port {options.port}: write HOST:PORT for another one"
        return "are address and cable right, and does 'ping' reach it?"
    from serial.tools import list_ports  # noqa: PLC0415 - only on the way to an error

    if "settings" in cause:
        return "try another --parity or --baudrate"
    if "denied" in cause:
        return "add yourself to the group that owns it, as a rule with 'sudo usermod -aG dialout $USER'"
    known = ", ".join(port.device for port in list_ports.comports() if port.vid is not None)
    return f"serial adapters of this computer: {known or 'none'}"


@dataclass(frozen=True, slots=True)
class Answer:
    """What a device says to a single question."""

    device: int
    reply: str
    """Why it does not give the register; empty if it does."""


def scan(
    asker: Client, devices: Sequence[int], register: int, stopped: Stopped, told: ProgressCallback
) -> list[Answer]:
    """Those of ``devices`` that answer when asked for one register.

    Raises:
        DeviceError: the line is gone.
    """
    found: list[Answer] = []
    for device in devices:
        if stopped():
            break
        told(f"asking device {device}; {len(found)} answered so far")
        asker.device = device
        try:
            asker.read(register, 1)
        except Refused as error:
            if error.code not in GATEWAY_CODES:
                found.append(Answer(device, EXCEPTIONS.get(error.code, str(error))))
        except Silent:
            continue
        else:
            found.append(Answer(device, ""))
    return found


MOST_READINGS = 1000  # kept of each register
SHORTEST_PERIOD = 0.01  # s from round to round: quick enough to see noise, slow enough to be a polite guest
RATES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1)  # Hz that people ask for
CHUNK = MOST_REGISTERS - 1  # an even number
MOST_SPANS = 8  # that are named in a line
FULL = 0.9  # share of a period that requests may take
Words = NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that can be read at once."""

    address: int
    count: int

    @property
    def end(self) -> int:
        """The first address behind it."""
        return self.address + self.count


@dataclass(slots=True)
class Survey:
    """Which registers there are."""

    blocks: list[Block] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    """Why, by address."""
    most: int = MOST_REGISTERS
    """Registers that the device gives at once, as far as it was tried."""

    def describe(self, first_address: int = 0) -> list[str]:
        """In words, a line each, with the registers as the machine file counts them."""
        readable = [at + first_address for block in self.blocks for at in range(block.address, block.end)]
        lines = [f"{spans(readable)} can be read"] if readable else []
        by_reason = [
            (reason, [at + first_address for at, why in self.refused.items() if why == reason])
            for reason in dict.fromkeys(self.refused.values())
        ]
        return lines + [f"{spans(addresses)} refused: {reason}" for reason, addresses in by_reason]


def survey(asker: Client, first: int, last: int, stopped: Stopped, told: ProgressCallback) -> Survey:
    """Find out which of the registers ``first`` to ``last`` can be read; what is refused is split, down to one.

    Raises:
        DeviceError: the device does not answer at all.
    """
    found = Survey()
    waiting = [Block(at, min(CHUNK, last + 1 - at)) for at in range(first, last + 1, CHUNK)]
    while waiting and not stopped():
        block = waiting.pop(0)
        told(f"looking which registers there are: {block.address} to {block.end - 1}")
        reason = _reason_against(asker, block)
        if reason is None:
            found.blocks.append(block)
        elif block.count == 1:
            found.refused[block.address] = reason
        else:
            waiting[:0] = _halves(block)
    return _joined(asker, found, stopped)


def _reason_against(asker: Client, block: Block) -> str | None:
    """Why ``block`` cannot be read; None if it can.

    Raises:
        DeviceError: the device is not there.
    """
    try:
        asker.read(block.address, block.count)
    except Refused as error:
        if error.code in GATEWAY_CODES:
            raise DeviceError(f"{asker.options.title()} is a gateway that says of device {asker.device}: {error}; "
                              "--scan lists the devices that answer") from error  # fmt: skip
        return EXCEPTIONS.get(error.code, str(error))
    except Silent as error:
        if not asker.alive:
            _say_dead_unless_one_answers(asker, block)
        return str(error)
    return None


def _say_dead_unless_one_answers(asker: Client, block: Block) -> None:
    """Some devices keep silent where they should refuse, so a single register is asked for before they are given up."""
    try:
        asker.read(block.address, 1)
    except Refused:
        return
    except Silent as error:
        options = asker.options
        way_out = (
            "--scan lists the devices that answer"
            if options.host is not None
            else "are baud rate, parity and stop bits those of the device, and the two wires not swapped? "
            "--scan lists the devices that answer"
        )
        raise DeviceError(f"{options.title()}: device {asker.device}: {error}; {way_out}") from error


def _halves(block: Block) -> list[Block]:
    """Cut at an even distance, so that numbers of two registers stay whole as long as possible."""
    half = max(1, block.count // 4 * 2)
    return [Block(block.address, half), Block(block.address + half, block.count - half)]


def _joined(asker: Client, found: Survey, stopped: Stopped) -> Survey:
    """Neighbours in one request where the device allows it; where not, that is the most it gives at once."""
    joined: list[Block] = []
    for block in found.blocks:
        before = joined[-1] if joined else None
        both = Block(before.address, block.end - before.address) if before and before.end == block.address else None
        if both is None or both.count > CHUNK or stopped():
            joined.append(block)
        elif _reason_against(asker, both) is None:
            joined[-1] = both
        else:
            found.most = min(found.most, max(before.count if before else 1, block.count))
            joined.append(block)
    return Survey(joined, found.refused, found.most)


def spans(addresses: Sequence[int], noun: str = "register") -> str:
    """``"registers 0 to 19 and 100"``."""
    ordered = sorted(addresses)
    starts = [at for index, at in enumerate(ordered) if index == 0 or ordered[index - 1] != at - 1]
    ends = [at for index, at in enumerate(ordered) if index == len(ordered) - 1 or ordered[index + 1] != at + 1]
    words = [f"{first} to {last}" if last > first else f"{first}" for first, last in zip(starts, ends, strict=True)]
    shown = words if len(words) <= MOST_SPANS else [*words[: MOST_SPANS - 1], f"{len(words) - MOST_SPANS + 1} more"]
    text = " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))
    return f"{noun}{'s' * (len(ordered) > 1)} {text}"


def watch(
    asker: Client, blocks: Sequence[Block], seconds: float, stopped: Stopped, told: ProgressCallback
) -> dict[Block, Words]:
    """Readings (rounds by registers) of every block, again and again for so many seconds; at least one round."""
    readings: dict[Block, list[list[int]]] = {block: [] for block in blocks}
    period = max(SHORTEST_PERIOD, seconds / MOST_READINGS)
    begun = time.monotonic()
    round_due = begun
    while blocks and (round_due == begun or (time.monotonic() - begun < seconds and not stopped())):
        told(f"reading for {max(0.0, seconds - time.monotonic() + begun):.0f} s more")
        for block in blocks:
            with contextlib.suppress(Refused, Silent):  # what it has refused now, it gave before
                readings[block].append(asker.read(block.address, block.count))
        now = time.monotonic()
        round_due = max(round_due + period, now)
        time.sleep(max(0.0, min(round_due, begun + seconds) - now))
    return {block: np.array(rows, dtype=np.uint16).reshape(-1, block.count) for block, rows in readings.items()}


@dataclass(frozen=True, slots=True)
class Speed:
    """How fast requests of one length are answered."""

    registers: int
    median: float
    slow: float
    """s that 99 of 100 do not exceed."""

    @classmethod
    def of(cls, registers: int, trips: Sequence[float]) -> "Speed":
        """From the times of all round trips (s)."""
        ordered = sorted(trips)
        slow = ordered[min(len(ordered) - 1, math.ceil(0.99 * len(ordered)) - 1)]
        return cls(registers, statistics.median(ordered), slow)

    def describe(self) -> str:
        """In words."""
        return (
            f"{self.registers} register{'s' * (self.registers > 1)} in one request: {1e3 * self.median:.3g} ms, "
            f"99 of 100 within {1e3 * self.slow:.3g} ms"
        )


def speeds(asker: Client, blocks: Sequence[Block]) -> list[Speed]:
    """Of the requests that the blocks take, in their order."""
    return [Speed.of(block.count, trips) for block in blocks if (trips := list(asker.round_trips.get(block.count, ())))]


def possible_rate(found: Sequence[Speed]) -> float:
    """Hz at which all these requests fit into a period, as people would ask for it; 0 where none does."""
    whole = sum(speed.slow for speed in found)
    return next((rate for rate in RATES if whole <= FULL / rate), 0.0)


# A device that has one order for some numbers hardly ever has another for others: bits, once and for each reading.
OTHER_ORDER, OTHER_ORDER_OF_EACH = 8.0, 1.5
VOTES = {LayoutVerdict.TOLD: 3, LayoutVerdict.LIKELY: 1}  # for the order of all
COLUMNS: tuple[TypeName, ...] = ("int16", "uint16", "int32", "float32")
REMARKS = {
    LayoutVerdict.STILL: "cannot be told, as nothing changes there: move the machine and probe again",
    LayoutVerdict.WILD: "jumps over its whole range: part of something larger, or noise",
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


def modbus_driver_lines(place: Place, found: Survey) -> list[str]:
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


def modbus_signal_lines(place: Place, numbers: Sequence[Number]) -> list[str]:
    """The table ``[signals]``: a line for every number that moves, and remarks on the others."""
    lines = ["[signals]"]
    for number in numbers:
        layout, part = number.part.layout, number.part
        if layout is None or part.verdict is LayoutVerdict.WILD:
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
