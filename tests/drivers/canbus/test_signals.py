"""Decoded values: raw bits, floats, ranges, multiplexers, FD; a value that is no reading is NaN."""

import math
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from otolith_drivers.canbus.decoder import FrameDecoder
from otolith_drivers.canbus.options import CanSource, FrameOptions
from otolith_drivers.common.message_times import PeriodEstimator
from otolith_drivers.errors import ConfigurationError
from tests.drivers.can_frames import dbc, decoder, frame, values
from tests.messages import assert_each_says

RAW: dict[str, Any] = {"id": "0x181", "start": 0, "length": 16, "signed": True, "scale": 0.01, "unit": "V"}
# As an ODrive describes itself: floats by SIG_VALTYPE_, ranges that say nothing, the axis in the arbitration ID.
ODRIVE = dbc(
    """BO_ 9 Axis0_Get_Encoder_Estimates: 8 Drive
 SG_ Pos_Estimate : 0|32@1- (1,0) [0|0] "rev" Monitor
 SG_ Vel_Estimate : 32|32@1- (1,0) [0|0] "rev/s" Monitor""",
    """BO_ 20 Axis0_Get_Iq: 8 Drive
 SG_ Iq_Setpoint : 0|32@1- (1,0) [0|0] "A" Monitor
 SG_ Iq_Measured : 32|32@1- (1,0) [0|0] "A" Monitor""",
    after="""SIG_VALTYPE_ 9 Pos_Estimate : 1;
SIG_VALTYPE_ 9 Vel_Estimate : 1;
SIG_VALTYPE_ 20 Iq_Setpoint : 1;
SIG_VALTYPE_ 20 Iq_Measured : 1;""",
)
MULTIPLEXED = dbc(
    """BO_ 100 Values: 8 Drive
 SG_ Which M : 0|8@1+ (1,0) [0|255] "" Monitor
 SG_ Always : 8|8@1+ (1,0) [0|0] "V" Monitor
 SG_ Torque m0 : 16|16@1- (0.01,0) [-100|100] "Nm" Monitor
 SG_ Heat m1 : 16|16@1- (0.1,0) [-100|300] "degC" Monitor"""
)


def test_signals_by_their_bits_need_no_database(tmp_path: Path) -> None:
    wishes = {
        "V_a": ("V", RAW),
        "i": ("A", {**RAW, "start": 23, "byte_order": "big", "unit": "mA", "scale": 10, "offset": 5}),
        "x": ("m", {"id": 0x18FF50E5, "extended": True, "start": 32, "length": 32, "float": True, "unit": "mm"}),
    }
    frame_decoder = decoder(tmp_path, wishes)
    data = struct.pack("<h", -250) + struct.pack(">h", 300) + bytes(4)
    assert values(frame_decoder.decode(frame(0x181, data), 0.0)) == {
        "V_a": pytest.approx(-2.5),
        "i": pytest.approx(3.005),
    }
    wide = bytes(4) + struct.pack("<f", 12.5)
    assert values(frame_decoder.decode(frame(0x18FF50E5, wide, extended=True), 0.0)) == {"x": pytest.approx(0.0125)}
    assert frame_decoder.decode(frame(0x181, data, extended=True), 0.0) == []
    assert frame_decoder.counters.bad == 0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"start": 56},
            "bit 56 reach into byte 9 of a frame of 8: correct start or length, or set fd = true",
        ),
        ({"start": 0, "byte_order": "big", "length": 64}, "reach into byte 9"),
        ({"start": 500, "fd": True}, "reach into byte 65 of a frame of 64: correct start or length"),
        ({"id": "0x18FF50E5"}, "id 0x18FF50E5 needs 29 bits: set extended = true"),
        ({"id": "0x3FFFFFFF", "extended": True}, "less than or equal to 536870911"),
        ({"id": "drive"}, "'drive' is not a whole number"),
        ({"length": 24, "float": True}, "a floating-point number has 16, 32 or 64 bits, not 24"),
        ({"length": 65}, "64"),
        ({"start": None}, "'start' and 'length' (bits) are missing beside 'id'"),
        ({"scale": 0}, "scale 0 makes every value the same"),
        ({"range": [5, 5]}, "the lower end comes first"),
        ({"signal": "Speed"}, "give one of 'signal', 'id' and 'node'"),
        ({"object": "0x6078"}, "'object' belongs to 'node', not to 'id'"),
    ],
)
def test_invalid_sources_are_refused(change: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValidationError) as caught:
        CanSource.model_validate({**RAW, **change}).bits()
    assert sentence in str(caught.value)


def test_unit_and_scale_replace_those_of_the_database(tmp_path: Path) -> None:
    """The current of a motor may stand for the force of an axis; a scale needs a unit."""
    with pytest.raises(ValidationError, match="set 'unit' to the new one"):
        CanSource.model_validate({"signal": "Iq_Measured", "scale": 2})
    source = {"signal": "Iq_Measured", "unit": "kN", "scale": 0.05, "offset": 1, "range": [-1, 2]}
    frame_decoder = decoder(tmp_path, {"F": ("N", source)}, ODRIVE)
    assert values(frame_decoder.decode(frame(20, struct.pack("<ff", 0.0, 4.0)), 0.0)) == {"F": pytest.approx(1200.0)}
    assert math.isnan(frame_decoder.decode(frame(20, struct.pack("<ff", 0.0, 20.5)), 0.0)[0].value)


def test_floats_with_an_empty_range_are_read(tmp_path: Path) -> None:
    wishes = {"x": ("rad", {"signal": "Pos_Estimate"}), "i_q": ("A", {"signal": "Iq_Measured"})}
    frame_decoder = decoder(tmp_path, wishes, ODRIVE)
    assert values(frame_decoder.decode(frame(9, struct.pack("<ff", 0.5, 3.0)), 0.0)) == {"x": pytest.approx(math.pi)}
    assert values(frame_decoder.decode(frame(20, struct.pack("<ff", 0.0, -4.25)), 0.0)) == {"i_q": -4.25}
    assert frame_decoder.counters.bad == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_floats_that_are_not_finite_are_no_reading(tmp_path: Path, value: float) -> None:
    frame_decoder = decoder(tmp_path, {"i_q": ("A", {"signal": "Iq_Measured"})}, ODRIVE)
    got = frame_decoder.decode(frame(20, struct.pack("<ff", 0.0, value)), 1.0)
    assert [math.isnan(sample.value) for sample in got] == [True]
    assert (frame_decoder.counters.received, frame_decoder.counters.bad) == (1, 1)
    assert "i_q of" in frame_decoder.warnings(2.0)[0]


def test_range_includes_its_bounds_and_can_be_replaced(tmp_path: Path) -> None:
    text = dbc('BO_ 5 M: 8 Drive\n SG_ U : 0|16@1- (0.002,0) [-65|65] "V" Monitor')
    for source, limit in ({"signal": "U"}, 65.0), ({"signal": "U", "range": [-60, 60]}, 60.0):
        frame_decoder = decoder(tmp_path, {"U": ("V", source)}, text)
        for raw in (round(limit / 0.002), round(-limit / 0.002)):
            assert not math.isnan(frame_decoder.decode(frame(5, struct.pack("<h6x", raw)), 0.0)[0].value)
            beyond = raw + (1 if raw > 0 else -1)
            assert math.isnan(frame_decoder.decode(frame(5, struct.pack("<h6x", beyond)), 0.0)[0].value)
        assert frame_decoder.counters.bad == 2


def test_multiplexed_signals_miss_nothing_in_other_frames(tmp_path: Path) -> None:
    wishes = {
        "T": ("N*m", {"signal": "Torque"}),
        "heat": ("K", {"signal": "Heat"}),
        "U": ("V", {"signal": "Always"}),
    }
    frame_decoder = decoder(tmp_path, wishes, MULTIPLEXED)
    assert values(frame_decoder.decode(frame(100, bytes([0, 5, 0x10, 0x27, 0, 0, 0, 0])), 0.0)) == {
        "U": 5.0,
        "T": 100.0,
    }
    got = values(frame_decoder.decode(frame(100, bytes([1, 6, 0xFA, 0, 0, 0, 0, 0])), 0.01))
    assert got == {"U": 6.0, "heat": pytest.approx(298.15)}
    assert values(frame_decoder.decode(frame(100, bytes([77, 7] + [0] * 6)), 0.02)) == {"U": 7.0}
    assert (frame_decoder.counters.received, frame_decoder.counters.bad) == (5, 0)


def test_a_silent_multiplexer_value_is_a_warning(tmp_path: Path) -> None:
    frame_decoder = decoder(
        tmp_path, {"T": ("N*m", {"signal": "Torque"}), "heat": ("degC", {"signal": "Heat"})}, MULTIPLEXED
    )
    frame_decoder.begin(0.0)
    for index in range(2000):
        which = index % 2 if index < 1000 else 0
        frame_decoder.decode(frame(100, bytes([which] + [0] * 7)), index * 0.01)
    assert_each_says(frame_decoder.warnings(20.0), ("Values (0x64)", "Which = 1", "silent", "10.0 s", "20.0 ms"))


def test_a_float_at_the_bound_of_its_range_is_a_reading(tmp_path: Path) -> None:
    """The 32-bit number next to 0.1 is above 0.1."""
    source = {"id": 5, "start": 0, "length": 32, "float": True, "unit": "V", "range": [0, 0.1]}
    frame_decoder = decoder(tmp_path, {"U": ("V", source)})
    assert values(frame_decoder.decode(frame(5, struct.pack("<f", 0.1)), 0.0)) == {"U": pytest.approx(0.1)}


def test_a_multiplexer_value_that_never_comes_is_a_warning(tmp_path: Path) -> None:
    """After a hundred periods of the message, since not every frame has it."""
    frame_decoder = decoder(tmp_path, {"heat": ("degC", {"signal": "Heat"})}, MULTIPLEXED)
    frame_decoder.begin(0.0)
    for index in range(121):
        frame_decoder.decode(frame(100, bytes(8)), index * 0.1)
    assert frame_decoder.warnings(9.9) == []
    assert_each_says(frame_decoder.warnings(10.5), ("Values (0x64)", "Which = 1", "not", "10.5 s"))


def test_nested_multiplexers_are_decoded(tmp_path: Path) -> None:
    text = dbc(
        """BO_ 100 Values: 8 Drive
 SG_ Outer M : 0|4@1+ (1,0) [0|0] "" Monitor
 SG_ Inner m1M : 4|4@1+ (1,0) [0|0] "" Monitor
 SG_ Deep m2 : 8|8@1+ (1,0) [0|0] "V" Monitor""",
        after="SG_MUL_VAL_ 100 Inner Outer 1-1;\nSG_MUL_VAL_ 100 Deep Inner 2-3;",
    )
    frame_decoder = decoder(tmp_path, {"U": ("V", {"signal": "Deep"})}, text)
    for first, expected in ((0x21, [9.0]), (0x31, [9.0]), (0x11, []), (0x22, [])):
        got = frame_decoder.decode(frame(100, bytes([first, 9] + [0] * 6)), 0.0)
        assert [sample.value for sample in got] == expected


def test_short_frames_are_bad_and_a_warning(tmp_path: Path) -> None:
    frame_decoder = decoder(tmp_path, {"V_a": ("V", {**RAW, "start": 16})})
    for time in (0.0, 0.1):
        assert frame_decoder.decode(frame(0x181, bytes(3)), time) == []
    assert frame_decoder.counters.bad == 2
    assert_each_says(frame_decoder.warnings(1.1), ("0x181", "3 bytes", "4", "2 ", "1.0 s"))


TWO = dbc(
    'BO_ 256 Drive: 8 Drive\n SG_ Current : 0|16@1- (0.01,0) [0|0] "A" Monitor\n'
    ' SG_ Speed : 16|16@1- (0.1,0) [0|0] "rad/s" Monitor\n SG_ AliveCounter : 60|4@1+ (1,0) [0|15] "" Monitor'
)
BOTH = {"i": ("A", {"signal": "Current"}), "omega": ("rad/s", {"signal": "Speed"})}


@pytest.mark.parametrize(
    ("length", "expected", "bad"),
    [(8, {"i": 1.0, "omega": 3.0}, 0), (4, {"i": 1.0, "omega": 3.0}, 0), (3, {"i": 1.0, "omega": None}, 1), (1, {}, 1)],
)
def test_of_a_short_frame_the_signals_that_are_in_it_are_read(
    tmp_path: Path, length: int, expected: dict[str, float | None], bad: int
) -> None:
    frame_decoder = decoder(tmp_path, BOTH, TWO)
    data = struct.pack("<hhI", 100, 30, 0)[:length]
    read = values(frame_decoder.decode(frame(256, data), 0.0))
    assert {name: None if math.isnan(value) else round(value, 9) for name, value in read.items()} == expected
    assert (frame_decoder.counters.bad, frame_decoder.counters.lost) == (bad, 0)
    warnings = frame_decoder.warnings(0.1)
    assert any(f"{length} bytes instead of 8" in line for line in warnings) is (length < 8)
    assert any("without omega" in line for line in warnings) is (length == 3)
    assert not frame_decoder.defect(0.1)


def test_a_short_frame_without_its_multiplexer_has_none_of_its_signals(tmp_path: Path) -> None:
    text = dbc(
        'BO_ 100 Values: 8 Drive\n SG_ Plain : 0|8@1+ (1,0) [0|0] "V" Monitor\n'
        ' SG_ Kind M : 56|8@1+ (1,0) [0|0] "" Monitor\n SG_ Deep m1 : 8|8@1+ (1,0) [0|0] "V" Monitor'
    )
    frame_decoder = decoder(tmp_path, {"a": ("V", {"signal": "Plain"}), "b": ("V", {"signal": "Deep"})}, text)
    assert values(frame_decoder.decode(frame(100, b"\x05\x06\x07"), 0.0)) == {"a": 5.0}
    assert values(frame_decoder.decode(frame(100, b"\x05\x06" + bytes(5) + b"\x01"), 0.1)) == {"a": 5.0, "b": 6.0}


def test_a_short_frame_without_its_checksum_is_refused(tmp_path: Path) -> None:
    table = {"Drive": {"checksum": {"signal": {"start": 48, "length": 8}, "kind": "xor"}}}
    frame_decoder = decoder(tmp_path, BOTH, TWO, messages=table)
    assert frame_decoder.decode(frame(256, bytes(5)), 0.0) == []
    assert frame_decoder.counters.bad == 1


def test_a_value_out_of_its_range_names_signal_value_and_range(tmp_path: Path) -> None:
    frame_decoder = decoder(tmp_path, {"V_a": ("V", {**RAW, "range": [0, 10]})})
    frame_decoder.decode(frame(0x181, struct.pack("<h", 2345) + bytes(6)), 0.0)
    assert_each_says(frame_decoder.warnings(0.1), ("V_a", "23.45 V", "0 to 10 V"))
    assert "23.45 V" in frame_decoder.latest_rejection()


def test_a_fault_of_the_decoder_is_counted_apart_and_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    frame_decoder = decoder(tmp_path, BOTH, TWO)
    assert not frame_decoder.defect(0.0)
    monkeypatch.setattr(PeriodEstimator, "lost_before", lambda *_: 1 // 0)
    for index in range(5):
        assert frame_decoder.decode(frame(256, bytes(8)), 0.1 * index) == []
    assert frame_decoder.counters.bad == 5
    assert_each_says([frame_decoder.defect(1.0)], ("ZeroDivisionError", "0x100", "5 in all"))
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert caplog.records[0].exc_info is not None
    assert not frame_decoder.defect(100.0)


def test_fd_frames_have_more_than_eight_bytes(tmp_path: Path) -> None:
    wishes = {"V_a": ("V", {**RAW, "start": 496, "fd": True})}
    frame_decoder = decoder(tmp_path, wishes)
    got = frame_decoder.decode(frame(0x181, bytes(62) + struct.pack("<h", 123), fd=True), 0.0)
    assert values(got) == {"V_a": pytest.approx(1.23)}


def test_tables_of_unknown_messages_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigurationError, match=r"no message 'Axis0_Get_Iqq' has a signal of \[signals\]: did you mean"
    ):
        decoder(tmp_path, {"i": ("A", {"signal": "Iq_Measured"})}, ODRIVE, messages={"Axis0_Get_Iqq": {}})
    frame_decoder = decoder(
        tmp_path, {"i": ("A", {"signal": "Iq_Measured"})}, ODRIVE, messages={"Axis0_Get_Encoder_Estimates": {}}
    )
    assert (
        "warning: driver.messages.Axis0_Get_Encoder_Estimates: [signals] has no signal of it"
        in frame_decoder.describe()
    )


HOSTILE = st.one_of(st.binary(max_size=64), st.none(), st.integers(), st.text(max_size=8), st.lists(st.integers()))


@pytest.fixture(scope="module")
def hardened(tmp_path_factory: pytest.TempPathFactory) -> FrameDecoder:
    wishes = {
        "x": ("rad", {"signal": "Pos_Estimate"}),
        "i_q": ("A", {"signal": "Iq_Measured"}),
        "V_a": ("V", RAW),
        "U": ("V", {"id": 5, "start": 5, "length": 13, "unit": "V", "range": [0, 10]}),
    }
    return decoder(tmp_path_factory.mktemp("hostile"), wishes, ODRIVE)


@settings(deadline=None)
@given(
    data=HOSTILE,
    identifier=st.sampled_from([5, 9, 20, 100, 0x181, -1, None, "x", 1.5, [1]]),
    flags=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    time=st.floats(0, 1e9),
)
def test_hostile_frames_neither_raise_nor_give_wrong_values(
    hardened: FrameDecoder, data: object, identifier: object, flags: tuple[bool, bool, bool], time: float
) -> None:
    """Interfaces deliver unchecked what was on the wire, so any field may hold any object."""
    frame_decoder, message = hardened, frame(9, b"")
    message.arbitration_id, message.data = identifier, data  # type: ignore[assignment]
    message.is_extended_id, message.is_error_frame, message.is_remote_frame = flags
    before = frame_decoder.counters
    got = frame_decoder.decode(message, time)
    after = frame_decoder.counters
    assert after.received - before.received == len(got)
    unusable = sum(not math.isfinite(sample.value) for sample in got)
    assert after.bad - before.bad >= unusable
    assert all(abs(sample.value) < 1e301 for sample in got if math.isfinite(sample.value))
    assert all("\n" not in line for line in frame_decoder.warnings(time))
    assert not frame_decoder.defect(time)


def test_options_take_one_database_or_several() -> None:
    assert [len(FrameOptions(dbc=paths).databases()) for paths in (Path("a"), (Path("a"), Path("b")), ())] == [1, 2, 0]
