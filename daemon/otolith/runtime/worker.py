"""The worker process: adapts to the windows it is handed, one by one, and owns nothing that could be lost.

The daemon imports this module for its messages; only the worker loads the heart, with its compiler and its optimiser.

Hands windows to the worker process one at a time, and keeps its promise that the worker may die at any moment.

A window whose worker died is tried once more; a second death, or a window that waits too long, is counted as missed.
The adaptation state stays on this side of the pipe, so that a death loses no more than the window at hand.
"""

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from otolith.acquisition.window import Window
from otolith.adaptation.state import AdaptationState, with_problem
from otolith.health.schema import Report
from otolith.runtime.process import ChildProcess

log = logging.getLogger(__name__)

REHEARSED = 80  # records


@dataclass(frozen=True, slots=True)
class Task:
    """A window to adapt to, from a state."""

    state: AdaptationState
    window: Window


@dataclass(frozen=True, slots=True)
class Result:
    """What came of a task; the state it began with and no report where the heart failed."""

    window_index: int
    state: AdaptationState
    report: Report | None
    seconds: float
    failure: str = ""


def main(connection: Any, state: AdaptationState) -> None:
    """Serve tasks until the connection closes or None comes."""
    _warm_up(state)
    while (task := connection.recv()) is not None:
        connection.send(perform(task))


def perform(task: Task) -> Result:
    """Adapt, timed; an exception in the heart costs this window and nothing else."""
    from otolith.adaptation.adapt import adapt  # noqa: PLC0415 - see the module's docstring

    begun = time.perf_counter()
    try:
        state, report = adapt(task.state, task.window)
    except Exception as error:
        log.exception("window %d", task.window.index)
        failure = f"{type(error).__name__}: {error}"
        return Result(task.window.index, task.state, None, time.perf_counter() - begun, failure)
    return Result(task.window.index, state, report, time.perf_counter() - begun)


def _warm_up(state: AdaptationState) -> None:
    """Load and compile what the first window would have to wait for."""
    signals = state.problem.twin.signals
    values = np.random.default_rng(state.problem.seed).standard_normal((REHEARSED, len(signals)))  # nothing explains it
    window = Window.whole(0, 0.0, 0.01, signals, values)
    short = replace(state.problem, swarm=replace(state.problem.swarm, generations=2))
    perform(Task(with_problem(state, short), window))


ROOM = 2  # windows that wait for a busy worker; older ones are missed
PATIENCE = 20.0  # s for a window beyond twice its length
COMPILING = 120.0  # s more for the first one: a twin that this computer has never run is compiled before
NOT_READY = (
    "the worker is not ready: it starts, and compiles a twin that is new to this computer, which takes a minute or two"
)


class Supervisor:
    """Times are seconds on the monotonic clock, given by the caller."""

    def __init__(self, state: AdaptationState, window_length: float) -> None:
        self.missed = 0
        self.finished = 0
        self._state = state
        self._changes: list[Callable[[AdaptationState], AdaptationState]] = []
        self._patience = PATIENCE + 2 * window_length
        self._companion = ChildProcess("otolith-worker", "otolith.runtime.worker:main", room=1)
        self._waiting: deque[Window] = deque()
        self._at_hand: Window | None = None
        self._retried: int | None = None
        self._deadline = 0.0
        self._missed_why = ""

    @property
    def records(self) -> int:
        """How many the next window should have."""
        state = self._state
        for change in self._changes:
            state = change(state)
        return state.records

    @property
    def restarts(self) -> int:
        """How often the worker had to be started again."""
        return max(0, self._companion.starts - 1)

    @property
    def waitables(self) -> list[Any]:
        """See :attr:`otolith.runtime.process.Companion.waitables`."""
        return self._companion.waitables

    @property
    def state(self) -> AdaptationState:
        """After the last window that was finished."""
        return self._state

    @property
    def _allowed(self) -> float:
        """S that the window at hand may take."""
        return self._patience + (0.0 if self.finished else COMPILING)

    def revise(self, change: Callable[[AdaptationState], AdaptationState]) -> None:
        """Change the state before the next window, whatever becomes of the one at hand."""
        self._changes.append(change)

    def start(self) -> None:
        """Start the worker."""
        self._companion.start(self._state)

    def stop(self) -> None:
        """End the worker at once; nobody will read what it has at hand."""
        self._companion.kill()

    def submit(self, window: Window, now: float) -> None:
        """Queue a window, and hand it on if the worker is free."""
        self._waiting.append(window)
        while len(self._waiting) > ROOM:
            self._miss(self._waiting.popleft(), "the worker is behind" if self.finished else NOT_READY)
        self._hand_on(now)

    def poll(self, now: float) -> list[tuple[Report, float]]:
        """Reports that are finished, each with the seconds of computing; restarts what has died."""
        reports = [report for result in self._companion.replies() if (report := self._take(result)) is not None]
        if not self._companion.alive:
            self._take_back("died")
            if self._companion.may_start_again(now):
                self.start()
        elif self._at_hand is not None and now > self._deadline:
            self._take_back(f"has not finished window {self._at_hand.index} in {self._allowed:.0f} s")
            self._companion.kill()
        self._hand_on(now)
        return reports

    def _take(self, result: Result) -> tuple[Report, float] | None:
        window = self._at_hand
        if window is None or window.index != result.window_index:  # it was taken back, and is answered by another
            return None
        self._at_hand = None
        self._companion.has_thrived()
        if result.report is None:
            self._miss(window, result.failure)
            return None
        self._state = result.state
        self.finished += 1
        return result.report, result.seconds

    def _take_back(self, why: str) -> None:
        """The window at hand waits for the next worker, unless it has already cost one."""
        window, self._at_hand = self._at_hand, None
        if window is None:
            return
        log.warning("the worker %s; it is started again", why)
        if window.index == self._retried:
            self._miss(window, "its worker died twice")
        else:
            self._retried = window.index
            self._waiting.appendleft(window)

    def _hand_on(self, now: float) -> None:
        if self._at_hand is not None or not self._waiting or not self._companion.alive:
            return
        while self._changes:
            self._state = self._changes.pop(0)(self._state)
        self._at_hand = self._waiting.popleft()
        self._companion.offer(Task(self._state, self._at_hand))
        self._deadline = now + self._allowed

    def _miss(self, window: Window, why: str) -> None:
        self.missed += 1
        level = logging.DEBUG if why == NOT_READY == self._missed_why else logging.WARNING  # once is enough
        self._missed_why = why
        log.log(level, "window %d missed: %s", window.index, why)
