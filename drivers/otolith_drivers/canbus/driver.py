"""The CAN driver: receives frames, gives each its time, and reconnects after the bus has failed.

It cannot disturb the machine: nothing in this package sends. ``decoder.py`` makes samples of the frames.
"""

import logging
import time
from dataclasses import replace

import can

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.canbus.bus import (
    MAX_CONSECUTIVE_BAD,
    BusOptions,
    DropCounter,
    bus_error,
    enlarge_buffer,
    frames_dropped,
    is_gone,
    open_bus,
)
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.options import CanSource, FrameOptions
from otolith_drivers.common.clocks import wall_clock_offset
from otolith_drivers.common.reconnection import PassingFault, Reconnection, ThreadedDriver
from otolith_drivers.errors import DeviceError

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT = 0.2  # s; how late a stop may be noticed
MAX_STAMP_AGE = 1.0  # s; an older kernel stamp is from before the wall clock was set
CLOCK_CHECK_PERIOD = 0.05  # s; how long a wall clock that was set can falsify times
GATHERING_TIME = 0.002  # s; frames of a busy bus are received together, so that not each of them wakes the thread
MIN_GATHERED, MAX_GATHERED = 4, 1000  # frames in that time on a busy bus; frames that are received together
SILENT_PERIODS, MIN_SILENCE, MAX_SILENCE = 10.0, 2.0, 60.0  # periods; s; s: when a silent bus is opened anew
UNKNOWN_PERIOD_SILENCE = 10.0  # s; the same while no period is known


class CanOptions(BusOptions, FrameOptions):
    """``[driver]`` with ``type = "can"``."""


Options = CanOptions  # the names that otolith_drivers.base.DriverType asks for
Source = CanSource


def build(options: CanOptions, setup: Setup) -> "CanReceiver":
    """A receiver of the frames with the signals of ``setup``; raises as :func:`.decoder.decoder_of`."""
    return CanReceiver(options, decoder_of(options, setup))


class CanReceiver(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over python-can, with a receive thread of its own."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: BusOptions, decoder: FrameDecoder) -> None:
        super().__init__()
        self._options, self._decoder = options, decoder
        self._connection = Reconnection(f"CAN bus {options.title()}", log)
        self._unreadable = PassingFault()  # Frames that python-can cannot unpack
        self._consecutive_bad = 0
        self._drops = DropCounter()
        self._last_frame = self._opened = 0.0
        self._gathers = False
        self._next_reopening = 0.0  # s of silence after which the bus is opened anew; doubles each time

    def open(self, deliver: Deliver) -> None:
        bus = self._connect()
        self._connection.come_up("is open")
        for line in self._decoder.configuration_warnings:
            log.warning("%s", line)
        self._last_frame = self._opened
        self._decoder.begin(self._opened)
        self._start("can-receive", self._receive, bus, deliver)

    def counters(self) -> Counters:
        counters = self._decoder.counters
        return replace(
            counters,
            bad=counters.bad + self._unreadable.count,
            # The period or the counter of a message shows dropped frames as well, unless it has neither.
            lost=max(counters.lost, self._drops.total),
            reconnects=self._connection.count,
        )

    def link(self) -> Link:
        up, reason = self._connection.state
        if not up:
            return Link(up=False, reason=reason)
        if self._decoder.faults.bus_off:
            return Link(up=False, reason="bus off: the controller has left the bus after too many errors")
        now = time.monotonic()
        silence = now - self._last_frame
        silent = [f"no frame at all for {silence:.1f} s"] if silence > self._silence_limit() else []
        unreadable = self._unreadable.warnings(now)
        warnings = (*silent, *unreadable, *self._drops.warnings(now), *self._decoder.warnings(now))
        return Link(up=True, warnings=warnings, latency=self._decoder.latency, defect=self._decoder.defect(now))

    def describe(self) -> list[str]:
        return [f"CAN bus {self._options.title()}, receive only", *self._decoder.describe()]

    def _connect(self) -> can.BusABC:
        filters: list[can.typechecking.CanFilter] = [
            {"can_id": identifier, "can_mask": mask, "extended": extended}
            for identifier, mask, extended in self._decoder.filters()
        ]
        bus = open_bus(self._options, filters, listen_only=True)
        enlarge_buffer(bus)
        self._drops.restart()
        self._consecutive_bad = 0
        self._opened = time.monotonic()
        self._decoder.faults.bus_off = False
        return bus

    def _receive(self, bus: can.BusABC | None, deliver: Deliver) -> None:
        while not self._stop.is_set():
            if bus is None:
                bus = self._reconnect()
            elif (failure := self._take_frames(bus, deliver)) is not None:
                self._connection.go_down(failure)
                _shut(bus)
                bus = None
        if bus is not None:
            _shut(bus)

    def _take_frames(self, bus: can.BusABC, deliver: Deliver) -> str | None:
        """Take frames until the next clock check; returns why the bus must be opened anew, or None."""
        decode, clock = self._decoder.decode, time.monotonic
        begun = now = clock()
        offset, count = wall_clock_offset(), 0
        while now - begun < CLOCK_CHECK_PERIOD:
            frames: list[can.Message] = []
            failure: Exception | None = None
            try:
                self._receive_waiting(bus, frames)
            except Exception as error:  # noqa: BLE001 - interfaces raise whatever their vendor's library raises
                failure = error
            now = clock()
            wall, samples = now + offset, list[Sample]()
            for frame in frames:
                samples += decode(frame, monotonic_of(frame.timestamp, wall, now))
            if samples:
                deliver(samples)
            if frames:
                count += len(frames)
                self._last_frame, self._consecutive_bad = now, 0
            if failure is not None:
                return None if self._is_only_a_bad_frame(failure) else f"{type(failure).__name__}: {failure}"
            if not frames:
                break
        is_busy = count * GATHERING_TIME >= MIN_GATHERED * (now - begun)
        self._gathers = is_busy and self._options.stamped_by_kernel
        return self._check_bus(bus, now)

    def _receive_waiting(self, bus: can.BusABC, frames: list[can.Message]) -> None:
        """Append the next frame to ``frames``, or on a busy bus all that have come after a short pause.

        If none comes, this waits for ``RECEIVE_TIMEOUT``. The frames before an error are in ``frames``.
        """
        receive, wanted, timeout = bus.recv, 1, RECEIVE_TIMEOUT
        if self._gathers:
            time.sleep(GATHERING_TIME)
            wanted = MAX_GATHERED
        while len(frames) < wanted and (frame := receive(timeout)) is not None:
            frames.append(frame)
            timeout = 0.0

    def _check_bus(self, bus: can.BusABC, now: float) -> str | None:
        """Check what no frame shows: drops, bus off, silence. Returns why the bus must be opened anew, or None."""
        self._drops.note(frames_dropped(bus), now)
        if _is_off(bus):
            self._decoder.faults.bus_off = True
        if now - self._last_frame < RECEIVE_TIMEOUT:
            self._next_reopening = 0.0
            return None
        silence = now - max(self._last_frame, self._opened)
        if silence < max(self._next_reopening, self._silence_limit()):
            return None
        # Some interfaces never report that their other end has gone.
        self._next_reopening = min(2.0 * silence, MAX_SILENCE)
        return f"no frame for {silence:.1f} s"

    def _silence_limit(self) -> float:
        period = self._decoder.slowest_period()
        return UNKNOWN_PERIOD_SILENCE if period is None else max(MIN_SILENCE, SILENT_PERIODS * period)

    def _is_only_a_bad_frame(self, error: Exception) -> bool:
        """Whether a frame could not be unpacked while the bus itself works; counts such frames."""
        if is_gone(error):
            return False
        self._consecutive_bad += 1
        self._unreadable.note(f"a frame cannot be unpacked ({type(error).__name__}: {error})", time.monotonic())
        return self._consecutive_bad <= MAX_CONSECUTIVE_BAD

    def _reconnect(self) -> can.BusABC | None:
        """Try until it succeeds, with growing random pauses; None if the driver is closed meanwhile."""
        while not self._stop.wait(self._connection.backoff.next()):
            try:
                bus = self._connect()
            except Exception as error:  # noqa: BLE001 - as above
                failure = str(error) if isinstance(error, DeviceError) else f"{type(error).__name__}: {error}"
            else:
                if (cause := bus_error(bus)) is None:
                    self._connection.come_up("the interface is open again, waiting for frames")
                    return bus
                _shut(bus)
                failure = f"CAN bus {self._options.title()}: {cause}"
            self._connection.stay_down(failure)
        return None


def monotonic_of(stamp: float, wall: float, monotonic: float) -> float:
    """The kernel's wall-clock ``stamp`` on the monotonic clock, given both clocks now (all in seconds).

    If the wall clock was set after the stamp, or if the interface stamps relative to its own start, this is
    ``monotonic``.
    """
    age = wall - stamp
    return monotonic - age if 0.0 <= age < MAX_STAMP_AGE else monotonic


def _is_off(bus: can.BusABC) -> bool:
    try:
        return bus.state is can.BusState.ERROR
    except Exception:  # noqa: BLE001 - many interfaces do not know their state
        return False


def _shut(bus: can.BusABC) -> None:
    try:
        bus.shutdown()
    except Exception as error:  # noqa: BLE001 - it is shut because it has failed
        log.debug("shutting the bus down: %s", error)
