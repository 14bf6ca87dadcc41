"""The MQTT tables of a machine file, and the way from a message to samples. No clock and no connection in here."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import Sample, Signal
from otolith_drivers.common.credentials import CredentialOptions
from otolith_drivers.common.periods import PeriodEstimator
from otolith_drivers.common.reconnection import PassingFault
from otolith_drivers.common.remote_clock import ArrivalClock, unix_time
from otolith_drivers.common.scaled import Conversion, ScaledSource
from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.units import Quantity

MAX_PAYLOAD = 1 << 16  # bytes of a message that is read
SAME_CLOCK = 0.2  # s between the offsets of two topics, below which their senders have one clock
FIRST_WAIT = 10.0  # s without a message of a topic, after which the link has a warning of it
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
PATH = re.compile(r"[^.\[\]\s]+(?:\[\d+\])*(?:\.[^.\[\]\s]+(?:\[\d+\])*)*|(?:\[\d+\])+")

FieldPath = Annotated[str, Field(pattern=f"^(?:{PATH.pattern})$", max_length=200)]


class MqttOptions(CredentialOptions):
    """``[driver]`` with ``type = "mqtt"``."""

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """By default 1883, and 8883 with TLS."""
    qos: Literal[0, 1, 2] = 0
    tls: bool = False
    ca: Path | None = None
    """The certificate of the authority that signed the broker's; by default those of the computer."""
    client_id: str = ""
    """By default a random one."""
    keepalive: Annotated[float, BeforeValidator(Quantity("s", 1.0, 3600.0))] = 10.0
    """Time (s) without a message, after which the broker is asked whether it is there."""
    time: FieldPath | None = None
    """Field of the messages with the time at which their values were true; without it the time of arrival is used."""
    time_format: Literal["s", "ms", "us", "ns", "iso"] = "ms"
    """Unit of that time since 1970, or ISO 8601, which is in UTC if it names no time zone."""

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
    field: FieldPath | None = None
    """Path in a JSON message; without it the message is the number."""
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
    periods: PeriodEstimator = field(default_factory=PeriodEstimator)
    time: float = -math.inf
    """s; of the latest samples."""
    clock: ArrivalClock = field(default_factory=ArrivalClock)
    retained: bool = False
    """Whether a retained message has come."""
    unusable: PassingFault = field(default_factory=PassingFault)
    """Messages and values that could not be used."""

    def warnings(self, now: float, begun: float) -> list[str]:
        """Return what is wrong at ``now`` (s) since the subscription at ``begun`` (s), a line each."""
        lines = self.unusable.warnings(now, self.name)
        if self.periods.last is None and now - begun > FIRST_WAIT:
            kind = "only a retained message, which is old" if self.retained else "no message"
            lines.append(f"{self.name}: {kind} since {now - begun:.0f} s: does its publisher run?")
        elif (silence := self.periods.silence(now)) is not None:
            lines.append(f"{self.name} silent for {silence:.1f} s; {self.periods.describe()}")
        return lines


class Messages:
    """Samples of the messages of all topics."""

    def __init__(self, options: MqttOptions, signals: Sequence[Signal]) -> None:
        """Raise ConfigurationError for a unit of another quantity, or a time in messages that are plain numbers."""
        self._path, self._format = options.time, options.time_format
        self.received = self.lost = self.retained = 0
        self.topics: dict[str, TopicSignals] = {}
        for signal in signals:
            source: MqttSource = signal.source
            key = ("signals", signal.name)
            if options.time is not None and source.field is None:
                raise ConfigurationError(
                    f"{source.topic}: a plain number has no field {options.time!r}: give 'field'", key
                )
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
        if retained:  # stored by the broker: its value was true at an unknown time
            topic.retained = True
            self.retained += 1
            return []
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
        samples = [self._sample(topic, signal, content, time, now) for signal in topic.signals]
        self.lost += topic.periods.lost_before(time) * len(samples)
        self.received += sum(math.isfinite(sample.value) for sample in samples)
        return samples

    def offsets(self) -> list[float]:
        """Return this computer's monotonic clock minus that of the sender, s, of each topic with times."""
        return [topic.clock.offset for topic in self.topics.values() if math.isfinite(topic.clock.offset)]

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
            raise ValueError(f"{self._path} is {shown(written)}, ahead of the messages before it")
        own = topic.clock.offset
        others = (other.clock.offset for other in self.topics.values())
        return stamp + min(offset for offset in others if abs(offset - own) < SAME_CLOCK)

    def _sample(
        self, topic: TopicSignals, signal: tuple[str, str | None, Conversion], content: Any, time: float, now: float
    ) -> Sample:
        name, path, conversion = signal
        try:
            written = content if path is None else at(content, path)
            value = conversion.value(written)
            fault = f"{name} is {shown(written)}, no number in its range" if math.isnan(value) else ""
        except ValueError as error:
            value, fault = math.nan, str(error)
        if fault:
            topic.unusable.note(fault, now)
        return Sample(name, time, value)


def _content(payload: bytes, *, plain: bool) -> Any:
    """Return the number or the JSON document in a message.

    Raises:
        ValueError: it is neither.
    """
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"a message of {len(payload)} bytes, more than {MAX_PAYLOAD}")
    try:
        text = payload.decode("utf-8").strip()
        if plain and len(text) < 100:
            return float(text)
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        kind = "number" if plain else "JSON document"
        raise ValueError(f"{shown(payload[:60])} is no {kind}") from error


def at(content: Any, path: str | None) -> Any:
    """Return what is at ``path``, like ``values.speed`` or ``axes[0].speed``, of a JSON document.

    Raises:
        ValueError: there is nothing.
    """
    value = content
    for name, index in re.findall(r"([^.\[\]]+)|\[(\d+)\]", path or ""):
        try:
            value = value[name] if name else value[int(index)]
        except (KeyError, IndexError, TypeError):
            known = f": it has {', '.join(map(str, list(value)[:8]))}" if isinstance(value, dict) and value else ""
            raise ValueError(f"a message without {path}{known}") from None
    return value
