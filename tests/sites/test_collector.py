"""What the collector makes of what comes: by which clock, what it asks for again, and which events it asks for."""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from otolith.health.limits import Level
from otolith.publishing.reader_sessions import Arrival
from otolith.publishing.zenoh_config import Connection
from otolith.site import collector as collector_module
from otolith.site.app import SitePages
from otolith.site.collector import Collector
from otolith.site.past import MAX_EVENTS, PastQuery, past_of
from otolith.site.serving.scrapes import Scrapes
from otolith.site.settings import SiteFile
from tests.sites.machines import daemons, own_endpoint, raised, report_of, sent
from tests.storage.histories import MACHINE, SITE
from tests.waiting import wait_for

DAY = 86_400.0


def arrival(number: int, end: float) -> Arrival:
    return Arrival(*sent(report_of(number=number, end=end)))


@pytest.fixture
def collector() -> Iterator[Collector]:
    """One that reads nobody."""
    made = Collector(Connection((own_endpoint(),)))
    yield made
    made._queries.shutdown()


@pytest.mark.parametrize("jump", [-DAY, DAY])
def test_a_wall_clock_that_is_set_makes_nobody_silent(
    collector: Collector, monkeypatch: pytest.MonkeyPatch, jump: float
) -> None:
    true, end = time.time, time.time()
    collector._take(arrival(1, end), is_past=False)
    monkeypatch.setattr(time, "time", lambda: true() + jump)
    pages, scrapes = SitePages(collector, SiteFile()), Scrapes(collector, (), ThreadPoolExecutor(1))
    assert pages._shown("en").counts[Level.OK] == 1
    assert b"otolith_machine_up{" in scrapes._written()
    collector._take(arrival(2, end + 2.0), is_past=False)
    assert pages._shown("en").counts[Level.OK] == 1


def test_what_was_dropped_is_asked_for_while_more_comes(collector: Collector, monkeypatch: pytest.MonkeyPatch) -> None:
    """The queue of a busy site is never empty."""
    monkeypatch.setattr(collector_module, "PAUSE", 0.05)
    asked = list[str]()
    monkeypatch.setattr(collector, "_look_back", asked.append)
    report = arrival(1, time.time())
    for _ in range(collector_module.MAX_WAITING + 1):
        collector._put(report)
    assert collector.dropped["queue"] == 1
    collector._thread.start()

    def is_asked() -> bool:
        for _ in range(100):
            collector._put(report)
        return bool(asked)

    wait_for(is_asked)
    collector._stopping.set()
    collector._thread.join()
    assert asked[0] == f"otolith/{SITE}/{MACHINE}"


def test_of_more_events_than_a_page_has_the_last_ones_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("otolith.publishing.zenoh_session.MAX_REPLIES", 40)
    monkeypatch.setattr("otolith.site.past.MAX_EVENTS", 30)
    assert MAX_EVENTS > 30
    with daemons(tmp_path, MACHINE) as (daemon,):
        now = time.time()
        for index in range(100):
            end = now - 200.0 + index
            event = raised(time=end).model_copy(update={"id": f"e{index}"})
            daemon.keep(report_of(daemon.machine, end=end, events=(event,)))
        daemon.publish(report_of(daemon.machine, end=now))
        daemon.wait()
        with Collector(Connection((daemon.endpoint,))) as own:
            wait_for(lambda: own.connected and own.where(SITE, daemon.machine) != "")
            query = PastQuery(SITE, daemon.machine, now - 3600.0, now + 60.0, 2.0)
            events = past_of(own.ask, query, None).history.events(0.0)
            assert [event.id for event in events] == [f"e{index}" for index in range(70, 100)]
            wait_for(lambda: own.knowledge.get(SITE, daemon.machine) is not None)
            wait_for(lambda: "e99" in {key for machine in own.knowledge for key in machine.events})
