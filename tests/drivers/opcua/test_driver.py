"""The OPC UA driver against asyncua's server in another process: times, faults, security; no server may end it."""

import json
import math
import re
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from click.testing import CliRunner
from cryptography import x509

from otolith.cli.main import cli
from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.common import reconnection
from otolith_drivers.common.sharing import places
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.opcua import driver as opcua
from otolith_drivers.opcua.connection import certificate_warnings, lasting_name, place
from tests.conftest import free_port
from tests.drivers.certificates import certificate
from tests.drivers.opcua_server import opcua_server, server_of_this_process
from tests.messages import assert_each_says, raises_saying
from tests.waiting import wait_for

VALUES = {"i": (2.0, "A"), "omega": (10.0, "rad/s")}


def setup_of(folder: Path, **nodes: str) -> Setup:
    units = {"i": "A", "omega": "rad/s"}
    own = {"omega": "rad/s"}  # the unit of the current is that of the server
    signals = [Signal(name, units[name], opcua.Source(node=node, unit=own.get(name))) for name, node in nodes.items()]
    return Setup(tuple(signals), folder, 0.01)


@contextmanager
def opened(port: int, folder: Path, *, nodes: dict[str, str] | None = None, **keys: Any) -> Iterator[
    tuple[opcua.OpcuaSubscriber, list[Sample]]
]:  # fmt: skip
    options = opcua.Options.model_validate({"endpoint": f"opc.tcp://127.0.0.1:{port}/motor"} | keys)
    setup = setup_of(folder, **(nodes or {"i": "ns=2;s=i", "omega": "ns=2;s=omega"}))
    driver, samples = opcua.build(options, setup), list[Sample]()
    driver.open(samples.extend)
    try:
        yield driver, samples
    finally:
        driver.close()


@pytest.fixture(scope="module")
def port() -> int:
    return server_of_this_process()


def test_a_server_that_hangs_or_is_killed_and_comes_back_costs_counted_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(reconnection, "BACKOFF_MAX", 0.3)
    port = free_port(socket.SOCK_STREAM)
    with opcua_server(port, VALUES) as server, opened(port, tmp_path, timeout="0.5 s") as (driver, samples):
        wait_for(lambda: len(samples) > 100)
        times = [sample.time for sample in samples if sample.signal == "i"]
        period = max((times[-1] - times[0]) / (len(times) - 1), 0.01)  # a busy computer samples less often than asked
        server.send_signal(signal.SIGSTOP)
        wait_for(lambda: re.search("no answer|no message|does not answer", driver.link().reason) is not None)
        server.send_signal(signal.SIGCONT)
        wait_for(lambda: driver.link().up)
        server.kill()
        server.wait()
        wait_for(lambda: driver.link().reason == "Connection refused")
        before, gone = len(samples), samples[-1].time
        with opcua_server(port, VALUES):
            wait_for(lambda: len(samples) > before + 100)
            assert driver.link().up
            counters = driver.counters()
    assert "ended the subscription" not in caplog.text, "the library calls a lost connection so, not the server"
    first = samples[before].time
    assert counters.reconnects == 2
    assert counters.lost >= 0.9 * 2 * (first - gone) / period


def test_a_server_that_is_restarted_is_one_reconnection_of_each_machine_that_reads_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconnection, "BACKOFF_MAX", 0.3)
    port = free_port(socket.SOCK_STREAM)
    with ExitStack() as stack:
        with opcua_server(port, VALUES):
            machines = [stack.enter_context(opened(port, tmp_path, nodes={"i": "ns=2;s=i"})) for _ in range(2)]
            wait_for(lambda: all(samples for _, samples in machines))
        wait_for(lambda: all(driver.link().reason == "Connection refused" for driver, _ in machines))
        with opcua_server(port, VALUES):
            wait_for(lambda: all(driver.link().up for driver, _ in machines))
            assert [driver.counters().reconnects for driver, _ in machines] == [1, 1]
            assert len(places()) == 1
    assert not places()


def test_stamps_of_a_clock_an_hour_ahead_are_refused_and_those_of_the_server_used(port: int, tmp_path: Path) -> None:
    with opened(port, tmp_path, nodes={"i": "ns=2;s=ahead"}) as (driver, samples):
        wait_for(lambda: driver.counters().bad > 10)
        link = driver.link()
        assert link.up, "the server does send, and the warning says what is wrong with it"
        assert_each_says(link.warnings, ("i:", "3600.0 s after", 'stamps = "server"'))
        assert "known within" in link.plan
        assert samples == []
    with opened(port, tmp_path, nodes={"i": "ns=2;s=ahead"}, stamps="server") as (driver, samples):
        wait_for(lambda: len(samples) > 10)
        assert driver.counters().bad == 0
        assert all(abs(time.monotonic() - sample.time) < 1800.0 for sample in samples)


def test_a_value_that_stays_is_repeated_while_the_server_sends_messages(port: int, tmp_path: Path) -> None:
    with opened(port, tmp_path, nodes={"i": "ns=2;s=still"}) as (driver, samples):
        wait_for(lambda: len(samples) > 10)
        assert driver.link().up
        assert driver.counters().bad == 0
        now = time.monotonic()
    assert {sample.value for sample in samples} == {3.0}
    assert all(sample.time <= now for sample in samples)


def test_a_bad_status_is_counted_and_not_used(port: int, tmp_path: Path) -> None:
    with opened(port, tmp_path, nodes={"i": "ns=2;s=bad", "omega": "ns=2;s=omega"}) as (driver, samples):
        wait_for(lambda: driver.counters().bad > 10 and len(samples) > 50)
        assert any("BadSensorFailure" in line for line in driver.link().warnings)
    assert all(math.isnan(sample.value) for sample in samples if sample.signal == "i")


def test_an_unknown_node_and_a_missing_unit_are_named(port: int, tmp_path: Path) -> None:
    nodes = {"i": "ns=2;s=Current", "omega": "ns=2;s=omega"}
    with opened(port, tmp_path, nodes=nodes) as (driver, samples):
        wait_for(lambda: len(samples) > 10)
        (line,) = driver.link().warnings
    assert "i: ns=2;s=Current" in line
    assert {sample.signal for sample in samples} == {"omega"}
    with opened(port, tmp_path, nodes={"i": "ns=0;i=2267"}) as (driver, _):
        wait_for(lambda: "set 'unit'" in driver.link().reason)


def test_a_variable_that_appears_later_or_is_made_anew_is_subscribed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua, "FIRST_RETRY", 0.2)
    monkeypatch.setattr(opcua, "LAST_RETRY", 0.2)
    port = free_port(socket.SOCK_STREAM)

    def of_late(samples: list[Sample]) -> int:
        return sum(sample.signal == "omega" for sample in samples)

    def is_missing(driver: opcua.OpcuaSubscriber) -> bool:
        return any("ns=2;s=omega" in line and "asked for again" in line for line in driver.link().warnings)

    with opcua_server(port, VALUES, "--late", "omega") as server, opened(port, tmp_path) as (driver, samples):
        for _ in range(2):
            before = of_late(samples)
            wait_for(lambda: is_missing(driver))
            server.send_signal(signal.SIGUSR1)
            wait_for(lambda: of_late(samples) > before + 50)  # noqa: B023 - called in this round
            assert not is_missing(driver)
            server.send_signal(signal.SIGUSR1)
        counters = driver.counters()
    times = [sample.time for sample in samples if sample.signal == "omega"]
    assert times == sorted(set(times)), "it is subscribed once"
    assert counters.reconnects == 0


def test_a_namespace_that_the_server_lacks_costs_only_its_signal(port: int, tmp_path: Path) -> None:
    nodes = {"i": "ns=2;s=i", "omega": "nsu=urn:moter;s=omega"}
    with opened(port, tmp_path, nodes=nodes) as (driver, samples):
        wait_for(lambda: len(samples) > 10)
        (warning,) = driver.link().warnings
        assert "'urn:moter': did you mean 'urn:motor'?" in warning
        assert {sample.signal for sample in samples} == {"i"}


@pytest.mark.parametrize(("before", "after"), [("urn:motor,urn:pump", "urn:pump,urn:motor")])
def test_a_server_that_renumbers_its_namespaces_is_not_read_as_if_nothing_had_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str
) -> None:
    monkeypatch.setattr(reconnection, "BACKOFF_MAX", 0.3)
    port, nodes = free_port(socket.SOCK_STREAM), {"i": "ns=2;s=i", "omega": "nsu=urn:motor;s=omega"}
    with opened(port, tmp_path, nodes=nodes) as (driver, samples):
        with opcua_server(port, VALUES, "--namespaces", before):
            wait_for(lambda: len(samples) > 20)
            assert not driver.link().defect
        wait_for(lambda: not driver.link().up)
        with opcua_server(port, VALUES, "--namespaces", after):
            wait_for(lambda: driver.link().up)
            assert_each_says([driver.link().defect], ("'urn:motor'", "ns=2", "ns=3", "write nsu=urn:motor"))
            count = len(samples)
            wait_for(lambda: {sample.signal for sample in samples[count:]} == {"i", "omega"})
        wait_for(lambda: not driver.link().up)
        with opcua_server(port, VALUES, "--namespaces", "urn:pump"):
            wait_for(lambda: "'urn:motor'" in driver.link().reason)
            assert "lacks" in driver.link().defect
    assert {(sample.signal, sample.value) for sample in samples} == {("i", 2.0), ("omega", 10.0)}


SPACES = ["http://opcfoundation.org/UA/", "urn:server", "urn:a;b%", "urn:motor"]


@pytest.mark.parametrize("name", ["nsu=urn:motor;s=a;b=1", "nsu=urn:server;i=7", "nsu=urn:a%3Bb%25;s=x", "i=2267"])
def test_a_lasting_name_is_read_as_the_node_that_it_names(name: str) -> None:
    placed = place(name, SPACES, "")
    assert lasting_name(placed.node, SPACES) == name
    assert place(name, SPACES[::-1], placed.namespace).namespace == placed.namespace or not placed.node.NamespaceIndex
    assert not placed.moved


def test_without_the_uris_of_its_namespaces_a_server_is_read_by_their_numbers() -> None:
    assert place("ns=2;s=i", [], "").node.NamespaceIndex == 2
    assert lasting_name(place("ns=2;s=i", [], "").node, []) == "ns=2;s=i"
    assert lasting_name(place("ns=1;s=i", ["a", "b", "b"], "").node, ["a", "b", "b"]) == "ns=1;s=i"
    with pytest.raises(ValueError, match="urn:motor"):
        place("ns=2;s=i", [], "urn:motor")


def test_a_server_of_another_kind_and_none_are_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with opened(port, tmp_path, timeout="0.2 s") as (driver, _):
            wait_for(lambda: "no answer within" in driver.link().reason)
            other.close()
            wait_for(lambda: driver.link().reason == "Connection refused")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("certificates")
    for name in ("server", "client", "stranger"):
        certificate(folder, name)
    certificate(folder, "expired", until=timedelta(hours=-1))
    (folder / "trusted").mkdir()
    for name in ("client", "expired"):
        (folder / "trusted" / f"{name}.der").write_bytes((folder / f"{name}.der").read_bytes())
    for name, text in (("password", "secret\n"), ("wrong", "guess\n")):
        (folder / name).touch(mode=0o600)
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def secure(folder: Path) -> Iterator[int]:
    port = free_port(socket.SOCK_STREAM)
    files = (
        "--certificate",
        folder / "server.der",
        "--key",
        folder / "server.pem",
        "--trusted",
        folder / "trusted",
    )
    with opcua_server(port, VALUES, *map(str, files), "--user"):
        yield port


def keys_of(folder: Path, name: str = "client", **changed: Any) -> dict[str, Any]:
    keys = {"security": "Basic256Sha256", "certificate": folder / f"{name}.der", "key": folder / f"{name}.pem"}
    user = {"user": "otolith", "password_file": "password", "server_certificate": folder / "server.der"}
    return keys | user | changed


def test_values_come_signed_and_encrypted(secure: int, folder: Path) -> None:
    with opened(secure, folder, **keys_of(folder)) as (driver, samples):
        wait_for(lambda: len(samples) > 50)
        assert driver.link().up
        assert driver.link().warnings == ()


def test_a_certificate_of_another_host_is_a_warning(secure: int, folder: Path) -> None:
    keys: dict[str, Any] = {"server_certificate": None, "endpoint": f"opc.tcp://localhost:{secure}/motor"}
    with opened(secure, folder, **keys_of(folder, **keys)) as (driver, _):
        wait_for(lambda: driver.link().up)
        assert "the server's certificate is of 127.0.0.1 instead of localhost" in driver.link().warnings[0]


def test_an_expired_certificate_is_a_warning(folder: Path) -> None:
    served = x509.load_der_x509_certificate((folder / "server.der").read_bytes())
    now = datetime.now(UTC)
    assert certificate_warnings(served, "127.0.0.1", now) == certificate_warnings(served, None, now) == []
    (line,) = certificate_warnings(served, None, now + timedelta(days=2))
    assert f"to {served.not_valid_after_utc:%Y-%m-%d} only: renew it" in line


def test_a_certificate_with_a_faulty_extension_has_no_host() -> None:
    served = MagicMock(not_valid_before_utc=datetime.min.replace(tzinfo=UTC), not_valid_after_utc=datetime.now(UTC))
    served.extensions.get_extension_for_class.side_effect = ValueError("error parsing asn1 value")
    assert certificate_warnings(served, "plc", served.not_valid_after_utc) == []


@pytest.mark.parametrize(
    ("name", "changed", "reason"),
    [
        ("expired", {}, "takes the certificate .*expired.der as expired: renew it"),
        ("stranger", {}, "refuses the certificate"),
        ("client", {"password_file": "wrong"}, "refuses user 'otolith': is the password right?"),
        ("client", {"server_certificate": "stranger.der"}, "the server's certificate is not that of"),
        ("client", {"mode": "sign"}, "the server has not Basic256Sha256, sign; it offers"),
    ],
)
def test_each_refusal_is_a_line_with_its_cause(
    secure: int, folder: Path, name: str, changed: dict[str, Any], reason: str
) -> None:
    with opened(secure, folder, **keys_of(folder, name, **changed)) as (driver, samples):
        wait_for(lambda: driver.link().reason != "not connected yet")
        assert re.search(reason, driver.link().reason)
    assert samples == []


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"key": "stranger.pem"}, "is not the key of"),
        ({"certificate": "password"}, "is no X.509 certificate"),
        ({"key": "password"}, "is no private key"),
        ({"password_file": "absent"}, "absent: cannot be read"),
    ],
)
def test_a_wrong_file_is_refused_before_connecting(folder: Path, changed: dict[str, Any], fault: str) -> None:
    keys = keys_of(folder, **changed) | {"endpoint": "opc.tcp://127.0.0.1:1"}
    with pytest.raises(ConfigurationError, match=fault):
        opcua.build(opcua.Options.model_validate(keys), setup_of(folder, i="ns=2;s=i"))


@pytest.mark.parametrize(
    "keys",
    [
        {"endpoint": "http://plc"},
        {"endpoint": "opc.tcp://user:secret@plc:4840"},
        {"endpoint": "opc.tcp://plc", "security": "Basic256Sha256"},
        {"endpoint": "opc.tcp://plc", "user": "otolith"},
    ],
)
def test_options_that_do_not_fit_are_refused(keys: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"endpoint|set"):
        opcua.Options.model_validate(keys)


def test_probe_lists_the_variables_with_value_type_and_unit(port: int) -> None:
    command = ["probe", "opcua", f"opc.tcp://127.0.0.1:{port}/motor"]
    result = CliRunner().invoke(cli, command, standalone_mode=False, catch_exceptions=False)
    assert 'i = { node = "nsu=urn:motor;s=i" }  # i: 2.0 A, Double' in result.output
    assert (
        'bad = { node = "nsu=urn:motor;s=bad" }  # bad: None A, Double' in result.output
        or "BadSensorFailure" in result.output
    )
    assert 'omega = { node = "nsu=urn:motor;s=omega", unit = "?" }  # omega: 10.0, Double' in result.output
    some = CliRunner().invoke(cli, [*command, "--most", "2"], standalone_mode=False).output
    assert "2 variables, as many as --most allows" in some
    document = json.loads(CliRunner().invoke(cli, [*command, "--json"], standalone_mode=False).output)
    assert [(one["node"], one["unit"]) for one in document["variables"]][:2] == [
        ("nsu=urn:motor;s=i", "A"),
        ("nsu=urn:motor;s=omega", ""),
    ]


def test_probe_of_no_server_is_one_line() -> None:
    with raises_saying(DeviceError, "Connection refused", "port"):
        CliRunner().invoke(
            cli, ["probe", "opcua", "opc.tcp://127.0.0.1:9"], standalone_mode=False, catch_exceptions=False
        )


def test_windows_wait_for_the_messages_of_a_slow_subscription(port: int, tmp_path: Path) -> None:
    with opened(port, tmp_path, interval="0.4 s") as (driver, samples):
        assert driver.link().latency == pytest.approx(0.4)

        def is_complete() -> bool:
            """Whether none of the next samples is lost; a busy computer may renew the server's values late."""
            begun, lost = len(samples), driver.counters().lost
            wait_for(lambda: len(samples) > begun + 100)
            return driver.counters().lost == lost

        wait_for(is_complete)
