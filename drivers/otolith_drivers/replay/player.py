"""One thread that plays every recording of this process, and a few that read ahead for it.

A recording is an iterator that does what is due and yields when to go on (s, monotonic). A hall replays hundreds of
them: a thread for each would spend more on waking up than on delivering.
"""

import heapq
import itertools
import logging
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

log = logging.getLogger(__name__)

# Engineering choices: docs/reference/thresholds-replay.md.
READERS = 2  # threads that read chunks of files: one that waits for a disk leaves the other
IDLE = 1.0  # s for which the thread stays when nothing is played

Playing = Iterator[float]
"""Does what is due at each step and yields when the next one is, s, monotonic."""

reading = ThreadPoolExecutor(READERS, "replay-read")


class Played:
    """A recording that is played."""

    def __init__(self, steps: Playing) -> None:
        self.steps = steps
        self.ended = threading.Event()
        self.is_hastened = False  # since its last step was begun


class _Player:
    """Steps each recording when it asks to be; its thread ends when there is nothing to play."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._due: list[tuple[float, int, Played]] = []
        self.playing = 0
        """Number of recordings that are played."""
        self._numbers = itertools.count()
        self._thread: threading.Thread | None = None

    def play(self, steps: Playing) -> Played:
        """Step the iterator from now on, until it ends."""
        played = Played(steps)
        with self._changed:
            self.playing += 1
            heapq.heappush(self._due, (time.monotonic(), next(self._numbers), played))
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="replay", daemon=True)
                self._thread.start()
            self._changed.notify()
        return played

    def hasten(self, played: Played) -> None:
        """Step a recording at once: something has changed for it."""
        with self._changed:
            played.is_hastened = True
            self._due = [(0.0 if row[2] is played else row[0], *row[1:]) for row in self._due]
            heapq.heapify(self._due)
            self._changed.notify()

    def _run(self) -> None:
        while (played := self._next()) is not None:
            try:
                due = next(played.steps, None)
            except Exception:
                log.exception("a recording is no longer played")
                due = None
            if due is None:
                with self._changed:
                    self.playing -= 1
                played.ended.set()
                continue
            with self._changed:
                due = 0.0 if played.is_hastened else due
                heapq.heappush(self._due, (due, next(self._numbers), played))

    def _next(self) -> Played | None:
        """Wait for the recording that is due next; None if there is none any more, and the thread shall end."""
        with self._changed:
            while True:
                if not self._due:
                    if self._changed.wait(IDLE) or self._due:
                        continue
                    self._thread = None
                    return None
                wait = self._due[0][0] - time.monotonic()
                if wait <= 0.0:
                    played = heapq.heappop(self._due)[2]
                    played.is_hastened = False
                    return played
                self._changed.wait(wait)


player = _Player()
