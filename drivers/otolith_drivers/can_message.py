"""Taking the frames of one message: is it whole, is it new, what is in it. No clock in here."""

from collections.abc import Sequence
from dataclasses import dataclass

from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.base import Sample
from otolith_drivers.can_checksum import Checksum
from otolith_drivers.can_fields import Field, bytes_needed, field
from otolith_drivers.can_signals import Wanted
from otolith_drivers.can_vigilance import STANDS_STILL, FrameCounter, Pace, period_text
from otolith_drivers.errors import ConfigurationError

NO_READING = float("nan")
NOTHING: list[Sample] = []
RECENT = 10.0  # s for which a frame or value that could not be used is told
NEVER_SEEN_AFTER = 3.0  # s, or ten declared periods

Condition = tuple[tuple[Field, frozenset[int]], ...]
Row = tuple[str, Field, float, float, float, float, str]
"""Name, how to read it, lowest and highest raw number, scale, offset, unit."""


@dataclass(frozen=True, slots=True)
class Rules:
    """What a message is held to."""

    counter: FrameCounter | None = None
    checksum: Checksum | None = None
    period: float | None = None
    """s, declared."""
    needed: int = 0
    """Bytes that counter and checksum need."""


@dataclass(slots=True)
class _Trouble:
    count: int
    at: float
    text: str


class _Group:
    """The wanted signals that a frame has for some values of its multiplexers alone."""

    def __init__(self, title: str, condition: Condition) -> None:
        self.title = title
        self.condition = condition
        self.rows: list[Row] = []
        self.pace = Pace()
        self.lost = 0

    def is_in(self, data: bytes | bytearray) -> bool:
        return all(read(data) in values for read, values in self.condition)


class MessageReader:
    """Takes the frames of one arbitration ID, in the order of their arrival."""

    def __init__(self, messages: Sequence[Message], wanted: Sequence[Wanted], rules: Rules) -> None:
        """``messages`` are all descriptions of the frame in which something is ``wanted``."""
        self.wanted = tuple(wanted)
        self.title = f"{messages[0].name} (0x{messages[0].frame_id:X})"
        if messages[0].name == f"0x{messages[0].frame_id:X}":
            self.title = messages[0].name
        self.pace = Pace(rules.period)
        self.received = self.bad = 0
        self._lost = 0
        self._rules, self._counter, self._checksum = rules, rules.counter, rules.checksum
        self._length = max(rules.needed, *(message.length for message in messages))
        self._cycle = max((message.cycle_time or 0) * 1e-3 for message in messages)
        self._rows: list[Row] = []
        self._groups: dict[tuple[object, ...], _Group] = {}
        self._troubles: dict[str, _Trouble] = {}
        for entry in wanted:
            self._add(entry)

    @property
    def lost(self) -> int:
        """Samples that are known to be missing."""
        return self._lost + sum(group.lost for group in self._groups.values())

    def take(self, data: bytes | bytearray, time: float) -> list[Sample]:
        """The samples in one frame, which came at ``time`` (s); none where it is broken or is the last one again."""
        if len(data) < self._length or (self._checksum is not None and not self._checksum.holds(data)):
            return self._refuse(data, time)
        if self._counter is None:
            missing = self.pace.note(time)
        else:
            missing = self._counter.missing(data, time, self.pace)
            if missing < 0:
                self.bad += 1
                return NOTHING
        if missing:
            self._lost += missing * len(self._rows)
        samples = [
            Sample(name, time, scale * raw + offset)
            if low <= (raw := read(data)) <= high
            else self._no_reading(name, time, scale * raw + offset, unit)
            for name, read, low, high, scale, offset, unit in self._rows
        ]
        if self._groups:
            self._take_groups(data, time, samples)
        self.received += len(samples)
        return samples

    def complaints(self, now: float, begun: float, *, unused: bool = True) -> list[str]:
        """What is wrong at ``now``, a line each; listening began at ``begun`` (s).

        With ``unused`` also what came lately and could not be used.
        """
        if self.pace.last is None and not self._troubles:
            declared = self._rules.period or self._cycle
            waited = now - begun
            return [f"{self.title} has not come once in {waited:.1f} s"] if waited > _patience(declared) else []
        lines = [
            f"{self.title}: {trouble.text}; {trouble.count} in all, the last {max(now - trouble.at, 0.0):.1f} s ago"
            for trouble in list(self._troubles.values())  # the receiving thread may add one
            if unused and now - trouble.at < RECENT
        ]
        if self._counter is not None and self._counter.standing >= STANDS_STILL:
            lines.append(self._standing(self._counter))
        elif (silence := self.pace.silent_for(now)) is not None:
            lines.append(f"{self.title} silent for {silence:.1f} s; it came {self.pace.pace()}")
        elif self._groups:
            lines += self._silent_groups(now, begun)
        return lines

    def describe(self) -> list[str]:
        """What is read, and what the frames are held to, a line each."""
        rules = []
        if self._counter is not None:
            rules.append(f"counted by {self._counter.name}")
        if self._checksum is not None:
            rules.append("with a checksum")
        if self._rules.period is not None:
            rules.append(f"every {period_text(self._rules.period)}")
        held = [f"frames {self.title} are {', '.join(rules)}"] if rules else []
        return [*(entry.describe() for entry in self.wanted), *held]

    def _add(self, entry: Wanted) -> None:
        message, signal = entry.message, entry.signal
        self._length = max(self._length, bytes_needed(signal))
        unit = entry.target_unit
        row = (entry.name, field(signal), entry.raw_low, entry.raw_high, entry.scale, entry.offset, unit)
        links = _multiplexers(message, signal)
        if not links:
            self._rows.append(row)
            return
        key = tuple((switch.name, values) for switch, values in links)
        if key not in self._groups:
            when = " and ".join(f"{switch.name} = {_few(values)}" for switch, values in links)
            condition = tuple((field(switch), values) for switch, values in links)
            self._groups[key] = _Group(f"{self.title} with {when}", condition)
        self._groups[key].rows.append(row)

    def _take_groups(self, data: bytes | bytearray, time: float, samples: list[Sample]) -> None:
        for group in self._groups.values():
            if not group.is_in(data):
                continue
            group.lost += group.pace.note(time) * len(group.rows)
            for name, read, low, high, scale, offset, unit in group.rows:
                raw = read(data)
                value = scale * raw + offset
                fits = low <= raw <= high
                samples.append(Sample(name, time, value) if fits else self._no_reading(name, time, value, unit))

    def _no_reading(self, name: str, time: float, value: float, unit: str) -> Sample:
        self.bad += 1
        self._trouble(name, time, f"{name} of {value:.6g} {unit} is out of its range")
        return Sample(name, time, NO_READING)

    def _refuse(self, data: bytes | bytearray, time: float) -> list[Sample]:
        self.bad += 1
        if len(data) < self._length:
            self._trouble("short", time, f"a frame of {len(data)} bytes, of which there should be {self._length}")
        else:
            self._trouble("checksum", time, "a frame with a wrong checksum")
        if self._counter is None:
            self._lost += self.pace.note(time) * len(self._rows)
        else:
            self._counter.spoiled()
        return NOTHING

    def _trouble(self, kind: str, time: float, text: str) -> None:
        known = self._troubles.get(kind)
        if known is None:
            self._troubles[kind] = _Trouble(1, time, text)
        else:
            known.count, known.at, known.text = known.count + 1, time, text

    def _standing(self, counter: FrameCounter) -> str:
        line = f"the counter {counter.name} of {self.title} stands still since {counter.standing} frames"
        if counter.declared:
            return line
        return f"{line}; if it is no counter, set driver.messages.{self.title.split()[0]}.counter = false"

    def _silent_groups(self, now: float, begun: float) -> list[str]:
        lines = []
        for group in self._groups.values():
            if (silence := group.pace.silent_for(now)) is not None:
                lines.append(f"{group.title} silent for {silence:.1f} s; it came {group.pace.pace()}")
            elif group.pace.last is None and now - begun > _patience(10.0 * (self.pace.period or 0.0)):
                lines.append(f"{group.title} has not come once in {now - begun:.1f} s")
        return lines


def _patience(period: float) -> float:
    return max(NEVER_SEEN_AFTER, 10.0 * period)


def _few(values: frozenset[int]) -> str:
    shown = sorted(values)
    return ", ".join(map(str, shown[:3])) + (" ..." if len(shown) > 3 else "")


def _multiplexers(message: Message, signal: CanSignal) -> list[tuple[CanSignal, frozenset[int]]]:
    """The multiplexers on which ``signal`` depends, outermost last, each with its values."""
    links: list[tuple[CanSignal, frozenset[int]]] = []
    while signal.multiplexer_signal is not None and signal.multiplexer_ids is not None:
        if len(links) == len(message.signals):
            raise ConfigurationError(f"message {message.name}: its multiplexers depend on each other in a circle")
        switch = message.get_signal_by_name(signal.multiplexer_signal)
        links.append((switch, frozenset(signal.multiplexer_ids)))
        signal = switch
    return links
