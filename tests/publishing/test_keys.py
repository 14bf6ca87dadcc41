"""``otolith keys``, the checks of the files that a session uses, and how readers find sockets."""

import os
import re
import resource
import socket
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography.hazmat.primitives import serialization

from otolith.cli.demo import _refuse_busy
from otolith.cli.main import cli
from otolith.health.labels import expiry_event
from otolith.machine_file import AccessTable, TlsTable, ZenohTable
from otolith.publishing.certificates import CERTIFICATE_DAYS, make_authority, make_certificate, utc_now
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import (
    NOTICE_DAYS,
    SOCKET,
    Access,
    Connection,
    Credentials,
    Validity,
    listening,
    local_sockets,
    reader_settings,
)
from otolith.storage.history import history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith_drivers.errors import ConfigurationError, ServiceError
from tests.conftest import free_port
from tests.health.test_events import report
from tests.messages import raises_saying
from tests.storage.histories import document
from tests.waiting import wait_for

ENDPOINT = "tls/press.local:7447"
FILE = """[zenoh]
listen = ["tls/press.local:7447"]
[zenoh.tls]
ca = "ca.crt"
certificate = "press.crt"
key = "press.key"
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with an authority, the certificate of a daemon, and its machine file."""
    folder = tmp_path / "site"
    make_authority(folder, utc_now())
    make_certificate(folder, "press", ["press.local", "10.0.0.7"], utc_now())
    (folder / "machine.toml").write_text(FILE, encoding="utf-8")
    return folder


def settings(site: Path, endpoint: str = ENDPOINT, access: AccessTable | None = None) -> str:
    """The warning of the settings of a daemon."""
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    table = ZenohTable(tls=tls, access=access or AccessTable())
    return Access(table, site / "machine.toml").settings(["otolith/s/m"], [endpoint])[1].warning(utc_now())


def test_a_certificate_that_the_disk_has_no_room_for_leaves_no_key(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300, limits[1]))  # bytes: a key is shorter, a certificate longer
    try:
        with raises_saying(ConfigurationError, "ca.crt", "ile too large"):
            make_authority(tmp_path, utc_now())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert list(tmp_path.iterdir()) == []
    make_authority(tmp_path, utc_now())


def test_keys_are_private_and_never_replaced(tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    make = ["add", str(folder), "press", "--host", "press.local", "--host", "10.0.0.7"]
    for arguments, created, expiry in ((["init", str(folder)], "ca", 3650), (make, "press", CERTIFICATE_DAYS)):
        done = CliRunner().invoke(cli, ["keys", *arguments])
        assert done.exit_code == 0, done.output
        assert f"expires {utc_now() + timedelta(days=expiry):%F}" in done.output
        before = (folder / f"{created}.key").read_bytes()
        with pytest.raises(ConfigurationError, match=r"exists and is not replaced"):
            CliRunner().invoke(cli, ["keys", *arguments], catch_exceptions=False)
        assert (folder / f"{created}.key").read_bytes() == before
        assert (folder / f"{created}.key").stat().st_mode & 0o777 == 0o600
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("../press", "", "a b", "press\n"):
        assert CliRunner().invoke(cli, ["keys", "add", str(folder), name]).exit_code == 2
    assert CliRunner().invoke(cli, ["keys", "add", str(folder), "b", "--host", "ü"]).exit_code == 2
    with pytest.raises(ConfigurationError, match=r"ca\.crt: cannot be read"):
        CliRunner().invoke(cli, ["keys", "add", str(tmp_path), "b"], catch_exceptions=False)


def damage(site: Path, name: str) -> None:
    """Make the files of the daemon unusable in the way of ``name``."""
    if name == "missing":
        (site / "press.key").unlink()
    elif name == "open":
        (site / "press.key").chmod(0o644)
    elif name == "no certificate":
        (site / "press.crt").write_text("nothing", encoding="utf-8")
    elif name == "no key":
        (site / "press.key").write_text("nothing", encoding="utf-8")
    elif name == "encrypted":
        key = serialization.load_pem_private_key((site / "press.key").read_bytes(), None)
        pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
        (site / "press.key").write_bytes(
            key.private_bytes(pem, pkcs8, serialization.BestAvailableEncryption(b"secret"))
        )
    elif name == "other key":
        make_certificate(site, "other", [], utc_now())
        (site / "press.key").write_bytes((site / "other.key").read_bytes())
    elif name == "other authority":
        make_authority(site / "other", utc_now())
        (site / "ca.crt").write_bytes((site / "other" / "ca.crt").read_bytes())
    else:
        shift = timedelta(days=-CERTIFICATE_DAYS - 1 if name == "expired" else 2)
        make_certificate(site, "other", ["press.local"], utc_now() + shift)
        for kind in ("crt", "key"):
            (site / f"press.{kind}").write_bytes((site / f"other.{kind}").read_bytes())


@pytest.mark.parametrize(
    ("name", "line", "cause"),
    [
        ("missing", 6, r"zenoh\.tls\.key: .*press\.key: cannot be read: No such file"),
        ("open", 6, r"zenoh\.tls\.key: .*press\.key: open to every user of this computer .*'chmod o-rwx"),
        ("no certificate", 5, r"zenoh\.tls\.certificate: .*press\.crt: not a certificate in PEM form"),
        ("no key", 6, r"zenoh\.tls\.key: .*press\.key: not a private key in PEM form"),
        ("encrypted", 6, r"zenoh\.tls\.key: .*press\.key: encrypted; Zenoh needs a key without a passphrase"),
        ("other key", 6, r"zenoh\.tls\.key: .*press\.key: does not belong to the certificate"),
        ("other authority", 5, r"zenoh\.tls\.certificate: .*press\.crt: was not issued by .*ca\.crt"),
        ("expired", 5, r"zenoh\.tls\.certificate: .*press\.crt: expired on \d{4}-\d\d-\d\d; 'otolith keys renew'"),
        ("early", 5, r"zenoh\.tls\.certificate: .*press\.crt: valid only from .*; check the clock"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(site: Path, name: str, line: int, cause: str) -> None:
    damage(site, name)
    with pytest.raises(ConfigurationError, match=rf"machine\.toml:{line}: {cause}"):
        settings(site)


def test_a_certificate_for_other_hosts_is_named(site: Path) -> None:
    # A name of the certificate may lead to any address.
    for address in ("press.local", "Press.Local", "10.0.0.7", "10.0.0.8", "0.0.0.0", "[::]"):  # noqa: S104 - nothing listens
        assert not settings(site, f"tls/{address}:7447")
    with raises_saying(ConfigurationError, "mill.local", "10.0.0.7, press.local"):
        settings(site, "tls/mill.local:7447")
    for name, hosts, address in (
        ("address", ["10.0.0.7"], "10.0.0.8"),
        ("reader", [], "0.0.0.0"),  # noqa: S104 - nothing listens
    ):
        make_certificate(site, name, hosts, utc_now())
        for kind in ("crt", "key"):
            (site / f"press.{kind}").write_bytes((site / f"{name}.{kind}").read_bytes())
        with pytest.raises(ConfigurationError, match=rf"not for {address}, but for (10\.0\.0\.7|no host);"):
            settings(site, f"tls/{address}:7447")


def test_a_certificate_that_expires_soon_is_named(site: Path) -> None:
    make_certificate(site, "old", ["press.local"], utc_now() - timedelta(days=CERTIFICATE_DAYS - 20))
    for kind in ("crt", "key"):
        (site / f"press.{kind}").write_bytes((site / f"old.{kind}").read_bytes())
    assert re.search(r"press\.crt: expires on \d{4}-\d\d-\d\d", settings(site))


def test_a_daemon_that_runs_for_years_warns_of_its_certificate(site: Path, caplog: pytest.LogCaptureFixture) -> None:
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    make_certificate(site, "own", ["127.0.0.1"], utc_now())
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("own.crt"), key=Path("own.key"))
    publisher = Publisher([Published("s", "m")], [endpoint], Access(ZenohTable(tls=tls), site / "machine.toml"))
    try:
        certificate = publisher.certificate
        assert certificate is not None
        assert certificate.until - certificate.since >= timedelta(days=CERTIFICATE_DAYS).total_seconds()
        for days in (0, CERTIFICATE_DAYS - 40):
            publisher.warn_of_expiry(utc_now() + timedelta(days=days))
        assert caplog.text == ""
        for hours in range(48):
            publisher.warn_of_expiry(utc_now() + timedelta(days=CERTIFICATE_DAYS - 20, hours=hours))
        assert caplog.text.count("own.crt: expires on ") in {2, 3}
        notices = [publisher.expiry_notice(utc_now() + timedelta(days=days)) for days in range(CERTIFICATE_DAYS + 9)]
        noticed = [day for day, notice in enumerate(notices) if notice]
        assert noticed == [CERTIFICATE_DAYS - before for before in NOTICE_DAYS]
        publisher.warn_of_expiry(utc_now() + timedelta(days=CERTIFICATE_DAYS + 1))
        assert "own.crt: expired on " in caplog.text
        replaced = replace(publisher._validity, end=utc_now() + timedelta(days=CERTIFICATE_DAYS + 400))
        publisher._validity = replaced  # by another, which is told of as well
        assert publisher.expiry_notice(utc_now() + timedelta(days=CERTIFICATE_DAYS + 375)) == replaced
    finally:
        publisher.close()


@pytest.mark.parametrize(("days", "renewed"), [(1, 1 / 3), (7, 6), (14, 14 / 3), (47, 47 / 3), (90, 30), (365, 31)])
def test_a_certificate_that_an_authority_renews_by_itself_is_not_warned_of(days: int, renewed: float) -> None:
    """``renewed`` days before its end."""
    end = utc_now()
    validity = Validity(Path("own.crt"), end, timedelta(days=days))
    assert validity.warning(end - timedelta(days=renewed)) == ""
    for left in validity.notices:  # but if it is not renewed
        assert "expires on" in validity.warning(end - 0.99 * left)
    assert "expired on" in validity.warning(end + timedelta(hours=1))


@pytest.mark.parametrize("days", [20.0, 5.0])
def test_a_daemon_that_starts_again_does_not_repeat_a_notice(site: Path, days: float) -> None:
    make_certificate(site, "own", ["127.0.0.1"], utc_now() - timedelta(days=CERTIFICATE_DAYS - days))
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("own.crt"), key=Path("own.key"))
    own, now = Access(ZenohTable(tls=tls), site / "machine.toml"), utc_now()
    archive, time = HistoryWriter(history_path("hall-1", "press-3"), Bounds(20_000_000, 3650, 24)), now.timestamp()
    numbers, _ = archive.open(time)

    def notice(after: float) -> Validity | None:
        endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        with closing(Publisher([Published("hall-1", "press-3", archive)], [endpoint], own)) as publisher:
            return publisher.expiry_notice(now + timedelta(days=after))

    told = notice(0.0)
    assert told is not None
    assert told.end is not None
    raised = expiry_event(time, str(told.certificate), told.end.timestamp(), 0, "en")
    archive.add(numbers.number(document(0, time).model_copy(update={"events": (raised,)})))
    archive._write_waiting()
    assert [notice(after) for after in (0.0, 1.0)] == [None, None]
    assert (notice(14.0) == told) == (days == 20.0)  # within the last week
    archive._close()


def test_an_encrypted_endpoint_needs_certificates(site: Path) -> None:
    with raises_saying(ConfigurationError, "tls/press.local:7447", "[zenoh.tls]", "missing"):
        Access(ZenohTable(), site / "machine.toml").settings(["otolith/s/m"], [ENDPOINT])


def test_names_of_readers_need_a_proof(site: Path) -> None:
    table = ZenohTable(access=AccessTable(readers=("operator",)))
    with raises_saying(ConfigurationError, "zenoh.access.readers", "proves"):
        Access(table, site / "machine.toml").settings(["otolith/s/m"], [ENDPOINT.replace("tls", "tcp")])


@pytest.mark.parametrize("text", ["operator", "operator:", ":secret", " operator:secret", "a:b\n\nc:d"])
def test_a_wrong_line_of_the_passwords_is_named_but_not_shown(site: Path, text: str) -> None:
    users = site / "users"
    users.write_text(text, encoding="utf-8")
    users.chmod(0o600)
    with pytest.raises(
        ConfigurationError, match=r"zenoh.access.passwords: .*users:\d: write one user per line"
    ) as caught:
        settings(site, access=AccessTable(passwords=users))
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("credentials", "cause"),
    [
        (Credentials(), "needs --ca"),
        (Credentials(ca=Path("ca.crt"), certificate=Path("press.crt")), "belong together"),
        (Credentials(ca=Path("press.key")), "not a certificate"),
        (Credentials(ca=Path("nowhere")), "cannot be read"),
        (Credentials(login=Path("ca.crt")), "open to every user"),
    ],
)
def test_a_reader_learns_which_option_is_wrong(
    site: Path, monkeypatch: pytest.MonkeyPatch, credentials: Credentials, cause: str
) -> None:
    monkeypatch.chdir(site)
    with pytest.raises(ConfigurationError, match=cause):
        reader_settings(credentials, [ENDPOINT])


def test_a_reader_names_no_socket_of_another_user(monkeypatch: pytest.MonkeyPatch) -> None:
    """What another user left there is no cause that this reader can remove."""
    (endpoint,) = listening(["local"], "here.foreign")
    path = Path(endpoint.removeprefix(SOCKET))
    with socket.socket(socket.AF_UNIX) as hung, Subscriber(Connection(), lambda _: None) as subscriber:
        hung.bind(str(path))
        assert endpoint in subscriber.state()
        monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
        assert endpoint not in subscriber.state()
        assert "--connect" in subscriber.state()
    path.unlink()


def test_a_reader_names_a_socket_that_does_not_answer() -> None:
    (endpoint,) = listening(["local"], "here.stopped")
    with socket.socket(socket.AF_UNIX) as hung, Subscriber(Connection(), lambda _: None) as subscriber:
        hung.bind(endpoint.removeprefix(SOCKET))
        assert subscriber.state().startswith("no daemon reached yet")
        assert endpoint in subscriber.state()
    Path(endpoint.removeprefix(SOCKET)).unlink()


def test_a_reader_finds_sockets_as_they_appear() -> None:
    texts: list[str] = []
    with Subscriber(Connection(), texts.append) as subscriber:
        assert "no daemon of this user" in subscriber.state()
        (endpoint,) = listening(["local"], "s.m")
        publisher = Publisher([Published("s", "m")], [endpoint])
        try:
            assert local_sockets() == [endpoint]

            def arrives() -> bool:
                publisher.publish(report(0, 6.5))
                return bool(texts)

            wait_for(arrives)
            assert "connected" in subscriber.state()
            with pytest.raises(ServiceError, match=r"s\.m\.sock is in use"):
                _refuse_busy([endpoint])  # of the demo
            with closing(Publisher([Published("s", "m")], [endpoint])) as other:
                assert "another daemon publishes there" in str(other.outages(utc_now()))
        finally:
            publisher.close()
    assert local_sockets() == []


def test_the_environment_may_have_the_options(monkeypatch: pytest.MonkeyPatch, site: Path) -> None:
    monkeypatch.setenv("OTOLITH_CONNECT", f"{ENDPOINT} tls/other.local:7447")
    monkeypatch.setenv("OTOLITH_CA", str(site / "nowhere.crt"))
    with pytest.raises(ConfigurationError, match=r"nowhere\.crt: cannot be read"):
        CliRunner().invoke(cli, ["watch", "--json"], catch_exceptions=False)


def test_a_socket_with_a_long_path_is_refused() -> None:
    with raises_saying(ServiceError, "107 bytes", "zenoh.listen"):
        listening(["local"], f"{'a' * 64}.{'b' * 64}")


def test_a_runtime_directory_that_others_may_write_is_refused(runtime: Path) -> None:
    (runtime / "otolith").mkdir()
    (runtime / "otolith").chmod(0o777)
    with raises_saying(ServiceError, "writable", "readers"):
        listening(["local"], "s.m")


def test_sockets_without_a_runtime_directory_are_found(monkeypatch: pytest.MonkeyPatch, runtime: Path) -> None:
    """As in a container, or after su, where the variable names another user's directory."""
    monkeypatch.setenv("XDG_STATE_HOME", str(runtime / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime / "missing"))
    (endpoint,) = listening(["local"], "s.m")
    assert endpoint == f"unixsock-stream/{runtime}/state/otolith/s.m.sock"
    publisher = Publisher([Published("s", "m")], [endpoint])
    publisher.close()
    assert not list((runtime / "state" / "otolith").iterdir())
