"""Reading a file ahead of its use, so that a long stretch of it holds nothing up."""

import contextlib
import queue
import threading
from collections.abc import Iterator

from otolith_drivers.logs.rows import Rows

AHEAD = 2  # stretches
POLL = 0.1  # s; how late an end can be noticed


def read_ahead(stretches: Iterator[Rows], stop: threading.Event) -> Iterator[Rows]:
    """``stretches``, read in a thread of its own until ``stop`` is set; what it raises is raised here."""
    ready: queue.Queue[Rows | Exception | None] = queue.Queue(AHEAD)
    ended = threading.Event()
    thread = threading.Thread(target=_read, args=(stretches, ready, ended), name="replay-read", daemon=True)
    thread.start()
    try:
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                entry = ready.get(timeout=POLL)
                if isinstance(entry, Exception):
                    raise entry
                if entry is None:
                    return
                yield entry
    finally:
        ended.set()
        thread.join(timeout=1.0)


def _read(stretches: Iterator[Rows], ready: "queue.Queue[Rows | Exception | None]", ended: threading.Event) -> None:
    def give(entry: Rows | Exception | None) -> bool:
        while not ended.is_set():
            with contextlib.suppress(queue.Full):
                ready.put(entry, timeout=POLL)
                return True
        return False

    try:
        for rows in stretches:
            if not give(rows):
                return
        give(None)
    except Exception as error:  # noqa: BLE001 - it is raised again where the rows are used
        give(error)
