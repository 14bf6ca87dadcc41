"""States, parameters and events as JSON over MQTT, with the discovery of Home Assistant. It subscribes to nothing."""

import contextlib
import re
import secrets
import ssl
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from typing import Any

from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from otolith import __version__
from otolith.health.limits import Level
from otolith.health.schema import Language, ParameterDocument
from otolith.health.text import texts_in
from otolith.outlet_tables import BrokerOptions, MqttOutlet
from otolith.site.hall import SHOWN
from otolith.site.known import MAX_PARAMETERS
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup
from otolith.site.outlets.connections import failure, tls_context
from otolith.site.words import words_in
from otolith_drivers.common.credentials import password
from otolith_drivers.grammars.json_lines import json_text
from otolith_drivers.outside_text import visible

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
CONNECT_TIMEOUT = 3.0  # s for the network connection
ANSWER_TIMEOUT = 5.0  # s for the broker to accept the client, and its messages
CLOSING = 1.0  # s for the last message
KEEPALIVE = 15  # s without a message after which the broker is asked whether it is there
ONLINE, OFFLINE = "online", "offline"
IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")  # Names that a template of Home Assistant may have as they are


@dataclass(frozen=True, slots=True)
class BrokerAccess:
    """By what a broker lets this client in, and knows it again."""

    client_id: str  # The same for each connection: the broker ends the one before it, and its will comes first
    secret: str
    tls: ssl.SSLContext | None


def access_of(options: BrokerOptions, setup: OutletSetup) -> BrokerAccess:
    """Return what is in the files of a table; raise ConfigurationError if one cannot be used."""
    secret = password(None if options.password_file is None else setup.folder / options.password_file)
    pair = (options.certificate, options.key)
    tls = tls_context(setup.folder, options.ca, pair) if options.tls else None
    return BrokerAccess(options.client_id or f"otolith{secrets.token_hex(8)}", secret, tls)


def client_of(options: BrokerOptions, access: BrokerAccess) -> mqtt.Client:
    """Return a client, not connected."""
    client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=access.client_id, reconnect_on_failure=False)
    client.connect_timeout = CONNECT_TIMEOUT
    if options.user is not None:
        client.username_pw_set(options.user, access.secret)
    if access.tls is not None:
        client.tls_set_context(access.tls)
    return client


def connect(client: mqtt.Client, options: BrokerOptions) -> None:
    """Connect a client; raise OutletError if the broker is not there or refuses it."""
    answered, refusal = threading.Event(), list[str]()

    def on_connect(_: mqtt.Client, __: Any, ___: Any, code: Any, ____: Any) -> None:
        if code.is_failure:
            refusal.append(str(code))
        answered.set()

    client.on_connect = on_connect
    try:
        client.connect(options.host, options.port or (8883 if options.tls else 1883), KEEPALIVE)
        client.loop_start()
    except (OSError, ValueError) as error:
        raise OutletError(failure(error, options.host)) from error
    if not answered.wait(ANSWER_TIMEOUT) or refusal:
        client.disconnect()
        client.loop_stop()
        reason = f"refuses this client: {refusal[0]}" if refusal else "no answer: is a broker there, is tls right?"
        raise OutletError(f"{options.host}: {reason}")


class MqttPublisher:
    """Implements :class:`otolith.site.outlets.base.Outlet`. Each connection begins with all that is known."""

    def __init__(self, options: MqttOutlet, access: BrokerAccess, language: Language, sender: str) -> None:
        self._options, self._access, self._language = options, access, language
        self._sender = sender  # A machine of a daemon, or empty for a site
        self._availability = "/".join(filter(None, (options.prefix, sender, "status")))
        self._client: mqtt.Client | None = None
        self._shown: dict[str, tuple[str, str]] = {}  # Site and name of each machine of this connection
        self._configured: set[str] = set()  # Machines of which this connection has published configurations
        self._discovered: dict[str, frozenset[tuple[str, str]]] = {}  # Parameters and units of a machine

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Publish what has changed; see :class:`otolith.site.outlets.base.Outlet`."""
        client = self._connected()
        last: mqtt.MQTTMessageInfo | None = None
        try:
            if views or gone or notices:  # what another connection has left there ends with it: a will comes late
                last = _publish(client, self._availability, ONLINE, retain=True)
            for view in views:
                for topic, document in (*self._discovery(view), *self._documents(view)):
                    last = _publish(client, topic, document, retain=True)
                self._shown[view.key] = (view.site, view.name)
            for key in gone:
                self._shown.pop(key, None)
                for topic in (*self._topics(key), *self._forgotten(key)):
                    last = _publish(client, topic, None, retain=True)
            for notice in notices:
                topic = f"{self._options.prefix}/{notice.site}/{notice.machine}/event"
                last = _publish(client, topic, dict(notice.document()), retain=False)
            wait_until_taken(client, last)
        except (OSError, ValueError, RuntimeError) as error:
            self.close()
            raise OutletError(failure(error, self._options.host)) from error
        notices.clear()
        return True

    def close(self) -> None:
        """Say that the site is away and that nothing is known of its machines any more, and end the connection."""
        client, self._client = self._client, None
        shown, self._shown = self._shown, {}
        self._configured.clear()
        if client is not None:
            with contextlib.suppress(ValueError, RuntimeError, OSError):  # it was lost: the broker says it then
                last = _publish(client, self._availability, OFFLINE, retain=True)
                for key, own in shown.items():
                    for topic, document in self._unknown(key, own):
                        last = _publish(client, topic, document, retain=True)
                last.wait_for_publish(CLOSING)
            client.disconnect()
            client.loop_stop()

    def _connected(self) -> mqtt.Client:
        """Return the client, connected anew if it is not."""
        if self._client is not None and self._client.is_connected():
            return self._client
        self.close()
        client = client_of(self._options, self._access)
        client.will_set(self._availability, OFFLINE, qos=1, retain=True)
        connect(client, self._options)
        self._client = client
        client.publish(self._availability, ONLINE, qos=1, retain=True)
        return client

    def _topics(self, key: str) -> tuple[str, str, str]:
        own = f"{self._options.prefix}/{key}"
        return f"{own}/state", f"{own}/parameters", f"{own}/availability"

    def _documents(self, view: MachineView) -> Iterator[tuple[str, Any]]:
        state, parameters, availability = self._topics(view.key)
        since = None if view.since is None else _iso(view.since)
        yield state, {"site": view.site, "machine": view.name, "state": str(view.state), "word": view.word,
                      "since": since, "what": view.what, "advice": view.advice}  # fmt: skip
        if view.report is not None:
            first = islice(view.report.parameters.items(), MAX_PARAMETERS)
            rows = {visible(name): _row(row) for name, row in first}
            yield parameters, {"time": _iso(view.report.window.end), "parameters": rows}
        yield availability, OFFLINE if view.report is None else ONLINE

    def _unknown(self, key: str, own: tuple[str, str]) -> Iterator[tuple[str, Any]]:
        """Yield what is published of a machine when the site ends: who comes later would read its last state."""
        state, _, availability = self._topics(key)
        yield availability, OFFLINE
        texts, words = texts_in(self._language), words_in(self._language)
        what, advice = words["site_away"], words["site_away_advice"]
        if self._sender:
            what, advice = words["daemon_away"], texts("check_daemon")
        yield state, {"site": own[0], "machine": own[1], "state": str(Level.NO_DATA), "since": None,
                      "word": texts.translated(Level.NO_DATA), "what": what, "advice": advice}  # fmt: skip

    def _discovery(self, view: MachineView) -> Iterator[tuple[str, Any]]:
        """Yield the configurations of its sensors, as Home Assistant documents them, if they are new."""
        if self._options.discovery is None or view.report is None:
            return
        first = islice(view.report.parameters.items(), MAX_PARAMETERS)
        own = frozenset((name, row.unit) for name, row in first if IDENTIFIER.fullmatch(name))
        before = self._discovered.get(view.key, frozenset())
        if before == own and view.key in self._configured:
            return
        self._configured.add(view.key)
        self._discovered[view.key] = own
        for name in sorted({name for name, _ in before} - {name for name, _ in own}):
            yield self._config(view.key, _sensor_id(name)), None
        state, parameters, availability = self._topics(view.key)
        device = {"identifiers": [_object_id(view.key)], "name": view.name, "manufacturer": "Otolith",
                  "model": visible(view.report.twin), "suggested_area": view.site}  # fmt: skip
        both = {"device": device, "origin": {"name": "otolith", "sw_version": __version__}, "qos": 1}
        of_site = {"topic": self._availability}
        yield self._config(view.key, "state"), {
            **both, "name": "State", "unique_id": f"{_object_id(view.key)}_state", "state_topic": state,
            "value_template": "{{ value_json.state }}", "json_attributes_topic": state, "device_class": "enum",
            "options": [str(level) for level in SHOWN], "availability": [of_site], "icon": "mdi:engine",
        }  # fmt: skip
        for name, unit in sorted(own):
            yield self._config(view.key, _sensor_id(name)), {
                **both, "name": name, "unique_id": f"{_object_id(view.key)}_{_sensor_id(name)}",
                "state_topic": parameters,
                "value_template": f"{{{{ value_json.parameters['{name}'].value }}}}", "state_class": "measurement",
                "availability": [of_site, {"topic": availability}], "availability_mode": "all",
                **({"unit_of_measurement": visible(unit)} if unit not in ("", "1") else {}),
            }  # fmt: skip

    def _config(self, key: str, name: str) -> str:
        return f"{self._options.discovery}/sensor/{_object_id(key)}/{name}/config"

    def _forgotten(self, key: str) -> list[str]:
        """Return the topics of the configurations of a machine that is gone."""
        own = self._discovered.pop(key, None)
        names = () if own is None else ("state", *(_sensor_id(name) for name, _ in own))
        return [self._config(key, name) for name in names]


def _publish(client: mqtt.Client, topic: str, document: Any, *, retain: bool) -> mqtt.MQTTMessageInfo:
    text = document if document is None or isinstance(document, str) else json_text(document)
    return publish(client, topic, None if text is None else text.encode(errors="replace"), qos=1, retain=retain)


def publish(client: mqtt.Client, topic: str, content: bytes | None, *, qos: int, retain: bool) -> mqtt.MQTTMessageInfo:
    """Publish bytes; raise ConnectionError if the connection is lost."""
    info = client.publish(topic, content, qos=qos, retain=retain)
    if info.rc not in (mqtt.MQTT_ERR_SUCCESS, mqtt.MQTT_ERR_QUEUE_SIZE):
        raise ConnectionError(mqtt.error_string(info.rc))
    return info


def wait_until_taken(client: mqtt.Client, last: mqtt.MQTTMessageInfo | None) -> None:
    """Wait for the end of the ``last`` message; raise ConnectionError if the broker does not take it."""
    if last is not None:
        last.wait_for_publish(ANSWER_TIMEOUT)
    if not client.is_connected() or (last is not None and not last.is_published()):
        raise ConnectionError("the broker does not take what it is sent")


def _object_id(key: str) -> str:
    """Return the id of a machine in Home Assistant; no two machines have the same one."""
    return "otolith_" + key.replace("_", "__").replace("/", "_-_")


def _sensor_id(name: str) -> str:
    """Return the id of the sensor of a parameter; the state of the machine is ``state``."""
    return f"parameter_{name}" if re.fullmatch("(parameter_)*state", name) else name


def _row(row: ParameterDocument) -> dict[str, Any]:
    own = {"value": row.value, "low": row.low, "high": row.high, "limit": row.limit, "nominal": row.nominal}
    return {**own, "unit": visible(row.unit), "status": str(row.status)}


def _iso(seconds: float) -> str | None:
    try:
        return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")
    except (OverflowError, OSError, ValueError):  # no clock has such a time, but a report may
        return None


def build(options: MqttOutlet, setup: OutletSetup) -> MqttPublisher:
    """Return the outlet; raise ConfigurationError if a file cannot be used."""
    return MqttPublisher(options, access_of(options, setup), setup.language or "en", setup.sender)
