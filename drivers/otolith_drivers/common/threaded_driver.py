"""What drivers with a thread of their own share: its start, and its end within the second that the interface allows."""

import threading
from collections.abc import Callable
from typing import Any

CLOSE_TIMEOUT = 0.9  # s for the thread to end


class ThreadedDriver:
    """Base of a driver whose thread runs until ``_stop`` is set."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def _start(self, name: str, run: Callable[..., None], *arguments: Any) -> None:
        """Call ``run`` with the arguments in a thread of this name."""
        self._thread = threading.Thread(target=run, args=arguments, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(CLOSE_TIMEOUT)
