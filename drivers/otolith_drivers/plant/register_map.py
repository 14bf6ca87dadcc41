"""The registers of the simulated Modbus drive: the address of each signal, and numbers as registers."""

import math
import struct
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.modbus.protocol import BYTES_SWAPPED, LETTERS, WORDS_SWAPPED, Order
from otolith_drivers.units import Quantity

SPACING = 2  # registers from one signal to the next, of any type
COUNTER_VALUES = 65536

Type = Literal["float32", "int32", "int16"]

RANGES: dict[Type, tuple[float, float]] = {
    "float32": (-3.4028234e38, 3.4028234e38),
    "int32": (-(2.0**31), 2.0**31 - 1.0),
    "int16": (-(2.0**15), 2.0**15 - 1.0),
}


class NodeModbusOptions(StrictModel):
    """``[modbus]`` of a scenario."""

    host: str = "127.0.0.1"
    """Address on which Modbus TCP listens; the default is reachable from this computer only."""
    port: Annotated[int, Field(ge=1, le=65535)] = 1502
    device: Annotated[int, Field(ge=1, le=247)] = 1
    order: Order = "ABCD"
    type: Type = "float32"
    scale: dict[str, str] = Field(default_factory=dict)
    """Value of one count of each signal, like ``"1 mA"``; needed for integers."""
    line: Path | None = None
    """Modbus RTU: path of the serial line for the client, relative to the scenario."""
    baudrate: Annotated[int, Field(ge=300, le=4_000_000)] = 115200
    pace_line: bool = True
    """Whether bytes take the time of 8N1 at ``baudrate``; otherwise they arrive at once."""

    @model_validator(mode="after")
    def _type_fits(self) -> Self:
        if self.type == "float32" and self.scale:
            raise ValueError('scale is for type = "int16" and "int32": a float32 is in the unit of its signal')
        return self


class RegisterMap:
    """The address of each signal, and the content of all registers at a sample."""

    def __init__(self, options: NodeModbusOptions, signals: dict[str, str]) -> None:
        """``signals`` has the unit of each; integers need a scale of each in ``options``.

        Raises:
            ValueError: a scale is missing, of an unknown signal, or in a unit of another dimension.
        """
        self.addresses = {name: SPACING * number for number, name in enumerate(signals)}
        self.counter = SPACING * len(signals)
        self.size = self.counter + 1
        self._format = f">{LETTERS[options.type]}"
        self._range = RANGES[options.type]
        self._scales = _scales(options, signals)

    def encode(self, measured: dict[str, float], index: int, order: Order) -> list[int]:
        """All registers at sample ``index``; a value beyond the range of the type saturates."""
        registers: list[int] = []
        for name in self.addresses:
            registers += self._words(measured[name] / self._scales[name], order)
        return [*registers, index % COUNTER_VALUES]

    def _words(self, value: float, order: Order) -> list[int]:
        low, high = self._range
        within = min(max(value, low), high)
        data = struct.pack(self._format, within if self._format == ">f" else round(within))
        words = list(struct.unpack(f"{'<' if order in BYTES_SWAPPED else '>'}{len(data) // 2}H", data))
        if order in WORDS_SWAPPED:
            words.reverse()
        return [*words, *[0] * (SPACING - len(words))]


def _scales(options: NodeModbusOptions, signals: dict[str, str]) -> dict[str, float]:
    if options.type == "float32":
        return dict.fromkeys(signals, 1.0)
    if unknown := options.scale.keys() - signals.keys():
        raise ValueError(
            f"modbus.scale names {min(unknown)!r}, which is no signal; the signals are {', '.join(signals)}"
        )
    if missing := [name for name in signals if name not in options.scale]:
        raise ValueError(f"type {options.type!r} needs modbus.scale of {', '.join(missing)}: the value of one count")
    scales = {name: Quantity(unit, difference=True)(options.scale[name]) for name, unit in signals.items()}
    for name, scale in scales.items():
        if not math.isfinite(scale) or scale <= 0.0:
            raise ValueError(f"modbus.scale.{name}: {options.scale[name]!r} must be above zero")
    return scales
