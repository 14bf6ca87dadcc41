"""What every outlet does: it tells each change once, waits for who is away, and delays nobody."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import pytest

from otolith.health.limits import Level
from otolith.health.schema import EventDocument
from otolith.site.collector import Collector
from otolith.site.known import Knowledge
from otolith.site.outlets import runner
from otolith.site.outlets.base import OutletSetup
from otolith.site.outlets.runner import OutletRunner
from otolith.site.outlets.table import OUTLETS, runners_of
from otolith.site.settings import load_site
from otolith_drivers.errors import ConfigurationError
from tests.hostile import HOSTILE
from tests.messages import assert_says
from tests.sites.machines import raised, report_of, sent
from tests.sites.outlets.rigs import RIGS, Rig
from tests.variants import often
from tests.waiting import wait_for, within

TEXTS = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 1000]


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "TICK", 0.05)
    monkeypatch.setattr(runner, "FIRST_PAUSE", 0.05)
    monkeypatch.setattr(runner, "MAX_PAUSE", 0.2)


class Works:
    """What a collector has: machines that tests let report."""

    def __init__(self) -> None:
        self.knowledge, self.lock, self._number = Knowledge(), threading.Lock(), 0

    def report(
        self, machine: str, state: Level = Level.OK, events: tuple[EventDocument, ...] = (), **more: Any
    ) -> None:
        """Let a machine report."""
        self._number += 1
        own = report_of(machine, self._number, time.time(), state=state, events=events)
        with self.lock:
            assert self.knowledge.take(*sent(own.model_copy(update=more)), time.time()) is not None


def runner_of(rig: Rig, works: Works, more: str = "") -> OutletRunner:
    name = next(name for name, kind in RIGS.items() if isinstance(rig, kind))
    file = rig.folder / "site.toml"
    file.write_text(f"[outlets.{name}]\n{rig.table()}\n{more}", encoding="utf-8")
    settings, source = load_site(file)
    setup = OutletSetup(rig.folder, "Works", "en")
    (made,) = runners_of(settings.outlets, setup, cast("Collector", works), source)
    return made


@contextmanager
def passing_on(rig: Rig, works: Works, more: str = "") -> Iterator[OutletRunner]:
    made = runner_of(rig, works, more)
    made.start()
    try:
        yield made
    finally:
        made.stop()


@pytest.fixture(params=often([name for name in OUTLETS if name != "opcua"], OUTLETS))  # its address space takes seconds
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    made = RIGS[request.param](tmp_path)
    yield made
    made.stop()


def of_event(key: str, state: Level, **update: Any) -> EventDocument:
    return raised(state, time.time()).model_copy(update={"id": key, **update})


def test_each_change_is_told_once_and_each_state_is_shown(rig: Rig) -> None:
    works = Works()
    rig.start()
    with passing_on(rig, works):
        watch = of_event("limit/R_a@1", Level.WATCH)
        act = watch.model_copy(update={"state": Level.ACT})
        works.report("press-1")
        works.report("press-2", Level.WATCH, (watch,))
        wait_for(lambda: rig.events() in (None, [("press-2", "raised")]))
        works.report("press-2", Level.WATCH, (watch,))
        works.report("press-2", Level.ACT, (act.model_copy(update={"since": time.time()}),))
        wait_for(lambda: rig.events() is None or len(rig.events() or ()) == 2)
        if rig.states() is not None:
            wait_for(lambda: rig.states() == {"press-1": "OK", "press-2": "ACT"})
        works.report("press-2", Level.OK, (act.model_copy(update={"end": time.time()}),))
        wait_for(lambda: rig.events() is None or len(rig.events() or ()) == 3)
        if rig.states() is not None:
            wait_for(lambda: rig.states() == {"press-1": "OK", "press-2": "OK"})
        works.report("press-2")
        time.sleep(0.5)
        if (told := rig.events()) is not None:
            assert [machine for machine, _ in told] == ["press-2"] * 3
            assert (told[0][1], told[2][1]) == ("raised", "cleared")
        assert rig.states() in (None, {"press-1": "OK", "press-2": "OK"})


def test_who_comes_later_gets_what_is_known_and_each_event_once(rig: Rig) -> None:
    works = Works()
    rig.prevent()
    with passing_on(rig, works) as running:
        works.report("press-1", Level.ACT, (of_event("a", Level.ACT),))
        wait_for(lambda: running.status.failures >= 1)
        assert not running.status.is_up
        assert running.status.reason
        rig.start()
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: rig.events() in (None, [("press-1", "raised")]))
        assert rig.states() in (None, {"press-1": "ACT"})


def test_a_restart_tells_no_old_event_again(rig: Rig) -> None:
    works = Works()
    rig.start()
    old = of_event("old", Level.ACT, start=1.0, since=1.0)
    works.report("press-1", Level.ACT, (old, of_event("new", Level.WATCH)))
    with passing_on(rig, works) as running:
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: bool(rig.events() is None or rig.events()))
        time.sleep(0.3)
        assert rig.events() in (None, [("press-1", "raised")])


def test_hints_and_what_is_shelved_are_told_to_nobody(rig: Rig) -> None:
    works = Works()
    rig.start()
    note = {"by": "a", "at": 1.0, "text": "later", "until": time.time() + 600.0}
    shelved = of_event("shelved", Level.ACT).model_dump(mode="json") | {"shelved": note}
    own = (of_event("hint", Level.HINT), EventDocument.model_validate(shelved), of_event("new", Level.WATCH))
    works.report("press-1", Level.WATCH, own)
    with passing_on(rig, works) as running:
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: bool(rig.events() is None or rig.events()))
        time.sleep(0.3)
        assert rig.events() in (None, [("press-1", "raised")])


def test_who_accepts_and_never_answers_delays_nobody(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "CLOSING", 1.0)
    works = Works()
    works.report("press-1", Level.ACT, (of_event("a", Level.ACT),))
    with socket.create_server(("127.0.0.1", rig.port)), passing_on(rig, works):
        time.sleep(0.5)
        assert works.lock.acquire(timeout=within(0.2))
        works.lock.release()
        begun = time.monotonic()
    assert time.monotonic() - begun <= within(2.0)


def test_texts_from_outside_are_passed_on_as_texts(rig: Rig) -> None:
    works = Works()
    rig.start()
    events = tuple(of_event(f"e{index}", Level.ACT, part=text, condition=text, text=text, advice=text, cause=text)
                   for index, text in enumerate(TEXTS))  # fmt: skip
    parameter = report_of().parameters["R_a"]
    rows = {text: parameter.model_copy(update={"unit": text}) for text in TEXTS}
    with passing_on(rig, works) as running:
        works.report("press-1", Level.ACT, events, parameters=rows, twin=TEXTS[8])
        wait_for(lambda: running.status.is_up and running.status.sent >= len(TEXTS))
        assert running.status.failures == 0
        wait_for(lambda: rig.events() is None or {machine for machine, _ in rig.events() or ()} == {"press-1"})
        assert rig.states() in (None, {"press-1": "ACT"})


def test_no_more_is_told_than_the_limit_allows_and_the_rest_is_counted(rig: Rig) -> None:
    works = Works()
    rig.start()
    events = [of_event(f"e{index}", Level.ACT if index % 5 == 0 else Level.WATCH) for index in range(40)]
    with passing_on(rig, works, "per_hour = 8") as running:
        works.report("press-1", Level.ACT, tuple(events))
        wait_for(lambda: running.status.is_up and running.status.sent >= 8)
        time.sleep(0.3)
        assert running.status.sent == 8
        assert running.status.lost == 32
        wait_for(lambda: rig.events() is None or len(rig.events() or ()) == 8)


@pytest.mark.parametrize("content", [None, b"", b"\nsecret\n", b" \t\n"])
def test_a_secret_that_is_missing_or_empty_is_named(rig: Rig, content: bytes | None) -> None:
    works, tables = Works(), {"mqtt": ('user = "a"', "password_file"), "mail": ('user = "a"', "password_file"),
                              "webhook": ("", "secret_file"),
                              "opcua": ('user = "a"', "password_file")}  # fmt: skip
    name = next(name for name, kind in RIGS.items() if isinstance(rig, kind))
    lines, key = tables[name]
    more = f'{lines}\n{key} = "nowhere"'
    if content is not None:
        (rig.folder / "nowhere").write_bytes(content)
        (rig.folder / "nowhere").chmod(0o600)
    own = "\n".join(line for line in rig.table().splitlines() if not line.startswith((key, "security")))
    rig.table = lambda: own  # type: ignore[method-assign]
    with pytest.raises(ConfigurationError) as caught:
        runner_of(rig, works, more)
    assert_says(str(caught.value), "site.toml", f"outlets.{name}", "nowhere", *([] if content is None else [key]))


def test_each_outlet_has_a_rig() -> None:
    assert set(RIGS) == set(OUTLETS)
