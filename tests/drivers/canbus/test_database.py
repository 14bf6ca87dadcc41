"""CAN databases as vendors write them: found with the name of what is near, and read in spite of what is wrong."""

import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from otolith_drivers.base import Signal
from otolith_drivers.canbus.database import Loaded, load_database, load_dbc
from otolith_drivers.canbus.signals import Source, find_in_databases
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.drivers.can_frames import dbc, decoder, frame, values
from tests.waiting import within

DBC = EXAMPLES / "dc-motor.dbc"
MOTOR = """BO_ 385 Motor: 8 Drive
 SG_ Speed : 0|16@1- (0.01,0) [0|0] "rad/s" Monitor
 SG_ Current : 16|16@1- (0.001,0) [-32|32] "A" Monitor"""
SPEED = {"omega": ("rad/s", {"signal": "Speed"})}
FULL = bytes([0xE8, 0x03, 0xD0, 0x07, 0, 0, 0, 0])


def loaded(path: Path, text: str | bytes) -> Loaded:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_database(path)


@pytest.mark.parametrize(
    ("unit", "source", "sentence"),
    [
        ("rad/s", Source(signal="RotorSped"), "no signal 'RotorSped': did you mean 'RotorSpeed'?"),
        ("rad/s", Source(signal="RotorSpeed", message="Motor"), "no message 'Motor'"),
        ("A", Source(signal="RotorSpeed"), "unit 'rad/s' does not measure what 'A' does"),
        ("1", Source(signal="ElectricalAliveCounter"), "has no unit: set 'unit' beside it"),
    ],
)
def test_refusals(unit: str, source: Source, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        find_in_databases(Signal("n", unit, source), [load_database(DBC)])
    assert sentence in str(caught.value)
    assert caught.value.key == ("signals", "n")
    assert "\n" not in str(caught.value)


BROKEN = {
    "empty": "",
    "no database": "BO_ what",
    "zeros": "\x00\x01",
    "a list that would fill the memory": dbc('BO_ 1 A: 999999999 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X'),
    "a signal that would": dbc('BO_ 1 A: 8 X\n SG_ S : 0|999999999@1+ (1,0) [0|0] "" X'),
    "a multiplexer that would": dbc(
        'BO_ 1 A: 8 X\n SG_ M M : 0|8@1+ (1,0) [0|0] "" X\n SG_ S m0 : 8|8@1+ (1,0) [0|0] "" X',
        after="SG_MUL_VAL_ 1 S M 0-4000000000;",
    ),
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_database_is_refused_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "broken.dbc"
    with pytest.raises(ConfigurationError) as caught:
        find_in_databases(Signal("n", "V", Source(signal="S")), [loaded(path, content)])
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.timed
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bomb.kcd", '<!DOCTYPE x [<!ENTITY a "aaaa">]><NetworkDefinition>&a;</NetworkDefinition>'),
        (
            "bomb.kcd",
            '<NetworkDefinition><Bus name="b"><Message id="1" name="m" length="99999999"/></Bus></NetworkDefinition>',
        ),
        ("bomb.sym", 'FormatVersion=6.0\nTitle="x"\n\n{SEND}\n\n[M]\nID=000h-1FFFFFFFh\nLen=8\n'),
    ],
)
def test_bombs_of_other_formats_are_refused(tmp_path: Path, name: str, text: str) -> None:
    begun = time.monotonic()
    with pytest.raises(ConfigurationError, match="not a CAN database"):
        loaded(tmp_path / name, text)
    assert time.monotonic() - begun < within(2.0)


def test_a_huge_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with (tmp_path / "huge.dbc").open("wb") as file:
        file.truncate(1 << 30)
    for path in (tmp_path / "huge.dbc", tmp_path, Path("/dev/zero")):
        with pytest.raises(ConfigurationError, match=r"larger than|not a file"):
            load_database(path)


def test_the_data_sheet_of_a_canopen_drive_is_called_by_its_name() -> None:
    with pytest.raises(ConfigurationError, match=r'not a CAN database: name it by eds = "\.\.\." in \[driver\]'):
        load_database(EXAMPLES / "canopen-drive.eds")


def test_a_database_that_is_in_order_has_no_warnings() -> None:
    for path in sorted(EXAMPLES.glob("*.dbc")):
        assert load_database(path).warnings() == []
        assert load_dbc(path).messages


def test_overlapping_signals_of_others_are_a_warning_and_wanted_ones_an_error(tmp_path: Path) -> None:
    text = dbc(
        MOTOR,
        """BO_ 642 Other: 8 Drive
 SG_ One : 0|16@1+ (1,0) [0|0] "V" Monitor
 SG_ Two : 8|16@1+ (1,0) [0|0] "V" Monitor
 SG_ Three : 32|16@1+ (1,0) [0|0] "V" Monitor""",
    )
    found = decoder(tmp_path, SPEED, text)
    assert "warning: drive.dbc: Other.Two and Other.One overlap" in found.describe()
    assert values(found.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}
    decoder(tmp_path, {"U": ("V", {"signal": "Three"})}, text)  # the message is faulty, but not where it is read
    with pytest.raises(ConfigurationError, match=r"Other.Two and Other.One overlap: read it by 'id'"):
        decoder(tmp_path, {"U": ("V", {"signal": "One"})}, text)


def test_a_signal_beyond_its_frame_is_told_and_refused_only_where_it_is_wanted(tmp_path: Path) -> None:
    text = dbc(MOTOR, 'BO_ 642 Other: 2 Drive\n SG_ One : 8|16@1+ (1,0) [0|0] "V" Monitor')
    assert (
        "warning: drive.dbc: Other.One lies beyond the 2 bytes of its frame"
        in decoder(tmp_path, SPEED, text).describe()
    )
    with pytest.raises(ConfigurationError, match="lies beyond the 2 bytes"):
        decoder(tmp_path, {"U": ("V", {"signal": "One"})}, text)


def test_a_frame_described_twice_needs_a_word_which_it_is(tmp_path: Path) -> None:
    text = dbc(MOTOR, 'BO_ 385 Rival: 8 Drive\n SG_ Power : 0|16@1- (1,0) [0|0] "W" Monitor')
    with pytest.raises(ConfigurationError, match="frame 0x181 is both Motor and Rival: say which it is by 'message'"):
        decoder(tmp_path, SPEED, text)
    found = decoder(tmp_path, {"omega": ("rad/s", {"signal": "Speed", "message": "Motor"})}, text)
    assert "warning: drive.dbc: frame 0x181 is described 2 times: Motor, Rival" in found.describe()


def test_a_name_in_two_messages_needs_the_message(tmp_path: Path) -> None:
    text = dbc(MOTOR, MOTOR.replace("385 Motor", "386 Motor2"))
    with pytest.raises(ConfigurationError, match="is in Motor, Motor2: set 'message' beside it"):
        decoder(tmp_path, SPEED, text)


def test_several_databases_are_one(tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(dbc(MOTOR), encoding="utf-8")
    (tmp_path / "b.dbc").write_text(
        dbc('BO_ 642 Supply: 8 Drive\n SG_ Voltage : 0|16@1+ (0.1,0) [0|0] "V" Monitor'), encoding="utf-8"
    )
    wishes = {**SPEED, "U": ("V", {"signal": "Voltage"})}
    found = decoder(tmp_path, wishes, dbc=["a.dbc", "b.dbc"])
    assert values(found.decode(frame(642, bytes([100] + [0] * 7)), 0.0)) == {"U": pytest.approx(10.0)}
    assert values(found.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}


@pytest.mark.parametrize(
    "after",
    [
        'CM_ SG_ 385 Speed "a comment that never ends;',
        'BA_ "GenMsgCycleTime" BO_ 385 ten;',
        'VAL_ 385 Speed 0 "Off" oops "On" ;',
        "SOMETHING_NEW_ 1 2 3;",
    ],
)
def test_what_is_not_needed_may_be_broken(tmp_path: Path, after: str) -> None:
    found = decoder(tmp_path, SPEED, dbc(MOTOR, after=after))
    assert values(found.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}
    assert any(line.startswith("warning: drive.dbc: only its messages could be read") for line in found.describe())


def test_a_message_that_cannot_be_read_costs_only_itself(tmp_path: Path) -> None:
    text = dbc('BO_ 642 Sick: 8 Drive\n SG_ One : 0|zero@1+ (1,0) [0|0] "V" Monitor', MOTOR)
    found = decoder(tmp_path, SPEED, text)
    assert any("message Sick cannot be read" in line for line in found.describe())
    with pytest.raises(ConfigurationError, match="message 'Sick' cannot be read"):
        decoder(tmp_path, {"U": ("V", {"signal": "One", "message": "Sick"})}, text)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_the_encoding_is_found_out(tmp_path: Path, encoding: str) -> None:
    text = dbc('BO_ 642 Heat: 8 Drive\n SG_ Winding : 0|8@1+ (1,-40) [0|0] "°C" Monitor')
    found = loaded(tmp_path / "heat.dbc", text.encode(encoding))
    assert found.messages[0].signals[0].unit == "°C"
    assert found.warnings() == []


def test_bytes_of_no_encoding_are_told(tmp_path: Path) -> None:
    text = dbc(MOTOR, after='CM_ "Gr\x81\xdf";').encode("latin-1")
    found = loaded(tmp_path / "odd.dbc", text)
    assert [message.name for message in found.messages] == ["Motor"]
    assert "neither UTF-8 nor Windows-1252" in found.warnings()[0]


KCD = """<?xml version="1.0" encoding="UTF-8"?>
<NetworkDefinition xmlns="http://kayak.2codeornot2code.org/1.0">
  <Document name="drive"/>
  <Bus name="main">
    <Message id="0x181" name="Motor" length="8">
      <Signal name="Speed" offset="0" length="16"><Value type="signed" slope="0.01" unit="rad/s"/></Signal>
      <Signal name="Current" offset="16" length="16"><Value type="signed" slope="0.001" unit="A"/></Signal>
    </Message>
  </Bus>
</NetworkDefinition>
"""
SYM = """FormatVersion=6.0 // Do not edit this line!
Title="drive"

{SENDRECEIVE}

[Motor]
ID=181h
Len=8
Var=Speed signed 0,16 /u:"rad/s" /f:0.01
Var=Current signed 16,16 /u:A /f:0.001
"""


@pytest.mark.parametrize(("suffix", "text"), [("dbc", dbc(MOTOR)), ("kcd", KCD), ("sym", SYM), ("txt", dbc(MOTOR))])
def test_every_format_gives_the_same(tmp_path: Path, suffix: str, text: str) -> None:
    wishes = {**SPEED, "i": ("A", {"signal": "Current"})}
    found = decoder(tmp_path, wishes, text, suffix)
    assert values(found.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0), "i": pytest.approx(2.0)}


def mutations(text: str) -> st.SearchStrategy[str]:
    """``text`` with some pieces cut out, doubled, moved or replaced."""
    pieces = st.tuples(
        st.integers(0, len(text)),
        st.integers(0, 40),
        st.sampled_from(["", "\n", '"', "9999999999", "-1", "|", "@", "<", "]]>", "SG_", "\x00", "é", "m0M", "[", "="]),
    )

    def apply(edits: list[tuple[int, int, str]]) -> str:
        found = text
        for place, length, instead in edits:
            found = found[:place] + instead + found[place + length :]
        return found

    return st.lists(pieces, min_size=1, max_size=6).map(apply)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow], deadline=5000)
@given(data=st.data(), kind=st.sampled_from([("dbc", DBC.read_text(encoding="utf-8")), ("kcd", KCD), ("sym", SYM)]))
def test_a_mutated_database_is_read_or_refused_in_one_line(
    tmp_path: Path, data: st.DataObject, kind: tuple[str, str]
) -> None:
    suffix, text = kind
    mutated = data.draw(mutations(text))
    wish = "RotorSpeed" if suffix == "dbc" else "Speed"
    try:
        found = decoder(tmp_path, {"omega": ("rad/s", {"signal": wish})}, mutated, suffix)
    except ConfigurationError as error:
        assert "\n" not in str(error)  # noqa: PT017 - either way is right
        return
    for identifier, extended in found.identifiers():
        for content in (FULL, b"", bytes([255] * 8)):
            found.decode(frame(identifier, content, extended=extended), 0.0)
