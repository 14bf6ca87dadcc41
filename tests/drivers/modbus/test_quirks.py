"""What devices do that the standard does not expect; ``docs/modbus.md`` has a row for each.

The server is a small one of our own, not the library that the driver is built on.
"""

import logging
import math
import re
import socket
import struct
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import pytest
from pydantic import ValidationError

from otolith_drivers.modbus.driver import ModbusPoller, Options, Source
from otolith_drivers.modbus.plausibility import READINGS
from tests.conftest import free_port
from tests.drivers.modbus_readers import TIMEOUT, TWO, Listener, floats, poller, source
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import PATIENCE, wait_for

DOCS = Path(__file__).parents[3] / "docs" / "modbus.md"
PERIOD = 0.05
STARTING, ROUNDS = 5, 40
WORDS = floats(24.0, 1.5)
EVERY = 20
"""One answer in so many is wrong, where not all are."""
Change = Callable[[bytes], bytes]


def now_and_then(change: Change) -> Change:
    """``change`` for one answer in ``EVERY``; the first ones are right."""
    numbers = count(1)
    return lambda reply: change(reply) if next(numbers) % EVERY == 0 else reply


def refusals(code: int) -> Callable[[int, int, int], int | None]:
    """The first three requests of four are refused."""
    numbers = count()
    return lambda *_: None if next(numbers) % 4 == 3 else code


def late(reply: bytes) -> bytes:
    time.sleep(1.5 * TIMEOUT)
    return reply


def slow(reply: bytes) -> bytes:
    time.sleep(0.02)
    return reply


def swapped(reply: bytes) -> bytes:
    """A number in the wrong word order that moves."""
    moved = struct.pack(">f", 1.5 + 0.001 * (time.monotonic() % 1.0))
    return reply[:-4] + moved[2:] + moved[:2]


def torn(reply: bytes) -> bytes:
    """The high word of another value than the low one."""
    return reply[:-4] + struct.pack(">f", 1.5e30)[:2] + reply[-2:]


@dataclass(frozen=True)
class Quirk:
    """A row of the table."""

    behaviour: Callable[[], Behaviour]
    lost: float
    """Largest share of the readings that it costs."""
    reported: str = ""
    """What the link shows, as a pattern; empty if nothing."""
    sources: Sequence[Source] = field(default_factory=lambda: TWO)
    options: dict[str, object] = field(default_factory=dict)


def has_no_hole(_: int, at: int, registers: int) -> int | None:
    return 2 if at <= 2 < at + registers else None


QUIRKS = {
    "hole": Quirk(
        lambda: Behaviour(WORDS, refuse=has_no_hole), 0.1, sources=[source(register=0), source(register=4)],
    ),
    "small requests": Quirk(lambda: Behaviour(WORDS, refuse=lambda _, __, size: 3 if size > 2 else None), 0.1),
    "slow": Quirk(lambda: Behaviour(WORDS, corrupt=slow), 0.05, r"times right within \d+ ms"),
    "busy": Quirk(lambda: Behaviour(WORDS, refuse=refusals(6)), 0.05),
    "acknowledge": Quirk(lambda: Behaviour(WORDS, refuse=refusals(5)), 0.05),
    "closes each time": Quirk(lambda: Behaviour(WORDS, closes=True), 0.05, "reconnected for each request"),
    "wrong unit id": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: reply[:6] + b"\xff" + reply[7:]), 1.0,
        "device number 255 instead of 1: .* set reply_device = 255",
    ),
    "wrong unit id, declared": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: reply[:6] + b"\xff" + reply[7:]), 0.05,
        options={"reply_device": 255},
    ),
    "transaction id 0": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: b"\0\0" + reply[2:]), 1.0,
        r"transaction number 0 instead of \d+: .* set reply_transaction = 0",
    ),
    "transaction id 0, declared": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: b"\0\0" + reply[2:]), 0.05, options={"reply_transaction": 0},
    ),
    "length too small": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: reply[:4] + (len(reply) - 7).to_bytes(2) + reply[6:]), 0.05,
    ),
    "length too large": Quirk(
        lambda: Behaviour(WORDS, corrupt=lambda reply: reply[:4] + (len(reply) - 5).to_bytes(2) + reply[6:]), 0.05,
    ),
    "late": Quirk(lambda: Behaviour(WORDS, corrupt=now_and_then(late)), 0.5),
    "duplicate": Quirk(lambda: Behaviour(WORDS, corrupt=now_and_then(lambda reply: 2 * reply)), 0.05),
    "torn 32-bit": Quirk(
        lambda: Behaviour(WORDS, corrupt=now_and_then(torn)), 0.05, "s1: is .* out of its range from -100 to 100",
        sources=[source(register=0), source(register=2, range=[-100, 100])],
    ),
    "word order": Quirk(lambda: Behaviour(WORDS, corrupt=swapped), 0.6, 'set order = "CDAB"'),
    "input-only": Quirk(
        lambda: Behaviour(WORDS, refuse=lambda *_: 1), 1.0, 'illegal function; try table = "input"',
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", QUIRKS)
def test_quirk_is_handled_as_the_table_says(name: str, caplog: pytest.LogCaptureFixture) -> None:
    quirk, port = QUIRKS[name], free_port(socket.SOCK_STREAM)
    behaviour = quirk.behaviour()
    driver = poller(port, quirk.sources, PERIOD, **quirk.options)
    with odd_server(behaviour, port), Listener(driver) as listener:
        counted_over(driver, STARTING * len(quirk.sources))
        # A busy computer skips rounds. The device is judged by a stretch of rounds without such delays.
        share = math.inf
        deadline = time.monotonic() + PATIENCE
        while share > quirk.lost + 0.1 and time.monotonic() < deadline:
            received, bad, lost = counted_over(driver, ROUNDS * len(quirk.sources))
            share = (bad + lost) / (received + bad + lost)
        assert share <= quirk.lost + 0.1
        if quirk.lost < 1.0:
            listener.wait(lambda link: link.up)
        if quirk.reported:
            listener.wait(lambda link: bool(re.search(quirk.reported, " ".join((*link.warnings, link.plan)))))
        else:
            listener.wait(lambda link: not link.warnings)
    sys.stdout.write(f"{name}: {share / PERIOD:.1f} of {1 / PERIOD:.0f} readings per second lost\n")
    assert (received == 0) is (quirk.lost == 1.0)
    assert {round(sample.value, 1) for sample in listener.samples if sample.value == sample.value} <= {24.0, 1.5, 0.0}
    warnings = [record for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warnings) <= 3, "nothing is reported once per reading"


def counted_over(driver: ModbusPoller, readings: int) -> list[int]:
    """Return how many of at least the next ``readings`` were received, bad and lost."""
    begun = counted(driver)
    wait_for(lambda: sum(counted(driver)) - sum(begun) >= readings)
    return [now - then for now, then in zip(counted(driver), begun, strict=True)]


def counted(driver: ModbusPoller) -> tuple[int, int, int]:
    counters = driver.counters()
    return counters.received, counters.bad, counters.lost


def test_the_table_has_a_row_for_each_quirk() -> None:
    text = DOCS.read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([a-z0-9 ,-]+) \| .* \| (.*) \|$", text[text.index("## Quirks") :], re.MULTILINE)[1:]
    assert [name for name, _ in rows] == list(QUIRKS)
    for name, lost in rows:
        assert (lost == "all") is (QUIRKS[name].lost == 1.0), name
        assert not lost.startswith("0") or QUIRKS[name].lost <= 0.1, name


def test_a_device_that_closes_each_time_loses_nothing_and_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    behaviour, port = Behaviour(WORDS, closes=True), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, TWO, 0.02)) as listener:
        # A busy computer skips rounds and may accept a connection late: then a later stretch of rounds counts.
        wait_for(lambda: counted_over(listener.driver, 200)[0] >= 190)
        counters = listener.driver.counters()
        listener.wait(lambda link: link.up)
    assert counters.reconnects >= 95, "each is counted"
    assert len([record for record in caplog.records if "closes the connection" in record.message]) == 1


@pytest.mark.parametrize("function", [1, 2])
def test_coils_and_discrete_inputs_are_signals(function: int) -> None:
    words = {3: 1, 4: 0, 12: 1}
    behaviour, port = Behaviour(words), free_port(socket.SOCK_STREAM)
    table = {1: "coil", 2: "discrete"}[function]
    sources = [Source.model_validate({"register": at, "table": table, "unit": "V", "scale": 24.0}) for at in words]
    with odd_server(behaviour, port), Listener(poller(port, sources, 0.02)) as listener:
        wait_for(lambda: all(listener.of(f"s{at}") for at in range(3)))
    assert [listener.of(f"s{at}")[0].value for at in range(3)] == [24.0, 0.0, 24.0]
    assert set(behaviour.functions) == {function}
    assert len({(address, size) for _, _, address, size in behaviour.asked}) == 1
    assert "function codes 1 to 4" in listener.driver.describe()[0]


@pytest.mark.parametrize("key", [{"type": "int16"}, {"order": "ABCD"}, {"bits": "3"}, {"decimals": 4}, {"exponent": 4}])
def test_a_coil_takes_no_keys_of_registers(key: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match="is of registers: a coil is 0 or 1"):
        Source.model_validate({"register": 1, "table": "coil", "unit": "1"} | key)


@pytest.mark.parametrize("place", [1, 900])
def test_a_decimals_register_moves_the_point(place: int) -> None:
    """In the same request or in another one; a number of decimals that cannot be one makes no reading."""
    behaviour, port = Behaviour({0: 2415, place: 2}), free_port(socket.SOCK_STREAM)
    sources = [source(register=0, type="int16", decimals=place)]
    with odd_server(behaviour, port), Listener(poller(port, sources, 0.02)) as listener:
        wait_for(lambda: any(sample.value == sample.value for sample in listener.of("s0")))
        counters = listener.driver.counters()
        behaviour.words[place] = 3
        wait_for(lambda: listener.of("s0")[-1].value == pytest.approx(2.415))
        behaviour.words[place] = 77
        wait_for(lambda: listener.driver.counters().bad > counters.bad + 3)
    assert {sample.value for sample in listener.of("s0") if sample.value == sample.value} == {24.15, 2.415}
    assert "with the decimals of register" in listener.driver.describe()[1]


@pytest.mark.parametrize("place", [4, 60])
def test_a_signed_exponent_in_a_register_moves_the_point_both_ways(place: int) -> None:
    """SunSpec's scale factors; 0x8000 in one is "not implemented", so its number is no reading."""
    behaviour, port = Behaviour({0: 2415, place: 0xFFFE}), free_port(socket.SOCK_STREAM)
    sources = [source(register=0, type="int16", exponent=place)]
    with odd_server(behaviour, port), Listener(poller(port, sources, 0.02)) as listener:
        wait_for(lambda: any(sample.value == sample.value for sample in listener.of("s0")))
        behaviour.words[place] = 2
        wait_for(lambda: listener.of("s0")[-1].value == pytest.approx(241500.0))
        behaviour.words[place] = 0x8000
        listener.wait(lambda link: any("exponent -32768" in line for line in link.warnings))
    values = {sample.value for sample in listener.of("s0") if sample.value == sample.value}
    assert sorted(values) == pytest.approx([24.15, 241500.0])


def test_decimals_and_exponent_exclude_each_other() -> None:
    with pytest.raises(ValidationError, match="'decimals' and 'exponent'"):
        source(register=0, type="int16", decimals=4, exponent=4)


def test_the_reason_of_a_link_that_is_down_is_what_the_device_answers() -> None:
    behaviour, port = Behaviour(WORDS, refuse=lambda *_: 6), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, TWO, 0.02)) as listener:
        listener.wait(lambda link: not link.up and "server device busy" in link.reason)


def test_reply_numbers_are_of_tcp_only() -> None:
    with pytest.raises(ValidationError, match="reply_device and reply_transaction are of Modbus TCP"):
        Options(serial="/dev/ttyUSB0", reply_device=3)


@pytest.mark.parametrize(
    ("corrupt", "said"),
    [
        (lambda reply: reply[6:] + b"\x12\x34", 'an answer of a serial line: set framing = "rtu" in [driver]'),
        (lambda reply: b"hello\r\n" + reply, "bytes that are no answer of Modbus TCP"),
        (lambda reply: reply[:2] + b"\x12\x34" + reply[4:], "bytes that are no answer of Modbus TCP"),
    ],
    ids=["serial frames", "a greeting", "another protocol"],
)
def test_what_is_no_answer_of_modbus_tcp_is_said_to_be_none(corrupt: Callable[[bytes], bytes], said: str) -> None:
    """Not an answer with another device number, whose declaration would never help."""
    port = free_port(socket.SOCK_STREAM)
    with odd_server(Behaviour(WORDS, corrupt=corrupt), port), Listener(poller(port, TWO)) as listener:
        wait_for(lambda: any(said in warning for warning in listener.driver.link().warnings))
        assert not any("reply_device" in warning for warning in listener.driver.link().warnings)


def test_a_second_copy_of_an_answer_is_not_the_next_answer() -> None:
    """Without a transaction number that would tell."""
    numbers = count()

    def twice(reply: bytes) -> bytes:
        return 2 * (b"\0\0" + reply[2:-4] + struct.pack(">f", float(next(numbers))))

    behaviour, port = Behaviour(floats(0.0), corrupt=twice), free_port(socket.SOCK_STREAM)
    driver = poller(port, [source(register=0)], 0.02, reply_transaction=0)
    with odd_server(behaviour, port), Listener(driver) as listener:
        wait_for(lambda: len(listener.samples) >= READINGS + 40)
    values = [sample.value for sample in listener.samples]
    assert values == sorted(set(values))
    assert len(values) >= values[-1] - 2, "each request has its own answer"


def test_times_are_stated_to_be_right_within_half_a_round_trip() -> None:
    behaviour, port = Behaviour(WORDS, corrupt=slow), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port), Listener(poller(port, TWO, 0.1)) as listener:
        wait_for(lambda: len(listener.of("s0")) >= 5)
        (bound,) = re.findall(r"times right within (\d+) ms", listener.driver.link().plan)
    assert int(bound) >= 10
