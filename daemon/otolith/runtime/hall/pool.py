"""The pool of worker processes that compute the windows of all machines. Times are monotonic seconds.

Any worker takes the window of any machine, and each machine has one window at a time in a worker. A worker is
stateless, so if it ends, at most that window is lost. The window is tried once more; if the worker ends again, or if it
takes too long, it is counted as missed.

Windows that may take long leave at least one of several workers to the others: those of a machine whose last one did,
and those whose kernels no worker has used yet, which may have to be compiled, or hang. Of kernels that take long, each
has its turn: while others wait for theirs, a worker is killed early, and has more time the next time.
"""

import logging
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from otolith import kernel_cache
from otolith.runtime.effort import Effort
from otolith.runtime.hall.machine import NOT_READY, FinishedWindow, Machine, Task, WorkerResult
from otolith.runtime.process import ChildProcess
from otolith.runtime.worker import WARM_UP_KERNELS, Ready

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
WINDOW_TIMEOUT = 20.0  # s of effort for a window, in addition to twice its length
COMPILE_TIMEOUT = 600.0  # s in addition, from one kernel to the next: while the worker starts or compiles a kernel
TURN = 60.0  # s of effort for a kernel while others wait for their turn; twice as much after each failure
STALL_TIMEOUT = 30.0  # s of effort without a finished window, and three window lengths; then no watchdog is fed
BEHIND = "the worker is behind"


class Computed(NamedTuple):
    """A finished window and its machine."""

    machine: Machine
    finished: FinishedWindow


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


class Worker:
    """One worker process of the pool, and the machine whose window it computes."""

    def __init__(self, name: str) -> None:
        self.process = ChildProcess(name, "otolith.runtime.worker:main", room=1)
        self.machine: Machine | None = None
        self.kernels = ""  # Those that it compiles or loads at its start; then those of its window
        self.is_ready = False
        self.is_compiling = True  # Whether it starts, or compiles or loads a kernel
        self.prepared: list[bool] = []  # Of each kernel that it has had since its start, whether it was compiled
        self.stall = Effort()  # since the pool made progress
        self._effort = Effort()  # of the current window, or of a kernel

    @property
    def is_free(self) -> bool:
        """Whether it can take a window."""
        return self.machine is None and self.process.alive

    def start(self, machine: Machine) -> None:
        """Start the process, which compiles or loads the kernels of a machine."""
        self.is_compiling, self.is_ready, self.prepared = True, False, []
        self.kernels = machine.kernels
        self.process.start(machine.packed)

    def take(self, machine: Machine, now: float) -> None:
        """Compute the next window of a machine."""
        self.machine = machine
        self.kernels = machine.kernels if self.is_ready else self.kernels
        self.process.offer(machine.dispatch())
        self.begin(now)

    def begin(self, now: float) -> None:
        """Allow time from ``now`` on."""
        self._effort.begin(now, self.process.processor_time)

    def leave(self) -> Machine | None:
        """Return the machine whose window it no longer computes, if there is one."""
        machine, self.machine = self.machine, None
        return machine

    def allowed_seconds(self, longest: float) -> float:
        """Return for how long it may compute a window of a machine whose longest is of ``longest`` s."""
        return WINDOW_TIMEOUT + 2 * longest + (COMPILE_TIMEOUT if self.is_compiling else 0.0)

    def exceeds(self, now: float, seconds: float) -> bool:
        """Whether it has started or computed, or waited for something else than its turn, for longer than that."""
        if self.machine is None and self.is_ready:
            return False
        return self._effort.seconds(now, self.process.processor_time) > seconds

    def has_stalled(self, now: float, longest: float) -> bool:
        """Whether its effort since the pool made progress is too long."""
        patience = STALL_TIMEOUT + 3 * longest + (COMPILE_TIMEOUT if self.is_compiling else 0.0)
        return self.stall.seconds(now, self.process.processor_time) > patience


class Pool:
    """Computes the windows of machines in worker processes."""

    def __init__(self, machines: Sequence[Machine], count: int = 1) -> None:
        """``count`` is the number of processes."""
        self._machines = tuple(machines)
        names = (f"otolith-worker{f'-{number}' if count > 1 else ''}" for number in range(1, count + 1))
        self.workers = [Worker(name) for name in names]
        self._queue: deque[Machine] = deque()  # With a window that waits, in the order of their turns
        self._known: set[str] = set()  # Kernels that a worker has used
        self._failures: Counter[str] = Counter()  # Of kernels: workers that ended while they may have compiled them
        self._started: Counter[object] = Counter()  # Workers that began with these kernels, and with this machine
        self.progress = 0
        """Finished windows and compiled kernels."""
        self._seen = 0  # Progress at the last look of the watchdog

    @property
    def restarts(self) -> int:
        """Number of restarts of workers."""
        return sum(max(0, worker.process.starts - 1) for worker in self.workers)

    @property
    def preparation(self) -> Preparation | None:
        """What the workers do of which none is ready for a window yet; None if one is."""
        if any(worker.is_ready for worker in self.workers):
            return None
        prepared = max((worker.prepared for worker in self.workers), key=len)
        return Preparation(len(prepared), max(WARM_UP_KERNELS, len(prepared)), any(prepared))

    @property
    def waitables(self) -> list[Any]:
        """Arguments for :func:`otolith.runtime.process.wait_for`: ready on a reply, and when a process has died."""
        return [waitable for worker in self.workers for waitable in worker.process.waitables]

    def start(self, now: float) -> None:
        """Start the workers."""
        for worker in self.workers:
            self._start(worker)
            worker.begin(now)
            worker.stall.begin(now, worker.process.processor_time)

    def add(self, machine: Machine, now: float, most: int) -> None:
        """Compute the windows of a further machine, with another worker unless there are ``most``."""
        self._machines = (*self._machines, machine)
        if len(self.workers) < min(most, len(self._machines)):
            self.workers.append(Worker(f"otolith-worker-{len(self.workers) + 1}"))
            self._start(self.workers[-1])
            self.workers[-1].begin(now)
            self.workers[-1].stall.begin(now, self.workers[-1].process.processor_time)

    def leave_out(self, machine: Machine) -> None:
        """Compute no further window of a machine."""
        self._machines = tuple(own for own in self._machines if own is not machine)
        del self._started[machine]
        if machine in self._queue:
            self._queue.remove(machine)

    def submit(self, machine: Machine, task: Task, now: float) -> None:
        """Compute a window of a machine as soon as a worker is free."""
        machine.submit(task, NOT_READY if self.preparation else BEHIND)
        self._enqueue(machine)
        self._dispatch(now)

    def poll(self, now: float) -> list[Computed]:
        """Return the windows that were finished; restart workers that died or hang."""
        finished = [item for worker in self.workers for item in self._replies(worker, now)]
        for worker in self.workers:
            if not worker.process.alive:
                self._fail(worker)
                self._put_back(worker)
                if self._machines and worker.process.may_restart(now):
                    self._start(worker)
                    worker.begin(now)
            elif worker.exceeds(now, seconds := self._allowed_seconds(worker)):
                task = None if worker.machine is None else worker.machine.current
                what = (
                    "the worker has not started" if task is None else f"the worker has not finished window {task.index}"
                )
                log.warning("%s in %.0f s of processor time and waiting, and is killed", what, seconds)
                self._fail(worker)
                self._put_back(worker)
                worker.process.kill()
        self._dispatch(now)
        return finished

    def is_stalled(self, now: float) -> bool:
        """Whether no window, good or bad, is being finished, and no kernel compiled."""
        if self.progress != self._seen:
            self._seen = self.progress
            for worker in self.workers:
                worker.stall.begin(now, worker.process.processor_time)
        longest = max((machine.windower.length for machine in self._machines), default=0.0)
        stalled = [worker.has_stalled(now, longest) for worker in self.workers]  # each counts its effort
        return all(stalled)

    def kill(self) -> None:
        """End all workers."""
        for worker in self.workers:
            worker.process.kill()

    def _replies(self, worker: Worker, now: float) -> Iterator[Computed]:
        for reply in worker.process.replies():
            if not isinstance(reply, WorkerResult):
                self._note(worker, reply, now)
            elif (machine := worker.machine) is not None and machine.current is not None:
                if machine.current.index != reply.window_index:
                    continue
                worker.leave()
                worker.is_compiling = False  # a kernel that raised an exception has no end
                self._succeed(worker)
                worker.process.reset_backoff()
                finished = machine.accept(reply)
                self._enqueue(machine)
                if finished is not None:
                    self.progress += 1
                    yield Computed(machine, finished)

    def _note(self, worker: Worker, step: kernel_cache.CompileStep | Ready, now: float) -> None:
        """Allow time from this step on. Loading a kernel is no progress: a worker that always dies loads some, too."""
        if isinstance(step, Ready):
            worker.is_ready = True
            self._succeed(worker)
            worker.kernels = worker.kernels if worker.machine is None else worker.machine.kernels
        elif step.is_end:
            worker.prepared += [step.compiled] if step.is_kernel and not worker.is_ready else []
            self.progress += step.compiled
            number = None if worker.is_ready else self.preparation
            count = f", {number.done} of {number.total}" if step.is_kernel and number is not None else ""
            log.log(logging.INFO if step.compiled else logging.DEBUG, "compiled %s%s", step.kernel, count)
        worker.is_compiling = not worker.is_ready or not (isinstance(step, Ready) or step.is_end)
        worker.begin(now)

    def _put_back(self, worker: Worker) -> None:
        if (machine := worker.leave()) is not None:
            machine.put_back()
            self._enqueue(machine)

    def _enqueue(self, machine: Machine) -> None:
        if machine.is_waiting and machine in self._machines and machine not in self._queue:
            self._queue.append(machine)

    def _start(self, worker: Worker) -> None:
        """Start a worker: with kernels that have failed least, that are known, and with which fewest have begun."""

        def preference(machine: Machine) -> tuple[object, ...]:
            kernels, started = machine.kernels, self._started
            return self._failures[kernels], kernels not in self._known, started[kernels], started[machine]

        machine = min(self._machines, key=preference)
        self._started.update((machine.kernels, machine))
        worker.start(machine)

    def _succeed(self, worker: Worker) -> None:
        self._known.add(worker.kernels)
        del self._failures[worker.kernels]

    def _fail(self, worker: Worker) -> None:
        """Note that a worker has ended, if it may have been by the kernels that it compiled."""
        if worker.is_compiling and worker.kernels:
            self._failures[worker.kernels] += 1
            worker.kernels = ""

    def _allowed_seconds(self, worker: Worker) -> float:
        """Return for how long a worker may go on: less while kernels of others wait for theirs to be compiled."""
        allowed = worker.allowed_seconds(0.0 if worker.machine is None else worker.machine.longest)
        if not (worker.is_compiling and worker.kernels):
            return allowed
        others = [*self._queue] if worker.machine is None else [*self._queue, worker.machine]
        waiting = [machine for machine in others if machine.kernels != worker.kernels]
        if len(self.workers) > 1:
            waiting = [machine for machine in waiting if self._may_take_long(machine)]
        return min(allowed, TURN * 2.0 ** self._failures[worker.kernels]) if waiting else allowed

    def _may_take_long(self, machine: Machine) -> bool:
        return machine.is_slow or machine.kernels not in self._known

    def _is_long(self, worker: Worker) -> bool:
        """Whether a worker may not be free soon; one that starts with known kernels is."""
        if not (worker.is_ready and worker.process.alive):
            return worker.kernels not in self._known
        return worker.is_compiling or (worker.machine is not None and self._may_take_long(worker.machine))

    def _dispatch(self, now: float) -> None:
        """Give windows to workers; while one is ready, none waits for one that starts and may compile for minutes."""
        ready = [worker for worker in self.workers if worker.is_ready and worker.process.alive]
        for worker in ready or self.workers:
            if worker.is_free and (machine := self._next(worker)) is not None:
                worker.take(machine, now)

    def _next(self, worker: Worker) -> Machine | None:
        """Return the machine whose turn it is; what may take long leaves one of several workers to the others."""
        others = [other for other in self.workers if other is not worker]
        may_take_long = not others or not all(map(self._is_long, others))
        for machine in self._queue:
            if may_take_long or not self._may_take_long(machine):
                self._queue.remove(machine)
                return machine
        return None
