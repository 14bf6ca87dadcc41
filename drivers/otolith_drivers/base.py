"""What every driver is: something that stamps samples at their source and hands them on, and can do nothing else.

A driver is read-only by construction: this protocol has no way to write to a machine. It owns its threads and its
reconnect loop, counts what it receives and what it loses, and never lets an exception out of its threads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from otolith_drivers.config_files import StrictModel


class Sample(NamedTuple):
    """One reading of one signal."""

    signal: str
    time: float
    """Seconds on this computer's monotonic clock at which the reading was true or, failing that, arrived."""
    value: float
    """In the unit of the signal; not a number where the source said that it has no reading."""


@dataclass(frozen=True, slots=True)
class Signal:
    """What the daemon wants to read: its own name and unit, and where the driver finds it."""

    name: str
    unit: str
    source: Any
    """Where the signal is: an instance of the driver's ``Source``."""


class Sampling(StrEnum):
    """What the times of a driver's samples mean, and so how they come onto the grid of a window."""

    CYCLIC = "cyclic"
    """The source samples on a grid of its own; a time is that of arrival, which may be late but never early."""
    POLLED = "polled"
    """A time is that at which the value was true: signals are brought to the grid by interpolation."""


@dataclass(frozen=True, slots=True)
class Setup:
    """What a driver is built for."""

    signals: tuple[Signal, ...]
    folder: Path
    """What files named in options are relative to."""
    sample_period: float
    """s; how often the daemon wants each signal."""


@dataclass(frozen=True, slots=True)
class Counters:
    """What a driver has seen since it was opened."""

    received: int = 0
    """Samples delivered."""
    bad: int = 0
    """Frames, replies, rows or single values that came and could not be used: not decodable, out of range, repeated."""
    lost: int = 0
    """Samples known to be sent or asked for that never came."""
    reconnects: int = 0


@dataclass(frozen=True, slots=True)
class Link:
    """The state of the connection to the machine."""

    up: bool
    reason: str = ""
    """Why it is down, in words."""
    warnings: tuple[str, ...] = ()
    """What is wrong now although it is up, a line each: a silent frame, a dead device, registers that are refused."""
    plan: str = ""
    """What is asked of the machine and what is achieved; empty where the machine sets the pace."""
    period: float | None = None
    """s from sample to sample as achieved; None where the machine sets the pace, or while it is not known."""


Deliver = Callable[[Sequence[Sample]], None]
"""Takes the samples of one frame, reply or row; called from the driver's thread, never blocks for long."""


class Driver(Protocol):
    """A connection to one machine. Built from options, then opened once and closed once."""

    @property
    def sampling(self) -> Sampling:
        """What the times of its samples mean."""

    def open(self, deliver: Deliver) -> None:
        """Start to deliver; a device that is not there yet is waited for in a thread, as one that went away is.

        Raises:
            DeviceError: this computer lacks what it takes: the interface, the permission, the file.
        """

    def close(self) -> None:
        """Stop within a second; may be called twice."""

    def counters(self) -> Counters:
        """What has been seen so far; from any thread."""

    def link(self) -> Link:
        """Whether the connection stands, and what is wrong with it; from any thread."""

    def describe(self) -> list[str]:
        """What will be read from where, a line per fact, for ``otolith check``."""


class DriverType(Protocol):
    """What a row of the registry points to: a module with these three names."""

    Options: type[StrictModel]
    """The keys of ``[driver]`` beside ``type``."""
    Source: type[StrictModel]
    """The keys of each of ``[signals]``: where to find the signal."""

    def build(self, options: Any, setup: Setup) -> Driver:
        """A driver ready to be opened; ``options`` is an instance of ``Options``.

        Raises:
            ConfigurationError: a signal cannot be found where its source says.
        """
