"""Worker processes of this computer for a batch of replays; one that ends is started again."""

import time
from typing import Any

from otolith import kernel_cache
from otolith.runtime.batch.task import TASK_TIMEOUT, ReplayOutcome, ReplayTask, perform_task
from otolith.runtime.process import ChildProcess, wait_for
from otolith_drivers.errors import OtolithError

POLL = 0.2  # s between two looks at the workers, if none of them answers; the reaction time to a signal
GONE = f"its worker has ended: it died, or computed a part for {TASK_TIMEOUT:g} s"


def main(connection: Any) -> None:
    """Serve in the worker process: receive tasks and send outcomes, until None comes."""
    has_compiled = False

    def note(step: kernel_cache.CompileStep) -> None:
        nonlocal has_compiled
        has_compiled = has_compiled or step.compiled

    with kernel_cache.observed(note):
        while (task := connection.recv()) is not None:
            connection.send(answer(task))
            if has_compiled:
                kernel_cache.release_compiler()
                has_compiled = False


def answer(task: ReplayTask) -> ReplayOutcome | str:
    """Return the outcome of a task, or why there is none."""
    try:
        return perform_task(task)
    except (OtolithError, OSError) as error:
        return str(error)


class LocalWorkers:
    """Worker processes of this computer."""

    def __init__(self, count: int) -> None:
        names = (f"otolith-replay-{number}" for number in range(1, count + 1))
        self._workers = [ChildProcess(name, f"{__name__}:main", room=1) for name in names]
        self._computed: dict[int, str] = {}  # Key of the task of each worker, by its number
        for worker in self._workers:
            worker.start()

    @property
    def room(self) -> int:
        """Number of tasks that can be submitted now."""
        return sum(worker.alive and number not in self._computed for number, worker in enumerate(self._workers))

    def submit(self, key: str, task: ReplayTask) -> None:
        """Let a free worker compute a task."""
        number = next(n for n, worker in enumerate(self._workers) if worker.alive and n not in self._computed)
        self._computed[number] = key
        self._workers[number].offer(task)

    def finished(self) -> list[tuple[str, ReplayOutcome | None, str]]:
        """Wait for a moment, and return what was finished: key, outcome, and why there is none."""
        waitables = [waitable for worker in self._workers for waitable in worker.waitables]
        if waitables:
            wait_for(waitables, POLL)
        else:
            time.sleep(POLL)
        done = list[tuple[str, ReplayOutcome | None, str]]()
        for number, worker in enumerate(self._workers):
            for reply in worker.replies():
                worker.reset_backoff()
                key = self._computed.pop(number)
                done.append((key, reply, "") if isinstance(reply, ReplayOutcome) else (key, None, reply))
            if not worker.alive:
                if (lost := self._computed.pop(number, None)) is not None:
                    done.append((lost, None, GONE))
                if worker.may_restart(time.monotonic()):
                    worker.start()
        return done

    def close(self) -> None:
        """End all workers."""
        for worker in self._workers:
            worker.kill()
