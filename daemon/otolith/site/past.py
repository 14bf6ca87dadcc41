"""The past of a machine, from the history of its daemon over Zenoh: few reports, spread over the time asked for."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime

from otolith.health.schema import EventDocument, Language, ReportDocument
from otolith.publishing.reader_sessions import QUERY_TIMEOUT
from otolith.publishing.received_history import ReceivedHistory
from otolith.publishing.zenoh_session import EVENT, REPORT
from otolith.site.known import MAX_BYTES

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
POINTS = 96  # reports of a page, at most
MAX_EVENTS = 500  # of a page
PARALLEL = 6  # queries of one page at a time
SPANS = {"1h": 3600.0, "8h": 28_800.0, "24h": 86_400.0, "7d": 604_800.0}  # s, by the name that an address gives
DEADLINE = 10.0  # s for all queries of a page
TIMED_OUT = 0.9 * QUERY_TIMEOUT  # s of a query after which its daemon is not asked again
MIN_WINDOW = 2.0  # s: the shortest span of one query

Ask = Callable[[str, int], list[bytes]]


@dataclass(frozen=True, slots=True)
class PastQuery:
    """Which time of which machine is asked for."""

    site: str
    machine: str
    since: float
    until: float
    window: float  # Length of a window, s


class _Asking:
    """Asks until a query times out, or there is no time for another one: what is missing is not on the page."""

    def __init__(self, ask: Ask) -> None:
        self._ask, self._until = ask, time.monotonic() + DEADLINE - QUERY_TIMEOUT

    def __call__(self, selector: str, limit: int) -> list[bytes]:
        if (begun := time.monotonic()) > self._until:
            return []
        found = self._ask(selector, limit)
        if time.monotonic() - begun >= TIMED_OUT:
            self._until = begun
        return found


def past_of(
    ask: Ask,
    query: PastQuery,
    latest: ReportDocument | None,
    reader: tuple[Language | None, str | None] = (None, None),
) -> ReceivedHistory:
    """Return the history of a machine in the language and zone of its ``reader``, by default in those of the machine.

    ``ask`` returns what daemons answer to a selector, with a limit.
    """
    pieces, ask = tuple(_pieces(query)), _Asking(ask)
    key = REPORT.under(query.site, query.machine)
    selectors = [f"{key}?_time=[{_moment(begin)}..{_moment(end)}];limit=1" for begin, end in pieces]
    with ThreadPoolExecutor(PARALLEL) as pool:
        answers = pool.map(lambda selector: ask(selector, 1), selectors)
        reports = {report.window.end: report for content in answers for report in _reports(content, query)}
    if latest is not None and query.since <= latest.window.end <= query.until:
        reports[latest.window.end] = latest
    whole = f"{EVENT.under(query.site, query.machine)}?_time=[{_moment(query.since)}..{_moment(query.until)}]"
    events = list(_events(ask(whole, MAX_EVENTS)))
    ordered = [reports[end] for end in sorted(reports)]
    return ReceivedHistory(query.site, query.machine, ordered, events, reader)


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
