"""When a process hangs: by the processor time that it takes, whatever else this computer does.

A process on a busy computer gets little processor time, and its work takes long. One that computes for ever takes
processor time; one that waits for ever takes none.
"""

import time
from contextlib import suppress

# Threshold: docs/reference/thresholds-runtime.md has its origin.
MAX_TURN = 1.0  # s without processor time, beyond which a process waits for something else than its turn
TICK = 0.01  # s; a process that waits computes less in ``MAX_TURN``, whatever its libraries do meanwhile


def processor_time(pid: int) -> float:
    """Return the processor time that a process of this computer has taken, s, in whole ``TICK``; 0 if there is none."""
    with suppress(OSError):  # clock_getcpuclockid(3): the number of its clock on Linux
        return time.clock_gettime((~pid << 3) | 2) // TICK * TICK
    return 0.0


class Effort:
    """The time that counts since the begin of some work: that of the processor, and that of waiting without any.

    ``now`` is monotonic time, s. ``spent`` is the processor time of the process that runs now, s: if it becomes
    smaller, another process has taken its place.
    """

    def __init__(self) -> None:
        self._counted = self._spent = self._advanced_at = self._seen_at = 0.0

    def begin(self, now: float, spent: float) -> None:
        """Count from ``now`` on."""
        self._counted, self._spent, self._advanced_at, self._seen_at = 0.0, spent, now, now

    def seconds(self, now: float, spent: float) -> float:
        """Return the time that counts until ``now``, s."""
        if spent != self._spent:
            computed = spent - self._spent if spent > self._spent else spent
            self._counted += computed + self._waited(self._seen_at)
            self._spent, self._advanced_at = spent, now
        self._seen_at = now
        return self._counted + self._waited(now)

    def _waited(self, until: float) -> float:
        """Return the time since the process last computed, s; 0 if it may only wait for its turn."""
        waited = until - self._advanced_at
        return waited if waited > MAX_TURN else 0.0
