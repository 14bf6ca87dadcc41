"""The CAN driver: listens, decodes by a DBC, stamps every frame, survives the bus going down.

There is no path to ``bus.send`` in this file: the driver cannot disturb the machine.
"""

import logging
import random
import threading
import time
from dataclasses import replace

import can

from otolith_drivers.base import Counters, Deliver, Link, Sampling, Setup
from otolith_drivers.can_bus import BusOptions, open_bus
from otolith_drivers.can_decoder import FrameDecoder, decoder_of
from otolith_drivers.can_options import FrameOptions
from otolith_drivers.dbc import Source
from otolith_drivers.errors import DeviceError

__all__ = ["CanReceiver", "Options", "Source", "build"]

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT = 0.2  # s; how late a stop can be noticed
BACKOFF_FIRST, BACKOFF_LONGEST = 0.2, 10.0  # s
MOST_BAD_IN_A_ROW = 50  # unreadable frames, after which the bus is opened anew
STAMP_TOLERANCE = 1.0  # s; a kernel stamp farther from now than this met a clock that was set


class Options(BusOptions, FrameOptions):
    """``[driver]`` with ``type = "can"``."""


def build(options: Options, setup: Setup) -> "CanReceiver":
    """A receiver; each signal's source has ``signal`` and, where that is ambiguous, ``message``."""
    return CanReceiver(options, decoder_of(options, setup))


class CanReceiver:
    """Implements :class:`otolith_drivers.base.Driver` over python-can, with a receive thread of its own."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: BusOptions, decoder: FrameDecoder) -> None:
        self._options = options
        self._decoder = decoder
        self._reconnects = 0
        self._unreadable = 0
        self._link = Link(up=False, reason="not opened yet")
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._bad_in_a_row = 0

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        bus = self._connect()
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
        return replace(seen, bad=seen.bad + self._unreadable, reconnects=self._reconnects)

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        return replace(self._link, complaints=tuple(self._decoder.complaints(time.monotonic())))

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        return [f"CAN bus {self._options.title()}, receive only", *self._decoder.describe()]

    def _connect(self) -> can.BusABC:
        filters: list[can.typechecking.CanFilter] = [
            {"can_id": identifier, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
            for identifier, extended in self._decoder.identifiers()
        ]
        bus = open_bus(self._options, filters)
        self._link = Link(up=True)
        return bus

    def _receive(self, bus: can.BusABC | None, deliver: Deliver) -> None:
        while not self._stop.is_set():
            if bus is None:
                bus = self._reconnect()
                continue
            try:
                frame = bus.recv(RECEIVE_TIMEOUT)
            except Exception as error:  # noqa: BLE001 - interfaces raise whatever their vendor's library does
                if self._only_a_bad_frame(error):
                    continue
                self._link = Link(up=False, reason=f"{type(error).__name__}: {error}")
                log.warning("CAN bus %s: %s; reconnecting", self._options.title(), error)
                _shut(bus)
                bus = None
                continue
            self._bad_in_a_row = 0
            if frame is not None:
                self._take(frame, deliver)
        if bus is not None:
            _shut(bus)

    def _only_a_bad_frame(self, error: Exception) -> bool:
        """Whether what came could not be unpacked, while the bus itself stands; many in a row are no accident."""
        if isinstance(error, OSError) or isinstance(error.__cause__, OSError):
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
            except DeviceError as error:
                self._link = Link(up=False, reason=str(error))
                pause = min(2 * pause, BACKOFF_LONGEST)
            else:
                self._reconnects += 1
                return bus
        return None

    def _take(self, frame: can.Message, deliver: Deliver) -> None:
        moment = monotonic_of(frame.timestamp, time.time(), time.monotonic())
        if samples := self._decoder.decode(frame, moment):
            deliver(samples)


def monotonic_of(stamp: float, wall: float, monotonic: float) -> float:
    """The kernel's wall-clock ``stamp`` on the monotonic clock, given both clocks now (all in seconds).

    Where the wall clock was set between stamp and now, or the interface stamps relative to its own start, the time of
    taking the frame is the better one.
    """
    age = wall - stamp
    return monotonic - age if 0.0 <= age < STAMP_TOLERANCE else monotonic


def _shut(bus: can.BusABC) -> None:
    try:
        bus.shutdown()
    except Exception as error:  # noqa: BLE001 - it is being given up for that very reason
        log.debug("shutting the bus down: %s", error)
