"""Recorded windows in real time: each comes when it would have ended."""

import time
from collections.abc import Callable

from otolith.acquisition.playback import OUTAGE
from otolith.acquisition.window import Window

TICK = 0.1  # s; how late a stop can be noticed


class Pace:
    """The data's clock beside the computer's. A long silence is passed over here, too."""

    def __init__(self, stopped: Callable[[], bool]) -> None:
        self._stopped = stopped
        self._ahead: float | None = None  # s; how far the computer's clock is ahead of the data's
        self._end = 0.0

    def wait(self, window: Window) -> None:
        """Until the end of ``window``, or until it is stopped."""
        length = window.end - window.start
        if self._ahead is None:
            self._ahead = time.monotonic() - window.start
        elif window.start - self._end > OUTAGE * length:
            self._ahead -= window.start - self._end
        self._end = window.end
        while (left := window.end + self._ahead - time.monotonic()) > 0.0 and not self._stopped():
            time.sleep(min(left, TICK))
