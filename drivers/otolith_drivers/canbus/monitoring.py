"""Whether the received frames are complete and intact: counters, checksums and error frames.

No clock in here: every time is an argument (s, of any clock that advances steadily).
"""

import re
from collections import Counter
from collections.abc import Callable
from functools import reduce
from operator import xor

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.canbus.options import ChecksumKind, ChecksumTable, RawReader, bytes_needed, raw_reader
from otolith_drivers.common.message_times import EARLY, LATE, MAX_OUTAGE, PeriodEstimator

# Thresholds; docs/reference/thresholds-canbus.md gives the origin of each.
MIN_COUNTER_RUN = 9  # steps of one in a row before a signal is used as a counter because of its name
MIN_JUMPS = 16  # jumps more than steps of one, after which a counter is none
SLACK = 2.0  # frames more than the period allows that a counter may show, because of jitter
MIN_STUCK_FRAMES = 3  # repeated frames before a counter is reported as stuck
ERROR_SHOWN, STATE_SHOWN = 10.0, 60.0  # s after the last error frame; s after the last report of a controller state

COUNTER_NAMES = re.compile(
    r"(?:^|[_a-z0-9])(?:(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Roll(?:ing)?_?)?(?:Counter|Count|Cntr|Cnt|Ctr|Cyc))$"
    r"|^(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Counter|Count|Cntr|Cnt|Ctr)$"
    r"|^(?:COUNTER|Counter|CNT|RC|ARC|SQC|Alive|ALIVE)$"
    r"|_(?:COUNTER|Counter|CNT|Cnt|CTR|BZ|ARC|RC|SQC|MC)$"
)
"""How vendors name the counter of a message; BZ is the German ``Botschaftszähler``."""
OTHER_COUNTER_NAMES = re.compile(
    r"err|fault|puls|encod|revol|rotat|turn|start|hour|time|step|edge|tooth|batch|piece|part|lost|fail|bus_?off",
    re.IGNORECASE,
)
"""Names of counters that count something else than messages."""


class FrameCounter:
    """The counter in a message. One that is only recognised by its name is not used before it has counted."""

    def __init__(self, signal: CanSignal, modulo: int | None = None, *, declared: bool) -> None:
        """``modulo`` is one more than the highest count; by default that of the database, or of the bits."""
        self.name = signal.name
        self.declared = declared
        self.modulo = modulo or _modulo(signal)
        self.needed = bytes_needed(signal)  # Bytes of a frame that contains it
        self.repeated = 0  # Frames in a row that have repeated the last count
        self.is_random = False  # Whether it has jumped too often to be a counter, and has not counted since
        self._read: RawReader = raw_reader(signal)
        self._trusted = declared
        self._run = 0
        self._last: int | None = None
        self._corrupted = 0
        self._budget = 0.0  # Frames that may have been sent, by the clock, beside those that were counted
        self._jumps = 0  # Steps that were none of a counter, less those that were
        self._waiting = 0  # Lost frames that count when the counter has shown to be one

    def note_corrupted(self) -> None:
        """Count a frame whose counter cannot be read: it was sent and did arrive, so it is not lost."""
        self._corrupted += 1

    def lost_before(self, data: bytes | bytearray, time: float, periods: PeriodEstimator) -> int | None:
        """Number of frames that count as lost at this frame, or None if it repeats the last one."""
        count = int(self._read(data)) % self.modulo
        last, self._last = self._last, count
        step = (count - last) % self.modulo if last is not None else 1
        if not self._trusted:
            self._run = self._run + 1 if step == 1 else 0
            self._trusted, self._corrupted = self._run >= MIN_COUNTER_RUN, 0
            self.is_random &= not self._trusted
            return periods.lost_before(time)
        interval = 0.0 if periods.last is None else time - periods.last
        period = periods.period if periods.regular else None
        sent = periods.sent_since_last(time, step, self.modulo)
        if sent == 0:
            self.repeated += 1
            return None
        self.repeated = 0
        lost = sent - 1
        if self._corrupted:
            lost, self._corrupted = max(0, lost - self._corrupted), 0
        return self._credible(lost, interval, period)

    def _credible(self, lost: int, interval: float, period: float | None) -> int:
        """Return how many of ``lost`` frames count now, ``interval`` s after the frame before.

        A counter that shows more frames than the period allows jumps. Without a known period every loss may be a jump:
        then it counts when the counter has counted again. One that jumps in most frames is no counter.
        """
        if period is None:
            is_jump, self._budget = lost > 0, 0.0
        else:
            frames = interval / period if interval < MAX_OUTAGE else 0.0
            self._budget += frames
            is_jump = lost > self._budget + SLACK
            lost = max(0, round(frames) - 1) if is_jump else lost
            self._budget = max(-SLACK, self._budget - lost - 1)
            if not lost and EARLY <= frames <= LATE:  # nothing is held up any more
                self._budget = min(self._budget, SLACK)
        self._jumps = max(0, self._jumps + (1 if is_jump else -1))
        if self._jumps >= MIN_JUMPS:
            self.is_random, self._trusted, self._run, self._jumps, self._waiting = True, False, 0, 0, 0
            return 0
        if period is None:
            lost, self._waiting = (lost + self._waiting, 0) if not self._jumps else (0, lost + self._waiting)
        return lost


def _modulo(signal: CanSignal) -> int:
    whole = 1 << signal.length
    highest = signal.maximum
    return int(highest) + 1 if highest is not None and 1.0 < highest < whole - 1 else whole


def counter_by_name(message: Message, used: set[str]) -> CanSignal | None:
    """The signal of ``message`` with the name of a counter; None if there are several, or if it is in ``used``."""
    counters = [
        signal
        for signal in message.signals
        if COUNTER_NAMES.search(signal.name)
        and not OTHER_COUNTER_NAMES.search(signal.name)
        and signal.name not in used
        and signal.multiplexer_signal is None
        and 2 <= signal.length <= 16
        and not signal.is_signed
        and not signal.conversion.is_float
        and (signal.conversion.scale, signal.conversion.offset) == (1, 0)
    ]
    return counters[0] if len(counters) == 1 else None


CRCS: dict[str, tuple[str, int]] = {
    "crc8-sae-j1850": ("Crc8SaeJ1850", 8),
    "crc8-sae-j1850-zero": ("Crc8GsmA", 8),
    "crc8-autosar": ("Crc8Autosar", 8),
    "crc16-ccitt-false": ("Crc16CcittFalse", 16),
}
"""Class in crccheck, and bits. The SAE polynomial with initial value 0 is that of AUTOSAR's profile 1."""

ChecksumTest = Callable[[bytes | bytearray], bool]  # Whether the checksum in a frame is that of its bytes


def checksum_algorithm(kind: ChecksumKind) -> tuple[Callable[[bytes], int], int]:
    """The function that calculates a checksum, and the number of its bits."""
    if kind == "xor":
        return lambda data: reduce(xor, data, 0), 8
    if kind == "sum8":
        return lambda data: sum(data) & 0xFF, 8
    import crccheck.crc  # noqa: PLC0415 - most machines have none

    name, bits = CRCS[kind]
    return getattr(crccheck.crc, name).calc, bits


def checksum_test(signal: CanSignal, table: ChecksumTable, length: int) -> ChecksumTest:
    """The test for the checksum of ``table`` in ``signal``; raise ValueError if it does not fit ``length`` bytes."""
    calculate, bits = checksum_algorithm(table.kind)
    own, odd = divmod(signal.start if signal.byte_order == "little_endian" else signal.start - 7, 8)
    if odd or signal.length != bits or signal.is_signed or signal.conversion.is_float:
        raise ValueError(f"{table.kind} takes {bits} bits, unsigned and in whole bytes; {signal.name} is different")
    first, last = table.over or (0, length - 1)
    if not 0 <= first <= last < length:
        raise ValueError(f"bytes {first} to {last} are not within the {length} bytes of the frame")
    around = (slice(first, min(own, last + 1)), slice(max(own + bits // 8, first), last + 1))
    covered = tuple(part for part in around if part.start < part.stop)
    prefix, suffix = (bytes.fromhex(text.replace(":", " ")) for text in (table.prefix, table.suffix))
    read = raw_reader(signal)

    def matches(data: bytes | bytearray) -> bool:
        return calculate(prefix + b"".join(bytes(data[part]) for part in covered) + suffix) == read(data)

    return matches


# Bits of the arbitration ID of an error frame, and of its second data byte: linux/can/error.h.
CONTROLLER, BUS_OFF, RESTARTED = 0x04, 0x40, 0x100
ERROR_CLASSES: dict[int, str] = {
    0x01: "sending timed out",
    0x02: "arbitration lost",
    CONTROLLER: "controller error",
    0x08: "protocol violated",
    0x10: "transceiver error",
    0x20: "no acknowledgement",
    BUS_OFF: "bus off",
    0x80: "bus error",
    RESTARTED: "controller restarted",
}
CONTROLLER_STATES: dict[int, str] = {
    0x10: "error passive (receiving)",
    0x20: "error passive (sending)",
    0x04: "many errors (receiving)",
    0x08: "many errors (sending)",
}
OVERFLOW, ACTIVE_AGAIN = 0x01, 0x40


def error_classes(frame: can.Message) -> list[str]:
    """Names of the classes of an error frame; an interface that knows no classes has 0 in the arbitration ID."""
    return [name for bit, name in ERROR_CLASSES.items() if frame.arbitration_id & bit] or ["error frame"]


class BusFaults:
    """Counts error frames by their class and tracks the state of the CAN controller."""

    def __init__(self) -> None:
        self.bus_off = False  # True from a bus-off report until the next frame, or until the bus is opened anew
        self.total = 0  # Error frames, each of which may be of several classes
        self.counts: Counter[str] = Counter()  # Error frames of each class
        self.overflows = 0  # How often the controller had no room for a frame
        self._state = ""
        self._latest = ""
        self._time = 0.0

    def note(self, frame: can.Message, time: float) -> None:
        """Take an error frame, which arrived at ``time`` (s)."""
        self.total += 1
        bits, names = frame.arbitration_id, error_classes(frame)
        if bits & CONTROLLER and len(frame.data) > 1:
            names[names.index(ERROR_CLASSES[CONTROLLER])] = self._controller_event(frame.data[1])
        self.counts.update(names)
        if bits & BUS_OFF:
            self.bus_off = True
        if bits & RESTARTED:
            self.bus_off, self._state = False, ""
        self._latest, self._time = ", ".join(names), time

    def warnings(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        if not self.total:
            return []
        lines = []
        age = now - self._time
        if self._state and age < STATE_SHOWN:
            lines.append(f"the CAN controller is {self._state}: check cable, termination and bit rate")
        if age < ERROR_SHOWN:
            lines.append(f"{self.total} error frames on the bus, the latest {max(age, 0.0):.1f} s ago: {self._latest}")
        return lines

    def _controller_event(self, status: int) -> str:
        """Name of what the second data byte reports, and remember the state that it reports."""
        self.overflows += status & OVERFLOW
        if status & ACTIVE_AGAIN:
            self._state = ""
            return "error active again"
        for bit, name in CONTROLLER_STATES.items():
            if status & bit:
                self._state = name
                return name
        return "controller had no room for a frame" if status & OVERFLOW else ERROR_CLASSES[CONTROLLER]
