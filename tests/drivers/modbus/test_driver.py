"""The Modbus driver over TCP, with devices that are slow, refuse requests, or are missing."""

import contextlib
import re
import socket
import threading
import time
from collections.abc import Sequence

import pytest

from otolith_drivers.base import Link, Sample
from otolith_drivers.errors import ConfigurationError
from tests.conftest import free_port
from tests.drivers.modbus_readers import PERIOD, TWO, Listener, floats, poller, source
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import wait_for, within


def test_only_function_codes_3_and_4_are_sent() -> None:
    """Recorded by the server, through success, refusal, silence and reconnection."""
    behaviour = Behaviour(floats(24.0, 1.5), refuse=lambda _, address, __: 2 if address == 50 else None)
    port = free_port(socket.SOCK_STREAM)
    sources = [source(register=0), source(register=2, table="input"), source(register=50)]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        listener.wait(lambda link: any("refused" in line for line in link.warnings))
        behaviour.silent = lambda _: True
        listener.wait(lambda link: not link.up)
        behaviour.silent = lambda _: False
        listener.wait(lambda link: link.up)
    assert set(behaviour.functions) == {3, 4}


def test_each_sample_of_the_grid_is_received_or_lost() -> None:
    """Across a restart of the server, received + lost is what was requested."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    begun = time.monotonic()
    with Listener(poller(port, TWO)) as listener:
        opened = time.monotonic()
        with odd_server(behaviour, port):
            listener.wait(lambda link: link.up)
        listener.wait(lambda link: not link.up)
        with odd_server(behaviour, port):
            listener.wait(lambda link: link.up)
            count = len(listener.samples)
            wait_for(lambda: len(listener.samples) > count + 20)
        last = listener.samples[-1].time
    elapsed = time.monotonic() - begun
    counters = listener.driver.counters()
    assert counters.received == len(listener.samples)
    assert counters.bad == 0
    assert counters.reconnects >= 1  # more if an answer timed out on a busy computer
    requested = (counters.received + counters.lost) / len(TWO)
    # The last backoff may not be counted yet.
    assert (last - opened - 0.3) / PERIOD <= requested <= elapsed / PERIOD + 1.0
    assert counters.lost > 0


def test_refused_register_affects_no_other() -> None:
    """In a request with others it makes the device refuse all: the request is split until it is alone."""
    behaviour = Behaviour(floats(24.0, 1.5, 7.0), refuse=lambda _, at, count: 2 if at <= 2 < at + count else None)
    port = free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, [*TWO, source(register=4)])) as listener:
        listener.wait(lambda link: any("s1" in line and "illegal data address" in line for line in link.warnings))
        count = len(listener.of("s2"))
        wait_for(lambda: len(listener.of("s2")) > count + 20)
        assert {sample.value for sample in listener.of("s0")} == {24.0}
        assert {sample.value for sample in listener.of("s2")} == {7.0}
        assert not listener.of("s1")
        behaviour.refuse = lambda *_: None
        wait_for(lambda: bool(listener.of("s1")))
        listener.wait(lambda link: not link.warnings)


def test_requests_are_split_to_the_devices_limit() -> None:
    sources = [source(register=4 * index) for index in range(20)]
    behaviour = Behaviour(floats(*([3.0] * 40)), refuse=lambda _, __, count: 3 if count > 16 else None)
    port = free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, sources, 0.02)) as listener:
        wait_for(lambda: all(listener.of(f"s{index}") for index in range(20)))
        listener.wait(lambda link: not link.warnings)


def test_dead_device_does_not_stop_another() -> None:
    """On the same line; it is retried, and read when it is back."""
    behaviour, port = Behaviour(floats(24.0, 1.5), silent=lambda device: device == 2), free_port(socket.SOCK_STREAM)
    sources = [source(register=0, device=1), source(register=2, device=2)]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        listener.wait(lambda link: any("device 2 does not answer" in line for line in link.warnings))
        assert listener.driver.link().up
        count = len(listener.of("s0"))
        wait_for(lambda: len(listener.of("s0")) > count + 50)
        behaviour.silent = lambda _: False
        wait_for(lambda: bool(listener.of("s1")))
        listener.wait(lambda link: not link.warnings)


def test_sample_time_is_the_middle_of_the_round_trip() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    middles: list[float] = []

    def slow(reply: bytes) -> bytes:
        begun = time.monotonic()
        time.sleep(0.02)
        middles.append(0.5 * (begun + time.monotonic()))  # a busy computer may sleep longer
        return reply

    behaviour.corrupt = slow
    with odd_server(behaviour, port), Listener(poller(port, TWO, 0.1)) as listener:
        wait_for(lambda: len(listener.of("s0")) >= 25)
    behind = [middle - sample.time for middle, sample in zip(middles, listener.of("s0"), strict=False)]
    # A busy computer holds up one way of most round trips. The time of a request or a reply is never nearer than 10 ms.
    assert min(map(abs, behind)) < 0.004


@pytest.mark.timed
def test_slow_line_reports_its_achieved_rate() -> None:
    """And polls evenly on a coarser grid."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)

    def slow(reply: bytes) -> bytes:
        time.sleep(0.02)
        return reply

    behaviour.corrupt = slow
    with odd_server(behaviour, port), Listener(poller(port, TWO)) as listener:
        listener.wait(lambda link: link.period is not None and "not known" not in link.plan)
        link = listener.driver.link()
        assert link.period is not None
        assert 0.02 < link.period < within(0.05)
        assert "100 Hz asked" in link.plan
        listener.wait(keeps_its_period)


def keeps_its_period(link: Link) -> bool:
    """Whether the driver polls at the rate of its period; a busy computer keeps it only now and then."""
    achieved = re.search(r"([\d.]+) achieved", link.plan)
    if achieved is None or link.period is None:
        return False
    return float(achieved[1]) == pytest.approx(1 / link.period, rel=0.1)


def test_line_that_breaks_each_round_still_delivers() -> None:
    """The device closes the connection after each first answer."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)

    def close_connection(reply: bytes) -> bytes:
        if behaviour.asked[-1][2] == 50:
            raise OSError
        return reply

    behaviour.corrupt = close_connection
    with odd_server(behaviour, port), Listener(poller(port, [source(register=0), source(register=50)])) as listener:
        wait_for(lambda: len(listener.of("s0")) > 25)


@pytest.mark.timed
def test_unresponsive_host_does_not_delay_close() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as full, contextlib.ExitStack() as stack:
        for _ in range(4):  # beyond its backlog, connections are not answered
            waiting = stack.enter_context(socket.socket())
            waiting.setblocking(False)
            waiting.connect_ex(full.getsockname())
        driver = poller(full.getsockname()[1], TWO, timeout="10 s")
        driver.open(lambda _: None)
        time.sleep(0.2)  # long enough to begin to connect
        begun = time.monotonic()
        driver.close()
        assert time.monotonic() - begun < within(0.5)
    assert not [thread for thread in threading.enumerate() if thread.name == "modbus-poll"]


def test_close_logs_no_warning(caplog: pytest.LogCaptureFixture) -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)

    def slow(reply: bytes) -> bytes:
        time.sleep(0.02)  # so that close interrupts a request
        return reply

    behaviour.corrupt = slow
    with odd_server(behaviour, port):
        for _ in range(3):
            with Listener(poller(port, TWO)) as listener:
                wait_for(lambda: len(listener.of("s0")) > 0)
    assert not [record.message for record in caplog.records if record.levelname == "WARNING"]


def test_unreachable_host_is_retried() -> None:
    port = free_port(socket.SOCK_STREAM)
    with Listener(poller(port, TWO)) as listener:
        listener.wait(lambda link: "refused" in link.reason)
        assert not listener.driver.link().up
    assert not [thread for thread in threading.enumerate() if thread.name == "modbus-poll"]


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"register": 65535, "type": "float32"}, "registers go from 0 to 65535"),
        ({"register": 0, "unit": "A"}, "does not measure what 'V' does"),
    ],
)
def test_invalid_signal_names_its_key(keys: dict[str, object], sentence: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        poller(502, [source(**keys)])
    assert sentence in str(caught.value)
    assert caught.value.key == ("signals", "s0")


def test_failing_deliver_does_not_end_the_thread() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    calls: list[int] = []

    def deliver(samples: Sequence[Sample]) -> None:
        calls.append(len(samples))
        if len(calls) == 3:
            raise ValueError("a bug")

    driver = poller(port, TWO)
    with odd_server(behaviour, port):
        driver.open(deliver)
        wait_for(lambda: len(calls) > 20)
        assert driver.link().up
        driver.close()
