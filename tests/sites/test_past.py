"""The past of a machine whose daemon does not answer, or whose history cannot be shown."""

import asyncio
import threading
from collections import Counter
from typing import Any, cast

import pytest
from starlette.requests import Request

from otolith.publishing.reader_sessions import QUERY_TIMEOUT
from otolith.site import past
from otolith.site.app import SitePages
from otolith.site.collector import Collector
from otolith.site.known import Knowledge
from otolith.site.past import PARALLEL, PastQuery, past_of
from otolith.site.serving import past_pages
from otolith.site.serving.counts import Counts
from otolith.site.settings import SiteFile
from tests.sites.machines import report_of, sent
from tests.storage.histories import MACHINE, SITE, START


class Works:
    """What a collector has; its daemons answer nothing."""

    def __init__(self) -> None:
        self.knowledge, self.lock, self.asked = Knowledge(), threading.Lock(), 0
        self.dropped: Counter[str] = Counter()
        self.hindered: Counts = Counter()
        self.knowledge.take(*sent(report_of()), START)

    def where(self, *_: str) -> str:
        """Say that all are of one daemon."""
        return ""

    def ask(self, *_: object) -> list[bytes]:
        """Answer nothing."""
        self.asked += 1
        return []


def test_a_daemon_that_does_not_answer_is_asked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of the queries that run at a time may time out; none is sent after them."""
    clock = [0.0]
    monkeypatch.setattr("otolith.site.past.time.monotonic", lambda: clock[0])
    works, query = Works(), PastQuery(SITE, MACHINE, START - 86_400.0, START, 2.0)

    def ask(*_: object) -> list[bytes]:
        clock[0] += QUERY_TIMEOUT
        return works.ask()

    past_of(ask, query, None)
    assert works.asked <= PARALLEL
    assert clock[0] <= PARALLEL * QUERY_TIMEOUT


def test_a_slow_daemon_is_asked_until_there_is_no_time_for_another_query(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, lock = [0.0], threading.Lock()
    monkeypatch.setattr("otolith.site.past.time.monotonic", lambda: clock[0])
    monkeypatch.setattr(past, "PARALLEL", 1)
    begun = list[float]()

    def ask(*_: object) -> list[bytes]:
        with lock:
            begun.append(clock[0])
            clock[0] += 1.0
        return []

    past_of(ask, PastQuery(SITE, MACHINE, START - 86_400.0, START, 2.0), None)
    assert len(begun) > 1
    assert begun[-1] <= past.DEADLINE - QUERY_TIMEOUT


@pytest.mark.parametrize("error", [ValueError, KeyError("x"), OverflowError, ZeroDivisionError, OSError])
def test_a_history_that_cannot_be_shown_is_named_as_such(monkeypatch: pytest.MonkeyPatch, error: Any) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(past_pages, "received_page", fail)
    pages = SitePages(cast("Collector", Works()), SiteFile())
    scope = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": [],
             "path_params": {"site": SITE, "machine": MACHINE}}  # fmt: skip
    assert asyncio.run(pages._show_machine(Request(scope))).status_code == 502
