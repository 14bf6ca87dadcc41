"""Messages of a subscription: gaps, dropped values, stamps, values that stay. Without a server."""

import math
from datetime import UTC, datetime

import pytest
from asyncua import ua

from otolith_drivers.base import Conversion, Sample, Signal
from otolith_drivers.common.message_times import ArrivalClock, ExchangeClock
from otolith_drivers.opcua.connection import OpcuaSource
from otolith_drivers.opcua.driver import OVERFLOW, Readings

BEGUN = 1_700_000_000.0  # s, of the server's clock; the local one is 0 then
INTERVAL, PERIOD = 0.05, 0.01  # s


class Server:
    """Sends messages of one signal to readings whose clock is known."""

    def __init__(self, *, use_server_stamps: bool = False) -> None:
        source = OpcuaSource(node="ns=2;s=i", unit="A")
        self.readings = Readings([Signal("i", "A", source)], PERIOD, use_server_stamps=use_server_stamps)
        self.readings.signals[0].conversion = Conversion.of(source, "A", "A")
        self.readings.clock.exchange(-0.001, BEGUN, 0.001)
        self.readings.begin(INTERVAL)
        self.number = 0

    def send(self, time: float, *values: tuple[float, object], status: int = 0, skip: int = 0) -> list[Sample]:
        self.number += bool(values) + skip
        message = ua.NotificationMessage(self.number + (not values), stamp(time), [])
        items = [
            (0, ua.DataValue(ua.Variant(value), ua.StatusCode(status), SourceTimestamp=stamp(at)))
            for at, value in values
        ]
        return self.readings.take(message, items, time + 0.001)


def stamp(time: float) -> datetime:
    return datetime.fromtimestamp(BEGUN + time, UTC)


def pairs(samples: list[Sample]) -> list[tuple[float, float]]:
    return [(round(sample.time, 4), sample.value) for sample in samples]


def test_samples_have_the_time_of_their_source() -> None:
    assert pairs(Server().send(0.06, (0.02, 1.0), (0.03, 2.0))) == [(0.02, 1.0), (0.03, 2.0)]


def test_a_value_that_stays_is_repeated_and_ends_where_it_changes() -> None:
    server = Server()
    server.send(0.05, (0.04, 1.0))
    repeated = [sample for index in range(2, 12) for sample in server.send(INTERVAL * index)]
    assert {value for _, value in pairs(repeated)} == {1.0}
    assert pairs(repeated)[-1][0] == pytest.approx(0.5, abs=0.01)
    assert pairs(server.send(0.6, (0.58, 3.0))) == [(0.57, 1.0), (0.58, 3.0)]
    assert server.readings.bad == server.readings.lost == 0


def test_a_first_value_that_is_old_counts_from_now_on() -> None:
    server = Server()
    assert server.send(0.0, (-9000.0, 1.0)) == []
    later = [sample for index in range(1, 20) for sample in server.send(INTERVAL * index)]
    assert {value for _, value in pairs(later)} == {1.0}
    assert min(time for time, _ in pairs(later)) >= -INTERVAL - 0.01
    assert server.readings.bad == 0


@pytest.mark.parametrize("age", [-30.0, 30.0, 3600.0])
def test_stamps_of_another_clock_are_bad_and_do_not_stay(age: float) -> None:
    server = Server()
    server.send(0.05, (0.04, 1.0))
    assert server.send(0.1, (0.1 - age, 2.0)) == []
    assert [sample for index in range(3, 12) for sample in server.send(INTERVAL * index)] == []
    assert server.readings.bad == 1
    assert 'stamps = "server"' in server.readings.signals[0].warnings(0.2)[0]


def test_missing_messages_and_dropped_values_are_lost() -> None:
    server = Server()
    server.send(0.05, (0.04, 1.0))
    server.send(0.15, (0.14, 1.0), skip=2)
    assert server.readings.lost == 2
    server.send(0.2, (0.19, 1.0), status=OVERFLOW)
    assert server.readings.lost == 3
    server.send(0.25)
    server.send(0.3, (0.29, 1.0))
    assert server.readings.lost == 3


@pytest.mark.parametrize("value", ["text", None, float("inf"), [1.0, 2.0]])
def test_what_is_no_number_is_no_reading(value: object) -> None:
    server = Server()
    (sample,) = server.send(0.05, (0.04, value))
    assert math.isnan(sample.value)
    assert server.readings.bad == 1
    assert server.send(0.5) == []


def test_times_never_decrease() -> None:
    server = Server()
    server.send(0.05, (0.04, 1.0))
    assert server.send(0.1, (0.03, 2.0)) == []
    assert server.readings.bad == 1


def test_an_exchange_bounds_the_offset_and_a_set_clock_is_noticed() -> None:
    clock = ExchangeClock()
    for index in range(20):
        sent = 2.0 * index
        clock.exchange(
            sent, sent + 100.0 + 1e-4 * sent + 0.003, sent + 0.004
        )  # it drifts by 100 ppm; 3 ms there, 1 ms back
        assert abs(clock.offset + 100.0 + 1e-4 * sent) <= clock.error <= 0.003
    assert clock.steps == 0
    clock.exchange(50.0, 50.0 - 3600.0, 50.002)
    assert (clock.steps, round(clock.offset)) == (1, 3600)
    assert not clock.arrival(50.1 + 3600.0, 50.1)


def test_the_clock_of_a_sender_follows_its_drift_and_its_steps() -> None:
    clock = ArrivalClock()
    for index in range(6000):
        now, late = 0.01 * index, 0.002 + 0.01 * (index % 7)
        clock.arrival(now + 5.0 + 1e-4 * now, now + late, 0.2)
        if index > 10:
            assert abs(clock.offset + 5.0 + 1e-4 * now) < 0.005
    for index in range(2500):
        now = 60.0 + 0.01 * index
        clock.arrival(now - 3600.0, now + 0.002, 0.2)
    assert clock.offset == pytest.approx(3600.002, abs=0.001)
