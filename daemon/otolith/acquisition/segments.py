"""Where one recording ends and another begins within the rows of a file: by its marks, or because time starts again."""

from collections.abc import Iterator

import numpy as np

from otolith.acquisition.window import Mask
from otolith_drivers.replay.readers import Rows

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
CONFIRMING_ROWS = 5  # rows that must continue from an earlier time, so that one wrong time is no new recording


class SegmentFinder:
    """Marks the first row of each segment; the result does not depend on how the rows are split into chunks."""

    def __init__(self, step_back: float) -> None:
        """Time starts again where it steps back by more than ``step_back`` s."""
        self._step_back = step_back
        self._held: Rows | None = None
        self._clock = -np.inf  # latest time of the present segment, s

    def mark(self, rows: Rows) -> Iterator[Rows]:
        """Yield rows with their segments marked; the last few wait for those that confirm them."""
        rows = rows if self._held is None else self._held.followed_by(rows)
        ready = len(rows.times) - CONFIRMING_ROWS
        self._held = rows if ready <= 0 else rows.part(slice(ready, None))
        if ready > 0:
            yield self._marked(rows, ready)

    def rest(self) -> Iterator[Rows]:
        """Yield the rows that still wait."""
        held, self._held = self._held, None
        if held is not None and len(held.times):
            yield self._marked(held, len(held.times))

    def _marked(self, rows: Rows, count: int) -> Rows:
        begins: Mask = rows.begins.copy()
        times, at = rows.times, 0
        while at < count:
            marks = np.flatnonzero(begins[at:count])
            until = at + int(marks[0]) if len(marks) else count
            if until == at:
                self._clock = float(times[at])
                until = at + int(marks[1]) if len(marks) > 1 else count
            clock = np.maximum.accumulate(np.maximum(times[at:until], self._clock))
            behind = np.flatnonzero(times[at:until] < clock - self._step_back)
            again = next((at + int(index) for index in behind if self._starts_again(times, at + int(index))), None)
            if again is None:
                self._clock = float(clock[-1])
                at = until
            else:
                begins[again] = True
                at = again
        return rows.part(slice(None, count), begins[:count])

    def _starts_again(self, times: np.ndarray[tuple[int], np.dtype[np.float64]], row: int) -> bool:
        """Whether the rows from ``row`` on continue from there."""
        following = times[row : row + CONFIRMING_ROWS]
        return len(following) == CONFIRMING_ROWS and bool(
            (np.diff(following) >= 0.0).all() and following[-1] - following[0] <= self._step_back
        )
