"""The past of a machine, from the history of its daemon over Zenoh: few reports, spread over the time asked for."""

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime

from otolith.health.schema import EventDocument, Language, ReportDocument
from otolith.publishing.reader_sessions import QUERY_TIMEOUT
from otolith.publishing.received_history import ReceivedHistory
from otolith.publishing.zenoh_session import EVENT, MAX_REPLIES, REPORT
from otolith.site.known import MAX_BYTES

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
POINTS = 96  # reports of a page, at most
MAX_EVENTS = 500  # of a page
PARALLEL = 6  # queries of one page at a time
FIRST_SPAN = "1h"
SPANS = {"1h": 3600.0, "8h": 28_800.0, "24h": 86_400.0, "7d": 604_800.0}  # s, by the name that an address gives
DEADLINE = 10.0  # s for all queries of a page
TIMED_OUT = 0.9 * QUERY_TIMEOUT  # s of a query after which its daemon is not asked again
MIN_WINDOW = 2.0  # s: the shortest span of one query

Ask = Callable[[str, int, Callable[[], None]], list[bytes]]
"""Returns what daemons answer to a selector, with a limit; calls the last argument if one refuses to answer."""


@dataclass(frozen=True, slots=True)
class PastQuery:
    """Which time of which machine is asked for."""

    site: str
    machine: str
    since: float
    until: float
    window: float  # Length of a window, s


@dataclass(frozen=True, slots=True)
class PastAnswers:
    """What daemons answered, and how many of the queries they did not answer."""

    history: ReceivedHistory
    queries: int
    missing: int


class _Asking:
    """Asks until a query times out, or there is no time for another one, and counts what is missing on the page."""

    def __init__(self, ask: Ask) -> None:
        self._ask, self._until = ask, time.monotonic() + DEADLINE - QUERY_TIMEOUT
        self._missing = itertools.count()  # which threads share
        self.queries = 0

    def __call__(self, selector: str, limit: int) -> list[bytes]:
        if (begun := time.monotonic()) > self._until:
            self._count()
            return []
        found = self._ask(selector, limit, self._count)
        if time.monotonic() - begun >= TIMED_OUT:
            self._until = begun
            self._count()
        return found

    def _count(self) -> None:
        next(self._missing)

    @property
    def missing(self) -> int:
        """How many queries were not answered; call it once."""
        return next(self._missing)


def past_of(
    ask: Ask,
    query: PastQuery,
    latest: ReportDocument | None,
    reader: tuple[Language | None, str | None] = (None, None),
) -> PastAnswers:
    """Return the history of a machine in the language and zone of its ``reader``, by default in those of the machine.

    The events and the last reports are asked for first.
    """
    pieces, asking = list(_pieces(query)), _Asking(ask)
    key = EVENT.under(query.site, query.machine)
    span = f"_time=[{_moment(query.since)}..{_moment(query.until)}]"
    events = list(_events(asking(f"{key}?{span};last={MAX_EVENTS}", MAX_REPLIES)))[-MAX_EVENTS:]
    key = REPORT.under(query.site, query.machine)
    selectors = [f"{key}?_time=[{_moment(begin)}..{_moment(end)}];limit=1" for begin, end in reversed(pieces)]
    with ThreadPoolExecutor(PARALLEL) as pool:
        answers = pool.map(lambda selector: asking(selector, 1), selectors)
        reports = {report.window.end: report for content in answers for report in _reports(content, query)}
    if latest is not None and query.since <= latest.window.end <= query.until:
        reports[latest.window.end] = latest
    ordered = [reports[end] for end in sorted(reports)]
    history = ReceivedHistory(query.site, query.machine, ordered, events, reader)
    return PastAnswers(history, len(pieces) + 1, asking.missing)


def _pieces(query: PastQuery) -> Iterator[tuple[float, float]]:
    """Yield the spans that are asked for, one report of each."""
    count = min(POINTS, max(int((query.until - query.since) / max(query.window, MIN_WINDOW)), 1))
    step = (query.until - query.since) / count
    for index in range(count):
        yield query.since + index * step, query.since + (index + 1) * step


def _moment(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%M:%S.%f}Z"


def _reports(contents: Sequence[bytes], query: PastQuery) -> Iterator[ReportDocument]:
    for content in contents:
        if len(content) <= MAX_BYTES:
            try:
                text = content.decode().replace('"schema"', '"schema_"', 1)
                report = ReportDocument.model_validate_json(text, extra="ignore")
            except ValueError:  # anybody may answer anything
                continue
            if (report.site, report.machine) == (query.site, query.machine):
                yield report


def _events(contents: Sequence[bytes]) -> Iterator[EventDocument]:
    for content in contents:
        if len(content) <= MAX_BYTES:
            try:
                yield EventDocument.model_validate_json(content, extra="ignore")
            except ValueError:  # as above
                continue
