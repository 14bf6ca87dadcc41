"""Which events are told, and how a webhook and an e-mail tell them."""

import hashlib
import hmac
import http.server
import json
import smtplib
import ssl
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.health.limits import Level
from otolith.health.text import event_in
from otolith.outlet_tables import MailOutlet, WebhookOutlet
from otolith.runtime.hall.files import Refused
from otolith.runtime.hall.left_out import left_out_report
from otolith.site.known import Knowledge
from otolith.site.outlets import mail
from otolith.site.outlets import notices as notices_module
from otolith.site.outlets.base import Notice, OutletError, OutletSetup, Told
from otolith.site.outlets.notices import HOUR, LASTING, MISSED, Notices, RateLimit, Silences
from otolith.site.outlets.webhook import build as webhook
from tests.hostile import hostile_text
from tests.messages import assert_says
from tests.sites.machines import raised, report_of, sent
from tests.sites.outlets.rigs import MailRig, WebhookRig
from tests.storage.histories import MACHINE, SITE, START

LEVELS = (Level.WATCH, Level.ACT)
TLS = ssl.create_default_context()


def notice(key: str = "limit/R_a@1", state: Level = Level.ACT, told: Told = Told.RAISED, **update: Any) -> Notice:
    return Notice("hall-1", "press-3", told, raised(state).model_copy(update={"id": key, **update}))


@given(st.lists(st.one_of(st.none(), st.sampled_from(LEVELS)), min_size=1, max_size=30))
def test_a_change_of_state_is_told_and_nothing_else(states: list[Level | None]) -> None:
    """None is an event that is over."""
    knowledge, notices, told = Knowledge(), Notices(START), list[Told]()
    for index, state in enumerate(states):
        now = START + 2.0 * index
        event = raised(state or Level.ACT, START).model_copy(update={"since": now, "end": None if state else now})
        knowledge.take(*sent(report_of(number=index + 1, end=now, events=(event,))), now)
        told += [each.told for each in notices.take(knowledge, now)]
        assert notices.take(knowledge, now) == []
    steps = [None, *states]
    expected = sum(before is not after for before, after in zip(steps, states, strict=False))
    assert len(told) == expected
    if states[-1] is None and told:
        assert told[-1] is Told.CLEARED


@pytest.mark.parametrize(("age", "count"), [(0.0, 1), (MISSED - 1.0, 1), (MISSED + 1.0, 0)])
def test_what_changed_shortly_before_the_start_is_told(age: float, count: int) -> None:
    knowledge = Knowledge()
    event = raised(time=START).model_copy(update={"since": START - age})
    knowledge.take(*sent(report_of(events=(event,))), START)
    assert len(Notices(START).take(knowledge, START)) == count


@pytest.mark.parametrize("jump", [-864_000.0, 864_000.0])
def test_an_event_is_told_whatever_the_wall_clock_of_the_site_said_at_its_start(jump: float) -> None:
    """The clock of the site is not that of the daemon, and may have been set since."""
    knowledge, notices = Knowledge(), Notices(START + jump)
    knowledge.take(*sent(report_of(events=(raised(time=START),))), START + jump)
    assert [each.told for each in notices.take(knowledge, START + jump)] == [Told.RAISED]


def silences(silent: Silences, knowledge: Knowledge, now: float) -> list[tuple[str, Told]]:
    return [(each.machine, each.told) for each in silent.take(knowledge, now, now, "en")]


def test_silence_and_its_end_are_told_once_each_when_they_last() -> None:
    knowledge, silent, told, count = Knowledge(), Silences(), list[tuple[float, Told]](), 0
    for index in range(1000):
        now, second = START + index, float(index)
        if second % 2 == 0 and not (200 <= second < 230 or 400 <= second < 600 or 650 <= second < 690):
            count += 1
            knowledge.take(*sent(report_of(number=count, end=now)), now)
        told += [(second, each) for _, each in silences(silent, knowledge, now)]
    (first, raising), (second, clearing) = told
    assert (raising, clearing) == (Told.RAISED, Told.CLEARED)
    assert 400 + LASTING <= first <= 400 + LASTING + 15
    assert 600 + LASTING <= second <= 600 + LASTING + 100


def test_a_machine_that_was_named_and_never_reports_is_told_and_one_that_is_forgotten_is_not() -> None:
    knowledge, silent = Knowledge(["hall-1/press-3"]), Silences()
    assert silences(silent, knowledge, START) == []
    assert silences(silent, knowledge, START + LASTING) == [("press-3", Told.RAISED)]
    assert silences(silent, Knowledge(), START + LASTING) == silences(silent, Knowledge(), START + 2 * LASTING) == []


def test_a_machine_that_its_daemon_does_not_serve_is_told_with_the_reason() -> None:
    """Its reports come, and say nothing else."""
    knowledge, silent, told = Knowledge(), Silences(), list[Notice]()
    refused = Refused(Path("press-3.toml"), (SITE, MACHINE), "press-3.toml: R_a", "de")
    for index in range(300):
        now = START + index
        if index < 150 and index % 10 == 0:
            knowledge.take(*sent(left_out_report(refused, START, now)), now)
        elif index >= 150 and index % 2 == 0:
            knowledge.take(*sent(report_of(number=index, end=now)), now)
        told += silent.take(knowledge, now, now, "en")
    assert [each.told for each in told] == [Told.RAISED, Told.CLEARED]
    event = told[0].event
    assert (event.condition, event.text) == ("not monitored", "not served: press-3.toml: R_a")
    assert (event.state, event.language, event.since) == (Level.NO_DATA, "en", START)


def test_a_link_that_is_cut_leaves_room_for_what_machines_report() -> None:
    limit = RateLimit(10)
    own = [notice(str(index), Level.NO_DATA) for index in range(200)]
    assert len(limit.passes(own, START)) == 5
    assert len(limit.passes([notice(str(index)) for index in range(10)], START + 1.0)) == 5
    assert limit.withheld == 200


def test_an_event_that_is_open_is_told_once_however_many_others_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notices_module, "MAX_REMEMBERED", 60)
    knowledge, notices, told = Knowledge(), Notices(START), list[str]()
    first = raised(time=START).model_copy(update={"id": "open"})
    for index in range(200):
        now = START + 1.0 + index
        other = raised(time=now).model_copy(update={"id": f"other@{index}", "start": now, "end": None})
        knowledge.take(*sent(report_of(number=index + 1, end=now, events=(first, other))), now)
        told += [each.event.id for each in notices.take(knowledge, now) if each.told is Told.RAISED]
    assert len(told) == len(set(told)) == 201
    assert len(notices._told) <= 60


@given(st.lists(st.tuples(st.floats(0.0, 2000.0), st.integers(0, 8)), max_size=60), st.integers(1, 20))
def test_no_hour_has_more_notices_than_the_limit(steps: list[tuple[float, int]], per_hour: int) -> None:
    limit, now, passed, offered = RateLimit(per_hour), START, list[float](), 0
    for pause, count in steps:
        now += pause
        own = limit.passes([notice(str(index)) for index in range(count)], now)
        passed += [now] * len(own)
        offered += count
        assert sum(time > now - HOUR for time in passed) <= per_hour
    assert len(passed) + limit.withheld == offered


def test_the_most_severe_pass_first() -> None:
    own = [notice("a", Level.WATCH), notice("b", Level.ACT), notice("c", Level.WATCH), notice("d", Level.ACT)]
    assert [each.event.id for each in RateLimit(3).passes(own, START)] == ["a", "b", "d"]


@given(hostile_text)
def test_a_notice_is_a_document_whatever_it_says(text: str) -> None:
    own = notice(condition=text, text=text, advice=text, cause=text, part=text)
    assert json.loads(json.dumps(own.document()))["schema"] == "otolith.notice/1"


@pytest.fixture
def posted(tmp_path: Path) -> Iterator[WebhookRig]:
    rig = WebhookRig(tmp_path)
    rig.table()
    rig.start()
    yield rig
    rig.stop()


def hook(rig: WebhookRig) -> Any:
    options = WebhookOutlet(url=f"http://127.0.0.1:{rig.port}/hook?a=1", secret_file=Path("secret"))
    return webhook(options, OutletSetup(rig.folder, "Works", "en"))


def test_a_request_is_signed_and_says_which_notice_it_is(posted: WebhookRig) -> None:
    for _ in range(2):
        hook(posted).send([], [], deque([notice()]))
    hook(posted).send([], [], deque([notice(told=Told.CLEARED, end=START)]))
    keys = [headers["idempotency-key"] for headers, _ in posted.received]
    assert keys[0] == keys[1] != keys[2]
    for headers, content in posted.received:
        own = hmac.new(b"of this test", content, hashlib.sha256).hexdigest()
        assert headers["x-otolith-signature"] == f"sha256={own}"
    assert json.loads(posted.received[0][1])["advice"] == "measure resistance and insulation"


@pytest.mark.parametrize(("status", "left"), [(500, 2), (503, 2), (429, 2), (302, 2), (401, 2), (404, 0), (422, 0)])
def test_what_is_refused_for_good_is_dropped_and_the_rest_tried_again(
    posted: WebhookRig, monkeypatch: pytest.MonkeyPatch, status: int, left: int
) -> None:
    def answer(handler: http.server.BaseHTTPRequestHandler, code: int, *_: object) -> None:
        handler.send_response_only(status)
        handler.send_header("location", f"http://127.0.0.1:{posted.port}/elsewhere")

    handler = "tests.sites.outlets.rigs._Posted.send_response"
    monkeypatch.setattr(handler, answer)
    waiting = deque([notice("a"), notice("b")])
    with pytest.raises(OutletError) as caught:
        hook(posted).send([], [], waiting)
    assert_says(str(caught.value), "127.0.0.1", str(status))
    assert len(waiting) == left
    assert caught.value.refused == 2 - left
    assert len(posted.received) == (1 if left else 2)  # no redirection is followed


@pytest.fixture
def mailbox(tmp_path: Path) -> Iterator[MailRig]:
    rig = MailRig(tmp_path)
    rig.start()
    yield rig
    rig.stop()


def mailing(rig: MailRig, language: Any = "en", title: str = "Works") -> mail.Mail:
    options = MailOutlet(host="127.0.0.1", port=rig.port, security="none", sender="site@works.example",
                         to=("shift@works.example", "night@works.example"))  # fmt: skip
    return mail.build(options, OutletSetup(rig.folder, title, language))


def test_an_e_mail_says_state_machine_what_since_when_and_what_to_do(mailbox: MailRig) -> None:
    mailing(mailbox).send(
        [], [], deque([notice(timezone="UTC"), notice("b", Level.WATCH, told=Told.CLEARED, end=START)])
    )
    (message,) = mailbox.messages()
    assert message["subject"] == "Works: ACT press-3: winding: short circuit between turns (+1)"
    body = message.get_content()
    for needle in ("2023-11-14 22:13:20 UTC", "What to do: measure resistance", "R_a 6.1 ohm", "OK press-3"):
        assert needle in body
    assert message["auto-submitted"] == "auto-generated"


def test_an_e_mail_is_in_the_language_of_the_site(mailbox: MailRig) -> None:
    own = notice()
    mailing(mailbox, "de").send([], [], deque([replace(own, event=event_in(own.event, "de"))]))
    (message,) = mailbox.messages()
    assert "HANDELN" in message["subject"]
    assert "Was zu tun ist" in message.get_content()


@given(hostile_text)
def test_no_text_adds_a_header_or_a_line(text: str) -> None:
    own = notice(condition=text, text=text, advice=text, part=text)
    options = MailOutlet(host="127.0.0.1", security="none", sender="a@b.example", to=("c@d.example",))
    message = mail.Mail(options, "", TLS, OutletSetup(Path(), text, "en"))._message([own])
    assert len(message.items()) == len({name for name, _ in message.items()}) == 9
    assert len(message.get_content().splitlines()) <= 5
    assert max(map(len, message.get_content().splitlines())) <= mail.MAX_LINE
    assert message.as_bytes()


def test_what_a_server_refuses_for_good_is_dropped(mailbox: MailRig, monkeypatch: pytest.MonkeyPatch) -> None:
    for code, left in ((554, 0), (451, 1)):
        waiting = deque([notice()])

        def refuse(*_: object, code: int = code, **__: object) -> None:
            raise smtplib.SMTPDataError(code, b"no")

        monkeypatch.setattr(smtplib.SMTP, "send_message", refuse)
        with pytest.raises(OutletError) as caught:
            mailing(mailbox).send([], [], waiting)
        assert len(waiting) == left
        assert caught.value.refused == 1 - left
