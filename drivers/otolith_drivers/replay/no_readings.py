"""Numbers of a table that are no readings: those beyond a stated range, and sentinels as -9999 or the largest integer.

Loggers and drives write a sentinel where they have no value. It is one of few numbers, and far from all readings, so
it is none that a signal passes. Commands jump, so for an input it must be far from its ordinary range as well.
"""

import math
from collections import Counter

import numpy as np

from otolith_drivers.errors import counted
from otolith_drivers.replay.readers import Array, Mask

# Values, units, origins and guarding tests: docs/reference/thresholds-replay.md.
ENDS_OF_INTEGERS = frozenset({"32767", "32768", "65535", "2147483647", "2147483648", "4294967295"})
NINES = frozenset({"999", "9999", "99999", "999999", "9999999", "99999999", "99925"})
MIN_NINES = 999.0
BEYOND_MACHINES = 1e9
MAX_SENTINELS = 4
SENTINEL_DISTANCE = 2.0
MIN_LEVELS = 20

Range = tuple[float, float]


def is_sentinel_number(value: float) -> bool:
    """Whether loggers and drives write this number where they have no value; integers with any decimal factor."""
    size = abs(value)
    digits = f"{size:.11e}".partition("e")[0].replace(".", "").rstrip("0")
    return size >= BEYOND_MACHINES or digits in ENDS_OF_INTEGERS or (size >= MIN_NINES and digits in NINES)


class NoReadings:
    """Those of one column, whose numbers come part by part."""

    def __init__(self, stated: Range | None = None, ordinary: Range | None = None) -> None:
        """Numbers beyond ``stated`` are no readings; without it, sentinels. ``ordinary`` is the range of an input."""
        self._stated, self._ordinary = stated, ordinary
        self._low, self._high, self._levels = math.inf, -math.inf, 0  # of the readings so far
        self._beyond, self._sentinels = 0, Counter[float]()

    def among(self, numbers: Array) -> Mask:
        """Return which of the next ``numbers`` (n,) are no readings, and count them; NaN stands for a blank cell."""
        if self._stated is not None:
            beyond: Mask = (numbers < self._stated[0]) | (numbers > self._stated[1])
            self._beyond += int(np.count_nonzero(beyond))
            return beyond
        sentinels = self._sentinels_among(numbers[np.isfinite(numbers)])
        refused: Mask = np.isin(numbers, sentinels)
        if sentinels:
            self._sentinels.update(numbers[refused].tolist())
        return refused

    def _sentinels_among(self, readings: Array) -> list[float]:
        """Return the sentinels of ``readings``, all finite; the other readings become known."""
        candidates = list[float]()
        for end in (np.min, np.max):
            for _ in range(MAX_SENTINELS):
                if not len(readings) or not is_sentinel_number(value := float(end(readings))):
                    break
                candidates.append(value)
                readings = readings[readings != value]
        if len(readings):
            self._low, self._high = min(self._low, float(readings.min())), max(self._high, float(readings.max()))
            if self._levels < MIN_LEVELS:
                self._levels = max(self._levels, len(np.unique(readings)))
        if self._levels == 0 or (self._ordinary is None and self._levels < MIN_LEVELS):
            return []
        low, high = self._ordinary or (self._low, self._high)
        low, high = min(low, self._low), max(high, self._high)
        distance = SENTINEL_DISTANCE * (high - low)
        return [value for value in candidates if not low - distance <= value <= high + distance]

    def warnings(self, name: str) -> list[str]:
        """Return what was left out of the column of a signal, a line each."""
        remedy = f"write {name} = {{ range = [lowest, highest] }} under [signals] if it is one"
        lines = [
            f"{name}: {value:.12g} in {counted(count, 'cell')} is no reading and left out: {remedy}"
            for value, count in sorted(self._sentinels.items())
        ]
        if self._stated is not None and self._beyond:
            lines.append(f"{name}: {counted(self._beyond, 'cell')} beyond its range {list(self._stated)}, left out")
        return lines
