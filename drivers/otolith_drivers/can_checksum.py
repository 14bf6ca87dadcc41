"""Whether a frame is as it was sent: the checksums that makers put into their messages."""

from collections.abc import Callable
from dataclasses import dataclass

from cantools.database import Signal as CanSignal

from otolith_drivers.can_fields import Field, field
from otolith_drivers.can_options import ChecksumKind, ChecksumTable


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

    read: Field
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
