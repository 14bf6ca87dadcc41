"""The driver interface: a driver reads samples from a machine, stamps them at their source and delivers them.

A driver is read-only by construction: the protocol has no method that writes to a machine. A driver owns its threads
and its reconnect loop, counts the samples that it receives and loses, and lets no exception leave its threads.

The table of drivers, and the entry points through which other packages add theirs, are here as well; and what drivers
need whose signals arrive as plain numbers: :class:`ScaledSource` for the machine file, and :class:`Conversion`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, cast

from pydantic import model_validator

from otolith_drivers.config_files import Range, StrictModel
from otolith_drivers.errors import ConfigurationError, installation_of, nearest
from otolith_drivers.units import factor

ENTRY_POINT_GROUP = "otolith.drivers"

# A module is imported only when its driver is selected.
DRIVERS: dict[str, str] = {
    "can": "otolith_drivers.canbus.driver",
    "modbus": "otolith_drivers.modbus.driver",
    "mqtt": "otolith_drivers.mqtt",
    "opcua": "otolith_drivers.opcua.driver",
    "plant": "otolith_drivers.plant.realtime",
    "replay": "otolith_drivers.replay.driver",
}
EXTRAS = ("mqtt", "opcua")  # Drivers whose libraries come with the extra of the same name


class Sample(NamedTuple):
    """One reading of one signal."""

    signal: str
    time: float  # Seconds on the monotonic clock at which the value was true or, if that is unknown, arrived
    value: float  # In the unit of the signal; NaN if the source reports that it has no reading


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal that the daemon wants: its name and unit in the twin, and where the driver reads it."""

    name: str
    unit: str
    source: Any  # Address of the signal: an instance of the driver's Source
    ordinary: tuple[float, float] | None = None
    """Values of an input in ordinary operation, in ``unit``; None for all other signals."""


class Sampling(StrEnum):
    """Meaning of the times of a driver's samples, which decides how samples become records of a window."""

    CYCLIC = "cyclic"  # The source samples on its own grid; a time is one of arrival: maybe late, never early
    TRUE = "true"  # A time is that of measurement, and is used as it is. A command changes at its samples
    POLLED = "polled"  # As TRUE, but asked by a clock of its own: a command may have changed since


def sampling_of(sampling: Sampling | Mapping[str, Sampling], signal: str) -> Sampling:
    """Return the meaning of the times of a signal; ``sampling`` is that of :attr:`Driver.sampling`."""
    return sampling if isinstance(sampling, Sampling) else sampling[signal]


@dataclass(frozen=True, slots=True)
class Setup:
    """What a driver is built for."""

    signals: tuple[Signal, ...]
    folder: Path  # Files named in options are relative to this folder
    sample_period: float  # Period of the window's grid in s
    timezone: str = ""  # IANA name of the zone of dates that name none; UTC without it


@dataclass(frozen=True, slots=True)
class Counters:
    """Counts since the driver was opened."""

    received: int = 0  # Samples delivered
    bad: int = 0  # Frames, replies, rows or values that arrived but are unusable: not decodable, out of range, repeated
    lost: int = 0  # Samples known to be sent or requested that never arrived
    reconnects: int = 0


@dataclass(frozen=True, slots=True)
class Link:
    """State of the connection to the machine."""

    up: bool
    reason: str = ""  # Why the connection is down; empty if it is up
    warnings: tuple[str, ...] = ()
    """Present faults of a connection that is up, one line each: a silent frame, a dead device, refused registers."""
    plan: str = ""  # Requested and achieved polling; empty if the machine sends by its own clock
    period: float | None = None  # Achieved, s; None if the machine sends by its own clock, or not known yet
    latency: float = 0.0  # Longest time, s, by which samples arrive late because the source sends many at once
    defect: str = ""  # Why its values must not be trusted although they come: this becomes an event of the machine
    sources: tuple["SourceState", ...] = ()  # Of a machine with several sources, or of one with a defect


@dataclass(frozen=True, slots=True)
class SourceState:
    """One of several sources of a machine: its name in the machine file, its signals, and its state."""

    name: str
    signals: tuple[str, ...]
    link: Link
    counters: Counters


Deliver = Callable[[Sequence[Sample]], None]
"""Takes the samples of one frame, reply or row. Called from the driver's thread, never with an empty list."""


class Driver(Protocol):
    """A connection to one machine. Opened and closed once; an opening that fails may be repeated."""

    @property
    def sampling(self) -> Sampling | Mapping[str, Sampling]:
        """Meaning of the sample times, the same for all signals or by signal."""

    def open(self, deliver: Deliver) -> None:
        """Start to deliver samples. The driver's thread waits for an absent device and reconnects to a lost one.

        Raises:
            DeviceError: the computer lacks a requirement: the interface, the permission or the file.
        """

    def close(self) -> None:
        """Stop within one second; may be called twice."""

    def counters(self) -> Counters:
        """Return the counts so far; callable from any thread."""

    def link(self) -> Link:
        """Return the state of the connection; callable from any thread."""

    def describe(self) -> list[str]:
        """Return what the driver will read and from where, one line per fact, for ``otolith check``."""


class DriverType(Protocol):
    """What a row of the registry points to: a module with these three names."""

    Options: type[StrictModel]  # The keys of [driver] except type and name
    Source: type[StrictModel]  # The keys of each signal in [signals]

    def build(self, options: Any, setup: Setup) -> Driver:
        """Return a driver that is not open yet; ``options`` is an instance of ``Options``.

        Raises:
            ConfigurationError: a signal does not exist at its source.
        """


def known_drivers() -> list[str]:
    """Return the names that a machine file may give as ``driver.type``."""
    return sorted({*DRIVERS, *(point.name for point in entry_points(group=ENTRY_POINT_GROUP))})


def find_driver(name: str) -> DriverType:
    """Return the driver module ``name``; raise ConfigurationError if there is none, or it cannot be imported."""
    try:
        if name in DRIVERS:
            return cast("DriverType", import_module(DRIVERS[name]))
        for point in entry_points(group=ENTRY_POINT_GROUP, name=name):
            return _with_all_parts(name, point.load())
    except ImportError as error:
        if name in EXTRAS:
            missing = f"driver {name!r} needs the extra {name!r}"
            raise ConfigurationError(f"{missing}: {installation_of(name)} ({error})") from error
        raise ConfigurationError(f"driver {name!r} cannot be loaded: {error}") from error
    except ConfigurationError:
        raise
    except Exception as error:  # a module of another package may raise anything
        raise ConfigurationError(f"driver {name!r} cannot be loaded: {type(error).__name__}: {error}") from error
    text = f"unknown driver {name!r}: {nearest(name, known_drivers())}"
    raise ConfigurationError(f"{text}; a package that brings its own must be installed here")


def _with_all_parts(name: str, module: Any) -> DriverType:
    """Return a module of another package; raise ConfigurationError if it lacks what a driver has."""
    if missing := [part for part in ("Options", "Source", "build") if not hasattr(module, part)]:
        raise ConfigurationError(f"driver {name!r} cannot be loaded: its module has no {' and no '.join(missing)}")
    return cast("DriverType", module)


class ScaledSource(StrictModel):
    """Keys of a signal that arrives as a number; the value is ``scale * number + offset`` in ``unit``."""

    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0
    range: Range | None = None  # In unit; a value outside is no reading

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale 0 makes every value the same: leave it out, or write what one step is worth")
        return self


@dataclass(frozen=True, slots=True)
class Conversion:
    """From a number to the value in the unit of the twin."""

    source: ScaledSource
    to_target: tuple[float, float]  # Scale and offset from the unit of the source

    @classmethod
    def of(cls, source: ScaledSource, unit: str, target: str) -> Self:
        """Return the conversion of ``source``, which is in ``unit``; raise ValueError if the quantities differ."""
        return cls(source, factor(unit, target))

    @classmethod
    def for_signal(cls, signal: Signal) -> Self:
        """Return the conversion from the unit of the source; raise ConfigurationError for another quantity."""
        try:
            return cls.of(signal.source, signal.source.unit, signal.unit)
        except ValueError as error:
            raise ConfigurationError(str(error), ("signals", signal.name)) from error

    def value(self, number: object) -> float:
        """Return the value; NaN if ``number`` is none, not finite, or out of range."""
        if not isinstance(number, bool | int | float):
            return math.nan
        try:
            written = self.source.scale * float(number) + self.source.offset
        except OverflowError:  # an integer beyond the largest float
            return math.nan
        if self.source.range is not None and not self.source.range[0] <= written <= self.source.range[1]:
            return math.nan
        value = self.to_target[0] * written + self.to_target[1]
        return value if math.isfinite(value) else math.nan

    def why_no_value(self, number: object) -> str:
        """Return why :meth:`value` is NaN for ``number``, with value and range, in the unit of the source."""
        if not isinstance(number, bool | int | float):
            return "is no number"
        with suppress(OverflowError):
            written = self.source.scale * float(number) + self.source.offset
            if self.source.range is not None and math.isfinite(written):
                low, high = self.source.range
                unit = self.source.unit or "in the unit of the source"
                return f"is {written:.6g} {unit}, out of its range from {low:g} to {high:g}"
        return "is not finite"
