"""SAE J1939: messages by their parameter group (PGN) whatever node sends them, and numbers that are no readings.

An identifier of 29 bits has a priority, the parameter group and the address of its source. A database gives the group,
and as its source usually 0xFE, which stands for any.

A message of 9 to 1785 bytes comes in several frames (SAE J1939-21): a node announces size and group to all nodes (BAM),
or to one that then controls the transfer (RTS, CTS), and sends packets of 7 bytes.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, cast

from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.canbus.options import CLASSIC_LENGTH
from otolith_drivers.common.reconnection import PassingFault
from otolith_drivers.errors import ConfigurationError

ANY_SOURCE = 0xFE  # the null address (SAE J1939-81), which databases give where the source is open
FIRST_BROADCAST = 240  # from this PDU format on, the PDU specific byte belongs to the group (SAE J1939-21)
GROUP_BITS, GROUP_MASK, ADDRESS_MASK = 8, 0x3FFFF, 0xFF
FIRST_NO_READING = 0xFB  # highest byte of a number: specific, reserved, error (0xFE), not available (SAE J1939-71)
NO_READER = -1
ERROR_BYTE, NOT_AVAILABLE_BYTE = 0xFE, 0xFF
MANAGEMENT, DATA = 0xEC00, 0xEB00  # the parameter groups of the protocol
RTS, CTS, END, BAM, ABORT = 16, 17, 19, 32, 255  # what a frame of connection management is, by its first byte
PACKET_BYTES, MIN_BYTES, MAX_BYTES = 7, 9, 1785
MAX_SHOWN = 5  # addresses in a line
MAX_PAUSE = 1.25  # s between two frames of a transfer: the longest timeout of the standard (T2, T3)


NodePair = tuple[int, int]  # Addresses of the node that sends a frame, and of that for which it is


class WholeMessage(NamedTuple):
    """A message of several frames."""

    group: int
    source: int
    data: bytes | bytearray
    time: float  # Of its announcement, s: the data are of then


@dataclass(slots=True)
class _Transfer:
    group: int
    size: int
    begun: float
    latest: float  # s; time of its last frame
    data: bytearray = field(default_factory=bytearray)  # Of the packets so far


class Assembler:
    """Puts the packets of each sender together; a message of which a packet is missing is dropped and counted."""

    def __init__(self, groups: Collection[int]) -> None:
        """Only messages of these parameter groups are put together."""
        self.broken = PassingFault()  # Messages that were announced and are incomplete
        self.latency = 0.0  # s from the announcement of the latest message to its last frame
        self._groups = frozenset(groups)
        self._transfers: dict[NodePair, _Transfer] = {}

    def take_frame(self, identifier: int, data: bytes | bytearray, time: float) -> WholeMessage | None:
        """Take a frame of any group; see :meth:`take`."""
        pair = identifier & ADDRESS_MASK, identifier >> GROUP_BITS & ADDRESS_MASK
        return self.take(group, pair, data, time) if (group := group_of(identifier)) in (MANAGEMENT, DATA) else None

    def take(self, group: int, pair: NodePair, data: bytes | bytearray, time: float) -> WholeMessage | None:
        """Take a frame of the protocol, and return the message that it completes."""
        if len(data) < 1 + PACKET_BYTES:
            return None
        if group == MANAGEMENT:
            self._manage(pair, data, time)
            return None
        if (transfer := self._transfers.get(pair)) is None:
            return None  # of another group, or it began before listening did
        following = len(transfer.data) // PACKET_BYTES + 1
        if data[0] != following or time - transfer.latest > MAX_PAUSE:
            self._drop(pair, time)
            return None
        transfer.data += data[1 : 1 + PACKET_BYTES]
        transfer.latest = time
        if len(transfer.data) < transfer.size:
            return None
        del self._transfers[pair]
        self.latency = time - transfer.begun
        return WholeMessage(transfer.group, pair[0], bytes(transfer.data[: transfer.size]), transfer.begun)

    def _manage(self, pair: NodePair, data: bytes | bytearray, time: float) -> None:
        back = pair[1], pair[0]  # of the transfer that a receiver controls
        kind, group = data[0], int.from_bytes(data[5:8], "little")
        if kind in (BAM, RTS):
            self._drop(pair, time)
            size = int.from_bytes(data[1:3], "little")
            is_possible = MIN_BYTES <= size <= MAX_BYTES and data[3] == -(-size // PACKET_BYTES)
            if group in self._groups and is_possible:
                self._transfers[pair] = _Transfer(group, size, time, time)
        elif kind == CTS:  # from the receiver, who may ask for packets again, or (for 0 packets) to wait
            transfer, known = self._transfers.get(back), PACKET_BYTES * (data[2] - 1)
            if transfer is not None and data[1] and not 0 <= known <= len(transfer.data):
                self._drop(back, time)
            elif transfer is not None:
                transfer.latest = time
                del transfer.data[known if data[1] else len(transfer.data) :]
        elif kind in (END, ABORT):
            self._drop(back, time)
            self._drop(pair, time)

    def _drop(self, pair: NodePair, time: float) -> None:
        if self._transfers.pop(pair, None) is not None:
            self.broken.note("a message of several frames is incomplete", time)


def names_any_source(message: Message) -> bool:
    """Whether the identifier of ``message`` has the source address that stands for any."""
    return message.is_extended_frame and message.frame_id & ADDRESS_MASK == ANY_SOURCE


def has_several_frames(message: Message) -> bool:
    """Whether ``message`` is longer than a frame, so that it comes by the transport protocol."""
    return message.is_extended_frame and message.length > CLASSIC_LENGTH and not message.is_fd


def is_a_group(message: Message) -> bool:
    """Whether ``message`` is read by its parameter group, not by its identifier."""
    return names_any_source(message) or has_several_frames(message)


def is_j1939(message: Message) -> bool:
    """Whether the highest numbers of ``message`` are those that the standard reserves."""
    return is_a_group(message) or (message.is_extended_frame and message.protocol == "j1939")


def group_of(identifier: int) -> int:
    """Return the PGN of an identifier of 29 bits."""
    group = identifier >> GROUP_BITS & GROUP_MASK
    return group if (group >> 8 & 0xFF) >= FIRST_BROADCAST else group & ~0xFF


def filter_of(group: int, source: int | None) -> tuple[int, int]:
    """Return identifier and mask of the frames of a group, from ``source`` or from any."""
    mask = GROUP_MASK if (group >> 8 & 0xFF) >= FIRST_BROADCAST else GROUP_MASK & ~0xFF
    exact = 0 if source is None else ADDRESS_MASK
    return group << GROUP_BITS | (source or 0), mask << GROUP_BITS | exact


def highest_reading(signal: CanSignal) -> float:
    """Return the highest raw number that is a reading; infinite if the standard reserves none of its numbers."""
    if signal.conversion.is_float or signal.is_signed or signal.length < 2:
        return float("inf")
    if signal.length < 8:  # a state: the two highest are error and not available
        return float(2**signal.length - 3)
    return float((FIRST_NO_READING << (signal.length - 8)) - 1)


def highest_value(message: Message, signal: CanSignal) -> float:
    """Return the highest value that is a reading, in the unit of the database; infinite if none is reserved."""
    if not is_j1939(message):
        return float("inf")
    return cast("float", signal.raw_to_scaled(highest_reading(signal), decode_choices=False))


def fault_of(raw: float, signal: CanSignal) -> str:
    """Return what a raw number above :func:`highest_reading` means; empty for one that is not above."""
    if raw <= highest_reading(signal):
        return ""
    if signal.length < 8:
        return "is not available" if raw == 2**signal.length - 1 else "reports an error"
    top = int(raw) >> (signal.length - 8)
    meanings = {ERROR_BYTE: "reports an error", NOT_AVAILABLE_BYTE: "is not available"}
    return meanings.get(top, "is a reserved number")


@dataclass(slots=True)
class ParameterGroup:
    """The sources of a parameter group, of which one is read."""

    key: int  # Of the reader of its frames
    title: str
    declared: int | None  # Address of the source that the machine file or the database gives
    source: int | None  # The address that is read; None until a frame came, if none is declared
    others: set[int] = field(default_factory=set)


class ParameterGroups:
    """Which frames of 29 bits belong to a message of a database, whatever node sends it."""

    def __init__(self, messages: Sequence[tuple[int, Message]], source: int | None) -> None:
        """``messages`` with readers' keys, ``source`` of the file; raise ConfigurationError if two are of one group."""
        self._groups: dict[int, ParameterGroup] = {}
        for key, message in messages:
            declared = source if names_any_source(message) else message.frame_id & ADDRESS_MASK
            self._groups[group_of(message.frame_id)] = ParameterGroup(key, message.name, declared, declared)
        long = [group_of(message.frame_id) for _, message in messages if has_several_frames(message)]
        self.assembler = Assembler(long) if long else None  # Of the messages of several frames, if any
        if len(self._groups) < len(messages):
            names = ", ".join(message.name for _, message in messages)
            raise ConfigurationError(f"of {names}, two have the same parameter group: read signals of one of them")

    def __bool__(self) -> bool:
        return bool(self._groups)

    def assembled(self, identifier: int, data: bytes | bytearray, time: float) -> WholeMessage | None:
        """Return the message that a frame is, or completes; None for a frame of another group or source."""
        group, source = group_of(identifier), identifier & ADDRESS_MASK
        if self.assembler is None or group not in (MANAGEMENT, DATA):
            return WholeMessage(group, source, data, time) if group in self._groups else None
        return self.assembler.take_frame(identifier, data, time)

    def key(self, message: WholeMessage) -> int:
        """Return the key of the reader of a message; ``NO_READER`` if another source is read."""
        group = self._groups[message.group]
        if group.source is None:
            group.source = message.source
        if message.source != group.source:
            group.others.add(message.source)
            return NO_READER
        return group.key

    def filters(self) -> Iterator[tuple[int, int]]:
        """Yield identifier and mask of each group, from any source, so that one that is not declared is named."""
        for number in self._groups:
            yield filter_of(number, None)
        if self.assembler is not None:
            yield from (filter_of(number, None) for number in (MANAGEMENT, DATA))

    def wants(self, identifier: int) -> bool:
        """Whether a frame belongs to a group, from whatever source."""
        group = group_of(identifier)
        return group in self._groups or (self.assembler is not None and group in (MANAGEMENT, DATA))

    def other_sources(self, key: int) -> str:
        """Return from which addresses the group of a reader came that are not read, in words; empty without any."""
        found = [(number, group) for number, group in self._groups.items() if group.key == key and group.others]
        return "".join(
            f"; {_from_addresses(number, group.others)} instead of 0x{group.declared or 0:02X}: "
            f"is source_address in [driver] right, or the identifier in the database?"
            for number, group in found
        )

    def warnings(self, now: float) -> list[str]:
        """Return a line for each group that several nodes send although none is declared, and for lost packets."""
        lines = [] if self.assembler is None else self.assembler.broken.warnings(now)
        return lines + [
            f"{group.title} (PGN {number}) comes from the addresses 0x{group.source:02X}, which is used, and "
            f"{', '.join(f'0x{other:02X}' for other in sorted(group.others))}: set source_address in [driver]"
            for number, group in self._groups.items()
            if group.others and group.source is not None and group.declared is None
        ]


class ExactIdentifiers:
    """Messages that are read from one identifier, and the other addresses from which their parameter groups came."""

    def __init__(self, messages: Sequence[tuple[int, Message]]) -> None:
        """``messages`` have 29 bits and readers' keys."""
        self._marked = [message.frame_id for _, message in messages if message.protocol == "j1939"]
        self._groups = {key: group_of(message.frame_id) for key, message in messages}
        self._others: dict[int, set[int]] = {group: set() for group in self._groups.values()}

    def note(self, identifier: int) -> None:
        """Note a frame of 29 bits that no reader takes."""
        if (others := self._others.get(group_of(identifier))) is not None:
            others.add(identifier & ADDRESS_MASK)

    def filters(self) -> Iterator[tuple[int, int]]:
        """Yield identifier and mask of the groups that the database marks as J1939, from any source."""
        yield from (filter_of(group_of(identifier), None) for identifier in self._marked)

    def other_sources(self, key: int) -> str:
        """Return from which other addresses the group of a reader came, in words; empty without any."""
        group = self._groups.get(key)
        if group is None or not self._others[group]:
            return ""
        return (
            f"; {_from_addresses(group, self._others[group])} instead of 0x{key & ADDRESS_MASK:02X}: "
            "if these are its readings, write 0xFE as the last byte of its identifier in the database, "
            "and the address as source_address in [driver]"
        )


def _from_addresses(group: int, addresses: Collection[int]) -> str:
    shown = sorted(addresses)[:MAX_SHOWN]
    more = f" and {len(addresses) - len(shown)} more" if len(addresses) > len(shown) else ""
    return f"PGN {group} comes from address {', '.join(f'0x{address:02X}' for address in shown)}{more}"
