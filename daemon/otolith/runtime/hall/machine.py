"""One machine as it is monitored: its samples, its windows, its state and the numbers of its reports.

It asks no clock and owns no thread, file or socket: the service tells it the time, takes the slice of samples of a due
window from it, has it computed in a worker, and gives the result back. Times are monotonic seconds.
"""

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self

from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Verdict, Window
from otolith.acquisition.windower import RawWindow, Windower
from otolith.adaptation.fingerprints import kernels_fingerprint
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import AdaptationState, initial_state, with_sample_grid
from otolith.estimation.problem import WindowOptions
from otolith.health.labels import Numbers
from otolith.health.schema import Report
from otolith.machine import LoadedMachine
from otolith_drivers.base import Link

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
RING_WINDOWS = 8  # windows that the rings hold: how long the main thread may be delayed without loss of samples
RING_RATE = 4  # times the grid's rate at which a source may send for that to hold
MAX_WAIT = 0.1  # s; bounds the reaction time to a stop signal, a dead process and an outage
MIN_WAIT = 0.005  # s; bounds the CPU load while a window is overdue
MIN_PERIOD_CHANGE = 0.01  # share of the sample period by which the achieved period must differ for a new grid
MAX_WAITING_WINDOWS = 2  # of a machine, while workers are busy; older ones are missed
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
    state: PackedState  # Without its plan if that is the one of the state before
    report: Report | None
    seconds: float  # Computing time, s
    failure: str  # The exception, or an empty string
    text: str = ""  # JSON of the report


@dataclass(frozen=True, slots=True)
class FinishedWindow:
    """A window that was computed, with the states before and after it."""

    before: PackedState
    window: Window
    report: Report
    after: PackedState
    seconds: float  # Computing time, s
    text: str  # JSON of the report


class Machine:
    """The rings, the windows, the state and the numbers of one machine; at most one of its windows is computed."""

    def __init__(self, state: AdaptationState, rings: Rings, windower: Windower, longest: float) -> None:
        """``longest`` is the length of its longest window, s."""
        self.rings, self.windower, self.longest = rings, windower, longest
        self.packed = PackedState.of(state)
        """State after the last finished window."""
        self.kernels = kernels_fingerprint(state.problem)
        """The same for machines whose windows need the same kernels."""
        self.numbers = Numbers(0.0)
        self.windows = 0  # That were due
        self.missed = 0
        self.bad = 0  # Of bad quality
        self.finished = 0
        self.current: Task | None = None
        """The window that a worker computes."""
        self.is_slow = False
        """Whether its last window was computed for longer than it lasts."""
        self._waiting: deque[Task] = deque()
        self._changes: list[Callable[[AdaptationState], AdaptationState]] = []
        self._started_at = 0.0
        self._retried: int | None = None
        self._last_reason = ""

    @classmethod
    def of(cls, loaded: LoadedMachine) -> Self:
        """Return the machine of a file, of which nothing was learned yet."""
        identity, period = loaded.file.machine, loaded.file.window.sample_period
        plans, longest = loaded.plans(loaded.driver.sampling), loaded.problem.window.longest
        held = RING_WINDOWS * longest + math.ceil(max(plan.delay for plan in plans) / period)  # records
        return cls(
            initial_state(identity.name, identity.site, loaded.problem, loaded.plan),
            Rings(loaded.twin.signals, RING_RATE * held, loaded.observed),
            Windower(plans, loaded.records, period, loaded.limits),
            longest * period,
        )

    @property
    def state(self) -> AdaptationState:
        """State after the last finished window."""
        return self.packed.unpack()

    @state.setter
    def state(self, state: AdaptationState) -> None:
        self.packed = PackedState.of(state, self.packed)

    @property
    def is_waiting(self) -> bool:
        """Whether a window waits for a worker, and none is computed."""
        return self.current is None and bool(self._waiting)

    def begin(self, now: float) -> None:
        """Expect samples from ``now`` on."""
        self._started_at = now
        self.windower.records = self.packed.records

    def due_at(self, now: float) -> float:
        """Return when to ask for the next window: ``now`` if it is complete, or waits no longer for late samples."""
        if not self.windower.begin(self.rings, now, now - self._started_at):
            return now + MAX_WAIT
        if self.windower.due(self.rings, now):
            return now
        return max(now + MIN_WAIT, self.windower.next_end)

    def take(self, link: Link, offset: float, ahead: float) -> RawWindow:
        """Return the samples of the next window, which is due; the ``link`` tells how samples are late.

        ``offset`` and ``ahead`` as for :meth:`Windower.take`.
        """
        raw = self.windower.take(self.rings, offset, ahead)
        self.windower.latency = link.latency
        self.windows += 1
        return raw

    def submit(self, task: Task, behind: str) -> None:
        """Let a window wait for a worker; what waits for too long is missed, for the reason ``behind``."""
        self._waiting.append(task)
        while len(self._waiting) > MAX_WAITING_WINDOWS:
            self._miss(self._waiting.popleft(), behind)

    def dispatch(self) -> tuple[PackedState, Task]:
        """Return the window that waits for the longest time, and the state for it: a worker computes it now."""
        if self._changes:
            self.state, self._changes = self.next_state(), []
        self.current = self._waiting.popleft()
        return self.packed, self.current

    def accept(self, result: WorkerResult) -> FinishedWindow | None:
        """Go on with the result of a worker; None if it is that of a window which failed or was put back."""
        task = self.current
        if task is None or task.index != result.window_index:
            return None
        self.current = None
        self.is_slow = result.seconds > self.windower.length
        self.bad += result.window is not None and result.window.quality.verdict is Verdict.BAD
        if result.report is None or result.window is None:
            self._miss(task, result.failure)
            return None
        before, self.packed = self.packed, result.state.with_plan_of(self.packed)
        self.finished += 1
        self.windower.records = self.next_state().records if self._changes else self.packed.records
        return FinishedWindow(before, result.window, result.report, self.packed, result.seconds, result.text)

    def put_back(self) -> None:
        """Let the window of a worker that died wait again, once; then it is missed."""
        task, self.current = self.current, None
        if task is None:
            return
        self.is_slow = True
        if task.index == self._retried:
            self._miss(task, "its worker died twice")
        else:
            self._retried = task.index
            self._waiting.appendleft(task)

    def revise(self, change: Callable[[AdaptationState], AdaptationState]) -> None:
        """Apply ``change`` to the state before the next window is computed."""
        self._changes.append(change)

    def next_state(self) -> AdaptationState:
        """Return the state with all changes that wait."""
        state = self.state
        for change in self._changes:
            state = change(state)
        return state

    def adopt_period(self, period: float | None, options: WindowOptions, configured: float) -> None:
        """Use the sample ``period`` that a polled machine achieves, if it is known, for the following windows.

        ``options`` and ``configured`` (s) are those of its file.
        """
        current = self.windower.sample_period
        if period is None or abs(period / current - 1.0) < MIN_PERIOD_CHANGE:
            return
        self.revise(lambda state: with_sample_grid(state, options, period / configured))
        self.windower.regrid(self.next_state().records, period)
        change = f"the machine gives a sample every {period * 1e3:.4g} ms instead of every {current * 1e3:.4g} ms"
        size = f"{self.windower.records} records in {self.windower.length:.4g} s"
        log.warning("%s: windows now have %s", change, size)

    def _miss(self, task: Task, reason: str) -> None:
        self.missed += 1
        repeated = reason == NOT_READY == self._last_reason  # warn once about all windows missed during compilation
        self._last_reason = reason
        log.log(logging.DEBUG if repeated else logging.WARNING, "window %d missed: %s", task.index, reason)
