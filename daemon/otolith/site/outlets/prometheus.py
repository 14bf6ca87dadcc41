"""Metrics and health at an address of their own, over HTTP, with the bounds of a site on those who ask.

It is for a daemon without a site, and for a site whose scrapes are to wait for no reader of its pages.
"""

import asyncio
import contextlib
import socket
import threading
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

from otolith.outlet_tables import PrometheusOutlet
from otolith.publishing.zenoh_config import raise_descriptor_limit
from otolith.site.app import MAX_AGE, Guard
from otolith.site.outlets.base import Known, MachineView, Notice, OutletError, OutletSetup, OutletStatus
from otolith.site.outlets.connections import failure
from otolith.site.server import Server, listening_on, server_of
from otolith.site.serving.pace import Fresh
from otolith.site.serving.scrapes import Scrapes

# Threshold: docs/reference/thresholds-site.md has its origin.
ENDING = 4.0  # s for answers that have begun when it ends


class MetricsServer:
    """Implements :class:`otolith.site.outlets.base.Outlet`: it is asked, and has nothing to pass on."""

    def __init__(self, options: PrometheusOutlet, known: Known, statuses: Sequence[OutletStatus]) -> None:
        self._options, self._known, self._statuses = options, known, statuses
        self._thread: threading.Thread | None = None
        self._server: Server | None = None

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Listen, unless it does; see :class:`otolith.site.outlets.base.Outlet`."""
        notices.clear()
        if self._thread is not None and self._thread.is_alive():
            return True
        with contextlib.suppress(OSError, ValueError):  # a service may not
            raise_descriptor_limit()
        try:
            listening = listening_on(self._options.address)
        except OSError as error:
            raise OutletError(failure(error, f"listen = {self._options.listen}")) from error
        server = self._server = server_of(self._app(), hindered=self._known.hindered)
        self._thread = threading.Thread(target=_serve, args=(server, listening), name="metrics", daemon=True)
        self._thread.start()
        return True

    def close(self) -> None:
        """End it."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = True
            self._thread.join(ENDING)

    def _app(self) -> Guard:
        pool = ThreadPoolExecutor(1, "make-metrics")
        scrapes, health = Scrapes(self._known, self._statuses, pool), Fresh(self._health, MAX_AGE, pool)

        async def show_health(_: Request) -> Response:
            is_connected, status = await health.get()
            return JSONResponse(status, 200 if is_connected else 503)

        routes = [Route("/metrics", scrapes.answer), Route("/healthz", show_health)]
        return Guard(Starlette(routes=routes), self._options.hosts)

    def _health(self) -> tuple[bool, dict[str, object]]:
        with self._known.lock:
            count, is_connected = len(list(self._known.knowledge)), self._known.connected
        outlets = {each.name: each.reason or "ok" for each in self._statuses}
        text = "ok" if is_connected else "no daemon and no router is connected"
        return is_connected, {"status": text, "machines": count, "outlets": outlets}


def _serve(server: Server, listening: socket.socket) -> None:
    """Serve until the server is to exit; signals are those of the main thread."""
    server.takes_signals = False
    with listening, contextlib.suppress(asyncio.CancelledError):
        asyncio.run(server.serve([listening]))


def build(options: PrometheusOutlet, setup: OutletSetup) -> MetricsServer:
    """Return the outlet."""
    if setup.known is None:
        raise ValueError("metrics are of what is known")
    return MetricsServer(options, setup.known, setup.statuses)
