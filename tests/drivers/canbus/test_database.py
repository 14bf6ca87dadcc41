"""CAN databases as vendors write them: faults are tolerated, unusable files are refused with a way out."""

import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.base import Signal
from otolith_drivers.canbus.database import CanDatabase, load_database, load_dbc
from otolith_drivers.canbus.options import CanSource, request_from_databases
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.drivers.can_frames import dbc, decoder, frame, values
from tests.messages import assert_refuses, raises_saying
from tests.waiting import within

DBC = EXAMPLES / "dc-motor.dbc"
MOTOR = """BO_ 385 Motor: 8 Drive
 SG_ Speed : 0|16@1- (0.01,0) [0|0] "rad/s" Monitor
 SG_ Current : 16|16@1- (0.001,0) [-32|32] "A" Monitor"""
SPEED = {"omega": ("rad/s", {"signal": "Speed"})}
FULL = bytes([0xE8, 0x03, 0xD0, 0x07, 0, 0, 0, 0])


def loaded(path: Path, text: str | bytes) -> CanDatabase:
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_database(path)


@pytest.mark.parametrize(
    ("unit", "source", "sentence"),
    [
        ("rad/s", CanSource(signal="RotorSped"), "no signal 'RotorSped': did you mean 'RotorSpeed'?"),
        ("rad/s", CanSource(signal="RotorSpeed", message="Motor"), "no message 'Motor'"),
        ("A", CanSource(signal="RotorSpeed"), "unit 'rad/s' does not measure what 'A' does"),
        ("1", CanSource(signal="ElectricalAliveCounter"), "has no unit: set 'unit' beside it"),
    ],
)
def test_signals_that_cannot_be_resolved_are_refused(unit: str, source: CanSource, sentence: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        request_from_databases(Signal("n", unit, source), [load_database(DBC)])
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
def test_broken_databases_are_refused_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "broken.dbc"
    with pytest.raises(ConfigurationError) as caught:
        request_from_databases(Signal("n", "V", CanSource(signal="S")), [loaded(path, content)])
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.timed
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (dbc('BO_ 1 A: 32769 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X'), "a length or a start beyond 4096 bytes"),
        (dbc(MOTOR, after="SG_MUL_VAL_ 1 S M 0-65537;"), "a multiplexer of more than 65536 values"),
    ],
)
def test_excessive_numbers_are_refused_before_parsing(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(ConfigurationError, match=sentence):
        loaded(tmp_path / "excessive.dbc", text)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("bomb.kcd", '<!DOCTYPE x [<!ENTITY a "aaaa">]><NetworkDefinition>&a;</NetworkDefinition>'),
        (
            "bomb.kcd",
            '<NetworkDefinition><Bus name="b"><Message id="1" name="m" length="99999999"/></Bus></NetworkDefinition>',
        ),
        ("bomb.sym", 'FormatVersion=6.0\nTitle="x"\n\n{SEND}\n\n[M]\nID=000h-1FFFFFFFh\nLen=8\n'),
        ("bomb.sym", 'FormatVersion=6.0\nTitle="x"\n\n{SEND}\n\n[M]\nID=100h\nLen=8\nMux=X 0,2147483648 002Ah\n'),
        ("bomb.sym", 'FormatVersion=6.0\nTitle="x"\n\n{SEND}\n\n[M]\nID=100h\nLen=8\nVar=X unsigned 2147483648,8\n'),
    ],
)
def test_memory_bombs_in_other_formats_are_refused(tmp_path: Path, name: str, text: str) -> None:
    begun = time.monotonic()
    with pytest.raises(ConfigurationError, match="not a CAN database"):
        loaded(tmp_path / name, text)
    assert time.monotonic() - begun < within(2.0)


def test_huge_files_and_folders_are_refused(tmp_path: Path) -> None:
    with (tmp_path / "huge.dbc").open("wb") as file:
        file.truncate(1 << 30)
    for path in (tmp_path / "huge.dbc", tmp_path, Path("/dev/zero")):
        with pytest.raises(ConfigurationError, match=r"larger than|not a file"):
            load_database(path)


def test_an_eds_given_as_dbc_is_refused_with_the_way_out() -> None:
    with raises_saying(ConfigurationError, "not a CAN database", 'eds = "..."', "[driver]"):
        load_database(EXAMPLES / "canopen-drive.eds")


def test_correct_databases_have_no_warnings() -> None:
    for path in sorted(EXAMPLES.glob("*.dbc")):
        assert load_database(path).warnings() == []
        assert load_dbc(path).messages


def test_overlap_is_an_error_only_for_requested_signals(tmp_path: Path) -> None:
    text = dbc(
        MOTOR,
        """BO_ 642 Other: 8 Drive
 SG_ One : 0|16@1+ (1,0) [0|0] "V" Monitor
 SG_ Two : 8|16@1+ (1,0) [0|0] "V" Monitor
 SG_ Three : 32|16@1+ (1,0) [0|0] "V" Monitor""",
    )
    frame_decoder = decoder(tmp_path, SPEED, text)
    assert "warning: drive.dbc: Other.Two and Other.One overlap" in frame_decoder.describe()
    assert values(frame_decoder.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}
    decoder(tmp_path, {"U": ("V", {"signal": "Three"})}, text)  # the message is faulty, but not where it is read
    with raises_saying(ConfigurationError, "Other.Two", "Other.One", "overlap", "'id'"):
        decoder(tmp_path, {"U": ("V", {"signal": "One"})}, text)


def test_signal_beyond_frame_is_an_error_only_if_requested(tmp_path: Path) -> None:
    text = dbc(MOTOR, 'BO_ 642 Other: 2 Drive\n SG_ One : 8|16@1+ (1,0) [0|0] "V" Monitor')
    assert (
        "warning: drive.dbc: Other.One lies beyond the 2 bytes of its frame"
        in decoder(tmp_path, SPEED, text).describe()
    )
    with pytest.raises(ConfigurationError, match="lies beyond the 2 bytes"):
        decoder(tmp_path, {"U": ("V", {"signal": "One"})}, text)


def test_warnings_of_a_faulty_database_are_limited(tmp_path: Path) -> None:
    others = [f'BO_ {700 + n} Other{n}: 1 Drive\n SG_ S{n} : 8|8@1+ (1,0) [0|0] "V" Monitor' for n in range(30)]
    warnings = decoder(tmp_path, SPEED, dbc(MOTOR, *others)).configuration_warnings
    assert (len(warnings), warnings[-1]) == (21, "... and 10 more")


def test_a_frame_described_twice_needs_the_message(tmp_path: Path) -> None:
    text = dbc(MOTOR, 'BO_ 385 Rival: 8 Drive\n SG_ Power : 0|16@1- (1,0) [0|0] "W" Monitor')
    with raises_saying(ConfigurationError, "0x181", "Motor", "Rival", "'message'"):
        decoder(tmp_path, SPEED, text)
    frame_decoder = decoder(tmp_path, {"omega": ("rad/s", {"signal": "Speed", "message": "Motor"})}, text)
    assert "warning: drive.dbc: frame 0x181 is described 2 times: Motor, Rival" in frame_decoder.describe()


def test_a_name_in_two_messages_needs_the_message(tmp_path: Path) -> None:
    text = dbc(MOTOR, MOTOR.replace("385 Motor", "386 Motor2"))
    with raises_saying(ConfigurationError, "Motor, Motor2", "'message'"):
        decoder(tmp_path, SPEED, text)


def test_several_databases_are_searched(tmp_path: Path) -> None:
    (tmp_path / "a.dbc").write_text(dbc(MOTOR), encoding="utf-8")
    (tmp_path / "b.dbc").write_text(
        dbc('BO_ 642 Supply: 8 Drive\n SG_ Voltage : 0|16@1+ (0.1,0) [0|0] "V" Monitor'), encoding="utf-8"
    )
    wishes = {**SPEED, "U": ("V", {"signal": "Voltage"})}
    frame_decoder = decoder(tmp_path, wishes, dbc=["a.dbc", "b.dbc"])
    assert values(frame_decoder.decode(frame(642, bytes([100] + [0] * 7)), 0.0)) == {"U": pytest.approx(10.0)}
    assert values(frame_decoder.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}


@pytest.mark.parametrize(
    "after",
    [
        'CM_ SG_ 385 Speed "a comment that never ends;',
        'BA_ "GenMsgCycleTime" BO_ 385 ten;',
        'VAL_ 385 Speed 0 "Off" oops "On" ;',
        "SOMETHING_NEW_ 1 2 3;",
    ],
)
def test_broken_comments_and_attributes_are_tolerated(tmp_path: Path, after: str) -> None:
    frame_decoder = decoder(tmp_path, SPEED, dbc(MOTOR, after=after))
    assert values(frame_decoder.decode(frame(385, FULL), 0.0)) == {"omega": pytest.approx(10.0)}
    assert any(
        line.startswith("warning: drive.dbc: only its messages could be read") for line in frame_decoder.describe()
    )


@pytest.mark.parametrize(
    ("beside", "known"),
    [
        ('BA_ "Nope" SG_ 385 Speed 1;', True),
        ('CM_ "a comment with "quotes" in it";', True),
        ('VAL_ 385 Speed 0 "Off" oops "On" ;', False),
    ],
)
def test_a_fault_of_an_unused_line_leaves_values_that_are_no_readings(tmp_path: Path, beside: str, known: bool) -> None:
    values_of_message = 'VAL_ 385 Speed 65535 "SNA; not available" ;\nBA_DEF_ BO_ "GenMsgCycleTime" INT 0 65535;'
    after = f'{beside}\n{values_of_message}\nBA_ "GenMsgCycleTime" BO_ 385 20;'
    database = loaded(tmp_path / "drive.dbc", dbc(MOTOR, after=after).encode())
    (message,) = database.messages
    (speed,) = (signal for signal in message.signals if signal.name == "Speed")
    assert any("only its messages" in line for line in database.warnings())
    if known:
        assert dict(speed.conversion.choices or {}) == {65535: "SNA; not available"}
        assert message.cycle_time == 20
    else:
        assert any("Motor" in line and "no readings" in line for line in database.warnings())


OTHER = 'BO_ 641 Heat: 8 Drive\n SG_ Winding : 0|32@1+ (1,0) [0|0] "degC" Monitor'


@pytest.mark.parametrize(
    ("broken", "named", "is_float"),
    [
        ('VAL_ 385 Speed 65535 "SNA ;\nVAL_ 641 Winding 255 "SNA" ;', "Motor", False),
        ("SIG_VALTYPE_ 385 Speed : 1\nSIG_VALTYPE_ 641 Winding : 1;", "Motor", True),
        ('CM_ "never closed\nVAL_ 641 Winding 255 "SNA" ;', "only its messages", False),
    ],
)
def test_a_broken_statement_costs_no_other_message(tmp_path: Path, broken: str, named: str, is_float: bool) -> None:
    database = loaded(tmp_path / "drive.dbc", dbc(MOTOR, OTHER, after=broken))
    (heat,) = (message for message in database.messages if message.name == "Heat")
    conversion = heat.signals[0].conversion
    assert conversion.is_float is is_float
    assert is_float or dict(conversion.choices or {}) == {255: "SNA"}
    assert any(named in line for line in database.warnings()) or named in database.unread


@pytest.mark.parametrize(
    "end",
    [
        'VAL_ 641 Winding 255 "SNA"',
        "SIG_VALTYPE_ 641 Winding : 1",
        "BO_ 642 Cut: 8 Drive\n SG_ Q : 0|16@1+ (0.01,0) [-3",
    ],
)
def test_a_file_that_ends_within_a_statement_says_so(tmp_path: Path, end: str) -> None:
    database = loaded(tmp_path / "drive.dbc", dbc(MOTOR, OTHER).rstrip() + "\n" + end)
    assert any("ends within" in line for line in database.warnings())
    assert any(name in " ".join(database.warnings()) for name in ("Heat", "Cut"))
    assert {message.name for message in database.messages} >= {"Motor"}


def test_an_unreadable_message_does_not_affect_others(tmp_path: Path) -> None:
    text = dbc('BO_ 642 Sick: 8 Drive\n SG_ One : 0|zero@1+ (1,0) [0|0] "V" Monitor', MOTOR)
    frame_decoder = decoder(tmp_path, SPEED, text)
    assert any("message Sick cannot be read" in line for line in frame_decoder.describe())
    with pytest.raises(ConfigurationError, match="message 'Sick' cannot be read"):
        decoder(tmp_path, {"U": ("V", {"signal": "One", "message": "Sick"})}, text)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
def test_the_encoding_is_detected(tmp_path: Path, encoding: str) -> None:
    text = dbc('BO_ 642 Heat: 8 Drive\n SG_ Winding : 0|8@1+ (1,-40) [0|0] "°C" Monitor')
    database = loaded(tmp_path / "heat.dbc", text.encode(encoding))
    assert database.messages[0].signals[0].unit == "°C"
    assert database.warnings() == []


def test_bytes_of_no_known_encoding_are_a_warning(tmp_path: Path) -> None:
    text = dbc(MOTOR, after='CM_ "Gr\x81\xdf";').encode("latin-1")
    database = loaded(tmp_path / "odd.dbc", text)
    assert [message.name for message in database.messages] == ["Motor"]
    assert "neither UTF-8 nor Windows-1252" in database.warnings()[0]


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
def test_every_format_gives_the_same_signals(tmp_path: Path, suffix: str, text: str) -> None:
    wishes = {**SPEED, "i": ("A", {"signal": "Current"})}
    frame_decoder = decoder(tmp_path, wishes, text, suffix)
    assert values(frame_decoder.decode(frame(385, FULL), 0.0)) == {
        "omega": pytest.approx(10.0),
        "i": pytest.approx(2.0),
    }


def mutations(text: str) -> st.SearchStrategy[str]:
    """``text`` with some pieces cut out, doubled, moved or replaced."""
    pieces = st.tuples(
        st.integers(0, len(text)),
        st.integers(0, 40),
        st.sampled_from(["", "\n", '"', "9999999999", "-1", "|", "@", "<", "]]>", "SG_", "\x00", "é", "m0M", "[", "="]),
    )

    def apply(edits: list[tuple[int, int, str]]) -> str:
        mutated = text
        for place, length, instead in edits:
            mutated = mutated[:place] + instead + mutated[place + length :]
        return mutated

    return st.lists(pieces, min_size=1, max_size=6).map(apply)


@given(data=st.data(), kind=st.sampled_from([("dbc", DBC.read_text(encoding="utf-8")), ("kcd", KCD), ("sym", SYM)]))
def test_mutated_databases_are_read_or_refused_in_one_line(
    tmp_path: Path, data: st.DataObject, kind: tuple[str, str]
) -> None:
    suffix, text = kind
    mutated = data.draw(mutations(text))
    wish = "RotorSpeed" if suffix == "dbc" else "Speed"
    try:
        frame_decoder = decoder(tmp_path, {"omega": ("rad/s", {"signal": wish})}, mutated, suffix)
    except ConfigurationError as error:
        assert_refuses(error, "")
        assert "\n" not in str(error)  # noqa: PT017 - both outcomes are allowed
        return
    for identifier, extended in frame_decoder.identifiers():
        for content in (FULL, b"", bytes([255] * 8)):
            frame_decoder.decode(frame(identifier, content, extended=extended), 0.0)
