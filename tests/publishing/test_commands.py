"""A daemon carries out what a named sender commands, once, and nothing that anybody else sends."""

import base64
import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from otolith.adaptation.state import OperatorDecisions
from otolith.discovery.decision import Approval
from otolith.health.schema import ComponentDocument, ComponentStatus, EventDocument, NumberDocument
from otolith.machine_file import AccessTable, TlsTable, ZenohTable
from otolith.publishing import publisher, zenoh_session
from otolith.publishing.certificates import Identity, make_authority, make_certificate, utc_now
from otolith.publishing.commands.desk import MAX_COMMAND_AGE, MAX_COMMANDS, MAX_IDS, REFUSAL_PAUSE, CommandDesk
from otolith.publishing.commands.documents import MAX_COMMAND_BYTES, CommandDocument, CommandKind
from otolith.publishing.commands.signatures import CommandRefusedError, signed
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.reader_sessions import NotCarriedOutError, ReaderSessions
from otolith.publishing.zenoh_config import Access, Connection
from otolith.publishing.zenoh_session import COMMAND, REPORT
from otolith.storage.decisions import DecisionsFile
from otolith_drivers.errors import ConfigurationError
from tests.messages import raises_saying
from tests.sites.machines import own_endpoint, raised, report_of
from tests.storage.histories import MACHINE, SITE
from tests.waiting import PATIENCE, wait_for

LIMIT = raised()
SINE = LIMIT.model_copy(update={"id": "component/shaft/periodic@1700000000.0"})
AMPLITUDE = NumberDocument(value=0.004, sd=1e-4, low=0.0038, high=0.0042, unit="N m")
COMPONENT = ComponentDocument(
    id="shaft/periodic/t", site="shaft", meaning="torque on the shaft", mode="additive", family="periodic", input="t",
    equation="a*sin(b*t)", values={"amplitude": AMPLITUDE}, conditions="", domain="",
    status=ComponentStatus.ADOPTED, approval=Approval.OPEN,
    probability=0.99, onset=1.7e9,
)  # fmt: skip
REPORTED = report_of(events=(LIMIT, SINE)).model_copy(update={"components": (COMPONENT,)})
LATEST = REPORTED.to_json()


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority with certificates of a site and of a machine."""
    folder = tmp_path_factory.mktemp("keys")
    make_authority(folder, utc_now())
    for name in ("site", "press-3", "press-4"):
        make_certificate(folder, name, ["127.0.0.1"], utc_now())
    return folder


def identity(keys: Path, name: str = "site") -> Identity:
    return Identity(keys / "ca.crt", keys / f"{name}.crt", keys / f"{name}.key")


def command(kind: CommandKind = CommandKind.ACKNOWLEDGE, event: EventDocument = LIMIT, **own: Any) -> CommandDocument:
    given = {"id": uuid.uuid4().hex, "site": SITE, "machine": MACHINE, "by": "anna", "at": time.time()}
    return CommandDocument(**{**given, "kind": kind, "event": event.id, **own})


class Desk:
    """The desk of a machine, and its decisions."""

    def __init__(self, folder: Path, keys: Path, ahead: float = 0.0) -> None:
        """``ahead`` is by how much the wall clock is wrong, s; it may be set later."""
        self.file, self.keys, self.now, self.ahead = DecisionsFile(folder, SITE, MACHINE), keys, time.time(), ahead
        self.desk = CommandDesk(SITE, MACHINE, self.file, self.wall, lambda: self.now)
        self.now += 1.0

    def wall(self) -> float:
        return self.now + self.ahead

    def does(self, given: CommandDocument, sender: str = "site") -> bool:
        """Whether a command was new."""
        return self.takes(signed(given.model_copy(update={"at": self.wall()}), identity(self.keys, sender)))

    def takes(self, content: bytes) -> bool:
        return bool(json.loads(self.desk.take(content, self.keys / "ca.crt", ("site",), LATEST))["is_new"])

    @property
    def decisions(self) -> OperatorDecisions:
        return self.file.read()


@pytest.fixture
def desk(tmp_path: Path, keys: Path) -> Desk:
    return Desk(tmp_path / "state", keys)


def test_it_is_written_once_with_the_name_of_who_commands_it(desk: Desk, caplog: pytest.LogCaptureFixture) -> None:
    given = command()
    caplog.set_level(logging.INFO)
    assert desk.does(given)
    assert not desk.does(given)  # a double click
    (note,) = desk.decisions.notes
    assert (note.event, note.by, note.deed.value) == (LIMIT.id, "anna (site)", "acknowledge")
    assert "anna (site)" in caplog.text


@pytest.mark.parametrize("kind", [CommandKind.APPROVE, CommandKind.REJECT])
def test_a_component_is_decided_about_and_its_event_says_by_whom(desk: Desk, kind: CommandKind) -> None:
    desk.does(command(kind, SINE))
    approved, rejected = desk.decisions.approved, desk.decisions.rejected
    assert (approved, rejected) == ((frozenset({COMPONENT.id}), frozenset()) if kind == "approve" else
                                    (frozenset(), frozenset({COMPONENT.id})))  # fmt: skip
    (note,) = desk.decisions.notes
    assert (note.event, note.by) == (SINE.id, "anna (site)")
    assert COMPONENT.id in note.text


@pytest.mark.parametrize("second", [CommandKind.APPROVE, CommandKind.REJECT])
def test_the_first_decision_about_a_component_holds(desk: Desk, second: CommandKind) -> None:
    """Also if the daemon has not obeyed it yet: its report still has the component without a decision."""
    first = command(CommandKind.APPROVE, SINE)
    desk.does(first)
    decided = desk.decisions
    with raises_saying(CommandRefusedError, COMPONENT.id, "decided"):
        desk.does(command(second, SINE))
    assert not desk.does(first)  # a double click is no second decision
    assert desk.decisions == decided
    desk.file.write(OperatorDecisions(rejected=frozenset({COMPONENT.id})))  # by the command line
    with raises_saying(CommandRefusedError, COMPONENT.id, "decided"):
        desk.does(command(second, SINE))


Refused = Callable[[Desk], object]
REFUSED: dict[str, tuple[Refused, str]] = {
    "of a machine": (lambda desk: desk.does(command(), "press-4"), "may not send"),
    "of the machine itself": (lambda desk: desk.does(command(), "press-3"), "may not send"),
    "for another machine": (lambda desk: desk.does(command(machine="press-4")), "another machine"),
    "for another site": (lambda desk: desk.does(command(site="hall-2")), "another machine"),
    "about nothing": (lambda desk: desk.does(command(event=LIMIT.model_copy(update={"id": "limit/x@1.0"}))), "open"),
    "about no component": (lambda desk: desk.does(command(CommandKind.APPROVE)), "component"),
    "empty": (lambda desk: desk.takes(b""), "no signed command"),
    "no document": (lambda desk: desk.takes(b'{"command": 1}'), "no signed command"),
    "large": (lambda desk: desk.takes(b" " * (MAX_COMMAND_BYTES + 1)), "bytes"),
    "changed": (lambda desk: desk.takes(changed(desk, "anna", "evil")), "signature"),
    "of another key": (lambda desk: desk.takes(exchanged(desk)), "signature"),
    "of another authority": (lambda desk: desk.takes(forged(desk)), "authority"),
    "of an expired certificate": (lambda desk: desk.takes(expired(desk)), "not valid now"),
    "half a character": (lambda desk: desk.takes(changed(desk, "anna", "\\\\ud800")), "signature"),
}


def changed(desk: Desk, old: str, new: str) -> bytes:
    return signed(command(), identity(desk.keys)).replace(old.encode(), new.encode())


def exchanged(desk: Desk) -> bytes:
    """Signed by a machine, with the certificate of the site."""
    own = json.loads(signed(command(), identity(desk.keys, "press-4")))
    return json.dumps(own | {"certificate": (desk.keys / "site.crt").read_text()}).encode()


def forged(desk: Desk) -> bytes:
    folder = desk.file.path.parent.parent / "forged"
    make_authority(folder, utc_now())
    make_certificate(folder, "site", [], utc_now())
    return signed(command(), identity(folder))


def expired(desk: Desk) -> bytes:
    content = signed(command(), identity(desk.keys))
    desk.now += timedelta(days=3000).total_seconds()
    return content


@pytest.mark.parametrize("name", REFUSED)
def test_nobody_else_is_obeyed(desk: Desk, name: str) -> None:
    (refused, reason), now = REFUSED[name], desk.now
    with raises_saying(CommandRefusedError, reason):
        refused(desk)
    desk.now = now
    assert desk.decisions == OperatorDecisions()
    assert desk.does(command())  # it still obeys those who may


@pytest.mark.parametrize("age", [MAX_COMMAND_AGE + 1.0, -MAX_COMMAND_AGE - 1.0])
def test_an_old_command_and_one_of_a_wrong_clock_are_refused(desk: Desk, age: float) -> None:
    desk.now += 100.0
    with raises_saying(CommandRefusedError, "clocks"):
        desk.takes(signed(command(at=desk.now - age), identity(desk.keys)))


def test_a_command_that_is_sent_again_later_is_never_carried_out_again(desk: Desk) -> None:
    """Neither after a restart, nor if the clock was set back, nor after more commands than are remembered."""
    first = command(at=desk.now)
    content = signed(first, identity(desk.keys))
    assert desk.takes(content)
    again = CommandDesk(SITE, MACHINE, desk.file, desk.wall, lambda: desk.now)
    with raises_saying(CommandRefusedError, "before the daemon started"):
        again.take(content, desk.keys / "ca.crt", ("site",), LATEST)
    for _ in range(MAX_IDS):
        desk.now += 4.0
        desk.file.write(OperatorDecisions())
        desk.desk._remember(command(at=desk.now))
    desk.ahead = first.at - desk.now
    with raises_saying(CommandRefusedError, "before the daemon started"):
        desk.takes(content)
    assert not desk.decisions.notes


@pytest.mark.parametrize("ahead", [-36_000.0, 36_000.0], ids=["behind", "ahead"])
def test_a_clock_that_is_corrected_after_the_start_admits_nothing_old_and_shuts_nobody_out(
    tmp_path: Path, keys: Path, ahead: float
) -> None:
    desk = Desk(tmp_path / "state", keys, ahead)
    recorded = signed(command(at=desk.now - 5.0), identity(keys))
    desk.ahead = 0.0
    with raises_saying(CommandRefusedError, "before the daemon started"):
        desk.takes(recorded)
    assert desk.decisions == OperatorDecisions()
    assert desk.does(command())


def test_more_commands_than_persons_give_are_refused_for_a_while(desk: Desk) -> None:
    for _ in range(MAX_COMMANDS):
        assert desk.does(command())
    with raises_saying(CommandRefusedError, "later"):
        desk.does(command())
    desk.now += 61.0
    assert desk.does(command())


def test_refusals_fill_no_log(desk: Desk, caplog: pytest.LogCaptureFixture) -> None:
    for _ in range(50):
        with pytest.raises(CommandRefusedError):
            desk.takes(b"")
    assert len(caplog.records) == 1


def test_commands_that_cannot_be_carried_out_fill_no_log_and_refusals_hide_none(
    desk: Desk, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(CommandRefusedError):
        desk.takes(b"")
    for _ in range(50):
        with raises_saying(CommandRefusedError, "log"):
            desk.desk.take(b"", desk.keys / "missing.crt", ("site",), LATEST)
    assert ["missing.crt" in each.getMessage() for each in caplog.records] == [False, True]
    desk.now += REFUSAL_PAUSE
    with pytest.raises(CommandRefusedError):
        desk.desk.take(b"", desk.keys / "missing.crt", ("site",), LATEST)
    assert len(caplog.records) == 3


@pytest.fixture
def daemon(tmp_path: Path, keys: Path) -> Iterator[Callable[..., tuple[ReaderSessions, DecisionsFile]]]:
    """Function that starts a daemon with access rules, and returns a reader of it and its decisions."""
    opened = ExitStack()

    def started(**rules: Any) -> tuple[ReaderSessions, DecisionsFile]:
        endpoint, file = own_endpoint(), DecisionsFile(tmp_path / "state", SITE, MACHINE)
        tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press-3.crt"), key=Path("press-3.key"))
        access = Access(ZenohTable(tls=tls, access=AccessTable(**rules)), keys / "machine.toml")
        published = Publisher([Published(SITE, MACHINE, None, file)], [endpoint], access)
        reader = ReaderSessions(Connection((endpoint,)), (REPORT,), lambda _: None)
        opened.enter_context(closing(published))
        opened.enter_context(closing(reader))
        reader.start()
        wait_for(lambda: bool(reader.where(f"otolith/{SITE}/{MACHINE}")))
        published.publish(REPORTED)
        return reader, file

    with opened:
        yield started


def test_a_command_comes_over_zenoh_and_its_refusal_is_told(
    daemon: Callable[..., tuple[ReaderSessions, DecisionsFile]], keys: Path
) -> None:
    reader, file = daemon(commands=("site",))
    key, given = COMMAND.under(SITE, MACHINE), command()
    for is_new in (True, False):
        answer = json.loads(reader.command(key, signed(given, identity(keys))))
        assert answer == {"id": given.id, "is_new": is_new}
    assert [note.by for note in file.read().notes] == ["anna (site)"]
    with raises_saying(NotCarriedOutError, "may not send"):
        reader.command(key, signed(command(), identity(keys, "press-4")))
    with raises_saying(NotCarriedOutError, "no signed command"):
        reader.command(key, base64.b64encode(b"x"))


def test_readers_of_the_history_delay_no_command(
    daemon: Callable[..., tuple[ReaderSessions, DecisionsFile]], keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever may read may ask for as much of the history as it has, in a loop."""
    asked, released = threading.Event(), threading.Event()

    def answered(*_: object, **__: object) -> None:
        asked.set()
        released.wait(PATIENCE)

    monkeypatch.setattr(publisher, "answer", answered)
    reader, _ = daemon(commands=("site",))
    asking = threading.Thread(target=reader.get, args=(f"{REPORT.under(SITE, MACHINE)}?last=1000",))
    asking.start()
    try:
        assert asked.wait(PATIENCE)
        given = command()
        assert json.loads(reader.command(COMMAND.under(SITE, MACHINE), signed(given, identity(keys))))["is_new"]
    finally:
        released.set()
        asking.join()


def test_who_sends_one_command_too_many_is_told_so(
    daemon: Callable[..., tuple[ReaderSessions, DecisionsFile]], keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_session, "MAX_WAIT", -1.0)  # all have waited for too long
    reader, file = daemon(commands=("site",))
    with raises_saying(NotCarriedOutError, "commands", "again"):
        reader.command(COMMAND.under(SITE, MACHINE), signed(command(), identity(keys)))
    assert not file.path.exists()


def test_by_default_nothing_takes_commands(
    daemon: Callable[..., tuple[ReaderSessions, DecisionsFile]], keys: Path
) -> None:
    reader, file = daemon()
    with pytest.raises(NotCarriedOutError):
        reader.command(COMMAND.under(SITE, MACHINE), signed(command(), identity(keys)))
    assert not file.path.exists()


def test_who_may_command_needs_an_authority(tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    path.write_text('[zenoh.access]\ncommands = ["site"]\n', encoding="utf-8")
    access = Access(ZenohTable(access=AccessTable(commands=("site",))), path)
    with raises_saying(ConfigurationError, "[zenoh.tls]", "command"):
        access.settings(["otolith/s/m"], ["unixsock-stream//tmp/x"])


def test_a_certificate_that_is_no_longer_valid_signs_nothing(tmp_path: Path) -> None:
    make_authority(tmp_path, utc_now())
    make_certificate(tmp_path, "site", [], datetime.now(UTC) - timedelta(days=900))
    with raises_saying(ConfigurationError, "expired"):
        signed(command(), identity(tmp_path))
