"""Answers to who scrapes: written once for all who ask, and compressed for who takes that, as Prometheus does."""

import gzip
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from starlette.requests import Request
from starlette.responses import Response

from otolith.site.metrics import CONTENT_TYPE, Metrics
from otolith.site.outlets.base import Known, OutletStatus
from otolith.site.serving.pace import Fresh
from otolith.site.serving.pieces import Pieces

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_SCRAPE_AGE = 0.5  # s of metrics that are given to several who ask
LEVEL = 1  # of compression


class Scrapes:
    """Metrics of what is known and of outlets."""

    def __init__(self, known: Known, outlets: Sequence[OutletStatus], pool: ThreadPoolExecutor) -> None:
        """They are written in a thread of ``pool``."""
        self._known, self._outlets, self._metrics = known, outlets, Metrics(known.knowledge)
        self._plain = Fresh(self._written, MAX_SCRAPE_AGE, pool)
        self._compressed = Fresh(lambda: gzip.compress(self._written(), LEVEL), MAX_SCRAPE_AGE, pool)

    async def answer(self, request: Request) -> Response:
        """Answer a scrape."""
        if "gzip" not in request.headers.get("accept-encoding", ""):
            return Pieces([await self._plain.get()], CONTENT_TYPE, headers={"vary": "accept-encoding"})
        headers = {"vary": "accept-encoding", "content-encoding": "gzip"}
        return Pieces([await self._compressed.get()], CONTENT_TYPE, headers=headers)

    def _written(self) -> bytes:
        with self._known.lock:
            return self._metrics.exposition(
                self._known.dropped, tuple(self._outlets), time.monotonic(), self._known.hindered
            )
