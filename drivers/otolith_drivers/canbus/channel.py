"""One reader of a CAN bus for all drivers of this process: it receives frames, gives each its time, and reconnects.

Each driver gets the frames of its own identifiers only, and error frames. Nothing that decoding or delivering does for
one of them reaches the others.
"""

import logging
import threading
import time

import can

from otolith_drivers.base import Sample
from otolith_drivers.canbus.bus import (
    MAX_CONSECUTIVE_BAD,
    BusOptions,
    DropCounter,
    bus_error,
    enlarge_buffer,
    frames_dropped,
    is_gone,
    open_bus,
    set_filters,
)
from otolith_drivers.canbus.decoder import EXTENDED, FrameDecoder
from otolith_drivers.common.clocks import wall_clock_offset
from otolith_drivers.common.reconnection import OwnFaults, PassingFault, Reconnection, ThreadedDriver
from otolith_drivers.common.sharing import Delivery, SharedConnection
from otolith_drivers.errors import DeviceError

log = logging.getLogger(__name__)

RECEIVE_TIMEOUT = 0.2  # s; how late a stop may be noticed
MAX_STAMP_AGE = 1.0  # s; an older kernel stamp is from before the wall clock was set
CLOCK_CHECK_PERIOD = 0.05  # s; how long a wall clock that was set can falsify times
GATHERING_TIME = 0.002  # s; frames of a busy bus are received together, so that not each of them wakes the thread
MIN_GATHERED, MAX_GATHERED = 4, 1000  # frames in that time on a busy bus; frames that are received together
SILENT_PERIODS, MIN_SILENCE, MAX_SILENCE = 10.0, 2.0, 60.0  # periods; s; s: when a silent bus is opened anew
UNKNOWN_PERIOD_SILENCE = 10.0  # s; the same while no period is known
MAX_ROUTES = 4096  # identifiers of which it is known who decodes them; a bus of machines has some hundred


class CanListener:
    """What one driver hears of a channel."""

    def __init__(self, decoder: FrameDecoder, delivery: Delivery) -> None:
        self.decoder, self.delivery = decoder, delivery
        self.frames = 0  # That it was given
        self._samples = list[Sample]()

    def hear(self, frame: can.Message, time: float) -> None:
        """Take a frame of ``time`` (s)."""
        self.frames += 1
        self._samples += self.decoder.decode(frame, time)

    def hand_over(self) -> None:
        """Deliver the samples of the frames since the last call."""
        samples, self._samples = self._samples, []
        self.delivery.hand_over(samples)


class CanChannel(ThreadedDriver, SharedConnection[CanListener]):
    """The bus, open, with the thread that receives from it."""

    def __init__(self, options: BusOptions) -> None:
        ThreadedDriver.__init__(self)
        SharedConnection.__init__(self)
        self.connection = Reconnection(f"CAN bus {options.title()}", log)
        self.unreadable = PassingFault()  # Frames that python-can cannot unpack
        self.drops = DropCounter()
        self.own_faults = OwnFaults(log)
        self.frames = 0  # Received
        self.last_frame = 0.0  # s; when the latest one came, or the bus was opened
        self._options = options
        self._opening = threading.Lock()
        self._routes: dict[object, tuple[CanListener, ...]] = {}  # Who decodes the frames of an identifier
        self._has_filters = False  # Whether the bus has those of the present users
        self._is_off = False
        self._consecutive_bad = 0
        self._opened = 0.0
        self._gathers = False
        self._next_reopening = 0.0  # s of silence after which the bus is opened anew; doubles each time

    def open(self) -> None:
        """Open the bus if it is not; raise DeviceError if it cannot be opened."""
        with self._opening:
            if self._thread is None:
                bus = self._connect()
                self.connection.come_up("is open")
                self.last_frame = self._opened
                self._start("can-receive", self._receive, bus)

    def users_changed(self) -> None:
        """Give the frames to those who are there now."""
        self._routes, self._has_filters = {}, False

    def _connect(self) -> can.BusABC:
        self._has_filters = True  # a user who comes after this line changes it
        bus = open_bus(self._options, self._filters(), listen_only=True)
        enlarge_buffer(bus)
        self.drops.restart()
        self._consecutive_bad = 0
        self._opened = time.monotonic()
        self._note_active()
        return bus

    def _filters(self) -> list[can.typechecking.CanFilter]:
        wanted = dict.fromkeys(row for user in self.users for row in user.decoder.filters())
        return [{"can_id": identifier, "can_mask": mask, "extended": extended} for identifier, mask, extended in wanted]

    def _receive(self, bus: can.BusABC | None) -> None:
        while not self._stop.is_set():
            if bus is None:
                bus = self._reconnect()
                continue
            try:
                failure = self._take_frames(bus)
            except Exception as error:  # noqa: BLE001 - the thread serves all machines
                self.own_faults.note(error, "receiving frames", time.monotonic())
                failure = f"{type(error).__name__}: {error}"
            if failure is not None:
                self.connection.go_down(failure)
                _shut(bus)
                bus = None
        if bus is not None:
            _shut(bus)

    def _take_frames(self, bus: can.BusABC) -> str | None:
        """Take frames until the next clock check; returns why the bus must be opened anew, or None."""
        if not self._has_filters:
            self._has_filters = True
            set_filters(bus, self._options, self._filters())
        clock = time.monotonic
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
            if frames:
                self._distribute(frames, now + offset, now)
                count += len(frames)
                self.last_frame, self._consecutive_bad = now, 0
            if failure is not None:
                return None if self._is_only_a_bad_frame(failure) else f"{type(failure).__name__}: {failure}"
            if not frames:
                break
        is_busy = count * GATHERING_TIME >= MIN_GATHERED * (now - begun)
        self._gathers = is_busy and self._options.stamped_by_kernel
        return self._check_bus(bus, now)

    def _distribute(self, frames: list[can.Message], wall: float, now: float) -> None:
        """Give each frame to those who decode it, and then to each of them the samples; ``wall`` and ``now`` are s."""
        self.frames += len(frames)
        hearing: dict[CanListener, None] = {}
        for frame in frames:
            time_of_frame, listeners = monotonic_of(frame.timestamp, wall, now), self._listeners_of(frame)
            for listener in listeners:
                listener.hear(frame, time_of_frame)
            if frame.is_error_frame:
                self._is_off = any(listener.decoder.faults.bus_off for listener in listeners)
            elif self._is_off:
                self._note_active()
            hearing.update(dict.fromkeys(listeners))
        for listener in hearing:
            listener.hand_over()

    def _listeners_of(self, frame: can.Message) -> tuple[CanListener, ...]:
        """Return who decodes a frame; of an error frame, or one whose identifier is none, these are all."""
        routes, users = self._routes, self.users  # in this order: routes of users who have left are of no use
        if frame.is_error_frame:
            return users
        try:
            key = frame.arbitration_id + EXTENDED if frame.is_extended_id else frame.arbitration_id
            known = routes.get(key)
            if known is None:
                identifier, extended = frame.arbitration_id, bool(frame.is_extended_id)
                known = tuple(user for user in users if user.decoder.hears(identifier, extended=extended))
                if len(routes) >= MAX_ROUTES:
                    routes.clear()
                routes[key] = known
        except TypeError:
            return users
        return known

    def _note_active(self) -> None:
        """Note that the controller takes part in the bus, as a frame has come or it was opened anew."""
        self._is_off = False
        for user in self.users:
            user.decoder.faults.bus_off = False

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
        self.drops.note(frames_dropped(bus), now)
        if _is_off(bus):
            self._is_off = True
            for user in self.users:
                user.decoder.faults.bus_off = True
        if now - self.last_frame < RECEIVE_TIMEOUT:
            self._next_reopening = 0.0
            return None
        silence = now - max(self.last_frame, self._opened)
        if silence < max(self._next_reopening, self._silence_limit()):
            return None
        # Some interfaces never report that their other end has gone.
        self._next_reopening = min(2.0 * silence, MAX_SILENCE)
        return f"no frame for {silence:.1f} s"

    def _silence_limit(self) -> float:
        """Return the time (s) for which the slowest machine is waited for, but not for long at the cost of others."""
        limits = [silence_limit(user.decoder) for user in self.users] or [UNKNOWN_PERIOD_SILENCE]
        return min(max(limits), max(MAX_SILENCE, min(limits)))

    def _is_only_a_bad_frame(self, error: Exception) -> bool:
        """Whether a frame could not be unpacked while the bus itself works; counts such frames."""
        if is_gone(error):
            return False
        self._consecutive_bad += 1
        self.unreadable.note(f"a frame cannot be unpacked ({type(error).__name__}: {error})", time.monotonic())
        return self._consecutive_bad <= MAX_CONSECUTIVE_BAD

    def _reconnect(self) -> can.BusABC | None:
        """Try until it succeeds, with growing random pauses; None if the channel is closed meanwhile."""
        while not self._stop.wait(self.connection.backoff.next()):
            try:
                bus = self._connect()
            except Exception as error:  # noqa: BLE001 - as above
                failure = str(error) if isinstance(error, DeviceError) else f"{type(error).__name__}: {error}"
            else:
                if (cause := bus_error(bus)) is None:
                    self.connection.come_up("the interface is open again, waiting for frames")
                    return bus
                _shut(bus)
                failure = f"CAN bus {self._options.title()}: {cause}"
            self.connection.stay_down(failure)
        return None


def silence_limit(decoder: FrameDecoder) -> float:
    """Return the time (s) without a frame, after which there should have been one."""
    period = decoder.slowest_period()
    return UNKNOWN_PERIOD_SILENCE if period is None else max(MIN_SILENCE, SILENT_PERIODS * period)


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
