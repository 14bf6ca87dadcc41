"""Reads the daemons of a site over Zenoh, and gives what they publish to :class:`Knowledge`.

One session per endpoint. Zenoh's threads only append to a bounded queue; what does not fit is counted, and the history
of the machine is queried. A daemon that is new here is asked for its latest report and the events of the last week.
"""

import contextlib
import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Self

import zenoh

from otolith.publishing.zenoh_config import MAX_MESSAGE_BYTES, Connection, local_sockets, reader_settings
from otolith.publishing.zenoh_session import ALIVE, EVENT, MAX_REPLIES, REPORT, close_session, session
from otolith.site.known import MAX_MACHINES, Knowledge
from otolith_drivers.errors import ServiceError

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_WAITING = 4000  # documents
MAX_QUERIES = 8  # at a time
QUERY_TIMEOUT = 5.0  # s
MAX_ANSWER_BYTES = 8 << 20  # of the documents of one query
RETRY = 1.0  # s between two looks for daemons
PAST = "-7d"  # of the events that are asked for
MAX_CONNECTING = 32  # endpoints that are tried at the same time


@dataclass(frozen=True, slots=True)
class _Arrival:
    """A document, or that a daemon runs or has ended."""

    key: str
    content: bytes | None  # None of a daemon
    is_alive: bool = True
    is_past: bool = False  # Whether it is an answer to a query


class Collector:
    """Runs in threads of its own; ``knowledge`` is read while ``lock`` is held."""

    def __init__(self, connection: Connection) -> None:
        """Read the endpoints, or without any all daemons of this computer that this user may read.

        Raises:
            ConfigurationError: a file of the credentials is missing or cannot be used.
        """
        self.knowledge, self.lock, self.changed = Knowledge(), threading.Lock(), 0
        self.dropped: Counter[str] = Counter()
        self._endpoints = connection.endpoints
        limits = {"transport/link/rx/max_message_size": MAX_MESSAGE_BYTES}
        self._settings = {**reader_settings(connection.credentials, connection.endpoints), **limits}
        self._waiting: queue.Queue[_Arrival] = queue.Queue(MAX_WAITING)
        self._stopping, self._asking = threading.Event(), threading.Lock()
        self._asked: set[str] = set()  # Machines that are being asked
        self._behind: set[str] = set()  # Machines of which something was dropped
        self._sessions: dict[str, zenoh.Session] = {}
        self._declared: dict[str, tuple[object, ...]] = {}
        self._queries = ThreadPoolExecutor(MAX_QUERIES, thread_name_prefix="ask-daemon")
        self._threads = [threading.Thread(target=run, name=name, daemon=True)
                         for name, run in (("open-endpoints", self._connect), ("collect", self._run))]  # fmt: skip

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._close_sessions()
        for thread in self._threads:
            thread.join(QUERY_TIMEOUT)
        self._queries.shutdown(cancel_futures=True)
        self._close_sessions()

    @property
    def connected(self) -> bool:
        """Whether a daemon or a router is connected."""
        return any(each.info.peers_zid() or each.info.routers_zid() for each in tuple(self._sessions.values()))

    def ask(self, selector: str, limit: int = MAX_REPLIES) -> list[bytes]:
        """Return what daemons answer to a query: at most ``limit`` documents, none that is too large."""
        return [content for _, content in self._ask(selector, limit)]

    def _ask(self, selector: str, limit: int) -> list[tuple[str, bytes]]:
        for each in tuple(self._sessions.values()):
            found: list[tuple[str, bytes]] = []
            with contextlib.suppress(zenoh.ZError):  # the session was closed
                found = list(_answers(each, selector, limit))
            if found:
                return found
        return []

    def _close_sessions(self) -> None:
        while self._sessions:
            close_session(self._sessions.popitem()[1])

    def _connect(self) -> None:
        """Open a session for each endpoint, as soon as something answers there; it reconnects by itself."""
        with ThreadPoolExecutor(MAX_CONNECTING) as pool:
            while not self._stopping.is_set():
                missing = [each for each in self._endpoints or local_sockets() if each not in self._sessions]
                tuple(pool.map(self._open, missing))
                self._stopping.wait(RETRY)

    def _open(self, endpoint: str) -> None:
        with contextlib.suppress(ServiceError, zenoh.ZError):  # nothing answers there, or the session was closed
            if not self._stopping.is_set():
                opened = session((), [endpoint], self._settings, "client")
                self._sessions[endpoint] = opened
                keys = (REPORT.under("*", "*"), EVENT.under("*", "*"))
                alive = opened.liveliness().declare_subscriber(ALIVE.under("*", "*"), self._receive_alive, history=True)
                self._declared[endpoint] = (alive, *(opened.declare_subscriber(key, self._receive) for key in keys))

    def _receive(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._put(_Arrival(str(sample.key_expr), sample.payload.to_bytes()))

    def _receive_alive(self, sample: zenoh.Sample) -> None:
        self._put(_Arrival(str(sample.key_expr), None, is_alive=sample.kind == zenoh.SampleKind.PUT))

    def _put(self, arrival: _Arrival) -> None:
        try:
            self._waiting.put_nowait(arrival)
        except queue.Full:
            self.dropped["queue"] += 1
            if len(self._behind) < MAX_MACHINES:
                self._behind.add(arrival.key.rpartition("/")[0])

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                arrival = self._waiting.get(timeout=RETRY)
            except queue.Empty:
                while self._behind:
                    self._look_back(self._behind.pop())
                continue
            try:
                self._take(arrival)
            except Exception:  # no document ends the thread
                log.exception("%s: not taken", arrival.key)

    def _take(self, arrival: _Arrival) -> None:
        machine, _, topic = arrival.key.rpartition("/")
        now = time.time()
        with self.lock:
            if arrival.content is None:
                self.knowledge.take_alive(arrival.key, is_alive=arrival.is_alive)
            else:
                self.knowledge.take(arrival.key, arrival.content, now, is_past=arrival.is_past)
            self.changed += 1
        if topic == ALIVE.key and arrival.is_alive:
            self._look_back(machine)

    def _look_back(self, machine: str) -> None:
        """Ask a daemon for its latest report and its last events, unless it is being asked."""
        with self._asking:
            if machine in self._asked or len(self._asked) > MAX_MACHINES or self._stopping.is_set():
                return
            self._asked.add(machine)
        with contextlib.suppress(RuntimeError):  # it is shutting down
            self._queries.submit(self._query, machine)

    def _query(self, machine: str) -> None:
        try:
            for key, content in self._ask(f"{machine}/{EVENT.key}?_time=[now({PAST})..now()]", MAX_REPLIES):
                self._waiting.put(_Arrival(key, content, is_past=True), timeout=QUERY_TIMEOUT)
            for key, content in self._ask(f"{machine}/{REPORT.key}", 1):
                self._waiting.put(_Arrival(key, content, is_past=True), timeout=QUERY_TIMEOUT)
        except queue.Full:
            self.dropped["queue"] += 1
        finally:
            with self._asking:
                self._asked.discard(machine)


def _answers(opened: zenoh.Session, selector: str, limit: int) -> Iterator[tuple[str, bytes]]:
    """Yield key and content of the answers to a query, up to ``limit`` and to :data:`MAX_ANSWER_BYTES`."""
    none, size = zenoh.ConsolidationMode.NONE, 0
    replies = opened.get(selector, timeout=QUERY_TIMEOUT, consolidation=none)
    for count, reply in enumerate(replies):
        if reply.ok is None:
            continue
        content = reply.ok.payload.to_bytes()
        size += len(content)
        if count >= limit or size > MAX_ANSWER_BYTES:
            return
        yield str(reply.ok.key_expr), content
