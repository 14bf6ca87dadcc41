"""The times of messages: the clock of another computer on this computer's, and the period in which messages come.

No clock in here: every time is an argument (s, of any clock that advances steadily).

The *offset* is the local minus the remote time of one moment, in s. A request is sent before its reply is stamped, and
the reply arrives after that: so each exchange gives a lower and an upper bound of the offset, and a message that was
only received gives an upper one.

The period of a message, and the messages that are missing, follow from the times of arrival.
"""

import math
import statistics
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo

# Thresholds: docs/reference/thresholds-drivers.md has the origin of each.
MAX_DRIFT = 2e-4  # s per s between two clocks, beyond the 1e-4 of two quartz oscillators
BLOCK = 10.0  # s; the fastest message of the last one or two of these gives the offset of a clock that is not asked
SET_BACK = 2.0  # s; for which a clock that is not asked must be behind to count as one that was set back
MIN_INTERVALS, MIN_SPAN, MAX_INTERVALS = 8, 0.25, 4096  # intervals; s; intervals: what a period estimate takes
AGREEING = 0.8  # least ratio of two periods in a row that are the same
MIN_REGULAR_SHARE = 0.75  # of the intervals of a regular message are on time
EARLY, LATE = 0.5, 1.5  # periods: half-way to the frame before and to the frame after
TRACKING_GAIN = 0.02  # of the difference, with each frame: cheap oscillators drift
OUTLIER_WEIGHT = 3  # intervals on time for each that is not: the share that a regular message has at least
MAX_OUTLIERS = 96  # of that weight; then the period is estimated anew
MAX_OUTAGE = 60.0  # s; a longer silence is a stop of the sender, not a loss of frames
SILENT_PERIODS, MIN_SILENCE, MIN_IRREGULAR_SILENCE = 10.0, 0.5, 10.0  # periods; s; s


def unix_time(moment: datetime, zone: tzinfo = UTC) -> float:
    """Return the seconds since 1970 of ``moment``, which is in ``zone`` if it names no time zone.

    An hour that comes twice, as at the end of summer time, is the first of both.
    """
    return (moment if moment.tzinfo is not None else moment.replace(tzinfo=zone)).timestamp()


class ExchangeClock:
    """The clock of a server that is asked for its time."""

    def __init__(self) -> None:
        self._low, self._high, self._time = -math.inf, math.inf, 0.0
        self.steps = 0  # How often the clock was set

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


class PeriodEstimator:
    """Estimates the period of a message and infers lost frames from their arrival times.

    *Lateness* is the interval between two frames, in periods per frame sent. One interval is judged at a time:

    - On time (lateness from ``EARLY`` to ``LATE``): the period tracks the interval.
    - Late: frames are lost, or held up somewhere and about to arrive in a burst. The missing ones are *unconfirmed*.
    - Early: a frame of a burst. It was held up and not lost, so there is one unconfirmed frame less.

    Unconfirmed frames count as lost when the next frame is not early. After ``MAX_OUTLIERS`` intervals in a row that
    are not on time, the period is estimated anew.

    A frame counter gives the number of frames sent, but only modulo its cycle. The clock adds whole cycles, and these
    stay unconfirmed likewise. ``docs/explanation/frame-periods.md`` derives the rule and shows examples.
    """

    def __init__(self, declared: float | None = None) -> None:
        """``declared`` is the period (s) if the machine file gives it; it is then never estimated."""
        self.period = declared  # s; None until it is known
        self.regular = declared is not None
        self.last: float | None = None  # Arrival (s) of the last new frame
        self._declared = declared is not None
        self._intervals: list[float] = []
        self._candidate: float | None = None  # Period (s) that the last intervals had, if they were regular
        self._outliers = 0
        self._unconfirmed = 0
        self._held_up = 0

    def lost_before(self, time: float) -> int:
        """Number of frames that count as lost now that a frame without a counter has arrived at ``time`` (s)."""
        last, self.last = self.last, time
        if last is None:
            return 0
        interval = time - last
        if self.period is None or not self.regular:
            self._learn(interval)
            return 0
        lateness = interval / self.period
        if EARLY <= lateness <= LATE:
            return self._accept(interval)
        if lateness < EARLY and self._unconfirmed:
            self._unconfirmed -= 1
            return 0
        starts_anew = self._count_outlier()
        if starts_anew or lateness < EARLY:
            return 0
        confirmed, self._unconfirmed = self._unconfirmed, round(lateness) - 1 if interval < MAX_OUTAGE else 0
        return confirmed

    def sent_since_last(self, time: float, step: int, modulo: int) -> int:
        """Number of frames sent since the last new one, this one included; 0 if this frame repeats the last one.

        ``step`` is by how much the counter has advanced, modulo ``modulo``. Frames that were unconfirmed until now
        are included.
        """
        if self.last is None:
            self.last = time
            return 1
        interval = time - self.last
        period = self.period if self.regular else None
        expected = interval / period if period is not None and interval < MAX_OUTAGE else 0.0
        in_cycles = 0
        if step == 0 or expected > LATE:  # otherwise no cycle fits into the interval
            step, in_cycles = _add_cycles(step, modulo, expected)
        if step == 0:
            return 0
        self.last = time
        per_frame = interval / (step + in_cycles)
        if period is None:
            self._learn(per_frame)
            return step
        lateness = per_frame / period
        if EARLY <= lateness <= LATE:
            return step + self._accept(per_frame, in_cycles)
        if lateness < EARLY:
            self._take_burst(step)
            return step
        confirmed, self._unconfirmed = self._unconfirmed, 0
        self._held_up = int(expected) - step  # the counter excludes that these are lost
        self._count_outlier()
        return step + confirmed

    def silence(self, now: float) -> float | None:
        """Seconds without a frame at ``now`` (s), or None while that is no longer than normal."""
        if self.last is None:
            return None
        shortest = MIN_SILENCE if self.regular else MIN_IRREGULAR_SILENCE
        silence = now - self.last
        return silence if silence > max(shortest, SILENT_PERIODS * (self.period or 0.0)) else None

    def describe(self) -> str:
        """The period, as a clause."""
        period = self.period  # another thread may set it to None
        if period is None:
            return "its period is not known"
        return f"it came every {period_text(period)}" + ("" if self.regular else " or so, not regularly")

    def _take_burst(self, frames: int) -> None:
        """Take ``frames`` that came early: what was unconfirmed was held up, and not lost."""
        self._unconfirmed = 0
        if self._held_up > 0:
            self._held_up -= frames
        else:
            self._count_outlier()

    def _accept(self, interval: float, unconfirmed: int = 0) -> int:
        """Track an interval that is on time; returns the frames that it confirms as lost."""
        self._outliers = max(0, self._outliers - 1)
        if not self._declared and self.period is not None:
            self.period += TRACKING_GAIN * (interval - self.period)
        confirmed, self._unconfirmed = self._unconfirmed, unconfirmed
        return confirmed

    def _count_outlier(self) -> bool:
        """Count an interval that is not on time; True if the estimate starts anew because of it."""
        self._outliers += OUTLIER_WEIGHT
        if self._outliers < MAX_OUTLIERS or self._declared:
            return False
        self.period, self.regular, self._outliers, self._unconfirmed = None, False, 0, 0
        return True

    def _learn(self, interval: float) -> None:
        self._intervals.append(interval)
        if (estimate := estimate_period(self._intervals)) is None:
            return
        self._intervals.clear()
        period, is_regular = estimate
        before, self._candidate = self._candidate, period if is_regular else None
        agrees = before is not None and AGREEING * before <= period <= before / AGREEING
        self.period, self.regular = period, is_regular and agrees


def estimate_period(intervals: Sequence[float]) -> tuple[float, bool] | None:
    """Period (s) and whether the message is regular; None if there are too few ``intervals`` (s).

    The median finds the period in spite of bursts. The mean must agree with it: in a long burst even the median is
    wrong.
    """
    count, span = len(intervals), sum(intervals)
    if count < MIN_INTERVALS or (span < MIN_SPAN and count < MAX_INTERVALS):
        return None
    median, mean = statistics.median(intervals), span / count
    on_time = [interval for interval in intervals if EARLY * median <= interval <= LATE * median]
    regular = len(on_time) >= MIN_REGULAR_SHARE * count and median > 0.0 and abs(mean / median - 1.0) < LATE - 1.0
    return (statistics.fmean(on_time) if regular else mean), regular


def _add_cycles(step: int, modulo: int, expected: float) -> tuple[int, int]:
    """Frames that the counter shows, and frames in whole cycles that only the clock shows.

    ``expected`` is the number of frames that fit into the interval. A step of 0 after whole cycles is one full cycle.
    """
    cycles = round((expected - step) / modulo)
    if cycles <= 0:
        return step, 0
    return (step, cycles * modulo) if step else (modulo, (cycles - 1) * modulo)


def period_text(period: float) -> str:
    """``period`` (s) in milliseconds or seconds."""
    return f"{period * 1e3:.1f} ms" if period < 1.0 else f"{period:.1f} s"
