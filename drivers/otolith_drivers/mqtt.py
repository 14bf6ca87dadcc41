"""The MQTT driver: subscribes to the topics of its signals, and reconnects after every fault. It never publishes.

With a time field, the time of a sample is the sender's, on a clock that cannot be queried: the fastest message of
the last seconds counts as one that took no time. Without one, it is the time of arrival. The way from a message to
samples (:class:`Messages`) has no clock and no connection.
"""

import json
import logging
import math
import re
import ssl
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import Conversion, Counters, Deliver, Link, Sample, Sampling, ScaledSource, Setup, Signal
from otolith_drivers.common.clocks import wall_clock_offset
from otolith_drivers.common.credentials import CredentialOptions, certificate, certificate_and_key, password
from otolith_drivers.common.message_times import ArrivalClock, PeriodEstimator, unix_time
from otolith_drivers.common.reconnection import OwnFaults, PassingFault, Reconnection, ThreadedDriver, cause_of
from otolith_drivers.config_files import written_as
from otolith_drivers.errors import ConfigurationError, counted, shown
from otolith_drivers.units import Quantity

log = logging.getLogger(__name__)

CONNECT_TIMEOUT = 3.0  # s for the network connection
ANSWER_TIMEOUT = 5.0  # s for the broker to accept the client
LOOP_TIMEOUT = 0.1  # s; how late a stop may be noticed
MAX_PAYLOAD = 1 << 16  # bytes of a message that is read
SAME_CLOCK = 0.2  # s between the offsets of two topics, below which their senders have one clock
FIRST_WAIT = 10.0  # s without a message of a topic, after which the link has a warning of it
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
MIN_RATE, RATE_SPAN = 0.1, 1.5  # s per s by which the times of messages must advance; s after which that is judged
NAME = r"[^.\[\]\s](?:[^.\[\]]*[^.\[\]\s])?"
PATH = re.compile(rf"(?:{NAME}|\[\d+\])(?:\[\d+\])*(?:\.{NAME}(?:\[\d+\])*)*")
STEP = re.compile(r"\.?([^.\[\]]+)|\[(\d+)\]")  # from a JSON value into it
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)

FieldPath = Annotated[str, written_as(PATH, "path into a message, like 'speed', 'axes[0].speed' or '[0].t'")]


class MqttOptions(CredentialOptions):
    """``[driver]`` with ``type = "mqtt"``."""

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65535)] | None = None  # By default 1883, and 8883 with TLS
    qos: Literal[0, 1, 2] = 0
    tls: bool = False
    ca: Path | None = None  # Of the authority that signed the broker's certificate; by default the computer's
    client_id: str = ""  # By default a random one
    keepalive: Annotated[float, BeforeValidator(Quantity("s", 1.0, 3600.0))] = 10.0
    """Time (s) without a message, after which the broker is asked whether it is there."""
    time: FieldPath | None = None  # Field with the time of the values; without it the time of arrival is used
    time_format: Literal["s", "ms", "us", "ns", "iso"] = "ms"  # Unit since 1970, or ISO 8601, in UTC without a zone

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if not self.tls and (self.ca or self.certificate):
            raise ValueError("ca, certificate and key belong to tls = true")
        return self

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self.host, self.port or (8883 if self.tls else 1883)

    def title(self) -> str:
        """Return the broker in a few words."""
        host, port = self.address
        return f"MQTT {host}:{port}{', TLS' if self.tls else ''}"


class MqttSource(ScaledSource):
    """Place of a signal: ``{ topic = "motor/speed", unit = "rpm" }``, in JSON with ``field = "values.speed"``."""

    topic: Annotated[str, Field(min_length=1, max_length=1000)]
    field: FieldPath | None = None  # Path in a JSON message; without it the message is the number
    unit: str

    @model_validator(mode="after")
    def _is_one_topic(self) -> Self:
        if any(sign in self.topic for sign in "+#\0"):
            raise ValueError(f"{self.topic!r}: a signal has one topic, without the wildcards '+' and '#'")
        return self


@dataclass(slots=True)
class TopicSignals:
    """A topic, and the signals in its messages."""

    name: str
    signals: list[tuple[str, str | None, Conversion]] = field(default_factory=list)
    """Name, path in the message, and conversion."""
    periods: PeriodEstimator = field(default_factory=PeriodEstimator)  # Of their times
    arrivals: PeriodEstimator = field(default_factory=PeriodEstimator)
    begun: tuple[float, float] = (math.inf, 0.0)  # s; arrival and time of the first message
    time: float = -math.inf  # s; of the latest samples
    clock: ArrivalClock = field(default_factory=ArrivalClock)
    retained: bool = False  # Whether a retained message has come
    unusable: PassingFault = field(default_factory=PassingFault)  # Messages and values that could not be used

    def warnings(self, now: float, begun: float) -> list[str]:
        """Return what is wrong at ``now`` (s) since the subscription at ``begun`` (s), a line each."""
        lines = self.unusable.warnings(now, self.name)
        if self.arrivals.last is None and now - begun > FIRST_WAIT:
            kind = "only a retained message, which is old" if self.retained else "no message"
            lines.append(f"{self.name}: {kind} since {now - begun:.0f} s: does its publisher run?")
        elif (silence := self.arrivals.silence(now)) is not None:
            lines.append(f"{self.name} silent for {silence:.1f} s; {self.arrivals.describe()}")
        elif not lines and (span := (self.arrivals.last or 0.0) - self.begun[0]) > RATE_SPAN:
            rate = (self.time - self.begun[1]) / span
            if rate < MIN_RATE:
                lines.append(f"{self.name}: its times advance by {rate:.2g} s per second: is time_format right?")
        return lines


class Messages:
    """Samples of the messages of all topics."""

    def __init__(self, options: MqttOptions, signals: Sequence[Signal]) -> None:
        """Raise ConfigurationError for a unit of another quantity, or a time in messages that are plain numbers."""
        self._path, self._format = options.time, options.time_format
        self._lock = threading.Lock()  # of what messages change
        self.received = self.lost = self.retained = 0
        self.topics: dict[str, TopicSignals] = {}
        for signal in signals:
            source: MqttSource = signal.source
            key = ("signals", signal.name)
            if options.time is not None and source.field is None:
                text = f"{source.topic}: a plain number has no field {options.time!r}: give 'field'"
                raise ConfigurationError(text, key)
            topic = self.topics.setdefault(source.topic, TopicSignals(source.topic))
            topic.signals.append((signal.name, source.field, Conversion.for_signal(signal)))

    @property
    def bad(self) -> int:
        """Number of messages and values that could not be used."""
        return sum(topic.unusable.count for topic in self.topics.values())

    def take(self, name: str, payload: bytes, now: float, *, retained: bool) -> list[Sample]:
        """Return the samples of a message that came at ``now`` (s); none of one that is old or cannot be read."""
        topic = self.topics.get(name)
        if topic is None:
            return []
        with self._lock:
            return self._take(topic, payload, now, retained=retained)

    def _take(self, topic: TopicSignals, payload: bytes, now: float, *, retained: bool) -> list[Sample]:
        if retained:  # stored by the broker: its value was true at an unknown time
            topic.retained = True
            self.retained += 1
            return []
        topic.arrivals.lost_before(now)
        try:
            content = _content(payload, plain=all(path is None for _, path, _ in topic.signals))
            time = now if self._path is None else self._time(topic, content, now)
        except ValueError as error:
            topic.unusable.note(str(error), now)
            return []
        if topic.time - time > SAME_CLOCK:
            topic.unusable.note(f"its time is {topic.time - time:.3g} s before that of the message before it", now)
            return []
        topic.time = time = max(time, topic.time)  # a faster message than all before it moves the offset a little
        topic.begun = min(topic.begun, (now, time))
        samples = [self._sample(topic, signal, content, time, now) for signal in topic.signals]
        self.lost += topic.periods.lost_before(time) * len(samples)
        self.received += sum(math.isfinite(sample.value) for sample in samples)
        return samples

    def offsets(self) -> list[float]:
        """Return this computer's monotonic clock minus that of the sender, s, of each topic with times."""
        with self._lock:
            return [topic.clock.offset for topic in self.topics.values() if math.isfinite(topic.clock.offset)]

    def warnings(self, now: float, begun: float) -> list[str]:
        """Return what is wrong at ``now`` (s) since the subscription at ``begun`` (s), a line each."""
        with self._lock:
            return [line for topic in self.topics.values() for line in topic.warnings(now, begun)]

    def _time(self, topic: TopicSignals, content: Any, now: float) -> float:
        """Return the time of a message on this computer's monotonic clock, s; raise ValueError if it has none."""
        written = at(content, self._path)
        try:
            if self._format == "iso":
                stamp = unix_time(datetime.fromisoformat(written))
            else:
                stamp = float(written) * TIME_UNITS[self._format]
        except (TypeError, ValueError, OverflowError) as error:
            kind = "ISO 8601" if self._format == "iso" else f"number of {self._format}"
            raise ValueError(f"{self._path} is {shown(written)}, no {kind}") from error
        if not math.isfinite(stamp):
            raise ValueError(f"{self._path} is not finite")
        if not topic.clock.arrival(stamp, now, SAME_CLOCK):
            ahead = f"{self._path} is {shown(written)}, ahead of the messages before it"
            raise ValueError(f"{ahead}: is time_format right?")
        own = topic.clock.offset
        others = (other.clock.offset for other in self.topics.values())
        return stamp + min(offset for offset in others if abs(offset - own) < SAME_CLOCK)

    def _sample(
        self, topic: TopicSignals, signal: tuple[str, str | None, Conversion], content: Any, time: float, now: float
    ) -> Sample:
        name, path, conversion = signal
        try:
            written = content if path is None else at(content, path)
            written = float(written) if isinstance(written, str) and NUMBER.fullmatch(written.strip()) else written
            value = conversion.value(written)
            fault = f"{name} {shown(written)} {conversion.why_no_value(written)}" if math.isnan(value) else ""
        except ValueError as error:
            value, fault = math.nan, str(error)
        if fault:
            topic.unusable.note(fault, now)
        return Sample(name, time, value)


def _content(payload: bytes, *, plain: bool) -> Any:
    """Return the number or the JSON document in a message; raise ValueError if it is neither."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a message of {len(payload)} bytes, more than {MAX_PAYLOAD}")
    try:
        text = payload.decode("utf-8-sig").rstrip("\0").strip()
        content = text if plain and NUMBER.fullmatch(text) else json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{shown(payload[:60])} is no {'number' if plain else 'JSON document'}") from error
    if plain and isinstance(content, dict | list):
        raise ValueError(f"{shown(payload[:60])} is no number: set 'field' beside the topic")
    return content


def at(content: Any, path: str | None) -> Any:
    """Return what is at ``path``, like ``axes[0].speed``, of a JSON document; raise ValueError if there is nothing.

    A name may contain points and brackets, if that is not ambiguous: the longest one is taken.
    """
    value, rest = content, path or ""
    while rest:
        if isinstance(value, dict) and rest.removeprefix(".") in value:
            return value[rest.removeprefix(".")]
        match = STEP.match(rest)
        try:
            value = value[match[1] or int(match[2])] if match else None
        except (KeyError, IndexError, TypeError):
            known = f": it has {', '.join(map(str, list(value)[:8]))}" if isinstance(value, dict) and value else ""
            raise ValueError(f"a message without {path}{known}") from None
        rest = rest[match.end() :] if match else ""
    return value


Options, Source = MqttOptions, MqttSource  # for base.DriverType


def build(options: MqttOptions, setup: Setup) -> "MqttListener":
    """Return a listener to all signals; raise ConfigurationError for a wrong unit, certificate, key or password."""
    return listener(options, setup, Messages(options, setup.signals))


def listener(options: MqttOptions, setup: Setup, messages: Messages) -> "MqttListener":
    """Return a listener whose messages go to ``messages``; raise ConfigurationError for a wrong file."""
    secret = None if options.password_file is None else setup.folder / options.password_file
    return MqttListener(options, messages, password(secret), _tls(options, setup.folder))


def has_failed_first(listening: "MqttListener") -> bool:
    """Return whether the first attempt to connect has failed; drivers have no public name for it."""
    return listening._connection.has_failed_first


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
        self._own_faults = OwnFaults(log)
        self._begun = 0.0  # s; when the broker accepted the subscription
        self._refusal = ""  # why the broker accepts neither client nor topic

    @property
    def sampling(self) -> Sampling:
        return Sampling.CYCLIC if self._options.time is None else Sampling.POLLED

    def open(self, deliver: Deliver) -> None:
        self._connection.stay_down("not connected yet")
        self._start("mqtt-listen", self._run, deliver)

    def counters(self) -> Counters:
        messages = self._messages
        return Counters(messages.received, messages.bad, messages.lost, self._connection.count)

    def link(self) -> Link:
        now, messages, (up, reason) = time.monotonic(), self._messages, self._connection.state
        lines = messages.warnings(now, self._begun)
        facts = []
        if messages.retained:
            facts.append(f"{counted(messages.retained, 'retained message')} not used")
        if offsets := messages.offsets():
            wall = wall_clock_offset()
            ends = [f"{-wall - offset:+.4g} s" for offset in {min(offsets), max(offsets)}]
            facts.append(f"the senders' clocks minus this computer's: {' to '.join(sorted(ends))}, less the way here")
        defect = self._own_faults.defect(now)
        return Link(up, reason, tuple(lines) if up else (), ", ".join(facts), defect=defect)

    def describe(self) -> list[str]:
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
                if not isinstance(error, OSError | ValueError):
                    self._own_faults.note(error, "a connection to the broker", time.monotonic())
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
            now = time.monotonic()
            try:
                samples = self._messages.take(message.topic, bytes(message.payload), now, retained=message.retain)
                if samples and not self._stop.is_set():
                    deliver(samples)
            except Exception as error:  # noqa: BLE001 - no message may end the connection
                self._own_faults.note(error, f"reading a message of {shown(message.topic)}", now)

        client.on_connect, client.on_subscribe, client.on_message = on_connect, on_subscribe, on_message
        return client

    def _listen(self, client: mqtt.Client) -> None:
        """Connect and take messages until the connection fails, which raises, or the driver is closed."""
        self._refusal = ""
        host, port = self._options.address
        client.connect(host, port, keepalive=round(self._options.keepalive))
        begun, unanswered = time.monotonic(), "no answer of a broker: is one there, and is tls right?"
        self._connection.stay_down(unanswered)
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
