"""What the thread of an outlet keeps in mind: who is gone, what was refused, and whether anything was tried."""

import ssl
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import pytest

from otolith.health.limits import Level
from otolith.health.schema import HealthDocument, Language
from otolith.outlet_tables import MailOutlet
from otolith.site.collector import Collector
from otolith.site.known import Knowledge
from otolith.site.metrics import Metrics
from otolith.site.outlets import runner
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup, Told
from otolith.site.outlets.mail import Mail
from otolith.site.outlets.notices import LASTING, Silences
from otolith.site.outlets.runner import OutletRunner
from otolith.site.words import words_in
from tests.sites.machines import raised, report_of, sent
from tests.storage.histories import START
from tests.waiting import wait_for


class Scripted:
    """An outlet that keeps what it was given, and fails as it is told."""

    def __init__(self) -> None:
        self.shown, self.gone = list[str](), list[str]()
        self.error: OutletError | None = None

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Fail with the error that was set, once."""
        if self.error is not None:
            error, self.error = self.error, None
            for _ in range(error.refused):
                notices.popleft()
            raise error
        self.shown += [view.name for view in views]
        self.gone += gone
        is_tried = bool(notices)
        notices.clear()
        return is_tried

    def close(self) -> None:
        """Nothing is open."""


class Works:
    """What a collector has."""

    def __init__(self, knowledge: Knowledge) -> None:
        self.knowledge, self.lock = knowledge, threading.Lock()


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "TICK", 0.02)
    monkeypatch.setattr(runner, "FIRST_PAUSE", 0.02)


def known(*names: str) -> Knowledge:
    knowledge = Knowledge()
    for name in names:
        knowledge.take(*sent(report_of(name)), START)
    return knowledge


def running(outlet: Scripted, works: Works, language: Language | None = "en", zone: str | None = None) -> OutletRunner:
    setup = OutletSetup(Path(), "Works", language, zone)
    return OutletRunner("own", outlet, cast("Collector", works), setup, 60)


@pytest.mark.parametrize(
    ("language", "zone", "condition", "moment"),
    [("de", "Asia/Tokyo", "Unwucht der Welle", "07:13:20"), (None, None, "unbalanced shaft", "22:13:20")],
)
def test_views_and_notices_are_in_language_and_zone_of_the_site(
    language: Language | None, zone: str | None, condition: str, moment: str
) -> None:
    own = raised().model_copy(update={
        "condition": "unbalanced shaft", "condition_id": "unbalance", "timezone": "UTC", "part": "shaft"})  # fmt: skip
    knowledge = Knowledge()
    knowledge.take(*sent(report_of("a", events=(own,))), START)
    each = running(Scripted(), Works(knowledge), language, zone)
    view = each._view(next(iter(knowledge)), START)
    assert view is not None
    assert view.report is not None
    event = each._reworded(Notice("hall-1", "a", Told.RAISED, own)).event
    assert condition in view.what
    assert [row.condition for row in (*view.report.open_events, event)] == [condition, condition]
    letter = Mail(MailOutlet(host="h", sender="a@b.example", to=("c@d.example",)), "", ssl.create_default_context(),
                  OutletSetup(Path(), "Works"))._message([Notice("hall-1", "a", Told.RAISED, event)])  # fmt: skip
    assert condition in letter["subject"]
    assert moment in letter.get_content()


@pytest.mark.parametrize(("language", "said"), [(None, "de"), ("en", "en")])
def test_silence_is_told_in_language_and_zone_of_the_site_or_else_of_the_machine(
    language: Language | None, said: Language
) -> None:
    report, knowledge, silences = report_of("a"), Knowledge(), Silences()
    health = HealthDocument(state=Level.OK, since=START, parts={}, language="de", timezone="Asia/Tokyo")
    knowledge.take(*sent(report.model_copy(update={"health": health})), START)
    for now in (START + 1000.0, START + 1000.0 + LASTING):
        found = silences.take(knowledge, now, now, language)
    (event,) = (notice.event for notice in found)
    assert (event.language, event.timezone) == (said, "Asia/Tokyo")
    assert event.condition == words_in(said)["silence"]


def test_a_machine_that_is_gone_while_the_outlet_fails_is_told_to_be_gone() -> None:
    outlet, works = Scripted(), Works(known("a", "b"))
    own = running(outlet, works)
    own._pass_on()
    own._fail("away")
    works.knowledge = known("a")
    own._pass_on()
    assert outlet.shown == ["a", "b", "a"]
    assert [key.rpartition("/")[2] for key in outlet.gone] == ["b"]
    own._pass_on()
    assert len(outlet.gone) == 1


def test_what_was_refused_is_lost_and_an_outlet_that_was_not_tried_is_neither_up_nor_down() -> None:
    outlet, works = Scripted(), Works(Knowledge())
    own = running(outlet, works)
    assert "otolith_outlet_up{" not in Metrics(works.knowledge).exposition({}, [own.status], START).decode()
    own.start()
    outlet.error = OutletError("away", 0)
    wait_for(lambda: own.status.failures == 1)
    assert (own.status.is_tried, own.status.is_up) == (True, False)
    now = own.status.since
    outlet.error = OutletError("refused", 1)
    with works.lock:
        events = (raised(time=now),)
        works.knowledge.take(*sent(report_of("a", end=now, events=events)), now)
    wait_for(lambda: own.status.failures == 2)
    assert (own.status.sent, own.status.lost, own.status.is_up) == (0, 1, False)
    with works.lock:
        events = (raised(time=now).model_copy(update={"id": "another"}),)
        works.knowledge.take(*sent(report_of("b", end=now, events=events)), now)
    wait_for(lambda: own.status.is_up)
    assert (own.status.sent, own.status.lost) == (1, 1)
    own.stop()
