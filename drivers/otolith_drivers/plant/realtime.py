"""A scenario in real time: its samples at their times, on the buses of its nodes or in this process.

The nodes are devices of their own, for ``otolith plant``. The driver ``plant`` needs no bus: the faults of the scenario
act as on one, and a fault that needs a real bus is refused.
"""

import csv
import json
import logging
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
from typing import Any, NamedTuple

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup, Signal
from otolith_drivers.common.clocks import wall_clock_offset
from otolith_drivers.common.reconnection import ThreadedDriver
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, ServiceError, nearest
from otolith_drivers.plant.faults import (
    CAN,
    IN_PROCESS,
    MODBUS_RTU,
    MODBUS_TCP,
    BusEffect,
    BusFault,
    FaultInjector,
    PlantSample,
)
from otolith_drivers.plant.scenario import Scenario, load_scenario, simulate
from otolith_drivers.units import factor

log = logging.getLogger(__name__)

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

    number: int  # Counted over all faults of the scenario, from 0
    kind: str
    ticks: int = 0  # Samples on which it acted
    withheld: int = 0  # Frames not sent, requests not answered or samples not delivered because of it
    refused: int = 0  # Reads answered with an exception because of it


@dataclass(slots=True)
class NodeSummary:
    """What a node has done; its fields are the keys of the summary file."""

    faults: dict[int, FaultCount]  # The faults of the bus, by number
    ticks: int = 0  # Samples
    seconds: float = 0.0  # Simulated time
    stalls: int = 0  # How often the computer delayed the node by more than CATCH_UP_LIMIT
    frames: int = 0  # Frames of the machine that were sent
    answers: int = 0  # Answers to requests, exceptions included
    functions: Counter[int] = field(default_factory=Counter)  # Requests by function code
    refused: Counter[int] = field(default_factory=Counter)  # As illegal functions: all that do not read registers

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
    taken: float  # Sampling instant, s on this computer's monotonic clock; a delay of the bus does not change it
    due: float  # When the bus carries the sample, on the same clock; the computer may be later
    effect: BusEffect


def refuse_unfit(scenario: Scenario, transport: str) -> None:
    """Raise ConfigurationError if a fault of the bus that acts on ``transport`` cannot happen there."""
    for number, fault in enumerate(scenario.faults):
        if isinstance(fault, BusFault) and fault.on in (None, transport) and transport not in fault.ACTS_ON:
            fit = ", ".join(sorted(fault.ACTS_ON))
            text = f"faults[{number}]: a fault of kind {fault.kind!r} cannot happen on {transport}, only on {fit}"
            raise ConfigurationError(text)


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
        """Create the file; raise ServiceError if it cannot be written."""
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
        unix = wall_clock_offset() + scheduled.taken
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
    """Simulate one machine on all ``nodes`` until ``stopped`` or ``duration`` s; raise DeviceError if a bus fails."""
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
    """Write the summary of each transport as JSON, a single one flat; raise ServiceError if it cannot be written."""
    documents = [{"transport": transport} | summary.document() for transport, summary in summaries.items()]
    nodes = documents[0] if len(documents) == 1 else {"nodes": documents}
    document = {"plant": scenario.plant, "seed": scenario.seed} | nodes
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error


class PlantOptions(StrictModel):
    """``[driver]`` with ``type = "plant"``."""

    scenario: Path  # The scenario file, relative to the machine file


class PlantSource(StrictModel):
    """The source of a signal."""

    signal: str  # Name of the signal in the simulated machine


Options, Source = PlantOptions, PlantSource  # for base.DriverType


class PlantSignal(NamedTuple):
    """A wanted signal: its name in the daemon and in the machine, and the conversion between their units."""

    name: str
    signal: str
    scale: float
    offset: float


def build(options: PlantOptions, setup: Setup) -> "PlantDriver":
    """A driver for the scenario; raise ConfigurationError for a wrong file, an unfit fault or an unknown signal."""
    path = setup.folder / options.scenario
    scenario = load_scenario(path, ("driver", "scenario"))
    try:
        refuse_unfit(scenario, IN_PROCESS)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}", ("driver", "scenario")) from error
    return PlantDriver(scenario, path, [_find(signal, scenario) for signal in setup.signals])


def _find(signal: Signal, scenario: Scenario) -> PlantSignal:
    source: PlantSource = signal.source
    key = ("signals", signal.name)
    if source.signal not in scenario.SIGNALS:
        known = nearest(source.signal, list(scenario.SIGNALS))
        raise ConfigurationError(f"plant {scenario.plant!r} has no signal {source.signal!r}: {known}", key)
    try:
        return PlantSignal(signal.name, source.signal, *factor(scenario.SIGNALS[source.signal], signal.unit))
    except ValueError as error:
        raise ConfigurationError(f"signal {source.signal!r}: {error}", key) from error


class PlantDriver(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over a simulated machine, which runs in a thread of its own.

    A sample has the time at which a bus would have carried it, however busy this computer is.
    """

    sampling = Sampling.CYCLIC

    def __init__(self, scenario: Scenario, path: Path, wanted: list[PlantSignal]) -> None:
        super().__init__()
        self._scenario, self._path, self._wanted = scenario, path, wanted
        self._counters = Counters()
        self._link = Link(up=False, reason="not opened yet")

    def open(self, deliver: Deliver) -> None:
        self._link = Link(up=True)
        self._start("plant", self._run, deliver)

    def counters(self) -> Counters:
        return self._counters

    def link(self) -> Link:
        return self._link

    def describe(self) -> list[str]:
        units = self._scenario.SIGNALS
        signals = [f"{wanted.name} from {wanted.signal} [{units[wanted.signal]}]" for wanted in self._wanted]
        period = f"{1e3 * self._scenario.sample_period:g} ms"
        return [f"plant {self._scenario.plant!r} of {self._path}, simulated here, a sample each {period}", *signals]

    def _run(self, deliver: Deliver) -> None:
        try:
            summaries = {IN_PROCESS: NodeSummary.of(self._scenario.faults)}
            for _, scheduled in in_real_time(self._scenario, summaries, self._stop.is_set):
                self._take(scheduled, deliver)
        except Exception as error:  # the thread ends: the link names the cause
            self._link = Link(up=False, reason=f"{type(error).__name__}: {error}")
            log.exception("the simulated machine stopped with an error")

    def _take(self, scheduled: ScheduledSample, deliver: Deliver) -> None:
        """Deliver a sample, or count it as lost if a fault withholds it."""
        counters, count, gone = self._counters, len(self._wanted), scheduled.effect.gone
        if gone and self._link.up:
            self._link = Link(up=False, reason="the machine is off its bus, by a fault of the scenario (kind = 'gone')")
        elif not gone and not self._link.up:
            self._link, counters = Link(up=True), replace(counters, reconnects=counters.reconnects + 1)
        if scheduled.effect.withheld is not None:
            self._counters = replace(counters, lost=counters.lost + count)
            return
        self._counters = replace(counters, received=counters.received + count)
        measured = scheduled.sample.measured
        due = scheduled.due
        deliver([Sample(name, due, scale * measured[signal] + offset) for name, signal, scale, offset in self._wanted])
