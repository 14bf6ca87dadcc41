"""The OPC UA driver: subscribes to variables of a server, and reconnects after every fault. It can only read.

The time of a sample is the source's time stamp, which is on the server's clock. That clock is compared with this
computer's by the times in the answers, so the error of the times is bounded (see ``common/message_times.py``).

A server sends a value when it, its status or its time stamp changes; nothing means that nothing has changed. So a value
that stays is repeated at the time of the message (*held*), and once more one sample period before it changes. The way
from messages to samples (:class:`Readings`) has no clock and no connection.
"""

import asyncio
import logging
import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from asyncua import Client, ua

from otolith_drivers.base import Conversion, Counters, Deliver, Link, Sample, Sampling, Setup, Signal
from otolith_drivers.common.clocks import wall_clock_offset
from otolith_drivers.common.message_times import ExchangeClock, PeriodEstimator, unix_time
from otolith_drivers.common.reconnection import OwnFaults, PassingFault, Reconnection
from otolith_drivers.common.sharing import Delivery
from otolith_drivers.errors import counted
from otolith_drivers.opcua.connection import (
    OpcUaCredentials,
    OpcuaOptions,
    OpcuaSource,
    RefusedError,
    namespaces,
    place,
    reason,
    unit_of,
)
from otolith_drivers.opcua.session import EXPECTED, OpcuaSession

log = logging.getLogger(__name__)

SILENT_INTERVALS, MIN_SILENCE = 20.0, 2.0  # messages; s: without one, the connection is opened anew
KEEPALIVE = 1  # intervals without a value, after which the server sends an empty message
QUEUE_MARGIN = 4  # messages that the server's queue of a variable can hold back
HOLD_INTERVALS = 5.0  # messages without a change, after which a value is repeated at each message
MAX_AGE = 5.0  # s between the stamp of a value and its message; more is another clock, or a time zone
FIRST_RETRY, LAST_RETRY = 2.0, 60.0  # s, doubled from one to the other: when missing variables are asked for again
GONE = (ua.StatusCodes.BadNodeIdUnknown, ua.StatusCodes.BadNodeIdInvalid)  # of a variable that the server has removed
OVERFLOW = 0x480  # info bits of a status: of a data value, values before it were dropped (Part 4, 7.39.1)


@dataclass(slots=True, eq=False)
class NodeSignal:
    """A signal, its variable, and what has come of it."""

    signal: Signal
    conversion: Conversion | None = None  # None until the unit is known
    node: Any = None  # Its variable on the server, a ua.NodeId; None until it is looked up
    item: int | None = None  # Its number in the subscription, None if it is not in it
    namespace: str = ""  # URI of its namespace at the first connection
    defect: str = ""  # How its namespace has changed since then
    fault: str = ""  # Why the server does not send it; empty if it does
    value: float = math.nan  # The latest value in the unit of the twin
    time: float = -math.inf  # Of the latest sample, s
    known: float = -math.inf  # When the latest value arrived, s
    is_held: bool = False  # Whether the latest sample was a repeated one
    unusable: PassingFault = field(default_factory=PassingFault)  # Values that could not be used
    periods: PeriodEstimator = field(default_factory=PeriodEstimator)

    @property
    def source(self) -> OpcuaSource:
        """Where it is read."""
        source: OpcuaSource = self.signal.source
        return source

    def warnings(self, now: float) -> list[str]:
        """Return what is wrong at ``now`` (s), a line each."""
        name, fault = self.signal.name, self.fault  # the event loop may change it
        return [f"{name}: {fault}"] if fault else self.unusable.warnings(now, name)


class Readings:
    """Samples of the signals of a driver, in the order of their times."""

    def __init__(self, signals: Sequence[Signal], period: float, *, use_server_stamps: bool) -> None:
        """``period`` is the sampling period in s that is asked of the server."""
        self.signals = [NodeSignal(signal) for signal in signals]
        self.clock = ExchangeClock()
        self.received = self.bad = self.lost = 0
        self.server_stamped = 0  # Values without a source time stamp, although those are asked for
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
                age = f"{abs(published - stamp):.1f} s {'before' if stamp < published else 'after'}"
                self._reject(node, f'stamped {age} it was sent: set stamps = "server"', now)
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
    if node.conversion is None:
        return "a number of which the unit is not known"
    return f"a number that {node.conversion.why_no_value(number)}"


Options, Source = OpcuaOptions, OpcuaSource  # for base.DriverType


def build(options: OpcuaOptions, setup: Setup) -> "OpcuaSubscriber":
    """Return a subscriber to all signals; raise ConfigurationError for a wrong unit, certificate, key or password."""
    credentials = OpcUaCredentials.load(options, setup.folder)
    readings = Readings(setup.signals, setup.sample_period, use_server_stamps=options.stamps == "server")
    for node in readings.signals:
        if node.source.unit is not None:
            node.conversion = Conversion.for_signal(node.signal)
    return OpcuaSubscriber(options, credentials, readings, setup.sample_period)


class OpcuaSubscriber:
    """Implements :class:`otolith_drivers.base.Driver` over asyncua, with a session that drivers share."""

    sampling = Sampling.POLLED

    def __init__(self, options: OpcuaOptions, credentials: OpcUaCredentials, readings: Readings, period: float) -> None:
        self._options, self._credentials, self._readings, self._period = options, credentials, readings, period
        self._connection = Reconnection(f"OPC UA {options.endpoint}", log)
        self._subscription: _Subscription | None = None
        self._session: OpcuaSession | None = None

    def open(self, deliver: Deliver) -> None:
        delivery = Delivery(deliver, log)
        subscription = _Subscription(self._options, self._readings, self._period, self._connection, delivery)
        place = OpcuaSession.place(self._options, self._credentials)
        session = OpcuaSession.join(place, subscription, lambda: OpcuaSession(self._options, self._credentials))
        self._subscription, self._session, self._readings.clock = subscription, session, session.clock
        self._connection.stay_down(session.cause)
        session.open()

    def close(self) -> None:
        if self._subscription is not None and self._session is not None:
            self._subscription.delivery.end()
            self._session.leave(self._subscription)

    def counters(self) -> Counters:
        readings = self._readings
        return Counters(readings.received, readings.bad, readings.lost, self._connection.count)

    def link(self) -> Link:
        readings, now, (up, reason) = self._readings, time.monotonic(), self._connection.state
        subscription, session = self._subscription, self._session
        lines = [*session.certificate_warnings] if session is not None else []
        lines += [line for node in readings.signals for line in node.warnings(now)]
        if readings.server_stamped:
            lines.append(f"{readings.server_stamped} values without a source time stamp have that of the server")
        plan = ""
        if readings.clock.known:
            ahead = -wall_clock_offset() - readings.clock.offset
            where = "ahead of" if ahead > 0.0 else "behind"
            bound = f"{1e3 * readings.clock.error:.2g} ms"
            plan = f"the server's clock is {abs(ahead):.4g} s {where} this computer's, known within {bound}"
            plan += f", set {counted(readings.clock.steps, 'time')}" if readings.clock.steps else ""
            plan += f", {subscription.slow}" if subscription is not None and subscription.slow else ""
        defects = [node.defect for node in readings.signals]
        if subscription is not None and session is not None:
            defects += [subscription.own_faults.defect(now), subscription.delivery.defect(now)]
            defects.append(session.own_faults.defect(now))
        defect = "; ".join(filter(None, dict.fromkeys(defects)))
        latency = self._options.interval if subscription is None else subscription.interval
        return Link(up, reason, tuple(lines) if up else (), plan, latency=latency, defect=defect)

    def describe(self) -> list[str]:
        nodes = [
            f"{node.signal.name} [{node.signal.unit}] from {node.source.node}"
            f" [{node.source.unit or 'the unit that the server gives'}]"
            for node in self._readings.signals
        ]
        return [*self._options.describe(), *nodes]


class _Subscription:
    """Implements :class:`.session.SessionUser`: the subscription of one driver, in the event loop of the session."""

    def __init__(
        self, options: OpcuaOptions, readings: Readings, period: float, connection: Reconnection, delivery: Delivery
    ) -> None:
        self.delivery, self.own_faults = delivery, OwnFaults(log)
        self.slow = ""  # what the server grants less than was asked
        self.interval = options.interval  # s between two messages
        self._options, self._readings, self._period, self._connection = options, readings, period, connection
        self._latest = -math.inf  # s; time of the latest message
        self._ended = ""  # why the subscription has ended

    def lose(self, cause: str) -> None:
        self._connection.go_down(cause)

    async def serve(self, session: OpcuaSession, client: Client) -> None:
        self._connection.backoff.reset()
        while True:
            try:
                await self._serve(session, client)
            except asyncio.CancelledError:
                raise
            except Exception as error:  # noqa: BLE001 - nothing of one machine may end the session of others
                if not isinstance(error, EXPECTED):
                    self.own_faults.note(error, "a subscription", time.monotonic())
                if session.holds(client):
                    self._connection.go_down(reason(error, self._options.timeout))
                    session.doubt()
            await asyncio.sleep(self._connection.backoff.next())

    async def _serve(self, session: OpcuaSession, client: Client) -> None:
        """Subscribe and take values until the subscription fails, which raises."""
        await self._look_up(client, self._readings.signals)
        subscription, interval = await self._subscribe(session, client)
        retry, pause = time.monotonic() + FIRST_RETRY, FIRST_RETRY
        limit = max(MIN_SILENCE, SILENT_INTERVALS * interval)
        while True:
            await asyncio.sleep(0.1 * limit)
            now = time.monotonic()
            if self._ended:
                raise ConnectionError(self._ended)
            if now - self._latest > limit:
                raise ConnectionError(f"no message of the subscription for {now - self._latest:.1f} s")
            if now >= retry:
                is_any_there = await self._ask_again(client, subscription)
                pause = FIRST_RETRY if is_any_there else min(2.0 * pause, LAST_RETRY)
                retry = now + pause

    async def _look_up(self, client: Client, nodes: Sequence[NodeSignal]) -> None:
        """Ask for the variables, and for the units that the machine file leaves out."""
        spaces = await namespaces(client)
        for node in nodes:
            node.fault = ""
            try:
                placed = place(node.source.node, spaces, node.namespace)
            except ValueError as error:
                node.fault, node.defect = f"{node.source.node}: {error}", str(error) if node.namespace else ""
                continue
            node.node, node.namespace, node.defect = placed.node, placed.namespace, placed.moved
            if node.source.unit is not None:
                continue
            try:
                unit = await unit_of(client, node.node)
                node.conversion = Conversion.of(node.source, unit, node.signal.unit) if unit else None
                node.fault = "" if unit else f"{node.source.node} has no unit on the server: set 'unit' beside it"
            except (ua.UaStatusCodeError, ValueError) as error:
                node.conversion, node.fault = None, f"{node.source.node}: {error}; set 'unit' beside it"

    async def _ask_again(self, client: Client, subscription: int) -> bool:
        """Subscribe to the variables that the server lacked or removed; return whether one of them is there."""
        missing = [index for index, node in enumerate(self._readings.signals) if node.fault]
        if not missing:
            return False
        nodes = [self._readings.signals[index] for index in missing]
        gone = [node.item for node in nodes if node.item is not None]
        if gone:
            asked = ua.DeleteMonitoredItemsParameters(SubscriptionId=subscription, MonitoredItemIds=gone)
            await client.uaclient.session.delete_monitored_items(asked)
        await self._look_up(client, nodes)
        await self._monitor(
            client, subscription, [index for index in missing if not self._readings.signals[index].fault]
        )
        return not all(node.fault for node in nodes)

    async def _subscribe(self, session: OpcuaSession, client: Client) -> tuple[int, float]:
        """Subscribe to all variables; return the subscription and the time (s) between two messages."""
        readings = self._readings
        asked = ua.CreateSubscriptionParameters(
            RequestedPublishingInterval=self._options.interval * 1e3,
            RequestedLifetimeCount=10_000,
            RequestedMaxKeepAliveCount=KEEPALIVE,
        )
        readings.begin(self._options.interval)
        self._latest, self._ended, self.slow = time.monotonic(), "", ""
        result = await session.subscribe(client, self, asked, lambda message: self._guarded_take(message, session))
        interval = self.interval = 1e-3 * float(result.RevisedPublishingInterval)
        readings.begin(interval)
        for node in readings.signals:
            node.item = None
        await self._monitor(
            client, result.SubscriptionId, [index for index, node in enumerate(readings.signals) if not node.fault]
        )
        if all(node.fault for node in readings.signals):
            raise RefusedError(readings.signals[0].fault)
        return int(result.SubscriptionId), interval

    async def _monitor(self, client: Client, subscription: int, indices: Sequence[int]) -> None:
        """Add the signals ``indices`` to the subscription, without a filter where the server refuses it."""
        refused = await self._add(client, subscription, indices, by_stamp=True)
        await self._add(client, subscription, refused, by_stamp=False)

    async def _add(self, client: Client, subscription: int, indices: Sequence[int], *, by_stamp: bool) -> list[int]:
        """Add the signals ``indices`` to the subscription; return those whose filter the server refuses."""
        if not indices:
            return []
        nodes = [self._readings.signals[index] for index in indices]
        items = [self._item(node, index, by_stamp=by_stamp) for index, node in zip(indices, nodes, strict=True)]
        asked = ua.CreateMonitoredItemsParameters(
            SubscriptionId=subscription, TimestampsToReturn=ua.TimestampsToReturn.Both, ItemsToCreate=items
        )
        results = await client.uaclient.session.create_monitored_items(asked)
        refused = []
        for index, node, result in zip(indices, nodes, results, strict=True):
            node.item = result.MonitoredItemId if result.StatusCode.is_good() else None
            if by_stamp and "Filter" in result.StatusCode.name:
                refused.append(index)
            elif not result.StatusCode.is_good():
                hint = "'otolith probe opcua' lists the variables"
                node.fault = f"{node.source.node}: {result.StatusCode.name}: {hint}; it is asked for again"
            elif result.RevisedSamplingInterval > 1.5e3 * self._period:
                rates = f"every {result.RevisedSamplingInterval:g} ms instead of {self._period * 1e3:g} ms"
                self.slow = f"by its own account the server samples {node.signal.name} {rates}"
        return refused

    def _item(self, node: NodeSignal, index: int, *, by_stamp: bool) -> ua.MonitoredItemCreateRequest:
        """Return the request for a variable; with ``by_stamp`` it is also sent when only its time stamp changes."""
        parameters = ua.MonitoringParameters(
            ClientHandle=index,
            SamplingInterval=self._period * 1e3,
            QueueSize=max(10, math.ceil(QUEUE_MARGIN * self._options.interval / self._period)),
            DiscardOldest=True,
        )
        if by_stamp:
            parameters.Filter = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        where = ua.ReadValueId(NodeId=node.node, AttributeId=ua.AttributeIds.Value)
        return ua.MonitoredItemCreateRequest(
            ItemToMonitor=where, MonitoringMode=ua.MonitoringMode.Reporting, RequestedParameters=parameters
        )

    def _guarded_take(self, result: ua.PublishResult, session: OpcuaSession) -> None:
        try:
            self._take(result, session)
        except Exception as error:  # noqa: BLE001 - the library would drop it without a word
            self.own_faults.note(error, "reading a message of the server", time.monotonic())

    def _take(self, result: ua.PublishResult, session: OpcuaSession) -> None:
        """Take a message of the subscription; called in the event loop."""
        now = self._latest = time.monotonic()
        message, readings = result.NotificationMessage, self._readings
        values: list[tuple[int, Any]] = []
        for part in message.NotificationData or ():
            if isinstance(part, ua.StatusChangeNotification):
                self._ended = self._ended or f"the server has ended the subscription: {part.Status.name}"
            elif isinstance(part, ua.DataChangeNotification):
                values += [(item.ClientHandle, item.Value) for item in part.MonitoredItems]
        if not readings.clock.arrival(unix_time(message.PublishTime), now):  # the server's clock was set
            session.doubt()
        for index, value in values:
            if value.StatusCode is not None and value.StatusCode.value in GONE:
                node = readings.signals[index]
                node.fault = f"{node.source.node}: the server has removed it; it is asked for again"
        samples = readings.take(message, values, now)
        if values:  # also unusable ones: what is wrong with them is a warning of a link that is up
            self._connection.come_up("sends values")
        self.delivery.hand_over(samples)
