"""Taking one signal out of the bytes of a frame, as fast as plain Python can.

The layout is that of a :class:`cantools.database.Signal`, wherever that came from: a database, a line of the machine
file or the object dictionary of a drive. What comes out is the raw number; scales, ranges and units come later.
"""

import struct
from collections.abc import Callable

from cantools.database import Signal

FLOATS = {16: "e", 32: "f", 64: "d"}
INTEGERS = {8: "b", 16: "h", 32: "i", 64: "q"}
ORDERS = {"little_endian": "<", "big_endian": ">"}

Field = Callable[[bytes | bytearray], float]
"""From the data of a frame that is long enough (see :func:`bytes_needed`) to the raw number."""


def bytes_needed(signal: Signal) -> int:
    """How long a frame must be to hold ``signal``."""
    return (_first_bit(signal) + signal.length + 7) // 8


def field(signal: Signal) -> Field:
    """How to read ``signal``.

    Raises:
        ValueError: a floating-point number of a length that there is not, or nothing to be read.
    """
    if signal.length < 1 or signal.start < 0:
        raise ValueError(f"{signal.length} bits from bit {signal.start} are no signal")
    if signal.is_float and signal.length not in FLOATS:
        raise ValueError(f"a floating-point number has 16, 32 or 64 bits, not {signal.length}")
    return _whole_bytes(signal) or _any_bits(signal)


def _first_bit(signal: Signal) -> int:
    """Counted from the first bit of the frame in the order of the signal's bytes."""
    if signal.byte_order == "little_endian":
        return signal.start
    return 8 * (signal.start // 8) + 7 - signal.start % 8


def _whole_bytes(signal: Signal) -> Field | None:
    """What the processor has a type for is unpacked at once."""
    codes = FLOATS if signal.is_float else INTEGERS
    place, odd = divmod(_first_bit(signal), 8)
    if odd or signal.length not in codes:
        return None
    code = codes[signal.length]
    code = code if signal.is_float or signal.is_signed else code.upper()
    unpack = struct.Struct(ORDERS[signal.byte_order] + code).unpack_from

    def read(data: bytes | bytearray) -> float:
        value: float = unpack(data, place)[0]
        return value

    return read


def _any_bits(signal: Signal) -> Field:
    """Everything else by shifts of the whole frame as one integer."""
    first, mask = _first_bit(signal), (1 << signal.length) - 1
    end = bytes_needed(signal)
    order = "little" if signal.byte_order == "little_endian" else "big"
    shift = first if order == "little" else 8 * end - first - signal.length
    from_bytes = int.from_bytes

    def unsigned(data: bytes | bytearray) -> int:
        return (from_bytes(data[:end], order) >> shift) & mask  # type: ignore[arg-type]

    if signal.is_float:
        size, unpack = signal.length // 8, struct.Struct("<" + FLOATS[signal.length]).unpack
        return lambda data: float(unpack(unsigned(data).to_bytes(size, "little"))[0])
    if not signal.is_signed:
        return unsigned
    sign = 1 << (signal.length - 1)
    return lambda data: (unsigned(data) ^ sign) - sign
