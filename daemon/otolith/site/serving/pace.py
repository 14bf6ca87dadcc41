"""What is made once for all who ask, and how often pages are made at all."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Generic, TypeVar

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
PAGE_PAUSE = 0.002  # s from the begin of a page to that of the next one

Made = TypeVar("Made")


class Fresh(Generic[Made]):
    """What is made in another thread when somebody asks for it, and given to all who ask until it is too old."""

    def __init__(self, make: Callable[[], Made], max_age: float, pool: Executor) -> None:
        """``max_age`` is in s from when it was begun to be made."""
        self._make, self._max_age, self._pool = make, max_age, pool
        self._task: asyncio.Task[Made] | None = None
        self._begun = 0.0

    async def get(self) -> Made:
        """Return it; wait while it is being made."""
        loop = asyncio.get_running_loop()
        is_old = loop.time() - self._begun > self._max_age
        if self._task is None or (self._task.done() and (is_old or self._task.exception() is not None)):
            self._begun, self._task = loop.time(), loop.create_task(self._made())
        return await asyncio.shield(self._task)  # who leaves does not end it for the others

    async def _made(self) -> Made:
        return await asyncio.get_running_loop().run_in_executor(self._pool, self._make)


class Turns:
    """Lets one page after the other begin, so that what is asked for between them, as metrics, is answered at once."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()  # of which those who wait come in their order
        self._next = 0.0

    async def take(self) -> None:
        """Wait for a turn."""
        async with self._lock:
            loop = asyncio.get_running_loop()
            if (pause := self._next - loop.time()) > 0.0:
                await asyncio.sleep(pause)
            self._next = loop.time() + PAGE_PAUSE
