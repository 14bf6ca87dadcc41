"""Probing a bus: periods, what changes, signals of a database, and numbers in frames without one."""

import re
import tomllib
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from otolith.cli.commissioning.probe_view import can_document, marked, remarks, tables
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.canbus.probe import MAX_IDENTIFIERS, Picture, can_driver_lines, can_signal_lines, canopen_name
from tests.conftest import EXAMPLES
from tests.drivers.canbus.test_j1939 import DATABASE as GROUPS
from tests.drivers.canbus.test_j1939 import ENGINE, LONG, broadcast, engine


def frame(identifier: int, data: bytes, **keys: bool) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_extended_id=keys.pop("extended", False), **keys)


def receive_sine(picture: Picture, count: int = 100, period: float = 0.01, jitter: float = 0.0) -> None:
    """Frames of 0x123 with a speed that oscillates about zero, and nothing else."""
    random = np.random.default_rng(1)
    for index in range(count):
        speed = round(1000 * np.sin(0.1 * index))
        picture.take(
            frame(0x123, speed.to_bytes(2, "big", signed=True) + b"\x00\x55"),
            period * index + jitter * random.uniform(-1, 1),
        )


def test_period_jitter_and_changed_bytes() -> None:
    picture = Picture()
    receive_sine(picture, jitter=0.001)
    (observed,) = picture.ordered()
    assert observed.period == pytest.approx(0.01, rel=0.02)
    assert 0.0005 < observed.jitter < 0.0025
    assert observed.regular
    assert observed.lengths == {4}
    assert marked(observed).endswith("] 00 55")
    assert marked(observed).startswith("[")


def test_frames_without_a_period_are_irregular() -> None:
    picture, moment = Picture(), 0.0
    for gap in [0.001, 0.5, 0.002, 0.003, 0.4, 0.001] * 10:
        moment += gap
        picture.take(frame(0x10, b"\x01"), moment)
    assert not picture.ordered()[0].regular


def test_a_number_that_moves_becomes_a_signal_line() -> None:
    picture = Picture()
    receive_sine(picture)
    lines = list(can_signal_lines(picture))
    table = tomllib.loads("\n".join(lines))["signals"]["NAME"]
    assert table == {
        "id": "0x123",
        "start": 7,
        "length": 16,
        "byte_order": "big",
        "signed": True,
        "scale": 1.0,
        "unit": "?",
    }


def test_lines_mark_extended_and_fd_frames() -> None:
    picture = Picture()
    for index in range(100):
        data = round(3000 + 300 * np.sin(0.1 * index)).to_bytes(2, "little") + bytes(10)
        picture.take(frame(0x18FEF100, data, extended=True, is_fd=True), 0.01 * index)
    (_, line, _) = can_signal_lines(picture)
    assert "extended = true, fd = true" in line
    assert "fd = true" in can_driver_lines(BusOptions(), picture, None)
    assert picture.guess(picture.ordered()[0]) == "PGN 65265 from 0, if SAE J1939"


def test_the_database_gives_names_values_and_ranges() -> None:
    picture = Picture(load_dbc(EXAMPLES / "dc-motor.dbc"))
    for index, raw in enumerate((100, -200, 32767)):
        picture.take(frame(641, raw.to_bytes(2, "little", signed=True) + bytes(6)), 0.01 * index)
    picture.take(frame(641, b"\x01"), 0.03)
    picture.take(frame(0x7FF, b"\x01"), 0.03)
    values = {signal.name: value for _, signal, value in picture.signals()}
    speed = values["RotorSpeed"]
    assert (speed.low, speed.beyond) == (-2.0, 1)
    assert speed.high == pytest.approx(327.67)
    (observed,) = {id(frames): frames for frames, _, _ in picture.signals()}.values()
    assert observed.series()["RotorSpeed"] == pytest.approx([1.0, -2.0, 327.67])
    assert [message.name for message in picture.missing()] == ["MotorElectrical"]
    assert "in the database, but not received: MotorElectrical" in list(remarks(picture))
    lines = list(can_signal_lines(picture))
    assert 'NAME = { signal = "RotorSpeed" }  # rad/s, 327.67 now' in lines
    assert not any("Alive" in line for line in lines)


@pytest.fixture
def j1939_picture(tmp_path: Path) -> Picture:
    (tmp_path / "j.dbc").write_text(GROUPS, encoding="utf-8")
    return Picture(load_dbc(tmp_path / "j.dbc"))


def test_a_message_of_a_parameter_group_is_known_from_any_source(j1939_picture: Picture) -> None:
    for index, source in enumerate((0x00, 0x03, 0x00)):
        j1939_picture.take(frame(ENGINE & ~0xFF | source, engine(8000 + index), extended=True), 0.01 * index)
    shown = {frames.name: frames.title for frames in j1939_picture.ordered()}
    assert shown == {"0x0CF00400": "EEC1 from 0x00", "0x0CF00403": "EEC1 from 0x03"}
    assert "EEC1" not in [message.name for message in j1939_picture.missing()]
    lines = [line for line in can_signal_lines(j1939_picture) if "EngineSpeed" in line]
    assert lines == ['NAME = { signal = "EngineSpeed" }  # rpm, 1000.2 now']
    assert "# EEC1 from 0x00, EEC1 from 0x03: set source_address in [driver] to one of them" in list(
        can_signal_lines(j1939_picture)
    )


def test_a_message_of_several_frames_is_shown_with_its_signals(j1939_picture: Picture) -> None:
    frames = broadcast(0x21, bytes([7, *range(19)]))
    for index, (identifier, data) in enumerate(frames):
        j1939_picture.take(frame(identifier, data, extended=True), 0.05 * index)
    values = {signal.name: (frames.title, value.latest) for frames, signal, value in j1939_picture.signals()}
    assert values == {"Lamp": ("Faults from 0x21", 7.0)}
    assert j1939_picture.ordered()[-1].identifier == LONG & ~0xFF | 0x21
    assert j1939_picture.frames == len(frames)


def test_numbers_that_the_standard_reserves_are_no_readings_of_a_probe(j1939_picture: Picture) -> None:
    for index, speed in enumerate((8000, 0xFFFF, 0xFE00)):
        j1939_picture.take(frame(ENGINE, engine(speed, state=3), extended=True), 0.01 * index)
    values = {signal.name: value for _, signal, value in j1939_picture.signals()}
    assert (values["EngineSpeed"].high, values["EngineSpeed"].beyond) == (1000.0, 2)
    assert "State" not in values


@pytest.mark.parametrize(
    ("identifier", "name"),
    [
        (0x000, "NMT command"),
        (0x080, "SYNC"),
        (0x085, "emergency of node 5"),
        (0x185, "TPDO 1 of node 5"),
        (0x4FF, "TPDO 4 of node 127"),
        (0x705, "heartbeat of node 5"),
        (0x180, ""),
        (0x123, ""),
        (0x790, ""),
    ],
)
def test_canopen_identifiers(identifier: int, name: str) -> None:
    assert canopen_name(identifier) == name


def test_canopen_is_certain_only_with_heartbeats() -> None:
    picture = Picture()
    picture.take(frame(0x185, bytes(8)), 0.0)
    assert picture.guess(picture.ordered()[0]) == "TPDO 1 of node 5, if CANopen"
    picture.take(frame(0x705, b"\x05"), 0.1)
    assert [picture.guess(observed) for observed in picture.ordered()] == [
        "CANopen TPDO 1 of node 5",
        "CANopen heartbeat of node 5: operational",
    ]


def test_error_frames_are_counted_by_class() -> None:
    picture = Picture()
    for bits in (0x20, 0x20, 0x08 | 0x80, 0):
        picture.take(can.Message(arbitration_id=bits, is_error_frame=True, data=bytes(8)), 0.0)
    assert picture.frames == 0
    assert (picture.error_frames, dict(picture.errors)) == (
        4,
        {"no acknowledgement": 2, "protocol violated": 1, "bus error": 1, "error frame": 1},
    )
    assert next(remarks(picture)).startswith("4 error frames: 2 no acknowledgement")


def test_memory_is_bounded_for_any_number_of_ids() -> None:
    picture = Picture()
    for identifier in range(MAX_IDENTIFIERS + 100):
        picture.take(frame(identifier, b"", extended=True), 0.0)
    assert len(picture.observed) == MAX_IDENTIFIERS
    assert picture.left_out == 100
    assert picture.frames == MAX_IDENTIFIERS + 100


frames = st.builds(
    lambda identifier, data, extended, error, remote, fd: can.Message(
        arbitration_id=identifier if extended else identifier % 0x800,
        data=None if remote else data if fd else data[:8],
        is_extended_id=extended,
        is_error_frame=error,
        is_remote_frame=remote,
        is_fd=fd and not remote,
    ),
    st.sampled_from([0x181, 385, 641, 0x701, 0x80, 0x1FFFFFFF, 0x18FEF100]),
    st.binary(max_size=64),
    st.booleans(),
    st.booleans(),
    st.booleans(),
    st.booleans(),
)
DATABASE = load_dbc(EXAMPLES / "dc-motor.dbc")


@settings(max_examples=80, deadline=None)
@given(
    st.lists(st.tuples(frames, st.floats(-1e9, 1e9)), max_size=40),
    st.booleans(),
    st.integers(20, 200),
)
def test_any_frames_make_tables_and_lines(
    came: list[tuple[can.Message, float]], with_database: bool, width: int
) -> None:
    picture = Picture(DATABASE if with_database else None)
    for message, moment in came:
        picture.take(message, moment)
    console = Console(width=width, file=None, quiet=True)
    for table in tables(picture, width):
        console.print(table)
    assert picture.frames + picture.error_frames == len(came)
    document = can_document(picture, BusOptions(), None, 1.0)
    assert len(document["frames"]) == len(picture.observed)
    tomllib.loads("\n".join(can_driver_lines(BusOptions(), picture, None)))


def test_fields_without_a_database_are_candidates_with_a_probability() -> None:
    picture = Picture()
    receive_sine(picture)
    (_, line, remark) = can_signal_lines(picture)
    (percent,) = re.findall(r"# \? (\d+) %: -?\d+ now", line)
    assert 90 <= int(percent) <= 99
    assert "candidates" in remark


@pytest.mark.parametrize("selectors", [(0, 1), (0, 1, 2, 3), (0x10, 0x20, 0x30), (0, 1, 0, 2, 0, 3)])
@pytest.mark.parametrize("nibble", [False, True])
def test_no_candidate_crosses_a_multiplexed_payload(selectors: tuple[int, ...], nibble: bool) -> None:
    """The first byte, or a half of it, selects which of several signals the others hold."""
    picture, random = Picture(), np.random.default_rng(5)
    for index in range(400):
        selector = selectors[index % len(selectors)]
        number = round(6000 * (selector + 1) + 800 * np.sin(0.02 * index + selector) + 5 * random.standard_normal())
        first = (selector >> 4 or selector) << 4 | index % 16 if nibble else selector
        picture.take(frame(0x321, bytes([first]) + (number % 65536).to_bytes(2, "little") + bytes(5)), 0.01 * index)
    (_, remark) = can_signal_lines(picture)
    assert "0x321 seems multiplexed by" in remark


@pytest.mark.parametrize("amplitude", [4, 40, 400, 4000])
def test_a_counter_or_a_high_byte_is_no_multiplexer(amplitude: int) -> None:
    picture, random = Picture(), np.random.default_rng(6)
    for index in range(300):
        number = round(amplitude * (np.sin(0.05 * index) + 0.02 * random.standard_normal()))
        data = number.to_bytes(2, "little", signed=True) + bytes([index % 16])
        picture.take(frame(0x222, data), 0.01 * index)
    (_, line, _) = can_signal_lines(picture)
    assert "start = 0, length = 16" in line
