"""CANopen drives: objects by their data sheet, emergencies, heartbeats, and sheets with faults."""

import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.canbus.decoder import FrameDecoder
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.drivers.can_frames import dbc, decoder, frame, values
from tests.drivers.canbus.test_database import mutations
from tests.messages import assert_each_says, assert_refuses, raises_saying

SHEET = (EXAMPLES / "canopen-drive.eds").read_text(encoding="utf-8")
WISHES: dict[str, tuple[str, dict[str, Any]]] = {
    "i": ("A", {"node": 5, "object": "0x6078", "unit": "A", "scale": 0.001}),
    "x": ("m", {"node": 5, "object": "0x6064:00", "unit": "um"}),
    "v": ("m/s", {"node": 5, "object": "velocity actual value", "unit": "mm/s"}),
}


def drive(folder: Path, sheet: str = SHEET, wishes: Any = None, **options: Any) -> FrameDecoder:
    (folder / "drive.eds").write_text(sheet, encoding="utf-8")
    frame_decoder = decoder(folder, wishes or WISHES, eds="drive.eds", **options)
    frame_decoder.begin(0.0)
    return frame_decoder


def test_objects_are_decoded_as_the_sheet_maps_them(tmp_path: Path) -> None:
    frame_decoder = drive(tmp_path)
    assert values(frame_decoder.decode(frame(0x185, struct.pack("<Hh", 0x1637, -120)), 0.0)) == {
        "i": pytest.approx(-0.12)
    }
    assert values(frame_decoder.decode(frame(0x285, struct.pack("<ih", 150_000, 0)), 0.0)) == {"x": pytest.approx(0.15)}
    assert values(frame_decoder.decode(frame(0x385, struct.pack("<i", -2500)), 0.0)) == {"v": pytest.approx(-2.5)}
    assert frame_decoder.decode(frame(0x186, bytes(4)), 0.0) == []
    assert frame_decoder.counters.bad == 0
    assert any("node 5 Current actual value (0x6078:00), TPDO 1" in line for line in frame_decoder.describe())


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ({"object": "0x6062"}, "sends no object '0x6062'"),
        ({"object": "Velocty actual value"}, "did you mean 'Velocity actual value (0x606C:00)'?"),
        ({"object": "0x6079"}, "sends 0x6079 only in TPDO 4, which the sheet disables"),
        ({"object": "0x6078", "unit": None}, "has no unit: set 'unit' beside it"),
        ({"object": "0x6078", "unit": "V"}, "unit 'V' does not measure what 'A' does"),
    ],
)
def test_objects_that_the_drive_does_not_send_are_refused(
    tmp_path: Path, source: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        drive(tmp_path, wishes={"i": ("A", {"node": 5, "unit": "A", **source})})
    assert sentence in str(caught.value)
    assert caught.value.key == ("signals", "i")


def test_pdo_tables_take_precedence_over_the_sheet(tmp_path: Path) -> None:
    """With the types of the sheet, or without any sheet."""
    wishes = {"U": ("V", {"node": 5, "object": "0x6079", "unit": "mV"}), "i": WISHES["i"]}
    table = {"node": 5, "number": 4, "objects": ["0x6079", "0x2000"]}
    frame_decoder = drive(tmp_path, wishes=wishes, pdo=[table])
    assert values(frame_decoder.decode(frame(0x485, struct.pack("<If", 24_000, 0.0)), 0.0)) == {
        "U": pytest.approx(24.0)
    }
    table = {"node": 5, "number": 7, "id": "0x1F0", "objects": ["0x6079 u32", "0x6078:00 i16"]}
    alone = decoder(tmp_path, wishes, pdo=[table])
    decoded = values(alone.decode(frame(0x1F0, struct.pack("<Ih", 12_000, 5000)), 0.0))
    assert decoded == {"U": pytest.approx(12.0), "i": pytest.approx(5.0)}
    with pytest.raises(ConfigurationError, match="the type of 0x6079:00 is not known"):
        decoder(tmp_path, wishes, pdo=[{"node": 5, "number": 4, "objects": ["0x6079", "0x6078 i16"]}])


def test_unknown_mapped_objects_keep_their_place(tmp_path: Path) -> None:
    sheet = SHEET.replace("DefaultValue=0x60410010", "DefaultValue=0x2FFF0010")
    frame_decoder = drive(tmp_path, sheet, {"i": WISHES["i"]})
    assert values(frame_decoder.decode(frame(0x185, struct.pack("<hh", 99, -120)), 0.0)) == {"i": pytest.approx(-0.12)}


def test_drives_databases_and_bits_in_one_machine_file(tmp_path: Path) -> None:
    (tmp_path / "a.eds").write_text(SHEET, encoding="utf-8")
    (tmp_path / "b.eds").write_text(SHEET.replace("0x60780010", "0x60770010"), encoding="utf-8")
    wishes: dict[str, tuple[str, dict[str, Any]]] = {
        "i": WISHES["i"],
        "T": ("N*m", {"node": 6, "object": "0x6077", "unit": "mN*m"}),
        "U": ("V", {"signal": "Voltage"}),
        "raw": ("A", {"id": "0x185", "start": 0, "length": 8, "unit": "A"}),
    }
    text = dbc('BO_ 642 Supply: 8 Drive\n SG_ Voltage : 0|16@1+ (0.1,0) [0|0] "V" Monitor')
    frame_decoder = decoder(tmp_path, wishes, text, eds={"5": "a.eds", "0x06": "b.eds"})
    assert values(frame_decoder.decode(frame(0x186, struct.pack("<Hh", 0, 500)), 0.0)) == {"T": pytest.approx(0.5)}
    assert values(frame_decoder.decode(frame(642, bytes([10] + [0] * 7)), 0.0)) == {"U": pytest.approx(1.0)}
    got = values(frame_decoder.decode(frame(0x185, struct.pack("<Hh", 3, 2000)), 0.0))
    assert got == {"i": pytest.approx(2.0), "raw": 3.0}


def test_a_node_without_a_sheet_is_refused(tmp_path: Path) -> None:
    with raises_saying(ConfigurationError, "node 5", "eds", "[driver]"):
        decoder(tmp_path, WISHES)


def test_emergency_is_a_warning_until_it_is_reset(tmp_path: Path) -> None:
    frame_decoder = drive(tmp_path, wishes={"i": WISHES["i"]})
    assert (0x85, False) in frame_decoder.identifiers()
    frame_decoder.decode(frame(0x185, bytes(4)), 0.9)
    frame_decoder.decode(frame(0x85, struct.pack("<HB5x", 0x2310, 1)), 0.5)
    assert_each_says(frame_decoder.warnings(1.0), ("drive 5", "0x2310", "current at the output", "0.5 s"))
    frame_decoder.decode(frame(0x85, bytes(8)), 1.5)
    assert frame_decoder.warnings(1.6) == []


def test_heartbeats_give_state_and_silence_warnings(tmp_path: Path) -> None:
    frame_decoder = drive(tmp_path, wishes={"i": WISHES["i"]})
    frame_decoder.decode(frame(0x185, bytes(4)), 0.9)
    frame_decoder.decode(frame(0x705, b"\x7f"), 1.0)
    assert_each_says(frame_decoder.warnings(1.1), ("drive 5", "pre-operational", "process data"))
    for place in range(10):
        frame_decoder.decode(frame(0x705, b"\x05"), 2.0 + place)
    assert all("operational" not in line for line in frame_decoder.warnings(12.0))
    assert any("no heartbeat of drive 5 for 19.0 s" in line for line in frame_decoder.warnings(30.0))


@pytest.mark.parametrize(
    ("change", "warned"),
    [
        (("ParameterName=Statusword\n", ""), False),
        (("DataType=0x0006\nAccessType=ro", "DataType=none\nAccessType=ro"), True),
        (("[6041]", "[6041]\nParameterName=twice\nParameterName=twice\n\n[6041]"), False),
        (("Lines=", "Lines=999999999999"), False),
        (("DefaultValue=$NODEID+0x280", "DefaultValue=what"), True),
        (("[DeviceInfo]", "[Comments]\nLines=99999999999\n\n[DeviceInfo]"), False),
    ],
)
def test_faults_elsewhere_in_a_sheet_are_tolerated(tmp_path: Path, change: tuple[str, str], warned: bool) -> None:
    frame_decoder = drive(tmp_path, SHEET.replace(*change), {"i": WISHES["i"]})
    assert values(frame_decoder.decode(frame(0x185, struct.pack("<Hh", 0, 7)), 0.0)) == {"i": pytest.approx(0.007)}
    assert any(line.startswith("warning") for line in frame_decoder.describe()) is warned


@pytest.mark.parametrize("content", ["", "not an EDS", "[6041]\n", "\x00\xff"])
def test_files_that_are_no_sheet_are_refused_in_one_line(tmp_path: Path, content: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        drive(tmp_path, content)
    assert "\n" not in str(caught.value)


@given(data=st.data())
def test_mutated_sheets_are_read_or_refused_in_one_line(tmp_path: Path, data: st.DataObject) -> None:
    try:
        frame_decoder = drive(tmp_path, data.draw(mutations(SHEET)))
    except ConfigurationError as error:
        assert_refuses(error, "")
        assert "\n" not in str(error)  # noqa: PT017 - both outcomes are allowed
        return
    for identifier, extended in frame_decoder.identifiers():
        for content in (b"", bytes(8), bytes([255] * 8)):
            frame_decoder.decode(frame(identifier, content, extended=extended), 0.0)
    assert all("\n" not in line for line in frame_decoder.warnings(1.0))
