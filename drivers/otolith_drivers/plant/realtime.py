"""A scenario in real time: its samples at their times, what a node counts, and the table of nodes."""

import csv
import json
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.plant.faults import CAN, MODBUS_RTU, MODBUS_TCP, BusEffect, BusFault, FaultInjector, PlantSample
from otolith_drivers.plant.scenario import Scenario, simulate

# Simulated machines as devices of their own. Each class is a Node.
NODES = {
    CAN: ("otolith_drivers.plant.can_node", "CanNode"),
    MODBUS_TCP: ("otolith_drivers.plant.modbus_node", "TcpNode"),
    MODBUS_RTU: ("otolith_drivers.plant.modbus_node", "RtuNode"),
}
# Engineering choices. No test guards the first, which concerns suspend and resume.
CATCH_UP_LIMIT = 1.0  # s; after a longer stall the node continues from now instead of sending a burst
MAX_SLEEP = 0.1  # s; delay of a stop
TRUTH_INTERVAL = 10  # samples from line to line of the truth file


@dataclass(slots=True)
class FaultCount:
    """What one fault of the bus did."""

    number: int
    """Counted over all faults of the scenario, from 0."""
    kind: str
    ticks: int = 0
    """Samples on which it acted."""
    withheld: int = 0
    """Frames not sent, requests not answered or samples not delivered because of it."""
    refused: int = 0
    """Reads answered with an exception because of it."""


@dataclass(slots=True)
class NodeSummary:
    """What a node has done; its fields are the keys of the summary file."""

    faults: dict[int, FaultCount]
    """The faults of the bus, by number."""
    ticks: int = 0
    """Samples."""
    seconds: float = 0.0
    """Simulated time."""
    stalls: int = 0
    """How often the computer delayed the node by more than CATCH_UP_LIMIT."""
    frames: int = 0
    """Frames of the machine that were sent."""
    answers: int = 0
    """Answers to requests, exceptions included."""
    functions: Counter[int] = field(default_factory=Counter)
    """Requests by function code."""
    refused: Counter[int] = field(default_factory=Counter)
    """Requests refused as illegal functions: all that do not read registers, so nothing can be written."""

    @classmethod
    def of(cls, faults: Sequence[object]) -> "NodeSummary":
        """An empty summary for the faults of a scenario."""
        return cls(
            {
                number: FaultCount(number, fault.kind)
                for number, fault in enumerate(faults)
                if isinstance(fault, BusFault)
            }
        )

    def count(self, effect: BusEffect, sample_period: float) -> None:
        """Count another sample."""
        self.ticks += 1
        self.seconds = self.ticks * sample_period
        for number in effect.acting:
            self.faults[number].ticks += 1

    @property
    def withheld(self) -> int:
        """What all faults together have withheld."""
        return sum(fault.withheld for fault in self.faults.values())

    def document(self) -> dict[str, Any]:
        """The summary for a JSON file."""
        return asdict(self) | {
            "faults": [asdict(fault) for fault in self.faults.values()],
            "functions": {str(code): count for code, count in sorted(self.functions.items())},
            "refused": {str(code): count for code, count in sorted(self.refused.items())},
        }


@dataclass(frozen=True, slots=True)
class ScheduledSample:
    """A sample of the machine at the time at which its bus carries it."""

    index: int
    sample: PlantSample
    taken: float
    """Sampling instant, s on this computer's monotonic clock; a delay of the bus does not change it."""
    due: float
    """When the bus carries the sample, on the same clock; the computer may be later."""
    effect: BusEffect


def refuse_unfit(scenario: Scenario, transport: str) -> None:
    """Check that every fault of the bus can happen on ``transport``.

    Raises:
        ConfigurationError: one cannot.
    """
    for number, fault in enumerate(scenario.faults):
        if isinstance(fault, BusFault) and transport not in fault.ACTS_ON:
            fit = ", ".join(sorted(fault.ACTS_ON))
            raise ConfigurationError(
                f"faults[{number}]: a fault of kind {fault.kind!r} cannot happen on {transport}, only on {fit}"
            )


def in_real_time(
    scenario: Scenario, summary: NodeSummary, stopped: Callable[[], bool], duration: float = math.inf
) -> Iterator[ScheduledSample]:
    """The samples of ``scenario`` in their order, until ``stopped`` or for ``duration`` s; counts them in ``summary``.

    A sample whose delay would put it before the previous one comes at once.
    """
    injector = FaultInjector(scenario.faults, scenario.seed)
    start = latest = time.monotonic()
    for index, sample in enumerate(simulate(scenario)):
        effect = injector.at(sample.time)
        latest = max(latest, start + sample.time + effect.delay)
        if sample.time >= duration or not _wait_until(latest, stopped):
            return
        if (late := time.monotonic() - latest) > CATCH_UP_LIMIT:
            summary.stalls += 1
            start, latest = start + late, latest + late
        summary.count(effect, scenario.sample_period)
        yield ScheduledSample(index, sample, start + sample.time, latest, effect)


def _wait_until(moment: float, stopped: Callable[[], bool]) -> bool:
    """Whether ``moment`` (s, monotonic) came before the stop."""
    while not stopped():
        if (left := moment - time.monotonic()) <= 0:
            return True
        time.sleep(min(left, MAX_SLEEP))
    return False


class TruthFile:
    """A CSV file of the parameters and the noise-free states over Unix time ``t`` (s)."""

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            ServiceError: it cannot be written.
        """
        try:
            self._file = path.open("w", encoding="utf-8", newline="", buffering=1)
        except OSError as error:
            raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = csv.writer(self._file)

    def write(self, scheduled: ScheduledSample) -> None:
        """Write a line for every tenth sample, whatever the bus does with it."""
        if scheduled.index % TRUTH_INTERVAL:
            return
        truth = scheduled.sample.truth
        if scheduled.index == 0:
            self._writer.writerow(["t", *truth])
        unix = time.time() - time.monotonic() + scheduled.taken
        self._writer.writerow([f"{unix:.4f}", *(f"{value:.9g}" for value in truth.values())])

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Node(ABC):
    """A simulated machine on its bus: built, run once, closed once."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> NodeSummary:
        """Simulate the machine until ``stopped`` or for ``duration`` s.

        Raises:
            DeviceError: the bus failed.
        """
        summary = NodeSummary.of(self._scenario.faults)
        for scheduled in in_real_time(self._scenario, summary, stopped, duration):
            self._publish(scheduled, summary)
            if truth is not None:
                truth.write(scheduled)
        return summary

    @abstractmethod
    def title(self) -> str:
        """The machine, the bus and the data on it, in a line."""

    @abstractmethod
    def close(self) -> None:
        """Leave the bus."""

    @abstractmethod
    def summary_line(self, summary: NodeSummary) -> str:
        """The summary in a line."""

    @abstractmethod
    def _publish(self, scheduled: ScheduledSample, summary: NodeSummary) -> None:
        """Put a sample on the bus, and count it."""


def open_node(transport: str, scenario: Scenario) -> Node:
    """The machine of ``scenario`` on ``transport``, a key of ``NODES``.

    Raises:
        ConfigurationError: the scenario does not fit the transport.
        DeviceError: the bus cannot be opened, or another node uses it.
    """
    refuse_unfit(scenario, transport)
    module, name = NODES[transport]
    node: Node = getattr(import_module(module), name)(scenario)
    return node


def write_summary(path: Path, scenario: Scenario, transport: str, summary: NodeSummary) -> None:
    """Write the summary as a JSON file.

    Raises:
        ServiceError: it cannot be written.
    """
    document = {"plant": scenario.plant, "transport": transport, "seed": scenario.seed} | summary.document()
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
