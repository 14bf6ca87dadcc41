"""A driver's thread, and connections that are opened again: their state, pauses, causes and passing faults."""

import logging
import math
import os
import random
import ssl
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

BACKOFF_FIRST, BACKOFF_MAX = 0.2, 10.0  # s between attempts to connect
LASTING = 1.0  # s; a connection that lasted so long works, and the next pause is the shortest one again
LINES, LINE_PERIOD = 12, 300.0  # lines about a connection in the log at once; s for each further one
FAULT_SHOWN = 10.0  # s after which a passing fault is no longer a warning
CLOSE_TIMEOUT = 0.9  # s for the thread to end
MAX_KINDS = 20  # kinds of exceptions of a driver that are logged

Clock = Callable[[], float]  # s, of a clock that advances steadily


class ReconnectBackoff:
    """Pauses between attempts to connect, doubled each time, with jitter so that clients do not come all at once."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin with the shortest pause again."""
        self._pause = BACKOFF_FIRST

    def next(self) -> float:
        """Return the next pause, s."""
        pause, self._pause = self._pause, min(2.0 * self._pause, BACKOFF_MAX)
        return pause * random.uniform(0.5, 1.0)  # noqa: S311 - jitter, not a secret


class _LineLimit:
    """How many lines about a connection the log may have: ``LINES`` at once, then one each ``LINE_PERIOD``."""

    def __init__(self, clock: Clock) -> None:
        self._clock, self._time, self._left = clock, clock(), float(LINES)
        self._left_out = 0

    def remark(self) -> str | None:
        """Return what the next line ends with: how many were left out; None if it must be left out, too."""
        now = self._clock()
        self._left, self._time = min(LINES, self._left + (now - self._time) / LINE_PERIOD), now
        if self._left < 1.0:
            self._left_out += 1
            return None
        self._left -= 1.0
        left_out, self._left_out = self._left_out, 0
        return f" ({left_out} lines about it were left out before this one)" if left_out else ""


class Reconnection:
    """Whether a connection is up, why it is down, and how often it came back. Each change is logged once.

    Of a connection that fails and returns again and again, not every change is logged.
    """

    def __init__(self, title: str, log: logging.Logger, clock: Clock = time.monotonic) -> None:
        """``title`` begins each line of the log; ``clock`` gives the time in s."""
        self._clock, self._limit = clock, _LineLimit(clock)
        self.state, self.count = (False, "not opened yet"), 0  # Up or not, and why not: both change at once
        self.backoff = ReconnectBackoff()
        self._title, self._log = title, log
        self._was_up, self._has_failed, self._begun = False, False, 0.0
        self._logged = ""  # the latest reason

    @property
    def up(self) -> bool:
        """Whether the other end answers."""
        return self.state[0]

    @property
    def has_failed_first(self) -> bool:
        """Whether it was never up, and the first attempt has failed."""
        return self._has_failed and not self._was_up

    @property
    def reason(self) -> str:
        """Why it is down; empty if it is up."""
        return self.state[1]

    def stay_down(self, reason: str) -> None:
        """Note why the connection is down, without a line in the log."""
        self.state = False, reason

    def come_up(self, what: str) -> None:
        """Note that the other end ``what``, like "answers"."""
        if not self.up:
            self.state, self._logged = (True, ""), ""
            self.count += self._was_up
            self._was_up = True
            self._begun = self._clock()
            if (remark := self._limit.remark()) is not None:
                self._log.info("%s: %s%s", self._title, what, remark)

    def go_down(self, reason: str) -> None:
        """Note why the connection is down."""
        if reason != self._logged and (remark := self._limit.remark()) is not None:
            self._logged = reason  # one that is left out is tried again with the next attempt
            self._log.warning("%s: %s; trying again until it works%s", self._title, reason, remark)
        if self.up and self._clock() - self._begun >= LASTING:
            self.backoff.reset()
        self._has_failed, self.state = True, (False, reason)


@dataclass(slots=True)
class PassingFault:
    """A fault that ends no connection, such as an unusable value: counted, and a warning while it is recent."""

    text: str = ""  # The latest one
    count: int = 0
    time: float = -math.inf

    def note(self, text: str, now: float) -> None:
        """Count a fault at ``now`` (s)."""
        self.text, self.time, self.count = text, now, self.count + 1

    def warnings(self, now: float, title: str = "") -> list[str]:
        """Return a line that begins with ``title``, or none if the latest fault is long ago at ``now`` (s)."""
        age = max(now - self.time, 0.0)
        line = f"{title}: {self.text}" if title else self.text
        return [f"{line}; {self.count} in all, the last {age:.1f} s ago"] if age < FAULT_SHOWN else []


class OwnFaults:
    """Exceptions of a driver's own code: counted apart from what a machine sends wrong, each kind logged once."""

    def __init__(self, log: logging.Logger) -> None:
        self._log, self._kinds, self._latest = log, set[str](), PassingFault()

    @property
    def count(self) -> int:
        """How many there were."""
        return self._latest.count

    def note(self, error: BaseException, doing: str, now: float) -> None:
        """Count ``error``, raised at ``now`` (s) while ``doing`` something, like "decoding frame 0x181"."""
        text = f"{doing}: {type(error).__name__}: {error}"
        self._latest.note(f"a fault of this program in {text}", now)
        places = traceback.extract_tb(error.__traceback__)
        kind = f"{type(error).__name__} {places[-1].filename}:{places[-1].lineno}" if places else type(error).__name__
        if kind not in self._kinds and len(self._kinds) < MAX_KINDS:
            self._kinds.add(kind)
            self._log.error("a fault of this program, of a kind that is logged once, in %s", text, exc_info=error)

    def defect(self, now: float) -> str:
        """Return for :attr:`otolith_drivers.base.Link.defect` what is recent at ``now`` (s); empty without."""
        return "; ".join(self._latest.warnings(now))


def cause_of(error: BaseException) -> str:
    """Return why a connection failed, without the prefixes that libraries add to the texts of the system."""
    if isinstance(error, ssl.SSLError):  # an OSError, but its number is none of the system
        return f"TLS fails: {getattr(error, 'reason', '') or error}"
    if isinstance(error, OSError) and error.errno and error.errno > 0:
        return os.strerror(error.errno)
    return (isinstance(error, OSError) and error.strerror) or str(error) or type(error).__name__


class ThreadedDriver:
    """Base of a driver whose thread runs until ``_stop`` is set."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def _start(self, name: str, run: Callable[..., None], *arguments: Any) -> None:
        """Call ``run`` with the arguments in a thread of this name."""
        self._thread = threading.Thread(target=run, args=arguments, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join(CLOSE_TIMEOUT)
