"""Numbers in Modbus registers: the types, the four orders of their bytes, and fields of bits.

A register has 16 bits, high byte first on the wire (Modbus Application Protocol V1.1b3, section 4.2). Where a number
takes several, the standard is silent, so every order is met. They are written as telegraf writes them, by where the
bytes A (highest) to D (lowest) of a number of 32 bits stand; numbers of 64 bits follow the same rule.
"""

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

TypeName = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
ORDERS: tuple[Order, ...] = get_args(Order)
WORDS_SWAPPED: frozenset[Order] = frozenset({"CDAB", "DCBA"})
"""The lowest register comes first."""
BYTES_SWAPPED: frozenset[Order] = frozenset({"BADC", "DCBA"})
"""In each register."""

LETTERS: dict[TypeName, str] = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
"""Of each type the letter by which ``struct`` knows it."""
BITS = re.compile(r"(\d{1,2})(?:\.\.(\d{1,2}))?")


def registers_of(kind: TypeName) -> int:
    """How many registers a number takes."""
    return struct.calcsize(f">{LETTERS[kind]}") // 2


def is_float(kind: TypeName) -> bool:
    """Whether it is a number with an exponent."""
    return kind.startswith("float")


def orders_of(kind: TypeName) -> tuple[Order, ...]:
    """The orders that differ for a number of this type: one register has no order of words."""
    return ORDERS if registers_of(kind) > 1 else ("ABCD", "BADC")


def reader(kind: TypeName, order: Order) -> Callable[[Sequence[int]], float]:
    """A function from the registers of a number (each 0 to 65535, in the order of their addresses) to the number."""
    count = registers_of(kind)
    words = struct.Struct(f"{'<' if order in BYTES_SWAPPED else '>'}{count}H")
    number = struct.Struct(f">{LETTERS[kind]}")
    backwards = order in WORDS_SWAPPED

    def read(registers: Sequence[int]) -> float:
        found: float = number.unpack(words.pack(*(registers[::-1] if backwards else registers)))[0]
        return found

    return read


@dataclass(frozen=True, slots=True)
class Bits:
    """Some bits of an integer, the lowest counted as 0."""

    low: int
    high: int

    def of(self, value: float) -> int:
        """The number that the bits of ``value`` make."""
        return (int(value) >> self.low) & ((1 << (self.high - self.low + 1)) - 1)


def bits(written: str, kind: TypeName) -> Bits:
    """``"3"`` or ``"4..7"`` understood.

    Raises:
        ValueError: malformed, upside down, of a float, or beyond the number's bits.
    """
    match = BITS.fullmatch(written.strip())
    if match is None:
        raise ValueError(f'bits {written!r}: write one bit like "3", or the lowest and highest like "4..7"')
    low, high = int(match[1]), int(match[2] or match[1])
    width = 16 * registers_of(kind)
    if is_float(kind) or not low <= high < width:
        allowed = "none, as it has no bits of its own" if is_float(kind) else f"0 to {width - 1}, the lower one first"
        raise ValueError(f"bits {written!r}: of {kind} there are {allowed}")
    return Bits(low, high)
