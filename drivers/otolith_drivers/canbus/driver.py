"""The CAN driver: hears the frames of its signals on a channel that drivers share.

It cannot disturb the machine: nothing in this package sends. ``channel.py`` receives frames, and ``decoder.py`` makes
samples of them.
"""

import logging
import math
import time
from dataclasses import dataclass, replace

from otolith_drivers.base import Counters, Deliver, Link, Sampling, Setup
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.channel import CanChannel, CanListener, silence_limit
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.options import CanSource, FrameOptions
from otolith_drivers.common.sharing import Delivery

log = logging.getLogger(__name__)


class CanOptions(BusOptions, FrameOptions):
    """``[driver]`` with ``type = "can"``."""


Options = CanOptions  # the names that otolith_drivers.base.DriverType asks for
Source = CanSource


def build(options: CanOptions, setup: Setup) -> "CanReceiver":
    """A receiver of the frames with the signals of ``setup``; raises as :func:`.decoder.decoder_of`."""
    return CanReceiver(options, decoder_of(options, setup))


@dataclass(frozen=True, slots=True)
class _Hearing:
    """A channel, who listens to it, and what the channel had counted before."""

    channel: CanChannel
    listener: CanListener
    reconnects: int
    unreadable: int
    dropped: int
    frames: int

    def lost(self) -> int:
        """Frames that this computer did not read, as far as they were probably of this machine."""
        dropped, frames = self.channel.drops.total - self.dropped, self.channel.frames - self.frames
        return math.ceil(dropped * min(self.listener.frames / frames, 1.0)) if frames else dropped


class CanReceiver:
    """Implements :class:`otolith_drivers.base.Driver` over python-can."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: BusOptions, decoder: FrameDecoder) -> None:
        self._options, self._decoder = options, decoder
        self._hearing: _Hearing | None = None

    def open(self, deliver: Deliver) -> None:
        listener = CanListener(self._decoder, Delivery(deliver, log))
        place, options = self._options.place(), self._options.agreed()
        channel = CanChannel.join(place, listener, lambda: CanChannel(self._options), options)
        try:
            channel.open()
        except BaseException:
            channel.leave(listener)
            raise
        counts = (channel.connection.count, channel.unreadable.count, channel.drops.total, channel.frames)
        self._hearing = _Hearing(channel, listener, *counts)
        for line in self._decoder.configuration_warnings:
            log.warning("%s", line)
        self._decoder.begin(time.monotonic())

    def close(self) -> None:
        if self._hearing is not None:
            self._hearing.listener.delivery.end()
            self._hearing.channel.leave(self._hearing.listener)

    def counters(self) -> Counters:
        counters, hearing = self._decoder.counters, self._hearing
        if hearing is None:
            return counters
        return replace(
            counters,
            bad=counters.bad + hearing.channel.unreadable.count - hearing.unreadable,
            # The period or the counter of a message shows dropped frames as well, unless it has neither.
            lost=max(counters.lost, hearing.lost()),
            reconnects=hearing.channel.connection.count - hearing.reconnects,
        )

    def link(self) -> Link:
        if self._hearing is None:
            return Link(up=False, reason="not opened yet")
        channel, listener = self._hearing.channel, self._hearing.listener
        up, reason = channel.connection.state
        if not up:
            return Link(up=False, reason=reason)
        if self._decoder.faults.bus_off:
            return Link(up=False, reason="bus off: the controller has left the bus after too many errors")
        now = time.monotonic()
        silence = now - channel.last_frame
        silent = [f"no frame at all for {silence:.1f} s"] if silence > silence_limit(self._decoder) else []
        unreadable = channel.unreadable.warnings(now)
        warnings = (*silent, *unreadable, *channel.drops.warnings(now), *self._decoder.warnings(now))
        defects = (self._decoder.defect(now), listener.delivery.defect(now), channel.own_faults.defect(now))
        defect = "; ".join(filter(None, defects))
        return Link(up=True, warnings=warnings, latency=self._decoder.latency, defect=defect)

    def describe(self) -> list[str]:
        return [f"CAN bus {self._options.title()}, receive only", *self._decoder.describe()]
