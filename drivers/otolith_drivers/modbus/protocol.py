"""Numbers in Modbus registers: types, byte orders and bit fields; and how a request can fail.

A register has 16 bits, high byte first on the wire (Modbus Application Protocol V1.1b3, section 4.2). The standard
does not define the order of the registers of a longer number, so all orders occur. They are named by the positions of
the bytes A (highest) to D (lowest) of a 32-bit number; 64-bit numbers follow the same rule.
"""

import re
import struct
from collections.abc import Callable, Sequence
from typing import Literal, get_args

# Modbus Application Protocol V1.1b3, section 7.
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, it takes longer",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
ILLEGAL_FUNCTION = 1  # Exception of a device that does not serve the function, such as reading a table that it lacks
ILLEGAL_ADDRESS = 2  # Exception for registers that the device does not have
PERMANENT_CODES = (ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, 3)  # Exceptions that a repeated request will meet again
BUSY_CODES = (5, 6)  # Exceptions that ask to repeat the request later
GATEWAY_CODES = (10, 11)  # Exceptions by which a gateway reports that the device does not answer

TypeName = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
ORDERS: tuple[Order, ...] = get_args(Order)
WORDS_SWAPPED: frozenset[Order] = frozenset({"CDAB", "DCBA"})  # Orders with the lowest register first
BYTES_SWAPPED: frozenset[Order] = frozenset({"BADC", "DCBA"})  # Orders with the low byte of each register first
LETTERS: dict[TypeName, str] = dict(zip(get_args(TypeName), "hHiIqQfd", strict=True))  # Of struct, by type
BITS = re.compile(r"(\d{1,2})(?:\.\.(\d{1,2}))?")


class ExceptionReplyError(Exception):
    """The device answers with an exception: it does not have the registers, returns fewer at once, or is busy."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code

    @property
    def meaning(self) -> str:
        """The exception's name in the standard."""
        return EXCEPTIONS.get(self.code, str(self))


class NoReplyError(Exception):
    """No valid answer arrives in time, as from a device that is off or late; the connection itself stands."""


class ConnectionLostError(Exception):
    """The connection fails: it is refused or closed, the host unreachable, or the serial adapter unplugged."""


def registers_of(kind: TypeName) -> int:
    """Return the number of registers of a number."""
    return struct.calcsize(f">{LETTERS[kind]}") // 2


def is_float(kind: TypeName) -> bool:
    """Whether the type is a float."""
    return kind.startswith("float")


def orders_of(kind: TypeName) -> tuple[Order, ...]:
    """Return the orders that differ for this type: a single register has no word order."""
    return ORDERS if registers_of(kind) > 1 else ("ABCD", "BADC")


def reader(kind: TypeName, order: Order) -> Callable[[Sequence[int]], float]:
    """Return a function from a number's registers (each 0 to 65535, in the order of addresses) to the number."""
    words = struct.Struct(f"{'<' if order in BYTES_SWAPPED else '>'}{registers_of(kind)}H")
    number = struct.Struct(f">{LETTERS[kind]}")
    backwards = order in WORDS_SWAPPED

    def read(registers: Sequence[int]) -> float:
        value: float = number.unpack(words.pack(*(registers[::-1] if backwards else registers)))[0]
        return value

    return read


def bit_reader(written: str, kind: TypeName) -> Callable[[float], int]:
    """Return a function from an integer to its bits ``"3"`` or ``"4..7"``; bit 0 is the lowest.

    Raises:
        ValueError: malformed, not ascending, a field of a float, or beyond the bits of the type.
    """
    match = BITS.fullmatch(written.strip())
    if match is None:
        raise ValueError(f'bits {written!r}: write one bit like "3", or the lowest and highest like "4..7"')
    low, high = int(match[1]), int(match[2] or match[1])
    width = 16 * registers_of(kind)
    if is_float(kind):
        raise ValueError(f"bits {written!r}: a {kind} has no bit fields")
    if not low <= high < width:
        raise ValueError(f"bits {written!r}: {kind} has bits 0 to {width - 1}; write the lower one first")
    mask = (1 << (high - low + 1)) - 1
    return lambda value: int(value) >> low & mask
