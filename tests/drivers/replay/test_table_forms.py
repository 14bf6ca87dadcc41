"""Forms of tables: how times are written, a value per row, names in two lines, rows without last cells, words, scales.

Each right value follows from the description of the form, by hand.
"""

from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from pydantic import ValidationError

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.table.options import TableOptions, TableSource
from otolith_drivers.replay.table.reader import TableReader, open_log
from tests.drivers.replay.readings import samples
from tests.messages import assert_says, raises_saying

NOON = datetime(2026, 3, 29, 12, tzinfo=UTC).timestamp()


def written(folder: Path, *lines: str, name: str = "table.csv") -> Path:
    path = folder / name
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_times_of_the_day_count_on_behind_midnight(tmp_path: Path) -> None:
    path = written(tmp_path, "Time;x", "23:59:59,5;1", "23:59:59,9;2", "00:00:00,5;3", "00:00:01;4")
    times = [86_399.5, 86_399.9, 86_400.5, 86_401.0]
    assert samples(path, x={})["x"] == list(zip(times, [1.0, 2.0, 3.0, 4.0], strict=True))


def test_a_time_of_the_day_among_dates_is_bad(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x", "2026-03-29 12:00:00;1", "12:00:01;2", "2026-03-29 12:00:02;3")
    assert samples(path, bad=1, x={})["x"] == [(NOON, 1.0), (NOON + 2.0, 3.0)]


@pytest.mark.parametrize(
    ("cell", "forms"),
    [
        ("03/04/2026 12:00:00", ("%d/%m/%Y %H:%M:%S", "%m/%d/%Y %H:%M:%S")),
        ("03/04/26 1:00:00 PM", ("%d/%m/%y %I:%M:%S %p", "%m/%d/%y %I:%M:%S %p")),
        ("02:52.5", ("%M:%S", "%H:%M")),
    ],
)
def test_a_time_that_may_be_two_is_asked_about_and_answered_by_its_format(
    tmp_path: Path, cell: str, forms: tuple[str, str]
) -> None:
    with raises_saying(ConfigurationError, "table.csv:2", 'column = "Zeit"'):
        samples(written(tmp_path, "Zeit;x", f"{cell};1"), x={})
    path = written(tmp_path, "t;x", f"{cell};1")
    with raises_saying(ConfigurationError, "table.csv:2", cell, *(f'format = "{form}"' for form in forms)):
        samples(path, x={})
    found = [
        samples(path, x={"time": {"column": "t", "format": form}})["x"][0][0]
        for form in forms[: 1 + (":52" not in cell)]
    ]
    expected = {"%M:%S": 172.5}
    for form, time in zip(forms, found, strict=False):
        day, month = (3, 4) if form.startswith("%d") else (4, 3)
        hour = 13 if "%p" in form else 12
        assert time == expected.get(form, datetime(2026, month, day, hour, tzinfo=UTC).timestamp())


def test_a_format_holds_for_date_and_time_in_two_columns_in_a_zone(tmp_path: Path) -> None:
    path = written(tmp_path, "Day,Clock,x", "03/29/2026,14:00:00.250,1")
    time = {"column": "Clock", "date": "Day", "format": "%m/%d/%Y %H:%M:%S", "zone": "Europe/Berlin"}
    assert samples(path, x={"time": time})["x"] == [(NOON + 0.25, 1.0)]


def test_digits_that_a_format_describes_are_no_number(tmp_path: Path) -> None:
    path = written(tmp_path, "t,x", "20260329120000,1", "20260329120001,2")
    found = samples(path, x={"time": {"column": "t", "format": "%Y%m%d%H%M%S"}})["x"]
    assert found == [(NOON, 1.0), (NOON + 1.0, 2.0)]


@pytest.mark.parametrize(
    ("epoch", "unit", "number", "zone", "expected"),
    [
        ("1970-01-01T00:00:00Z", "ms", 1_774_785_600_000.0, "Europe/Berlin", NOON),
        ("1601-01-01T00:00:00Z", "s", 11_644_473_600.0 + NOON, "", NOON),
        ("1904-01-01", "s", NOON + 2_082_844_800.0, "", NOON),  # LabVIEW
        (
            "1899-12-30",
            "d",
            46_110.5,
            "Europe/Berlin",
            datetime(2026, 3, 29, 12, tzinfo=ZoneInfo("Europe/Berlin")).timestamp(),
        ),
    ],
)
def test_numbers_count_from_the_stated_epoch(
    tmp_path: Path, epoch: str, unit: str, number: float, zone: str, *, expected: float
) -> None:
    path = written(tmp_path, "clock,x", f"{number!r},1")
    time = {"column": "clock", "unit": unit, "epoch": epoch}
    assert samples(path, zone=zone, x={"time": time})["x"][0][0] == pytest.approx(expected, abs=1e-5)


def test_the_time_of_the_table_holds_for_signals_without_one_of_their_own(tmp_path: Path) -> None:
    path = written(tmp_path, "a [ms],b [s],x,y", "1000,3,1,2", "2000,4,3,4")
    found = samples(path, {"time": "a"}, x={}, y={"time": "b"})
    assert (found["x"], found["y"]) == ([(1.0, 1.0), (2.0, 3.0)], [(3.0, 2.0), (4.0, 4.0)])


@pytest.mark.parametrize(
    ("time", "words"),
    [
        ({"column": "t", "epoch": "yesterday"}, "1899-12-30"),
        ({"column": "t", "zone": "Berlin"}, "Europe/Berlin"),
        ({"column": "t", "format": "%Q"}, "%d/%m/%Y"),
        ({"column": "t", "unit": "V"}, "V"),
    ],
)
def test_a_key_of_the_time_that_is_none_is_refused(time: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError) as caught:
        TableSource.model_validate({"time": time})
    assert_says(str(caught.value), words)


LONG = (
    "VarName;Moment;VarValue",
    "U;2026-03-29 12:00:00;24,5",
    "N;2026-03-29 12:00:00;100",
    "U;2026-03-29 12:00:01;24,6",
)


def test_a_value_per_row_is_read_by_the_names_of_the_variables(tmp_path: Path) -> None:
    lines = [line.replace("Moment", "TimeString") for line in LONG]
    found = samples(written(tmp_path, *lines), u={"column": "U", "unit": "mV", "of": "V"}, n={"column": "N"})
    assert found["u"] == [(NOON, 0.0245), (NOON + 1.0, pytest.approx(0.0246))]
    assert found["n"] == [(NOON, 100.0)]


def test_a_value_per_row_in_columns_of_any_name(tmp_path: Path) -> None:
    path = written(tmp_path, "when,which,how much", "0,a,1", "0.5,b,2", "1,a,3")
    options = {"time": "when", "names": "which", "values": "how much"}
    found = samples(path, options, x={"column": "a"}, b={})
    assert (found["x"], found["b"]) == ([(0.0, 1.0), (1.0, 3.0)], [(0.5, 2.0)])
    with pytest.raises(ValidationError, match="values"):
        TableOptions.model_validate({"names": "which"})
    with raises_saying(ConfigurationError, "table.csv", "'what'", "table.names"):
        samples(path, {**options, "names": "what"}, x={"column": "a"})


def test_the_columns_of_a_data_log_may_be_separated_by_bars(tmp_path: Path) -> None:
    path = written(tmp_path, "time|path|value", "0|GVL.n|1.5", "1|GVL.u|24", "2|GVL.n|2.5")
    assert samples(path, n={"column": "GVL.n"})["n"] == [(0.0, 1.5), (2.0, 2.5)]


def test_blocks_of_variables_one_below_the_other_are_merged_by_time(tmp_path: Path) -> None:
    rows = [f"{row},a,{row}" for row in range(20)] + [f"{row},b,{2 * row}" for row in range(20)]
    path = written(tmp_path, "t,tag,value", *rows)
    signals = tuple(Signal(name=name, unit="1", source=TableSource()) for name in "ab")
    with open_log(path, Setup(signals, tmp_path, 0.01)) as reader:
        chunks = list(reader.chunks())
    assert [time for rows in chunks for time in rows.times] == sorted([*range(20), *range(20)])
    assert not any(rows.begins.any() for rows in chunks)


def test_a_variable_that_no_row_has_is_named_with_those_that_there_are(tmp_path: Path) -> None:
    path = written(tmp_path, "t,tag,value", "0,speed,1", "1,speed,2", "2,torque,3")
    with raises_saying(ConfigurationError, "table.csv", "'sped'", "'tag'", "'speed'"):
        samples(path, x={"column": "sped"})


def test_names_may_stand_below_the_unit_of_the_time(tmp_path: Path) -> None:
    path = written(tmp_path, "Time;Channel 1;Channel 2", "ms;U;n", "0;1;2", "10;3;4")
    assert samples(path, n={})["n"] == [(0.0, 2.0), (0.01, 4.0)]
    path = written(tmp_path, "Time;[0:0];[0:1]", ";U;n", "s;V;rpm", "0;1;2", "10;3;60")
    found = samples(path, n={"of": "turn/s"}, U={"of": "mV"})
    assert [value for _, value in found["n"]] == pytest.approx([2 / 60, 1.0])
    assert found["U"] == [(0.0, 1000.0), (10.0, 3000.0)]


def test_rows_may_lack_their_last_cells(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x;y", "0;1;2", "1;3", "2", "3;5;6", "4;7")
    with TableReader(path, {"x": "1", "y": "1"}) as reader:
        (rows,) = reader.chunks()
    assert rows.times.tolist() == [0.0, 1.0, 3.0, 4.0]
    assert rows.columns["x"].tolist() == [1.0, 3.0, 5.0, 7.0]
    assert np.isnan(rows.columns["y"]).tolist() == [False, True, False, True]
    assert reader.bad == 1  # the row with a time only
    assert any("line 3" in line and "2 rows" in line for line in reader.warnings())


def test_a_column_may_end_before_the_others(tmp_path: Path) -> None:
    """The first row without its last cell may be one that is cut; those that follow are not."""
    rows = [f"{row};{row};{row}" if row < 150 else f"{row};{row}" for row in range(200)]
    found = samples(written(tmp_path, "t;x;y", *rows), bad=1, x={}, y={})
    assert [value for _, value in found["x"]] == [row for row in range(200) if row != 150]
    assert [value for _, value in found["y"]] == [*range(150)]


def test_one_row_without_its_last_cell_is_damaged(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x;y", "0;1;2", "1;3", "2;4;5", "3;6;7")
    assert [time for time, _ in samples(path, bad=1, x={})["x"]] == [0.0, 2.0, 3.0]


def test_a_last_line_that_is_cut_off_is_no_row(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t;x;y\n0;1;2\n1;3;4\n2;5", encoding="utf-8")
    assert samples(path, bad=1, x={})["x"] == [(0.0, 1.0), (1.0, 3.0)]


def test_words_for_true_and_false_are_numbers(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x", "0;TRUE", "1;false", "2;WAHR", "3;Falsch", "4;1", "5;yes")
    found = samples(path, bad=1, x={})["x"]
    assert [value for _, value in found] == [1.0, 0.0, 1.0, 0.0, 1.0]


def test_a_column_is_scaled_moved_and_inverted_in_its_unit(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x;y", "0;4;100", "1;20;-50")
    source = {"unit": "bar", "scale": 6.25, "offset": -25.0, "of": "Pa"}  # 4 to 20 mA are 0 to 100 bar
    found = samples(path, x=source, y={"invert": True})
    assert [value for _, value in found["x"]] == pytest.approx([0.0, 1e7])
    assert [value for _, value in found["y"]] == [-100.0, 50.0]


def test_a_range_is_that_of_the_scaled_value(tmp_path: Path) -> None:
    path = written(tmp_path, "t;x", "0;400", "1;2000", "2;3000")
    source = {"unit": "V", "scale": 0.01, "range": [0.0, 25.0], "of": "mV"}
    assert [value for _, value in samples(path, x=source)["x"]] == pytest.approx([4000.0, 20000.0])


@pytest.mark.parametrize("source", [{"scale": 0.0, "unit": "V"}, {"scale": 2.0}, {"offset": 1.0}])
def test_a_scale_without_a_meaning_is_refused(source: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=r"scale|unit"):
        TableSource.model_validate(source)


@pytest.mark.parametrize("end", ["EOF", "//END", "//END_OF_LOG"])
def test_the_mark_at_the_end_is_no_row(tmp_path: Path, end: str) -> None:
    assert len(samples(written(tmp_path, "t;x", "0;1", "1;2", end), x={})["x"]) == 2
