"""Replies that are not what they seem: spoiled, late, of swapped words."""

import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from otolith_drivers.modbus.client import Line
from otolith_drivers.modbus.driver import Options
from otolith_drivers.modbus.protocol import Broken, Refused, Silent
from tests.conftest import free_port
from tests.drivers.modbus_readers import TIMEOUT, TWO, Listener, floats, poller, source
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import wait_for


def late(reply: bytes) -> bytes:
    """Of another value, and later than the driver waits: it is not to be taken for the answer to the next question."""
    time.sleep(1.5 * TIMEOUT)
    return reply[:-4] + struct.pack(">f", 99.0)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda reply: reply[:-1],
        lambda reply: reply[:9],
        lambda reply: b"",
        lambda reply: struct.pack(">H", struct.unpack(">H", reply[:2])[0] ^ 0x55) + reply[2:],
        lambda reply: reply[:6] + bytes([99]) + reply[7:],
        lambda reply: reply[:7] + bytes([4]) + reply[8:],
        lambda reply: reply[:5] + bytes([5, 1, 3, 2, 0, 1]),
        lambda reply: bytes(300),
        lambda reply: reply[:8] + bytes([250]) + reply[9:],
        late,
    ],
    ids=["a byte short", "header only", "nothing", "other transaction", "other device", "other function", "too few",
         "zeros", "wrong byte count", "late"],
)  # fmt: skip
def test_a_spoiled_reply_is_no_reading(spoil: Callable[[bytes], bytes]) -> None:
    """Not a single wrong value, and the next good one is taken."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, TWO)) as listener:
        wait_for(lambda: len(listener.samples) > 0)
        lost = listener.driver.counters().lost
        behaviour.spoil = spoil
        wait_for(lambda: listener.driver.counters().lost > lost + 2)
        behaviour.spoil = lambda reply: reply
        count = len(listener.samples)
        wait_for(lambda: len(listener.samples) > count)
    assert {sample.value for sample in listener.samples} == {24.0, 1.5}


def test_a_swapped_word_order_is_withheld_and_named() -> None:
    """Before a single sample of it was delivered."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    state = {"reads": 0}

    def moving(reply: bytes) -> bytes:
        state["reads"] += 1
        return reply[:-4] + struct.pack(">f", 1.5 + 0.001 * (state["reads"] % 7))

    behaviour.spoil = moving
    sources = [source(register=0), source(register=2, order="CDAB")]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        listener.wait(lambda link: any('set order = "ABCD", unless register' in line for line in link.warnings))
        wait_for(lambda: len(listener.of("s0")) > 20)
        assert not listener.of("s1")
        assert listener.driver.counters().bad >= 20


def test_an_order_that_the_user_vouches_for_is_not_doubted() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    sources = [source(register=0, order="CDAB", trusted=True)]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        wait_for(lambda: len(listener.of("s0")) > 40)
        assert not listener.driver.link().warnings


def test_a_device_that_comes_late_is_judged_before_anything_of_it_is_believed() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    behaviour.refuse = lambda device, _, __: 6 if device == 2 else None
    state = {"reads": 0}

    def moving(reply: bytes) -> bytes:
        state["reads"] += 1
        return reply[:-4] + struct.pack(">f", 1.5 + 0.001 * (state["reads"] % 7))

    behaviour.spoil = lambda reply: moving(reply) if reply[6] == 2 and reply[7] == 3 else reply
    sources = [source(register=0), source(register=2, device=2, order="CDAB")]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        wait_for(lambda: len(listener.of("s0")) > 100)
        behaviour.refuse = lambda _, __, ___: None
        listener.wait(lambda link: any('set order = "ABCD"' in line for line in link.warnings))
        assert not listener.of("s1")


WORDS = floats(24.0, 1.5)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(
    st.binary(max_size=300),
    st.tuples(st.integers(0, 19), st.integers(0, 16), st.binary(max_size=6)),
))  # fmt: skip
def test_whatever_bytes_come_are_the_right_registers_or_none(
    shared_server: tuple[Behaviour, int], damage: bytes | tuple[int, int, bytes]
) -> None:
    """Arbitrary bytes, and right answers with some bytes cut out and others put in."""
    behaviour, port = shared_server

    def spoil(reply: bytes) -> bytes:
        if isinstance(damage, bytes):
            return damage
        at, cut, put = damage
        return reply[:at] + put + reply[at + cut :]

    line = Line(Options(host="127.0.0.1", port=port, timeout="0.03 s"))
    line.connect()
    behaviour.spoil = spoil
    try:
        registers = line.read(1, "holding", 0, 4)
    except (Silent, Refused, Broken):
        return
    finally:
        line.close()
    # Modbus TCP has no checksum: only the bytes of the numbers themselves can be false in an answer that is taken.
    assert len(registers) == 4
    assert all(0 <= register <= 65535 for register in registers)


@pytest.fixture(scope="module")
def shared_server() -> Iterator[tuple[Behaviour, int]]:
    """One for many examples."""
    behaviour, port = Behaviour(WORDS), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port):
        yield behaviour, port
