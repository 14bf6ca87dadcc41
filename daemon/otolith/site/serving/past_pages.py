"""Pages of the past of machines: each is made once for all who ask, few at a time, and one of each daemon."""

import asyncio
import time
from collections import Counter, defaultdict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from otolith.health.schema import Language, ReportDocument
from otolith.publishing.received_history import received_page
from otolith.site.collector import Collector
from otolith.site.past import SPANS, PastAnswers, PastQuery, past_of
from otolith.site.serving.counts import Hindered

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_LOOKING = 4  # pages that are made at a time
MAX_WAITING = 12  # pages that wait to be made
MAX_OF_ADDRESS = 8  # pages that are made, or wait, for one address
PAST_AGE = 10.0  # s for which a page is given to others who ask for it
MAX_KEPT = 16  # pages that are kept for so long


Key = tuple[str, str, str, Language]
"""Site, machine, span, and the language of the page."""


@dataclass(frozen=True, slots=True)
class PastPage:
    """A report page: before its header, from there to its first heading, and from there to its end."""

    head: bytes
    top: bytes
    rest: bytes
    past: PastAnswers


class PastPages:
    """Asks daemons in threads of its own."""

    def __init__(self, collector: Collector, zone: str | None) -> None:
        """Times are shown in a zone, by default in that of the machine."""
        self._collector, self._zone = collector, zone
        self._asking = ThreadPoolExecutor(MAX_LOOKING, "ask-past")
        self._making = ThreadPoolExecutor(1, "make-past")  # one core is enough for those who look at the past
        self._looking = asyncio.Semaphore(MAX_LOOKING)
        self._daemons: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)  # By where it is asked
        self._pages: dict[Key, asyncio.Task[PastPage]] = {}
        self._open: Counter[str] = Counter()  # pages that are being made, or wait for it, by who asks

    async def get(self, key: Key, latest: ReportDocument | None, address: str = "") -> PastPage | None:
        """Return a page; None if too many wait for theirs, or for one ``address``.

        Raises:
            ValueError, LookupError, ArithmeticError, OSError: it cannot be shown; anybody may have published it.
        """
        if key not in self._pages:
            is_full = self._open.total() >= MAX_LOOKING + MAX_WAITING
            if is_full or self._open[address] >= MAX_OF_ADDRESS:
                self._collector.hindered[Hindered.HISTORY_BUSY if is_full else Hindered.HISTORY_ADDRESS] += 1
                return None
            self._open[address] += 1
            self._pages[key] = asyncio.create_task(self._page(key, latest, address))
        return await asyncio.shield(self._pages[key])  # who leaves does not end it for the others

    async def _page(self, key: Key, latest: ReportDocument | None, address: str) -> PastPage:
        loop, lock = asyncio.get_running_loop(), self._daemons[self._collector.where(*key[:2])]
        try:
            await lock.acquire()
            begun = loop.time()
            try:
                async with self._looking:
                    begun = loop.time()
                    return await self._made(key, latest)
            finally:
                loop.call_later(loop.time() - begun, lock.release)  # half of the time no page asks this daemon
        finally:
            self._open[address] -= 1
            self._open += Counter()  # without those that have none
            loop.call_later(PAST_AGE, self._pages.pop, key, None)
            for old in [key for key, task in self._pages.items() if task.done()][:-MAX_KEPT]:
                del self._pages[old]

    async def _made(self, key: Key, latest: ReportDocument | None) -> PastPage:
        loop, now, window = asyncio.get_running_loop(), time.time(), 0.0
        if latest is not None:
            window = latest.window.end - latest.window.start
        query = PastQuery(*key[:2], now - SPANS[key[2]], now, window)
        past = await loop.run_in_executor(
            self._asking, past_of, self._collector.ask, query, latest, (key[3], self._zone)
        )
        self._collector.hindered[Hindered.UNANSWERED] += past.missing
        page = await loop.run_in_executor(self._making, received_page, past.history, query.since, now)
        before, header, after = page.partition("<header>")
        above, heading, below = after.partition("<h2>")  # texts from outside are escaped
        pieces = before, f"{header}{above}", f"{heading}{below}"
        head, top, rest = (piece.encode(errors="replace") for piece in pieces)
        return PastPage(head, top, rest, past)
