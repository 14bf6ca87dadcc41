"""A step of 20 % of each estimated parameter of each twin of the library, alone.

The published interval must hold the truth from the third window after the step on, and a faulty sensor must not be the
most probable hypothesis, nor the decision.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from benchmarks.changes.machines import LIBRARY_PLANTS
from benchmarks.changes.observe import Case, Observed, Published
from benchmarks.changes.plants import Change
from otolith.discovery.decision import WindowDecision

FROM_WINDOW = 3  # after the step
SIZE = 0.2
HELD_AT_LEAST, SENSOR_AT_MOST = 0.95, 0.05


@dataclass(frozen=True, slots=True)
class Step:
    """A step of one parameter."""

    parameter: str
    factor: float
    case: Case


def steps(healthy: int, changed: int, names: Sequence[str] = ()) -> list[Step]:
    """Return the steps of the machines of those names, or of all."""
    made = []
    for plant in LIBRARY_PLANTS.values():
        if names and plant.name not in names:
            continue
        for parameter in Case(plant.name, plant, Change()).problem.free:
            for factor in (1.0 - SIZE, 1.0 + SIZE):
                change = Change(parameters={parameter.name: factor * plant.parameters[parameter.name]})
                name = f"{plant.name}: {parameter.name} {factor - 1.0:+.0%}"
                made.append(Step(parameter.name, factor, Case(name, plant, change, healthy=healthy, changed=changed)))
    return made


def with_noise(step: Step, noise: float) -> Step:
    """Return the step with another noise of the sensors than that of the machine file."""
    return replace(step, case=replace(step.case, noise=noise))


def summarise(step: Step, runs: Sequence[Sequence[Observed]]) -> dict[str, Any]:
    """Return the figures of the runs of a step as a document."""
    after = [run[step.case.healthy :] for run in runs]
    late = [window for run in after for window in run[FROM_WINDOW - 1 :]]
    held = {name: _held([window.parameters[name] for window in late]) for name in late[0].parameters}
    every = [window for run in after for window in run]
    sensor = sum(map(_is_sensor, every)) / len(every)
    moved = [window.parameters[step.parameter] for window in late]
    widths = sorted(own.high - own.low for own in moved if own.low is not None and own.high is not None)
    return {
        "case": step.case.name,
        "held": held[step.parameter],
        "others": {name: share for name, share in held.items() if name != step.parameter},
        "half_width": 0.5 * widths[len(widths) // 2] / abs(moved[0].truth) if widths else None,
        "sensor": sensor,
        "statuses": dict(Counter(own.status for own in moved)),
        "decisions": [dict(Counter(run[number].decision.name for run in after)) for number in range(len(after[0]))],
        "published": len(widths) / len(late),
        "met": held[step.parameter] >= HELD_AT_LEAST and sensor <= SENSOR_AT_MOST,
    }


def _held(published: Sequence[Published]) -> float:
    """Return the share of the published intervals that hold the truth; one without any."""
    held = [own.holds_truth for own in published if own.holds_truth is not None]
    return sum(held) / len(held) if held else 1.0


def _is_sensor(window: Observed) -> bool:
    """Whether the report blames a sensor before anything else; equal probabilities are a class."""
    if window.decision is WindowDecision.SENSOR:
        return True
    rivals = [item.probability for item in window.stated if item.reason != "SENSOR"]
    best = max((item.probability for item in window.stated if item.reason == "SENSOR"), default=0.0)
    return best > max(rivals, default=0.0) + 0.01
