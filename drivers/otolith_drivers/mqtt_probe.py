"""What an MQTT broker passes on: numbers in messages by topic and field. It only subscribes.

The connection is that of the driver, with other messages.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from otolith_drivers.base import Sample, Setup
from otolith_drivers.errors import DeviceError
from otolith_drivers.mqtt import (
    MAX_PAYLOAD,
    NUMBER,
    PATH,
    Messages,
    MqttOptions,
    TopicSignals,
    at,
    has_failed_first,
    listener,
)
from otolith_drivers.toml_bounds import MAX_DEPTH

ALL = "#"  # the wildcard of all topics
MAX_NUMBERS = 2000  # topics and fields that are kept apart
MAX_VALUES = 5000  # of each
PAUSE = 0.05  # s between two looks at the connection


@dataclass(slots=True)
class ObservedNumber:
    """A number in the messages of a topic."""

    topic: str
    path: str | None  # Path in a JSON message; None if the message is the number
    times: list[float] = field(default_factory=list)  # s; of arrival, monotonic
    values: list[float] = field(default_factory=list)


class ObservedMessages(Messages):
    """The numbers in all messages of a filter of topics."""

    def __init__(self, options: MqttOptions, topics: str = ALL) -> None:
        super().__init__(options.model_copy(update={"time": None}), ())
        self.topics = {topics: TopicSignals(topics)}
        self.numbers: dict[tuple[str, str | None], ObservedNumber] = {}
        self.left_out = 0  # Numbers beyond MAX_NUMBERS

    def take(self, name: str, payload: bytes, now: float, *, retained: bool) -> list[Sample]:
        """Keep the numbers in a message that came at ``now`` (s); return no sample."""
        if retained or len(payload) > MAX_PAYLOAD:
            return []
        for path, value in _numbers(payload):
            number = self.numbers.get((name, path))
            if number is None:
                if len(self.numbers) >= MAX_NUMBERS:
                    self.left_out += 1
                    continue
                number = self.numbers[name, path] = ObservedNumber(name, path)
            if len(number.values) < MAX_VALUES:
                number.times.append(now)
                number.values.append(value)
        return []


def observe(
    options: MqttOptions, folder: Path, seconds: float, stopped: Callable[[], bool], topics: str = ALL
) -> ObservedMessages:
    """Return what came within ``seconds``, connecting included; raise DeviceError if the broker refuses or is none.

    It does so at once: whoever asks waits for it.
    """
    messages = ObservedMessages(options, topics)
    driver = listener(options, Setup((), folder, 1.0), messages)
    driver.open(lambda _: None)
    try:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not (stopped() or has_failed_first(driver)):
            time.sleep(PAUSE)
        link = driver.link()
    finally:
        driver.close()
    if not link.up:
        raise DeviceError(f"{options.title()}: {link.reason}")
    return messages


def _numbers(payload: bytes) -> Iterator[tuple[str | None, float]]:
    """Yield path and value of each number in a message that a signal could name."""
    try:
        text = payload.decode("utf-8-sig").rstrip("\0").strip()
        if NUMBER.fullmatch(text):
            yield None, float(text)
            return
        content = json.loads(text)
    except (ValueError, RecursionError):
        return
    for path, value in _leaves(content, "", 0):
        if PATH.fullmatch(path) and _found(content, path) is value:
            yield path, float(value)


def _leaves(content: Any, path: str, depth: int) -> Iterator[tuple[str, int | float]]:
    if depth > MAX_DEPTH:
        return
    if isinstance(content, dict):
        for name, item in content.items():
            yield from _leaves(item, f"{path}.{name}" if path else name, depth + 1)
    elif isinstance(content, list):
        for index, item in enumerate(content):
            yield from _leaves(item, f"{path}[{index}]", depth + 1)
    elif isinstance(content, int | float) and not isinstance(content, bool) and path:
        yield path, content


def _found(content: Any, path: str) -> Any:
    try:
        return at(content, path)
    except ValueError:
        return None
