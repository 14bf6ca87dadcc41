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
from otolith.outlet_tables import MachineOutlets, OutletsTable
from otolith.site.known import Knowledge
from otolith.site.outlets import runner
from otolith.site.outlets.base import OutletSetup
from otolith.site.outlets.process import DaemonOutlets, places
from otolith.site.outlets.runner import OutletRunner
from otolith.site.outlets.table import OUTLETS, runners_of, running
from otolith.site.serving.counts import Counts
from otolith.site.settings import load_site
from otolith_drivers.config_files import parse, read, validate
from otolith_drivers.errors import ConfigurationError
from tests.hostile import HOSTILE
from tests.messages import assert_says
from tests.sites.machines import raised, report_of, sent
from tests.sites.outlets.rigs import RIGS, Rig
from tests.storage.histories import SITE
from tests.variants import often
from tests.waiting import wait_for, within

TEXTS = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 1000]


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "TICK", 0.05)
    monkeypatch.setattr(runner, "FIRST_PAUSE", 0.05)
    monkeypatch.setattr(runner, "MAX_PAUSE", 0.2)


class Works:
    """Machines that tests let report, and what passes them on: a site, which has collected them."""

    def __init__(self, rig: Rig) -> None:
        self.rig, self.lock, self._number = rig, threading.Lock(), 0
        self.knowledge, self.dropped, self.connected = Knowledge(), dict[str, int](), True
        self.hindered = Counts()

    def report(
        self, machine: str, state: Level = Level.OK, events: tuple[EventDocument, ...] = (), **more: Any
    ) -> None:
        """Let a machine report."""
        self._number += 1
        own = report_of(machine, self._number, time.time(), state=state, events=events)
        self.take(*sent(own.model_copy(update=more)))

    def take(self, key: str, content: bytes) -> None:
        """Take a report."""
        with self.lock:
            assert self.knowledge.take(key, content, time.time()) is not None

    def table(self, more: str) -> str:
        """The table of the outlet."""
        return f"[outlets.{self.rig.name}]\n{self.rig.table()}\n{more}"

    @contextmanager
    def passing_on(self, more: str = "") -> Iterator[OutletRunner]:
        """Pass on what machines report."""
        file = self.rig.folder / "site.toml"
        file.write_text(self.table(more), encoding="utf-8")
        settings, source = load_site(file)
        made = runners_of(settings.outlets, OutletSetup(self.rig.folder, "Works", "en", known=self), self, source)
        with running(made):
            yield made[0]


class DaemonWorks(Works):
    """The same of a daemon, whose machines have the table in their files."""

    def __init__(self, rig: Rig) -> None:
        super().__init__(rig)
        self.outlets, self._early = DaemonOutlets(), cast("list[tuple[str, bytes]] | None", [])
        self.lock = self.outlets.lock

    def take(self, key: str, content: bytes) -> None:
        """Send a report to the process of the outlets, once it has the tables of the machine."""
        if self._early is None:
            self.outlets.take("/".join(key.split("/")[1:3]), (0, content))
        else:
            self._early.append((key, content))

    @contextmanager
    def passing_on(self, more: str = "") -> Iterator[OutletRunner]:
        """Pass on what machines report."""
        file = self.rig.folder / "machine.toml"
        file.write_text(self.table(more), encoding="utf-8")
        source = read(file)
        table = validate(parse(source)["outlets"], OutletsTable, source, ("outlets",))
        own = [MachineOutlets(SITE, name, file, table) for name in ("press-1", "press-2")]
        places(own[0], source)
        with self.outlets:
            for machine in own:
                self.outlets.take(machine.key, machine)
            early, self._early = self._early, None
            for key, content in early or ():
                self.take(key, content)
            (made,) = self.outlets.runners
            yield made


PLACES = {"site": Works, "daemon": DaemonWorks}
ROWS = [(name, place) for name in OUTLETS for place in PLACES]
SLOW = {"opcua"}  # Its address space takes seconds


@pytest.fixture(
    params=often([row for row in ROWS if row[0] not in SLOW and (row[1] == "site") != (row[0] == "prometheus")], ROWS),
    ids="-".join,
)
def works(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Works]:
    name, place = request.param
    rig = RIGS[name](tmp_path)
    yield PLACES[place](rig)
    rig.stop()


@pytest.fixture
def rig(works: Works) -> Rig:
    return works.rig


def of_event(key: str, state: Level, **update: Any) -> EventDocument:
    return raised(state, time.time()).model_copy(update={"id": key, **update})


def test_each_change_is_told_once_and_each_state_is_shown(works: Works, rig: Rig) -> None:
    rig.start()
    with works.passing_on():
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


def test_who_comes_later_gets_what_is_known_and_each_event_once(works: Works, rig: Rig) -> None:
    rig.prevent()
    with works.passing_on() as running:
        works.report("press-1", Level.ACT, (of_event("a", Level.ACT),))
        wait_for(lambda: running.status.failures >= 1)
        assert not running.status.is_up
        assert running.status.reason
        rig.start()
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: rig.events() in (None, [("press-1", "raised")]))
        assert rig.states() in (None, {"press-1": "ACT"})


def test_a_restart_tells_no_old_event_again(works: Works, rig: Rig) -> None:
    rig.start()
    old = of_event("old", Level.ACT, start=1.0, since=1.0)
    works.report("press-1", Level.ACT, (old, of_event("new", Level.WATCH)))
    with works.passing_on() as running:
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: bool(rig.events() is None or rig.events()))
        time.sleep(0.3)
        assert rig.events() in (None, [("press-1", "raised")])


def test_hints_and_what_is_shelved_are_told_to_nobody(works: Works, rig: Rig) -> None:
    rig.start()
    note = {"by": "a", "at": 1.0, "text": "later", "until": time.time() + 600.0}
    shelved = of_event("shelved", Level.ACT).model_dump(mode="json") | {"shelved": note}
    own = (of_event("hint", Level.HINT), EventDocument.model_validate(shelved), of_event("new", Level.WATCH))
    works.report("press-1", Level.WATCH, own)
    with works.passing_on() as running:
        wait_for(lambda: running.status.is_up)
        wait_for(lambda: bool(rig.events() is None or rig.events()))
        time.sleep(0.3)
        assert rig.events() in (None, [("press-1", "raised")])


def test_who_accepts_and_never_answers_delays_nobody(works: Works, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "CLOSING", 1.0)
    works.report("press-1", Level.ACT, (of_event("a", Level.ACT),))
    with socket.create_server(("127.0.0.1", rig.port)), works.passing_on():
        time.sleep(0.5)
        assert works.lock.acquire(timeout=within(0.2))
        works.lock.release()
        begun = time.monotonic()
    assert time.monotonic() - begun <= within(2.0)


def test_texts_from_outside_are_passed_on_as_texts(works: Works, rig: Rig) -> None:
    rig.start()
    events = tuple(of_event(f"e{index}", Level.ACT, part=text, condition=text, text=text, advice=text, cause=text)
                   for index, text in enumerate(TEXTS))  # fmt: skip
    parameter = report_of().parameters["R_a"]
    rows = {text: parameter.model_copy(update={"unit": text}) for text in TEXTS}
    with works.passing_on() as running:
        works.report("press-1", Level.ACT, events, parameters=rows, twin=TEXTS[8])
        wait_for(lambda: running.status.is_up and running.status.sent >= len(TEXTS) * rig.tells)
        assert running.status.failures == 0
        wait_for(lambda: rig.events() is None or {machine for machine, _ in rig.events() or ()} == {"press-1"})
        assert rig.states() in (None, {"press-1": "ACT"})


def test_no_more_is_told_than_the_limit_allows_and_the_rest_is_counted(works: Works, rig: Rig) -> None:
    rig.start()
    events = [of_event(f"e{index}", Level.ACT if index % 5 == 0 else Level.WATCH) for index in range(40)]
    with works.passing_on("per_hour = 8" if rig.tells else "") as running:
        works.report("press-1", Level.ACT, tuple(events))
        wait_for(lambda: running.status.is_up and running.status.sent >= 8 * rig.tells)
        time.sleep(0.3)
        assert running.status.sent == 8 * rig.tells
        assert running.status.lost == 32 * rig.tells
        wait_for(lambda: rig.events() is None or len(rig.events() or ()) == 8)


@pytest.mark.parametrize("content", [None, b"", b"\nsecret\n", b" \t\n"])
def test_a_secret_that_is_missing_or_empty_is_named(works: Works, rig: Rig, content: bytes | None) -> None:
    user = 'user = "a"', "password_file"
    tables = {"webhook": ("", "secret_file"), **dict.fromkeys(("mqtt", "sparkplug", "mail", "opcua"), user)}
    if rig.name not in tables:
        return
    lines, key = tables[rig.name]
    more = f'{lines}\n{key} = "nowhere"'
    if content is not None:
        (rig.folder / "nowhere").write_bytes(content)
        (rig.folder / "nowhere").chmod(0o600)
    own = "\n".join(line for line in rig.table().splitlines() if not line.startswith((key, "security")))
    rig.table = lambda: own  # type: ignore[method-assign]
    with pytest.raises(ConfigurationError) as caught, works.passing_on(more):
        pass
    assert_says(str(caught.value), ".toml", f"outlets.{rig.name}", "nowhere", *([] if content is None else [key]))


def test_each_outlet_has_a_rig() -> None:
    assert set(RIGS) == set(OUTLETS)
