"""What is on a CAN bus, for ``otolith probe can``: which frames, how often, what changes in them, and what that may be.

No clock in here: the time of a frame is an argument. The last functions write lines of a machine file.
"""

import math
import re
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import can
import numpy as np
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database
from numpy.typing import NDArray

from otolith_drivers.canbus import j1939
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.canopen import STATES
from otolith_drivers.canbus.monitoring import error_classes
from otolith_drivers.canbus.options import CLASSIC_LENGTH, RANGE_TOLERANCE, range_of
from otolith_drivers.errors import some_names
from otolith_drivers.grammars.toml_lines import toml_comment, toml_value
from otolith_drivers.number_inference import FRAMES, Layout, LayoutVerdict, Part, number_text, parts, spread

MAX_IDENTIFIERS = 2048  # that are kept apart; a bus with standard identifiers has no more
MAX_FRAMES = 500  # of each identifier that are kept
MIN_FRAMES = 8  # of one identifier before numbers are looked for in them
MAX_SELECTED, MIN_SELECTED_SHARE = 16, 0.25  # values of a selector; share of frames in which it changes
MIN_SELECTED_BITS, MAX_GROUPED_SHARE = 2.0, 0.6  # bits per change of a selected byte; what is left of them in a group
MAX_JITTER = 1.0  # periods; a message with more is irregular
COUNTER_OR_CHECKSUM = re.compile(
    r"count|alive|rolling|sequence|checksum|crc|^(?:mc|bz|cnt|chk)|(?:mc|bz|cnt|chk)$", re.IGNORECASE
)

# The predefined connection set of CiA 301: what a frame carries, by its identifier without the node.
CANOPEN = {
    **{0x080 + 0x100 * number: f"TPDO {number}" for number in range(1, 5)},
    **{0x100 + 0x100 * number: f"RPDO {number}" for number in range(1, 5)},
} | {0x080: "emergency", 0x580: "SDO answer", 0x600: "SDO request", 0x700: "heartbeat"}
CANOPEN_BROADCASTS = {0x000: "NMT command", 0x080: "SYNC", 0x100: "TIME"}


@dataclass(slots=True)
class ObservedValue:
    """What a signal of the database has been, in its unit."""

    latest: float
    low: float
    high: float
    beyond: int = 0  # How often it was outside the range of the database, or no reading by the standard (J1939)


@dataclass(slots=True)
class ObservedFrames:
    """All frames of one arbitration ID."""

    identifier: int
    extended: bool
    message: Message | None = None  # Its description in the database
    count: int = 0
    latest: bytes = b""
    fd: bool = False
    lengths: set[int] = field(default_factory=set)
    changed: bytearray = field(default_factory=bytearray)  # The bits of each byte that have ever changed
    history: deque[bytes] = field(default_factory=lambda: deque(maxlen=MAX_FRAMES))
    values: dict[str, ObservedValue] = field(default_factory=dict)
    undecodable: int = 0
    remote: int = 0
    _intervals: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_FRAMES))
    _last: float | None = None

    @property
    def name(self) -> str:
        """Its arbitration ID; an extended one has eight digits."""
        return f"0x{self.identifier:08X}" if self.extended else f"0x{self.identifier:03X}"

    @property
    def title(self) -> str:
        """The message of the database; with its source address if that is open there."""
        return self.name if self.message is None else f"{self.message.name}{self.source}"

    @property
    def source(self) -> str:
        """The source address in words, if it is open in the database; else empty."""
        is_open = self.message is not None and j1939.is_a_group(self.message)
        return f" from 0x{self.identifier & j1939.ADDRESS_MASK:02X}" if is_open else ""

    @property
    def period(self) -> float | None:
        """The mean interval between frames (s); None before there are two."""
        whole = sum(self._intervals)
        return whole / len(self._intervals) if whole > 0.0 else None

    @property
    def jitter(self) -> float:
        """Half of the width (s) of the central 95 % of the intervals."""
        if len(self._intervals) < 2:
            return 0.0
        ordered = sorted(self._intervals)
        edge = len(ordered) // 40
        return (ordered[-1 - edge] - ordered[edge]) / 2

    @property
    def regular(self) -> bool:
        """Whether it has a period."""
        return self.period is not None and self.jitter <= MAX_JITTER * self.period

    def take(self, frame: can.Message, time: float) -> None:
        """Take a frame of it, which arrived at ``time`` (s)."""
        self.count += 1
        if self._last is not None and time >= self._last:
            self._intervals.append(time - self._last)
        self._last = time
        if frame.is_remote_frame:
            self.remote += 1
            return
        data = bytes(frame.data)
        self.fd |= bool(frame.is_fd)
        self.changed.extend(bytes(max(0, len(data) - len(self.changed))))
        if self.lengths:
            for place, (before, now) in enumerate(zip(self.latest, data, strict=False)):
                self.changed[place] |= before ^ now
        self.latest = data
        self.lengths.add(len(data))
        self.history.append(data)
        if self.message is not None:
            self._decode(self.message, data)

    def series(self) -> dict[str, list[float]]:
        """The numbers that each signal of the database had in the frames that are kept."""
        series: dict[str, list[float]] = {}
        if self.message is None:
            return series
        rows = [_numbers(self.message, data) or {} for data in self.history]
        for signal in self.message.signals:
            highest = j1939.highest_value(self.message, signal)
            numbers = (row.get(signal.name, math.nan) for row in rows)
            series[signal.name] = [number for number in numbers if math.isfinite(number) and number <= highest]
        return series

    def _decode(self, message: Message, data: bytes) -> None:
        numbers = _numbers(message, data)
        if numbers is None:
            self.undecodable += 1
            return
        for signal in message.signals:
            number = numbers.get(signal.name, math.nan)
            if number > j1939.highest_value(message, signal):
                if signal.name in self.values:  # one that never had a reading is not shown
                    self.values[signal.name].beyond += 1
            elif math.isfinite(number):
                value = self.values.setdefault(signal.name, ObservedValue(number, number, number))
                value.latest, value.low, value.high = number, min(value.low, number), max(value.high, number)
                value.beyond += not within(signal, number)


def _numbers(message: Message, data: bytes) -> dict[str, float] | None:
    """The numbers of the signals in a frame; None if it cannot be decoded."""
    try:
        decoded: Any = message.decode(data, decode_choices=False, allow_truncated=True)
        return {name: float(value) for name, value in decoded.items()}
    except Exception:  # noqa: BLE001 - neither the frame nor the database is checked before
        return None


def within(signal: CanSignal, number: float) -> bool:
    """Whether ``number`` is in the range of the database, if it has one."""
    low, high = range_of(signal)
    if math.isinf(low):
        return True
    slack = RANGE_TOLERANCE * max(abs(low), abs(high))
    return bool(low - slack <= number <= high + slack)


class Picture:
    """Everything that was received from a bus."""

    def __init__(self, database: Database | None = None) -> None:
        self._messages = {
            (message.frame_id, message.is_extended_frame): message
            for message in (database.messages if database else [])
            if not message.is_container
        }
        self._groups = {j1939.group_of(one.frame_id): one for one in self._messages.values() if j1939.is_a_group(one)}
        self._assembler = j1939.Assembler([key for key, one in self._groups.items() if j1939.has_several_frames(one)])
        self._assembled: dict[int, ObservedFrames] = {}  # Messages of several frames, by an identifier of their source
        self.has_database = bool(self._messages)
        self.observed: dict[tuple[int, bool], ObservedFrames] = {}
        self.errors: Counter[str] = Counter()  # Error frames of each class
        self.error_frames = 0
        self.unreadable = 0  # Frames that the interface could not unpack
        self.left_out = 0  # Frames of the arbitration IDs beyond MAX_IDENTIFIERS

    @property
    def frames(self) -> int:
        """Number of frames, without error frames."""
        return sum(observed.count for observed in self.observed.values()) + self.left_out

    def take(self, frame: can.Message, time: float) -> None:
        """Take a frame, which arrived at ``time`` (s, of any clock that advances steadily)."""
        if frame.is_error_frame:
            self.error_frames += 1
            self.errors.update(error_classes(frame))
            return
        key = (frame.arbitration_id, bool(frame.is_extended_id))
        observed = self.observed.get(key)
        if observed is None:
            if len(self.observed) >= MAX_IDENTIFIERS:
                self.left_out += 1
                return
            observed = self.observed[key] = ObservedFrames(*key, self._message_of(*key))
        observed.take(frame, time)
        if frame.is_extended_id and (
            whole := self._assembler.take_frame(frame.arbitration_id, bytes(frame.data), time)
        ):
            message = self._groups[whole.group]
            identifier = message.frame_id & ~j1939.ADDRESS_MASK | whole.source
            assembled = self._assembled.setdefault(identifier, ObservedFrames(identifier, True, message))
            assembled.take(can.Message(arbitration_id=identifier, data=whole.data), whole.time)

    def _message_of(self, identifier: int, extended: bool) -> Message | None:
        """The description of a frame in the database: by its identifier, else by its parameter group."""
        exact = self._messages.get((identifier, extended))
        return exact or (self._groups.get(j1939.group_of(identifier)) if extended else None)

    def ordered(self) -> list[ObservedFrames]:
        """The observed frames by arbitration ID, standard ones first; last the messages of several frames."""
        single = [self.observed[key] for key in sorted(self.observed, key=lambda key: (key[1], key[0]))]
        return single + [self._assembled[key] for key in sorted(self._assembled)]

    def missing(self) -> list[Message]:
        """Messages of the database that have not come."""
        seen = {id(observed.message) for observed in self.ordered()}
        return [message for message in self._messages.values() if id(message) not in seen]

    def signals(self) -> Iterator[tuple[ObservedFrames, CanSignal, ObservedValue]]:
        """Every signal of the database that has come, with its frames and its value."""
        for observed in self.ordered():
            for signal in observed.message.signals if observed.message else ():
                if (value := observed.values.get(signal.name)) is not None:
                    yield observed, signal, value

    @property
    def is_canopen(self) -> bool:
        """Whether a node sends heartbeats of CANopen."""
        return any(
            not observed.extended
            and 0x701 <= observed.identifier <= 0x77F
            and observed.lengths == {1}
            and observed.latest[0] & 0x7F in STATES
            for observed in self.observed.values()
        )

    def guess(self, observed: ObservedFrames) -> str:
        """What frames that no database describes may be, by their arbitration ID; empty if that is not known."""
        if observed.extended:
            return f"PGN {j1939.group_of(observed.identifier)} from {observed.identifier & 0xFF}, if SAE J1939"
        if not (name := canopen_name(observed.identifier)):
            return ""
        if not self.is_canopen:
            return f"{name}, if CANopen"
        if name.startswith("heartbeat") and len(observed.latest) == 1:
            name += f": {STATES.get(observed.latest[0] & 0x7F, 'state unknown')}"
        return f"CANopen {name}"


def canopen_name(identifier: int) -> str:
    """What a standard arbitration ID carries by CiA 301; empty if it has no meaning there."""
    if identifier in CANOPEN_BROADCASTS:
        return CANOPEN_BROADCASTS[identifier]
    node = identifier & 0x7F
    what = CANOPEN.get(identifier - node)
    return f"{what} of node {node}" if node and what else ""


def _payloads(observed: ObservedFrames) -> NDArray[np.uint8] | None:
    """The data of the frames as long as the latest, a row each; None if there are fewer than ``MIN_FRAMES``."""
    history = [data for data in observed.history if len(data) == len(observed.latest)]
    if len(history) < MIN_FRAMES or not observed.latest:
        return None
    return np.frombuffer(b"".join(history), dtype=np.uint8).reshape(len(history), -1)


def _fields(payloads: NDArray[np.uint8]) -> list[tuple[Part, Layout]]:
    """Candidates for numbers in the frames of one arbitration ID, without counters and without what jumps."""
    return [
        (part, part.layout)
        for part in parts(payloads, FRAMES, 1)
        if part.layout is not None and part.verdict in (LayoutVerdict.CERTAIN, LayoutVerdict.LIKELY)
    ]


def _selector(payloads: NDArray[np.uint8]) -> str:
    """The byte, or half of one, that selects what the others mean; empty if there seems to be none."""
    data = payloads.astype(np.int64)
    bits = _change_bits(data)
    if not np.any(bits >= MIN_SELECTED_BITS):
        return ""
    for place, byte in enumerate(data.T):
        halves = {"byte": byte, "the low half of byte": byte & 0x0F, "the high half of byte": byte >> 4}
        for name, values in halves.items():
            if np.any(np.delete(_is_selected(data, bits, values), place)):
                return f"{name} {place}"
    return ""


def _is_selected(data: NDArray[np.int64], bits: NDArray[np.float64], values: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether each byte depends on a selector with ``values``.

    If so, it changes by far fewer bits between frames of one value than between frames in a row (``bits``).
    """
    switches = np.count_nonzero(np.diff(values))
    if not 1 < len(np.unique(values)) <= MAX_SELECTED or switches < MIN_SELECTED_SHARE * len(values):
        return np.zeros(len(bits), dtype=np.bool_)
    order = np.argsort(values, kind="stable")
    grouped = _change_bits(data[order], np.diff(values[order]) == 0)
    return (bits >= MIN_SELECTED_BITS) & (grouped <= MAX_GROUPED_SHARE * bits)


def _change_bits(data: NDArray[np.int64], counted: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
    """Mean bits of the change of each byte from row to row; a byte wraps from 255 to 0."""
    changes = np.abs(np.diff(data, axis=0))
    bits = np.log2(1.0 + np.minimum(changes, 256 - changes))
    rows = bits if counted is None else bits[counted]
    return rows.mean(axis=0) if len(rows) else np.full(data.shape[1], np.inf)


def can_driver_lines(options: BusOptions, picture: Picture, database: str | None) -> list[str]:
    """The table ``[driver]``."""
    lines = ["[driver]", 'type = "can"']
    for key in ("interface", "channel", "port"):
        value = getattr(options, key)
        if value != BusOptions.model_fields[key].default:
            lines.append(f"{key} = {toml_value(value)}")
    if options.bitrate is not None:
        lines.append(f'bitrate = "{options.bitrate:g} bit/s"')
    if any(observed.fd for observed in picture.observed.values()):
        lines.append("fd = true")
    is_used = any(observed.message is not None for observed in picture.observed.values())
    return lines + ([f"dbc = {toml_value(database)}"] if database and is_used else [])


def can_signal_lines(picture: Picture) -> Iterator[str]:
    """The table ``[signals]``: signals of the database by name, other numbers by their bits; and remarks."""
    yield "[signals]"
    signals = [
        (observed, signal, value)
        for observed, signal, value in picture.signals()
        if signal.unit or not COUNTER_OR_CHECKSUM.search(signal.name)
    ]
    titles: dict[str, list[str]] = {}
    for observed in picture.ordered():
        titles.setdefault(observed.message.name if observed.message else "", []).append(observed.title)
    signals = [row for row in signals if row[0].message and row[0].title == titles[row[0].message.name][0]]
    names = Counter(signal.name for _, signal, _ in signals)
    for observed, signal, value in signals:
        message = observed.message.name if observed.message and names[signal.name] > 1 else None
        keys = f"signal = {toml_value(signal.name)}" + (f", message = {toml_value(message)}" if message else "")
        keys += "" if signal.unit else ', unit = "?"'
        remark = f"{signal.unit}, " if signal.unit else ""
        remark += f"{value_text(signal, value.latest)} now"
        yield f"NAME = {{ {keys} }}  {toml_comment(remark)}"
    for name, several in titles.items():
        if name and len(set(several)) > 1:
            yield toml_comment(f"{', '.join(several)}: set source_address in [driver] to one of them")
    yield from _candidate_lines([observed for observed in picture.ordered() if observed.message is None])


def _candidate_lines(unknown: Sequence[ObservedFrames]) -> Iterator[str]:
    """Candidates for numbers in frames that no database describes, and remarks on the frames without any."""
    multiplexed, still = [], []
    for observed in unknown:
        payloads = _payloads(observed)
        if payloads is not None and (selector := _selector(payloads)):
            multiplexed.append(
                f"# {observed.name} seems multiplexed by {selector}: no candidates, as they would mix several signals"
            )
        elif payloads is not None and (fields := _fields(payloads)):
            yield from (_field_line(observed, part, layout) for part, layout in fields)
        else:
            still.append(observed.name)
    if len(multiplexed) + len(still) < len(unknown):
        yield "# lines with ? are candidates among numbers of whole bytes: compare each with the machine"
    yield from multiplexed
    if still:
        yield f"# no number changes smoothly in {some_names(still)}: move the machine and probe again"


def value_text(signal: CanSignal, number: float) -> str:
    """``number`` with as many decimals as one step of the signal has; with the name of a state that has one."""
    choices: Any = signal.choices or {}
    if number in choices:
        return f"{number:g} {choices[number]}"
    step = abs(float(signal.conversion.scale)) or 1.0
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{number:.5g}" if signal.conversion.is_float or decimals > 12 else f"{number:.{decimals}f}"


def _field_line(observed: ObservedFrames, part: Part, layout: Layout) -> str:
    extended = ", extended = true" if observed.extended else ""
    fd = ", fd = true" if len(observed.latest) > CLASSIC_LENGTH else ""
    kind = "float = true" if layout.is_float else f"signed = {'true' if layout.signed else 'false'}"
    start = _start_bit(part.start, layout)
    bits = f'start = {start}, length = {8 * layout.width}, byte_order = "{layout.order}", {kind}'
    others = ", ".join(
        f"{other.layout.name} from bit {_start_bit(other.start, other.layout)} "
        f"({number_text(other.latest, other.layout)})"
        for other in part.others
    )
    comment = f"? {100 * part.probability:.0f} %: " + spread(part) + (f"; or {others}" if others else "")
    name = f'"0x{observed.identifier:X}"'
    return f'NAME = {{ id = {name}{extended}{fd}, {bits}, scale = 1.0, unit = "?" }}  {toml_comment(comment)}'


def _start_bit(byte: int, layout: Layout) -> int:
    """Start bit, as a DBC counts, of a number that begins with ``byte``."""
    return 8 * byte + (7 if layout.order == "big" else 0)
