"""What a Modbus device has: which registers can be read, what is in them over some seconds, how fast it answers."""

import contextlib
import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus_failures import EXCEPTIONS, GATEWAY_CODES, Refused, Silent
from otolith_drivers.modbus_options import MOST_REGISTERS
from otolith_drivers.probe_line import Asker, Stopped, Told

MOST_READINGS = 1000  # kept of each register
SHORTEST_PERIOD = 0.01  # s from round to round: quick enough to see noise, slow enough to be a polite guest
RATES = (1000, 500, 200, 100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1)  # Hz that people ask for
CHUNK = MOST_REGISTERS - 1  # an even number
MOST_SPANS = 8  # that are named in a line
FULL = 0.9  # share of a period that requests may take
Words = NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class Block:
    """Registers that can be read at once."""

    address: int
    count: int

    @property
    def end(self) -> int:
        """The first address behind it."""
        return self.address + self.count


@dataclass(slots=True)
class Survey:
    """Which registers there are."""

    blocks: list[Block] = field(default_factory=list)
    refused: dict[int, str] = field(default_factory=dict)
    """Why, by address."""
    most: int = MOST_REGISTERS
    """Registers that the device gives at once, as far as it was tried."""

    def describe(self, first_address: int = 0) -> list[str]:
        """In words, a line each, with the registers as the machine file counts them."""
        readable = [at + first_address for block in self.blocks for at in range(block.address, block.end)]
        lines = [f"{spans(readable)} can be read"] if readable else []
        by_reason = [
            (reason, [at + first_address for at, why in self.refused.items() if why == reason])
            for reason in dict.fromkeys(self.refused.values())
        ]
        return lines + [f"{spans(addresses)} refused: {reason}" for reason, addresses in by_reason]


def survey(asker: Asker, first: int, last: int, stopped: Stopped, told: Told) -> Survey:
    """Find out which of the registers ``first`` to ``last`` can be read; what is refused is split, down to one.

    Raises:
        DeviceError: the device does not answer at all.
    """
    found = Survey()
    waiting = [Block(at, min(CHUNK, last + 1 - at)) for at in range(first, last + 1, CHUNK)]
    while waiting and not stopped():
        block = waiting.pop(0)
        told(f"looking which registers there are: {block.address} to {block.end - 1}")
        reason = _reason_against(asker, block)
        if reason is None:
            found.blocks.append(block)
        elif block.count == 1:
            found.refused[block.address] = reason
        else:
            waiting[:0] = _halves(block)
    return _joined(asker, found, stopped)


def _reason_against(asker: Asker, block: Block) -> str | None:
    """Why ``block`` cannot be read; None if it can.

    Raises:
        DeviceError: the device is not there.
    """
    try:
        asker.read(block.address, block.count)
    except Refused as error:
        if error.code in GATEWAY_CODES:
            raise DeviceError(f"{asker.options.title()} is a gateway that says of device {asker.device}: {error}; "
                              "--scan lists the devices that answer") from error  # fmt: skip
        return EXCEPTIONS.get(error.code, str(error))
    except Silent as error:
        if not asker.alive:
            _say_dead_unless_one_answers(asker, block)
        return str(error)
    return None


def _say_dead_unless_one_answers(asker: Asker, block: Block) -> None:
    """Some devices keep silent where they should refuse, so a single register is asked for before they are given up."""
    try:
        asker.read(block.address, 1)
    except Refused:
        return
    except Silent as error:
        options = asker.options
        way_out = (
            "--scan lists the devices that answer"
            if options.host is not None
            else "are baud rate, parity and stop bits those of the device, and the two wires not swapped? "
            "--scan lists the devices that answer"
        )
        raise DeviceError(f"{options.title()}: device {asker.device}: {error}; {way_out}") from error


def _halves(block: Block) -> list[Block]:
    """Cut at an even distance, so that numbers of two registers stay whole as long as possible."""
    half = max(1, block.count // 4 * 2)
    return [Block(block.address, half), Block(block.address + half, block.count - half)]


def _joined(asker: Asker, found: Survey, stopped: Stopped) -> Survey:
    """Neighbours in one request where the device allows it; where not, that is the most it gives at once."""
    joined: list[Block] = []
    for block in found.blocks:
        before = joined[-1] if joined else None
        both = Block(before.address, block.end - before.address) if before and before.end == block.address else None
        if both is None or both.count > CHUNK or stopped():
            joined.append(block)
        elif _reason_against(asker, both) is None:
            joined[-1] = both
        else:
            found.most = min(found.most, max(before.count if before else 1, block.count))
            joined.append(block)
    return Survey(joined, found.refused, found.most)


def spans(addresses: Sequence[int], noun: str = "register") -> str:
    """``"registers 0 to 19 and 100"``."""
    ordered = sorted(addresses)
    starts = [at for index, at in enumerate(ordered) if index == 0 or ordered[index - 1] != at - 1]
    ends = [at for index, at in enumerate(ordered) if index == len(ordered) - 1 or ordered[index + 1] != at + 1]
    words = [f"{first} to {last}" if last > first else f"{first}" for first, last in zip(starts, ends, strict=True)]
    shown = words if len(words) <= MOST_SPANS else [*words[: MOST_SPANS - 1], f"{len(words) - MOST_SPANS + 1} more"]
    text = " and ".join(filter(None, [", ".join(shown[:-1]), shown[-1]]))
    return f"{noun}{'s' * (len(ordered) > 1)} {text}"


def watch(asker: Asker, blocks: Sequence[Block], seconds: float, stopped: Stopped, told: Told) -> dict[Block, Words]:
    """Readings (rounds by registers) of every block, again and again for so many seconds; at least one round."""
    readings: dict[Block, list[list[int]]] = {block: [] for block in blocks}
    period = max(SHORTEST_PERIOD, seconds / MOST_READINGS)
    begun = time.monotonic()
    round_due = begun
    while blocks and (round_due == begun or (time.monotonic() - begun < seconds and not stopped())):
        told(f"reading for {max(0.0, seconds - time.monotonic() + begun):.0f} s more")
        for block in blocks:
            with contextlib.suppress(Refused, Silent):  # what it has refused now, it gave before
                readings[block].append(asker.read(block.address, block.count))
        now = time.monotonic()
        round_due = max(round_due + period, now)
        time.sleep(max(0.0, min(round_due, begun + seconds) - now))
    return {block: np.array(rows, dtype=np.uint16).reshape(-1, block.count) for block, rows in readings.items()}


@dataclass(frozen=True, slots=True)
class Speed:
    """How fast requests of one length are answered."""

    registers: int
    median: float
    slow: float
    """s that 99 of 100 do not exceed."""

    @classmethod
    def of(cls, registers: int, trips: Sequence[float]) -> "Speed":
        """From the times of all round trips (s)."""
        ordered = sorted(trips)
        slow = ordered[min(len(ordered) - 1, math.ceil(0.99 * len(ordered)) - 1)]
        return cls(registers, statistics.median(ordered), slow)

    def describe(self) -> str:
        """In words."""
        return (
            f"{self.registers} register{'s' * (self.registers > 1)} in one request: {1e3 * self.median:.3g} ms, "
            f"99 of 100 within {1e3 * self.slow:.3g} ms"
        )


def speeds(asker: Asker, blocks: Sequence[Block]) -> list[Speed]:
    """Of the requests that the blocks take, in their order."""
    return [Speed.of(block.count, trips) for block in blocks if (trips := list(asker.round_trips.get(block.count, ())))]


def possible_rate(found: Sequence[Speed]) -> float:
    """Hz at which all these requests fit into a period, as people would ask for it; 0 where none does."""
    whole = sum(speed.slow for speed in found)
    return next((rate for rate in RATES if whole <= FULL / rate), 0.0)
