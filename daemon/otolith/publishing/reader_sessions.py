"""Sessions of a reader: one per endpoint, with what it subscribes, and queries to where a machine was heard."""

import contextlib
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import islice

import zenoh

from otolith.publishing.zenoh_config import Connection, is_own, local_sockets, reader_settings
from otolith.publishing.zenoh_session import ALIVE, MAX_REPLIES, Topic, close_session, session
from otolith_drivers.errors import ServiceError

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
QUERY_TIMEOUT = 5.0  # s
RETRY = 0.5  # s between two looks for endpoints that answer
MAX_CONNECTING = 32  # endpoints that are tried at the same time
COMMAND_TIMEOUT = 8.0  # s
MAX_HEARD = 1000  # machines of which the endpoint is kept


class NotCarriedOutError(Exception):
    """A command is not carried out, or nothing says whether it is; the message has the reason."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """What a machine published, or that its daemon runs or has ended."""

    key: str
    content: bytes | None  # None of a daemon
    is_alive: bool = True

    @property
    def machine(self) -> str:
        """The prefix of the keys of its machine."""
        return self.key.rpartition("/")[0]


class ReaderSessions:
    """Opens a session for each endpoint as soon as something answers there; it reconnects by itself.

    Without endpoints it opens all daemons of this computer that this user may read. A machine is asked where it was
    heard: with a socket per daemon, asking at each endpoint would need as many queries per machine as there are
    machines.
    """

    def __init__(
        self,
        connection: Connection,
        topics: Iterable[Topic],
        receive: Callable[[Arrival], None],
        machine: tuple[str, str] = ("*", "*"),
        limits: Mapping[str, int] | None = None,
    ) -> None:
        """Zenoh's threads call ``receive`` with what is published of topics, and as daemons begin and end.

        ``machine`` has the site and the name of one, or ``*``; ``limits`` are settings of Zenoh.

        Raises:
            ConfigurationError: a file of the credentials is missing or cannot be used.
        """
        self.endpoints = connection.endpoints
        self._settings = {**reader_settings(connection.credentials, connection.endpoints), **(limits or {})}
        self._keys, self._receive = [topic.under(*machine) for topic in topics], receive
        self._alive = ALIVE.under(*machine)
        self._opened: dict[str, zenoh.Session] = {}
        self._declared: dict[str, list[object]] = {}
        self._heard: dict[str, str] = {}  # Endpoint by the prefix of the keys of a machine
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._connect, name="open-endpoints", daemon=True)

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def close(self) -> None:
        """Close all sessions, which also ends their queries. One that is left open would keep the process alive."""
        self._stopping.set()
        self._close_all()
        if self._thread.is_alive():  # one that comes back from Zenoh while the interpreter ends would abort it
            self._thread.join(QUERY_TIMEOUT)
        self._close_all()

    @property
    def connected(self) -> bool:
        """Whether a daemon or a router is connected."""
        return any(each.info.peers_zid() or each.info.routers_zid() for each in tuple(self._opened.values()))

    @property
    def addresses(self) -> tuple[str, ...]:
        """Where it looks: the endpoints, or the sockets of daemons of this user."""
        return tuple(self.endpoints or filter(is_own, self._opened or local_sockets()))

    def where(self, machine: str) -> str:
        """Return the endpoint where a machine was heard, by the prefix of its keys; empty if it was not."""
        return self._heard.get(machine, "")

    def get(
        self,
        selector: str,
        limit: int = MAX_REPLIES,
        max_bytes: float = math.inf,
        refused: Callable[[], None] = lambda: None,
    ) -> list[tuple[str, bytes]]:
        """Return key and content of what answers a selector: at most ``limit``, and no more than ``max_bytes``.

        ``refused`` is called if a daemon refuses to answer.
        """
        heard = self._opened.get(self.where(selector.partition("?")[0].rpartition("/")[0]))
        for each in (heard,) if heard is not None else tuple(self._opened.values()):
            if found := list(islice(_answers(each, selector, max_bytes, refused), limit)):
                return found
        return []

    def command(self, key: str, content: bytes) -> bytes:
        """Send a command to where its machine was heard, and return the answer of the daemon.

        Raises:
            NotCarriedOutError: the daemon refuses it, or does not answer.
        """
        heard = self._opened.get(self.where(key.rpartition("/")[0]))
        refusal = ""
        if heard is not None:
            with contextlib.suppress(zenoh.ZError):  # the session was closed
                for reply in heard.get(key, payload=content, timeout=COMMAND_TIMEOUT):
                    if reply.ok is not None:
                        return reply.ok.payload.to_bytes()
                    refusal = refusal or (reply.err.payload.to_bytes() if reply.err else b"").decode(errors="replace")
        raise NotCarriedOutError(refusal)

    def _close_all(self) -> None:
        while self._opened:
            close_session(self._opened.popitem()[1])

    def _connect(self) -> None:
        with ThreadPoolExecutor(MAX_CONNECTING) as pool:
            while not self._stopping.is_set():
                missing = [each for each in self.endpoints or local_sockets() if each not in self._opened]
                tuple(pool.map(self._open, missing))
                self._stopping.wait(RETRY)

    def _open(self, endpoint: str) -> None:
        with contextlib.suppress(ServiceError, zenoh.ZError):  # nothing answers there, or the session was closed
            if not self._stopping.is_set():
                opened = self._opened[endpoint] = session((), [endpoint], self._settings, "client")
                take = partial(self._take, endpoint)
                declared = self._declared[endpoint] = [opened.declare_subscriber(key, take) for key in self._keys]
                take_alive = partial(self._take_alive, endpoint)
                declared.append(opened.liveliness().declare_subscriber(self._alive, take_alive, history=True))

    def _take(self, endpoint: str, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._hear(endpoint, arrival := Arrival(str(sample.key_expr), sample.payload.to_bytes()))
            self._receive(arrival)

    def _take_alive(self, endpoint: str, sample: zenoh.Sample) -> None:
        arrival = Arrival(str(sample.key_expr), None, is_alive=sample.kind == zenoh.SampleKind.PUT)
        if arrival.is_alive:
            self._hear(endpoint, arrival)
        self._receive(arrival)

    def _hear(self, endpoint: str, arrival: Arrival) -> None:
        if arrival.machine in self._heard or len(self._heard) < MAX_HEARD:
            self._heard[arrival.machine] = endpoint


def _answers(
    opened: zenoh.Session, selector: str, max_bytes: float, refused: Callable[[], None]
) -> Iterator[tuple[str, bytes]]:
    none, size = zenoh.ConsolidationMode.NONE, 0  # by default only the latest message of a key would be passed on
    with contextlib.suppress(zenoh.ZError):  # the session was closed
        for reply in opened.get(selector, timeout=QUERY_TIMEOUT, consolidation=none):
            if reply.ok is None:
                refused()
                continue
            content = reply.ok.payload.to_bytes()
            size += len(content)
            if size > max_bytes:
                return
            yield str(reply.ok.key_expr), content
