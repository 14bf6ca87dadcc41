"""Looking at Modbus devices: which registers there are, who answers, how fast; on servers that do not always oblige."""

import socket
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
    open_line,
    possible_rate,
    scan,
    spans,
    speeds,
    survey,
    watch,
)
from tests.conftest import free_port
from tests.drivers.modbus_servers import Behaviour, odd_server


@contextmanager
def asking(behaviour: Behaviour, timeout: str = "0.1 s") -> Iterator[ProbeClient]:
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


def having(registers: set[int]) -> Behaviour:
    """A device that has these registers alone, and refuses whatever touches another one."""
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
def test_what_is_refused_is_split_until_it_is_known_what_there_is(registers: set[int]) -> None:
    behaviour = having(registers)
    with asking(behaviour) as client:
        found = survey(client, 0, 63, never, quiet)
    readable = {at for block in found.blocks for at in range(block.address, block.end)}
    assert readable == registers
    assert set(found.refused) == set(range(64)) - registers
    for one, other in zip(found.blocks, found.blocks[1:], strict=False):
        assert one.end < other.address, "what can be read at once is"
    assert set(behaviour.functions) == {3}, "nothing but reading is ever asked for"


def test_the_answer_is_said_in_words() -> None:
    with asking(having({*range(20), *range(60, 64)})) as client:
        lines = survey(client, 0, 63, never, quiet).describe(first_address=1)
    assert lines == [
        "registers 1 to 20 and 61 to 64 can be read",
        "registers 21 to 60 refused: illegal data address",
    ]


def test_a_device_that_gives_only_some_at_once_is_found_out() -> None:
    with asking(Behaviour({}, refuse=lambda _, __, count: 3 if count > 32 else None)) as client:
        found = survey(client, 0, 99, never, quiet)
    assert {at for block in found.blocks for at in range(block.address, block.end)} == set(range(100))
    assert 24 <= found.max_registers <= 32


def test_numbers_of_two_registers_that_cannot_be_read_by_halves_are_found() -> None:
    behaviour = Behaviour({}, refuse=lambda _, at, count: 2 if at % 2 or count % 2 or at + count > 30 else None)
    with asking(behaviour) as client:
        found = survey(client, 0, 63, never, quiet)
    assert found.blocks == [Block(0, 30)]


def test_a_busy_device_is_asked_again() -> None:
    answers = iter([6, 6, None, None, None])
    with asking(Behaviour({0: 7}, refuse=lambda *_: next(answers))) as client:
        assert survey(client, 0, 0, never, quiet).blocks == [Block(0, 1)]


def test_a_device_that_keeps_silent_is_an_error_with_a_way_out() -> None:
    with asking(Behaviour({}, silent=lambda _: True)) as client, pytest.raises(DeviceError, match=r"no answer.*--scan"):
        survey(client, 0, 63, never, quiet)


def test_a_gateway_without_that_device_is_an_error() -> None:
    with asking(Behaviour({}, refuse=lambda *_: 11)) as client, pytest.raises(DeviceError, match="gateway"):
        survey(client, 0, 63, never, quiet)


def test_readings_are_many_and_timed() -> None:
    with asking(Behaviour({3: 77})) as client:
        found = survey(client, 0, 9, never, quiet)
        client.round_trips.clear()
        readings = watch(client, found.blocks, 0.3, never, quiet)
        assert [block for block, _ in readings.items()] == [Block(0, 10)]
        words = readings[Block(0, 10)]
        assert words.shape[0] >= 5
        assert set(words[:, 3]) == {77}
        (speed,) = speeds(client, found.blocks)
    assert 0.0 < speed.median <= speed.slow < 0.3
    assert "10 registers in one request" in speed.describe()


def test_one_round_is_read_even_in_no_time() -> None:
    with asking(Behaviour({})) as client:
        readings = watch(client, [Block(0, 2)], 0.0, never, quiet)
    assert readings[Block(0, 2)].shape == (1, 2)


@pytest.mark.parametrize(
    ("slow", "rate"), [((0.0004,), 1000), ((0.005,), 100), ((0.005, 0.005), 50), ((0.3,), 2), ((20.0,), 0)]
)
def test_the_rate_that_is_called_possible_leaves_room(slow: tuple[float, ...], rate: float) -> None:
    assert possible_rate([Speed(10, each, each) for each in slow]) == rate


def test_a_scan_lists_those_that_answer_also_with_an_exception() -> None:
    behaviour = Behaviour(
        {0: 1},
        silent=lambda device: device not in (3, 7, 9),
        refuse=lambda device, *_: {7: 2, 9: 11}.get(device),
    )
    with asking(behaviour, "0.05 s") as client:
        found = scan(client, range(1, 12), 0, never, quiet)
    assert [(answer.device, answer.reply) for answer in found] == [(3, ""), (7, "illegal data address")]


def test_addresses_in_words() -> None:
    assert spans([5]) == "register 5"
    assert spans([3, 1, 2, 9]) == "registers 1 to 3 and 9"
    assert spans(list(range(0, 60, 2))).endswith("and 23 more")
