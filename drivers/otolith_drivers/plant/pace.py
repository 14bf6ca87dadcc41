"""A scenario in real time: each tick at its moment, with what the bus makes of it."""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.bus_faults import BusFault, Effect, Interference
from otolith_drivers.plant.plants import simulate
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.summary import Summary
from otolith_drivers.plant.tick import Tick

CATCH_UP_LIMIT = 1.0  # s; after a longer stall (suspend) the node goes on from now instead of sending a burst
LONGEST_NAP = 0.1  # s; how late a stop can be noticed


@dataclass(frozen=True, slots=True)
class Turn:
    """A tick whose moment has come."""

    index: int
    tick: Tick
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
    interference = Interference(scenario.faults, scenario.seed)
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
