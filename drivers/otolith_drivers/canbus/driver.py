"""The CAN driver: listens, stamps every frame, survives the bus going down.

There is no path to ``bus.send`` in this file: the driver cannot disturb the machine. What is in the frames is the
business of ``can_decoder.py``.
"""

import logging
import random
import threading
import time
from dataclasses import replace

import can

from otolith_drivers.base import Counters, Deliver, Link, Sampling, Setup
from otolith_drivers.canbus.bus import (
    MOST_BAD_IN_A_ROW,
    BusOptions,
    Drops,
    enlarge_buffer,
    frames_dropped,
    is_gone,
    open_bus,
    refusal,
)
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.options import FrameOptions
from otolith_drivers.canbus.signals import Source
from otolith_drivers.errors import DeviceError

__all__ = ["CanReceiver", "Options", "Source", "build"]

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT = 0.2  # s; how late a stop can be noticed
BACKOFF_FIRST, BACKOFF_LONGEST = 0.2, 10.0  # s
STAMP_TOLERANCE = 1.0  # s; a kernel stamp farther from now than this met a clock that was set
LOOK_EVERY = 0.05  # s; how often the clocks are compared: 50 ms are the longest that a clock that was set can mislead
CLOCK_TRIES, CLOCK_SPAN = 5, 2e-5  # s
SILENT_PERIODS, SILENT_AT_LEAST, SILENT_AT_MOST = 10.0, 2.0, 60.0  # periods; s
NEVER_HEARD = 10.0  # s; no period is known before anything came


class Options(BusOptions, FrameOptions):
    """``[driver]`` with ``type = "can"``."""


def build(options: Options, setup: Setup) -> "CanReceiver":
    """A receiver of the frames in which the signals are."""
    return CanReceiver(options, decoder_of(options, setup))


class CanReceiver:
    """Implements :class:`otolith_drivers.base.Driver` over python-can, with a receive thread of its own."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: BusOptions, decoder: FrameDecoder) -> None:
        self._options = options
        self._decoder = decoder
        self._link = Link(up=False, reason="not opened yet")
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._reconnects = self._unreadable = self._bad_in_a_row = 0
        self._drops = Drops()
        self._heard = self._opened = 0.0
        self._patience = 0.0

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        bus = self._connect()
        for line in self._decoder.configuration_warnings:
            log.warning("%s", line)
        self._heard = self._opened
        self._decoder.begin(self._opened)
        self._thread = threading.Thread(target=self._receive, args=(bus, deliver), name="can-receive", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def counters(self) -> Counters:
        """See :meth:`otolith_drivers.base.Driver.counters`."""
        seen = self._decoder.counters
        return replace(
            seen,
            bad=seen.bad + self._unreadable,
            # What the kernel dropped is missed by pace or counter as well, unless a message has neither.
            lost=max(seen.lost, self._drops.total),
            reconnects=self._reconnects,
        )

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        link = self._link
        if not link.up:
            return link
        if self._decoder.faults.bus_off:
            return Link(up=False, reason="bus off: the controller has left the bus after too many errors")
        now = time.monotonic()
        silence = now - self._heard
        alone = [f"nothing at all has come for {silence:.1f} s"] if silence > self._silence_limit() else []
        warnings = (*alone, *self._drops.warnings(now), *self._decoder.warnings(now))
        return replace(link, warnings=warnings)

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        return [f"CAN bus {self._options.title()}, receive only", *self._decoder.describe()]

    def _connect(self) -> can.BusABC:
        filters: list[can.typechecking.CanFilter] = [
            {"can_id": identifier, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
            for identifier, extended in self._decoder.identifiers()
        ]
        bus = open_bus(self._options, filters, listen_only=True)
        enlarge_buffer(bus)
        self._drops.begin()
        self._bad_in_a_row = 0
        self._opened = time.monotonic()
        self._decoder.faults.bus_off = False
        self._link = Link(up=True)
        return bus

    def _receive(self, bus: can.BusABC | None, deliver: Deliver) -> None:
        while not self._stop.is_set():
            if bus is None:
                bus = self._reconnect()
            elif (trouble := self._take_frames(bus, deliver)) is not None:
                self._link = Link(up=False, reason=trouble)
                log.warning("CAN bus %s: %s; reconnecting", self._options.title(), trouble)
                _shut(bus)
                bus = None
        if bus is not None:
            _shut(bus)

    def _take_frames(self, bus: can.BusABC, deliver: Deliver) -> str | None:
        """Take what comes until the clocks are to be compared again; what is wrong if the bus must be opened anew."""
        receive, decode, clock = bus.recv, self._decoder.decode, time.monotonic
        begun = now = clock()
        offset = wall_ahead()
        while now - begun < LOOK_EVERY:
            try:
                frame = receive(RECEIVE_TIMEOUT)
                now = clock()
                if frame is None:
                    break
                if samples := decode(frame, monotonic_of(frame.timestamp, now + offset, now)):
                    deliver(samples)
            except Exception as error:  # noqa: BLE001 - interfaces raise whatever their vendor's library does
                if self._only_a_bad_frame(error):
                    return None
                return f"{type(error).__name__}: {error}"
            self._heard, self._bad_in_a_row = now, 0
        return self._look(bus, now)

    def _look(self, bus: can.BusABC, now: float) -> str | None:
        """At what no frame tells; what is wrong if the bus must be opened anew."""
        self._drops.note(frames_dropped(bus), now)
        if _is_off(bus):
            self._decoder.faults.bus_off = True
        if now - self._heard < RECEIVE_TIMEOUT:
            self._patience = 0.0
            return None
        silence = now - max(self._heard, self._opened)
        if silence < max(self._patience, self._silence_limit()):
            return None
        # Some interfaces never tell that their other end has gone.
        self._patience = min(2.0 * silence, SILENT_AT_MOST)
        return f"nothing has come for {silence:.1f} s"

    def _silence_limit(self) -> float:
        period = self._decoder.slowest_period()
        return NEVER_HEARD if period is None else max(SILENT_AT_LEAST, SILENT_PERIODS * period)

    def _only_a_bad_frame(self, error: Exception) -> bool:
        """Whether what came could not be unpacked, while the bus itself stands."""
        if is_gone(error):
            return False
        self._bad_in_a_row += 1
        self._unreadable += 1
        return self._bad_in_a_row <= MOST_BAD_IN_A_ROW

    def _reconnect(self) -> can.BusABC | None:
        """Endless, with growing pauses that differ from machine to machine."""
        pause = BACKOFF_FIRST
        while not self._stop.wait(pause * random.uniform(0.5, 1.0)):  # noqa: S311 - jitter, not a secret
            try:
                bus = self._connect()
            except Exception as error:  # noqa: BLE001 - as above; a DeviceError has a sentence of its own
                trouble = str(error) if isinstance(error, DeviceError) else f"{type(error).__name__}: {error}"
            else:
                if (against := refusal(bus)) is None:
                    self._reconnects += 1
                    return bus
                _shut(bus)
                trouble = f"CAN bus {self._options.title()}: {against}"
            self._link = Link(up=False, reason=trouble)
            pause = min(2 * pause, BACKOFF_LONGEST)
        return None


def wall_ahead() -> float:
    """How far the wall clock is ahead of the monotonic one (s), though this thread may be held up between the two."""
    best, span = 0.0, float("inf")
    for _ in range(CLOCK_TRIES):
        before, wall, after = time.monotonic(), time.time(), time.monotonic()
        if after - before < span:
            best, span = wall - 0.5 * (before + after), after - before
        if span < CLOCK_SPAN:
            break
    return best


def monotonic_of(stamp: float, wall: float, monotonic: float) -> float:
    """The kernel's wall-clock ``stamp`` on the monotonic clock, given both clocks now (all in seconds).

    Where the wall clock was set between stamp and now, or the interface stamps relative to its own start, the time of
    taking the frame is the better one.
    """
    age = wall - stamp
    return monotonic - age if 0.0 <= age < STAMP_TOLERANCE else monotonic


def _is_off(bus: can.BusABC) -> bool:
    try:
        return bus.state is can.BusState.ERROR
    except Exception:  # noqa: BLE001 - many interfaces cannot tell
        return False


def _shut(bus: can.BusABC) -> None:
    try:
        bus.shutdown()
    except Exception as error:  # noqa: BLE001 - it is being given up for that very reason
        log.debug("shutting the bus down: %s", error)
