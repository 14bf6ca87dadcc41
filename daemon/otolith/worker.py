"""The worker process: adapts to the windows it is handed, one by one, and owns nothing that could be lost.

The daemon imports this module for its messages; only the worker loads the heart, with its compiler and its optimiser.
"""

import logging
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from otolith.acquisition.window import Window
from otolith.health.report import Report
from otolith.state import State

log = logging.getLogger(__name__)

REHEARSED = 80  # records


@dataclass(frozen=True, slots=True)
class Task:
    """A window to adapt to, from a state."""

    state: State
    window: Window


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a task; the state it began with and no report where the heart failed."""

    window_index: int
    state: State
    report: Report | None
    seconds: float
    failure: str = ""


def main(connection: Any, state: State) -> None:
    """Serve tasks until the connection closes or None comes."""
    _warm_up(state)
    while (task := connection.recv()) is not None:
        connection.send(perform(task))


def perform(task: Task) -> Result:
    """Adapt, timed; an exception in the heart costs this window and nothing else."""
    from otolith.heart import adapt  # noqa: PLC0415 - see the module's docstring

    begun = time.perf_counter()
    try:
        state, report = adapt(task.state, task.window)
    except Exception as error:
        log.exception("window %d", task.window.index)
        failure = f"{type(error).__name__}: {error}"
        return Result(task.window.index, task.state, None, time.perf_counter() - begun, failure)
    return Result(task.window.index, state, report, time.perf_counter() - begun)


def _warm_up(state: State) -> None:
    """Load and compile what the first window would have to wait for."""
    signals = state.problem.twin.signals
    values = np.random.default_rng(state.problem.seed).standard_normal((REHEARSED, len(signals)))  # nothing explains it
    window = Window.whole(0, 0.0, 0.01, signals, values)
    short = replace(state.problem, swarm=replace(state.problem.swarm, generations=2))
    perform(Task(replace(state, problem=short), window))
