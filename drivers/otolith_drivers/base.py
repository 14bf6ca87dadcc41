"""The driver interface: a driver reads samples from a machine, stamps them at their source and delivers them.

A driver is read-only by construction: the protocol has no method that writes to a machine. A driver owns its threads
and its reconnect loop, counts the samples that it receives and loses, and lets no exception leave its threads.
:class:`SeveralSources` presents several drivers as one, for a machine whose signals come from several buses or files.

The table of drivers, and the entry points through which other packages add theirs, are here as well; and what drivers
need whose signals arrive as plain numbers: :class:`ScaledSource` for the machine file, and :class:`Conversion`.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass
from enum import StrEnum
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self, cast

from pydantic import model_validator

from otolith_drivers.common.reconnection import CLOSE_TIMEOUT, ReconnectBackoff, ThreadedDriver
from otolith_drivers.config_files import Range, StrictModel
from otolith_drivers.errors import ConfigurationError, DeviceError, installation_of, nearest
from otolith_drivers.units import factor

log = logging.getLogger(__name__)

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
    TRUE = "true"  # A time is when the value was true, and is used as it is. A command changes at its samples
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
    sources: tuple["SourceState", ...] = ()  # Of a machine with several sources


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
            return cast("DriverType", point.load())
    except ImportError as error:
        if name in EXTRAS:
            missing = f"driver {name!r} needs the extra {name!r}"
            raise ConfigurationError(f"{missing}: {installation_of(name)} ({error})") from error
        raise ConfigurationError(f"driver {name!r} cannot be loaded: {error}") from error
    text = f"unknown driver {name!r}: {nearest(name, known_drivers())}"
    raise ConfigurationError(f"{text}; a package that brings its own must be installed here")


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


@dataclass(frozen=True, slots=True)
class NamedSource:
    """A driver of a machine with several, its name in the machine file, and the signals that it reads."""

    name: str
    driver: Driver
    signals: tuple[str, ...]


class SeveralSources(ThreadedDriver):
    """Implements :class:`Driver` over other drivers, each of which keeps its own threads.

    All drivers stamp on this computer's monotonic clock, so their samples have one time base.
    """

    def __init__(self, sources: tuple[NamedSource, ...]) -> None:
        super().__init__()
        self._sources = sources
        self._faults: dict[str, str] = {}  # Why a source cannot be opened, by its name; it is tried again

    @property
    def sampling(self) -> Mapping[str, Sampling]:
        """Meaning of the sample times of each signal."""
        return {
            signal: sampling_of(source.driver.sampling, signal) for source in self._sources for signal in source.signals
        }

    def open(self, deliver: Deliver) -> None:
        """See :meth:`Driver.open`; a source that cannot be opened does not keep the others back.

        Raises:
            DeviceError: no source can be opened.
        """
        for source in self._sources:
            self._try_to_open(source, deliver)
        if len(self._faults) == len(self._sources):
            self.close()
            raise DeviceError("; ".join(f"source {name!r}: {fault}" for name, fault in self._faults.items()))
        if self._faults:
            self._start("open-sources", self._open_the_rest, deliver)

    def _try_to_open(self, source: NamedSource, deliver: Deliver) -> None:
        try:
            source.driver.open(deliver)
        except Exception as error:  # noqa: BLE001 - whatever a driver of another package raises, the others go on
            is_known = isinstance(error, DeviceError)
            self._faults[source.name] = str(error) if is_known else f"{type(error).__name__}: {error}"
        else:
            self._faults.pop(source.name, None)
            if self._stop.is_set():  # it was closed while it opened
                source.driver.close()

    def _open_the_rest(self, deliver: Deliver) -> None:
        backoff, logged = ReconnectBackoff(), dict[str, str]()
        while self._faults:
            for name, fault in self._faults.items():
                if logged.get(name) != fault:
                    log.warning("source %r: %s; tried again until it can be opened", name, fault)
            logged = dict(self._faults)
            if self._stop.wait(backoff.next()):
                return
            for source in self._sources:
                if source.name in self._faults and not self._stop.is_set():
                    self._try_to_open(source, deliver)

    def close(self) -> None:
        """See :meth:`Driver.close`; all drivers close at the same time."""
        self._stop.set()
        closing = [super().close, *(source.driver.close for source in self._sources)]
        threads = [threading.Thread(target=close, name="close", daemon=True) for close in closing]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def counters(self) -> Counters:
        """Return the sums over all drivers."""
        counters = [astuple(source.driver.counters()) for source in self._sources]
        return Counters(*map(sum, zip(*counters, strict=True)))

    def link(self) -> Link:
        """Return the state of each source, and that of the machine: it is up while any source is.

        A source that is down is a warning. The period is that of the fastest source, if all of them are polled.
        """
        faults = {name: Link(up=False, reason=fault) for name, fault in list(self._faults.items())}
        states = tuple(
            SourceState(
                source.name, source.signals, faults.get(source.name) or source.driver.link(), source.driver.counters()
            )
            for source in self._sources
        )
        up, links = any(state.link.up for state in states), [state.link for state in states]
        warnings = [f"{state.name}: {warning}" for state in states for warning in state.link.warnings]
        down = [f"source {state.name!r} is down: {state.link.reason}" for state in states if not state.link.up]
        periods = [link.period for link in links if link.period is not None]
        return Link(
            up=up,
            reason="" if up else "; ".join(down),
            warnings=tuple([*down, *warnings] if up else warnings),
            plan="; ".join(f"{state.name}: {state.link.plan}" for state in states if state.link.plan),
            period=min(periods) if len(periods) == len(links) else None,
            latency=max((link.latency for link in links), default=0.0),
            sources=states,
        )

    def describe(self) -> list[str]:
        """Return the lines of each driver under its name."""
        lines = [f"{len(self._sources)} sources: {', '.join(source.name for source in self._sources)}"]
        for source in self._sources:
            first, *rest = source.driver.describe()
            lines += [f"source {source.name}: {first}", *rest]
        return lines
