"""The records of a window as a few bytes: lossless, smaller than numbers of 64 bits, and checked when they are read.

The count of records and whether the window was good (5 bytes, little endian), then a zlib stream, which has a checksum:
the differences of the times in ns, then each signal. The bytes of equal weight of all records are next to each other,
because those of a slow signal repeat.
"""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from otolith_drivers.replay.readers import Array, Integers

MAX_RECORDS = 1_000_000  # as many as a window of a machine file may have
HEADER = struct.Struct("<I?")


def packed(times: Integers, columns: Sequence[Array], *, good: bool) -> bytes:
    """Return the records of a window; ``times`` (ns) and each column have a value for each record."""
    words = [np.diff(times, prepend=0), *(np.asarray(column, dtype="<f8").view("<i8") for column in columns)]
    content = b"".join(_transposed(word.astype("<i8", copy=False)) for word in words)
    return HEADER.pack(len(times), good) + zlib.compress(content)


def unpacked(data: bytes, signals: int) -> tuple[bool, Integers, Array]:
    """Return whether the window was good, the times in ns and the values (signals, records), bit for bit.

    Raises:
        ValueError: not the records of a window of so many signals.
    """
    if len(data) < HEADER.size:
        raise ValueError("too short")
    count, good = HEADER.unpack_from(data)
    if count > MAX_RECORDS:
        raise ValueError(f"{count} records")
    size = 8 * count * (signals + 1)
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(data[HEADER.size :], size + 1)  # the bound protects from a stream that expands
    except zlib.error as error:
        raise ValueError(str(error)) from error
    if len(content) != size or not stream.eof:
        raise ValueError(f"{len(content)} bytes instead of {size}")
    words = np.frombuffer(content, dtype=np.uint8).reshape(signals + 1, 8, count).transpose(0, 2, 1)
    numbers = np.ascontiguousarray(words).reshape(signals + 1, count * 8)
    times = np.cumsum(numbers[0].view("<i8"), dtype=np.int64)
    return good, times, numbers[1:].view("<f8").astype(np.float64).reshape(signals, count)


def _transposed(numbers: Integers) -> bytes:
    return np.ascontiguousarray(numbers).view(np.uint8).reshape(-1, 8).T.tobytes()
