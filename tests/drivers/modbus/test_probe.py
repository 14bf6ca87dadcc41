"""The survey, scan and timing of the probe, against devices that refuse, are busy or silent."""

import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from otolith_drivers.errors import DeviceError
from otolith_drivers.modbus.client import ReadOnlyClient
from otolith_drivers.modbus.options import LineOptions
from otolith_drivers.modbus.probe import (
    Block,
    ProbeClient,
    Speed,
    numbers_of,
    open_line,
    possible_rate,
    renewal_of,
    scan,
    spans,
    speeds,
    survey,
    watch,
)
from tests.conftest import free_port
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.messages import assert_each_says


@contextmanager
def connected(behaviour: Behaviour, timeout: str = "0.1 s") -> Iterator[ProbeClient]:
    port = free_port(socket.SOCK_STREAM)
    options = LineOptions.model_validate({"host": "127.0.0.1", "port": port, "timeout": timeout})
    line = ReadOnlyClient(options)
    with odd_server(behaviour, port):
        open_line(line, options)
        yield ProbeClient(line, options, 1, "holding")
        line.close()


def never() -> bool:
    return False


def quiet(_: str) -> None:
    pass


def device_with(registers: set[int]) -> Behaviour:
    """A device that has these registers only, and refuses a request for any other."""
    return Behaviour(
        {}, refuse=lambda _, address, count: None if set(range(address, address + count)) <= registers else 2
    )


@pytest.mark.parametrize(
    "registers",
    [
        set(range(20)) | {*range(40, 44)},
        {0},
        {63},
        {1, 3, 5},
        set(range(64)),
        set(np.random.default_rng(4).integers(0, 64, 20).tolist()),
    ],
)
def test_survey_lists_exactly_the_readable_registers(registers: set[int]) -> None:
    behaviour = device_with(registers)
    with connected(behaviour) as client:
        result = survey(client, 0, 63, never, quiet)
    readable = {at for block in result.blocks for at in range(block.address, block.end)}
    assert readable == registers
    assert set(result.refused) == set(range(64)) - registers
    for one, other in zip(result.blocks, result.blocks[1:], strict=False):
        assert one.end < other.address, "what can be read at once is"
    assert set(behaviour.functions) == {3}, "nothing but reading is ever asked for"


def test_survey_is_described_in_words() -> None:
    with connected(device_with({*range(20), *range(60, 64)})) as client:
        lines = survey(client, 0, 63, never, quiet).describe(first_address=1)
    assert_each_says(lines, ("1 to 20", "61 to 64", "can be read"), ("21 to 60", "refused", "illegal data address"))


def test_survey_measures_the_devices_limit() -> None:
    with connected(Behaviour({}, refuse=lambda _, __, count: 3 if count > 32 else None)) as client:
        result = survey(client, 0, 99, never, quiet)
    assert {at for block in result.blocks for at in range(block.address, block.end)} == set(range(100))
    assert 24 <= result.max_registers <= 32


def test_survey_keeps_register_pairs_whole() -> None:
    behaviour = Behaviour({}, refuse=lambda _, at, count: 2 if at % 2 or count % 2 or at + count > 30 else None)
    with connected(behaviour) as client:
        result = survey(client, 0, 63, never, quiet)
    assert result.blocks == [Block(0, 30)]


def test_busy_device_is_asked_again() -> None:
    answers = iter([6, 6, None, None, None])
    with connected(Behaviour({0: 7}, refuse=lambda *_: next(answers))) as client:
        assert survey(client, 0, 0, never, quiet).blocks == [Block(0, 1)]


def test_silent_device_is_an_error_with_a_remedy() -> None:
    with (
        connected(Behaviour({}, silent=lambda _: True)) as client,
        pytest.raises(DeviceError, match=r"no answer.*--scan"),
    ):
        survey(client, 0, 63, never, quiet)


def test_gateway_without_the_device_is_an_error() -> None:
    with connected(Behaviour({}, refuse=lambda *_: 11)) as client, pytest.raises(DeviceError, match="gateway"):
        survey(client, 0, 63, never, quiet)


def test_watch_reads_repeatedly_and_times_requests() -> None:
    with connected(Behaviour({3: 77})) as client:
        result = survey(client, 0, 9, never, quiet)
        client.round_trips.clear()
        readings, changes = watch(client, result.blocks, 0.3, never, quiet)
        assert not any(changes[Block(0, 10)]), "nothing has changed"
        assert [block for block, _ in readings.items()] == [Block(0, 10)]
        words = readings[Block(0, 10)]
        assert words.shape[0] >= 5
        assert set(words[:, 3]) == {77}
        (speed,) = speeds(client, result.blocks)
    assert 0.0 < speed.median <= speed.slow < 0.3
    assert "10 registers in one request" in speed.describe()


def test_the_renewal_of_a_register_does_not_depend_on_how_long_it_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a long time few readings are kept: here every half second, of a number that is renewed each 0.1 s."""
    monkeypatch.setattr("otolith_drivers.modbus.probe.MAX_READINGS", 5)
    begun, words = time.monotonic(), {0: 0, 1: 0}

    def renewed(*_: int) -> None:
        words[1] = int(10.0 * (time.monotonic() - begun)) ** 2

    with connected(Behaviour(words, refuse=renewed)) as client:
        readings, changes = watch(client, [Block(0, 2)], 2.5, never, quiet)
    assert 2 <= len(readings[Block(0, 2)]) <= 6
    (number,) = (number for number in numbers_of(readings) if number.address + number.count > 1)
    assert renewal_of(number, changes) == pytest.approx(0.1)


def test_watch_reads_at_least_one_round() -> None:
    with connected(Behaviour({})) as client:
        readings, _ = watch(client, [Block(0, 2)], 0.0, never, quiet)
    assert readings[Block(0, 2)].shape == (1, 2)


@pytest.mark.parametrize(
    ("slow", "rate"), [((0.0004,), 1000), ((0.005,), 100), ((0.005, 0.005), 50), ((0.3,), 2), ((20.0,), 0)]
)
def test_possible_rate_leaves_a_margin(slow: tuple[float, ...], rate: float) -> None:
    assert possible_rate([Speed(10, each, each) for each in slow]) == rate


def test_scan_lists_devices_that_answer_or_refuse() -> None:
    behaviour = Behaviour(
        {0: 1},
        silent=lambda device: device not in (3, 7, 9),
        refuse=lambda device, *_: {7: 2, 9: 11}.get(device),
    )
    with connected(behaviour, "0.05 s") as client:
        answers = scan(client, range(1, 12), 0, never, quiet)
    assert [(answer.device, answer.reply) for answer in answers] == [(3, ""), (7, "illegal data address")]


def test_spans_of_addresses_in_words() -> None:
    assert spans([5]) == "register 5"
    assert spans([3, 1, 2, 9]) == "registers 1 to 3 and 9"
    assert spans(list(range(0, 60, 2))).endswith("and 23 more")
