"""Who may read and who may publish: forgers, ghosts, eavesdroppers and floods are refused, and readers lose nothing."""

import functools
import json
import os
import resource
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
import zenoh

from otolith.machine_file import AccessTable, TlsTable, ZenohTable
from otolith.publishing.certificates import make_authority, make_certificate, utc_now
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import (
    MAX_HALF_OPEN,
    TLS,
    Access,
    Credentials,
    listening,
    reader_settings,
)
from otolith.publishing.zenoh_session import ALIVE, session
from tests.conftest import free_port
from tests.health.test_events import report
from tests.publishing import attacker
from tests.waiting import PATIENCE, wait_for

STRANGER = 65533  # a user of no group
ZENOHS_TIMEOUT = 11.0  # s: longer than its default for a TLS handshake
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")


FIRST = report(0, 6.5)
EXPECTED = [report(index, 6.5).to_json() for index in range(1, 6)]


def tcp() -> str:
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"


class Reader:
    """A subscriber in this process: what it receives of reports, and which machines are alive."""

    def __init__(self, endpoint: str, credentials: Credentials | None = None, mode: str = "peer") -> None:
        settings = {**reader_settings(credentials or Credentials(), [endpoint]), "mode": mode}
        self.session = session(connect=[endpoint], settings=settings)
        self.texts: list[str] = []
        self.alive: list[str] = []
        self.session.declare_subscriber(attacker.KEY, self._receive)
        self.session.liveliness().declare_subscriber(
            "otolith/**", lambda sample: self.alive.append(str(sample.key_expr)), history=True
        )

    def _receive(self, sample: zenoh.Sample) -> None:
        self.texts.append(sample.payload.to_string() if sample.kind == zenoh.SampleKind.PUT else attacker.FORGED)

    def _has(self, text: str) -> bool:
        return text in self.texts

    def queried(self) -> list[str]:
        """All answers to a query for the reports of all machines."""
        replies = self.session.get("otolith/*/*/report", target=zenoh.QueryTarget.ALL, timeout=PATIENCE)
        return [reply.ok.payload.to_string() for reply in replies if reply.ok is not None]

    def receives(self, publisher: Publisher, count: int = 5) -> list[str]:
        """What arrives while ``count`` reports are published, each after the one before has arrived."""

        def has_subscribed() -> bool:
            publisher.publish(FIRST)
            return bool(self.texts)

        wait_for(has_subscribed)
        del self.texts[:]
        for index in range(1, count + 1):
            document = report(index, 6.5)
            publisher.publish(document)
            wait_for(functools.partial(self._has, document.to_json()))
        return [text for text in self.texts if text != FIRST.to_json()]


@contextmanager
def attack(
    endpoint: str, settings: dict[str, Any] | None = None, uid: int = 0, opens: bool = False, answers: bool = False
) -> Iterator[Callable[[], list[str] | None]]:
    """Attack from another process; the function ends it and returns what it received, None if it was refused.

    A refusal costs a moment's wait; a session that ``opens``, and one that ``answers``, has as long as a busy computer
    needs.
    """
    given: dict[str, Any] = {"connect": endpoint, "settings": settings or {}, "uid": uid}
    given |= {"opening": PATIENCE} if opens or answers else {}
    given |= {"answering": PATIENCE} if answers else {}
    process = subprocess.Popen(
        [sys.executable, attacker.__file__, json.dumps(given)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with process:
        assert process.stdout is not None
        first = process.stdout.readline().strip()
        assert first in {"refused", "attacked"}

        def received() -> list[str] | None:
            rest, _ = process.communicate()
            return None if first == "refused" else list(json.loads(rest))

        try:
            yield received
        finally:
            process.kill()


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def publisher(stack: ExitStack, endpoint: str, access: Access = Access()) -> Publisher:  # noqa: B008 - immutable
    opened = Publisher([Published("s", "m")], [endpoint], access)
    stack.callback(opened.close)
    return opened


def reader(stack: ExitStack, endpoint: str, credentials: Credentials | None = None) -> Reader:
    opened = Reader(endpoint, credentials)
    stack.callback(opened.session.close)
    return opened


def test_the_attack_succeeds_against_a_session_without_access_control(stack: ExitStack) -> None:
    """Otherwise the other tests would prove nothing."""
    endpoint = tcp()
    stack.callback(session(listen=[endpoint]).close)
    victim = reader(stack, endpoint)
    with attack(endpoint, answers=True):
        wait_for(lambda: f"{attacker.GHOST}/alive" in victim.alive)
        wait_for(lambda: victim.queried() == [attacker.FORGED])


def test_nobody_but_the_daemon_publishes_under_its_keys(stack: ExitStack) -> None:
    endpoint = tcp()
    daemon = publisher(stack, endpoint)
    victim = reader(stack, endpoint)
    victim.receives(daemon)
    with attack(endpoint, answers=True) as received:
        texts = victim.receives(daemon)
        latest = victim.queried()
        assert received()  # everybody may read on this computer
    texts += victim.receives(daemon)
    assert texts == 2 * EXPECTED
    assert latest == EXPECTED[-1:]
    assert victim.alive == [ALIVE.under("s", "m")]


@as_root
def test_another_user_cannot_open_the_socket(stack: ExitStack) -> None:
    (endpoint,) = listening(["local"], "s.m")
    path = Path(endpoint.removeprefix("unixsock-stream/"))
    daemon = publisher(stack, endpoint)
    assert path.stat().st_mode & 0o777 == 0o660
    for folder in (path.parent, path.parent.parent):
        folder.chmod(0o755)  # so that the socket alone is in the way
    own = reader(stack, endpoint)
    with attack(endpoint, uid=STRANGER) as received:
        assert received() is None
    assert own.receives(daemon) == EXPECTED
    os.chown(path, -1, STRANGER)  # its group
    with attack(endpoint, uid=STRANGER, answers=True) as received:
        own.receives(daemon)
        assert received()


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the certificates of a daemon and two readers, and those of another site."""
    for folder in ("site", "other"):
        make_authority(tmp_path / folder, utc_now())
        make_certificate(tmp_path / folder, "press", ["localhost", "127.0.0.1"], utc_now())
        make_certificate(tmp_path / folder, "operator", [], utc_now())
    make_certificate(tmp_path / "site", "visitor", [], utc_now())
    return tmp_path


def client(site: Path, name: str, ca: str = "site", own: str = "site") -> Credentials:
    return Credentials(site / ca / "ca.crt", site / own / f"{name}.crt", site / own / f"{name}.key")


def test_only_readers_with_a_certificate_read_over_the_network(stack: ExitStack, site: Path) -> None:
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    table = ZenohTable(tls=tls, access=AccessTable(readers=("operator",)))
    daemon = publisher(stack, endpoint, Access(table, site / "site" / "machine.toml"))
    own = reader(stack, endpoint, client(site, "operator"))
    own.receives(daemon)
    no_certificate = reader_settings(Credentials(site / "site" / "ca.crt"), [endpoint])
    rogue = {**reader_settings(client(site, "operator", own="other", ca="other"), [endpoint])}
    rogue[TLS] = {**dict(rogue[TLS]), "root_ca_certificate": str(site / "site" / "ca.crt")}  # type: ignore[call-overload]  # a setting may be of any type
    visitor = reader_settings(client(site, "visitor"), [endpoint])
    refused: list[tuple[str, dict[str, object]]] = [
        (endpoint, no_certificate),
        (endpoint, rogue),
        (endpoint.replace("tls/localhost", "tcp/127.0.0.1"), {}),
    ]
    for address, settings in refused:
        with attack(address, settings) as received:
            assert received() is None
    with attack(endpoint, visitor, opens=True) as received:  # the session opens, but nothing passes
        own.receives(daemon)
        assert received() == []
    assert own.receives(daemon) == EXPECTED
    assert own.alive == [ALIVE.under("s", "m")]


def test_a_reader_refuses_a_daemon_of_another_site(stack: ExitStack, site: Path) -> None:
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"), clients=False)
    publisher(stack, endpoint, Access(ZenohTable(tls=tls), site / "other" / "machine.toml"))
    with attack(endpoint, reader_settings(Credentials(site / "site" / "ca.crt"), [endpoint])) as received:
        assert received() is None


def test_only_users_with_their_password_read(stack: ExitStack, tmp_path: Path) -> None:
    users, login = tmp_path / "users", tmp_path / "login"
    users.write_text("operator:correct\nvisitor:also\n", encoding="utf-8")
    login.write_text("operator:correct\n", encoding="utf-8")
    for path in (users, login):
        path.chmod(0o600)
    endpoint = tcp()
    table = ZenohTable(access=AccessTable(passwords=users, readers=("operator",)))
    daemon = publisher(stack, endpoint, Access(table, tmp_path / "machine.toml"))
    own = reader(stack, endpoint, Credentials(login=login))
    own.receives(daemon)
    for user, password in (("operator", "wrong"), ("nobody", "correct"), (None, None)):
        settings = {"transport/auth/usrpwd": {"user": user, "password": password}} if user else {}
        with attack(endpoint, settings) as received:
            assert received() is None
    with attack(endpoint, {"transport/auth/usrpwd": {"user": "visitor", "password": "also"}}, opens=True) as received:
        own.receives(daemon)
        assert received() == []
    assert own.receives(daemon) == EXPECTED


def test_reports_pass_a_router(stack: ExitStack) -> None:
    """It sends the daemon the subscriptions and queries of its own clients."""
    endpoint = tcp()
    stack.callback(session([endpoint], settings={"mode": "router"}).close)
    daemon = Publisher([Published("s", "m")], [], Access(ZenohTable(listen=(), connect=(endpoint,))))
    stack.callback(daemon.close)
    client = Reader(endpoint, mode="client")
    stack.callback(client.session.close)
    assert client.receives(daemon) == EXPECTED
    assert client.queried() == EXPECTED[-1:]
    assert client.alive == [ALIVE.under("s", "m")]


@pytest.mark.parametrize("protocol", ["tcp", "tls"])
def test_half_open_connections_do_not_keep_readers_out(stack: ExitStack, site: Path, protocol: str) -> None:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    stack.callback(resource.setrlimit, resource.RLIMIT_NOFILE, limits)
    usual = (1024 if protocol == "tls" else limits[0], limits[1])  # the clients of this test are in the same process
    resource.setrlimit(resource.RLIMIT_NOFILE, usual)
    endpoint = f"{protocol}/localhost:{free_port(socket.SOCK_STREAM)}"
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    daemon = publisher(stack, endpoint, Access(ZenohTable(tls=tls), site / "site" / "machine.toml"))
    port = int(endpoint.rpartition(":")[2])
    for _ in range(MAX_HALF_OPEN + 400):
        half_open = stack.enter_context(socket.socket())
        half_open.settimeout(1.0)
        with suppress(TimeoutError, ConnectionError):
            half_open.connect(("127.0.0.1", port))
    late = reader(stack, endpoint, client(site, "operator"))
    assert late.receives(daemon) == EXPECTED


@pytest.mark.full
def test_half_open_handshakes_do_not_keep_readers_out_when_zenohs_timeout_is_over(stack: ExitStack, site: Path) -> None:
    """Each one that it closed would cost a tenth of a second in which nobody is accepted."""
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    daemon = publisher(stack, endpoint, Access(ZenohTable(tls=tls), site / "site" / "machine.toml"))
    port = int(endpoint.rpartition(":")[2])
    held = [stack.enter_context(socket.create_connection(("127.0.0.1", port))) for _ in range(200)]
    held[0].settimeout(ZENOHS_TIMEOUT)
    with pytest.raises(TimeoutError):
        held[0].recv(1)
    assert reader(stack, endpoint, client(site, "operator")).receives(daemon) == EXPECTED


def test_a_flood_does_not_reach_readers(stack: ExitStack) -> None:
    endpoint = tcp()
    daemon = publisher(stack, endpoint)
    own = reader(stack, endpoint)
    own.receives(daemon)
    with session(connect=[endpoint]) as flood:
        for _ in range(2000):
            flood.put(attacker.KEY, attacker.FORGED, congestion_control=zenoh.CongestionControl.BLOCK)
        assert own.receives(daemon, 20) == [report(index, 6.5).to_json() for index in range(1, 21)]


def test_only_configured_endpoints_listen(stack: ExitStack) -> None:
    def listened() -> set[str]:
        connections = psutil.Process().net_connections("all")
        addresses = {f"tcp/{item.laddr[0]}:{item.laddr[1]}" for item in connections if item.status == "LISTEN"}
        udp = {
            str(item.laddr) for item in connections if item.type is socket.SOCK_DGRAM and item.family != socket.AF_UNIX
        }
        return (
            addresses | udp | {str(item.laddr) for item in connections if item.laddr and item.family == socket.AF_UNIX}
        )

    before, endpoint = listened(), tcp()
    (local,) = listening(["local"], "s.m")
    opened = Publisher([Published("s", "m")], [local, endpoint])
    stack.callback(opened.close)
    reader(stack, local)
    assert {address for address in listened() - before if address} == {endpoint, local.removeprefix("unixsock-stream/")}
