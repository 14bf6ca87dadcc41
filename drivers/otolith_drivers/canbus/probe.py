"""What is heard on a CAN bus: which frames, how often and how regularly, and what in them changes. No clock in here.

From CAN frames that no database describes to fields that move, and to lines of a machine file. Pure.
"""

import math
import re
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import can
import numpy as np
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database

from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.canopen import STATES
from otolith_drivers.canbus.monitoring import classes_of
from otolith_drivers.number_inference import FRAMES, Layout, LayoutVerdict, Part, number_text, parts, quoted, spread

MOST_IDENTIFIERS = 2048  # that are kept apart; a standard bus has no more
MOST_FRAMES = 500  # of each that are kept
IRREGULAR = 1.0  # of the period, beyond which a frame is called irregular

# CiA 301, the predefined connection set: base of the identifiers, what they carry.
CANOPEN = {
    0x080: "emergency",
    0x180: "TPDO 1",
    0x200: "RPDO 1",
    0x280: "TPDO 2",
    0x300: "RPDO 2",
    0x380: "TPDO 3",
    0x400: "RPDO 3",
    0x480: "TPDO 4",
    0x500: "RPDO 4",
    0x580: "SDO answer",
    0x600: "SDO request",
    0x700: "heartbeat",
}
OF_ALL_NODES = {0x000: "NMT command", 0x080: "SYNC", 0x100: "TIME"}


@dataclass(slots=True)
class Value:
    """What a signal of the database has been."""

    latest: float
    low: float
    high: float
    beyond: int = 0
    """Times that it was out of the database's range."""


@dataclass(slots=True)
class ObservedFrames:
    """All frames of one arbitration ID."""

    identifier: int
    extended: bool
    message: Message | None = None
    """What the database says of it."""
    count: int = 0
    latest: bytes = b""
    fd: bool = False
    lengths: set[int] = field(default_factory=set)
    changed: bytearray = field(default_factory=bytearray)
    """Of each byte the bits that have ever changed."""
    history: deque[bytes] = field(default_factory=lambda: deque(maxlen=MOST_FRAMES))
    values: dict[str, Value] = field(default_factory=dict)
    undecodable: int = 0
    remote: int = 0
    _intervals: deque[float] = field(default_factory=lambda: deque(maxlen=MOST_FRAMES))
    _last: float | None = None

    @property
    def name(self) -> str:
        """Its arbitration ID; an extended one has eight digits."""
        return f"0x{self.identifier:08X}" if self.extended else f"0x{self.identifier:03X}"

    @property
    def period(self) -> float | None:
        """The mean time from frame to frame (s); None before there are two."""
        whole = sum(self._intervals)
        return whole / len(self._intervals) if whole > 0.0 else None

    @property
    def jitter(self) -> float:
        """Half of the width (s) in which 19 of 20 times between frames lie."""
        if len(self._intervals) < 2:
            return 0.0
        ordered = sorted(self._intervals)
        edge = len(ordered) // 40
        return (ordered[-1 - edge] - ordered[edge]) / 2

    @property
    def regular(self) -> bool:
        """Whether it comes at a pace of its own."""
        return self.period is not None and self.jitter <= IRREGULAR * self.period

    def take(self, frame: can.Message, time: float) -> None:
        """A frame of it, which came at ``time`` (s)."""
        self.count += 1
        if self._last is not None and time >= self._last:
            self._intervals.append(time - self._last)
        self._last = time
        if frame.is_remote_frame:
            self.remote += 1
            return
        data = bytes(frame.data)
        self.fd |= bool(frame.is_fd)
        self._compare(data)
        self.latest = data
        self.lengths.add(len(data))
        self.history.append(data)
        if self.message is not None:
            self._decode(self.message, data)

    def _compare(self, data: bytes) -> None:
        self.changed.extend(bytes(max(0, len(data) - len(self.changed))))
        if self.lengths:
            for place, (before, now) in enumerate(zip(self.latest, data, strict=False)):
                self.changed[place] |= before ^ now

    def _decode(self, message: Message, data: bytes) -> None:
        try:
            decoded: Any = message.decode(data, decode_choices=False, allow_truncated=True)
            numbers = {name: float(value) for name, value in decoded.items()}
        except Exception:  # noqa: BLE001 - what the wire gives is anything, and so is what a database makes of it
            self.undecodable += 1
            return
        for signal in message.signals:
            if (number := numbers.get(signal.name)) is not None and math.isfinite(number):
                value = self.values.setdefault(signal.name, Value(number, number, number))
                value.latest, value.low, value.high = number, min(value.low, number), max(value.high, number)
                value.beyond += not within(signal, number)


def within(signal: CanSignal, number: float) -> bool:
    """Whether ``number`` is in the range that the database gives; [0|0] means that nobody gave one."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not low < high:
        return True
    slack = 1e-6 * max(abs(low), abs(high))
    return bool(low - slack <= number <= high + slack)


class Picture:
    """All that was heard."""

    def __init__(self, database: Database | None = None) -> None:
        self._messages = {
            (message.frame_id, message.is_extended_frame): message
            for message in (database.messages if database else [])
            if not message.is_container
        }
        self.observed: dict[tuple[int, bool], ObservedFrames] = {}
        self.errors: Counter[str] = Counter()
        """Error frames by kind."""
        self.error_frames = 0
        self.unreadable = 0
        """What the interface could not unpack."""
        self.left_out = 0
        """Frames of more arbitration IDs than are kept apart."""

    @property
    def has_database(self) -> bool:
        """Whether there is one."""
        return bool(self._messages)

    @property
    def frames(self) -> int:
        """Frames of all kinds but error frames."""
        return sum(heard.count for heard in self.observed.values()) + self.left_out

    def take(self, frame: can.Message, time: float) -> None:
        """A frame, which came at ``time`` (s, of any clock that goes on steadily)."""
        if frame.is_error_frame:
            self.error_frames += 1
            self.errors.update(classes_of(frame))
            return
        key = (frame.arbitration_id, bool(frame.is_extended_id))
        heard = self.observed.get(key)
        if heard is None:
            if len(self.observed) >= MOST_IDENTIFIERS:
                self.left_out += 1
                return
            heard = self.observed[key] = ObservedFrames(*key, self._messages.get(key))
        heard.take(frame, time)

    def ordered(self) -> list[ObservedFrames]:
        """By their arbitration IDs, standard ones first."""
        return [self.observed[key] for key in sorted(self.observed, key=lambda key: (key[1], key[0]))]

    def missing(self) -> list[Message]:
        """Messages of the database that have not come."""
        return [message for key, message in self._messages.items() if key not in self.observed]

    def signals(self) -> Iterator[tuple[ObservedFrames, CanSignal, Value]]:
        """Every signal of the database that was heard."""
        for heard in self.ordered():
            for signal in heard.message.signals if heard.message else ():
                if (value := heard.values.get(signal.name)) is not None:
                    yield heard, signal, value

    @property
    def is_canopen(self) -> bool:
        """Whether somebody sends heartbeats as CANopen has them."""
        return any(
            not heard.extended
            and 0x701 <= heard.identifier <= 0x77F
            and heard.lengths == {1}
            and heard.latest[0] & 0x7F in STATES
            for heard in self.observed.values()
        )

    def guess(self, heard: ObservedFrames) -> str:
        """What a frame would be that no database knows, by its arbitration ID; empty where that says nothing."""
        if heard.extended:
            group = heard.identifier >> 8 & (0x3FFFF if heard.identifier >> 16 & 0xFF >= 0xF0 else 0x3FF00)
            return f"PGN {group} from {heard.identifier & 0xFF}, if SAE J1939"
        if not (name := canopen_name(heard.identifier)):
            return ""
        if not self.is_canopen:
            return f"{name}, if CANopen"
        if name.startswith("heartbeat") and len(heard.latest) == 1:
            name += f": {STATES.get(heard.latest[0] & 0x7F, 'state unknown')}"
        return f"CANopen {name}"


def canopen_name(identifier: int) -> str:
    """What a standard arbitration ID carries by CiA 301; empty where it has no meaning there."""
    if identifier in OF_ALL_NODES:
        return OF_ALL_NODES[identifier]
    node = identifier & 0x7F
    what = CANOPEN.get(identifier - node)
    return f"{what} of node {node}" if node and what else ""


FEWEST_FRAMES = 8
CLASSIC = 8  # bytes
COUNTERS = re.compile(r"count|alive|rolling|sequence|checksum|crc|^(?:mc|bz|cnt|chk)|(?:mc|bz|cnt|chk)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Field:
    """Some bytes of a frame that move as a number does."""

    observed: ObservedFrames
    part: Part
    layout: Layout

    @property
    def start(self) -> int:
        """The bit where it begins, as a DBC counts."""
        return start_bit(self.part.start, self.layout)


def start_bit(byte: int, layout: Layout) -> int:
    """The lowest bit of a little-endian number that begins with ``byte``, or the highest of a big-endian one."""
    return 8 * byte + (7 if layout.order == "big" else 0)


def parts_of(heard: ObservedFrames) -> list[Part]:
    """What is in the frames of one arbitration ID, as far as it changes."""
    history = [data for data in heard.history if len(data) == len(heard.latest)]
    if len(history) < FEWEST_FRAMES or not heard.latest:
        return []
    return parts(np.frombuffer(b"".join(history), dtype=np.uint8).reshape(len(history), -1), FRAMES, 1)


def fields_of(heard: ObservedFrames) -> list[Field]:
    """The numbers in them that move, without counters and what jumps."""
    return [
        Field(heard, part, part.layout)
        for part in parts_of(heard)
        if part.layout is not None and part.verdict in (LayoutVerdict.CERTAIN, LayoutVerdict.LIKELY)
    ]


def can_driver_lines(options: BusOptions, picture: Picture, database: str | None) -> list[str]:
    """The table ``[driver]``."""
    lines = ["[driver]", 'type = "can"']
    for key in ("interface", "channel", "port"):
        value = getattr(options, key)
        if value != BusOptions.model_fields[key].default:
            lines.append(f"{key} = {quoted(value)}")
    if options.bitrate is not None:
        lines.append(f'bitrate = "{options.bitrate:g} bit/s"')
    if any(heard.fd for heard in picture.observed.values()):
        lines.append("fd = true")
    knows = any(heard.message is not None for heard in picture.observed.values())
    return lines + ([f"dbc = {quoted(database)}"] if database and knows else [])


def can_signal_lines(picture: Picture) -> Iterator[str]:
    """The table ``[signals]``: what the database knows by name, the rest by its bits."""
    yield "[signals]"
    found = [(heard, signal, value) for heard, signal, value in picture.signals() if not _is_counter(signal)]
    names = [signal.name for _, signal, _ in found]
    for heard, signal, value in found:
        message = heard.message.name if heard.message and names.count(signal.name) > 1 else None
        yield _known(signal, value, message)
    for heard in picture.ordered():
        if heard.message is None:
            for field in fields_of(heard):
                yield _raw(field)


def _is_counter(signal: CanSignal) -> bool:
    return not signal.unit and COUNTERS.search(signal.name) is not None


def _known(signal: CanSignal, value: Value, message: str | None) -> str:
    keys = f"signal = {quoted(signal.name)}" + (f", message = {quoted(message)}" if message else "")
    unit = f"{signal.unit}, " if signal.unit else ""
    keys += "" if signal.unit else ', unit = "?"'
    return f"NAME = {{ {keys} }}  # {unit}{value_text(signal, value.latest)} now"


def value_text(signal: CanSignal, number: float) -> str:
    """With as many digits as one step of the signal is worth; with the name of a state that has one."""
    choices: Any = signal.choices or {}
    if number in choices:
        return f"{number:g} {choices[number]}"
    if signal.conversion.is_float:
        return f"{number:.5g}"
    step = abs(float(signal.conversion.scale)) or 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return f"{number:.{decimals}f}" if decimals <= 12 else f"{number:.5g}"


def _raw(field: Field) -> str:
    heard, layout = field.observed, field.layout
    extended = ", extended = true" if heard.extended else ""
    fd = ", fd = true" if len(heard.latest) > CLASSIC else ""
    kind = "float = true" if layout.is_float else f"signed = {'true' if layout.signed else 'false'}"
    bits = f'start = {field.start}, length = {8 * layout.width}, byte_order = "{layout.order}", {kind}'
    others = ", ".join(
        f"{other.layout.name} from bit {start_bit(other.start, other.layout)} "
        f"({number_text(other.latest, other.layout)})"
        for other in field.part.others
    )
    comment = spread(field.part) + (f"; or {others}" if others else "")
    name = f'"0x{heard.identifier:X}"'
    return f'NAME = {{ id = {name}{extended}{fd}, {bits}, scale = 1.0, unit = "?" }}  # {comment}'
