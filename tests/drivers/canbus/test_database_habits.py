"""What tools and vendors write into databases: names cut short, placeholders, identifiers without their flag."""

from pathlib import Path

import pytest

from otolith_drivers.canbus.database import load_database, load_dbc
from otolith_drivers.canbus.probe import Picture
from otolith_drivers.errors import ConfigurationError
from tests.drivers.can_frames import dbc, decoder, frame, values
from tests.messages import raises_saying

NESTED = """BO_ 258 Mux: 8 Drive
 SG_ VeryLongNameOfTheOuterMultiplexer M : 0|8@1+ (1,0) [0|0] "" Monitor
 SG_ InnerMultiplexer m0M : 8|8@1+ (1,0) [0|0] "" Monitor
 SG_ Volts m1 : 16|8@1+ (1,0) [0|0] "V" Monitor
 SG_ Plain : 24|8@1+ (1,0) [0|0] "V" Monitor"""
CUT = dbc(
    NESTED,
    after="SG_MUL_VAL_ 258 InnerMultiplexer VeryLongNameOfTheOuterMul 0-0;\n\nSG_MUL_VAL_ 258 Volts InnerMult 1-1;",
)
OUTER_CUT = CUT.replace("InnerMult 1-1", "InnerMultiplexer 1-1")
VOLTS, PLAIN = {"U": ("V", {"signal": "Volts"})}, {"U": ("V", {"signal": "Plain"})}


@pytest.mark.parametrize(
    "text",
    [
        CUT,
        OUTER_CUT,
        dbc(NESTED),  # two multiplexers, and nothing that assigns the signals to them
        dbc(NESTED.replace("m0M", "m0").replace("Multiplexer M ", "Multiplexer ")),
    ],
    ids=["name cut short", "outer name cut short", "not assigned", "no multiplexer"],
)
def test_signal_without_its_multiplexer_is_an_error_only_if_requested(tmp_path: Path, text: str) -> None:
    """It would otherwise be read from frames that do not contain it."""
    with raises_saying(ConfigurationError, "Mux.Volts", "multiplexed", "'id'"):
        decoder(tmp_path, VOLTS, text)
    frame_decoder = decoder(tmp_path, PLAIN, text)
    assert any("Mux.Volts is multiplexed by" in line for line in frame_decoder.describe())
    assert values(frame_decoder.decode(frame(258, bytes([0, 1, 2, 3, 0, 0, 0, 0])), 0.0)) == {"U": 3.0}


def test_a_cycle_time_that_is_none_does_no_harm(tmp_path: Path) -> None:
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" INT 0 10;\nBA_DEF_DEF_ "GenMsgCycleTime" 0;\nBA_ "GenMsgCycleTime" BO_ 258 '
    frame_decoder = decoder(tmp_path, PLAIN, dbc(NESTED, after=f"{cycle}{'9' * 400};"))
    assert values(frame_decoder.decode(frame(258, bytes([0, 1, 2, 3, 0, 0, 0, 0])), 0.0)) == {"U": 3.0}


def test_a_cycle_time_that_is_a_text_does_no_harm(tmp_path: Path) -> None:
    cycle = 'BA_DEF_ BO_ "GenMsgCycleTime" STRING ;\nBA_DEF_DEF_ "GenMsgCycleTime" "";\n'
    text = dbc(NESTED, after=f'{cycle}BA_ "GenMsgCycleTime" BO_ 258 "100";')
    frame_decoder = decoder(tmp_path, PLAIN, text)
    assert values(frame_decoder.decode(frame(258, bytes([0, 1, 2, 3, 0, 0, 0, 0])), 0.0)) == {"U": 3.0}


def test_a_message_of_a_negative_length_does_not_affect_others(tmp_path: Path) -> None:
    frame_decoder = decoder(tmp_path, PLAIN, dbc(NESTED, 'BO_ 400 Other: -1 Drive\n SG_ A : 0|8@1+ (1,0) [0|0] "V" X'))
    assert any("message Other cannot be used: it has -1 bytes" in line for line in frame_decoder.describe())


@pytest.mark.parametrize("length", [0, 12])
def test_signal_of_an_impossible_length_is_an_error_in_one_line(tmp_path: Path, length: int) -> None:
    text = dbc(
        f'BO_ 385 Motor: 8 Drive\n SG_ Speed : 0|{length}@1- (1,0) [0|0] "rad/s" Monitor',
        after="SIG_VALTYPE_ 385 Speed : 1;" if length else "",
    )
    with pytest.raises(ConfigurationError, match=r"drive\.dbc: "):
        decoder(tmp_path, {"omega": ("rad/s", {"signal": "Speed"})}, text)


def test_identifier_of_29_bits_without_its_flag_is_extended(tmp_path: Path) -> None:
    """As SavvyCAN and opendbc write it; everything else in the file refers to the same number."""
    text = dbc(
        'BO_ 419385573 Drive: 8 Drive\n SG_ Speed : 0|32@1- (1,0) [0|0] "rad/s" Monitor',
        'BO_ 385 Other: 8 Drive\n SG_ U : 0|16@1- (1,0) [0|0] "V" Monitor',
        after='SIG_VALTYPE_ 419385573 Speed : 1;\nCM_ SG_ 419385573 Speed "of the shaft";',
    )
    frame_decoder = decoder(tmp_path, {"omega": ("rad/s", {"signal": "Speed"})}, text)
    assert frame_decoder.identifiers() == [(419385573, True)]
    data = bytes.fromhex("00002041") + bytes(4)  # 10.0 as a float
    assert values(frame_decoder.decode(frame(419385573, data, extended=True), 0.0)) == {"omega": 10.0}
    (warning,) = frame_decoder.configuration_warnings
    assert "identifiers over 11 bits without bit 31 are read as extended: Drive" in warning
    database = load_database(tmp_path / "drive.dbc")
    assert [message.is_extended_frame for message in database.messages] == [True, False]


@pytest.mark.parametrize(
    ("bits", "scale", "placeholder"),
    [("0|16", "1", True), ("0|16", "0.01", True), ("0|8", "0.005", False), ("0|1", "1", False), ("0|8", "0.01", False)],
)
def test_range_0_to_1_on_several_bits_is_none(tmp_path: Path, bits: str, scale: str, placeholder: bool) -> None:
    """Unless half of the numbers that the bits hold are in it, as of a duty cycle."""
    text = dbc(f'BO_ 385 Motor: 8 Drive\n SG_ U : {bits}@1+ ({scale},0) [0|1] "V" Monitor')
    frame_decoder = decoder(tmp_path, {"U": ("V", {"signal": "U"})}, text)
    assert ("[0|1] is taken for a placeholder" in frame_decoder.describe()[0]) is placeholder
    (sample,) = frame_decoder.decode(frame(385, bytes([255] * 8)), 0.0)
    assert (sample.value == sample.value) is (placeholder or bits == "0|1")
    picture = Picture(load_dbc(tmp_path / "drive.dbc"))
    picture.take(frame(385, bytes([255] * 8)), 0.0)
    ((_, _, value),) = picture.signals()
    assert (value.beyond == 0) is (placeholder or bits == "0|1")


@pytest.mark.parametrize(
    ("scale", "raw", "sentence"),
    [
        ("0.001", 32700, "i of 32700 mA is out of its range from -32000 to 32000 mA"),
        ("-0.001", 32700, "i of -32700 mA is out of its range from -32000 to 32000 mA"),
    ],
)
def test_discarded_value_is_named_with_signal_value_and_range(
    tmp_path: Path, scale: str, raw: int, sentence: str
) -> None:
    text = dbc(f'BO_ 385 Motor: 8 Drive\n SG_ Current : 0|16@1- ({scale},0) [-32|32] "A" Monitor')
    frame_decoder = decoder(tmp_path, {"i": ("mA", {"signal": "Current"})}, text)
    frame_decoder.decode(frame(385, raw.to_bytes(2, "little", signed=True) + bytes(6)), 0.0)
    (line,) = frame_decoder.warnings(0.1)
    assert sentence in line


def test_number_that_is_not_finite_is_named(tmp_path: Path) -> None:
    text = dbc('BO_ 385 Motor: 8 Drive\n SG_ U : 0|32@1- (1,0) [0|0] "V" Monitor', after="SIG_VALTYPE_ 385 U : 1;")
    frame_decoder = decoder(tmp_path, {"U": ("V", {"signal": "U"})}, text)
    frame_decoder.decode(frame(385, bytes.fromhex("0000c07f") + bytes(4)), 0.0)
    (line,) = frame_decoder.warnings(0.1)
    assert "U of nan V is no number" in line


@pytest.mark.parametrize(
    ("bits", "table", "readings", "none"),
    [
        ("0|16@1+", '65535 "SNA" 65534 "Error" 0 "Standstill"', [0, 1, 65533], [65534, 65535]),
        ("0|16@1-", '-32768 "Signal not available"', [-32767, 32767], [-32768]),
        ("0|16@1-", '32768 "SNA"', [-32767, 32767], [-32768]),  # the bits of the lowest number
        ("0|8@1+", '0 "Sensor error" 255 "Not available"', [1, 254], [0, 255]),
        ("0|16@1+", '65535 "Maximum" 0 "Nabla" 32000 "Invalid"', [0, 32000, 65535], []),  # it may be passed
        ("0|4@1+", '15 "SNA" 14 "Error"', [14, 15], []),  # a state
    ],
)
def test_a_number_that_the_database_names_as_none_is_no_reading(
    tmp_path: Path, bits: str, table: str, readings: list[int], none: list[int]
) -> None:
    text = dbc(f'BO_ 385 Motor: 8 Drive\n SG_ U : {bits} (0.1,0) [0|0] "V" X', after=f"VAL_ 385 U {table} ;")
    plain = decoder(tmp_path, {"U": ("V", {"signal": "U"})}, text)
    stated = decoder(tmp_path, {"U": ("V", {"signal": "U", "range": [-1e9, 1e9]})}, text)
    for number in readings + none:
        data = (number % 65536).to_bytes(2, "little") + bytes(6)
        (sample,) = plain.decode(frame(385, data), 0.0)
        assert sample.value == pytest.approx(float("nan") if number in none else 0.1 * number, nan_ok=True)
        assert values(stated.decode(frame(385, data), 0.0)) == {"U": pytest.approx(0.1 * number)}
    assert plain.counters.bad == len(none)
    if none:
        (line,) = plain.warnings(0.0)
        assert f"U of {0.1 * none[-1]:g} V is no reading: its raw number {none[-1]} is '" in line


def test_a_signal_without_receivers_and_a_message_without_a_sender_are_read(tmp_path: Path) -> None:
    """The library drops the one without a word, and refuses the other."""
    text = dbc('BO_ 385 Motor: 8\n SG_ U : 0|16@1- (0.1,0) [0|0] "V"\n SG_ I : 16|16@1- (0.1,0) [0|0] "A"  ')
    for written in (text, text.replace("\n", "\r\n")):
        signals = {"U": ("V", {"signal": "U"}), "I": ("A", {"signal": "I"})}
        frame_decoder = decoder(tmp_path, signals, written)
        assert frame_decoder.configuration_warnings == ()
        samples = frame_decoder.decode(frame(385, bytes([10, 0, 20, 0, 0, 0, 0, 0])), 0.0)
        assert values(samples) == pytest.approx({"U": 1.0, "I": 2.0})


def test_an_unknown_byte_order_is_refused(tmp_path: Path) -> None:
    """The library takes it over, and decodes it as the other one."""
    path = tmp_path / "drive.kcd"
    value = '<Value type="unsigned" unit="V"/>'
    signal = f'<Signal name="U" offset="0" length="8" endianess="{{}}">{value}</Signal>'
    text = (
        '<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0"><Document/><Bus name="b">'
        f'<Message id="0x181" name="M" length="8">{signal}</Message></Bus></NetworkDefinition>'
    )
    path.write_text(text.format("little"), encoding="utf-8")
    assert load_database(path).unread == {}
    path.write_text(text.format("lite"), encoding="utf-8")
    assert load_database(path).unread == {"M": "one of its signals has the byte order 'lite_endian'"}
