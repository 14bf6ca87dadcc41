"""An endpoint that cannot be opened costs itself alone, is named, and is opened once that is possible."""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import zenoh

from otolith.machine_file import TlsTable, ZenohTable
from otolith.publishing import publisher as module
from otolith.publishing.certificates import CERTIFICATE_DAYS, make_authority, make_certificate, utc_now
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import SOCKET, Access, Credentials, listening
from otolith.publishing.zenoh_session import protect_files
from otolith_drivers.errors import ConfigurationError
from tests.conftest import free_port
from tests.publishing.test_security import EXPECTED, FIRST, Reader
from tests.waiting import wait_for


@pytest.fixture(autouse=True)
def _often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FIRST_RETRY", 0.05)
    monkeypatch.setattr(module, "MAX_RETRY", 0.2)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder with the certificates of a daemon, which may be replaced, and of a reader."""
    make_authority(tmp_path, utc_now())
    for name, days in (("expired", -CERTIFICATE_DAYS - 1), ("early", 2), ("valid", 0)):
        make_certificate(tmp_path, name, ["127.0.0.1"], utc_now() + timedelta(days=days))
    (tmp_path / "machine.toml").write_text('[zenoh.tls]\nca = "ca.crt"\ncertificate = "press.crt"\nkey = "press.key"\n')
    return tmp_path


def use(site: Path, name: str) -> None:
    for kind in ("crt", "key"):
        (site / f"press.{kind}").write_bytes((site / f"{name}.{kind}").read_bytes())
    (site / "press.key").chmod(0o600)


def access(site: Path) -> Access:
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"), clients=False)
    return Access(ZenohTable(tls=tls), site / "machine.toml")


def opened(stack: ExitStack, *listen: str, access: Access = Access()) -> Publisher:  # noqa: B008 - immutable
    return stack.enter_context(closing(Publisher([Published("s", "m")], listen, access)))


def read(stack: ExitStack, daemon: Publisher, endpoint: str, credentials: Credentials | None = None) -> list[str]:
    reader = Reader(endpoint, credentials)
    stack.callback(reader.session.close)
    return reader.receives(daemon)


def test_endpoints_that_all_work_share_one_session(stack: ExitStack) -> None:
    port = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    daemon = opened(stack, "local", port)
    assert len(daemon._sessions) == 1
    assert daemon.outages(utc_now()) == {}
    (local,) = listening(["local"], "s.m")
    assert daemon.endpoints == f"{local}, {port}"


def test_an_endpoint_that_is_in_use_is_opened_once_it_is_free(
    stack: ExitStack, caplog: pytest.LogCaptureFixture
) -> None:
    number = free_port(socket.SOCK_STREAM)
    endpoint = f"tcp/127.0.0.1:{number}"
    with socket.create_server(("127.0.0.1", number)):
        daemon = opened(stack, endpoint, "local")
        (local,) = listening(["local"], "s.m")
        assert read(stack, daemon, local) == EXPECTED
        ((name, reason),) = daemon.outages(utc_now()).items()
        assert endpoint in name
        assert "in use" in reason
    wait_for(lambda: not daemon.outages(utc_now()))
    assert read(stack, daemon, endpoint) == EXPECTED
    assert caplog.text.count(f"no reports on {endpoint}") == 1


@pytest.mark.parametrize(("name", "reason"), [("expired", "expired on"), ("early", "check the clock")])
def test_a_certificate_that_is_not_valid_now_costs_only_the_encrypted_endpoint(
    site: Path, stack: ExitStack, name: str, reason: str
) -> None:
    use(site, name)
    endpoint = f"tls/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    daemon = opened(stack, "local", endpoint, access=access(site))
    (local,) = listening(["local"], "s.m")
    assert read(stack, daemon, local) == EXPECTED
    ((key, text),) = daemon.outages(utc_now()).items()
    assert endpoint in key
    assert reason in text
    use(site, "valid")  # or the clock was set right
    wait_for(lambda: not daemon.outages(utc_now()))
    assert read(stack, daemon, endpoint, Credentials(ca=site / "ca.crt")) == EXPECTED
    assert "expired" in str(daemon.outages(utc_now() + timedelta(days=CERTIFICATE_DAYS + 1)))


def test_a_certificate_that_no_endpoint_needs_is_no_outage(site: Path, stack: ExitStack) -> None:
    use(site, "expired")
    assert opened(stack, "local", access=access(site)).outages(utc_now()) == {}


@pytest.mark.parametrize("name", ["missing key", "other host"])
def test_a_mistake_in_the_files_is_refused_also_if_they_have_expired(site: Path, name: str) -> None:
    use(site, "expired")
    host = "127.0.0.1"
    if name == "missing key":
        (site / "press.key").unlink()
    else:
        host = "127.0.0.2"
    with pytest.raises(ConfigurationError, match=r"machine\.toml"):
        Publisher([Published("s", "m")], ["local", f"tls/{host}:7447"], access(site))


def test_a_folder_for_sockets_that_cannot_be_used_costs_only_the_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: ExitStack
) -> None:
    """A file in the place of the folder stands for a read-only disk, which does not stop root."""
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    (tmp_path / "state").write_text("")
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    daemon = opened(stack, "local", endpoint)
    assert read(stack, daemon, endpoint) == EXPECTED
    ((key, reason),) = daemon.outages(utc_now()).items()
    assert "local" in key
    assert "state" in reason
    (tmp_path / "state").unlink()
    wait_for(lambda: not daemon.outages(utc_now()))
    (local,) = listening(["local"], "s.m")
    assert read(stack, daemon, local) == EXPECTED


def test_a_publisher_without_any_endpoint_is_closed_at_once(stack: ExitStack) -> None:
    number = free_port(socket.SOCK_STREAM)
    stack.enter_context(socket.create_server(("127.0.0.1", number)))
    daemon = opened(stack, f"tcp/127.0.0.1:{number}")
    daemon.publish(FIRST)
    daemon.close()
    assert not daemon._thread.is_alive()


def test_what_other_threads_write_meanwhile_has_the_permissions_of_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: ExitStack
) -> None:
    """The history's thread runs while sockets are made."""
    before, open_session = os.umask(0o022), zenoh.open
    stack.callback(os.umask, before)
    modes = list[int]()

    def open_beside_a_writer(*arguments: Any) -> zenoh.Session:
        thread = threading.Thread(target=(tmp_path / "other").touch, args=(0o666,))
        thread.start()
        thread.join()
        modes.append((tmp_path / "other").stat().st_mode & 0o777)
        return open_session(*arguments)

    monkeypatch.setattr(zenoh, "open", open_beside_a_writer)
    protect_files()
    (endpoint,) = listening(["local"], "s.m")
    opened(stack, endpoint)
    assert modes == [0o644]
    assert Path(endpoint.removeprefix(SOCKET)).stat().st_mode & 0o777 == 0o660


@pytest.mark.parametrize(("mask", "expected"), [(0o000, 0o002), (0o022, 0o022), (0o077, 0o077)])
def test_nobody_else_may_write_what_the_daemon_makes(mask: int, expected: int) -> None:
    before = os.umask(mask)
    try:
        protect_files()
        assert os.umask(before) == expected
    finally:
        os.umask(before)


def test_a_further_machine_takes_no_further_thread(tmp_path: Path) -> None:
    """A hall has hundreds; and a daemon thread of Zenoh that comes back to Python when that has ended aborts it."""
    with closing(Publisher([Published("s", "m")], [f"unixsock-stream/{tmp_path}/a.sock"], of_hall=True)) as publisher:
        before = set(threading.enumerate())
        for number in range(3):
            publisher.add(Published("s", f"n{number}"))
        assert not set(threading.enumerate()) - before
