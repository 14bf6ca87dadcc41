"""The CAN driver: listens, decodes by a DBC, stamps every frame, survives the bus going down.

There is no path to ``bus.send`` in this file: the driver cannot disturb the machine.
"""

import logging
import math
import random
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import can
from cantools.database import Message

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.can_bus import BusOptions, open_bus
from otolith_drivers.dbc import Source, Wanted, find_signals, load_dbc
from otolith_drivers.errors import DeviceError

__all__ = ["CanReceiver", "Options", "Source", "build"]

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT = 0.2  # s; how late a stop can be noticed
BACKOFF_FIRST, BACKOFF_LONGEST = 0.2, 10.0  # s
MOST_BAD_IN_A_ROW = 50  # unreadable frames, after which the bus is opened anew
STAMP_TOLERANCE = 1.0  # s; a kernel stamp farther from now than this met a clock that was set


class Options(BusOptions):
    """``[driver]`` with ``type = "can"``."""

    dbc: Path
    """The CAN database that describes the frames."""


@dataclass(frozen=True, slots=True)
class _Frame:
    """What to take from the frames of one arbitration ID."""

    message: Message
    wanted: tuple[Wanted, ...]


def build(options: Options, setup: Setup) -> "CanReceiver":
    """A receiver; each signal's source has ``signal`` and, where that is ambiguous, ``message``."""
    path = setup.folder / options.dbc
    database = load_dbc(path)
    frames: dict[tuple[int, bool], _Frame] = {}
    for wanted in find_signals(database, setup.signals, path):
        key = (wanted.message.frame_id, wanted.message.is_extended_frame)
        frame = frames.get(key, _Frame(wanted.message, ()))
        frames[key] = replace(frame, wanted=(*frame.wanted, wanted))
    return CanReceiver(options, frames)


class CanReceiver:
    """Implements :class:`otolith_drivers.base.Driver` over python-can, with a receive thread of its own."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: BusOptions, frames: dict[tuple[int, bool], _Frame]) -> None:
        self._options = options
        self._frames = frames
        self._counters = Counters()
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
        return self._counters

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        return self._link

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        wanted = [wanted for frame in self._frames.values() for wanted in frame.wanted]
        signals = [f"{entry.name} [{entry.target_unit}] from {entry.describe()}" for entry in wanted]
        return [f"CAN bus {self._options.title()}, receive only", *signals]

    def _connect(self) -> can.BusABC:
        filters: list[can.typechecking.CanFilter] = [
            {"can_id": identifier, "can_mask": 0x1FFFFFFF if extended else 0x7FF, "extended": extended}
            for identifier, extended in self._frames
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
        self._counters = replace(self._counters, bad=self._counters.bad + 1)
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
                self._counters = replace(self._counters, reconnects=self._counters.reconnects + 1)
                return bus
        return None

    def _take(self, frame: can.Message, deliver: Deliver) -> None:
        known = self._frames.get((frame.arbitration_id, frame.is_extended_id))
        if known is None or frame.is_error_frame or frame.is_remote_frame:
            return
        moment = monotonic_of(frame.timestamp, time.time(), time.monotonic())
        try:
            values = known.message.decode_simple(bytes(frame.data), decode_choices=False)
            samples = [Sample(wanted.name, moment, wanted.read(values)) for wanted in known.wanted]
        except Exception as error:  # noqa: BLE001 - a hostile frame must not end the thread
            self._counters = replace(self._counters, bad=self._counters.bad + 1)
            log.debug("frame 0x%X: %s", frame.arbitration_id, error)
            return
        bad = any(not math.isfinite(sample.value) for sample in samples)
        self._counters = replace(
            self._counters, received=self._counters.received + len(samples), bad=self._counters.bad + int(bad)
        )
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
