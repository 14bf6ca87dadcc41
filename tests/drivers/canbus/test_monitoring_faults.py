"""Error frames: counted by class, reported in words; bus off means that the link is down."""

from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.canbus.monitoring import BusFaults
from tests.drivers.can_frames import decoder, frame
from tests.messages import assert_each_says

RAW = {"V_a": ("V", {"id": "0x181", "start": 0, "length": 16, "unit": "V"})}


def error(identifier: int, data: bytes = bytes(8)) -> can.Message:
    return can.Message(arbitration_id=identifier, data=data, is_error_frame=True, is_extended_id=False)


@pytest.mark.parametrize(
    ("identifier", "data", "word"),
    [
        (0x40, bytes(8), "bus off"),
        (0x20, bytes(8), "no acknowledgement"),
        (0x04, bytes([0, 0x10] + [0] * 6), "error passive (receiving)"),
        (0x204, bytes([0, 0x20] + [0] * 6), "error passive (sending)"),
        (0x04, bytes([0, 0x01] + [0] * 6), "controller had no room for a frame"),
        (0x88, bytes(8), "protocol violated"),
        (0x100, bytes(8), "controller restarted"),
        (0x00, b"", "error frame"),
    ],
)
def test_each_error_class_has_a_name(identifier: int, data: bytes, word: str) -> None:
    faults = BusFaults()
    faults.note(error(identifier, data), 1.0)
    assert faults.total == 1
    assert faults.counts[word] == 1
    assert any(word in line for line in faults.warnings(2.0))
    assert faults.warnings(1000.0) == []


def test_bus_off_lasts_until_the_next_frame(tmp_path: Path) -> None:
    frame_decoder = decoder(tmp_path, RAW)
    assert frame_decoder.decode(error(0x40), 0.0) == []
    assert frame_decoder.faults.bus_off
    frame_decoder.decode(frame(0x181, bytes(8)), 0.1)
    assert not frame_decoder.faults.bus_off
    assert frame_decoder.counters.bad == 0


def test_controller_overflows_are_lost_samples(tmp_path: Path) -> None:
    frame_decoder = decoder(tmp_path, RAW)
    frame_decoder.decode(error(0x04, bytes([0, 1] + [0] * 6)), 0.0)
    assert frame_decoder.counters.lost == 1


def test_error_passive_is_a_warning_until_it_ends() -> None:
    faults = BusFaults()
    faults.note(error(0x04, bytes([0, 0x20])), 0.0)
    assert_each_says(faults.warnings(30.0), ("error passive (sending)", "cable", "termination", "bit rate"))
    faults.note(error(0x04, bytes([0, 0x40])), 31.0)
    assert all("controller is" not in line for line in faults.warnings(32.0))


@given(st.lists(st.tuples(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8)), max_size=50))
def test_every_error_frame_is_counted_once(frames: list[tuple[int, bytes]]) -> None:
    faults = BusFaults()
    for place, (identifier, data) in enumerate(frames):
        faults.note(error(identifier, data), float(place))
    assert faults.total == len(frames)
    assert all("\n" not in line for line in faults.warnings(len(frames) + 0.5))
    assert len(faults.counts) < 32
