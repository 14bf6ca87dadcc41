"""The simulated machine as a CAN node: cyclic frames by a DBC, in real time, with an alive counter in each message."""

import csv
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import can
from cantools.database import Message

from otolith_drivers.can_bus import open_bus
from otolith_drivers.dbc import load_dbc
from otolith_drivers.errors import ConfigurationError, DeviceError, ServiceError
from otolith_drivers.plant.plants import signals, simulate
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.tick import Tick
from otolith_drivers.quantities import factor

ALIVE_COUNTER = "AliveCounter"  # signals whose name ends so count the frames of their message
LISTEN_FIRST = 0.15  # s; longer than ten periods of a node that is already there
CATCH_UP_LIMIT = 1.0  # s; after a longer stall (suspend) the node goes on from now instead of sending a burst
TRUTH_EVERY = 10  # ticks


@dataclass(frozen=True, slots=True)
class Sent:
    """What a node has done."""

    frames: int
    seconds: float
    """Simulated time."""
    stalls: int
    """How often the computer held the node up for longer than ``CATCH_UP_LIMIT``."""


class CanNode:
    """A simulated machine on its bus."""

    def __init__(self, scenario: Scenario, truth: Path | None = None) -> None:
        """Open the bus; ``truth`` gets what is true, as CSV over Unix time.

        Raises:
            DeviceError: the bus cannot be opened, or another node already sends these frames.
            ConfigurationError: the DBC describes signals that the machine does not have.
            ServiceError: ``truth`` cannot be written.
        """
        self._scenario = scenario
        self._messages = _messages(scenario)
        self._conversions = _conversions(self._messages, scenario)
        self._truth = _TruthFile(truth) if truth is not None else None
        self._bus = open_bus(scenario.bus)
        try:
            _refuse_twins(self._bus, self._messages, scenario)
        except DeviceError:
            self.close()
            raise

    def run(self, stopped: Callable[[], bool], duration: float = math.inf) -> Sent:
        """Be the machine until ``stopped`` or for ``duration`` s.

        Raises:
            DeviceError: the bus went away.
        """
        stalls, index = 0, 0
        for index, (tick, stalled) in enumerate(_in_real_time(self._scenario)):
            if stopped() or tick.time >= duration:
                break
            stalls += stalled
            for message in self._messages:
                self._send(message, tick, index)
            if self._truth is not None and index % TRUTH_EVERY == 0:
                self._truth.note(tick)
        return Sent(index * len(self._messages), index * self._scenario.sample_period, stalls)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()
        if self._truth is not None:
            self._truth.close()

    def _send(self, message: Message, tick: Tick, index: int) -> None:
        values: dict[str, float] = {}
        for signal in message.signals:
            if signal.name.endswith(ALIVE_COUNTER):
                values[signal.name] = index % 2**signal.length
            else:  # a sensor saturates at the ends of its range
                scale, offset = self._conversions[signal.name]
                low = -math.inf if signal.minimum is None else float(signal.minimum)
                high = math.inf if signal.maximum is None else float(signal.maximum)
                values[signal.name] = min(max(scale * tick.measured[signal.name] + offset, low), high)
        data = message.encode(values, padding=True)
        frame = can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=message.is_extended_frame)
        try:
            self._bus.send(frame)
        except (can.CanError, OSError) as error:
            raise DeviceError(f"sending on the bus failed: {error}") from error


def _in_real_time(scenario: Scenario) -> Iterator[tuple[Tick, bool]]:
    """Each tick at its time, and whether the computer had held the machine up so long that time was given up."""
    start = time.monotonic()
    for tick in simulate(scenario):
        late = time.monotonic() - (start + tick.time)
        if late < 0:
            time.sleep(-late)
        if stalled := late > CATCH_UP_LIMIT:
            start += late
        yield tick, stalled


def _messages(scenario: Scenario) -> list[Message]:
    messages = load_dbc(scenario.dbc).messages
    known = signals(scenario)
    for message in messages:
        for signal in message.signals:
            if signal.name not in known and not signal.name.endswith(ALIVE_COUNTER):
                text = f"{scenario.dbc}: {message.name}.{signal.name} is no signal of plant {scenario.plant!r}"
                raise ConfigurationError(f"{text}; it has {', '.join(sorted(known))}")
    return list(messages)


def _refuse_twins(bus: can.BusABC, messages: list[Message], scenario: Scenario) -> None:
    """Two nodes with the same arbitration IDs would give the listener a mixture of two machines."""
    ours = {message.frame_id for message in messages}
    end = time.monotonic() + LISTEN_FIRST
    while (left := end - time.monotonic()) > 0:
        frame = bus.recv(left)
        if frame is not None and frame.arbitration_id in ours:
            raise DeviceError(
                f"another node already sends frame 0x{frame.arbitration_id:X} on {scenario.bus.title()}: "
                "is a second plant or demo running? Stop it, or give this scenario another bus"
            )


class _TruthFile:
    def __init__(self, path: Path) -> None:
        try:
            self._file = path.open("w", encoding="utf-8", newline="", buffering=1)
        except OSError as error:
            raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = csv.writer(self._file)

    def note(self, tick: Tick) -> None:
        if tick.time == 0.0:
            self._writer.writerow(["t", *tick.truth])
        self._writer.writerow([f"{time.time():.4f}", *(f"{value:.9g}" for value in tick.truth.values())])

    def close(self) -> None:
        self._file.close()


def _conversions(messages: list[Message], scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Scale and offset of each signal from the plant's unit to that of the DBC."""
    units = signals(scenario)
    return {
        signal.name: factor(units[signal.name], signal.unit or units[signal.name])
        for message in messages
        for signal in message.signals
        if signal.name in units
    }
