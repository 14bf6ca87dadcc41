"""Service time: the clock of the windows, which nobody sets; and the wall clock, which labels it.

Service time is the time since the boot of the computer, which also counts a suspension, plus a constant. A daemon that
starts again during the same boot continues it exactly, whatever has set the wall clock meanwhile. After another boot
only the wall clock can tell how long the computer was off. If it says something impossible, the time is unknown.

A wall clock that is set by :data:`MIN_SET` or more was wrong since the boot, or since the first daemon of this boot
began: the labels of that time are corrected. A smaller correction is what a clock drifts by; earlier labels stay.
A computer without a battery has a wrong clock at each boot until a time server answers, so that is no event.
"""

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from otolith.estimation.imm_filter import UNKNOWN_AWAY
from otolith.health.labels import TimeLabels
from otolith.storage.learned_state import SavedClock
from otolith_drivers.common.clocks import clock_difference, uptime

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
TIME_SERVER_DELAY = 3600.0  # s since the boot within which a time server sets the clock
MIN_SET = 30.0  # s: a larger change of the wall clock was a wrong clock, a smaller one its drift
LABEL_TOLERANCE = 0.1  # s by which labels may differ from the wall clock
MAX_SUSPENSION_ERROR = 1e-3  # s by which two comparisons of the clocks differ by chance
MAX_AWAY = 10 * 365 * 86_400.0  # s: a wall clock that says more is wrong
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class ClockReading:
    """The clocks of the computer at one moment."""

    boot: str  # Identifies the boot; empty if unknown
    uptime: float  # Time since the boot, s
    monotonic: float  # s
    unix: float  # What the wall clock says, s


def read_clocks() -> ClockReading:
    """Return what the clocks of this computer say now."""
    now = uptime()
    monotonic = now - clock_difference(uptime, time.monotonic)
    return ClockReading(_boot(), now, monotonic, now + clock_difference(time.time, uptime))


@cache
def _boot() -> str:
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""


class ServiceClock:
    """Service time of one daemon, and its labels."""

    def __init__(
        self,
        saved: SavedClock | None = None,
        last: float = -math.inf,
        labels: TimeLabels | None = None,
        read: Callable[[], ClockReading] = read_clocks,
    ) -> None:
        """Continue a ``saved`` clock after the service time ``last`` of the last window that is known.

        ``labels`` are those of the history: they count if no clock was saved.
        """
        self._read = read
        now = read()
        self.labels = (labels or TimeLabels()) if saved is None else saved.labels
        if saved is not None and saved.boot == now.boot != "":
            self._offset, self._begin = saved.offset, saved.begin
        else:
            self._begin = _begin(last, self.labels, now)
            self._offset = self._begin - now.uptime
            self.labels = self._labels_now(now)
        self._boot = now.boot
        self._suspended = now.uptime - now.monotonic

    @property
    def saved(self) -> SavedClock:
        """What the next daemon continues from."""
        return SavedClock(boot=self._boot, offset=self._offset, begin=self._begin, labels=self.labels)

    @property
    def offset(self) -> float:
        """Service time minus monotonic time, s."""
        return self._offset + self._suspended

    @property
    def ahead(self) -> float:
        """Unix time minus service time, s."""
        return self.labels.ahead(self.now())

    def now(self) -> float:
        """Return the service time, s."""
        return self._offset + self._read().uptime

    def update(self) -> float | None:
        """Follow the wall clock with the labels.

        Return by how much it was set (s); None if it was not, or so soon after the boot that it is no event.
        """
        now = self._read()
        if abs(now.uptime - now.monotonic - self._suspended) > MAX_SUSPENSION_ERROR:
            self._suspended = now.uptime - now.monotonic
        by = now.unix - self.labels.unix(self._offset + now.uptime)
        if abs(by) < MIN_SET:
            self.labels = self._labels_now(now)
            return None
        self.labels = self.labels.shifted(self._begin, by)
        if now.uptime < TIME_SERVER_DELAY:
            log.info("the clock was set by %+.0f s after the boot; times since the boot are corrected", by)
            return None
        return by

    def _labels_now(self, now: ClockReading) -> TimeLabels:
        """Return labels that agree with the wall clock from now on."""
        moment = self._offset + now.uptime
        by = now.unix - self.labels.unix(moment)
        return self.labels if abs(by) <= LABEL_TOLERANCE else self.labels.since(moment, now.unix - moment)


def _begin(last: float, labels: TimeLabels, now: ClockReading) -> float:
    """Return the service time of the first moment after a boot."""
    if not math.isfinite(last):
        return now.unix
    away = now.unix - labels.unix(last)
    return last + (away if 0.0 <= away <= MAX_AWAY else max(UNKNOWN_AWAY, now.uptime))
