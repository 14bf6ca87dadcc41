"""SAE J1939: messages by their parameter group (PGN) whatever node sends them, and numbers that are no readings.

An identifier of 29 bits has a priority, the parameter group and the address of its source. A database gives the group,
and as its source usually 0xFE, which stands for any.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.canbus.j1939_transport import DATA, MANAGEMENT, Assembler, WholeMessage
from otolith_drivers.canbus.signals import CLASSIC_LENGTH
from otolith_drivers.errors import ConfigurationError

ANY_SOURCE = 0xFE  # the null address (SAE J1939-81), which databases give where the source is open
FIRST_BROADCAST = 240  # from this PDU format on, the PDU specific byte belongs to the group (SAE J1939-21)
GROUP_BITS, GROUP_MASK, ADDRESS_MASK = 8, 0x3FFFF, 0xFF
FIRST_NO_READING = 0xFB  # highest byte of a number: specific, reserved, error (0xFE), not available (SAE J1939-71)
NO_READER = -1
ERROR_BYTE, NOT_AVAILABLE_BYTE = 0xFE, 0xFF


def names_any_source(message: Message) -> bool:
    """Whether the identifier of ``message`` has the source address that stands for any."""
    return message.is_extended_frame and message.frame_id & ADDRESS_MASK == ANY_SOURCE


def has_several_frames(message: Message) -> bool:
    """Whether ``message`` is longer than a frame, so that it comes by the transport protocol."""
    return message.is_extended_frame and message.length > CLASSIC_LENGTH and not message.is_fd


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

    key: int
    """Of the reader of its frames."""
    title: str
    declared: int | None
    """Address of the source that the machine file or the database gives."""
    source: int | None
    """The address that is read; None until a frame came, if none is declared."""
    others: set[int] = field(default_factory=set)


class ParameterGroups:
    """Which frames of 29 bits belong to a message of a database, whatever node sends it."""

    def __init__(self, messages: Sequence[tuple[int, Message]], source: int | None) -> None:
        """``messages`` have the key of their reader; ``source`` is the address of the machine file.

        Raises:
            ConfigurationError: two messages are the same parameter group.
        """
        self._groups: dict[int, ParameterGroup] = {}
        for key, message in messages:
            declared = source if names_any_source(message) else message.frame_id & ADDRESS_MASK
            self._groups[group_of(message.frame_id)] = ParameterGroup(key, message.name, declared, declared)
        long = [group_of(message.frame_id) for _, message in messages if has_several_frames(message)]
        self.assembler = Assembler(long) if long else None
        """Of the messages of several frames; None if there are none."""
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
        return self.assembler.take(group, (source, identifier >> GROUP_BITS & ADDRESS_MASK), data, time)

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
        """Yield identifier and mask of each group."""
        for number, group in self._groups.items():
            yield filter_of(number, group.declared)
        if self.assembler is not None:
            yield from (filter_of(number, None) for number in (MANAGEMENT, DATA))

    def wants(self, identifier: int) -> bool:
        """Whether a frame belongs to a group, from whatever source."""
        group = group_of(identifier)
        return group in self._groups or (self.assembler is not None and group in (MANAGEMENT, DATA))

    def warnings(self, now: float) -> list[str]:
        """Return a line for each group that several nodes send although none is declared, and for lost packets."""
        lines = [] if self.assembler is None else self.assembler.broken.warnings(now)
        return lines + [
            f"{group.title} (PGN {number}) comes from the addresses 0x{group.source:02X}, which is used, and "
            f"{', '.join(f'0x{other:02X}' for other in sorted(group.others))}: set source_address in [driver]"
            for number, group in list(self._groups.items())
            if group.others and group.source is not None and group.declared is None
        ]
