"""What every reader gives: rows of numbers, and the count of what could not become one."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]

LATEST = 1e11  # s; a time beyond is in another unit, or wrong


@dataclass(frozen=True, slots=True)
class Rows:
    """A stretch of recorded data, in the order of the file."""

    times: Array
    """(rows,) s, finite."""
    columns: dict[str, Array]
    """(rows,) of each signal in its unit, not a number where there is no reading."""
    lines: Integers
    """(rows,) numbers of their lines, frames or records, from 1."""
    bad: Integers
    """(rows,) how much of the file was bad up to and with each row."""
