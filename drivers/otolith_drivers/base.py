"""What every driver is: something that stamps samples at their source and hands them on, and can do nothing else.

A driver is read-only by construction: this protocol has no way to write to a machine. It owns its threads and its
reconnect loop, counts what it receives and what it loses, and never lets an exception out of its threads.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from otolith_drivers.toml_files import Closed


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


@dataclass(frozen=True, slots=True)
class Counters:
    """What a driver has seen since it was opened."""

    received: int = 0
    """Frames, replies or rows that held a wanted signal."""
    bad: int = 0
    """Received but not decodable, or out of range."""
    lost: int = 0
    """Known to be sent but never received, or dropped for want of room."""
    reconnects: int = 0


@dataclass(frozen=True, slots=True)
class Link:
    """The state of the connection to the machine."""

    up: bool
    reason: str = ""
    """Why it is down, in words."""


Deliver = Callable[[Sequence[Sample]], None]
"""Takes the samples of one frame, reply or row; called from the driver's thread, never blocks for long."""


class Driver(Protocol):
    """A connection to one machine. Built from options, then opened once and closed once."""

    def open(self, deliver: Deliver) -> None:
        """Connect and start to deliver.

        Raises:
            DeviceError: the device cannot be reached at all.
        """

    def close(self) -> None:
        """Stop within a second; may be called twice."""

    def counters(self) -> Counters:
        """What has been seen so far; from any thread."""

    def link(self) -> Link:
        """Whether the connection stands; from any thread."""

    def describe(self) -> list[str]:
        """What will be read from where, a line per fact, for ``otolith check``."""


class DriverType(Protocol):
    """What a row of the registry points to: a module with these three names."""

    Options: type[Closed]
    """The keys of ``[driver]`` beside ``type``."""
    Source: type[Closed]
    """The keys of each of ``[signals]``: where to find the signal."""

    def build(self, options: Any, signals: Sequence[Signal], folder: Path) -> Driver:
        """A driver ready to be opened; files in ``options`` are relative to ``folder``.

        Raises:
            ConfigurationError: a signal cannot be found where its source says.
        """
