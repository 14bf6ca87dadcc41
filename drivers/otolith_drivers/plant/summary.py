"""What a node has done, counted exactly: what it sent, what it was asked, and what its faults withheld."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from otolith_drivers.plant.bus_faults import BusFault, Effect


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
