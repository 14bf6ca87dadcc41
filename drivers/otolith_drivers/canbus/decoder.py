"""From frames to samples: serves a live bus and a log of one alike.

:class:`FrameDecoder` gives each frame to the :class:`MessageReader` of its arbitration ID, which checks that the frame
is intact and new, and reads its signals. No clock in here: the time of a frame is an argument.
"""

import logging
import math
import threading
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import can
from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.base import Counters, Sample, Setup, Signal
from otolith_drivers.canbus.canopen import CanopenDrive, FrameHandler, NodeMonitor
from otolith_drivers.canbus.database import STANDARD_LIMIT, CanDatabase, load_database
from otolith_drivers.canbus.j1939 import (
    ExactIdentifiers,
    ParameterGroups,
    fault_of,
    highest_reading,
    is_a_group,
    is_j1939,
    names_any_source,
)
from otolith_drivers.canbus.monitoring import (
    MIN_STUCK_FRAMES,
    BusFaults,
    ChecksumTest,
    FrameCounter,
    checksum_test,
    counter_by_name,
)
from otolith_drivers.canbus.options import (
    MAX_VALUE,
    BitRange,
    FrameOptions,
    MessageTable,
    RawReader,
    SignalRequest,
    bytes_needed,
    names_of_no_reading,
    raw_reader,
    request_bits,
    request_from_databases,
)
from otolith_drivers.common.message_times import PeriodEstimator, period_text
from otolith_drivers.common.reconnection import OwnFaults, PassingFault
from otolith_drivers.errors import ConfigurationError, nearest

log = logging.getLogger(__name__)

NO_READING = float("nan")
NO_SAMPLES: list[Sample] = []
EXTENDED = 1 << 29  # added to an extended arbitration ID, so that it differs from the same standard one
MIN_WAIT, WAIT_PERIODS = 3.0, 10.0  # s; periods: when a message is reported that has not come once
GROUP_WAIT_PERIODS = 100.0  # periods of the message: the same for the signals of one multiplexer value
MAX_CYCLE_TIME = 86_400_000  # ms; a longer one in a database is no cycle time
MAX_WARNINGS = 20  # lines about the files; more of them do not help

Condition = tuple[tuple[RawReader, frozenset[int]], ...]
Row = tuple[str, RawReader, float, float, float, float, str]  # Name, reader, raw limits, scale, offset, unit


@dataclass(frozen=True, slots=True)
class MessageRules:
    """What the frames of a message are checked against."""

    counter: FrameCounter | None = None
    checksum: ChecksumTest | None = None
    period: float | None = None  # s, declared
    length: int = 0  # Bytes that counter and checksum need
    is_j1939: bool = False  # Whether its highest numbers are no readings


@dataclass(slots=True)
class _MultiplexedGroup:
    """The requested signals that a frame has only for some values of its multiplexers."""

    title: str
    condition: Condition
    needed: int  # Bytes of a frame that contains its multiplexers
    rows: list[Row] = field(default_factory=list)
    periods: PeriodEstimator = field(default_factory=PeriodEstimator)
    lost: int = 0

    def is_in(self, data: bytes | bytearray) -> bool:
        return len(data) >= self.needed and all(read(data) in values for read, values in self.condition)


class MessageReader:
    """Reads the frames of one arbitration ID, in the order of their arrival."""

    def __init__(self, messages: Sequence[Message], requests: Sequence[SignalRequest], rules: MessageRules) -> None:
        """``messages`` are the descriptions of the frame that contain the signals of ``requests``."""
        name, identifier = messages[0].name, f"0x{messages[0].frame_id:X}"
        self.title = name if name == identifier else f"{name} ({identifier})"
        self.requests = tuple(requests)
        self.periods = PeriodEstimator(rules.period)
        self.received = self.bad = 0
        self._lost = 0
        self._counter, self._checksum, self._declared_period = rules.counter, rules.checksum, rules.period
        self._length = max(rules.length, *(message.length for message in messages))
        cycles = [message.cycle_time for message in messages]  # a database may define it as a text
        longest = max((ms for ms in cycles if isinstance(ms, int | float)), default=0)
        self._database_period = 1e-3 * min(longest, MAX_CYCLE_TIME)
        self._rows: list[Row] = []
        self._needed: dict[str, int] = {}  # Bytes of a frame that contains each signal
        self._groups: dict[tuple[object, ...], _MultiplexedGroup] = {}
        self._rejections: defaultdict[str, PassingFault] = defaultdict(PassingFault)  # Frames or values, by their kind
        self._standard = {request.name: request.signal for request in requests if rules.is_j1939}
        self._named = {request.name: names_of_no_reading(request.signal) for request in requests}
        for request in requests:
            self._needed[request.name] = bytes_needed(request.signal)
            self._length = max(self._length, self._needed[request.name])
            high = min(request.raw_high, highest_reading(request.signal) if rules.is_j1939 else math.inf)
            read, limits = raw_reader(request.signal), (request.raw_low, high)
            row = (request.name, read, *limits, request.scale, request.offset, request.target_unit)
            self._rows_of(request).append(row)

    @property
    def lost(self) -> int:
        """Samples that are known to be lost."""
        return self._lost + sum(group.lost for group in self._groups.values())

    def take(self, data: bytes | bytearray, time: float) -> list[Sample]:
        """The samples of a frame of ``time`` (s); none if it is corrupted or repeats the last one."""
        is_short = len(data) < self._length
        if (is_short and not self._is_of_use(data)) or (self._checksum is not None and not self._checksum(data)):
            return self._reject(data, time)
        lost: int | None
        if self._counter is None or len(data) < self._counter.needed:
            lost = self.periods.lost_before(time)
        else:
            lost = self._counter.lost_before(data, time, self.periods)
        if lost is None:
            self.bad += 1
            return NO_SAMPLES
        if lost:
            self._lost += lost * len(self._rows)
        rows = self._rows if not self._groups else self._rows + self._multiplexed_rows(data, time)
        if is_short:
            if self._counter is not None and len(data) < self._counter.needed:
                self._counter.note_corrupted()
            rows, missing = self._split_rows(data, rows, time)
        samples = [
            Sample(name, time, scale * raw + offset)
            if low <= (raw := read(data)) <= high
            else self._no_reading((name, read, low, high, scale, offset, unit), time, raw)
            for name, read, low, high, scale, offset, unit in rows
        ]
        if is_short:
            samples += [Sample(name, time, NO_READING) for name in missing]
        self.received += len(samples)
        return samples

    def warnings(self, now: float, begun: float, *, unused: bool = True, hint: str = "") -> list[str]:
        """What is wrong at ``now`` (s), a line each; listening began at ``begun`` (s).

        With ``unused`` also what came lately and could not be used. ``hint`` is why nothing may come.
        """
        if self.periods.last is None and not self._rejections:
            waited = now - begun
            limit = max(MIN_WAIT, WAIT_PERIODS * (self._declared_period or self._database_period))
            return [f"{self.title} has not come once in {waited:.1f} s{hint}"] if waited > limit else []
        rejections = self._rejections.values() if unused else ()
        lines = [line for rejection in rejections for line in rejection.warnings(now, self.title)]
        if self._counter is not None and self._counter.is_random:
            lines.append(self._random_counter(self._counter))
        if self._counter is not None and self._counter.repeated >= MIN_STUCK_FRAMES:
            lines.append(self._stuck_counter(self._counter))
        elif (silence := self.periods.silence(now)) is not None:
            lines.append(f"{self.title} silent for {silence:.1f} s; {self.periods.describe()}")
        else:
            lines += self._silent_groups(now, begun)
        return lines

    def describe(self) -> list[str]:
        """What is read, and what the frames are checked against, a line each."""
        rules = []
        if self._counter is not None:
            rules.append(f"counted by {self._counter.name}")
        if self._checksum is not None:
            rules.append("with a checksum")
        if self._declared_period is not None:
            rules.append(f"every {period_text(self._declared_period)}")
        checks = [f"frames {self.title} are {', '.join(rules)}"] if rules else []
        return [*(request.describe() for request in self.requests), *checks]

    def _rows_of(self, request: SignalRequest) -> list[Row]:
        """The rows that are read under the same condition as ``request``."""
        switches = _multiplexers(request.message, request.signal)
        if not switches:
            return self._rows
        key = tuple((switch.name, values) for switch, values in switches)
        if key not in self._groups:
            when = " and ".join(f"{switch.name} = {_few(values)}" for switch, values in switches)
            condition = tuple((raw_reader(switch), values) for switch, values in switches)
            needed = max(bytes_needed(switch) for switch, _ in switches)
            self._groups[key] = _MultiplexedGroup(f"{self.title} with {when}", condition, needed)
        return self._groups[key].rows

    def _multiplexed_rows(self, data: bytes | bytearray, time: float) -> list[Row]:
        """The rows that a frame of ``time`` (s) has because of its multiplexers; counts what they have lost."""
        rows: list[Row] = []
        for group in self._groups.values():
            if group.is_in(data):
                group.lost += group.periods.lost_before(time) * len(group.rows)
                rows += group.rows
        return rows

    def _is_of_use(self, data: bytes | bytearray) -> bool:
        """Whether a frame that is too short has a wanted signal; without the bytes of its checksum it has none."""
        return self._checksum is None and any(needed <= len(data) for needed in self._needed.values())

    def _split_rows(self, data: bytes | bytearray, rows: list[Row], time: float) -> tuple[list[Row], list[str]]:
        """The rows of which the bytes are in a frame that is too short, and the names of the others, counted."""
        within = [row for row in rows if self._needed[row[0]] <= len(data)]
        missing = [row[0] for row in rows if row not in within]
        what = f"without {', '.join(missing)}" if missing else "with all signals that are read"
        short = f"a frame of {len(data)} bytes instead of {self._length}, {what}"
        self._rejections["short"].note(short, time)
        self.bad += len(missing)
        return within, missing

    @property
    def rejections(self) -> list[PassingFault]:
        """Frames and values that could not be used, by their kind."""
        return list(self._rejections.values())

    def _no_reading(self, row: Row, time: float, raw: float) -> Sample:
        name, _, low, high, scale, offset, unit = row
        first, last = sorted((scale * low + offset, scale * high + offset))
        why = f"is out of its range from {first:.6g} to {last:.6g} {unit}"
        if not math.isfinite(raw) or abs(raw) >= high >= MAX_VALUE / max(1.0, abs(scale)):
            why = "is no number"
        if name in self._standard and (meaning := fault_of(raw, self._standard[name])):
            self._count_rejection(name, time, f"{name} {meaning} (raw number 0x{int(raw):X})")
            return Sample(name, time, NO_READING)
        if raw in self._named[name]:
            why = f"is no reading: its raw number {raw:g} is {self._named[name][int(raw)]!r} in the database"
        self._count_rejection(name, time, f"{name} of {scale * raw + offset:.6g} {unit} {why}")
        return Sample(name, time, NO_READING)

    def _reject(self, data: bytes | bytearray, time: float) -> list[Sample]:
        if len(data) < self._length:
            self._count_rejection("short", time, f"a frame of {len(data)} bytes instead of {self._length}")
        else:
            self._count_rejection("checksum", time, "a frame with a wrong checksum")
        if self._counter is None:
            self._lost += self.periods.lost_before(time) * len(self._rows)
        else:
            self._counter.note_corrupted()
        return NO_SAMPLES

    def _count_rejection(self, kind: str, time: float, text: str) -> None:
        self.bad += 1
        self._rejections[kind].note(text, time)

    def _random_counter(self, counter: FrameCounter) -> str:
        name = self.title.split()[0]
        line = f"the counter {counter.name} of {self.title} jumps at random and is not used: it is no counter"
        return f"{line} (set driver.messages.{name}.counter = false), or two nodes send the message"

    def _stuck_counter(self, counter: FrameCounter) -> str:
        line = f"the counter {counter.name} of {self.title} has not changed for {counter.repeated} frames"
        if counter.declared:
            return line
        return f"{line}; if it is no counter, set driver.messages.{self.title.split()[0]}.counter = false"

    def _silent_groups(self, now: float, begun: float) -> list[str]:
        lines = []
        for group in self._groups.values():
            waited = now - begun
            if (silence := group.periods.silence(now)) is not None:
                lines.append(f"{group.title} silent for {silence:.1f} s; {group.periods.describe()}")
            elif group.periods.last is None and waited > max(
                MIN_WAIT, GROUP_WAIT_PERIODS * (self.periods.period or 0.0)
            ):
                lines.append(f"{group.title} has not come once in {waited:.1f} s")
        return lines


def _few(values: frozenset[int]) -> str:
    shown = sorted(values)
    return ", ".join(map(str, shown[:3])) + (" ..." if len(shown) > 3 else "")


def _multiplexers(message: Message, signal: CanSignal) -> list[tuple[CanSignal, frozenset[int]]]:
    """The multiplexers of ``signal`` with their values, outermost last; raise ConfigurationError for a circle."""
    switches: list[tuple[CanSignal, frozenset[int]]] = []
    while signal.multiplexer_signal is not None and signal.multiplexer_ids is not None:
        if len(switches) == len(message.signals):
            raise ConfigurationError(f"message {message.name}: its multiplexers depend on each other in a circle")
        switch = message.get_signal_by_name(signal.multiplexer_signal)
        switches.append((switch, frozenset(signal.multiplexer_ids)))
        signal = switch
    return switches


class FrameDecoder:
    """Decodes frames in the order of their arrival."""

    def __init__(
        self,
        readers: Mapping[int, MessageReader],
        nodes: Sequence[NodeMonitor] = (),
        warnings: Sequence[str] = (),
        groups: ParameterGroups | None = None,
        exact: ExactIdentifiers | None = None,
    ) -> None:
        """``groups`` are the keys of ``readers`` whose frames may come from any node of J1939, ``exact`` the others."""
        self.faults = BusFaults()  # What error frames report
        self.configuration_warnings = tuple(warnings)  # What is wrong with the files that describe the frames
        self._readers = dict(readers)
        self._groups = groups or None
        self._exact = exact
        self._nodes = tuple(nodes)
        self._handlers: dict[int, FrameHandler] = {
            key: handler for node in nodes for key, handler in node.handlers.items()
        }
        self._unreadable = 0
        self._own_faults = OwnFaults(log)
        self._begun: float | None = None
        self._lock = threading.Lock()  # Of all that frames change

    def begin(self, time: float) -> None:
        """Listening begins at ``time`` (s); a message that does not come from then on is reported."""
        self._begun = time

    def decode(self, frame: can.Message, time: float) -> list[Sample]:
        """The samples of ``frame``, which arrived or was true at ``time`` (s, of any clock that advances steadily).

        Never raises: a frame that cannot be used is counted.
        """
        with self._lock:
            return self._decode(frame, time)

    def _decode(self, frame: can.Message, time: float) -> list[Sample]:
        try:
            if frame.is_error_frame or frame.is_remote_frame:
                if frame.is_error_frame:
                    self.faults.note(frame, time)
                return NO_SAMPLES
            self.faults.bus_off = False
            key = frame.arbitration_id + EXTENDED if frame.is_extended_id else frame.arbitration_id
            if self._handlers and (handler := self._handlers.get(key)) is not None:
                handler(frame.data, time)
            data: bytes | bytearray = frame.data
            if self._groups is not None and key >= EXTENDED and self._groups.wants(frame.arbitration_id):
                if (message := self._groups.assembled(frame.arbitration_id, data, time)) is None:
                    return NO_SAMPLES
                key, data, time = self._groups.key(message), message.data, message.time
            reader = self._readers.get(key)
            if reader is None:
                self.note_other(frame.arbitration_id, extended=key >= EXTENDED)
            return reader.take(data, time) if reader is not None else NO_SAMPLES
        except Exception as error:  # noqa: BLE001 - no frame may end the thread
            written, identifier = getattr(frame, "data", None), getattr(frame, "arbitration_id", None)
            self._unreadable += 1
            if isinstance(written, bytes | bytearray) and isinstance(identifier, int):  # else the interface is at fault
                self._own_faults.note(error, f"decoding frame 0x{identifier:X} with data {written.hex(' ')}", time)
            return NO_SAMPLES

    def note_other(self, identifier: int, *, extended: bool) -> None:
        """Note a frame that is not decoded: it may be that of a message whose source has another address."""
        if extended and self._exact is not None:
            self._exact.note(identifier)

    @property
    def counters(self) -> Counters:
        """What has been received so far; ``reconnects`` stays 0."""
        readers, assembler = self._readers.values(), self._groups and self._groups.assembler
        with self._lock:
            broken = assembler.broken.count if assembler else 0
            return Counters(
                received=sum(reader.received for reader in readers),
                bad=sum(reader.bad for reader in readers) + self._unreadable + broken,
                # The period or the counter of a message shows overflows as well, unless it has neither.
                lost=max(sum(reader.lost for reader in readers), self.faults.overflows),
            )

    def warnings(self, now: float, *, unused: bool = True) -> list[str]:
        """What is wrong at ``now`` (s, of the clock of :meth:`decode`), a line each.

        With ``unused`` also what came lately and could not be used.
        """
        if self._begun is None:
            self._begun = now
        with self._lock:
            lines = self.faults.warnings(now) + (self._groups.warnings(now) if self._groups is not None else [])
            for key, reader in self._readers.items():
                lines += reader.warnings(now, self._begun, unused=unused, hint=self._other_sources(key))
            for node in self._nodes:
                lines += node.warnings(now)
        return lines

    def _other_sources(self, key: int) -> str:
        sources = (self._groups, self._exact)
        return "".join(known.other_sources(key) for known in sources if known is not None)

    def other_sources(self) -> str:
        """From which other addresses of J1939 the messages came, in words; empty without any."""
        with self._lock:
            return "".join(map(self._other_sources, self._readers))

    def defect(self, now: float) -> str:
        """What this program did wrong lately at ``now`` (s); empty if nothing."""
        with self._lock:
            return self._own_faults.defect(now)

    def latest_rejection(self) -> str:
        """Why the latest frame or value that was not used could not be; empty without any."""
        with self._lock:
            faults = [fault for reader in self._readers.values() for fault in reader.rejections]
            return max(faults, key=lambda fault: fault.time).text if faults else ""

    @property
    def latency(self) -> float:
        """Time by which samples come after their times, s: a message of several frames has that of its announcement."""
        return self._groups.assembler.latency if self._groups is not None and self._groups.assembler else 0.0

    def slowest_period(self) -> float | None:
        """The longest period (s) of the regular messages; None if there are none yet."""
        with self._lock:
            estimates = [reader.periods for reader in self._readers.values()]
            return max((one.period for one in estimates if one.regular and one.period is not None), default=None)

    def identifiers(self) -> list[tuple[int, bool]]:
        """The arbitration IDs that are decoded, and whether each is an extended one."""
        return [(key % EXTENDED, key >= EXTENDED) for key in sorted({*self._readers, *self._handlers})]

    def filters(self) -> list[tuple[int, int, bool]]:
        """Arbitration ID and mask of the frames that are decoded, and whether they are extended ones."""
        exact = [
            (identifier, EXTENDED - 1 if extended else STANDARD_LIMIT, extended)
            for identifier, extended in self.identifiers()
        ]
        known = [each.filters() for each in (self._groups, self._exact) if each is not None]
        return exact + [(identifier, mask, True) for filters in known for identifier, mask in filters]

    def wants(self, identifier: int, *, extended: bool) -> bool:
        """Whether frames of this arbitration ID are decoded."""
        key = identifier + EXTENDED if extended else identifier
        is_exact = key in self._readers or key in self._handlers
        return is_exact or (extended and self._groups is not None and self._groups.wants(identifier))

    def hears(self, identifier: int, *, extended: bool) -> bool:
        """Whether frames of this arbitration ID are of use: decoded, or a sign of a source with another address."""
        return any(
            is_extended == extended and not (identifier ^ wanted) & mask for wanted, mask, is_extended in self.filters()
        )

    def describe(self) -> list[str]:
        """What will be read from where, and what is wrong with the files that describe it, a line each."""
        lines = [line for reader in self._readers.values() for line in reader.describe()]
        return [*lines, *(f"warning: {line}" for line in self.configuration_warnings)]


def decoder_of(options: FrameOptions, setup: Setup) -> FrameDecoder:
    """A decoder of the signals of ``setup``; raise ConfigurationError if a source or message table does not fit."""
    databases = [load_database(setup.folder / path) for path in options.databases()]
    warnings = [line for database in databases for line in database.warnings()]
    drives = _drives(options, setup)
    frames: dict[int, _FrameContent] = {}
    for signal in setup.signals:
        request = _request(signal, databases, drives)
        content = frames.setdefault(_key(request.message), _FrameContent())
        content.requests.append(request)
        if request.message not in content.messages:
            content.messages.append(request.message)
    warnings += [line for drive in drives.values() for line in drive.warnings]
    tables = _tables_by_frame(frames, options.messages, databases, warnings)
    described = {key: content.messages[0] for key, content in frames.items() if options.j1939}
    open_sources = [(key, message) for key, message in described.items() if is_a_group(message)]
    standard = {key for key, message in described.items() if is_j1939(message)}
    if options.source_address is not None and not any(names_any_source(message) for _, message in open_sources):
        warnings.append("source_address: no signal is of a message from any source (0xFE)")
    readers = {
        key: MessageReader(
            content.messages, content.requests, _rules(content, tables.get(key, MessageTable()), key in standard)
        )
        for key, content in frames.items()
    }
    if len(warnings) > MAX_WARNINGS:
        warnings = [*warnings[:MAX_WARNINGS], f"... and {len(warnings) - MAX_WARNINGS} more"]
    groups = ParameterGroups(open_sources, options.source_address)
    one_source = [row for row in described.items() if row[1].is_extended_frame and row not in open_sources]
    monitors = [drive.monitor for drive in drives.values()]
    return FrameDecoder(readers, monitors, warnings, groups, ExactIdentifiers(one_source) if one_source else None)


@dataclass(slots=True)
class _FrameContent:
    """What is requested of one frame, and the descriptions of the frame that contain it."""

    messages: list[Message] = field(default_factory=list)
    requests: list[SignalRequest] = field(default_factory=list)

    def is_named(self, name: str) -> bool:
        """Whether ``name`` is the name of a description or the arbitration ID."""
        try:
            return int(name, 0) == self.messages[0].frame_id
        except ValueError:
            return any(message.name == name for message in self.messages)


def _key(message: Message) -> int:
    return message.frame_id + EXTENDED if message.is_extended_frame else message.frame_id


def _drives(options: FrameOptions, setup: Setup) -> dict[int, CanopenDrive]:
    """The CANopen nodes whose objects are requested."""
    nodes = sorted({signal.source.node for signal in setup.signals if signal.source.node is not None})
    sheets = {node: options.data_sheet(node) for node in nodes}
    tables = {node: tuple(table for table in options.pdo if table.node == node) for node in nodes}
    return {
        node: CanopenDrive(node, setup.folder / sheet if sheet is not None else None, tables[node])
        for node, sheet in sheets.items()
    }


def _request(signal: Signal, databases: Sequence[CanDatabase], drives: Mapping[int, CanopenDrive]) -> SignalRequest:
    if signal.source.node is not None:
        return drives[signal.source.node].request(signal)
    if signal.source.id is not None:
        return request_bits(signal)
    return request_from_databases(signal, databases)


def _tables_by_frame(
    frames: Mapping[int, _FrameContent],
    tables: Mapping[str, MessageTable],
    databases: Sequence[CanDatabase],
    warnings: list[str],
) -> dict[int, MessageTable]:
    """The table of each frame; unused ones go to ``warnings``; raise ConfigurationError for an unknown message."""
    by_frame: dict[int, MessageTable] = {}
    for name, table in tables.items():
        keys = [key for key, content in frames.items() if content.is_named(name)]
        by_frame |= dict.fromkeys(keys, table)
        if keys:
            continue
        if not any(message.name == name for database in databases for message in database.messages):
            known = nearest(name, [message.name for content in frames.values() for message in content.messages])
            text = f"no message {name!r} has a signal of [signals]: {known}"
            raise ConfigurationError(text, ("driver", "messages", name))
        warnings.append(f"driver.messages.{name}: [signals] has no signal of it")
    return by_frame


def _rules(content: _FrameContent, table: MessageTable, is_j1939: bool) -> MessageRules:
    message = content.messages[0]
    length = max(described.length for described in content.messages)
    counter, checksum, needed = None, None, 0
    if table.counter is None:
        requested = {request.signal.name for request in content.requests}
        if (signal := counter_by_name(message, requested)) is not None:
            counter = FrameCounter(signal, table.modulo, declared=False)
    elif table.counter is not False:
        signal = _signal(content, table.counter, "counter")
        counter, needed = FrameCounter(signal, table.modulo, declared=True), bytes_needed(signal)
    if table.checksum is not None:
        signal = _signal(content, table.checksum.signal, "checksum")
        needed = max(needed, bytes_needed(signal))
        try:
            checksum = checksum_test(signal, table.checksum, max(length, needed))
        except ValueError as error:
            raise ConfigurationError(str(error), ("driver", "messages", message.name, "checksum")) from error
    return MessageRules(counter, checksum, table.period, needed, is_j1939)


def _signal(content: _FrameContent, where: str | BitRange, key: str) -> CanSignal:
    """The signal or the bits ``where``; raise ConfigurationError if no description of the frame has such a signal."""
    if isinstance(where, BitRange):
        return where.as_signal(key)
    signals = {signal.name: signal for message in reversed(content.messages) for signal in message.signals}
    if where in signals:
        return signals[where]
    name = content.messages[0].name
    text = f"{name} has no signal {where!r}: {nearest(where, list(signals))}"
    raise ConfigurationError(text, ("driver", "messages", name, key))
