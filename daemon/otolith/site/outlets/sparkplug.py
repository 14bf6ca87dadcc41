"""A node of Sparkplug B with a device for each machine: births, data, deaths and the command that asks for births.

By the specification 3.0.0. Each connection begins with the births of all machines; then only what has changed is sent.
"""

import contextlib
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

from paho.mqtt import client as mqtt

from otolith.health.schema import Status
from otolith.outlet_tables import SparkplugOutlet
from otolith.site.known import MAX_PARAMETERS
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup
from otolith.site.outlets.connections import failure
from otolith.site.outlets.mqtt import (
    ANSWER_TIMEOUT,
    CLOSING,
    BrokerAccess,
    access_of,
    client_of,
    connect,
    publish,
    wait_until_taken,
)
from otolith_drivers.grammars.json_lines import json_text
from otolith_drivers.grammars.sparkplug_payload import (
    REBIRTH,
    DataType,
    Properties,
    SparkplugMetric,
    asks_for_rebirth,
    payload,
)
from otolith_drivers.outside_text import visible

MAX_NAME = 100  # characters of the name of a parameter: docs/reference/thresholds-site.md has its origin
NUMBERS = 256  # Sequence numbers and births begin anew after this many
GOOD, STALE, BAD = 192, 500, 0  # The property Quality, of the specification
QUALITIES = {Status.ESTIMATED: GOOD, Status.HELD: STALE}  # The others are bad
MAX_TIME = 1e11  # s since 1970 that are a time
LIMITS = ("low", "high", "limit", "nominal")

Metrics = dict[str, SparkplugMetric]


class SparkplugNode:
    """Implements :class:`otolith.site.outlets.base.Outlet`."""

    def __init__(self, options: SparkplugOutlet, access: BrokerAccess, node: str) -> None:
        self._options, self._access, self._node = options, access, node
        self._client: mqtt.Client | None = None
        self._births = int(time.time()) % NUMBERS  # bdSeq: another one than that of a node that was killed just now
        self._number = 0  # seq
        self._counted = 0  # Machines that the node has said to have
        self._devices: dict[str, Metrics] = {}  # What is known of machines that report, by site and name
        self._born: set[str] = set()  # Those of which this connection has published the birth
        self._rebirth = threading.Event()

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Publish births, what has changed, and deaths; see :class:`otolith.site.outlets.base.Outlet`."""
        client = self._connected()
        last: mqtt.MQTTMessageInfo | None = None
        try:
            if self._rebirth.is_set():
                self._rebirth.clear()
                self._publish_birth(client)
            for view in views:
                last = self._show(client, view) or last
            for key in gone:
                last = self._bury(client, key) or last
            last = self._count(client) or last
            for notice in notices:
                event = SparkplugMetric("Event", DataType.STRING, json_text(dict(notice.document())), _now())
                last = self._publish(client, "NDATA", "", [event])
            wait_until_taken(client, last)
        except (OSError, ValueError, RuntimeError) as error:
            self.close()
            raise OutletError(failure(error, self._options.host)) from error
        notices.clear()
        return True

    def close(self) -> None:
        """Publish the death of the node, and end the connection."""
        client, self._client = self._client, None
        if client is not None:
            with contextlib.suppress(ValueError, RuntimeError, OSError):  # it was lost: the broker says it then
                client.publish(self._topic("NDEATH"), self._death(), qos=1).wait_for_publish(CLOSING)
            client.disconnect()
            client.loop_stop()

    def _connected(self) -> mqtt.Client:
        """Return the client, connected anew, with the births of what is known, if it is not."""
        if self._client is not None and self._client.is_connected():
            return self._client
        self.close()
        self._births = (self._births + 1) % NUMBERS
        client, command = client_of(self._options, self._access), self._topic("NCMD")
        client.will_set(self._topic("NDEATH"), self._death(), qos=1, retain=False)
        subscribed, refusal = threading.Event(), list[str]()

        def on_message(_: mqtt.Client, __: Any, message: mqtt.MQTTMessage) -> None:
            if message.topic == command and asks_for_rebirth(bytes(message.payload)):
                self._rebirth.set()

        def on_subscribe(_: mqtt.Client, __: Any, ___: int, codes: Sequence[Any], ____: Any) -> None:
            refusal.extend(str(code) for code in codes if code.is_failure)
            subscribed.set()

        client.on_message, client.on_subscribe = on_message, on_subscribe
        connect(client, self._options)
        self._client = client
        client.subscribe(command, 1)
        if not subscribed.wait(ANSWER_TIMEOUT) or refusal:
            self.close()
            reason = refusal[0] if refusal else "no answer"
            remedy = "allow it in the access list of the broker"
            raise OutletError(f"{self._options.host}: this client may not subscribe {command}: {reason}: {remedy}")
        self._rebirth.clear()
        self._publish_birth(client)
        return client

    def _topic(self, kind: str, device: str = "") -> str:
        return "/".join(filter(None, ("spBv1.0", self._options.group, kind, self._node, device)))

    def _death(self) -> bytes:
        return payload([SparkplugMetric("bdSeq", DataType.INT64, self._births, _now())], _now(), None)

    def _publish_birth(self, client: mqtt.Client) -> None:
        """Publish the births of the node and of all machines that report."""
        now = _now()
        own = [
            SparkplugMetric("bdSeq", DataType.INT64, self._births, now),
            SparkplugMetric(REBIRTH, DataType.BOOLEAN, False, now),
            SparkplugMetric("Machines", DataType.INT32, len(self._devices), now),
            SparkplugMetric("Event", DataType.STRING, None, now),
        ]
        self._number, self._counted = 0, len(self._devices)
        self._publish(client, "NBIRTH", "", own)
        self._born.clear()
        for key, metrics in self._devices.items():
            self._publish(client, "DBIRTH", _device(key), list(metrics.values()))
            self._born.add(key)

    def _show(self, client: mqtt.Client, view: MachineView) -> mqtt.MQTTMessageInfo | None:
        """Publish what has changed of a machine; one that is silent is dead."""
        if view.report is None:
            return self._bury(client, view.key)
        own = {metric.name: metric for metric in _metrics(view)}
        before = self._devices.get(view.key, {})
        self._devices[view.key] = own
        if view.key not in self._born or {name: metric.type for name, metric in own.items()} != {
            name: metric.type for name, metric in before.items()
        }:
            self._born.add(view.key)
            return self._publish(client, "DBIRTH", _device(view.key), list(own.values()))
        changed = [metric for name, metric in own.items() if not _is_same(metric, before[name])]
        return self._publish(client, "DDATA", _device(view.key), changed) if changed else None

    def _count(self, client: mqtt.Client) -> mqtt.MQTTMessageInfo | None:
        """Publish how many machines there are, if that has changed."""
        if self._counted == (count := len(self._devices)):
            return None
        self._counted = count
        return self._publish(client, "NDATA", "", [SparkplugMetric("Machines", DataType.INT32, count, _now())])

    def _bury(self, client: mqtt.Client, key: str) -> mqtt.MQTTMessageInfo | None:
        """Publish the death of a machine that was born."""
        self._devices.pop(key, None)
        if key not in self._born:
            return None
        self._born.discard(key)
        return self._publish(client, "DDEATH", _device(key), [])

    def _publish(
        self, client: mqtt.Client, kind: str, device: str, metrics: Sequence[SparkplugMetric]
    ) -> mqtt.MQTTMessageInfo:
        content = payload(metrics, _now(), self._number)
        self._number = (self._number + 1) % NUMBERS
        return publish(client, self._topic(kind, device), content, qos=0, retain=False)


def _now() -> int:
    return _milliseconds(time.time())


def _milliseconds(seconds: float) -> int:
    """Return ms; 0 for what is no time, which a report may have."""
    return int(1e3 * seconds) if 0.0 <= seconds < MAX_TIME else 0


def _device(key: str) -> str:
    """Return the name of the device of a machine; neither a site nor a machine has a point in its name."""
    return key.replace("/", ".")


def _is_same(metric: SparkplugMetric, before: SparkplugMetric) -> bool:
    return (metric.value, metric.properties) == (before.value, before.properties)


def _metrics(view: MachineView) -> Iterator[SparkplugMetric]:
    """Yield the metrics of a machine that reports."""
    report = view.report
    if report is None:
        return
    at = _milliseconds(report.window.end)
    for name, text in (("State", str(view.state)), ("What", view.what), ("Advice", view.advice)):
        yield SparkplugMetric(name, DataType.STRING, text, at)
    since = None if view.since is None else _milliseconds(view.since)
    yield SparkplugMetric("Since", DataType.DATE_TIME, since, at)
    yield SparkplugMetric("Open Events", DataType.INT32, len(report.open_events), at)
    for name, row in islice(report.parameters.items(), MAX_PARAMETERS):
        own = f"Parameters/{visible(name, MAX_NAME).replace('/', '%2F')}"
        unit: Properties = {"engUnit": (DataType.STRING, visible(row.unit, MAX_NAME))}
        rated: Properties = {"Quality": (DataType.INT32, QUALITIES.get(row.status, BAD)), **unit}
        yield SparkplugMetric(f"{own}/Value", DataType.DOUBLE, _double(row.value), at, rated)
        for limit in LIMITS:
            value = _double(getattr(row, limit))
            yield SparkplugMetric(f"{own}/{limit.title()}", DataType.DOUBLE, value, at, unit)


def _double(value: float | None) -> float | None:
    return None if value is None else float(value)


def build(options: SparkplugOutlet, setup: OutletSetup) -> SparkplugNode:
    """Return the outlet; raise ConfigurationError if a file cannot be used."""
    node = options.node or setup.sender.replace("/", ".") or "site"
    return SparkplugNode(options, access_of(options, setup), node)
