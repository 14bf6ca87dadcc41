"""What every reader gives: rows of numbers, and the count of what could not become one."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Protocol

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


class Reader(Protocol):
    """A file of recorded data, open; a context that closes it."""

    @property
    def path(self) -> Path:
        """Of the file."""

    @property
    def place(self) -> str:
        """What is numbered in it: ``line``, ``frame`` or ``record``."""

    @property
    def ignored(self) -> tuple[str, ...]:
        """Columns that nobody asked for."""

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""

    @property
    def bad(self) -> int:
        """How much came that could not be used."""

    @property
    def lost(self) -> int:
        """Samples that the file shows to have been sent, and does not hold."""

    def stretches(self) -> Iterator[Rows]:
        """All rows, some ten thousand at a time; once.

        Raises:
            ConfigurationError: none can be used, or the file is something else.
        """

    def describe(self) -> list[str]:
        """What is read from where, a line per signal."""

    def found(self) -> list[str]:
        """How much was read and what was wrong with it, in a few words each; first of what, and how much."""

    def complaints(self) -> list[str]:
        """What a user should know of the file before trusting what was made of it, a line each."""

    def __enter__(self) -> "Reader": ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
