"""What the main thread does not wait for: reading files, closing drivers and writing what is left of a machine."""

import logging
import queue
import threading
from collections import deque
from collections.abc import Callable

log = logging.getLogger(__name__)

Then = Callable[[], None]
"""What the main thread does once a job is done."""


class Background:
    """Does one job after the other in a thread; the main thread takes what follows from each."""

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue[Callable[[], Then | None] | None] = queue.SimpleQueue()
        self._done: deque[Then] = deque()
        self._thread = threading.Thread(target=self._run, name="take-over", daemon=True)

    def do(self, job: Callable[[], Then | None]) -> None:
        """Do a job after those that wait; it returns what the main thread is to do then."""
        self._jobs.put(job)
        if self._thread.ident is None:
            self._thread.start()

    def finish(self) -> None:
        """Do in the main thread what follows from the jobs that are done."""
        while self._done:
            self._done.popleft()()

    def stop(self, seconds: float) -> None:
        """End after the jobs that wait, or after ``seconds``: what is left of a machine is written until then."""
        if self._thread.ident is not None:
            self._jobs.put(None)
            self._thread.join(seconds)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                then = job()
            except Exception:  # no job ends the others
                log.exception("a machine was not taken over")
            else:
                self._done += [] if then is None else [then]
