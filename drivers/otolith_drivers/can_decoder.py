"""From frames to samples, without any clock: serves a bus and a recording of one alike."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.base import Counters, Sample, Setup, Signal
from otolith_drivers.can_checksum import checksum_of
from otolith_drivers.can_faults import BusFaults
from otolith_drivers.can_fields import bytes_needed
from otolith_drivers.can_message import NOTHING, MessageReader, Rules
from otolith_drivers.can_options import FrameOptions, MessageTable
from otolith_drivers.can_signals import Wanted, find_in_databases, raw_signal
from otolith_drivers.can_source import Bits
from otolith_drivers.can_vigilance import FrameCounter, counter_by_name
from otolith_drivers.canopen_watch import NodeWatch, Note
from otolith_drivers.dbc import Loaded, load_database
from otolith_drivers.errors import ConfigurationError, nearest

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
        self.warnings = tuple(warnings)
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

    def complaints(self, now: float, *, unused: bool = True) -> list[str]:
        """What is wrong at ``now`` (s, of the clock of :meth:`decode`), a line each.

        With ``unused`` also what came lately and could not be used.
        """
        if self._begun is None:
            self._begun = now
        lines = self.faults.complaints(now)
        for reader in self._readers.values():
            lines += reader.complaints(now, self._begun, unused=unused)
        for watch in self._watches:
            lines += watch.complaints(now)
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
        return [*lines, *(f"warning: {line}" for line in self.warnings)]


class _Drives:
    """The CANopen nodes of which something is wanted."""

    def __init__(self, options: FrameOptions, setup: Setup) -> None:
        nodes = sorted({signal.source.node for signal in setup.signals if signal.source.node is not None})
        self._drives = {}
        if nodes:
            from otolith_drivers.canopen_pdo import Drive  # noqa: PLC0415 - only CANopen drives cost its imports

            for node in nodes:
                sheet = options.data_sheet(node)
                tables = tuple(table for table in options.pdo if table.node == node)
                self._drives[node] = Drive(node, setup.folder / sheet if sheet is not None else None, tables)

    def find(self, signal: Signal) -> Wanted:
        return self._drives[signal.source.node].find(signal)

    def warnings(self) -> list[str]:
        return [line for drive in self._drives.values() for line in drive.warnings]

    def watches(self) -> list[NodeWatch]:
        return [NodeWatch(node, drive.emergency) for node, drive in self._drives.items()]


def _find(signal: Signal, databases: Sequence[Loaded], drives: _Drives) -> Wanted:
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
    wanted: list[Wanted]

    def is_called(self, name: str) -> bool:
        try:
            identifier = int(name, 0)
        except ValueError:
            return any(message.name == name for message in self.messages)
        return identifier == self.messages[0].frame_id


def _readers(
    wanted: Sequence[Wanted], tables: Mapping[str, MessageTable], databases: Sequence[Loaded], warnings: list[str]
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


def _signal(frame: _Frame, said: str | Bits, what: str) -> CanSignal:
    """The signal called ``said`` in any description of the frame, or where it says."""
    if isinstance(said, Bits):
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
