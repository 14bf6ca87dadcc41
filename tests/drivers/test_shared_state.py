"""What a driver states of its connection is right at whatever moment its receiving thread changes it."""

import itertools
import logging
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from asyncua import ua

from otolith_drivers import mqtt
from otolith_drivers.base import Driver, Setup, Signal
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.driver import CanReceiver
from otolith_drivers.common.message_times import PeriodEstimator
from otolith_drivers.common.reconnection import Reconnection
from otolith_drivers.modbus.client import ExceptionReplyError
from otolith_drivers.opcua import driver as opcua
from tests.drivers.can_frames import dbc, decoder, frame
from tests.drivers.interleaving import interleaved
from tests.drivers.modbus_readers import poller, source

LONG_AGO = 100.0  # s
SEEDS = range(10)
Steps = tuple[Callable[[], object], ...]

DRIVE = dbc(
    'BO_ 256 Drive: 8 Drive\n SG_ Current : 0|16@1- (0.01,0) [0|0] "A" Monitor\n'
    ' SG_ AliveCounter : 16|4@1+ (1,0) [0|15] "" Monitor',
    'BO_ 257 Encoder: 8 Drive\n SG_ Speed : 0|16@1- (0.01,0) [0|0] "rad/s" Monitor',
)


def times_that_come_and_go(take: Callable[[float], object], period: float) -> Steps:
    """Messages that make a period known, and messages that make it unknown again; all of them long ago."""
    clock = itertools.accumulate(itertools.repeat(period), initial=time.monotonic() - LONG_AGO)

    def regular() -> None:
        for _ in range(60):
            take(next(clock))

    def irregular() -> None:
        for _ in range(32):
            take([next(clock) for _ in range(8)][-1])

    return regular, irregular


def can_receiver(folder: Path) -> tuple[Driver, Steps]:
    signals = {"i": ("A", {"signal": "Current"}), "omega": ("rad/s", {"signal": "Speed"})}
    frames = decoder(folder, signals, DRIVE)
    driver = CanReceiver(BusOptions(interface="virtual"), frames)
    messages = [frame(identifier, bytes(8)) for identifier in (256, 257)]
    steps = times_that_come_and_go(lambda at: [frames.decode(message, at) for message in messages], 1e-3)
    driver.open(lambda _: None)
    assert driver._hearing is not None
    up, down = up_and_down(driver._hearing.channel.connection)
    return driver, (up, up, up, *steps, *steps, down)


def mqtt_listener(_: Path) -> tuple[Driver, Steps]:
    signal = Signal("i", "A", mqtt.Source(topic="t", field="i", unit="A"))
    driver = mqtt.build(mqtt.Options(host="127.0.0.1", time="at", time_format="s"), Setup((signal,), Path(), 0.01))
    take = driver._messages.take
    steps = times_that_come_and_go(lambda at: take("t", b'{"i": 1, "at": %r}' % at, at, retained=False), 1e-3)
    bad = (lambda: take("t", b"nonsense", time.monotonic(), retained=False), lambda: take("t", b"1", 0, retained=True))
    up, down = up_and_down(driver._connection)
    return driver, (up, up, *steps, *bad, down)


def opcua_subscriber(_: Path) -> tuple[Driver, Steps]:
    signal = Signal("i", "A", opcua.Source(node="ns=2;s=i", unit="A"))
    driver = opcua.build(opcua.Options(endpoint="opc.tcp://127.0.0.1:4840"), Setup((signal,), Path(), 0.01))
    readings, numbers = driver._readings, itertools.count()
    (node,) = readings.signals

    def fault() -> None:
        node.fault = "no such node"
        readings.clock.exchange(0.0, next(numbers), 1.0)

    def no_fault() -> None:
        node.fault = ""
        message = ua.NotificationMessage(next(numbers), datetime.now(UTC), [])
        readings.take(message, [(0, ua.DataValue(ua.Variant("text"), ua.StatusCode(0)))], time.monotonic())

    up, down = up_and_down(driver._connection)
    return driver, (up, fault, no_fault, down)


def modbus_poller(_: Path) -> tuple[Driver, Steps]:
    driver = poller(1, [source(register=register) for register in (0, 2, 300)])
    schedule, requests = driver._schedule, driver._requests
    schedule.start(time.monotonic())
    clock = itertools.accumulate(itertools.repeat(0.01), initial=time.monotonic())

    def fast() -> None:
        for _ in range(schedule._starts.maxlen or 0):
            schedule.begin(next(clock))
            schedule.end(0.001, repeated=False)

    def down() -> None:
        schedule.pass_over(next(clock) + 1.0)
        driver._trips.append(0.001)
        for request in requests.requests:
            requests.unanswered(request, "no reply", next(clock))

    def refused() -> None:
        for request in requests.requests:
            requests.answered(request)
            requests.refused(request, ExceptionReplyError(2), next(clock))

    up, connection_down = up_and_down(driver._connection)
    return driver, (up, fast, down, refused, connection_down)


def up_and_down(connection: Reconnection) -> Steps:
    return (lambda: connection.come_up("answers")), (lambda: connection.go_down("the connection was closed"))


@pytest.mark.parametrize("build", [can_receiver, mqtt_listener, opcua_subscriber, modbus_poller])
def test_the_link_is_right_whenever_the_receiving_thread_changes_it(
    build: Callable[[Path], tuple[Driver, Steps]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    driver, steps = build(tmp_path)
    caplog.set_level(logging.CRITICAL)
    for step in steps:
        step()
    for seed in SEEDS:
        with interleaved("otolith_drivers", steps, seed) as other:
            link, counters = driver.link(), driver.counters()
        assert link.up is not bool(link.reason), link
        assert all(line.strip(": ") == line and "None" not in line for line in link.warnings), link
        assert not any(word in link.plan for word in ("nan", "inf")), link
        assert counters.received >= 0
        assert other.taken
    driver.close()


def test_a_period_that_becomes_unknown_while_it_is_described() -> None:
    periods = PeriodEstimator()
    steps = times_that_come_and_go(periods.lost_before, 1e-3)
    texts = set()
    for seed in SEEDS:
        with interleaved("otolith_drivers", steps, seed):
            texts |= {periods.describe(), periods.describe()}
    assert any("not known" in text for text in texts)
    assert any("came every" in text for text in texts)
