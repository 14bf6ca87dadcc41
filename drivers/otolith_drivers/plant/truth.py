"""What is true of a simulated machine, as a CSV file for whoever compares."""

import csv
import time
from pathlib import Path

from otolith_drivers.errors import ServiceError
from otolith_drivers.plant.pace import Turn

EVERY = 10  # ticks


class TruthFile:
    """Parameters and states without noise over Unix time ``t`` (s)."""

    def __init__(self, path: Path) -> None:
        """Begin the file.

        Raises:
            ServiceError: it cannot be written.
        """
        try:
            self._file = path.open("w", encoding="utf-8", newline="", buffering=1)
        except OSError as error:
            raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = csv.writer(self._file)

    def note(self, turn: Turn) -> None:
        """A line for every tenth tick, whatever the bus made of it."""
        if turn.index % EVERY:
            return
        if turn.index == 0:
            self._writer.writerow(["t", *turn.tick.truth])
        moment = time.time() - time.monotonic() + turn.lived
        self._writer.writerow([f"{moment:.4f}", *(f"{value:.9g}" for value in turn.tick.truth.values())])

    def close(self) -> None:
        """End the file."""
        self._file.close()
