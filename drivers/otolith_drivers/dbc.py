"""Finding the wanted signals in a CAN database (DBC, KCD, SYM, ARXML, as cantools reads them)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cantools
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database

from otolith_drivers.base import Signal
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.quantities import factor
from otolith_drivers.toml_files import Closed

LARGEST = 1e300
ROUNDING = 1e-6  # of a bound: 0.1 in a frame of 32-bit floats is above 0.1


class Source(Closed):
    """Where in the DBC a signal is."""

    signal: str
    message: str | None = None
    unit: str | None = None
    """The unit on the bus, for a DBC that does not say it."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """A signal of the machine as the frames carry it."""

    name: str
    target_unit: str
    message: Message
    signal: str
    source_unit: str
    scale: float
    offset: float
    low: float = -math.inf
    """Of the DBC, in the unit on the bus; a value beyond is a code for "no reading", or wrong."""
    high: float = math.inf

    def read(self, values: Mapping[str, Any]) -> float:
        """The value in the target unit; not a number where this (multiplexed) frame has none, or one out of range."""
        value = values.get(self.signal)
        if value is None or not self.low <= float(value) <= self.high:
            return math.nan
        return self.scale * float(value) + self.offset

    def raw_range(self, signal: CanSignal) -> tuple[float, float, float, float]:
        """The lowest and highest raw number that is a reading, and scale and offset from it to the target unit."""
        slope, zero = float(signal.conversion.scale), float(signal.conversion.offset)
        ends = sorted((end - zero) / slope for end in (self.low, self.high))
        scale, offset = self.scale * slope, self.scale * zero + self.offset
        # Beyond the largest float there is no value, be it in the frame or after scaling.
        limit = LARGEST / max(1.0, abs(scale))
        slack = [ROUNDING * abs(end) if math.isfinite(end) else 0.0 for end in ends]
        return max(ends[0] - slack[0], -limit), min(ends[1] + slack[1], limit), scale, offset

    def describe(self) -> str:
        """Where it is read, in words."""
        message = self.message
        return f"{message.name}.{self.signal} [{self.source_unit}], frame 0x{message.frame_id:X}"


def load_dbc(path: Path) -> Database:
    """The database.

    Raises:
        ConfigurationError: no such file, or not a CAN database.
    """
    try:
        database = cantools.database.load_file(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}", ("driver", "dbc")) from error
    except Exception as error:
        cause = " ".join(str(error).split())[:200]
        raise ConfigurationError(f"{path}: not a CAN database: {cause}", ("driver", "dbc")) from error
    if not isinstance(database, Database):
        raise ConfigurationError(
            f"{path}: a diagnostics database; a CAN database (DBC, KCD, SYM, ARXML) is needed", ("driver", "dbc")
        )
    return database


def find_signals(database: Database, signals: Sequence[Signal], path: Path) -> list[Wanted]:
    """Every one of ``signals`` in ``database`` (which came from ``path``).

    Raises:
        ConfigurationError: one is not there, or is there twice, or measures something else.
    """
    return [_find(database, signal, path) for signal in signals]


def _find(database: Database, signal: Signal, path: Path) -> Wanted:
    key = ("signals", signal.name)
    source: Source = signal.source
    messages = [message for message in database.messages if source.message in (None, message.name)]
    if not messages:
        known = nearest(str(source.message), [message.name for message in database.messages])
        raise ConfigurationError(f"{path}: no message {source.message!r}: {known}", key)
    holders = [message for message in messages if any(entry.name == source.signal for entry in message.signals)]
    if not holders:
        known = nearest(source.signal, sorted({entry.name for message in messages for entry in message.signals}))
        raise ConfigurationError(f"{path}: no signal {source.signal!r}: {known}", key)
    if len(holders) > 1:
        names = ", ".join(message.name for message in holders)
        raise ConfigurationError(f"{path}: signal {source.signal!r} is in {names}: set 'message' beside it", key)
    if holders[0].is_container:
        raise ConfigurationError(f"{path}: {holders[0].name} is a container message, which is not supported", key)
    found = holders[0].get_signal_by_name(source.signal)
    unit = source.unit or found.unit
    if unit is None:
        raise ConfigurationError(f"{path}: signal {source.signal!r} has no unit: set 'unit' beside it", key)
    try:
        scale, offset = factor(unit, signal.unit)
    except ValueError as error:
        raise ConfigurationError(f"{path}: signal {source.signal!r}: {error}", key) from error
    low, high = found.minimum, found.maximum
    if low is None or high is None or not low < high:  # [0|0] in a DBC means that nobody said
        low, high = -math.inf, math.inf
    return Wanted(signal.name, signal.unit, holders[0], found.name, unit, scale, offset, float(low), float(high))
