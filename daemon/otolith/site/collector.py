"""Reads the daemons of a site over Zenoh, and gives what they publish to :class:`Knowledge`.

Zenoh's threads only append to a bounded queue; what does not fit is counted, and the daemon is asked. A daemon that is
new here is asked for its latest report and the events of the last week.
"""

import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Self

from otolith.publishing.reader_sessions import QUERY_TIMEOUT, Arrival, ReaderSessions
from otolith.publishing.zenoh_config import MAX_MESSAGE_BYTES, Connection
from otolith.publishing.zenoh_session import EVENT, MAX_REPLIES, REPORT, prefix
from otolith.site.known import MAX_MACHINES, Knowledge
from otolith.site.serving.counts import Counts

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_WAITING = 4000  # documents
MAX_QUERIES = 8  # at a time
MAX_ANSWER_BYTES = 8 << 20  # of the documents of one query
PAUSE = 1.0  # s between two looks whether daemons can be asked for what was dropped
PAST_CHANGES = 500  # changes of events that are asked for, the last ones
PAST = "-7d"  # of the events that are asked for


class Collector:
    """Runs in threads of its own; ``knowledge`` is read while ``lock`` is held."""

    def __init__(self, connection: Connection, expected: Iterable[str] = ()) -> None:
        """Read the endpoints, or without any all daemons of this computer that this user may read.

        ``expected`` is that of :class:`Knowledge`.

        Raises:
            ConfigurationError: a file of the credentials is missing or cannot be used.
        """
        self.certificate = connection.credentials.certificate  # Of the site
        self.knowledge, self.lock = Knowledge(expected), threading.Lock()
        self.dropped: Counter[str] = Counter()
        self.hindered: Counts = Counter()  # Of those who read the site
        limits = {"transport/link/rx/max_message_size": MAX_MESSAGE_BYTES}
        self._sessions = ReaderSessions(connection, (REPORT,), self._put, limits=limits)
        self._waiting: queue.Queue[tuple[Arrival, bool]] = queue.Queue(MAX_WAITING)  # And whether it is of the past
        self._stopping, self._asking = threading.Event(), threading.Lock()
        self._asked: set[str] = set()  # Machines that are being asked
        self._behind: set[str] = set()  # Machines of which something was dropped
        self._queries = ThreadPoolExecutor(MAX_QUERIES, thread_name_prefix="ask-daemon")
        self._thread = threading.Thread(target=self._run, name="collect", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._sessions.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._sessions.close()
        self._thread.join(QUERY_TIMEOUT)
        self._queries.shutdown(cancel_futures=True)

    @property
    def connected(self) -> bool:
        """Whether a daemon or a router is connected."""
        return self._sessions.connected

    def where(self, site: str, machine: str) -> str:
        """Return the endpoint of the daemon of a machine, or of its router; empty if it was not heard yet."""
        return self._sessions.where(prefix(site, machine))

    def ask(self, selector: str, limit: int, refused: Callable[[], None]) -> list[bytes]:
        """Return what daemons answer to a query: at most ``limit`` documents, and no more than a few megabytes."""
        return [content for _, content in self._sessions.get(selector, limit, MAX_ANSWER_BYTES, refused)]

    def command(self, key: str, content: bytes) -> bytes:
        """Send a signed command to a daemon, and return its answer; raise NotCarriedOutError if there is none."""
        return self._sessions.command(key, content)

    def _put(self, arrival: Arrival) -> None:
        try:
            self._waiting.put_nowait((arrival, False))
        except queue.Full:
            self.dropped["queue"] += 1
            if len(self._behind) < MAX_MACHINES:
                self._behind.add(arrival.machine)

    def _run(self) -> None:
        due = 0.0
        while not self._stopping.is_set():
            if self._behind and time.monotonic() >= due:
                due = time.monotonic() + PAUSE
                self._look_back_if_there_is_room()
            try:
                arrival, is_past = self._waiting.get(timeout=PAUSE)
            except queue.Empty:
                continue
            try:
                self._take(arrival, is_past=is_past)
            except Exception:  # no document ends the thread
                log.exception("%s: not taken", arrival.key)

    def _take(self, arrival: Arrival, *, is_past: bool) -> None:
        now, answered = time.monotonic(), time.time() if is_past else None
        with self.lock:
            if arrival.content is None:
                machine = self.knowledge.take_alive(arrival.key, now, is_alive=arrival.is_alive)
            else:
                machine = self.knowledge.take(arrival.key, arrival.content, now, answered=answered)
            if machine is None or (machine.is_asked and arrival.content is not None) or not arrival.is_alive:
                return
            machine.is_asked = True
        self._look_back(arrival.machine)

    def _look_back_if_there_is_room(self) -> None:
        """Ask daemons for what was dropped, unless the answers would be dropped, too."""
        while self._behind and self._waiting.qsize() < MAX_WAITING // 2:
            self._look_back(self._behind.pop())

    def _look_back(self, machine: str) -> None:
        """Ask a daemon for its latest report and its last events, unless it is being asked."""
        with self._asking:
            if machine in self._asked or len(self._asked) > MAX_MACHINES or self._stopping.is_set():
                return
            self._asked.add(machine)
        with contextlib.suppress(RuntimeError):  # it is shutting down
            self._queries.submit(self._query, machine)

    def _query(self, machine: str) -> None:
        changes = f"{machine}/{EVENT.key}?_time=[now({PAST})..now()];last={PAST_CHANGES}"
        selectors = {changes: MAX_REPLIES, f"{machine}/{REPORT.key}": 1}
        try:
            for selector, limit in selectors.items():
                for key, content in self._sessions.get(selector, limit, MAX_ANSWER_BYTES):
                    self._waiting.put((Arrival(key, content), True), timeout=QUERY_TIMEOUT)
        except queue.Full:
            self.dropped["queue"] += 1
        finally:
            with self._asking:
                self._asked.discard(machine)
