"""What 'otolith check' says of files as programs export them: the time base, the values, or the question that is asked.

The files are small, of the kinds that PLCs, scopes and loggers write; each right value follows from its description.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.cli.test_several_files import TWIN
from tests.messages import assert_says, raises_saying

DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 100 M: 8 A
 SG_ U : 0|16@1+ (0.1,0) [0|0] "V" A
 SG_ Y : 16|16@1- (1,0) [0|0] "rpm" A
"""
COLUMNS = 'u = { column = "Valve", unit = "1" }\ny = { column = "Speed", unit = "1" }'
MACHINE = """[machine]
name = "x"
[driver]
{driver}
[signals]
{signals}
[twin]
file = "twin.toml"
[window]
length = "0.5 s"
sample_period = "10 ms"
"""


def machine(folder: Path, name: str, signals: str = COLUMNS, driver: str = "") -> Path:
    (folder / "twin.toml").write_text(TWIN, encoding="utf-8")
    path = folder / "machine.toml"
    options = driver or f'type = "replay"\nfile = "{name}"'
    path.write_text(MACHINE.format(driver=options, signals=signals), encoding="utf-8")
    return path


def checked(file: Path, data: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(otolith("check", file, data, "--json").stdout)
    return document


def table(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def can_machine(folder: Path, dbc: str = DBC) -> Path:
    (folder / "d.dbc").write_text(dbc, encoding="utf-8")
    signals = 'u = { signal = "U", unit = "1" }\ny = { signal = "Y", unit = "1" }'
    return machine(folder, "", signals, 'type = "can"\ndbc = "d.dbc"')


def frame(index: int, u: int, length: int = 8) -> str:
    return (u.to_bytes(2, "little") + index.to_bytes(2, "little") + bytes(4))[:length].hex().upper()


def test_wincc_lasts_as_long_as_its_dates_say(tmp_path: Path) -> None:
    rows = ['"VarName";"TimeString";"VarValue";"Validity";"Time_ms"']
    for index in range(60):
        clock = f'"17.03.2026 10:00:{index:02d}"'
        days = f"{46_098_416_666.6667 + index * 1e6 / 86_400:.4f}".replace(".", ",")
        rows += [f'"Valve";{clock};{index % 7};1;{days}', f'"Speed";{clock};{index},5;1;{days}']
    document = checked(machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(rows) + "\n"))
    assert document["end"] - document["start"] == pytest.approx(59.0, abs=1e-3)
    assert document["signals"]["y"]["samples"] == 60


def test_scope_channels_have_times_of_their_own(tmp_path: Path) -> None:
    """Two ramps of 1 per ms, every 0.2 and every 1 ms: at 0.6 s the slow one is 600."""
    rows = ["Name\tscope", "Starttime of export\t134192592000000000\tSunday", "", "Name\tValve\tName\tSpeed",
            "SampleTime[ms]\t0.2\tSampleTime[ms]\t1", ""]  # fmt: skip
    rows += [f"{i / 5:g}\t{i / 5:g}\t" + (f"{i}\t{i}" if i < 601 else "\t") for i in range(3001)]
    document = checked(machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(rows) + "\n"))
    assert document["end"] - document["start"] == pytest.approx(0.6, abs=1e-6)
    intervals = {name: signal["interval_s"] for name, signal in document["signals"].items()}
    assert intervals == {"u": pytest.approx(2e-4, rel=0.01), "y": pytest.approx(1e-3, rel=0.01)}


def test_two_columns_of_times_are_asked_about(tmp_path: Path) -> None:
    rows = ["Name,Valve,Name,Speed", *(f"{i / 5},{i},{i},{i}" for i in range(20))]
    with raises_saying(ConfigurationError, "table.csv:1", "'Name'", 'time = "'):
        otolith("check", machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(rows) + "\n"))


def test_a_value_per_row_and_a_block_per_variable_are_read(tmp_path: Path) -> None:
    long = ["VarName;TimeString;VarValue"]
    trace = ["[key]; [value]", "0.Variable; Valve", "0.Data; ", *(f"; {20 * i + 2}; 24.{i % 10}" for i in range(50))]
    trace += ["1.Variable; Speed", "1.Data; ", *(f"; {20 * i + 2}; {100 + i}" for i in range(50))]
    for index in range(50):
        long += [f"{name};2026-03-17 10:00:{index:02d};{100 + index}" for name in ("Valve", "Speed")]
    for lines, span in ((long, 49.0), (trace, 0.98)):
        document = checked(machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(lines) + "\n"))
        assert document["end"] - document["start"] == pytest.approx(span)
        assert [signal["samples"] for signal in document["signals"].values()] == [50, 50]


@pytest.mark.parametrize("attribute", ["", 'BA_ "Nope" SG_ 100 U 1;\n'])
def test_values_that_are_no_readings_are_none_whatever_else_is_wrong(tmp_path: Path, attribute: str) -> None:
    dbc = f'{DBC}{attribute}VAL_ 100 U 65535 "SNA" ;\n'
    rows = [f"({1000 + i / 100:.6f}) can0 064#{frame(i, 0xFFFF if i % 3 == 0 else 240)}" for i in range(60)]
    document = checked(can_machine(tmp_path, dbc), table(tmp_path, "\n".join(rows) + "\n", "bus.log"))
    assert document["signals"]["u"]["samples"] == 40
    assert_says(" ".join(document["remarks"]), "6553.5", "SNA", "65535")


def test_signals_within_frames_shorter_than_the_database_says_are_read(tmp_path: Path) -> None:
    rows = [f"({1000 + i / 100:.6f}) can0 064#{frame(i, 240, 5)}" for i in range(60)]
    document = checked(can_machine(tmp_path), table(tmp_path, "\n".join(rows) + "\n", "bus.log"))
    assert [signal["samples"] for signal in document["signals"].values()] == [60, 60]


def test_differences_of_times_are_refused(tmp_path: Path) -> None:
    rows = [f"(000.{(10_200, 9_800)[i % 2] * bool(i):06d}) can0 064#{frame(i, 240)}" for i in range(60)]
    with raises_saying(ConfigurationError, "bus.log", "differences", "candump -L"):
        otolith("check", can_machine(tmp_path), table(tmp_path, "\n".join(rows) + "\n", "bus.log"))


@pytest.mark.parametrize("above", ["", "internal events logged\n", "Begin Triggerblock Tue Mar 17 10:00:00 am 2026\n"])
def test_the_first_frame_of_an_asc_log_counts_whatever_stands_above_it(tmp_path: Path, above: str) -> None:
    rows = ["date Tue Mar 17 10:00:00.000 am 2026", "base hex  timestamps absolute"]
    frames = [f"   {i / 100:.6f} 1  64             Rx   d 8 F0 00 {i:02X} 00 00 00 00 00" for i in range(60)]
    text = "\n".join(rows) + "\n" + above + "\n".join(frames) + "\n"
    document = checked(can_machine(tmp_path), table(tmp_path, text, "bus.asc"))
    assert (document["rows"], document["start"]) == (60, pytest.approx(0.0))


OTHER_TOOLS = {
    "spy.csv": "Spy Setup File,x\n\nLine,Abs Time(Sec),Rel Time (Sec),Er,Tx,Description,Arb ID,Xtd,B1,B2\n"
    "1,2550.368,0.01,F,F,HS CAN $64,064,F,F0,00\n",
    "memorator.txt": "   Kvaser Memorator Log\n   ====\n\n   Time Chan   Identifier Flags   DLC  Data   Counter\n"
    "    0.000000  1          64              2  F0 00  1\n",
    "canhacker.trc": "Time   ID     DLC Data                    Comment\n00.000 00000064 2 F0 00\n",
}


@pytest.mark.parametrize("name", OTHER_TOOLS)
def test_logs_of_other_tools_are_refused_with_the_setting_that_helps(tmp_path: Path, name: str) -> None:
    with raises_saying(ConfigurationError, name, "another tool", "candump -L"):
        otolith("check", can_machine(tmp_path), table(tmp_path, OTHER_TOOLS[name], name))


@pytest.mark.parametrize("before", [3, 6000])
def test_a_block_of_zero_bytes_is_one_bad_row(tmp_path: Path, before: int) -> None:
    rows = ["t;Valve;Speed", *(f"{i / 100:.2f};24.5;{i}" for i in range(before))]
    rows += ["\0" * 4096, *(f"{i / 100:.2f};24.5;{i}" for i in range(before, before + 1000))]
    document = checked(machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(rows) + "\n"))
    assert document["rows"] == before + 1000
    remark = next(text for text in document["remarks"] if "bad rows: 1" in text)
    assert len(remark) < 300


def test_days_are_asked_about_and_seconds_of_a_savvycan_table_are_read(tmp_path: Path) -> None:
    days = ["Time;Valve;Speed", *(f"{45203.7157523148 + i * 0.01 / 86_400:.10f};24;{i}" for i in range(60))]
    with raises_saying(ConfigurationError, "table.csv", "10 ms if they are days", "'t [d]'"):
        otolith("check", machine(tmp_path, "table.csv"), table(tmp_path, "\n".join(days) + "\n"))
    rows = ["Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"]
    for index in range(60):
        data = ",".join(f"{byte:02X}" for byte in bytes.fromhex(frame(index, 240)))
        rows.append(f"{index / 100:.6f},00000064,false,Rx,0,8,{data},")
    document = checked(can_machine(tmp_path), table(tmp_path, "\n".join(rows) + "\n"))
    assert document["end"] - document["start"] == pytest.approx(0.59)


def test_a_table_says_what_its_time_is_in_the_machine_file(tmp_path: Path) -> None:
    rows = ["Day,Clock,Valve,Speed", *(f"03/17/2026,10:00:{i / 50:06.3f},{i % 5},{i}" for i in range(101))]
    keys = 'time = { column = "Clock", date = "Day", format = "%m/%d/%Y %H:%M:%S" }'
    driver = f'type = "replay"\nfile = "table.csv"\ntable = {{ {keys} }}'
    data = table(tmp_path, "\n".join(rows) + "\n")
    document = checked(machine(tmp_path, "table.csv", driver=driver), data)
    assert document["end"] - document["start"] == pytest.approx(2.0)
    wrong = driver.replace("format", "fromat")
    with raises_saying(ConfigurationError, "machine.toml", "table", "fromat"):
        otolith("check", machine(tmp_path, "table.csv", driver=wrong), data)
