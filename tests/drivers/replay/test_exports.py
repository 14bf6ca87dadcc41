"""Named formats of tables, written by hand after their public descriptions, with the values that they mean."""

from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import pytest

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import open_log
from tests.drivers.replay.readings import samples
from tests.messages import assert_says, raises_saying

BERLIN = ZoneInfo("Europe/Berlin")
NOON = datetime(2026, 3, 29, 12, tzinfo=UTC).timestamp()
NOON_IN_BERLIN = datetime(2026, 3, 29, 12, tzinfo=BERLIN).timestamp()


def written(folder: Path, text: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def described(path: Path, column: str, unit: str = "1") -> str:
    signal = Signal(name="x", unit=unit, source=TableSource(column=column))
    with open_log(path, Setup((signal,), path.parent, 0.01)) as reader:
        return " ".join(reader.describe())


# 29 March 2026, 12:00:00, is day 46110.5 of a spreadsheet; a second is 11.5741 millionths of a day.
WINCC = """"VarName";"TimeString";"VarValue";"Validity";"Time_ms"
"$RT_OFF$";"29.03.2026 11:59:00";0;2;46110499305,5556
"Speed";"29.03.2026 12:00:00";100,5;1;46110500000,0000
"Torque";"29.03.2026 12:00:00";7;1;46110500000,0000
"Speed";"29.03.2026 12:00:01";101,5;1;46110500011,5741
"Torque";"29.03.2026 12:00:01";0;0;46110500011,5741
"""


def test_a_tag_log_of_wincc_counts_days_times_a_million(tmp_path: Path) -> None:
    path = written(tmp_path, WINCC)
    found = samples(path, zone="Europe/Berlin", speed={"column": "Speed"}, Torque={})
    assert [value for _, value in found["speed"]] == [100.5, 101.5]
    assert [time for time, _ in found["speed"]] == pytest.approx([NOON_IN_BERLIN, NOON_IN_BERLIN + 1.0], abs=1e-4)
    assert [value for _, value in found["Torque"]] == [7.0]  # the other one is not valid
    assert_says(described(path, "Speed"), "WinCC", "VarName", "'Speed'")
    assert samples(path, x={"column": "Speed", "time": "TimeString"})["x"] == [(NOON, 100.5), (NOON + 1.0, 101.5)]


def test_a_tag_log_of_one_variable_is_read_by_its_columns(tmp_path: Path) -> None:
    lines = [line for line in WINCC.splitlines(keepends=True) if "Torque" not in line]
    found = samples(written(tmp_path, "".join(lines)), x={"column": "VarValue"}, v={"column": "Validity"})
    assert [value for _, value in found["x"]] == [100.5, 101.5]
    assert found["x"][1][0] - found["x"][0][0] == pytest.approx(1.0, abs=1e-4)
    with raises_saying(ConfigurationError, "several variables", "Speed", "Torque"):
        samples(written(tmp_path, WINCC), x={"column": "VarValue"})


def test_a_data_log_of_s7_has_the_month_first_and_utc(tmp_path: Path) -> None:
    rows = "1,03/29/2026,12:00:00,100.5,1\n2,03/29/2026,12:00:00.500,101.5,1\n//END\n"
    path = written(tmp_path, f"Record,Date,UTC Time,Speed,Torque\n{rows}")
    found = samples(path, zone="Europe/Berlin", Speed={})
    assert found["Speed"] == [(NOON, 100.5), (NOON + 0.5, 101.5)]
    assert_says(described(path, "Speed"), "S7")


INFLUX = """#group,false,false,true,true,false,false,true,true
#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string
#default,_result,,,,,,,
,result,table,_start,_stop,_time,_value,_field,_measurement
,,0,2026-03-29T00:00:00Z,2026-03-30T00:00:00Z,2026-03-29T12:00:00Z,1.5,speed,drive
,,0,2026-03-29T00:00:00Z,2026-03-30T00:00:00Z,2026-03-29T12:00:00.25Z,2.5,speed,drive
,,1,2026-03-29T00:00:00Z,2026-03-30T00:00:00Z,2026-03-29T12:00:00Z,7,torque,drive
"""


def test_an_annotated_export_of_influxdb_has_a_block_per_series(tmp_path: Path) -> None:
    found = samples(written(tmp_path, INFLUX), speed={}, m={"column": "torque"})
    assert (found["speed"], found["m"]) == ([(NOON, 1.5), (NOON + 0.25, 2.5)], [(NOON, 7.0)])
    with raises_saying(ConfigurationError, "'speed'", "several series", "filter"):
        samples(written(tmp_path, INFLUX.replace("7,torque", "7,speed")), speed={})


def test_a_history_of_home_assistant_has_states(tmp_path: Path) -> None:
    rows = [
        "entity_id,state,last_changed",
        "sensor.power,12.5,2026-03-29T12:00:00.000Z",
        "switch.pump,unavailable,2026-03-29T12:00:00.000Z",
        "sensor.power,unknown,2026-03-29T12:00:01.000Z",
        "sensor.power,13.5,2026-03-29T12:00:02.500Z",
    ]
    found = samples(written(tmp_path, "\n".join(rows) + "\n"), p={"column": "sensor.power"})
    assert found["p"] == [(NOON, 12.5), (NOON + 2.5, 13.5)]


CODESYS = """[key]; [value]
Version; 0x03050000
Name; Application.Trace
IecTaskName; MainTask
0.Variable; GVL.rSpeed
0.Color; 4278190335
0.Data;
; 2; 24.0
; 22; 24.1
; 42; 24.2
1.Variable; GVL.xRun
1.Data;
; 4; FALSE
; 24; TRUE
"""


def test_a_trace_of_codesys_has_a_block_per_variable(tmp_path: Path) -> None:
    path = written(tmp_path, CODESYS)
    found = samples(path, n={"column": "GVL.rSpeed", "unit": "rpm", "of": "turn/s"}, run={"column": "GVL.xRun"})
    assert [time for time, _ in found["n"]] == pytest.approx([0.002, 0.022, 0.042])
    assert [60.0 * value for _, value in found["n"]] == pytest.approx([24.0, 24.1, 24.2])
    assert [value for _, value in found["run"]] == [0.0, 1.0]
    assert [time for time, _ in found["run"]] == pytest.approx([0.004, 0.024])
    assert_says(described(path, "GVL.rSpeed"), "CODESYS", "ms")
    with raises_saying(ConfigurationError, "table.csv", "'GVL.rSped'", "'GVL.rSpeed'"):
        samples(path, n={"column": "GVL.rSped"})


def test_a_line_in_a_trace_that_is_no_row_is_counted_with_its_place(tmp_path: Path) -> None:
    path = written(tmp_path, CODESYS.replace("; 22; 24.1", "; 22; #NaN"))
    signal = Signal(name="n", unit="1", source=TableSource(column="GVL.rSpeed"))
    with open_log(path, Setup((signal,), tmp_path, 0.01)) as reader:
        assert sum(len(rows.times) for rows in reader.chunks()) == 3
        assert_says(reader.warnings()[0], "line 9", "#NaN")


START = 134_192_592_000_000_000  # 100 ns from 1601 to 29 March 2026, 12:00 UTC
SCOPE = [
    ["Name", "my scope"],
    ["File", "C:\\scope.csv"],
    ["Starttime of export", f"{START}", "Sunday, March 29, 2026", "14:00:00.000"],
    ["Endtime of export", f"{START + 20_000}", "Sunday, March 29, 2026", "14:00:00.002"],
    [],
    ["Name", "speed", "torque", "Name", "bearing [1]"],
    ["SymbolComment", "", "", "SymbolComment", ""],
    ["Data-Type", "REAL64", "REAL64", "Data-Type", "REAL32"],
    ["SampleTime[ms]", "0,5", "0,5", "SampleTime[ms]", "2"],
    ["Unit", "rpm", "Nm (Torque)", "Unit", "(None)"],
    ["Unit ScaleFactor", "1", "1", "Unit ScaleFactor", "1"],
    [],
    ["0", "60", "1,5", "1", "-4"],
    ["0,5", "120", "2,5", "3", "-5"],
    ["1", "180", "3,5"],
    ["EOF"],
]


@pytest.mark.parametrize("separator", ["\t", ";"])
def test_twincat_scope_has_times_for_each_group_of_channels(tmp_path: Path, separator: str) -> None:
    path = written(tmp_path, "\n".join(separator.join(cells) for cells in SCOPE) + "\n")
    found = samples(
        path, n={"column": "speed", "of": "turn/s"}, M={"column": "torque", "of": "N*m"}, b={"column": "bearing [1]"}
    )
    for name, times, values in (
        ("n", [0.0, 0.0005, 0.001], [1.0, 2.0, 3.0]),
        ("M", [0.0, 0.0005, 0.001], [1.5, 2.5, 3.5]),
        ("b", [0.001, 0.003], [-4.0, -5.0]),
    ):
        assert [time - NOON for time, _ in found[name]] == pytest.approx(times, abs=1e-6), name
        assert [value for _, value in found[name]] == pytest.approx(values), name
    assert_says(described(path, "speed", "rpm"), "TwinCAT Scope")


def test_full_times_of_twincat_scope_count_from_1601(tmp_path: Path) -> None:
    cells = [list(row) for row in SCOPE]
    for row, offset in zip(cells[-4:-1], (0, 5_000, 10_000), strict=True):
        row[0] = f"{START + offset}"
    path = written(tmp_path, "\n".join("\t".join(row) for row in cells) + "\n")
    times = [time - NOON for time, _ in samples(path, n={"column": "speed", "of": "rpm"})["n"]]
    assert times == pytest.approx([0.0, 0.0005, 0.001], abs=3e-6)


def test_twincat_scope_without_times_is_refused_with_the_setting(tmp_path: Path) -> None:
    rows = [row for row in SCOPE if row[:1] != ["Name"]]
    path = written(tmp_path, "\n".join("\t".join(row) for row in rows) + "\n")
    with raises_saying(ConfigurationError, "TwinCAT Scope", "Timelines"):
        samples(path, n={"column": "speed"})


def lvm(columns: str, rows: list[str], decimal: str = ".") -> str:
    tags = {"Writer_Version": "2", "Separator": "Tab", "Decimal_Separator": decimal, "X_Columns": columns}
    file = ["LabVIEW Measurement\t", *(f"{tag}\t{value}" for tag, value in tags.items()), "***End_of_Header***\t", "\t"]
    names = ["X_Value", "speed", "torque"]
    if columns == "Multi":
        names = ["X_Value", "speed", "X_Value", "torque"]
    segment = [
        "Channels\t2",
        f"Samples\t{len(rows)}\t{len(rows)}",
        "Date\t2026/03/29\t2026/03/29",
        f"Time\t12:00:00{decimal}5\t12:00:00{decimal}5",
        "Y_Unit_Label\trpm\tVolts",
        "X_Dimension\tTime\tTime",
        f"X0\t0{decimal}0E+0\t0{decimal}0E+0",
        f"Delta_X\t0{decimal}010000\t0{decimal}010000",
        "***End_of_Header***\t",
        "\t".join([*names, "Comment"]),
        *(row.replace(".", decimal) for row in rows),
    ]
    return "\n".join([*file, *segment]) + "\n"


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize(
    ("columns", "rows", "times"),
    [
        ("One", ["0.0\t60\t1.5\t", "0.01\t120\t2.5\tseen"], [0.0, 0.01]),
        ("No", ["\t60\t1.5", "\t120\t2.5"], [0.0, 0.01]),
        ("Multi", ["0.0\t60\t0.1\t1.5", "0.02\t120\t0.3\t2.5"], [0.0, 0.02]),
    ],
)
def test_a_measurement_of_labview_has_times_in_one_column_in_several_or_in_none(
    tmp_path: Path, columns: str, rows: list[str], times: list[float], decimal: str
) -> None:
    path = written(tmp_path, lvm(columns, rows, decimal), "run.lvm")
    sources: dict[str, dict[str, object]] = {
        "n": {"column": "speed", "of": "turn/s"},
        "u": {"column": "torque", "of": "V"},
    }
    found = samples(path, None, 0, "Europe/Berlin", **sources)
    assert [time - NOON_IN_BERLIN - 0.5 for time, _ in found["n"]] == pytest.approx(times, abs=1e-6)
    assert [value for _, value in found["n"]] == pytest.approx([1.0, 2.0])
    assert [value for _, value in found["u"]] == [1.5, 2.5]
    assert_says(described(path, "speed", "rpm"), "LVM")


def test_each_segment_of_labview_has_a_time_of_its_own(tmp_path: Path) -> None:
    text = lvm("No", ["\t60\t1.5", "\t120\t2.5"])
    second = text[text.index("Channels") :].replace("12:00:00.5", "12:00:02.5").replace("60", "180")
    found = samples(written(tmp_path, f"{text}\t\n{second}", "run.lvm"), n={"column": "speed", "of": "turn/s"})
    assert [time - NOON - 0.5 for time, _ in found["n"]] == pytest.approx([0.0, 0.01, 2.0, 2.01], abs=1e-6)
    assert [value for _, value in found["n"]] == pytest.approx([1.0, 2.0, 3.0, 2.0])


def test_a_text_of_iba_has_names_below_the_line_of_the_times(tmp_path: Path) -> None:
    """Signal IDs beside the word of the time, names and units below, as ibaAnalyzer reads and writes them."""
    text = "time\t[0:0]\t[0:1]\n\tspeed\ttorque\nsec\trpm\tNm\n0,00\t60\t1,5\n0,01\t120\t2,5\n"
    path = written(tmp_path, text, "pda.txt")
    found = samples(path, n={"column": "speed", "of": "turn/s"}, M={"column": "torque", "of": "N*m"})
    assert [time for time, _ in found["n"]] == [0.0, 0.01]
    assert [value for _, value in found["n"]] == pytest.approx([1.0, 2.0])
    assert [value for _, value in found["M"]] == [1.5, 2.5]


def test_a_tag_log_of_wincc_may_lack_a_time(tmp_path: Path) -> None:
    lines = [*WINCC.splitlines(), *(f'"Speed";"";1;1;{time}' for time in ("", "abc", "1e30", "-1e30"))]
    found = samples(written(tmp_path, "\n".join(lines) + "\n"), bad=4, zone="Europe/Berlin", speed={"column": "Speed"})
    assert [value for _, value in found["speed"]] == [100.5, 101.5]


LVM_SEGMENT = """Channels\t2
Y_Unit_Label\t{unit}\tA
Date\t2026/03/29\t2026/03/29
Time\t12:00:00\t12:00:00
***End_of_Header***
X_Value\ta\tX_Value\tb\tComment
0\t1\t0\t5
0.1\t2\t\t
x\t3\t\t
"""
LVM_HEAD = "LabVIEW Measurement\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tMulti\n***End_of_Header***\n\n"


def test_channels_of_a_labview_file_may_have_few_rows(tmp_path: Path) -> None:
    path = written(tmp_path, LVM_HEAD + LVM_SEGMENT.format(unit="V"), "run.lvm")
    assert samples(path, b={"of": "A"}) == {"b": [(NOON, 5.0)]}
    assert samples(path, bad=1, a={"of": "V"}) == {"a": [(NOON, 1.0), (NOON + 0.1, 2.0)]}


def test_a_channel_of_a_labview_file_has_one_unit(tmp_path: Path) -> None:
    segments = [LVM_SEGMENT.format(unit=unit) for unit in ("V", "mV")]
    with raises_saying(ConfigurationError, "run.lvm:22", "'a'", "'V'", "'mV'", "export"):
        samples(written(tmp_path, LVM_HEAD + "\n".join(segments), "run.lvm"), a={"of": "V"})


@pytest.mark.parametrize("title", ["", "2026 first run\n", "\ufeff"])
@pytest.mark.parametrize("indent", ["", " ", "+"])
def test_no_row_of_twincat_is_taken_for_a_key(tmp_path: Path, title: str, indent: str) -> None:
    head = f"{title}Starttime of export\t134192000000000000\tSunday\n\nName\tspeed\nUnit\trpm\n\n"
    rows = "".join(f"{indent}{number}\t{100 + number}\n" for number in range(5))
    found = samples(written(tmp_path, head + rows), speed={"of": "rpm"})
    assert [value for _, value in found["speed"]] == [100.0, 101.0, 102.0, 103.0, 104.0]


@pytest.mark.parametrize("zone", ["", "Europe/Berlin"])
def test_it_is_said_that_dates_of_a_labview_file_are_taken_as_utc(tmp_path: Path, zone: str) -> None:
    path = written(tmp_path, LVM_HEAD + LVM_SEGMENT.format(unit="V"), "run.lvm")
    signal = Signal(name="a", unit="V", source=TableSource())
    with open_log(path, Setup((signal,), tmp_path, 0.01, timezone=zone)) as reader:
        assert len(list(reader.chunks())) == 1
        assert ("taken as UTC" in " ".join(reader.warnings())) is not zone.startswith("Europe")


def test_a_second_table_of_influx_has_the_same_order_of_columns(tmp_path: Path) -> None:
    first = ",table,_time,_value,_field\n,0,2026-03-29T12:00:00Z,1.5,speed\n"
    same = ",table,_time,_value,_field\n,1,2026-03-29T12:00:00Z,2.5,torque\n"
    other = ",table,_time,_field,_value\n,1,2026-03-29T12:00:01Z,torque,3.5\n"
    assert samples(written(tmp_path, first + "\n" + same), torque={}) == {"torque": [(NOON, 2.5)]}
    with raises_saying(ConfigurationError, "table.csv", "line 4", "another header", "export"):
        samples(written(tmp_path, first + "\n" + other), speed={})
