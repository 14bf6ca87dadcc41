"""The worker process, which cuts one window at a time and adapts to it, and its supervisor in the daemon.

The worker is stateless: it receives state and samples, and returns window, next state and report. The state of record
stays with the supervisor, so if a worker ends, at most the current window is lost. That window is tried once more; if
its worker ends again, or if it takes too long, it is counted as missed.

The daemon imports this module too, so what is large is imported only in the functions that run in the worker: the
adaptation core with its compiler and optimiser, and SciPy, which bridges inputs.
"""

import contextlib
import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from otolith import kernel_cache
from otolith.acquisition.window import Verdict, Window
from otolith.acquisition.windower import RawWindow
from otolith.adaptation.state import AdaptationState, with_problem
from otolith.health.schema import Report
from otolith.health.status import absent_sources
from otolith.runtime.effort import Effort
from otolith.runtime.process import ChildProcess
from otolith_drivers.base import Link

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
WARM_UP_RECORDS = 40  # of the random window that makes a new worker compile every kernel
MAX_WAITING_WINDOWS = 2  # for a busy worker; older ones are missed
WINDOW_TIMEOUT = 20.0  # s of effort for a window, in addition to twice its length
COMPILE_TIMEOUT = 600.0  # s in addition, from one kernel to the next: while the worker starts or compiles a kernel
WARM_UP_KERNELS = 11  # that a new worker compiles or loads
NOT_READY = "the worker is starting; if the twin is new on this computer, it compiles kernels, which takes minutes"


@dataclass(frozen=True, slots=True)
class Task:
    """A window that is not cut yet, and what the daemon knew at its end."""

    raw: RawWindow
    link: Link = field(default_factory=lambda: Link(up=True))  # Of the machine
    outages: Mapping[str, str] = field(default_factory=dict)  # See Window

    @property
    def index(self) -> int:
        """Number of the window."""
        return self.raw.index


@dataclass(frozen=True, slots=True)
class WorkerResult:
    """The next state and the report of a window; after a failure the unchanged state and no report."""

    window_index: int
    window: Window | None  # None if it could not be cut
    state: AdaptationState
    report: Report | None
    seconds: float  # Computing time, s
    failure: str  # The exception, or an empty string


class Ready(NamedTuple):
    """The worker has started: sent once, before the first result."""


def main(connection: Any, state: AdaptationState) -> None:
    """Serve in the worker process: receive (state, task) and send a result, until None comes.

    Each step of a kernel is sent as well, and :class:`Ready` once.
    """
    has_compiled = False

    def report(step: kernel_cache.CompileStep) -> None:
        nonlocal has_compiled
        has_compiled = True
        with contextlib.suppress(OSError):  # the daemon has died, which the next result notices
            connection.send(step)

    with kernel_cache.observed(report):
        warm_up(state)
        connection.send(Ready())
        while (task := connection.recv()) is not None:
            connection.send(answer(*task))
            if has_compiled:
                kernel_cache.release_compiler()
                has_compiled = False


def answer(state: AdaptationState, task: Task) -> WorkerResult:
    """Cut the window of a task and adapt to it; samples that cannot be cut cost this window only."""
    from otolith.acquisition.cutting import cut  # noqa: PLC0415 - see the module's docstring

    try:
        window = cut(task.raw).window
        absent = absent_sources(task.link, window, {output.name for output in state.problem.twin.outputs})
    except Exception as error:
        log.exception("window %d", task.index)
        return WorkerResult(task.index, None, state, None, 0.0, f"{type(error).__name__}: {error}")
    return perform(state, replace(window, absent=absent, outages=task.outages))


def perform(state: AdaptationState, window: Window) -> WorkerResult:
    """Adapt to a window; an exception costs this window only."""
    from otolith.adaptation.adapt import adapt  # noqa: PLC0415 - see the module's docstring

    begun = time.perf_counter()
    report, failure = None, ""
    try:
        state, report = adapt(state, window)
    except Exception as error:  # any fault of the core: reported with the window, and the state stays as it was
        log.exception("window %d", window.index)
        failure = f"{type(error).__name__}: {error}"
    return WorkerResult(window.index, window, state, report, time.perf_counter() - begun, failure)


def warm_up(state: AdaptationState) -> str:
    """Import and compile what the first window needs: no twin explains random values, so discovery runs as well.

    Returns the reason of a failure, or an empty string.
    """
    signals = state.problem.twin.signals
    values = np.random.default_rng(state.problem.seed).standard_normal((WARM_UP_RECORDS, len(signals)))
    window = Window.whole(0, 0.0, 0.01, signals, values)
    short = replace(state.problem, swarm=replace(state.problem.swarm, generations=2))
    return perform(with_problem(state, short), window).failure


@dataclass(frozen=True, slots=True)
class Preparation:
    """How far a worker that starts has come."""

    done: int  # Kernels that are compiled or loaded
    total: int
    is_compiled: bool  # Whether one of them was compiled, and not loaded

    @property
    def text(self) -> str:
        """The same in words."""
        return f"the daemon {'compiles' if self.is_compiled else 'loads'} kernels: {self.done} of {self.total}"


class Supervisor:
    """Runs the worker process and keeps the adaptation state. Times are monotonic seconds, given by the caller."""

    def __init__(self, state: AdaptationState, length: float, keep: Callable[..., None] = lambda *_: None) -> None:
        """``length`` is that of the longest window, s; ``keep`` takes state, window, report and next state of each."""
        self._keep = keep
        self.state = state  # State after the last finished window
        self.missed = 0
        self.bad = 0  # Windows of bad quality
        self.finished = 0
        self.progress = 0  # Finished windows and compiled kernels
        self.is_compiling = True  # Whether the worker starts, or compiles or loads a kernel
        self._prepared: list[bool] = []  # Of each kernel that a new worker has had, whether it was compiled
        self._is_ready = False
        self._changes: list[Callable[[AdaptationState], AdaptationState]] = []
        self._timeout = WINDOW_TIMEOUT + 2 * length
        self.worker = ChildProcess("otolith-worker", "otolith.runtime.worker:main", room=1)
        self._effort = Effort()  # of the current window, or of a kernel
        self._waiting: deque[Task] = deque()
        self._current: Task | None = None
        self._retried: int | None = None
        self._last_reason = ""

    @property
    def records(self) -> int:
        """Records of the next window."""
        return self._next_state().records

    @property
    def restarts(self) -> int:
        """Number of restarts of the worker."""
        return max(0, self.worker.starts - 1)

    @property
    def preparation(self) -> Preparation | None:
        """What a worker does that is not ready for a window yet; None if it is."""
        if self._is_ready:
            return None
        total = max(WARM_UP_KERNELS, len(self._prepared))
        return Preparation(len(self._prepared), total, any(self._prepared))

    @property
    def _allowed_seconds(self) -> float:
        return self._timeout + (COMPILE_TIMEOUT if self.is_compiling else 0.0)

    def revise(self, change: Callable[[AdaptationState], AdaptationState]) -> None:
        """Apply ``change`` to the state before the next window is dispatched."""
        self._changes.append(change)

    def start(self) -> None:
        """Start the worker."""
        self.is_compiling, self._is_ready, self._prepared = True, False, []
        self.worker.start(self.state)

    def submit(self, window: Task, now: float) -> None:
        """Queue a window, and dispatch it if the worker is free."""
        self._waiting.append(window)
        while len(self._waiting) > MAX_WAITING_WINDOWS:
            self._miss(self._waiting.popleft(), "the worker is behind" if self._is_ready else NOT_READY)
        self._dispatch(now)

    def poll(self, now: float) -> list[tuple[Report, float]]:
        """Return finished reports with their computing times in s; restart a worker that died or hangs."""
        reports = []
        for reply in self.worker.replies():
            if not isinstance(reply, WorkerResult):
                self._note(reply, now)
            elif (report := self._take(reply)) is not None:
                reports.append(report)
        if not self.worker.alive:
            self._requeue()
            if self.worker.may_restart(now):
                self.start()
        elif self._current is not None and self._hangs(now):
            what = f"the worker has not finished window {self._current.index}"
            log.warning("%s in %.0f s of processor time and waiting, and is killed", what, self._allowed_seconds)
            self._requeue()
            self.worker.kill()
        self._dispatch(now)
        return reports

    def _hangs(self, now: float) -> bool:
        """Whether the worker has computed, or waited for something else than its turn, for longer than allowed."""
        return self._effort.seconds(now, self.worker.processor_time) > self._allowed_seconds

    def _note(self, step: kernel_cache.CompileStep | Ready, now: float) -> None:
        """Allow time from this step on. Loading a kernel is no progress: a worker that always dies loads some, too."""
        if isinstance(step, Ready):
            self._is_ready = True
        elif step.is_end:
            self._prepared += [step.compiled] if step.is_kernel and not self._is_ready else []
            self.progress += step.compiled
            number = self.preparation
            count = f", {number.done} of {number.total}" if step.is_kernel and number is not None else ""
            log.log(logging.INFO if step.compiled else logging.DEBUG, "compiled %s%s", step.kernel, count)
        self.is_compiling = not self._is_ready or not (isinstance(step, Ready) or step.is_end)
        self._effort.begin(now, self.worker.processor_time)

    def _take(self, result: WorkerResult) -> tuple[Report, float] | None:
        window = self._current
        if window is None or window.index != result.window_index:  # the window was requeued meanwhile
            return None
        self._current, self.is_compiling = None, False  # a kernel that raised an exception has no end
        self.worker.reset_backoff()
        self.bad += result.window is not None and result.window.quality.verdict is Verdict.BAD
        if result.report is None:
            self._miss(window, result.failure)
            return None
        self._keep(self.state, result.window, result.report, result.state)
        self.state = result.state
        self.finished += 1
        self.progress += 1
        return result.report, result.seconds

    def _requeue(self) -> None:
        """Put the current window back for the next worker, or count it as missed if it was put back before."""
        window, self._current = self._current, None
        if window is None:
            return
        if window.index == self._retried:
            self._miss(window, "its worker died twice")
        else:
            self._retried = window.index
            self._waiting.appendleft(window)

    def _dispatch(self, now: float) -> None:
        if self._current is not None or not self._waiting or not self.worker.alive:
            return
        self.state, self._changes = self._next_state(), []
        self._current = self._waiting.popleft()
        self.worker.offer((self.state, self._current))
        self._effort.begin(now, self.worker.processor_time)

    def _next_state(self) -> AdaptationState:
        """Return the state with all pending changes."""
        state = self.state
        for change in self._changes:
            state = change(state)
        return state

    def _miss(self, window: Task, reason: str) -> None:
        self.missed += 1
        repeated = reason == NOT_READY == self._last_reason  # warn once about all windows missed during compilation
        self._last_reason = reason
        log.log(logging.DEBUG if repeated else logging.WARNING, "window %d missed: %s", window.index, reason)
