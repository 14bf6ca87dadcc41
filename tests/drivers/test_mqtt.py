"""The MQTT driver against a real broker in another process: retained and damaged messages, times, faults, TLS."""

import json
import math
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers import mqtt
from otolith_drivers.base import Sample, Sampling, Setup, Signal
from otolith_drivers.config_files import validated
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.mqtt import MAX_PAYLOAD, Messages, at
from tests.conftest import free_port
from tests.drivers.certificates import certificate
from tests.drivers.mqtt_broker import broker_of_this_process, mqtt_broker, publisher
from tests.messages import assert_says, raises_saying
from tests.waiting import wait_for

STEP = 0.02  # s
SPEED = {"topic": "motor", "field": "values.speed", "unit": "rpm"}


def setup_of(folder: Path = Path(), **sources: dict[str, Any]) -> Setup:
    units = {"i": "A", "omega": "rad/s"}
    signals = [Signal(name, units[name], mqtt.Source.model_validate(source)) for name, source in sources.items()]
    return Setup(tuple(signals), folder, 0.01)


def messages(**keys: Any) -> Messages:
    options = mqtt.Options.model_validate({"host": "broker"} | keys)
    return Messages(options, setup_of(omega=SPEED).signals)


def document(speed: object, time: object = 0) -> bytes:
    return json.dumps({"t": time, "values": {"speed": speed}}).encode()


@contextmanager
def opened(port: int, setup: Setup, **keys: Any) -> Iterator[tuple[mqtt.MqttListener, list[Sample]]]:
    options = mqtt.Options.model_validate({"host": "127.0.0.1", "port": port} | keys)
    driver, samples = mqtt.build(options, setup), list[Sample]()
    driver.open(samples.extend)
    try:
        yield driver, samples
    finally:
        driver.close()


def test_a_retained_value_is_no_sample_and_damaged_messages_are_counted() -> None:
    setup = setup_of(i={"topic": "retained/i", "unit": "mA"})
    port = broker_of_this_process()
    with publisher(port) as client:
        client.publish("retained/i", "7000", retain=True, qos=1).wait_for_publish()
        with opened(port, setup, qos=1) as (driver, samples):
            wait_for(lambda: "1 retained message" in driver.link().plan)
            client.publish("retained/i", b"\xff garbage", qos=1)
            client.publish("retained/i", "2000", qos=1)
            wait_for(lambda: len(samples) == 1)
            assert driver.counters().bad == 1
            assert "is no number" in driver.link().warnings[0]
    assert samples[0].value == pytest.approx(2.0)


def test_a_machine_loses_nothing_while_the_topic_of_another_one_is_flooded() -> None:
    """Each has a client, and the broker a queue for each client: in one of both, the quiet one would lose messages."""
    port, count = broker_of_this_process(), 50
    flooded, quiet = (setup_of(i={"topic": f"flood/{name}", "unit": "A"}) for name in ("fast", "quiet"))
    with opened(port, flooded) as (fast, _), opened(port, quiet) as (slow, samples), publisher(port) as client:
        wait_for(lambda: fast.link().up and slow.link().up)
        for number in range(count):
            for _ in range(400):
                client.publish("flood/fast", "1" + " " * 1000)
            client.publish("flood/quiet", str(number))
        wait_for(lambda: len(samples) == count)
    assert [sample.value for sample in samples] == list(range(count))


def test_a_broker_that_is_killed_and_comes_back_costs_counted_samples(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    keys = {"time": "t", "time_format": "s"}
    with mqtt_broker(port, tmp_path) as broker, opened(port, setup_of(omega=SPEED), **keys) as (driver, samples):
        wait_for(lambda: driver.link().up)
        _send_until(port, lambda: len(samples) >= 60)
        broker.kill()
        broker.wait()
        wait_for(lambda: driver.link().reason == "Connection refused")
        with mqtt_broker(port, tmp_path):
            wait_for(lambda: driver.link().up)
            _send_until(port, lambda: len(samples) >= 90)
            counters = driver.counters()
    # The first sample after the pause, wherever it is: a message may have been on its way when the broker ended.
    missing = max(after.time - before.time for before, after in pairwise(samples)) / STEP - 1
    assert counters.reconnects == 1
    assert counters.lost >= missing - 3


def _send_until(port: int, enough: Callable[[], bool]) -> None:
    """Send a value with a time on a grid of ``STEP``, as it comes, until ``enough``."""
    sent = 0.0
    with publisher(port) as client:
        while not enough():
            moment = STEP * math.floor(time.time() / STEP)
            if moment > sent:
                client.publish("motor", document(60.0, moment))
                sent = moment
            time.sleep(0.2 * STEP)


# paho-mqtt leaves the socket of a handshake that fails to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_wrong_authority_and_an_expired_certificate_are_named_and_the_right_one_accepted(tmp_path: Path) -> None:
    from cryptography import x509  # noqa: PLC0415 - only here
    from cryptography.hazmat.primitives.serialization import Encoding  # noqa: PLC0415

    port, pems = free_port(socket.SOCK_STREAM), {}
    for name, valid in (("broker", 1), ("stranger", 1), ("expired", -1)):
        der, _ = certificate(tmp_path, name, until=timedelta(hours=valid))
        pems[name] = tmp_path / f"{name}.crt"
        pems[name].write_bytes(x509.load_der_x509_certificate(der.read_bytes()).public_bytes(Encoding.PEM))
    setup = setup_of(tmp_path, omega=SPEED)
    with mqtt_broker(port, tmp_path, tls=(pems["broker"], tmp_path / "broker.pem")):
        with opened(port, setup, tls=True, ca=pems["stranger"].name) as (driver, _):
            wait_for(lambda: "are ca, host and" in driver.link().reason)
        with opened(port, setup, tls=True, ca=pems["broker"].name) as (driver, _):
            wait_for(lambda: driver.link().up)
    with mqtt_broker(port, tmp_path, tls=(pems["expired"], tmp_path / "expired.pem")):  # noqa: SIM117 - as above
        with opened(port, setup, tls=True, ca=pems["expired"].name) as (driver, _):
            wait_for(lambda: "certificate has expired" in driver.link().reason)


def test_a_server_that_is_no_broker_and_files_that_are_none_are_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        with opened(other.getsockname()[1], setup_of(omega=SPEED)) as (driver, _):
            with other.accept()[0] as connection:
                connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            wait_for(lambda: "is one there" in driver.link().reason)
        assert not driver.link().up
    (tmp_path / "none").touch(mode=0o600)
    (tmp_path / "none").write_text("nothing")
    certificate(tmp_path, "own")
    for keys, fault in (
        ({"ca": "none"}, "none: is no X.509"),
        ({"ca": "own.der"}, "PEM"),
        ({"ca": "absent"}, "absent: cannot be read"),
        ({"certificate": "none", "key": "own.pem"}, "none: is no X.509"),
        ({"certificate": "own.der", "key": "none"}, "none: is no private key"),
        ({"user": "me", "password_file": "absent"}, "absent: cannot be read"),
    ):
        options = mqtt.Options.model_validate({"host": "a", "tls": True} | keys)
        with pytest.raises(ConfigurationError, match=fault):
            mqtt.build(options, setup_of(tmp_path, omega=SPEED))


@pytest.mark.parametrize(("time_format", "unit"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_a_time_field_keeps_the_spacing_of_the_sender(time_format: str, unit: float) -> None:
    read = messages(time="t", time_format=time_format)
    samples: list[Sample] = []
    for index in range(50):
        delay = 0.002 + 0.03 * (index % 5)
        stamp = (1.7e9 + 0.01 * index) * unit
        samples += read.take("motor", document(60.0, stamp), 5.0 + 0.01 * index + delay, retained=False)
    spacing = [after.time - before.time for before, after in pairwise(samples)]
    assert spacing == pytest.approx([0.01] * 49, abs=1e-4)
    assert samples[0].time == pytest.approx(5.002, abs=1e-4)
    assert read.bad == 0


def test_a_time_may_be_iso_8601_and_a_step_back_is_bad() -> None:
    read = messages(time="t", time_format="iso")
    assert read.take("motor", document(1.0, "2026-03-02T14:05:12.250+01:00"), 9.0, retained=False)
    assert read.take("motor", document(1.0, "2026-03-02T13:05:12.260Z"), 9.01, retained=False)
    assert not read.take("motor", document(1.0, "2026-03-02T13:05:02Z"), 9.02, retained=False)
    assert not read.take("motor", document(1.0, "yesterday"), 9.03, retained=False)
    assert "no ISO 8601" in read.topics["motor"].unusable.text
    assert read.bad == 2


@pytest.mark.parametrize("wrong", [1e15, 1.7e9 + 3600.0])
def test_one_time_from_the_future_costs_one_message(wrong: float) -> None:
    read = messages(time="t", time_format="s")
    for index in range(100):
        stamp, now = 1.7e9 + 0.01 * index, 5.0 + 0.01 * index
        samples = read.take("motor", document(60.0, wrong if index % 40 == 20 else stamp), now, retained=False)
        assert [sample.time for sample in samples] == pytest.approx([] if index % 40 == 20 else [now], abs=1e-4)
    assert read.bad == 2
    assert "ahead of the messages before it" in read.topics["motor"].unusable.text


def test_a_clock_that_is_set_ahead_costs_one_message() -> None:
    read = messages(time="t", time_format="s")
    taken = [
        bool(read.take("motor", document(60.0, now + (3600.0 if now > 7.0 else 0.0)), now, retained=False))
        for now in np.arange(5.0, 9.0, 0.01).tolist()
    ]
    assert taken.count(False) == read.bad == 1


@pytest.mark.parametrize(
    ("wrong", "shift", "settled"),
    [(range(100, 102), 30.0, 310), (range(100, 130), 30.0, 340), (range(100, 1000), -30.0, 310)],
    ids=["two wrong times", "thirty wrong times", "set back"],
)
def test_equal_wrong_times_and_a_clock_that_is_set_back_cost_two_seconds(
    wrong: range, shift: float, settled: int
) -> None:
    read = messages(time="t", time_format="s")
    for index in range(1000):
        now = 5.0 + 0.01 * index
        stamp = now + (shift if index in wrong else 0.0)
        samples = read.take("motor", document(60.0, stamp), now, retained=False)
        if index >= settled:
            assert [sample.time for sample in samples] == pytest.approx([now], abs=1e-6)
    assert 150 <= read.bad <= 210


def test_messages_that_were_held_up_for_a_second_do_not_move_the_clock() -> None:
    read = messages(time="t", time_format="s")
    for index in range(1000):
        stamp = 5.0 + 0.01 * index
        now = max(stamp, 8.0) if stamp > 7.0 else stamp  # the broker hangs for a second, and sends all at once
        samples = read.take("motor", document(60.0, stamp), now, retained=False)
        assert [sample.time for sample in samples] == pytest.approx([stamp], abs=1e-6)


def test_senders_with_two_clocks_do_not_move_each_other() -> None:
    options = mqtt.Options(host="broker", time="t", time_format="s")
    other = {"topic": "other", "field": "values.speed", "unit": "A"}
    read = Messages(options, setup_of(omega=SPEED, i=other).signals)
    for index in range(20):
        now = 5.0 + 0.01 * index
        (one,) = read.take("motor", document(1.0, now + 100.0), now + 0.001, retained=False)
        (two,) = read.take("other", document(1.0, now - 100.0), now + 0.001, retained=False)
        assert (one.time, two.time) == pytest.approx((now + 0.001, now + 0.001))


def test_what_a_message_lacks_is_named() -> None:
    read = messages()
    (sample,) = read.take("motor", b'{"values": {"torque": 1}}', 1.0, retained=False)
    assert math.isnan(sample.value)
    assert_says(read.topics["motor"].unusable.text, "values.speed", "torque")


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode) | st.just(b"[" * 50_000) | st.just(b"1" * 5000))
def test_no_message_raises(payload: bytes) -> None:
    read = messages(time="t")
    samples = read.take("motor", payload, 1.0, retained=False)
    usable = sum(math.isfinite(sample.value) for sample in samples)
    assert usable == read.received
    assert usable + min(read.bad, 1) == 1
    assert bool(read.topics["motor"].unusable.text) == bool(read.bad)


def test_a_huge_message_is_refused() -> None:
    read = messages()
    assert read.take("motor", b" " * (MAX_PAYLOAD + 1), 1.0, retained=False) == []
    assert read.bad == 1


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_no_value_in_a_message_raises(value: Any) -> None:
    read = messages()
    (sample,) = read.take("motor", document(value), 1.0, retained=False)
    assert math.isnan(sample.value) or isinstance(value, bool | int | float | str)
    assert read.bad == math.isnan(sample.value)


def test_paths_reach_into_lists() -> None:
    assert at({"axes": [{"speed": 3}]}, "axes[0].speed") == 3
    assert at([[1, 2]], "[0][1]") == 2


def test_a_list_at_the_root_is_read_by_its_index() -> None:
    """A list of readings, as gateways collect them, arrives over a real broker; field and time name one of them."""
    setup = setup_of(
        i={"topic": "list/root", "field": "[1].v.i", "unit": "A"},
        omega={"topic": "list/root", "field": "[0].n", "unit": "rad/s"},
    )
    port = broker_of_this_process()
    with opened(port, setup, time="[0].t", time_format="s") as (driver, samples), publisher(port) as client:
        wait_for(lambda: driver.link().up)
        for index in range(40):
            client.publish("list/root", json.dumps([{"t": 5.0 + STEP * index, "n": 7.0}, {"v": {"i": index}}]))
            time.sleep(STEP)
        wait_for(lambda: len(samples) == 80)
    times = np.array([sample.time for sample in samples if sample.signal == "i"])
    assert [sample.value for sample in samples if sample.signal == "i"] == list(range(40))
    assert (np.diff(times) > 0.0).all()
    # The clock of the sender is that of the message that was least late; on a busy computer it is not the first.
    assert np.diff(times[20:]) == pytest.approx(STEP, abs=0.01)


@pytest.mark.parametrize("path", ["a..b", "[x].t", "[0]..t", ".a", "a.", "[0]t", "a" * 201])
def test_a_wrong_path_is_named_in_words(path: str) -> None:
    tables = (({"host": "a", "time": path}, mqtt.Options), ({"topic": "t", "unit": "A", "field": path}, mqtt.Source))
    for table, model in tables:
        with raises_saying(ConfigurationError, path[:50], "axes[0].speed"):
            validated(table, model, ())


@pytest.mark.parametrize("key", ["Motor Speed", "Channel1.Device1.Speed", "DB1[0]", "a.b[0].c"])
def test_a_key_may_have_spaces_points_and_brackets(key: str) -> None:
    read = Messages(mqtt.Options(host="a"), setup_of(i={"topic": "t", "field": key, "unit": "A"}).signals)
    (sample,) = read.take("t", json.dumps({"x": 2, key: 1.5}).encode(), 1.0, retained=False)
    assert sample.value == 1.5
    nested = Messages(mqtt.Options(host="a"), setup_of(i={"topic": "t", "field": f"v.{key}", "unit": "A"}).signals)
    (sample,) = nested.take("t", json.dumps({"v": {key: 1.5}}).encode(), 1.0, retained=False)
    assert sample.value == 1.5


@pytest.mark.parametrize(
    ("payload", "value"),
    [("1.5", 1.5), (" +1.5e0\n", 1.5), ('"1.5"', 1.5), ("true", 1.0), ('"1.5 A"', None), ("1,5", None), ("1_5", None)],
)
def test_a_number_may_be_a_text(payload: str, value: float | None) -> None:
    """Some gateways write all values as texts; a number with its unit or with a comma is none."""
    plain = Messages(mqtt.Options(host="a"), setup_of(i={"topic": "t", "unit": "A"}).signals)
    samples = plain.take("t", payload.encode(), 1.0, retained=False)
    assert [sample.value for sample in samples if not math.isnan(sample.value)] == ([] if value is None else [value])
    assert plain.bad == (value is None)
    read = Messages(mqtt.Options(host="a"), setup_of(i={"topic": "t", "field": "v", "unit": "A"}).signals)
    read.take("t", f'{{"v": {json.dumps(payload)}}}'.encode(), 1.0, retained=False)
    assert read.bad == (payload not in {"1.5", " +1.5e0\n"})


@pytest.mark.parametrize("around", [("\ufeff", ""), ("", "\0"), ("\ufeff ", "\n\0")])
def test_a_mark_of_the_encoding_and_the_zero_at_the_end_of_a_c_string_are_no_fault(around: tuple[str, str]) -> None:
    text = '{"values": {"speed": 30}}'.join(around)
    (sample,) = messages().take("motor", text.encode(), 1.0, retained=False)
    assert sample.value == pytest.approx(math.pi)


def test_a_document_without_field_is_named() -> None:
    read = Messages(mqtt.Options(host="a"), setup_of(i={"topic": "t", "unit": "A"}).signals)
    assert read.take("t", b'{"value": 1.5}', 1.0, retained=False) == []
    assert read.topics["t"].unusable.text.endswith("is no number: set 'field' beside the topic")


@pytest.mark.parametrize(("written", "declared"), [(1.0, "ms"), (1e3, "s"), (1e3, "us"), (1e9, "ms")])
def test_times_in_another_unit_than_declared_are_named(written: float, declared: str) -> None:
    read = messages(time="t", time_format=declared)
    for index in range(200):
        read.take("motor", document(1.0, (1.7e9 + 0.01 * index) * written), 5.0 + 0.01 * index, retained=False)
    (line,) = read.topics["motor"].warnings(7.0, 5.0)
    assert "is time_format right?" in line
    assert "silent" not in line


def test_sampling_follows_from_the_times() -> None:
    for keys, sampling in (({}, Sampling.CYCLIC), ({"time": "t"}, Sampling.POLLED)):
        options = mqtt.Options.model_validate({"host": "a"} | keys)
        assert mqtt.build(options, setup_of(omega=SPEED)).sampling is sampling


@pytest.mark.parametrize(
    ("options", "source"),
    [
        ({}, {"topic": "motor/+", "unit": "A"}),
        ({}, {"topic": "motor", "field": "a..b", "unit": "A"}),
        ({"user": "me"}, {"topic": "motor", "unit": "A"}),
        ({"ca": "ca.pem"}, {"topic": "motor", "unit": "A"}),
        ({"time": "t"}, {"topic": "motor", "unit": "A"}),
        ({}, {"topic": "motor", "unit": "V"}),
    ],
)
def test_what_does_not_fit_is_refused(options: dict[str, Any], source: dict[str, Any]) -> None:
    with pytest.raises((ValueError, ConfigurationError)):
        mqtt.build(mqtt.Options.model_validate({"host": "a"} | options), setup_of(i=source))
