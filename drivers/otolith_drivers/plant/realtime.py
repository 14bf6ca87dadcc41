"""A scenario in real time: its samples at their times, what a node counts, and the table of nodes."""

import csv
import json
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field, replace
from heapq import merge
from importlib import import_module
from itertools import tee
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
        acting = [(number, fault.kind) for number, fault in enumerate(faults) if isinstance(fault, BusFault)]
        return cls({number: FaultCount(number, kind) for number, kind in acting})

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
    """Check that every fault of the bus that acts on ``transport`` can happen there.

    Raises:
        ConfigurationError: one cannot.
    """
    for number, fault in enumerate(scenario.faults):
        if isinstance(fault, BusFault) and fault.on in (None, transport) and transport not in fault.ACTS_ON:
            fit = ", ".join(sorted(fault.ACTS_ON))
            raise ConfigurationError(
                f"faults[{number}]: a fault of kind {fault.kind!r} cannot happen on {transport}, only on {fit}"
            )


def in_real_time(
    scenario: Scenario,
    summaries: Mapping[str, NodeSummary],
    stopped: Callable[[], bool],
    duration: float = math.inf,
) -> Iterator[tuple[str, ScheduledSample]]:
    """The samples of ``scenario`` on each transport, when they are due, until ``stopped`` or for ``duration`` s.

    They are counted in the summary of the transport. A sample whose delay would put it before the previous one of its
    transport comes at once.
    """
    copies = tee(simulate(scenario), len(summaries))
    schedules = [
        _schedule(samples, FaultInjector(scenario.faults, scenario.seed, transport), transport, duration)
        for transport, samples in zip(summaries, copies, strict=True)
    ]
    start = time.monotonic()
    for transport, planned in merge(*schedules, key=lambda item: item[1].due):
        if not _wait_until(start + planned.due, stopped):
            return
        if (late := time.monotonic() - start - planned.due) > CATCH_UP_LIMIT:
            summaries[transport].stalls += 1
            start += late
        summaries[transport].count(planned.effect, scenario.sample_period)
        yield transport, replace(planned, taken=start + planned.taken, due=start + planned.due)


def _schedule(
    samples: Iterable[PlantSample], injector: FaultInjector, transport: str, duration: float
) -> Iterator[tuple[str, ScheduledSample]]:
    """The samples of the first ``duration`` s on a transport, with times since the start."""
    latest = 0.0
    for index, sample in enumerate(samples):
        if sample.time >= duration:
            return
        effect = injector.at(sample.time)
        latest = max(latest, sample.time + effect.delay)
        yield transport, ScheduledSample(index, sample, sample.time, latest, effect)


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

    @contextmanager
    def online(self) -> Iterator[None]:
        """Be on the bus for the time of a run."""
        yield

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
    def publish(self, scheduled: ScheduledSample, summary: NodeSummary) -> None:
        """Put a sample on the bus, and count it."""


def run_nodes(
    nodes: Mapping[str, Node],
    scenario: Scenario,
    truth: TruthFile | None,
    stopped: Callable[[], bool],
    duration: float = math.inf,
) -> dict[str, NodeSummary]:
    """Simulate one machine on all ``nodes``, by transport, until ``stopped`` or for ``duration`` s.

    Raises:
        DeviceError: a bus failed.
    """
    summaries = {transport: NodeSummary.of(scenario.faults) for transport in nodes}
    first = next(iter(nodes))
    with ExitStack() as stack:
        for node in nodes.values():
            stack.enter_context(node.online())
        for transport, scheduled in in_real_time(scenario, summaries, stopped, duration):
            nodes[transport].publish(scheduled, summaries[transport])
            if truth is not None and transport == first:
                truth.write(scheduled)
    return summaries


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


def write_summary(path: Path, scenario: Scenario, summaries: Mapping[str, NodeSummary]) -> None:
    """Write the summary of each transport as a JSON file; of a single one without a level of its own.

    Raises:
        ServiceError: it cannot be written.
    """
    documents = [{"transport": transport} | summary.document() for transport, summary in summaries.items()]
    nodes = documents[0] if len(documents) == 1 else {"nodes": documents}
    document = {"plant": scenario.plant, "seed": scenario.seed} | nodes
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
