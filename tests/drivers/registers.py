"""Numbers as a device has them in its registers, and signals that read them."""

import struct

from otolith_drivers.base import Signal
from otolith_drivers.modbus.options import (
    LETTERS,
    ModbusOptions,
    ModbusSource,
    Order,
    RegisterSignal,
    TypeName,
    register_signal,
)

KINDS: list[TypeName] = list(LETTERS)


def registers(number: float, kind: TypeName, order: Order) -> list[int]:
    """The inverse of ``reader``, written byte by byte."""
    data = list(struct.pack(f">{LETTERS[kind]}", number if kind.startswith("float") else int(number)))
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if order in ("BADC", "DCBA"):
        words = [word[::-1] for word in words]
    if order in ("CDAB", "DCBA"):
        words = words[::-1]
    return [high << 8 | low for high, low in words]


def item(name: str = "s", **keys: object) -> RegisterSignal:
    source = ModbusSource.model_validate({"register": 0, "type": "float32", "unit": "V", **keys})
    return register_signal(Signal(name, "V", source), ModbusOptions(host="localhost"))
