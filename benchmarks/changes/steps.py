"""A step of 20 % of each estimated parameter of each twin of the library, alone.

From the third window after the step on, an interval must be published and hold the truth. A faulty sensor must not be
the most probable hypothesis, nor the decision.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.changes.classes import EQUAL
from benchmarks.changes.machines import LIBRARY_PLANTS
from benchmarks.changes.observe import Case, Observed, coverage
from benchmarks.changes.plants import Change
from otolith.discovery.alternatives import WindowDecision

FROM_WINDOW = 3  # after the step
SIZE = 0.2
HELD_AT_LEAST, SENSOR_AT_MOST = 0.95, 0.05


@dataclass(frozen=True, slots=True)
class Step:
    """A step of one parameter."""

    parameter: str
    factor: float
    case: Case


def steps(healthy: int, changed: int) -> list[Step]:
    """Return the steps of all machines."""
    made = []
    for plant in LIBRARY_PLANTS.values():
        for parameter in Case(plant.name, plant, Change()).problem.free:
            for factor in (1.0 - SIZE, 1.0 + SIZE):
                change = Change(parameters={parameter.name: factor * plant.parameters[parameter.name]})
                name = f"{plant.name}: {parameter.name} {factor - 1.0:+.0%}"
                made.append(Step(parameter.name, factor, Case(name, plant, change, healthy=healthy, changed=changed)))
    return made


def summarise(step: Step, runs: Sequence[Sequence[Observed]]) -> dict[str, Any]:
    """Return the figures of the runs of a step as a document."""
    after = [run[step.case.healthy :] for run in runs]
    late = [window for run in after for window in run[FROM_WINDOW - 1 :]]
    covered = {name: coverage([window.parameters[name] for window in late]) for name in late[0].parameters}
    own = covered[step.parameter]
    every = [window for run in after for window in run]
    sensor = sum(map(_is_sensor, every)) / len(every)
    moved = [window.parameters[step.parameter] for window in late]
    widths = sorted(each.high - each.low for each in moved if each.low is not None and each.high is not None)
    return {
        "case": step.case.name,
        "held": own.held,
        "others": {name: other.held for name, other in covered.items() if name != step.parameter},
        "half_width": 0.5 * widths[len(widths) // 2] / abs(moved[0].truth) if widths else None,
        "sensor": sensor,
        "statuses": dict(Counter(each.status for each in moved)),
        "decisions": [dict(Counter(run[number].decision.name for run in after)) for number in range(len(after[0]))],
        "published": own.published,
        "met": own.reaches(HELD_AT_LEAST) and sensor <= SENSOR_AT_MOST,
    }


def _is_sensor(window: Observed) -> bool:
    """Whether a sensor is the most probable hypothesis of the report; equal probabilities are a class.

    Hypotheses that parameters moved share the probability of their member of the class.
    """
    if window.decision is WindowDecision.SENSOR:
        return True
    moved = sum(item.probability for item in window.stated if item.reason == "PARAMETER")
    rivals = [item.probability for item in window.stated if item.reason not in ("PARAMETER", "SENSOR")]
    best = max((item.probability for item in window.stated if item.reason == "SENSOR"), default=0.0)
    return best > max(moved, *rivals, 0.0) + EQUAL
