"""A certificate is replaced by another for the same name while readers are connected, without a restart."""

import errno
import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from datetime import timedelta
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from otolith.cli.main import cli
from otolith.health.limits import Level
from otolith.health.schema import EventChange
from otolith.machine_file import AccessTable, TlsTable, ZenohTable
from otolith.publishing import certificates, publisher
from otolith.publishing.certificates import (
    CERTIFICATE_DAYS,
    make_authority,
    make_certificate,
    renew_certificate,
    utc_now,
)
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import Access, Credentials
from otolith_drivers.errors import ConfigurationError, ServiceError
from tests.cli.commands import otolith
from tests.conftest import free_port
from tests.messages import assert_each_says, assert_says, raises_saying
from tests.publishing.test_security import EXPECTED, Reader
from tests.runtime.test_clock import Computer, Start, daemons
from tests.waiting import wait_for

__all__ = ["daemons"]  # a fixture
OLD = timedelta(days=CERTIFICATE_DAYS - 20)  # since it was made: it is valid for 20 days


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(publisher, "RENEWAL_INTERVAL", 0.05)
    monkeypatch.setattr(publisher, "FIRST_RETRY", 0.05)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with an authority, and certificates of a daemon and of a reader that expire soon."""
    make_authority(tmp_path, utc_now())
    make_certificate(tmp_path, "press", ["localhost", "127.0.0.1"], utc_now() - OLD)
    make_certificate(tmp_path, "operator", [], utc_now() - OLD)
    (tmp_path / "machine.toml").write_text('[zenoh.tls]\nca = "ca.crt"\ncertificate = "press.crt"\nkey = "press.key"\n')
    return tmp_path


def access(site: Path, *readers: str) -> Access:
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    return Access(ZenohTable(tls=tls, access=AccessTable(readers=readers)), site / "machine.toml")


def keys(*arguments: object) -> Result:
    return CliRunner().invoke(cli, ["keys", *map(str, arguments)], catch_exceptions=False)


def credentials(site: Path, name: str) -> Credentials:
    return Credentials(site / "ca.crt", site / f"{name}.crt", site / f"{name}.key")


def test_old_and_new_certificate_of_a_name_read_until_the_name_is_revoked(site: Path, stack: ExitStack) -> None:
    """docs/security.md: 'Renew a certificate' and 'Exclude a reader'."""
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    daemon = stack.enter_context(closing(Publisher([Published("s", "m")], [endpoint], access(site, "operator"))))
    renewal = renew_certificate(site, "operator", [], utc_now())
    old = Reader(endpoint, credentials(site, renewal.kept.stem))
    stack.callback(old.session.close)
    assert old.receives(daemon) == EXPECTED
    new = Reader(endpoint, credentials(site, "operator"))
    stack.callback(new.session.close)
    assert new.receives(daemon) == EXPECTED

    # A lost key is revoked with its name: the reader gets another one, and the daemon is reloaded.
    make_certificate(site, "operator-2", [], utc_now())
    before = daemon._sessions
    daemon.reload(access(site, "operator-2"))
    wait_for(lambda: daemon._sessions not in (before, ()))
    other = Reader(endpoint, credentials(site, "operator-2"))
    stack.callback(other.session.close)
    old.texts.clear()
    assert other.receives(daemon) == EXPECTED
    assert old.texts == []


def test_a_daemon_takes_over_a_renewed_certificate_without_a_restart(
    site: Path, stack: ExitStack, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    daemon = stack.enter_context(closing(Publisher([Published("s", "m")], [endpoint], access(site, "operator"))))
    connected = Reader(endpoint, credentials(site, "operator"))
    stack.callback(connected.session.close)
    assert connected.receives(daemon) == EXPECTED
    assert "expires on" in daemon.warning(utc_now())
    assert keys("renew", site, "press").exit_code == 0
    wait_for(lambda: not daemon.warning(utc_now()))
    later = Reader(endpoint, credentials(site, "operator"))
    stack.callback(later.session.close)
    assert later.receives(daemon) == EXPECTED
    connected.texts.clear()
    assert connected.receives(daemon) == EXPECTED  # it connects again by itself
    assert "not taken over" not in caplog.text


def test_half_of_a_renewal_changes_nothing(site: Path, stack: ExitStack, caplog: pytest.LogCaptureFixture) -> None:
    """Certificate and key are copied one after the other."""
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    daemon = stack.enter_context(closing(Publisher([Published("s", "m")], [endpoint], access(site, "operator"))))
    before = daemon._sessions
    reader = Reader(endpoint, credentials(site, "operator"))
    stack.callback(reader.session.close)
    make_certificate(site, "new", ["localhost"], utc_now())
    (site / "press.crt").write_bytes((site / "new.crt").read_bytes())
    wait_for(lambda: "not taken over" in caplog.text)
    assert caplog.text.count("press.key: does not belong to the certificate") == 1
    assert daemon._sessions == before
    assert reader.receives(daemon) == EXPECTED
    (site / "press.key").write_bytes((site / "new.key").read_bytes())
    wait_for(lambda: not daemon.warning(utc_now()))


def test_renewing_keeps_hosts_and_the_old_files(site: Path) -> None:
    old = (site / "press.crt").read_bytes(), (site / "press.key").read_bytes()
    done = keys("renew", site, "press")
    end = utc_now() + timedelta(days=20)
    kept = site / f"press.until-{end:%Y-%m-%d}.crt"
    assert (kept.read_bytes(), kept.with_suffix(".key").read_bytes()) == old
    assert f"{kept}: the old certificate, stays valid until {end:%F}" in done.output
    assert (site / "press.key").stat().st_mode & 0o777 == 0o600
    hosts = {path.name: hosts for path, (_, hosts) in certificates.issued(site)[0].items()}
    assert hosts["press.crt"] == hosts[kept.name] == ("127.0.0.1", "localhost")
    listed = keys("list", site).output.splitlines()
    assert [line.split()[0] for line in listed] == ["ca", "operator", "press", kept.stem]
    assert "days left" in listed[1]


@pytest.mark.parametrize("replaced", [0, 1])
def test_a_renewal_that_fails_leaves_the_files_as_they_were(
    site: Path, replaced: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, done, replace = {path: path.read_bytes() for path in site.iterdir()}, list[Path](), Path.replace

    def fail(path: Path, target: Path) -> Path:
        done.append(path)
        if len(done) == replaced + 1:
            raise OSError(errno.EIO, "input/output error")
        return replace(path, target)

    monkeypatch.setattr(Path, "replace", fail)
    with raises_saying(ConfigurationError, str(site), "input/output error"):
        renew_certificate(site, "press", [], utc_now())
    assert {path: path.read_bytes() for path in site.iterdir()} == before


@pytest.fixture
def changed_modes(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Modes that files had before they got another one, on a disk on which a file has one name only."""

    def no_link(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    def recorded(real: Callable[..., None]) -> Callable[..., None]:
        def change(file: int | Path, mode: int, **rest: object) -> None:
            before.append((os.fstat(file) if isinstance(file, int) else Path(file).stat()).st_mode)
            real(file, mode, **rest)

        return change

    before = list[int]()
    monkeypatch.setattr(os, "link", no_link)
    for name in ("chmod", "fchmod"):
        monkeypatch.setattr(os, name, recorded(getattr(os, name)))
    umask = os.umask(0)
    yield before
    os.umask(umask)


def test_nobody_else_may_read_the_copy_of_a_key_at_any_moment(site: Path, changed_modes: list[int]) -> None:
    old = (site / "press.key").read_bytes()
    renewal = renew_certificate(site, "press", [], utc_now())
    kept = renewal.kept.with_suffix(".key")
    assert kept.read_bytes() == old
    assert (kept.stat().st_mode & 0o777, renewal.kept.stat().st_mode & 0o777) == (0o600, 0o644)
    assert not any(mode & 0o077 for mode in changed_modes)


@pytest.mark.parametrize("copied", [0, 1])
def test_a_copy_that_fails_leaves_the_files_as_they_were(
    site: Path, copied: int, changed_modes: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    before, place, sync = {path: path.read_bytes() for path in site.iterdir()}, len(changed_modes), os.fsync

    def full(handle: int) -> None:
        if len(changed_modes) > place + copied:
            raise OSError(errno.ENOSPC, "No space left on device")
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with raises_saying(ServiceError, "press.until-", "No space left"):
        renew_certificate(site, "press", [], utc_now())
    assert {path: path.read_bytes() for path in site.iterdir()} == before


def test_files_of_a_renewal_that_was_ended_are_no_certificate(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    before = certificates.issued(site)
    with monkeypatch.context() as patch:
        patch.setattr(certificates, "_keep", killed)
        with pytest.raises(KeyboardInterrupt):
            renew_certificate(site, "press", [], utc_now())
    assert len(list(site.glob(".press*"))) == 2
    assert certificates.issued(site) == before
    renew_certificate(site, "press", [], utc_now())
    assert not list(site.glob(".press*"))


def test_a_file_that_is_no_certificate_hides_no_other(site: Path) -> None:
    (site / "junk.crt").write_text("not a certificate")
    (site / "folder.crt").mkdir()
    (site / "ca.crt").write_bytes(b"")
    done = otolith("keys", "list", site)
    assert done.return_value == 1
    assert [line.split()[0] for line in done.stdout.splitlines()] == ["operator", "press"]
    told = done.stderr.splitlines()
    assert len(told) == 3
    assert_each_says(told, ["ca.crt"], ["folder.crt"], ["junk.crt", "certificate"])
    document = json.loads(keys("list", site, "--json").stdout)
    assert [Path(row["file"]).stem for row in document["certificates"]] == ["operator", "press"]
    assert [Path(row["file"]).stem for row in document["unreadable"]] == ["ca", "folder", "junk"]


def test_a_second_renewal_on_a_day_loses_nothing(site: Path) -> None:
    for _ in range(3):
        assert keys("renew", site, "operator").exit_code == 0
    assert len(list(site.glob("operator*.crt"))) == len(list(site.glob("operator*.key"))) == 4


def test_a_name_without_certificate_cannot_be_renewed(site: Path) -> None:
    with raises_saying(ConfigurationError, "visitor.crt"):
        keys("renew", site, "visitor")
    assert not list(site.glob("visitor*"))


def test_a_name_that_has_a_certificate_is_told_how_to_renew_it(site: Path) -> None:
    with raises_saying(ConfigurationError, "operator.key", "exists", f"'otolith keys renew {site} operator'"):
        keys("add", site, "operator")


def test_a_folder_that_takes_no_file_leaves_the_old_pair_in_place(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise ConfigurationError("no space left")

    before = sorted(path.name for path in site.iterdir())
    monkeypatch.setattr(certificates, "_write", full)
    with raises_saying(ConfigurationError, "no space"):
        keys("renew", site, "press")
    assert sorted(path.name for path in site.iterdir()) == before


@pytest.mark.full
def test_a_certificate_that_expires_soon_is_an_event_in_the_history_and_no_state(
    site: Path, stack: ExitStack, daemons: Start
) -> None:
    endpoint = f"tls/localhost:{free_port(socket.SOCK_STREAM)}"
    publishing = stack.enter_context(closing(Publisher([Published("s", "m")], [endpoint], access(site, "operator"))))
    running = daemons(Computer())
    for name in ("warning", "expiry_notice", "warn_of_expiry"):
        setattr(running, name, getattr(publishing, name))
    running.run(3)
    running.stop()
    events = [event for event in running.reader.events(0.0) if event.condition_id == "certificate"]
    (event,) = events  # once, although it is said in each report
    assert (event.part, event.change, event.state) == ("daemon", EventChange.NOTED, Level.OK)
    assert_says(event.text, "press.crt", f"{utc_now() + timedelta(days=20):%F}")
    last = running.published[-1]
    assert last.health is not None
    assert last.health.state is Level.OK
    assert any("press.crt" in note for note in last.notes)


@pytest.mark.parametrize("error", [ConfigurationError("press.key: does not belong"), RuntimeError("a bug")])
def test_what_cannot_be_opened_anew_is_named_and_tried_again_and_the_rest_goes_on(
    site: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """The files may change again between the look at them and the new session."""
    good, bad = (f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2))
    daemon = stack.enter_context(closing(Publisher([Published("s", "m")], [good, bad], access(site))))
    opening, failing = daemon._open, [True]

    def opened(endpoints: publisher._Endpoints) -> None:
        if failing and bad in endpoints.listen:
            raise error
        opening(endpoints)

    monkeypatch.setattr(daemon, "_open", opened)
    assert keys("renew", site, "press").exit_code == 0
    wait_for(lambda: str(error) in daemon.outages(utc_now()).get(f"reports on {bad}", ""))
    wait_for(lambda: daemon.endpoints == good)
    failing.clear()
    wait_for(lambda: not daemon.outages(utc_now()))
    assert daemon.endpoints == f"{good}, {bad}"


def test_files_that_cannot_be_checked_leave_the_session_and_the_thread(
    site: Path, stack: ExitStack, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    daemon = stack.enter_context(closing(Publisher([Published("s", "m")], [endpoint], access(site))))

    def broken(*_: object) -> None:
        raise ValueError("a form of certificate that is not known")

    monkeypatch.setattr(daemon, "_settings", broken)
    assert keys("renew", site, "press").exit_code == 0
    wait_for(lambda: "not known" in caplog.text)
    assert daemon._thread.is_alive()
    assert daemon.endpoints == endpoint
