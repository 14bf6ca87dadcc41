"""What is heard on a CAN bus: which frames, how often and how regularly, and what in them changes. No clock in here."""

import math
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database

from otolith_drivers.can_faults import classes_of
from otolith_drivers.canopen_watch import STATES

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
class Heard:
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
        self.heard: dict[tuple[int, bool], Heard] = {}
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
        return sum(heard.count for heard in self.heard.values()) + self.left_out

    def take(self, frame: can.Message, time: float) -> None:
        """A frame, which came at ``time`` (s, of any clock that goes on steadily)."""
        if frame.is_error_frame:
            self.error_frames += 1
            self.errors.update(classes_of(frame))
            return
        key = (frame.arbitration_id, bool(frame.is_extended_id))
        heard = self.heard.get(key)
        if heard is None:
            if len(self.heard) >= MOST_IDENTIFIERS:
                self.left_out += 1
                return
            heard = self.heard[key] = Heard(*key, self._messages.get(key))
        heard.take(frame, time)

    def ordered(self) -> list[Heard]:
        """By their arbitration IDs, standard ones first."""
        return [self.heard[key] for key in sorted(self.heard, key=lambda key: (key[1], key[0]))]

    def missing(self) -> list[Message]:
        """Messages of the database that have not come."""
        return [message for key, message in self._messages.items() if key not in self.heard]

    def signals(self) -> Iterator[tuple[Heard, CanSignal, Value]]:
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
            for heard in self.heard.values()
        )

    def guess(self, heard: Heard) -> str:
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
