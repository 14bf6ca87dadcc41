"""The clocks of this computer, compared: wall clock, monotonic clock, and time since its boot.

Time stamps are on the monotonic clock, which nobody sets. The wall clock may be set at any moment, so it is only read
together with another one.
"""

import time
from collections.abc import Callable

CLOCK_TRIES, CLOCK_PRECISION = 5, 2e-5  # s; readings of the clocks, and when one is good enough


def uptime() -> float:
    """Return the time since the boot of this computer, s. Unlike the monotonic clock it also counts a suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def clock_difference(clock: Callable[[], float], other: Callable[[], float]) -> float:
    """Return ``clock`` minus ``other`` (s): the best of several readings, since a thread may be held up in one."""
    best, precision = 0.0, float("inf")
    for _ in range(CLOCK_TRIES):
        before, reading, after = other(), clock(), other()
        if after - before < precision:
            best, precision = reading - 0.5 * (before + after), after - before
        if precision < CLOCK_PRECISION:
            break
    return best


def wall_clock_offset() -> float:
    """Return wall clock minus monotonic clock, s."""
    return clock_difference(time.time, time.monotonic)
