"""What tells that frames are missing or repeated: their pace and their counter. No clock in here.

Whether a frame is as it was sent: the checksums that makers put into their messages.

What a bus says of itself in error frames, in the classes of Linux (``linux/can/error.h``). No clock in here.
"""

import re
import statistics
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.canbus.options import ChecksumKind, ChecksumTable
from otolith_drivers.canbus.signals import BitField, field


def _xor(data: bytes) -> int:
    found = 0
    for byte in data:
        found ^= byte
    return found


def _sum(data: bytes) -> int:
    return sum(data) & 0xFF


def _crc(name: str) -> Callable[[bytes], int]:
    import crccheck.crc  # noqa: PLC0415 - most machines have none

    calculate: Callable[[bytes], int] = getattr(crccheck.crc, name).calc
    return calculate


CRCS: dict[str, tuple[str, int]] = {
    "crc8-sae-j1850": ("Crc8SaeJ1850", 8),
    "crc8-sae-j1850-zero": ("Crc8GsmA", 8),
    "crc8-autosar": ("Crc8Autosar", 8),
    "crc16-ccitt-false": ("Crc16CcittFalse", 16),
}
"""Names in crccheck, and bits. The SAE polynomial that starts from zero is that of AUTOSAR's profile 1."""


def calculation(kind: ChecksumKind) -> tuple[Callable[[bytes], int], int]:
    """What calculates a checksum, and how many bits it has."""
    if kind in CRCS:
        name, bits = CRCS[kind]
        return _crc(name), bits
    return {"xor": _xor, "sum8": _sum}[kind], 8


@dataclass(frozen=True, slots=True)
class Checksum:
    """The checksum in a message."""

    read: BitField
    calculate: Callable[[bytes], int]
    covered: tuple[slice, ...]
    """The bytes of the frame that it covers."""
    prefix: bytes = b""
    suffix: bytes = b""
    """Bytes that both sides know and the frame does not have: AUTOSAR's data ID."""

    def holds(self, data: bytes | bytearray) -> bool:
        """Whether the frame is as it was sent."""
        covered = b"".join(bytes(data[part]) for part in self.covered)
        return self.calculate(self.prefix + covered + self.suffix) == self.read(data)


def checksum_of(signal: CanSignal, table: ChecksumTable, length: int) -> Checksum:
    """The checksum in ``signal`` of a frame of ``length`` bytes, which ``table`` describes.

    Raises:
        ValueError: its bits are no whole bytes, too few or too many, or what it covers lies beyond the frame.
    """
    calculate, bits = calculation(table.kind)
    own, odd = divmod(signal.start if signal.byte_order == "little_endian" else signal.start - 7, 8)
    if odd or signal.length != bits or signal.is_signed or signal.conversion.is_float:
        raise ValueError(f"{table.kind} takes {bits} bits, unsigned and whole bytes; {signal.name} is not so")
    first, last = table.over or (0, length - 1)
    if not 0 <= first <= last < length:
        raise ValueError(f"bytes {first} to {last} are not within the {length} bytes of the frame")
    around = (slice(first, min(own, last + 1)), slice(max(own + bits // 8, first), last + 1))
    covered = tuple(part for part in around if part.start < part.stop)
    prefix, suffix = (bytes.fromhex(text.replace(":", " ")) for text in (table.prefix, table.suffix))
    return Checksum(field(signal), calculate, covered, prefix, suffix)


RECENT = 10.0  # s for which the last error is complained of
STATE_HOLDS = 60.0  # s for which the controller is taken to be in the state it last reported

BUS_OFF, RESTARTED, CONTROLLER = 0x40, 0x100, 0x04
CLASSES: dict[int, str] = {
    0x01: "sending timed out",
    0x02: "arbitration lost",
    CONTROLLER: "trouble of the controller",
    0x08: "protocol violated",
    0x10: "trouble of the transceiver",
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
OVERFLOW_RECEIVING, ACTIVE_AGAIN = 0x01, 0x40  # bits of the first data byte beside those states


def classes_of(frame: can.Message) -> list[str]:
    """What an error frame says, in words; an interface that does not tell classes has 0 there."""
    return [name for bit, name in CLASSES.items() if frame.arbitration_id & bit] or ["error frame"]


class BusFaults:
    """Counts error frames by their class, and knows whether the controller has left the bus."""

    def __init__(self) -> None:
        self.bus_off = False
        """Until a frame comes, or the bus is opened anew."""
        self.total = 0
        """Error frames, each of which may be of several classes."""
        self.counts: Counter[str] = Counter()
        """By what they say."""
        self.overflows = 0
        """Times that the controller had no room for a frame."""
        self._state = ""
        self._latest = ""
        self._at = 0.0

    def note(self, frame: can.Message, time: float) -> None:
        """An error frame, which came at ``time`` (s)."""
        self.total += 1
        bits, names = frame.arbitration_id, classes_of(frame)
        if bits & CONTROLLER and len(frame.data) > 1:
            names = [self._of_controller(frame.data[1]) if name == CLASSES[CONTROLLER] else name for name in names]
        self.counts.update(names)
        if bits & BUS_OFF:
            self.bus_off = True
        if bits & RESTARTED:
            self.bus_off, self._state = False, ""
        self._latest, self._at = ", ".join(names), time

    def warnings(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        if not self.total:
            return []
        lines = []
        age = now - self._at
        if self._state and age < STATE_HOLDS:
            lines.append(f"the CAN controller is {self._state}: look at cable, termination and bit rate")
        if age < RECENT:
            lines.append(f"{self.total} error frames on the bus, the latest {max(age, 0.0):.1f} s ago: {self._latest}")
        return lines

    def _of_controller(self, status: int) -> str:
        if status & OVERFLOW_RECEIVING:
            self.overflows += 1
        if status & ACTIVE_AGAIN:
            self._state = ""
            return "error active again"
        for bit, name in CONTROLLER_STATES.items():
            if status & bit:
                self._state = name
                return name
        return "controller had no room for a frame" if status & OVERFLOW_RECEIVING else CLASSES[CONTROLLER]


LEARNED_FROM, LEARNED_OVER, MOST_INTERVALS = 8, 0.25, 4096  # intervals; s; intervals
MOSTLY = 0.75  # of the intervals of something regular are like the one in the middle
SOON, LATE = 0.5, 1.5  # of the period: what comes sooner was held up before, what comes later lacks a frame
FOLLOWING = 0.02  # of the difference, with each frame: periods of cheap oscillators drift
MOST_ODD = 32  # intervals in a row, after which the message has another period
LONGEST_OUTAGE = 60.0  # s; who is silent for longer has stopped to send, and nothing is known to be lost
SILENT_AFTER, SILENT_AT_LEAST = 10.0, 0.5  # periods; s
IRREGULAR_SILENT_AT_LEAST = 10.0  # s
PROOF = 8  # steps of one in a row, before a signal is believed to be a counter because of its name
STANDS_STILL = 3  # repeated frames

COUNTER_NAMES = re.compile(
    r"(?:^|[_a-z0-9])(?:(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Roll(?:ing)?_?)?(?:Counter|Count|Cntr|Cnt|Ctr|Cyc))$"
    r"|^(?:Alive|Rolling|Message|Msg|Sequence|Seq|Frame|Live)_?(?:Counter|Count|Cntr|Cnt|Ctr)$"
    r"|^(?:COUNTER|Counter|CNT|RC|ARC|SQC|Alive|ALIVE)$"
    r"|_(?:COUNTER|Counter|CNT|Cnt|CTR|BZ|ARC|RC|SQC|MC)$"
)
"""How vendors name the counter of a message; BZ is the German ``Botschaftszähler``."""
NOT_OF_MESSAGES = re.compile(
    r"err|fault|puls|encod|revol|rotat|turn|start|hour|time|step|edge|tooth|batch|piece|part|lost|fail|bus_?off",
    re.IGNORECASE,
)


class PeriodEstimator:
    """How often something comes, learned from when it came, unless it is declared."""

    def __init__(self, declared: float | None = None) -> None:
        self.period = declared
        """s; None until it is known."""
        self.regular = declared is not None
        self.last: float | None = None
        self._declared = declared is not None
        self._intervals: list[float] = []
        self._odd = 0
        self._missing = 0
        self._held_up = 0

    def note(self, time: float) -> int:
        """One has come at ``time``; how many are now known to be missing before it.

        A gap counts once the next interval is a regular one: after a hold-up all come, in a burst.
        """
        last, self.last = self.last, time
        if last is None:
            return 0
        elapsed = time - last
        if self.period is None or not self.regular:
            self._learn(elapsed)
            return 0
        ratio = elapsed / self.period
        if SOON <= ratio <= LATE:
            self._follow(elapsed)
            missing, self._missing = self._missing, 0
            return missing
        if ratio < SOON and self._missing:
            self._missing -= 1
            return 0
        if self._oddity() or ratio < SOON:
            return 0
        missing, self._missing = self._missing, round(ratio) - 1 if elapsed < LONGEST_OUTAGE else 0
        return missing

    def counted(self, time: float, step: int, modulo: int) -> int:
        """The same for one that is counted ``step`` after the last, modulo ``modulo``: how many frames it is ahead.

        An outage may be longer than the counter's cycle: it is then the number nearest to what the clock says. Whole
        cycles count once the next interval is a regular one, with that one.
        """
        last, self.last = self.last, time
        if last is None:
            return 1
        elapsed = time - last
        if self.period is None or not self.regular:
            if step:
                self._learn(elapsed / step)
            return step
        if step == 1 and SOON <= elapsed / self.period <= LATE:  # as nearly always
            self._follow(elapsed)
            missing, self._missing = self._missing, 0
            return 1 + missing
        expected = elapsed / self.period if elapsed < LONGEST_OUTAGE else 0.0
        cycles = max(0, round((expected - step) / modulo))
        if cycles and not step:  # the count of the last frame, but not that frame
            step, cycles = modulo, cycles - 1
        if not step:
            return 0
        missing, self._missing = self._missing, cycles * modulo
        ratio = elapsed / self.period / (step + cycles * modulo)
        if SOON <= ratio <= LATE:
            self._follow(ratio * self.period)
            return step + missing
        if ratio > LATE:
            self._held_up = int(expected) - step
        elif self._held_up > 0:
            self._held_up -= step
            return step
        self._oddity()
        return step + missing if ratio > LATE else step

    def silent_for(self, now: float) -> float | None:
        """Seconds without one, where that is longer than it ever should be."""
        if self.last is None:
            return None
        least = SILENT_AT_LEAST if self.regular else IRREGULAR_SILENT_AT_LEAST
        silence = now - self.last
        return silence if silence > max(least, SILENT_AFTER * (self.period or 0.0)) else None

    def pace(self) -> str:
        """In words."""
        if self.period is None:
            return "at a pace that is not known"
        return f"every {period_text(self.period)}" + ("" if self.regular else " or so, not regularly")

    def _follow(self, interval: float) -> None:
        self._odd = 0
        if not self._declared and self.period is not None:
            self.period += FOLLOWING * (interval - self.period)

    def _oddity(self) -> bool:
        """Whether there were so many that the period is learned anew."""
        self._odd += 1
        if self._odd < MOST_ODD or self._declared:
            return False
        self.period, self.regular, self._odd, self._missing = None, False, 0, 0
        return True

    def _learn(self, interval: float) -> None:
        """By the mean of some time: in a burst that a hold-up has left, intervals are anything."""
        self._intervals.append(interval)
        count, span = len(self._intervals), sum(self._intervals)
        if count < LEARNED_FROM or (span < LEARNED_OVER and count < MOST_INTERVALS):
            return
        middle, mean = statistics.median(self._intervals), span / count
        inside = [entry for entry in self._intervals if SOON * middle <= entry <= LATE * middle]
        self.regular = len(inside) >= MOSTLY * count and middle > 0.0 and abs(mean / middle - 1.0) < LATE - 1.0
        self.period = statistics.fmean(inside) if self.regular else mean
        self._intervals.clear()


def period_text(period: float) -> str:
    """A period as people say it."""
    return f"{period * 1e3:.1f} ms" if period < 1.0 else f"{period:.1f} s"


class FrameCounter:
    """The counter in a message, declared or recognised by its name; the latter must first count to be believed."""

    def __init__(self, signal: CanSignal, modulo: int | None = None, *, declared: bool) -> None:
        """``modulo`` is one more than the highest count; without it that is the database's, or what the bits hold."""
        self.name = signal.name
        self.modulo = modulo or _modulo(signal)
        self.standing = 0
        """Frames since it last moved."""
        self._read: BitField = field(signal)
        self.declared = declared
        self._trusted = declared
        self._run = 0
        self._last: int | None = None
        self._spoiled = 0

    def spoiled(self) -> None:
        """A frame came whose counter cannot be believed: it will be missing in the count, but it is not lost."""
        self._spoiled += 1

    def missing(self, data: bytes | bytearray, time: float, pace: PeriodEstimator) -> int:
        """Frames lost before this one; -1 where it is the one before once more."""
        count = int(self._read(data)) % self.modulo
        last, self._last = self._last, count
        step = (count - last) % self.modulo if last is not None else 1
        if not self._trusted:
            self._run = self._run + 1 if step == 1 else 0
            self._trusted, self._spoiled = self._run > PROOF, 0
            return pace.note(time)
        before = pace.last
        ahead = pace.counted(time, step, self.modulo)
        if ahead == 0:
            pace.last = before  # time goes on from the last frame that was new
            self.standing += 1
            return -1
        spoiled, self._spoiled, self.standing = self._spoiled, 0, 0
        return max(0, ahead - 1 - spoiled)


def _modulo(signal: CanSignal) -> int:
    whole = 1 << signal.length
    highest = signal.maximum
    return int(highest) + 1 if highest is not None and 1.0 < highest < whole - 1 else whole


def counter_by_name(message: Message, taken: set[str]) -> CanSignal | None:
    """The signal of ``message`` that is called as counters are; none where several are, or where it is ``taken``."""
    found = [
        signal
        for signal in message.signals
        if COUNTER_NAMES.search(signal.name)
        and not NOT_OF_MESSAGES.search(signal.name)
        and signal.name not in taken
        and signal.multiplexer_signal is None
        and 2 <= signal.length <= 16
        and not signal.is_signed
        and not signal.conversion.is_float
        and (signal.conversion.scale, signal.conversion.offset) == (1, 0)
    ]
    return found[0] if len(found) == 1 else None
