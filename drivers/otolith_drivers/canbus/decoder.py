"""From frames to samples, without any clock: serves a bus and a recording of one alike.

Taking the frames of one message: is it whole, is it new, what is in it. No clock in here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.base import Counters, Sample, Setup, Signal
from otolith_drivers.canbus.canopen import NodeWatch, Note
from otolith_drivers.canbus.database import Loaded, load_database
from otolith_drivers.canbus.monitoring import (
    STANDS_STILL,
    BusFaults,
    Checksum,
    FrameCounter,
    PeriodEstimator,
    checksum_of,
    counter_by_name,
    period_text,
)
from otolith_drivers.canbus.options import FrameOptions, MessageTable
from otolith_drivers.canbus.signals import (
    BitField,
    BitRange,
    SignalRequest,
    bytes_needed,
    field,
    find_in_databases,
    raw_signal,
)
from otolith_drivers.errors import ConfigurationError, nearest

NO_READING = float("nan")
NOTHING: list[Sample] = []
RECENT = 10.0  # s for which a frame or value that could not be used is told
NEVER_SEEN_AFTER = 3.0  # s, or ten declared periods

Condition = tuple[tuple[BitField, frozenset[int]], ...]
Row = tuple[str, BitField, float, float, float, float, str]
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
        self.pace = PeriodEstimator()
        self.lost = 0

    def is_in(self, data: bytes | bytearray) -> bool:
        return all(read(data) in values for read, values in self.condition)


class MessageReader:
    """Takes the frames of one arbitration ID, in the order of their arrival."""

    def __init__(self, messages: Sequence[Message], wanted: Sequence[SignalRequest], rules: Rules) -> None:
        """``messages`` are all descriptions of the frame in which something is ``wanted``."""
        self.wanted = tuple(wanted)
        self.title = f"{messages[0].name} (0x{messages[0].frame_id:X})"
        if messages[0].name == f"0x{messages[0].frame_id:X}":
            self.title = messages[0].name
        self.pace = PeriodEstimator(rules.period)
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

    def warnings(self, now: float, begun: float, *, unused: bool = True) -> list[str]:
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

    def _add(self, entry: SignalRequest) -> None:
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


EXTENDED = 1 << 29  # added to an extended arbitration ID, to tell it from a standard one of the same number
MOST_WARNINGS = 20  # lines; a file of which everything is wrong says no more by more of them


def decoder_of(options: FrameOptions, setup: Setup) -> "FrameDecoder":
    """What decodes the frames that hold ``setup.signals``.

    Raises:
        ConfigurationError: a signal cannot be found where its source says.
    """
    databases = [load_database(setup.folder / path) for path in options.databases()]
    warnings = [line for loaded in databases for line in loaded.warnings()]
    drives = _Drives(options, setup)
    wanted = [_find(signal, databases, drives) for signal in setup.signals]
    warnings += drives.warnings()
    readers = _readers(wanted, options.messages, databases, warnings)
    if len(warnings) > MOST_WARNINGS:
        warnings = [*warnings[:MOST_WARNINGS], f"... and {len(warnings) - MOST_WARNINGS} more"]
    return FrameDecoder(readers, drives.watches(), warnings)


class FrameDecoder:
    """Takes frames in the order of their arrival; everything it knows of time comes with them."""

    def __init__(
        self, readers: Mapping[int, MessageReader], watches: Sequence[NodeWatch] = (), warnings: Sequence[str] = ()
    ) -> None:
        self.faults = BusFaults()
        """What the bus says of itself."""
        self._readers = dict(readers)
        self._watches = tuple(watches)
        self._notes: dict[int, Note] = {key: note for watch in watches for key, note in watch.frames().items()}
        self.configuration_warnings = tuple(warnings)
        """What is wrong with the files that say what is in the frames, a line each."""
        self._unreadable = 0
        self._begun: float | None = None

    def begin(self, time: float) -> None:
        """Listening begins at ``time`` (s); what does not come from then on is missed."""
        self._begun = time

    def decode(self, frame: can.Message, time: float) -> list[Sample]:
        """The samples in ``frame``, which came or was true at ``time`` (s, of any clock that goes on steadily).

        Never raises: what cannot be used is counted.
        """
        try:
            if frame.is_error_frame or frame.is_remote_frame:
                if frame.is_error_frame:
                    self.faults.note(frame, time)
                return NOTHING
            self.faults.bus_off = False
            key = frame.arbitration_id + EXTENDED if frame.is_extended_id else frame.arbitration_id
            if self._notes and (note := self._notes.get(key)) is not None:
                note(frame.data, time)
            reader = self._readers.get(key)
            return reader.take(frame.data, time) if reader is not None else NOTHING
        except Exception:  # noqa: BLE001 - interfaces hand on what the wire gave them, and that may be anything
            self._unreadable += 1
            return NOTHING

    @property
    def counters(self) -> Counters:
        """What has been seen so far; ``reconnects`` are not its business."""
        readers = self._readers.values()
        return Counters(
            received=sum(reader.received for reader in readers),
            bad=sum(reader.bad for reader in readers) + self._unreadable,
            # What the controller had no room for is missed by pace or counter as well, unless a message has neither.
            lost=max(sum(reader.lost for reader in readers), self.faults.overflows),
        )

    def warnings(self, now: float, *, unused: bool = True) -> list[str]:
        """What is wrong at ``now`` (s, of the clock of :meth:`decode`), a line each.

        With ``unused`` also what came lately and could not be used.
        """
        if self._begun is None:
            self._begun = now
        lines = self.faults.warnings(now)
        for reader in self._readers.values():
            lines += reader.warnings(now, self._begun, unused=unused)
        for watch in self._watches:
            lines += watch.warnings(now)
        return lines

    def slowest_period(self) -> float | None:
        """Of the messages that come regularly (s); None while there are none."""
        paces = [reader.pace for reader in self._readers.values()]
        return max((pace.period for pace in paces if pace.regular and pace.period is not None), default=None)

    def identifiers(self) -> list[tuple[int, bool]]:
        """The arbitration IDs that are looked at, and whether each is an extended one."""
        return [(key % EXTENDED, key >= EXTENDED) for key in sorted({*self._readers, *self._notes})]

    def describe(self) -> list[str]:
        """What will be read from where, and what is wrong with the files that say so, a line each."""
        lines = [line for reader in self._readers.values() for line in reader.describe()]
        return [*lines, *(f"warning: {line}" for line in self.configuration_warnings)]


class _Drives:
    """The CANopen nodes of which something is wanted."""

    def __init__(self, options: FrameOptions, setup: Setup) -> None:
        nodes = sorted({signal.source.node for signal in setup.signals if signal.source.node is not None})
        self._drives = {}
        if nodes:
            from otolith_drivers.canbus.canopen import CanopenDrive  # noqa: PLC0415 - only CANopen drives cost its imports

            for node in nodes:
                sheet = options.data_sheet(node)
                tables = tuple(table for table in options.pdo if table.node == node)
                self._drives[node] = CanopenDrive(node, setup.folder / sheet if sheet is not None else None, tables)

    def find(self, signal: Signal) -> SignalRequest:
        return self._drives[signal.source.node].find(signal)

    def warnings(self) -> list[str]:
        return [line for drive in self._drives.values() for line in drive.warnings]

    def watches(self) -> list[NodeWatch]:
        return [NodeWatch(node, drive.emergency) for node, drive in self._drives.items()]


def _find(signal: Signal, databases: Sequence[Loaded], drives: _Drives) -> SignalRequest:
    if signal.source.node is not None:
        return drives.find(signal)
    if signal.source.id is not None:
        return raw_signal(signal)
    return find_in_databases(signal, databases)


def _key(message: Message) -> int:
    return message.frame_id + EXTENDED if message.is_extended_frame else message.frame_id


@dataclass(slots=True)
class _Frame:
    messages: list[Message]
    wanted: list[SignalRequest]

    def is_called(self, name: str) -> bool:
        try:
            identifier = int(name, 0)
        except ValueError:
            return any(message.name == name for message in self.messages)
        return identifier == self.messages[0].frame_id


def _readers(
    wanted: Sequence[SignalRequest],
    tables: Mapping[str, MessageTable],
    databases: Sequence[Loaded],
    warnings: list[str],
) -> dict[int, MessageReader]:
    frames: dict[int, _Frame] = {}
    for entry in wanted:
        frame = frames.setdefault(_key(entry.message), _Frame([], []))
        frame.wanted.append(entry)
        if entry.message not in frame.messages:
            frame.messages.append(entry.message)
    rules = {key: MessageTable() for key in frames}
    for name, table in tables.items():
        meant = [key for key, frame in frames.items() if frame.is_called(name)]
        if not meant:
            _say_unused(name, frames, databases, warnings)
        rules |= dict.fromkeys(meant, table)
    return {
        key: MessageReader(frame.messages, frame.wanted, _rules(frame, rules[key])) for key, frame in frames.items()
    }


def _say_unused(name: str, frames: Mapping[int, _Frame], databases: Sequence[Loaded], warnings: list[str]) -> None:
    if any(message.name == name for loaded in databases for message in loaded.messages):
        warnings.append(f"driver.messages.{name}: no signal of it is wanted")
        return
    known = nearest(name, [message.name for frame in frames.values() for message in frame.messages])
    raise ConfigurationError(f"no message {name!r} has a signal that is wanted: {known}", ("driver", "messages", name))


def _rules(frame: _Frame, table: MessageTable) -> Rules:
    message = frame.messages[0]
    length = max(entry.length for entry in frame.messages)
    counter, checksum, needed = None, None, 0
    if table.counter is None:
        if (found := counter_by_name(message, {entry.signal.name for entry in frame.wanted})) is not None:
            counter = FrameCounter(found, table.modulo, declared=False)
    elif table.counter is not False:
        found = _signal(frame, table.counter, "counter")
        counter, needed = FrameCounter(found, table.modulo, declared=True), bytes_needed(found)
    if table.checksum is not None:
        found = _signal(frame, table.checksum.signal, "checksum")
        needed = max(needed, bytes_needed(found))
        try:
            checksum = checksum_of(found, table.checksum, max(length, needed))
        except ValueError as error:
            raise ConfigurationError(str(error), ("driver", "messages", message.name, "checksum")) from error
    return Rules(counter, checksum, table.period, needed)


def _signal(frame: _Frame, said: str | BitRange, what: str) -> CanSignal:
    """The signal called ``said`` in any description of the frame, or where it says."""
    if isinstance(said, BitRange):
        return said.as_signal(what)
    names = []
    for message in frame.messages:
        for signal in message.signals:
            names.append(signal.name)
            if signal.name == said:
                return signal
    name = frame.messages[0].name
    raise ConfigurationError(
        f"{name} has no signal {said!r}: {nearest(said, names)}", ("driver", "messages", name, what)
    )
