"""Sensors that lie: channels that stand still or at their limit.

What a sensor says is held against the twin as it was known before; a lie must not teach.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.objective import Objective, quantum
from otolith.adaptation.problem import Problem

SHORTEST = 5  # records of the same value that are looked at
STUCK = 0.05  # share of records beyond which a channel is not believed
FAR = 6.0  # standard deviations that the twin must move, or be away, while the channel stands still


def stuck(problem: Problem, window: Window, parameters: Array) -> list[str]:
    """Which channels stand still while the twin, with ``parameters`` (free,), moves; a sentence for each."""
    found = []
    told: Array | None = None
    for index, entry in enumerate(problem.twin.outputs):
        values = window.column(entry.name)
        runs = [run for run in _runs(values) if not window.missing_in(entry.name)[run].any()]
        if sum(run.stop - run.start for run in runs) <= STUCK * window.records:
            continue
        if told is None:
            objective = Objective(replace(problem, open_loop=True), window, parameters)
            told = objective.simulate(objective.guess(parameters))
        far = FAR * problem.noise[index] + 2.0 * quantum(values)
        lies = [run for run in runs if _disagrees(told[run, index], float(values[run.start]), far)]
        if sum(run.stop - run.start for run in lies) > STUCK * window.records:
            beyond = np.concatenate([told[run, index] for run in lies]) - values[lies[0].start]
            found.append(_sentence(entry.name, entry.unit, values, lies[0], float(np.median(beyond))))
    return found


def _runs(values: Array) -> list[slice]:
    """Stretches of one and the same value."""
    same = np.concatenate([[False], np.diff(values) == 0.0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    runs = [slice(int(start), int(end) + 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run.stop - run.start >= SHORTEST]


def _disagrees(told: Array, value: float, far: float) -> bool:
    """Whether the twin moves while the channel does not, and is away from it at that."""
    if not np.isfinite(told).all():
        return False
    return bool(np.ptp(told) > far and np.abs(told - value).max() > far)


def _sentence(name: str, unit: str, values: Array, lie: slice, beyond: float) -> str:
    """``beyond`` is how far the twin is above the value at which the channel stands still."""
    value = float(values[lie.start])
    clipped = np.ptp(values) > 0.0 and (
        (value == values.max() and beyond > 0.0) or (value == values.min() and beyond < 0.0)
    )
    kind = "is clipped at" if clipped else "is frozen at"
    return f"{name} {kind} {value:.6g} {unit} while the twin moves on: look at the sensor"
