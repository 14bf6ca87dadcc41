"""Runs the site: uvicorn on one address, with bounds on connections, and on what waits for those who read slowly."""

import asyncio
import signal
import socket
import ssl
import sys
from asyncio import sslproto
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from otolith.publishing.zenoh_config import raise_descriptor_limit
from otolith.site.access.orders import Orders
from otolith.site.access.users import Loop, SiteAccess, user_of
from otolith.site.app import SitePages
from otolith.site.collector import Collector
from otolith.site.outlets.runner import OutletRunner
from otolith.site.outlets.table import running
from otolith.site.serving.counts import Counts, Hindered
from otolith.site.settings import SiteFile
from otolith_drivers.errors import ServiceError

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_CONNECTIONS = 2000
PATIENCE = 10.0  # s for a whole request, or for a reader to take something
SWEEP = 10  # ticks of uvicorn, of 0.1 s, between two looks at all connections
MAX_UNREAD = 16 << 10  # bytes that wait for a reader before it is sent no more
MAX_ALL_UNREAD = 16 << 20  # bytes that wait for all readers together
SEND_BUFFER = 128 << 10  # bytes of a connection that the kernel keeps
BACKLOG = 512  # connections that wait to be accepted
ACCEPTED = 16  # connections that are accepted in one step of the loop
LOGGED = "error"  # Not each request that is malformed: anybody can send many
TLS_BUFFER = 16 << 10  # bytes of an encrypted connection that are read at a time; asyncio keeps a buffer for each
CLOSING = 3  # s for requests that have begun when the site ends
SWITCH = 0.001  # s that a thread may keep the others waiting


class _Patient(H11Protocol):
    """A connection that is cut once it waits for a request, or for its reader, for too long."""

    def __init__(self, *given: Any, hindered: Counts, **named: Any) -> None:
        super().__init__(*given, **named)
        self._hindered = hindered

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        super().connection_made(transport)
        transport.set_write_buffer_limits(high=MAX_UNREAD)
        self._phase: tuple[object, bool] = (None, True)  # Its request, and whether it waits for the next one
        self._since = self.loop.time()  # When it last came on
        self.app_state = {**self.app_state, "user": user_of(transport)}
        if isinstance(self.loop, Loop):
            self.loop.has_shaken(self)
        if len(self.connections) > MAX_CONNECTIONS:
            self._make_room()

    def resume_writing(self) -> None:
        """Its reader has taken most of what waited."""
        self._since = self.loop.time()
        super().resume_writing()

    @property
    def unread(self) -> int:
        """Bytes that wait for the reader."""
        return self.transport.get_write_buffer_size()

    @property
    def waits(self) -> bool:
        """Whether a request is to come."""
        return self.cycle is None or self.cycle.response_complete

    def idle(self, now: float) -> float:
        """Return for how long neither the other side nor this one came on, s."""
        phase = self.cycle, self.waits
        if phase != self._phase or not (phase[1] or self.unread):
            self._phase, self._since = phase, now
        return now - self._since

    @property
    def address(self) -> str:
        """Of the other side."""
        return self.client[0] if self.client else ""

    def cut(self, reason: Hindered) -> None:
        """End it, with all that waits; a connection that is only closed waits for its reader."""
        if not self.transport.is_closing():
            self._hindered[reason] += 1
        self.transport.abort()

    def _make_room(self) -> None:
        """Of the address with the most connections, cut who has been waiting for a request for the longest time."""
        known = [each for each in self.connections if isinstance(each, _Patient)]
        held = Counter(each.address for each in known)
        others = [each for each in known if each.waits and each is not self]
        if others:
            min(others, key=lambda each: (-held[each.address], each._since)).cut(Hindered.ROOM)


class Server(uvicorn.Server):
    """Ends by a signal without raising it again, so that everything is closed; cuts who hinders others."""

    ended_by = 0
    takes_signals = True  # Only in the main thread

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Take the signals that end it, for as long as it serves."""
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM) if self.takes_signals else ():
            loop.add_signal_handler(number, self._end, number)
        yield

    def _end(self, number: int) -> None:
        self.should_exit, self.ended_by = True, number

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen."""
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(BACKLOG)  # asyncio has set it to ACCEPTED, which it accepts in one step

    async def on_tick(self, counter: int) -> bool:
        """Look at the connections once a second; return whether it is to end."""
        if counter % SWEEP == 0:
            self.sweep(asyncio.get_running_loop().time())
        return await super().on_tick(counter)

    def sweep(self, now: float) -> None:
        """Cut connections that did not come on in time, and of slow readers so many that the others have memory."""
        known = [each for each in self.server_state.connections if isinstance(each, _Patient)]
        ages = {each: each.idle(now) for each in known}
        slow = sorted((each for each in known if each.unread), key=lambda each: -ages[each])
        excess = sum(each.unread for each in slow) - MAX_ALL_UNREAD
        for each in slow:
            if excess > 0:
                excess -= each.unread
                each.cut(Hindered.MEMORY)
        for each in known:
            if ages[each] > PATIENCE:
                each.cut(Hindered.SLOW if each.unread else Hindered.IDLE)


def server_of(app: ASGIApp, tls: ssl.SSLContext | None = None, hindered: Counts | None = None) -> Server:
    """Return what serves an application, encrypted if ``tls`` is given; ``hindered`` counts who is cut."""
    protocol: Any = partial(_Patient, hindered=Counter() if hindered is None else hindered)
    return Server(uvicorn.Config(
        app, http=protocol, ws="none", lifespan="off", log_config=None, log_level=LOGGED, access_log=False,
        server_header=False, date_header=True, limit_concurrency=MAX_CONNECTIONS + ACCEPTED, backlog=ACCEPTED,
        timeout_keep_alive=round(PATIENCE), timeout_graceful_shutdown=CLOSING, loop="asyncio", proxy_headers=False,
        ssl_context_factory=None if tls is None else lambda *_: tls,
    ))  # fmt: skip


def listening_on(address: tuple[str, int]) -> socket.socket:
    """Return a socket that listens; raise OSError if it cannot."""
    listening = socket.socket(socket.AF_INET6 if ":" in address[0] else socket.AF_INET, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)  # connections inherit it
        listening.bind(address)
        listening.listen(BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening


def run_site(
    collector: Collector,
    settings: SiteFile,
    outlets: list[OutletRunner],
    ready: Callable[[str], None],
    access: SiteAccess | None = None,
) -> int:
    """Serve until SIGTERM or SIGINT, and return its number; ``ready`` is told the address once it is listened on.

    With ``access`` connections are encrypted, and users may send commands.

    Raises:
        ServiceError: the address cannot be listened on.
    """
    raise_descriptor_limit()
    sys.setswitchinterval(SWITCH)
    sslproto.SSLProtocol.max_size = TLS_BUFFER
    orders = None if access is None else Orders(access.users, access.signer, collector.command)
    pages = SitePages(collector, settings, [outlet.status for outlet in outlets], orders)
    server = server_of(pages.app(), None if access is None else access.tls, collector.hindered)
    try:
        listening = listening_on(settings.http.address)
    except OSError as error:
        remedy = "set http.listen to another address"
        raise ServiceError(f"http.listen = {settings.http.listen}: {error.strerror}; {remedy}") from error
    with listening, collector, running(outlets):
        ready(f"{'http' if access is None else 'https'}://{settings.http.listen}/")
        with asyncio.Runner(loop_factory=Loop) as runner:
            runner.run(server.serve([listening]))
    return server.ended_by
