"""From the messages of an OPC UA subscription to samples. No clock and no connection in here.

A server sends a value when it, its status or its time stamp changes; nothing means that nothing has changed. So a value
that stays is repeated at the time of the message (*held*), and once more one sample period before it changes.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import ua

from otolith_drivers.base import Sample, Signal
from otolith_drivers.common.periods import PeriodEstimator
from otolith_drivers.common.reconnection import PassingFault
from otolith_drivers.common.remote_clock import ExchangeClock, unix_time
from otolith_drivers.common.scaled import Conversion
from otolith_drivers.opcua.connection import OpcuaSource

HOLD_INTERVALS = 5.0  # messages without a change, after which a value is repeated at each message
MAX_AGE = 5.0  # s between the stamp of a value and its message; more is another clock, or a time zone
OVERFLOW = 0x480  # info bits of a status: of a data value, values before it were dropped (Part 4, 7.39.1)


@dataclass(slots=True, eq=False)
class NodeSignal:
    """A signal, its variable, and what has come of it."""

    signal: Signal
    conversion: Conversion | None = None
    """None until the unit is known."""
    node: Any = None
    """Its variable on the server, a ``ua.NodeId``; None until it is looked up."""
    fault: str = ""
    """Why the server does not send it; empty if it does."""
    value: float = math.nan
    """The latest value in the unit of the twin."""
    time: float = -math.inf
    """Of the latest sample, s."""
    known: float = -math.inf
    """When the latest value arrived, s."""
    is_held: bool = False
    """Whether the latest sample was a repeated one."""
    unusable: PassingFault = field(default_factory=PassingFault)
    """Values that could not be used."""
    periods: PeriodEstimator = field(default_factory=PeriodEstimator)

    @property
    def source(self) -> OpcuaSource:
        """Where it is read."""
        source: OpcuaSource = self.signal.source
        return source

    def warnings(self, now: float) -> list[str]:
        """Return what is wrong at ``now`` (s), a line each."""
        name = self.signal.name
        return [f"{name}: {self.fault}"] if self.fault else self.unusable.warnings(now, name)


class Readings:
    """Samples of the signals of a driver, in the order of their times."""

    def __init__(self, signals: Sequence[Signal], period: float, *, use_server_stamps: bool) -> None:
        """``period`` is the sampling period in s that is asked of the server."""
        self.signals = [NodeSignal(signal) for signal in signals]
        self.clock = ExchangeClock()
        self.received = self.bad = self.lost = 0
        self.server_stamped = 0
        """Values without a source time stamp, although those are asked for."""
        self._period, self._use_server_stamps = period, use_server_stamps
        self._interval = math.inf  # s between messages
        self._sequence: int | None = None
        self._fresh: set[NodeSignal] = set()

    def begin(self, interval: float) -> None:
        """Begin a subscription that sends every ``interval`` s; the first value of each signal may be an old one."""
        self._interval, self._sequence, self._fresh = interval, None, set(self.signals)
        for node in self.signals:
            node.value = math.nan

    def take(
        self, message: ua.NotificationMessage, values: Iterable[tuple[int, ua.DataValue]], now: float
    ) -> list[Sample]:
        """Return the samples of a message that came at ``now`` (s); ``values`` has the index of each value's signal."""
        values = list(values)
        self._count_gap(message, is_empty=not values)
        published = unix_time(message.PublishTime) + self.clock.offset
        samples: list[Sample] = []
        for index, value in values:
            samples += self._samples(self.signals[index], value, unix_time(message.PublishTime), now)
        held = published - self._interval - self.clock.error
        for node in self.signals:
            quiet = held - max(node.time, node.known if not node.is_held else -math.inf)
            if math.isfinite(node.value) and quiet > (0.0 if node.is_held else HOLD_INTERVALS * self._interval):
                node.is_held = True
                samples.append(self._sample(node, held, node.value))
        self.received += sum(math.isfinite(sample.value) for sample in samples)
        return samples

    def _count_gap(self, message: ua.NotificationMessage, *, is_empty: bool) -> None:
        """Count the messages that are missing; an empty one has the number of the next one that is not."""
        number = message.SequenceNumber
        if self._sequence is not None and number > self._sequence:
            self.lost += (number - self._sequence) * len(self.signals)
        self._sequence = number if is_empty else number + 1

    def _samples(self, node: NodeSignal, value: ua.DataValue, published: float, now: float) -> list[Sample]:
        """Return the sample of a value, and before it the value that it replaces if that was held until then."""
        stamp, before = self._stamp(value, published), node.value
        is_first, node.known = node in self._fresh, now
        self._fresh.discard(node)
        status = value.StatusCode if value.StatusCode is not None else ua.StatusCode()
        number = None if value.Value is None else value.Value.Value
        node.value = node.conversion.value(number) if node.conversion is not None and status.is_good() else math.nan
        overflow = status.value & OVERFLOW == OVERFLOW
        self.lost += overflow
        if not abs(published - stamp) <= MAX_AGE:
            if not is_first or stamp > published:  # the first one may be as old as it likes: it is still the value
                node.value = math.nan
                self._reject(node, f'stamped {published - stamp:.1f} s before it was sent: set stamps = "server"', now)
            return []
        time = min(stamp + self.clock.offset, now)
        if time < node.time:
            if not node.is_held:
                self._reject(node, f"stamped {node.time - time:.3g} s before the value before it", now)
                return []
            time = node.time
        if math.isnan(node.value):
            self._reject(node, _why_unusable(status, number, node), now)
            return [self._sample(node, time, math.nan)]
        self.lost += node.periods.lost_before(time)
        last = time - self._period
        fill = node.is_held and not overflow and last > node.time and math.isfinite(before)
        samples = [self._sample(node, last, before)] if fill else []
        node.is_held = False
        return [*samples, self._sample(node, time, node.value)]

    def _stamp(self, value: ua.DataValue, published: float) -> float:
        """Return the time of a value on the server's clock, s."""
        if value.SourceTimestamp is not None and not self._use_server_stamps:
            return unix_time(value.SourceTimestamp)
        self.server_stamped += not self._use_server_stamps
        return unix_time(value.ServerTimestamp) if value.ServerTimestamp is not None else published

    def _reject(self, node: NodeSignal, why: str, now: float) -> None:
        self.bad += 1
        node.unusable.note(why, now)

    @staticmethod
    def _sample(node: NodeSignal, time: float, value: float) -> Sample:
        node.time = time
        return Sample(node.signal.name, time, value)


def _why_unusable(status: ua.StatusCode, number: Any, node: NodeSignal) -> str:
    if not status.is_good():
        return f"status {status.name}"
    if not isinstance(number, bool | int | float):
        return f"a {type(number).__name__} instead of a number"
    source, unit = node.source, node.source.unit or "the server's unit"
    limits = f" (range {list(source.range)} {unit})" if source.range is not None else ""
    return f"the number {number:.6g} is out of range or not finite{limits}"
