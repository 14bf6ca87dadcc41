"""The MQTT driver: subscribes to the topics of its signals, and reconnects after every fault. It never publishes.

With a time field, the time of a sample is the sender's, on a clock that nobody can be asked for: the fastest message of
the last seconds counts as one that took no time. Without one, it is the time of arrival.
"""

import logging
import ssl
import time
from pathlib import Path
from typing import Any

from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from otolith_drivers.base import Counters, Deliver, Link, Sampling, Setup
from otolith_drivers.common.credentials import certificate, certificate_and_key, password
from otolith_drivers.common.reconnection import Reconnection, ThreadedDriver, cause_of
from otolith_drivers.errors import ConfigurationError, counted
from otolith_drivers.mqtt.topics import Messages, MqttOptions, MqttSource

__all__ = ["MqttListener", "Options", "Source", "build"]

log = logging.getLogger(__name__)

Options = MqttOptions
Source = MqttSource

CONNECT_TIMEOUT = 3.0  # s for the network connection
ANSWER_TIMEOUT = 5.0  # s for the broker to accept the client
LOOP_TIMEOUT = 0.1  # s; how late a stop may be noticed


def build(options: MqttOptions, setup: Setup) -> "MqttListener":
    """Return a listener to the topics of all signals of ``setup``.

    Raises:
        ConfigurationError: a unit has the wrong dimension, or a certificate, key or password cannot be read.
    """
    secret = None if options.password_file is None else setup.folder / options.password_file
    return MqttListener(options, Messages(options, setup.signals), password(secret), _tls(options, setup.folder))


def _tls(options: MqttOptions, folder: Path) -> ssl.SSLContext | None:
    """Return what TLS needs; the files are checked one by one first, as its own errors do not name them."""
    if not options.tls:
        return None
    if options.ca is not None:
        certificate(folder / options.ca, "ca")
    key = "ca"
    try:
        context = ssl.create_default_context(cafile=None if options.ca is None else folder / options.ca)
        if options.certificate is not None and options.key is not None:
            key, files = "certificate", (folder / options.certificate, folder / options.key)
            certificate_and_key(*files)
            context.load_cert_chain(*files, password=lambda: b"")
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"is not in PEM, or not usable: {cause_of(error)}", ("driver", key)) from error
    return context


class MqttListener(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over paho-mqtt, with its own thread."""

    def __init__(self, options: MqttOptions, messages: Messages, password: str, tls: ssl.SSLContext | None) -> None:
        super().__init__()
        self._options, self._messages, self._password, self._tls = options, messages, password, tls
        self._connection = Reconnection(options.title(), log)
        self._begun = 0.0  # s; when the broker accepted the subscription
        self._refusal = ""  # why the broker accepts neither client nor topic

    @property
    def sampling(self) -> Sampling:
        """See :attr:`otolith_drivers.base.Driver.sampling`."""
        return Sampling.CYCLIC if self._options.time is None else Sampling.POLLED

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        self._connection.reason = "not connected yet"
        self._start("mqtt-listen", self._run, deliver)

    def counters(self) -> Counters:
        """See :meth:`otolith_drivers.base.Driver.counters`."""
        messages = self._messages
        return Counters(messages.received, messages.bad, messages.lost, self._connection.count)

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        now, messages, connection = time.monotonic(), self._messages, self._connection
        lines = [line for topic in messages.topics.values() for line in topic.warnings(now, self._begun)]
        facts = []
        if messages.retained:
            facts.append(f"{counted(messages.retained, 'retained message')} not used")
        if offsets := messages.offsets():
            wall = time.time() - now
            ends = [f"{-wall - offset:+.4g} s" for offset in {min(offsets), max(offsets)}]
            facts.append(f"the senders' clocks minus this computer's: {' to '.join(sorted(ends))}, less the way here")
        return Link(connection.up, connection.reason, tuple(lines) if connection.up else (), ", ".join(facts))

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        stamps = "times of arrival" if self._options.time is None else f"times of the field {self._options.time}"
        lines = [f"{self._options.title()}, subscribed only (QoS {self._options.qos}), {stamps}"]
        if self._options.user is not None and not self._options.tls:
            lines.append("warning: the password is sent as it is: set tls = true")
        for topic in self._messages.topics.values():
            for name, path, conversion in topic.signals:
                where = topic.name if path is None else f"{topic.name}, field {path}"
                lines.append(f"{name} from {where} [{conversion.source.unit}]")
        return lines

    def _run(self, deliver: Deliver) -> None:
        while not self._stop.is_set():
            client = self._client(deliver)
            try:
                self._listen(client)
            except Exception as error:  # noqa: BLE001 - nothing that a broker sends may end the thread
                self._connection.go_down(_cause(error))
            finally:
                client.disconnect()
                client.loop_misc()
                if (connection := client.socket()) is not None:
                    connection.close()
            self._stop.wait(self._connection.backoff.next())

    def _client(self, deliver: Deliver) -> mqtt.Client:
        options = self._options
        client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id=options.client_id, reconnect_on_failure=False)
        client.connect_timeout = CONNECT_TIMEOUT
        if options.user is not None:
            client.username_pw_set(options.user, self._password)
        if self._tls is not None:
            client.tls_set_context(self._tls)

        # No callback may refer to the client: it would keep its sockets open until the next garbage collection.
        def on_connect(connected: mqtt.Client, __: Any, ___: Any, code: Any, ____: Any) -> None:
            if code.is_failure:
                self._refusal = f"the broker refuses this client: {code}"
            else:
                connected.subscribe([(name, int(options.qos)) for name in self._messages.topics])

        def on_subscribe(_: Any, __: Any, ___: Any, codes: Any, ____: Any) -> None:
            refused = [name for name, code in zip(self._messages.topics, codes, strict=False) if code.is_failure]
            if refused:
                self._refusal = f"the broker refuses the topics {', '.join(refused)}: may this user read them?"
            else:
                self._begun = time.monotonic()
                self._connection.come_up("subscribed")

        def on_message(_: Any, __: Any, message: mqtt.MQTTMessage) -> None:
            samples = self._messages.take(
                message.topic, bytes(message.payload), time.monotonic(), retained=message.retain
            )
            if samples and not self._stop.is_set():
                deliver(samples)

        client.on_connect, client.on_subscribe, client.on_message = on_connect, on_subscribe, on_message
        return client

    def _listen(self, client: mqtt.Client) -> None:
        """Connect and take messages until the connection fails, which raises, or the driver is closed."""
        self._refusal = ""
        host, port = self._options.address
        client.connect(host, port, keepalive=round(self._options.keepalive))
        begun, unanswered = time.monotonic(), "no answer of a broker: is one there, and is tls right?"
        self._connection.reason = unanswered
        while not self._stop.is_set():
            code = client.loop(LOOP_TIMEOUT)
            if self._refusal:
                raise ConnectionError(self._refusal)
            if code != mqtt.MQTT_ERR_SUCCESS:
                ended = f"the connection was closed: {mqtt.error_string(code)}"
                raise ConnectionError(ended if self._connection.up else unanswered)
            if not self._connection.up and time.monotonic() - begun > ANSWER_TIMEOUT:
                raise ConnectionError(unanswered)


def _cause(error: Exception) -> str:
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"the broker's certificate is refused: {error.verify_message}: are ca, host and the clock here right?"
    if isinstance(error, TimeoutError) and not error.errno:
        return f"no answer within {CONNECT_TIMEOUT:g} s: is a broker there, and is tls right?"
    return cause_of(error)
