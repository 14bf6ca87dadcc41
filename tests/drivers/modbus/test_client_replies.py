"""Replies that are corrupted, late, or in a swapped word order."""

import contextlib
import socket
import struct
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.modbus.client import ConnectionLostError, ExceptionReplyError, NoReplyError, ReadOnlyClient
from otolith_drivers.modbus.driver import Options
from tests.conftest import free_port
from tests.drivers.modbus_readers import TIMEOUT, TWO, Listener, floats, poller, source
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.messages import assert_refuses
from tests.waiting import wait_for


def late(reply: bytes) -> bytes:
    """A reply with another value after the timeout, which must not be taken for the answer to the next request."""
    time.sleep(1.5 * TIMEOUT)
    return reply[:-4] + struct.pack(">f", 99.0)


@pytest.mark.parametrize(
    "corrupt",
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
def test_corrupted_reply_is_no_reading(corrupt: Callable[[bytes], bytes]) -> None:
    """No wrong value is delivered, and the next valid reply is."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, TWO)) as listener:
        wait_for(lambda: len(listener.samples) > 0)
        lost = listener.driver.counters().lost
        behaviour.corrupt = corrupt
        wait_for(lambda: listener.driver.counters().lost > lost + 2)
        behaviour.corrupt = lambda reply: reply
        count = len(listener.samples)
        wait_for(lambda: len(listener.samples) > count)
    assert {sample.value for sample in listener.samples} == {24.0, 1.5}


def test_swapped_word_order_is_withheld_and_reported() -> None:
    """Before any sample of the signal was delivered."""
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    state = {"reads": 0}

    def moving(reply: bytes) -> bytes:
        state["reads"] += 1
        return reply[:-4] + struct.pack(">f", 1.5 + 0.001 * (state["reads"] % 7))

    behaviour.corrupt = moving
    sources = [source(register=0), source(register=2, order="CDAB")]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        listener.wait(lambda link: any('set order = "ABCD", unless the register' in line for line in link.warnings))
        wait_for(lambda: len(listener.of("s0")) > 20)
        assert not listener.of("s1")
        assert listener.driver.counters().bad >= 20


def test_trusted_order_is_not_judged() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    sources = [source(register=0, order="CDAB", trusted=True)]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        wait_for(lambda: len(listener.of("s0")) > 40)
        assert not listener.driver.link().warnings


def test_late_device_is_judged_before_delivery() -> None:
    behaviour, port = Behaviour(floats(24.0, 1.5)), free_port(socket.SOCK_STREAM)
    behaviour.refuse = lambda device, _, __: 6 if device == 2 else None
    state = {"reads": 0}

    def moving(reply: bytes) -> bytes:
        state["reads"] += 1
        return reply[:-4] + struct.pack(">f", 1.5 + 0.001 * (state["reads"] % 7))

    behaviour.corrupt = lambda reply: moving(reply) if reply[6] == 2 and reply[7] == 3 else reply
    sources = [source(register=0), source(register=2, device=2, order="CDAB")]
    with odd_server(behaviour, port), Listener(poller(port, sources)) as listener:
        wait_for(lambda: len(listener.of("s0")) > 100)
        behaviour.refuse = lambda _, __, ___: None
        listener.wait(lambda link: any('set order = "ABCD"' in line for line in link.warnings))
        assert not listener.of("s1")


WORDS = floats(24.0, 1.5)


@settings(max_examples=60)
@given(st.one_of(
    st.binary(max_size=300),
    st.tuples(st.integers(0, 19), st.integers(0, 16), st.binary(max_size=6)),
))  # fmt: skip
def test_any_bytes_are_valid_registers_or_an_error(
    shared_server: tuple[Behaviour, int], damage: bytes | tuple[int, int, bytes]
) -> None:
    """Arbitrary bytes, and valid replies with some bytes removed and others inserted."""
    behaviour, port = shared_server

    def corrupt(reply: bytes) -> bytes:
        if isinstance(damage, bytes):
            return damage
        at, cut, put = damage
        return reply[:at] + put + reply[at + cut :]

    client = ReadOnlyClient(Options(host="127.0.0.1", port=port, timeout="0.03 s"))
    wait_for(lambda: is_connected(client))
    behaviour.corrupt = corrupt
    try:
        registers = client.read(1, "holding", 0, 4)
    except (NoReplyError, ExceptionReplyError, ConnectionLostError) as error:
        assert_refuses(error, "")
        return
    finally:
        client.close()
    # Modbus TCP has no checksum, so the registers of an accepted reply may be wrong, but not their number.
    assert len(registers) == 4
    assert all(0 <= register <= 65535 for register in registers)


def is_connected(client: ReadOnlyClient) -> bool:
    """Connect, and return whether the server of a busy computer accepted within the timeout."""
    with contextlib.suppress(ConnectionLostError):
        client.connect()
        return True
    return False


@pytest.fixture(scope="module")
def shared_server() -> Iterator[tuple[Behaviour, int]]:
    """One server for all examples."""
    behaviour, port = Behaviour(WORDS), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port):
        yield behaviour, port
