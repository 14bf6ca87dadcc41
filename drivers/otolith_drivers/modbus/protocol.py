"""Numbers in Modbus registers: the types, the four orders of their bytes, and fields of bits.

A register has 16 bits, high byte first on the wire (Modbus Application Protocol V1.1b3, section 4.2). Where a number
takes several, the standard is silent, so every order is met. They are written as telegraf writes them, by where the
bytes A (highest) to D (lowest) of a number of 32 bits stand; numbers of 64 bits follow the same rule.

How a reading of registers can fail: the device says no, nobody answers, or the line is broken.
"""

import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
GATEWAY_CODES = (10, 11)


class Refused(Exception):  # noqa: N818 - what the device has done, said in the words of the field
    """The device answers that it does not want to.

    Example scenarios: registers that it does not have, more of them than it gives at once, busy.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code


class Silent(Exception):  # noqa: N818
    """No answer, or none to the question, in time; the line itself stands.

    Example scenarios: device switched off, wrong device number, wrong baud rate, a late answer to an earlier question.
    """


class Broken(Exception):  # noqa: N818
    """The line is gone.

    Example scenarios: connection refused or closed, host unreachable, serial adapter pulled out.
    """


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
class RegisterBits:
    """Some bits of an integer, the lowest counted as 0."""

    low: int
    high: int

    def of(self, value: float) -> int:
        """The number that the bits of ``value`` make."""
        return (int(value) >> self.low) & ((1 << (self.high - self.low + 1)) - 1)


def bits(written: str, kind: TypeName) -> RegisterBits:
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
    return RegisterBits(low, high)
