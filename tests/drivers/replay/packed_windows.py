"""Recordings as earlier versions wrote them: the records of a window packed, in the ``.rrd`` file itself."""

import gzip
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from otolith_drivers.replay.readers import Array, Integers
from otolith_drivers.replay.recording import HEADER

GOLDEN = Path(__file__).parents[2] / "golden" / "recordings" / "packed-samples.rrd.gz"
"""Three windows of four signals by the last version that packed them."""


def earlier_recording(path: Path) -> Path:
    """Write a recording of an earlier version, and return its path."""
    path.write_bytes(gzip.decompress(GOLDEN.read_bytes()))
    return path


def packed(times: Integers, columns: Sequence[Array], *, good: bool) -> bytes:
    """Return the records of a window; ``times`` (ns) and each column have a value for each record."""
    words = [np.diff(times, prepend=0), *(np.asarray(column, dtype="<f8").view("<i8") for column in columns)]
    content = b"".join(_transposed(word.astype("<i8", copy=False)) for word in words)
    return HEADER.pack(len(times), good) + zlib.compress(content)


def _transposed(numbers: Integers) -> bytes:
    return np.ascontiguousarray(numbers).view(np.uint8).reshape(-1, 8).T.tobytes()
