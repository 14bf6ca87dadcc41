"""What ``otolith probe modbus`` asks a device: which registers it has, what is in them, and how fast it answers.

Everything goes through :class:`otolith_drivers.modbus.client.ReadOnlyClient`. The readings become numbers, and lines of
a machine file.
"""

import contextlib
import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import DeviceError
from otolith_drivers.grammars.toml_lines import toml_comment, toml_value
from otolith_drivers.modbus.client import (
    BUSY_CODES,
    GATEWAY_CODES,
    ConnectionLostError,
    ExceptionReplyError,
    NoReplyError,
    ReadOnlyClient,
)
from otolith_drivers.modbus.options import MAX_REGISTERS, LineOptions, Table, TypeName
from otolith_drivers.modbus.plausibility import renewal_period
from otolith_drivers.number_inference import (
    REGISTERS,
    Bytes,
    Layout,
    LayoutVerdict,
    Part,
    number_text,
    parts,
    register_layouts,
    spread,
)

# Engineering choices, guarded by tests/drivers/modbus/test_probe.py.
MAX_TIMES = 1000  # round trips kept of each length of request, and changes of each register
MAX_BUSY_REPEATS, BUSY_PAUSE = 5, 0.1  # repeats of a request to a busy device; s between them
CHUNK = MAX_REGISTERS - 1  # registers of a request: an even number, so that 32-bit numbers are read whole
MAX_READINGS = 1000  # kept of each register, evenly over the time
MIN_PERIOD = 0.01  # s from round to round: fast enough to see noise, without loading the device fully
RATES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1)  # usual rates in Hz
MAX_LOAD = 0.9  # share of a period that requests may take at a possible rate
MAX_SPANS = 8  # ranges of registers that are listed
Words = NDArray[np.uint16]  # Readings by registers
Changes = list[deque[float]]  # Times in s of the latest changes of each register of a block
Stopped = Callable[[], bool]  # Whether the user has ended the probe
ProgressCallback = Callable[[str], None]  # Takes a line about what is being done
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


class ProbeClient:
    """Repeated requests to one table of one device, with their round-trip times."""

    def __init__(self, line: ReadOnlyClient, options: LineOptions, device: int, table: Table) -> None:
        self._line = line
        self.options, self.device, self.table = options, device, table
        self.round_trips: dict[int, deque[float]] = {}  # Round-trip times in s by the number of registers
        self.alive = False  # Whether the device has ever answered, if only with an exception
        self._answered: int | None = None

    def read(self, address: int, count: int) -> list[int]:
        """Return ``count`` registers from ``address`` on.

        Raises:
            ExceptionReplyError: the device answers with an exception.
            NoReplyError: the device does not answer; the connection is ready for the next request.
            DeviceError: the connection is lost and cannot be reopened.
        """
        for _ in range(MAX_BUSY_REPEATS):
            try:
                return self._read_once(address, count)
            except ExceptionReplyError as error:
                self.alive = True
                if error.code not in BUSY_CODES:
                    raise
                time.sleep(BUSY_PAUSE)
        return self._read_once(address, count)

    def _read_once(self, address: int, count: int) -> list[int]:
        begun = time.perf_counter()
        try:
            words = self._line.read(self.device, self.table, address, count)
        except NoReplyError:
            self._reopen()
            raise
        except ConnectionLostError:  # some servers close an idle connection, or after each answer
            self._reopen()
            try:
                words = self._line.read(self.device, self.table, address, count)
            except ConnectionLostError as error:
                raise NoReplyError(f"{error} instead of an answer") from error
        self.alive, self._answered = True, self.device
        self.round_trips.setdefault(count, deque(maxlen=MAX_TIMES)).append(time.perf_counter() - begun)
        if self.options.pause:
            time.sleep(self.options.pause)
        return words

    def _reopen(self) -> None:
        if self._answered == self.device:  # it may answer late, which must not be taken for the next answer
            self._line.drain()
        self._line.close()
        open_line(self._line, self.options)


def open_line(line: ReadOnlyClient, options: LineOptions) -> None:
    """Open the connection; raise DeviceError if it cannot be opened; the message has cause and remedy."""
    try:
        line.connect()
    except ConnectionLostError as error:
        raise DeviceError(f"{options.title()} cannot be opened: {error}; {_remedy(options, str(error))}") from error


@contextmanager
def opened(options: LineOptions, progress: ProgressCallback) -> Iterator[ReadOnlyClient]:
    """Open the connection, and close it at the end; raise DeviceError, with the remedy, if it cannot be opened."""
    line = ReadOnlyClient(options)
    progress(f"opening {options.title()}")
    open_line(line, options)
    try:
        yield line
    finally:
        line.close()


def _remedy(options: LineOptions, cause: str) -> str:
    if options.host is not None:
        if "refused" in cause:
            return f"the host answers, but port {options.port} is closed: write HOST:PORT for another port"
        return "are address and cable right, and does 'ping' reach it?"
    from serial.tools import list_ports  # noqa: PLC0415 - only needed for an error

    if "settings" in cause:
        return "try another --parity or --baudrate"
    if "denied" in cause:
        return "add yourself to the group that owns it, as a rule with 'sudo usermod -aG dialout $USER'"
    known = ", ".join(port.device for port in list_ports.comports() if port.vid is not None)
    return f"serial adapters of this computer: {known or 'none'}"


@dataclass(frozen=True, slots=True)
class Answer:
    """A device that answers."""

    device: int
    reply: str  # The exception with which it refuses the register; empty if it returns it


def scan(
    client: ProbeClient, devices: Sequence[int], register: int, stopped: Stopped, progress: ProgressCallback
) -> list[Answer]:
    """Return which ``devices`` answer a request for one register; raise DeviceError if the connection is lost."""
    answers: list[Answer] = []
    for device in devices:
        if stopped():
            break
        progress(f"requesting from device {device}; {len(answers)} have answered")
        client.device = device
        with contextlib.suppress(NoReplyError):
            try:
                client.read(register, 1)
                answers.append(Answer(device, ""))
            except ExceptionReplyError as error:
                if error.code not in GATEWAY_CODES:
                    answers.append(Answer(device, error.meaning))
    return answers


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that can be read at once."""

    address: int
    count: int

    @property
    def end(self) -> int:
        """First address behind the block."""
        return self.address + self.count

    @property
    def addresses(self) -> range:
        """All addresses of the block."""
        return range(self.address, self.end)


@dataclass(slots=True)
class Survey:
    """Which registers a device has."""

    blocks: list[Block] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)  # Reasons by address
    max_registers: int = MAX_REGISTERS  # Registers that the device returns at once, as far as tried

    def describe(self, first_address: int = 0) -> list[str]:
        """Return a line for the readable registers and for each reason, numbered as in the machine file."""
        readable = [at + first_address for block in self.blocks for at in block.addresses]
        lines = [f"{spans(readable)} can be read"] if readable else []
        for reason in dict.fromkeys(self.refused.values()):
            addresses = [at + first_address for at, why in self.refused.items() if why == reason]
            lines.append(f"{spans(addresses)} refused: {reason}")
        return lines


def survey(client: ProbeClient, first: int, last: int, stopped: Stopped, progress: ProgressCallback) -> Survey:
    """Return which of the registers ``first`` to ``last`` can be read; refused blocks are split, down to one register.

    Raises:
        DeviceError: the device does not answer at all.
    """
    result = Survey()
    waiting = [Block(at, min(CHUNK, last + 1 - at)) for at in range(first, last + 1, CHUNK)]
    while waiting and not stopped():
        block = waiting.pop(0)
        progress(f"reading registers {block.address} to {block.end - 1}")
        reason = _refusal(client, block)
        if reason is None:
            result.blocks.append(block)
        elif block.count == 1:
            result.refused[block.address] = reason
        else:  # at an even distance, so that 32-bit numbers stay whole as long as possible
            half = max(1, block.count // 4 * 2)
            waiting[:0] = [Block(block.address, half), Block(block.address + half, block.count - half)]
    return _joined(client, result, stopped)


def _refusal(client: ProbeClient, block: Block) -> str | None:
    """Return why ``block`` cannot be read; None if it can; raise DeviceError if the device is not there."""
    try:
        client.read(block.address, block.count)
    except ExceptionReplyError as error:
        if error.code in GATEWAY_CODES:
            gateway = f"{client.options.title()} is a gateway that reports of device {client.device}: {error}"
            raise DeviceError(f"{gateway}; --scan lists the devices that answer") from error
        return error.meaning
    except NoReplyError as error:
        if not client.alive:
            _check_alive(client, block.address)
        return str(error)
    return None


def _check_alive(client: ProbeClient, address: int) -> None:
    """Request a single register: some devices do not answer a request that they should refuse."""
    try:
        client.read(address, 1)
    except ExceptionReplyError:
        return
    except NoReplyError as error:
        remedy = "--scan lists the devices that answer"
        if client.options.host is None:
            remedy = f"are baud rate, parity and stop bits right, and the two wires not swapped? {remedy}"
        raise DeviceError(f"{client.options.title()}: device {client.device}: {error}; {remedy}") from error


def _joined(client: ProbeClient, split: Survey, stopped: Stopped) -> Survey:
    """Join adjacent blocks that the device returns at once; if it does not, that is its limit."""
    joined, limit = list[Block](), split.max_registers
    for block in split.blocks:
        before = joined[-1] if joined else None
        if before is None or before.end != block.address or before.count + block.count > CHUNK or stopped():
            joined.append(block)
        elif _refusal(client, both := Block(before.address, before.count + block.count)) is None:
            joined[-1] = both
        else:
            limit = min(limit, max(before.count, block.count))
            joined.append(block)
    return Survey(joined, split.refused, limit)


def spans(addresses: Iterable[int], noun: str = "register") -> str:
    """Return ``"registers 0 to 19 and 100"``."""
    ordered = sorted(addresses)
    runs = [[at for _, at in run] for _, run in groupby(enumerate(ordered), key=lambda pair: pair[1] - pair[0])]
    texts = [f"{run[0]} to {run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs]
    if len(texts) > MAX_SPANS:
        texts[MAX_SPANS - 1 :] = [f"{len(texts) - MAX_SPANS + 1} more"]
    return f"{noun}{'s' * (len(ordered) > 1)} {' and '.join(filter(None, [', '.join(texts[:-1]), texts[-1]]))}"


def watch(
    client: ProbeClient, blocks: Sequence[Block], seconds: float, stopped: Stopped, progress: ProgressCallback
) -> tuple[dict[Block, Words], dict[Block, Changes]]:
    """Read all blocks repeatedly for ``seconds``, at least once; return readings (rounds by registers) and changes.

    Of a long time only some of the readings are kept, but a change is seen in all of them.
    """
    readings: dict[Block, list[list[int]]] = {block: [] for block in blocks}
    changes: dict[Block, Changes] = {block: [deque(maxlen=MAX_TIMES) for _ in block.addresses] for block in blocks}
    latest: dict[Block, list[int]] = {}
    begun = time.monotonic()
    round_due = kept_due = begun
    while blocks and (round_due == begun or (time.monotonic() - begun < seconds and not stopped())):
        progress(f"reading for {max(0.0, seconds - time.monotonic() + begun):.0f} s more")
        is_kept = time.monotonic() >= kept_due
        kept_due += is_kept * seconds / MAX_READINGS
        for block in blocks:
            with contextlib.suppress(ExceptionReplyError, NoReplyError):  # the survey has read it before
                words = client.read(block.address, block.count)
                _note_changes(changes[block], latest.get(block, words), words, time.monotonic())
                latest[block] = words
                if is_kept:
                    readings[block].append(words)
        now = time.monotonic()
        round_due = max(round_due + MIN_PERIOD, now)
        time.sleep(max(0.0, min(round_due, begun + seconds) - now))
    words_of = {block: np.array(rows, dtype=np.uint16).reshape(-1, block.count) for block, rows in readings.items()}
    return words_of, changes


def _note_changes(changes: Changes, before: Sequence[int], now: Sequence[int], moment: float) -> None:
    """Add ``moment`` (s) to the registers that differ from ``before``."""
    for own, old, new in zip(changes, before, now, strict=True):
        if old != new:
            own.append(moment)


@dataclass(frozen=True, slots=True)
class Speed:
    """Round-trip times of requests of one length."""

    registers: int
    median: float
    slow: float  # Time in s that 99 of 100 requests do not exceed

    def describe(self) -> str:
        """Return length and times in words."""
        length = f"{self.registers} register{'s' * (self.registers > 1)} in one request"
        return f"{length}: {1e3 * self.median:.3g} ms, 99 of 100 within {1e3 * self.slow:.3g} ms"


def speeds(client: ProbeClient, blocks: Iterable[Block]) -> list[Speed]:
    """Return the times of the requests for ``blocks``."""
    times = [(block.count, sorted(client.round_trips.get(block.count, ()))) for block in blocks]
    return [
        Speed(count, statistics.median(trips), trips[math.ceil(0.99 * len(trips)) - 1])
        for count, trips in times
        if trips
    ]


def possible_rate(requests: Sequence[Speed]) -> float:
    """Return the highest usual rate in Hz at which all requests fit into a period; 0 if none does."""
    whole = sum(speed.slow for speed in requests)
    return next((rate for rate in RATES if whole <= MAX_LOAD / rate), 0.0)


@dataclass(frozen=True, slots=True)
class Number:
    """Registers that are one number, or whose type is unknown."""

    address: int
    part: Part
    word: int  # The latest content of its first register

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


def renewal_of(number: Number, changes: Mapping[Block, Changes]) -> float | None:
    """Return the time in s between two renewals of a number while it moves; None if it has changed too seldom."""
    block = next(block for block in changes if number.address in block.addresses)
    first = number.address - block.address
    own = changes[block][first : first + number.count]
    known = max((times[0] for times in own if len(times) == MAX_TIMES), default=-math.inf)  # since then from all
    return renewal_period(np.diff(sorted({moment for times in own for moment in times if moment >= known})).tolist())


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
    fault: str  # Why no machine has these numbers; empty if one could


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
            lines.append(f"{key} = {toml_value(value)}")
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
        keys = ", ".join(
            f"{key} = {toml_value(value)}" for key, value in number_keys(place, number.address, layout).items()
        )
        longer = _longer_readings(place, number, numbers)
        mark = "? " if longer or part.verdict is LayoutVerdict.LIKELY else ""
        comment = f"{mark}{spread(part)}{_alternatives(place, number)}{longer}"
        lines.append(f'NAME = {{ {keys}, unit = "?" }}  {toml_comment(comment)}')
    for verdict, remark in REMARKS.items():
        unknown = [number for number in numbers if number.part.verdict is verdict]
        if unknown:
            addresses = [number.address + offset for number in unknown for offset in range(number.count)]
            lines.append(f"# {spans(map(place.shown, addresses))}: {remark}")
    return lines


def number_keys(place: Place, address: int, layout: Layout) -> dict[str, int | str]:
    """Return the keys by which a machine file names a number at ``address`` (on the wire), without its unit."""
    keys: dict[str, int | str] = {"register": place.shown(address)}
    keys |= {"table": place.table} if place.table != "holding" else {}
    keys |= {"type": layout.kind}
    return keys | ({"order": layout.order} if layout.width > 2 or layout.order != "ABCD" else {})


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
