"""Payloads of Sparkplug B: metrics of simple types in the wire format of protocol buffers, and the command of a host.

Its libraries for Python need protobuf or paho-mqtt in versions that exclude those of the MQTT driver. What is written
here is read by the official schema in the tests.
"""

import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

REBIRTH: Final = "Node Control/Rebirth"
MAX_VARINT = 10  # bytes of a whole number of 64 bit
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # Wire types


class DataType(IntEnum):
    """Of the specification 3.0.0, 6.4.16; those that are used here."""

    INT32 = 3
    INT64 = 4
    DOUBLE = 10
    BOOLEAN = 11
    STRING = 12
    DATE_TIME = 13  # ms since 1970


Value = int | float | bool | str | None
Properties = Mapping[str, tuple[DataType, Value]]
METRIC_FIELDS = {DataType.INT32: 10, DataType.INT64: 11, DataType.DATE_TIME: 11, DataType.DOUBLE: 13,
                 DataType.BOOLEAN: 14, DataType.STRING: 15}  # fmt: skip
PROPERTY_FIELDS = {DataType.INT32: 3, DataType.INT64: 4, DataType.DOUBLE: 6, DataType.BOOLEAN: 7, DataType.STRING: 8}


@dataclass(frozen=True, slots=True)
class SparkplugMetric:
    """A value at a time; None is a value that is not known."""

    name: str
    type: DataType
    value: Value
    time: int  # ms since 1970
    properties: Properties = field(default_factory=dict)


def payload(metrics: Iterable[SparkplugMetric], time: int | None, number: int | None) -> bytes:
    """Return a payload; ``number`` is its sequence number."""
    parts = [] if time is None else [_whole(1, time)]
    parts += [_bytes(2, _metric(metric)) for metric in metrics]
    parts += [] if number is None else [_whole(3, number)]
    return b"".join(parts)


def asks_for_rebirth(content: bytes) -> bool:
    """Return whether a command asks the node to be born again; what cannot be read does not."""
    try:
        for number, metric in _fields(content):
            if number == 2 and isinstance(metric, bytes):
                own = dict(_fields(metric))
                if own.get(1) == REBIRTH.encode() and own.get(14) == 1:
                    return True
    except ValueError:
        return False
    return False


def _metric(metric: SparkplugMetric) -> bytes:
    parts = [_text(1, metric.name), _whole(3, metric.time), _whole(4, metric.type)]
    if metric.properties:
        keys = b"".join(_text(1, key) for key in metric.properties)
        values = (
            _whole(1, kind) + _value(2, PROPERTY_FIELDS[kind], value) for kind, value in metric.properties.values()
        )
        parts.append(_bytes(9, keys + b"".join(_bytes(2, value) for value in values)))
    return b"".join([*parts, _value(7, METRIC_FIELDS[metric.type], metric.value)])


def _value(null: int, number: int, value: Value) -> bytes:
    if value is None:
        return _whole(null, 1)
    if isinstance(value, str):
        return _text(number, value)
    if isinstance(value, float):
        return _varint(number << 3 | FIXED64) + struct.pack("<d", value)
    return _whole(number, int(value))


def _varint(number: int) -> bytes:
    number &= (1 << 64) - 1  # A negative one is its complement
    found = bytearray()
    while number > 0x7F:
        found.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*found, number])


def _whole(field_number: int, value: int) -> bytes:
    return _varint(field_number << 3 | VARINT) + _varint(value)


def _bytes(field_number: int, content: bytes) -> bytes:
    return _varint(field_number << 3 | BYTES) + _varint(len(content)) + content


def _text(field_number: int, text: str) -> bytes:
    return _bytes(field_number, text.encode(errors="replace"))


def _fields(content: bytes) -> Iterator[tuple[int, int | bytes]]:
    """Yield the numbers and values of fields; raise ValueError if it is no message."""
    at = 0
    while at < len(content):
        tag, at = _read(content, at)
        kind = tag & 7
        if kind == VARINT:
            value, at = _read(content, at)
            yield tag >> 3, value
            continue
        size = {FIXED64: 8, FIXED32: 4}.get(kind)
        if kind == BYTES:
            size, at = _read(content, at)
        if size is None or at + size > len(content):
            raise ValueError("not a message")
        yield tag >> 3, content[at : at + size]
        at += size


def _read(content: bytes, at: int) -> tuple[int, int]:
    """Return a whole number at a place, and the place after it."""
    number = 0
    for index, byte in enumerate(content[at : at + MAX_VARINT]):
        number |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return number, at + index + 1
    raise ValueError("not a number")
