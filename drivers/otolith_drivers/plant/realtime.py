"""A scenario in real time: each tick at its moment, with what the bus makes of it.

What a node has done, counted exactly: what it sent, what it was asked, and what its faults withheld.

What is true of a simulated machine, as a CSV file for whoever compares.

The table of ways to reach a simulated machine as a device of its own: one lazy row each.
"""

import csv
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.plant.faults import CAN, MODBUS_RTU, MODBUS_TCP, BusFault, Effect, FaultInjector, PlantSample
from otolith_drivers.plant.scenario import Scenario, simulate


@dataclass(slots=True)
class FaultCount:
    """What one fault of the bus did."""

    number: int
    """Among all faults of the scenario, from 0."""
    kind: str
    ticks: int = 0
    """On which it acted."""
    withheld: int = 0
    """Frames not sent, requests not answered or samples not delivered because of it."""
    refused: int = 0
    """Reads answered with an exception because of it."""


@dataclass(slots=True)
class Summary:
    """All that is counted."""

    faults: dict[int, FaultCount]
    """Those of the bus, by their number."""
    ticks: int = 0
    seconds: float = 0.0
    """Simulated time."""
    stalls: int = 0
    """How often the computer held the node up so long that it gave time up."""
    frames: int = 0
    """Sent, the machine's own."""
    answers: int = 0
    """To requests, exceptions included."""
    functions: Counter[int] = field(default_factory=Counter)
    """Requests by function code."""
    refused: Counter[int] = field(default_factory=Counter)
    """Those refused as illegal functions: every one that does not read registers, so that nobody can write."""

    @classmethod
    def of(cls, faults: Sequence[object]) -> "Summary":
        """Empty, for the faults of a scenario."""
        found = {number: fault for number, fault in enumerate(faults) if isinstance(fault, BusFault)}
        return cls({number: FaultCount(number, fault.kind) for number, fault in found.items()})

    def note(self, effect: Effect, sample_period: float) -> None:
        """Another tick."""
        self.ticks += 1
        self.seconds = self.ticks * sample_period
        for number in effect.acting:
            self.faults[number].ticks += 1

    @property
    def withheld(self) -> int:
        """By all faults together."""
        return sum(fault.withheld for fault in self.faults.values())

    def document(self) -> dict[str, Any]:
        """For a file of JSON."""
        return asdict(self) | {
            "faults": [asdict(fault) for fault in self.faults.values()],
            "functions": {str(code): count for code, count in sorted(self.functions.items())},
            "refused": {str(code): count for code, count in sorted(self.refused.items())},
        }


CATCH_UP_LIMIT = 1.0  # s; after a longer stall (suspend) the node goes on from now instead of sending a burst
LONGEST_NAP = 0.1  # s; how late a stop can be noticed


@dataclass(frozen=True, slots=True)
class Turn:
    """A tick whose moment has come."""

    index: int
    tick: PlantSample
    lived: float
    """When the machine was so, in s on this computer's monotonic clock; a delay of its bus does not change that."""
    due: float
    """When its bus carries it, on the same clock; the computer may be later."""
    effect: Effect


def refuse_unfit(scenario: Scenario, transport: str) -> None:
    """Refuse faults that cannot happen on ``transport``, instead of leaving them out.

    Raises:
        ConfigurationError: the scenario has such a fault.
    """
    for number, fault in enumerate(scenario.faults):
        if isinstance(fault, BusFault) and transport not in fault.ACTS_ON:
            fit = ", ".join(sorted(fault.ACTS_ON))
            raise ConfigurationError(
                f"faults[{number}]: a fault of kind {fault.kind!r} cannot happen on {transport}, only on {fit}"
            )


def in_real_time(
    scenario: Scenario, summary: Summary, stopped: Callable[[], bool], duration: float = math.inf
) -> Iterator[Turn]:
    """The ticks of ``scenario`` until ``stopped`` or for ``duration`` s, counted in ``summary``, in their order.

    One that its delay puts before another that has been sent comes at once.
    """
    interference = FaultInjector(scenario.faults, scenario.seed)
    start = latest = time.monotonic()
    for index, tick in enumerate(simulate(scenario)):
        effect = interference.at(tick.time)
        latest = max(latest, start + tick.time + effect.delay)
        if tick.time >= duration or not _wait_until(latest, stopped):
            return
        if (late := time.monotonic() - latest) > CATCH_UP_LIMIT:
            summary.stalls += 1
            start, latest = start + late, latest + late
        summary.note(effect, scenario.sample_period)
        yield Turn(index, tick, start + tick.time, latest, effect)


def _wait_until(moment: float, stopped: Callable[[], bool]) -> bool:
    """Whether the moment came before the stop."""
    while not stopped():
        if (left := moment - time.monotonic()) <= 0:
            return True
        time.sleep(min(left, LONGEST_NAP))
    return False


EVERY = 10  # ticks


class TruthFile:
    """Parameters and states without noise over Unix time ``t`` (s)."""

    def __init__(self, path: Path) -> None:
        """Begin the file.

        Raises:
            ServiceError: it cannot be written.
        """
        try:
            self._file = path.open("w", encoding="utf-8", newline="", buffering=1)
        except OSError as error:
            raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
        self._writer = csv.writer(self._file)

    def note(self, turn: Turn) -> None:
        """A line for every tenth tick, whatever the bus made of it."""
        if turn.index % EVERY:
            return
        if turn.index == 0:
            self._writer.writerow(["t", *turn.tick.truth])
        moment = time.time() - time.monotonic() + turn.lived
        self._writer.writerow([f"{moment:.4f}", *(f"{value:.9g}" for value in turn.tick.truth.values())])

    def close(self) -> None:
        """End the file."""
        self._file.close()


# Each class is built from a scenario and is a Node.
NODES = {
    CAN: ("otolith_drivers.plant.can_node", "CanNode"),
    MODBUS_TCP: ("otolith_drivers.plant.modbus_node", "TcpNode"),
    MODBUS_RTU: ("otolith_drivers.plant.modbus_node", "RtuNode"),
}


class Node(Protocol):
    """A simulated machine on its bus: built, run once, closed once."""

    def title(self) -> str:
        """Where it can be heard or asked, and what for."""

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> Summary:
        """Be the machine until ``stopped`` or for ``duration`` s.

        Raises:
            DeviceError: the bus went away.
        """

    def close(self) -> None:
        """Leave the bus."""

    def say(self, done: Summary) -> str:
        """What it has done, in a line."""


def open_node(transport: str, scenario: Scenario) -> Node:
    """The machine of ``scenario`` on ``transport``, a key of ``NODES``.

    Raises:
        ConfigurationError: the scenario does not fit the transport.
        DeviceError: the bus cannot be opened, or another node already uses it.
    """
    refuse_unfit(scenario, transport)
    module, name = NODES[transport]
    node: Node = getattr(import_module(module), name)(scenario)
    return node


def write_summary(path: Path, scenario: Scenario, transport: str, done: Summary) -> None:
    """As a file of JSON.

    Raises:
        ServiceError: it cannot be written.
    """
    document = {"plant": scenario.plant, "transport": transport, "seed": scenario.seed} | done.document()
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
