"""Runs the site: uvicorn on one address, with bounds on connections."""

import asyncio
import signal
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from otolith.publishing.zenoh_config import raise_descriptor_limit
from otolith.site.app import SitePages
from otolith.site.collector import Collector
from otolith.site.outlets.runner import OutletRunner
from otolith.site.outlets.table import running
from otolith.site.settings import SiteFile
from otolith_drivers.errors import ServiceError

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_CONNECTIONS = 2000
FIRST_REQUEST = 10.0  # s that a connection may take until its first request is whole
KEEP_ALIVE = 10  # s that a connection may wait for its next request
BACKLOG = 512  # connections that wait to be accepted
CLOSING = 3  # s for requests that have begun when the site ends


class _Patient(H11Protocol):
    """Closes a connection that sends no request in time."""

    _overdue: asyncio.TimerHandle

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn has it
        super().connection_made(transport)
        self._overdue = self.loop.call_later(FIRST_REQUEST, self._close_unless_asked)

    def connection_lost(self, exc: Exception | None) -> None:
        self._overdue.cancel()
        super().connection_lost(exc)

    def _close_unless_asked(self) -> None:
        if self.cycle is None and not self.transport.is_closing():
            self.transport.close()


class _Server(uvicorn.Server):
    """Ends by a signal without raising it again, so that everything is closed."""

    ended_by = 0

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self._end, number)
        yield

    def _end(self, number: int) -> None:
        self.should_exit, self.ended_by = True, number


def run_site(
    collector: Collector, settings: SiteFile, outlets: list[OutletRunner], ready: Callable[[str], None]
) -> int:
    """Serve until SIGTERM or SIGINT, and return its number; ``ready`` is told the address once it is listened on.

    Raises:
        ServiceError: the address cannot be listened on.
    """
    raise_descriptor_limit()
    host, port = settings.http.address
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    pages = SitePages(collector, settings, [outlet.status for outlet in outlets])
    config = uvicorn.Config(
        pages.app(), http=_Patient, ws="none", lifespan="off", log_config=None,
        access_log=False, server_header=False, date_header=True, limit_concurrency=MAX_CONNECTIONS, backlog=BACKLOG,
        timeout_keep_alive=KEEP_ALIVE, timeout_graceful_shutdown=CLOSING, loop="asyncio", proxy_headers=False,
    )  # fmt: skip
    with socket.socket(family, socket.SOCK_STREAM) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, port))
            listening.listen(BACKLOG)
        except OSError as error:
            remedy = "set http.listen to another address"
            raise ServiceError(f"http.listen = {settings.http.listen}: {error.strerror}; {remedy}") from error
        server = _Server(config)
        with collector, running(outlets):
            ready(f"http://{settings.http.listen}/")
            asyncio.run(server.serve([listening]))
    return server.ended_by
