"""Two threads in every order: what one of them does happens between any two bytecodes of the other."""

import random
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

KEPT_BACK = 0.05  # s after which a step that has not returned counts as kept back by a lock


class _OtherThread:
    """Does any of its steps, each time when it is told to."""

    def __init__(self, steps: tuple[Callable[[], object], ...], seed: int) -> None:
        self._steps, self._random = steps, random.Random(seed)  # noqa: S311 - an order, not a secret
        self._told, self._done = threading.Semaphore(0), threading.Event()
        self._done.set()
        self._stop = False
        self.taken = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while self._told.acquire() and not self._stop:
            self._random.choice(self._steps)()
            self.taken += 1
            self._done.set()

    def step(self) -> None:
        """Do the next step, unless the one before waits for a lock that this thread holds."""
        if self._done.is_set():
            self._done.clear()
            self._told.release()
            self._done.wait(KEPT_BACK)

    def end(self) -> None:
        self._done.wait()
        self._stop = True
        self._told.release()
        self._thread.join()


@contextmanager
def interleaved(package: str, steps: tuple[Callable[[], object], ...], seed: int) -> Iterator[_OtherThread]:
    """Before every bytecode of ``package`` in this block, another thread does one of ``steps``."""
    other = _OtherThread(steps, seed)

    def trace(frame: FrameType, event: str, _: Any) -> Any:
        if package not in frame.f_code.co_filename:
            return None
        frame.f_trace_opcodes = True
        if event == "opcode":
            other.step()
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        yield other
    finally:
        sys.settrace(before)
        other.end()
