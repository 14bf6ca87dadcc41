"""The clock of another computer on this computer's monotonic clock. No clock in here: every time is an argument.

The *offset* is the local minus the remote time of one moment, in s. A request is sent before its reply is stamped, and
the reply arrives after that: so each exchange gives a lower and an upper bound of the offset, and a message that was
only received gives an upper one.
"""

import math
from datetime import UTC, datetime

MAX_DRIFT = 2e-4  # s per s between two clocks, beyond the 1e-4 of two quartz oscillators
BLOCK = 10.0  # s; the fastest message of the last one or two of these gives the offset of a clock that is not asked
SET_BACK = 2.0  # s; for which a clock that is not asked must be behind to count as one that was set back


def unix_time(moment: datetime) -> float:
    """Return the seconds since 1970 of ``moment``, which is in UTC if it names no time zone."""
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)).timestamp()


class ExchangeClock:
    """The clock of a server that is asked for its time."""

    def __init__(self) -> None:
        self._low, self._high, self._time = -math.inf, math.inf, 0.0
        self.steps = 0
        """How often the clock was set."""

    @property
    def known(self) -> bool:
        """Whether there was an exchange."""
        return math.isfinite(self._low)

    @property
    def offset(self) -> float:
        """Local minus remote time in s; NaN before the first exchange."""
        return 0.5 * (self._low + self._high) if self.known else math.nan

    @property
    def error(self) -> float:
        """Largest error of the offset in s."""
        return 0.5 * (self._high - self._low)

    def exchange(self, sent: float, stamp: float, received: float) -> None:
        """Take a reply of the remote time ``stamp`` to a request; ``sent`` and ``received`` are local times (s)."""
        self._widen(received)
        low, high = max(self._low, sent - stamp), min(self._high, received - stamp)
        if low > high:
            low, high = sent - stamp, received - stamp
            self.steps += 1
        self._low, self._high = low, high

    def arrival(self, stamp: float, received: float) -> bool:
        """Take a message of the remote time ``stamp``; return whether it agrees with the offset."""
        self._widen(received)
        if received - stamp < self._low:
            return False
        self._high = min(self._high, received - stamp)
        return True

    def _widen(self, now: float) -> None:
        drift = MAX_DRIFT * max(0.0, now - self._time)
        self._low, self._high, self._time = self._low - drift, self._high + drift, max(now, self._time)


class ArrivalClock:
    """The clock of a sender that cannot be asked: its fastest message counts as one that took no time."""

    def __init__(self) -> None:
        self._begun, self._least, self._previous = -math.inf, math.inf, math.inf
        self._ahead = math.nan
        self._late_since, self._late = math.inf, math.inf

    def arrival(self, stamp: float, received: float, most: float) -> bool:
        """Take a message of the remote time ``stamp`` (s) that came at the local time ``received`` (s).

        Return False, and do not use it, if it is more than ``most`` s ahead of all others and the message before it was
        not ahead by as much: one wrong time would make all that follow old. If all messages of ``SET_BACK`` s are
        behind the others by more than ``most``, only they count: the clock was set back, or the others were wrong.
        """
        if received - self._begun >= BLOCK:
            self._begin(received, self._least if received - self._begun < 2.0 * BLOCK else math.inf)
        offset = received - stamp
        known, before = self.offset, self._ahead
        self._ahead = offset
        if math.isfinite(known) and known - offset > most and not abs(offset - before) <= most:
            return False
        self._least = min(self._least, offset)
        if offset - known <= most:
            self._late_since, self._late = math.inf, math.inf
            return True
        self._late_since, self._late = min(self._late_since, received), min(self._late, offset)
        if received - self._late_since > SET_BACK:
            self._begin(received, self._late)
        return True

    def _begin(self, now: float, previous: float) -> None:
        """Begin a block at ``now`` (s), which follows one whose least offset was ``previous`` (s)."""
        self._begun, self._least, self._previous = now, math.inf, previous

    @property
    def offset(self) -> float:
        """Local minus remote time in s, too large by the duration of the fastest message; infinite without any."""
        return min(self._least, self._previous)
