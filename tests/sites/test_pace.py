"""What is made once for all who ask, and the turns of those who ask for pages."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any, cast

import pytest

from otolith.site.collector import Collector
from otolith.site.known import Knowledge
from otolith.site.past import PastQuery, past_of
from otolith.site.serving import past_pages
from otolith.site.serving.counts import Counts, Hindered
from otolith.site.serving.pace import PAGE_PAUSE, Fresh, Turns
from otolith.site.serving.past_pages import MAX_LOOKING, MAX_OF_ADDRESS, MAX_WAITING, Key, PastPages
from otolith.site.serving.pieces import PIECE, grouped
from tests.storage.histories import MACHINE, SITE


def test_what_many_ask_for_at_once_is_made_once_and_anew_when_it_is_old() -> None:
    made = list[str]()

    def make() -> int:
        made.append(threading.current_thread().name)
        return len(made)

    async def run() -> None:
        with ThreadPoolExecutor(1, "own") as pool:
            fresh = Fresh(make, 0.2, pool)
            assert set(await asyncio.gather(*(fresh.get() for _ in range(100)))) == {1}
            await asyncio.sleep(0.25)
            assert await fresh.get() == 2
            assert made == ["own_0", "own_0"]

    asyncio.run(run())


def test_what_could_not_be_made_is_tried_again_by_who_asks_next() -> None:
    failures = [ValueError("first")]

    def make() -> int:
        if failures:
            raise failures.pop()
        return 1

    async def run() -> None:
        with ThreadPoolExecutor(1) as pool:
            fresh = Fresh(make, 60.0, pool)
            with pytest.raises(ValueError, match="first"):
                await fresh.get()
            assert await fresh.get() == 1

    asyncio.run(run())


def test_who_leaves_does_not_end_what_others_wait_for() -> None:
    free = threading.Event()

    async def run() -> None:
        with ThreadPoolExecutor(1) as pool:
            fresh = Fresh(free.wait, 60.0, pool)
            first, second = asyncio.create_task(fresh.get()), asyncio.create_task(fresh.get())
            await asyncio.sleep(0.01)
            first.cancel()
            free.set()
            assert await second

    asyncio.run(run())


def test_pages_take_turns_and_a_scrape_waits_for_none_of_them() -> None:
    order = list[str]()

    async def page(turns: Turns) -> None:
        await turns.take()
        order.append("page")

    async def scrape() -> None:
        order.append("scrape")

    async def run() -> float:
        turns, begun = Turns(), asyncio.get_running_loop().time()
        pages = [asyncio.create_task(page(turns)) for _ in range(40)]
        await asyncio.gather(asyncio.create_task(scrape()), *pages)
        return asyncio.get_running_loop().time() - begun

    assert asyncio.run(run()) >= 39 * PAGE_PAUSE
    assert order.index("scrape") <= 1


def test_pieces_are_sent_in_parts_of_bounded_size() -> None:
    content = [b"a" * size for size in (0, 1, 10 * PIECE, 700, PIECE - 1, 5)]
    parts = list(grouped(content))
    assert b"".join(parts) == b"".join(content)
    assert max(map(len, parts)) < 2 * PIECE
    assert len(parts) <= sum(map(len, content)) / PIECE + 1


class Works:
    """What a collector has; each machine has a daemon of its own."""

    knowledge, lock = Knowledge(), threading.Lock()

    def __init__(self) -> None:
        self.hindered = Counts()

    def where(self, site: str, machine: str) -> str:
        """Return the endpoint of a machine."""
        return f"{site}/{machine}"

    def ask(self, *_: object) -> list[bytes]:
        """Answer nothing."""
        return []


def asked(monkeypatch: pytest.MonkeyPatch, free: threading.Event) -> tuple[PastPages, list[PastQuery]]:
    """Pages of which each is made once ``free`` is set, and those that are being made."""
    queries = list[PastQuery]()

    def past(ask: Any, query: PastQuery, *rest: Any) -> Any:
        queries.append(query)
        free.wait()
        return past_of(ask, query, *rest)

    monkeypatch.setattr(past_pages, "past_of", past)
    monkeypatch.setattr(past_pages, "received_page", lambda *_: "<header>")
    return PastPages(cast("Collector", Works()), None), queries


def test_a_page_of_the_past_is_made_once_for_all_who_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    free.set()
    pages, queries = asked(monkeypatch, free)

    async def run() -> None:
        first = await asyncio.gather(*(pages.get((SITE, MACHINE, "1h", "en"), None) for _ in range(200)))
        again = await pages.get((SITE, MACHINE, "1h", "en"), None)
        assert {id(page) for page in first} == {id(again)}

    asyncio.run(run())
    assert len(queries) == 1


def test_more_pages_of_the_past_than_are_made_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    pages, queries = asked(monkeypatch, free)

    async def run() -> None:
        keys: list[tuple[Key, str]] = [((SITE, f"m-{index}", "1h", "en"), f"{index % 50}") for index in range(100)]
        waiting = [asyncio.create_task(pages.get(key, None, address)) for key, address in keys]
        await asyncio.sleep(0.2)
        assert len(queries) == MAX_LOOKING
        free.set()
        found = await asyncio.gather(*waiting)
        assert sum(page is not None for page in found) == MAX_LOOKING + MAX_WAITING
        assert +pages._collector.hindered == {Hindered.HISTORY_BUSY: 100 - MAX_LOOKING - MAX_WAITING}

    asyncio.run(run())


def test_one_address_leaves_places_of_the_past_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    pages, _ = asked(monkeypatch, free)

    async def run() -> None:
        waiting = [asyncio.create_task(pages.get((SITE, f"m-{index}", "1h", "en"), None, "a")) for index in range(100)]
        await asyncio.sleep(0.1)
        other = asyncio.create_task(pages.get((SITE, "other", "1h", "en"), None, "b"))
        await asyncio.sleep(0.1)
        free.set()
        assert sum(page is not None for page in await asyncio.gather(*waiting)) == MAX_OF_ADDRESS
        assert await other is not None
        assert +pages._collector.hindered == {Hindered.HISTORY_ADDRESS: 100 - MAX_OF_ADDRESS}
        assert await pages.get((SITE, "later", "1h", "en"), None, "a") is not None
        assert not pages._open

    asyncio.run(run())


def test_a_daemon_is_asked_for_one_page_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    free = threading.Event()
    monkeypatch.setattr(Works, "where", lambda *_: "a router")
    pages, queries = asked(monkeypatch, free)

    async def run() -> None:
        waiting = [asyncio.create_task(pages.get((SITE, f"m-{index}", "1h", "en"), None)) for index in range(3)]
        await asyncio.sleep(0.2)
        assert len(queries) == 1
        free.set()
        await asyncio.gather(*waiting)

    asyncio.run(run())
