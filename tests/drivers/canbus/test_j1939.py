"""SAE J1939: any source address, one source at a time, and numbers that are no readings."""

import math
from pathlib import Path

import can
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.canbus.decoder import FrameDecoder, decoder_of
from otolith_drivers.canbus.driver import Options, Source
from otolith_drivers.canbus.j1939 import group_of
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.can_log import open_log
from tests.drivers.canbus.test_j1939_transport import transfer_frames
from tests.messages import assert_each_says, assert_says, raises_saying

ENGINE, TORQUE, LONG, FIXED, LONG_OF_ONE = 0x0CF004FE, 0x18EF00FE, 0x18FECAFE, 0x0CF00401, 0x18FECB21
DATABASE = f"""VERSION ""

NS_ :

BS_:

BU_: Engine

BO_ {ENGINE | 1 << 31} EEC1: 8 Engine
 SG_ EngineSpeed : 24|16@1+ (0.125,0) [0|8031.875] "rpm" Engine
 SG_ State : 0|2@1+ (1,0) [0|3] "1" Engine
 SG_ Load : 8|8@1+ (1,-125) [-125|125] "%" Engine

BO_ {TORQUE | 1 << 31} Proprietary: 8 Engine
 SG_ Position : 0|32@1+ (1,0) [0|0] "mm" Engine

BO_ {LONG | 1 << 31} Faults: 20 Engine
 SG_ Lamp : 0|8@1+ (1,0) [0|0] "1" Engine

BO_ {LONG_OF_ONE | 1 << 31} Torques: 12 Engine
 SG_ Torque : 0|8@1+ (1,0) [0|0] "1" Engine

BO_ {FIXED | 1 << 31} Exact: 8 Engine
 SG_ Other : 0|8@1+ (1,0) [0|0] "1" Engine
"""
SIGNALS = {"n": ("rpm", "EngineSpeed"), "state": ("1", "State"), "load": ("%", "Load"), "x": ("mm", "Position")}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "j.dbc").write_text(DATABASE, encoding="utf-8")
    return tmp_path


def decoder(folder: Path, names: tuple[str, ...] = tuple(SIGNALS), **keys: object) -> FrameDecoder:
    signals = tuple(Signal(name, SIGNALS[name][0], Source(signal=SIGNALS[name][1])) for name in names)
    options = Options.model_validate({"dbc": "j.dbc"} | keys)
    return decoder_of(options, Setup(signals, folder, 0.01))


def engine(speed: int, *, state: int = 1, load: int = 125) -> bytes:
    return bytes([0xFC | state, load, 0xFF, *speed.to_bytes(2, "little"), 0xFF, 0xFF, 0xFF])


def sent(decode: FrameDecoder, identifier: int, data: bytes, time: float = 0.0) -> dict[str, float]:
    frame = can.Message(arbitration_id=identifier, data=data, is_extended_id=True)
    samples: list[Sample] = decode.decode(frame, time)
    return {sample.signal: sample.value for sample in samples}


@pytest.mark.parametrize("identifier", [0x0CF00400, 0x18F00417, 0x0CF004FE, 0x00F00480])
def test_a_message_is_read_from_any_source_with_any_priority(folder: Path, identifier: int) -> None:
    assert sent(decoder(folder), identifier, engine(8000))["n"] == 1000.0


@pytest.mark.parametrize("identifier", [0x18EF0203, 0x0CEFFF03, 0x18EF00FE])
def test_the_destination_is_no_part_of_a_group_of_pdu1(folder: Path, identifier: int) -> None:
    assert sent(decoder(folder), identifier, (77).to_bytes(8, "little"))["x"] == 77.0


@pytest.mark.parametrize("identifier", [0x0CF00500, 0x0DF00400, 0x0CFF0400])
def test_another_group_is_not_read(folder: Path, identifier: int) -> None:
    assert sent(decoder(folder), identifier, engine(8000)) == {}


@pytest.mark.parametrize("is_marked", [False, True])
def test_a_message_that_only_another_address_sends_is_named_with_it(folder: Path, *, is_marked: bool) -> None:
    """Whether the machine file declares the address or the database; a message that comes has no such line."""
    declared = decoder(folder, ("n",), source_address="0x03")
    kinds = 'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
    mark = f'{kinds}BA_ "VFrameFormat" BO_ {FIXED | 1 << 31} 3;\n'
    (folder / "j.dbc").write_text(DATABASE + mark * is_marked, encoding="utf-8")
    signals = (Signal("n", "1", Source(signal="Other")),)
    exact = decoder_of(Options.model_validate({"dbc": "j.dbc"}), Setup(signals, folder, 0.01))
    for decode, own in ((declared, 0x03), (exact, 0x01)):
        decode.begin(0.0)
        for source in (0x17, 0x21):
            assert sent(decode, 0x0CF00400 | source, engine(8000)) == {}
        (line,) = decode.warnings(60.0)
        assert_says(line, "has not come once", "PGN 61444", "0x17, 0x21", f"0x{own:02X}", "source_address")
        assert sent(decode, 0x0CF00400 | own, engine(8000), 60.0)
        assert not [line for line in decode.warnings(60.1) if "0x17" in line]
    passes = [0x0CF00417 & mask == number & mask for number, mask, _ in exact.filters()]
    assert any(passes) == is_marked, "an identifier that may be no J1939 is received alone"


def test_a_log_of_another_address_says_which(folder: Path) -> None:
    signals = (Signal("n", "1", Source(signal="Other")),)
    (folder / "a.log").write_text(
        "".join(f"({t}.0) can0 0CF00417#FFFFFFFFFFFFFFFF\n" for t in range(9)), encoding="utf-8"
    )
    options, setup = Options.model_validate({"dbc": "j.dbc"}), Setup(signals, folder, 0.01)
    with open_log(folder / "a.log", setup, options) as log, raises_saying(ConfigurationError, "PGN 61444", "0x17"):
        list(log.chunks())


def test_a_standard_frame_with_the_same_low_bits_is_not_read(folder: Path) -> None:
    decode = decoder(folder)
    assert decode.decode(can.Message(arbitration_id=0x4FE, data=engine(8000), is_extended_id=False), 0.0) == []


def test_a_second_source_is_ignored_and_named(folder: Path) -> None:
    decode = decoder(folder)
    assert sent(decode, 0x0CF00400, engine(8000))
    assert sent(decode, 0x0CF00403, engine(80)) == {}
    (line,) = [line for line in decode.warnings(0.1) if "source_address" in line]
    assert "EEC1 (PGN 61444) comes from the addresses 0x00, which is used, and 0x03" in line


def test_the_source_address_of_the_machine_file_is_read_alone(folder: Path) -> None:
    decode = decoder(folder, source_address="0x03")
    assert sent(decode, 0x0CF00400, engine(8000)) == {}
    assert sent(decode, 0x0CF00403, engine(80))["n"] == 10.0
    assert not [line for line in decode.warnings(0.1) if "source_address" in line]


@pytest.mark.parametrize(
    ("data", "missing", "why"),
    [
        (engine(0xFFFF), {"n"}, "n is not available (raw number 0xFFFF)"),
        (engine(0xFE12), {"n"}, "n reports an error"),
        (engine(0xFB00), {"n"}, "n is a reserved number"),
        (engine(0xFAFF, state=3), {"state"}, "state is not available"),
        (engine(0xFAFF, state=2), {"state"}, "state reports an error"),
        (engine(8000, load=0xFF), {"load"}, "load is not available"),
        (engine(8000, load=0xFA), set(), ""),
    ],
)
def test_numbers_that_are_no_readings_are_missing_and_counted(
    folder: Path, data: bytes, missing: set[str], why: str
) -> None:
    decode = decoder(folder)
    values = sent(decode, 0x0CF00400, data)
    assert {name for name, value in values.items() if math.isnan(value)} == missing
    assert decode.counters.bad == len(missing)
    assert any(why in line for line in ["", *decode.warnings(0.1)])


def test_the_filters_of_the_kernel_pass_all_sources_of_a_group_and_nothing_else(folder: Path) -> None:
    def passed(decode: FrameDecoder, identifier: int) -> bool:
        return any(identifier & mask == number & mask for number, mask, extended in decode.filters() if extended)

    either = decoder(folder)
    for identifier, wanted in ((0x18F00417, True), (0x0CF00400, True), (0x0CF00517, False), (0x18EF4403, True)):
        assert passed(either, identifier) == either.wants(identifier, extended=True) == wanted
    one = decoder(folder, ("n",), source_address=3)
    assert passed(one, 0x18F00403)
    assert passed(one, 0x18F00404), "a source that is not declared is named"
    assert not passed(one, 0x18F00503)


def faults_decoder(folder: Path, **keys: object) -> FrameDecoder:
    options = Options.model_validate({"dbc": "j.dbc"} | keys)
    return decoder_of(options, Setup((Signal("lamp", "1", Source(signal="Lamp")),), folder, 0.01))


def broadcast(source: int, data: bytes, identifier: int = LONG) -> list[tuple[int, bytes]]:
    """The frames of a message of several frames to all nodes."""
    frames = transfer_frames(group_of(identifier), data)
    return [(group << 8 | 0x1C00FF00 | source, content) for group, content in frames]


def test_a_message_of_several_frames_has_the_time_of_its_announcement(folder: Path) -> None:
    decode = faults_decoder(folder)
    frames = broadcast(0x21, bytes([7, *range(19)]))
    samples = [sample for index, (identifier, data) in enumerate(frames) for sample in decode.decode(
        can.Message(arbitration_id=identifier, data=data, is_extended_id=True), 10.0 + 0.05 * index)]  # fmt: skip
    assert samples == [Sample("lamp", 10.0, 7.0)]
    assert decode.latency == pytest.approx(0.15)
    assert decode.counters.bad == 0
    for identifier, _ in frames:
        assert decode.wants(identifier, extended=True)
        assert any(identifier & mask == number & mask for number, mask, _ in decode.filters())


def test_of_messages_of_several_frames_one_source_is_read(folder: Path) -> None:
    decode = faults_decoder(folder, source_address="0x03")
    frames = [frame for source in (0x02, 0x03) for frame in broadcast(source, bytes([source, *range(19)]))]
    assert [value for identifier, data in frames for value in sent(decode, identifier, data).values()] == [3.0]


def test_a_long_message_of_which_the_database_names_the_source_is_read_from_there(folder: Path) -> None:
    signal = Signal("torque", "1", Source(signal="Torque"))
    decode = decoder_of(Options(dbc=Path("j.dbc")), Setup((signal,), folder, 0.01))
    frames = [frame for source in (0x03, 0x21) for frame in broadcast(source, bytes([source] * 12), LONG_OF_ONE)]
    assert [value for identifier, data in frames for value in sent(decode, identifier, data).values()] == [0x21]


def test_an_incomplete_message_is_counted_and_named(folder: Path) -> None:
    decode = faults_decoder(folder)
    frames = broadcast(0x21, bytes(20))
    del frames[2]
    assert not any(sent(decode, identifier, data, 1.0) for identifier, data in frames)
    assert decode.counters.bad == 1
    assert "a message of several frames is incomplete; 1 in all, the last 0.5 s ago" in decode.warnings(1.5)
    assert not any("incomplete" in line for line in decode.warnings(12.0))


def test_other_identifiers_and_databases_that_are_not_of_j1939_stay_exact(folder: Path) -> None:
    signal = Signal("other", "1", Source(signal="Other"))
    decode = decoder_of(Options(dbc=Path("j.dbc")), Setup((signal,), folder, 0.01))
    assert sent(decode, 0x0CF00402, bytes(8)) == {}
    assert sent(decode, FIXED, b"\xff" * 8) == {"other": 255.0}
    plain = decoder(folder, j1939=False)
    assert sent(plain, 0x0CF00400, engine(8000)) == {}
    assert sent(plain, ENGINE, engine(8000, state=3))["state"] == 3.0


def test_a_message_that_the_database_marks_as_j1939_has_no_reserved_readings(tmp_path: Path) -> None:
    marked = """BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";
BA_DEF_DEF_ "VFrameFormat" "J1939PG";
"""
    (tmp_path / "j.dbc").write_text(DATABASE + marked, encoding="utf-8")
    signal = Signal("other", "1", Source(signal="Other"))
    decode = decoder_of(Options(dbc=Path("j.dbc")), Setup((signal,), tmp_path, 0.01))
    assert sent(decode, 0x0CF00402, bytes(8)) == {}
    assert sent(decode, FIXED, bytes([250, *bytes(7)])) == {"other": 250.0}
    assert math.isnan(sent(decode, FIXED, b"\xff" * 8)["other"])
    plain = decoder_of(Options(dbc=Path("j.dbc"), j1939=False), Setup((signal,), tmp_path, 0.01))
    assert sent(plain, FIXED, b"\xff" * 8) == {"other": 255.0}


def test_a_source_address_without_a_message_from_any_source_is_a_warning(folder: Path) -> None:
    signal = Signal("other", "1", Source(signal="Other"))
    decode = decoder_of(Options(dbc=Path("j.dbc"), source_address=3), Setup((signal,), folder, 0.01))
    assert_each_says(decode.configuration_warnings, ("source_address", "0xFE"))
    assert decoder(folder, source_address=3).configuration_warnings == ()


def test_group_numbers_are_those_of_the_standard() -> None:
    assert [group_of(identifier) for identifier in (0x0CF00400, 0x18FEEE00, 0x18EA2301)] == [61444, 65262, 59904]
