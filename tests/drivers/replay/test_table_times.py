"""The times of a table: named for each signal, in any unit and form, and questioned where they are improbable."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import open_log
from tests.drivers.replay.readings import samples
from tests.messages import assert_says, raises_saying

BEGIN = 1_714_993_372.0  # 2024-05-06 11:02:52 UTC
NAMED: dict[str, object] = {"time": "Name"}


def assert_readings(found: Sequence[tuple[float, float]], times: Sequence[float], values: Sequence[float]) -> None:
    assert [value for _, value in found] == list(values)
    assert [time for time, _ in found] == pytest.approx(list(times))


def table(folder: Path, header: str, rows: Sequence[str]) -> Path:
    path = folder / "table.csv"
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def scope(folder: Path, first: str = "Name") -> Path:
    """Two signals with times of their own, ms: 'fast' every 0.2, 'slow' every 1; both are their times."""
    rows = [f"{row / 5}\t{row / 5}\t" + (f"{row}\t{row}" if row < 20 else "\t") for row in range(100)]
    return table(folder, f"{first}\tfast\tName\tslow", rows)


def test_each_signal_has_the_times_of_the_column_before_it(tmp_path: Path) -> None:
    clock = {"column": "Name", "unit": "ms"}
    found = samples(scope(tmp_path), fast={"time": clock}, slow={"time": clock})
    assert (len(found["fast"]), len(found["slow"])) == (100, 20)
    for readings in found.values():
        assert [time for time, _ in readings] == pytest.approx([value / 1e3 for _, value in readings])


def test_times_behind_their_values_are_found(tmp_path: Path) -> None:
    rows = [f"{row},{row / 10},{row},{row / 5}" for row in range(10)]
    path = table(tmp_path, "x,Name,y,Name", rows)
    found = samples(path, x=NAMED, y=NAMED)
    assert_readings(found["x"][9:], [0.9], [9.0])
    assert_readings(found["y"][9:], [1.8], [9.0])
    with raises_saying(ConfigurationError, "table.csv:1", "Time", "y", 'time = "'):
        samples(table(tmp_path, "x,t,y,Time", rows), x={}, y={})


def test_times_on_either_side_of_values_are_refused(tmp_path: Path) -> None:
    path = table(tmp_path, "Name,x,Name,y,Name", [f"{row},{row},{row},{row},{row}" for row in range(10)])
    with raises_saying(ConfigurationError, "table.csv:1", "Name"):
        samples(path, x=NAMED, y=NAMED)


@pytest.mark.parametrize("header", ["t [ms],x [A]", "t,x\nms,A"], ids=["in the header", "below it"])
@pytest.mark.parametrize(
    ("source", "words"),
    [({"time": {"column": "t", "unit": "s"}}, ("ms", "s")), ({"unit": "mA"}, ("A", "mA"))],
    ids=["time", "signal"],
)
def test_a_unit_that_the_table_contradicts_is_refused(
    header: str, source: dict[str, object], words: tuple[str, str], tmp_path: Path
) -> None:
    path, other = table(tmp_path, header, [f"{row},{row}" for row in range(10)]), TableSource.model_validate(source)
    with raises_saying(ConfigurationError, "table.csv", *(f"'{word}'" for word in words), "unit"):
        open_log(path, Setup((Signal(name="x", unit="A", source=other),), tmp_path, 0.01))
    same = TableSource.model_validate({"unit": "ampere", "time": {"column": "t", "unit": "msec"}})
    with open_log(path, Setup((Signal(name="x", unit="A", source=same),), tmp_path, 0.01)) as reader:
        assert next(iter(reader.chunks())).times[1] == pytest.approx(1e-3)


@pytest.mark.parametrize(
    ("header", "unit", "of_file", "factor"),
    [
        ("x (C)", "K", "°C", 1.0),  # of a temperature, C is no coulomb
        ("x (C)", "degC", "degC", 1.0),
        ("x (1/min)", "rad/s", "rpm", np.pi / 30.0),
        ("x [Umdr./min]", "rad/s", "rpm", np.pi / 30.0),
        ("x (A)", "V", "mV", 1e-3),  # a phase
        ("x (V)", "A", "A", 1.0),
        ("x (Hz)", "rad/s", "rpm", np.pi / 30.0),  # which leaves open whether turns are meant
    ],
)
def test_a_unit_that_the_header_does_not_contradict_is_that_of_the_machine_file(
    header: str, unit: str, of_file: str, factor: float, tmp_path: Path
) -> None:
    path = table(tmp_path, f"t (S),{header}", [f"{row},{row}" for row in range(10)])
    source = TableSource.model_validate({"unit": of_file, "time": {"column": "t", "unit": "s"}})
    with open_log(path, Setup((Signal(name="x", unit=unit, source=source),), tmp_path, 0.01)) as reader:
        rows = next(iter(reader.chunks()))
    assert np.diff(rows.columns["x"]) == pytest.approx(factor)
    assert np.diff(rows.times) == pytest.approx(1.0)


def test_columns_with_one_name_are_asked_about(tmp_path: Path) -> None:
    with raises_saying(ConfigurationError, "table.csv:1", "2 columns", "'Name'", 'time = "'):
        samples(scope(tmp_path), fast={}, slow={})


def test_a_column_that_rises_like_a_time_before_a_signal_is_asked_about(tmp_path: Path) -> None:
    path = scope(tmp_path, "t [ms]")
    with raises_saying(ConfigurationError, "table.csv:1", "'Name'", "slow", 'time = "Name"', 'time = "t [ms]"'):
        samples(path, fast={}, slow={})
    both = samples(path, fast={"time": "t [ms]"}, slow={"time": "t [ms]"})
    assert_readings(both["slow"][5:6], [1e-3], [5.0])


def test_a_counter_or_a_position_before_a_signal_is_no_time(tmp_path: Path) -> None:
    path = table(tmp_path, "t,counter,position,x", [f"{row / 100},{row},{row / 10},{row}" for row in range(10)])
    assert_readings(samples(path, x={})["x"][9:], [0.09], [9.0])


def test_dates_that_contradict_the_times_are_asked_about(tmp_path: Path) -> None:
    """Numbers whose name says ms, but which are not."""
    rows = [f'"06.05.2024 11:02:{52 + row}";{row},00;1;{45418460324 + 11.574 * row:.2f}' for row in range(6)]
    path = table(tmp_path, '"Moment";"x";"Validity";"Time_ms"', rows)
    with raises_saying(ConfigurationError, "table.csv:1", "Time_ms", "0.0463 s", "Moment", "4 s", 'time = "'):
        samples(path, x={})
    found = samples(path, x={"time": "Moment"})
    assert found["x"] == [(BEGIN + row, float(row)) for row in range(6)]


@pytest.mark.parametrize("beside", ["2026-01-31", "20260131", "calibrated 2025-01-31 12:00:00", "2025-01-31 12:00:00"])
def test_a_constant_date_beside_the_times_contradicts_nothing(tmp_path: Path, beside: str) -> None:
    path = table(tmp_path, "t,Note,x", [f"{row},{beside},{row}" for row in range(10)])
    assert len(samples(path, x={})["x"]) == 10


def test_the_time_of_a_signal_may_be_named_with_its_unit(tmp_path: Path) -> None:
    rows = [f"{row},{row},{2 * row},{row}" for row in range(10)]
    path = table(tmp_path, "Time (s),x,Time (s),y", rows)
    for name in ("Time (s)", "Time"):
        found = samples(path, x={"time": name}, y={"time": name})
        assert_readings(found["y"][9:], [18.0], [9.0])


def test_a_line_without_end_is_refused_where_columns_repeat(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t,x," * 100_000, encoding="utf-8")
    with raises_saying(ConfigurationError, "table.csv", "100000"):
        samples(path, x={"time": "t"})


@pytest.mark.parametrize(
    ("unit", "step", "begin", "meaning"),
    [
        ("d", 0.01 / 86400, 45203.7157523148, "10 ms if they are days"),
        ("h", 0.001 / 3600, 0.0, "1 ms if they are hours"),
    ],
)
def test_rows_faster_than_any_logger_are_asked_about(
    tmp_path: Path, unit: str, step: float, begin: float, meaning: str
) -> None:
    rows = [f"{begin + step * row:.11f};{row}" for row in range(20)]
    with raises_saying(ConfigurationError, "table.csv", meaning, f"[{unit}]"):
        samples(table(tmp_path, "t;x", rows), x={})
    found = samples(table(tmp_path, f"t [{unit}];x", rows), x={})
    since = np.array([time for time, _ in found["x"]])
    assert np.diff(since) == pytest.approx(step * {"d": 86400, "h": 3600}[unit], rel=0.02)
    if begin:  # 2023-10-04 17:10:41, counted in days since 1899
        assert since[0] == pytest.approx(1_696_439_441.0, abs=1.0)


def test_days_of_a_spreadsheet_are_in_the_zone_of_the_plant_whatever_stands_beside_them(tmp_path: Path) -> None:
    path = table(tmp_path, "t [d];x", ["0;0", "46110,5;1", "46110,75;2"])
    signals = (Signal(name="x", unit="1", source=TableSource()),)
    with open_log(path, Setup(signals, tmp_path, 0.01, timezone="Europe/Berlin")) as reader:
        times = np.concatenate([rows.times for rows in reader.chunks()])
    noon = 1_774_778_400.0  # 2026-03-29 12:00 in Berlin
    assert times.tolist() == pytest.approx([0.0, noon, noon + 21_600.0])


@pytest.mark.parametrize("pause", [0, 1500, 2400], ids=["none", "25 min", "40 min"])
@pytest.mark.parametrize("begin", [-1800, -600, 600], ids=["before", "late", "in the hour"])
def test_dates_of_the_hour_that_comes_twice_go_on(begin: int, pause: int, tmp_path: Path) -> None:
    """Summer time ended in Berlin at 01:00 UTC, when it was 02:00 again."""
    end, zone = datetime(2026, 10, 25, 1, tzinfo=UTC), ZoneInfo("Europe/Berlin")
    since = [begin - 3600 + 20 * row + pause * (row > 150) for row in range(500)]
    dates = [(end + timedelta(seconds=seconds)).astimezone(zone) for seconds in since]
    path = table(tmp_path, "time;x", [f"{date:%d.%m.%Y %H:%M:%S};{row}" for row, date in enumerate(dates)])
    signals = (Signal(name="x", unit="1", source=TableSource()),)
    with open_log(path, Setup(signals, tmp_path, 20.0, timezone="Europe/Berlin")) as reader:
        times = np.concatenate([rows.times for rows in reader.chunks()])
        assert_says(" ".join(reader.warnings()), "twice", "CEST")
    assert times.tolist() == [end.timestamp() + seconds for seconds in since]


def test_dates_without_a_zone_are_said_to_be_taken_as_utc(tmp_path: Path) -> None:
    signals = (Signal(name="x", unit="1", source=TableSource()),)
    for zone, mark, is_said in (("", "", True), ("Europe/Berlin", "", False), ("", "+01:00", False)):
        path = table(tmp_path, "time;x", [f"2026-01-31 12:00:0{row}{mark};{row}" for row in range(9)])
        with open_log(path, Setup(signals, tmp_path, 1.0, timezone=zone)) as reader:
            list(reader.chunks())
            assert ("UTC" in " ".join(reader.warnings())) is is_said


def test_a_fast_table_whose_unit_is_stated_is_not_asked_about(tmp_path: Path) -> None:
    path = table(tmp_path, "t [s];x", [f"{row * 1e-8:.10f};{row}" for row in range(20)])
    assert samples(path, x={})["x"][19][0] == pytest.approx(1.9e-7)


def test_date_and_time_of_day_may_stand_in_two_columns(tmp_path: Path) -> None:
    rows = [f"06.05.2024;11:02:{52 + row / 2:06.3f};{row}" for row in range(6)]
    path = table(tmp_path, "Datum;Uhrzeit;x", rows)
    found = samples(path, x={"time": {"column": "Uhrzeit", "date": "Datum"}})
    assert_readings(found["x"], [BEGIN + row / 2 for row in range(6)], list(range(6)))
    with raises_saying(ConfigurationError, "table.csv:1", "'Tag'", "Datum"):
        samples(path, x={"time": {"column": "Uhrzeit", "date": "Tag"}})


def test_a_unit_that_measures_no_time_is_refused() -> None:
    with pytest.raises(ValidationError, match="time"):
        TableSource.model_validate({"time": {"column": "t", "unit": "V"}})


@settings(max_examples=60)
@given(
    periods=st.lists(st.integers(1, 20), min_size=1, max_size=4),
    ends=st.lists(st.integers(6, 40), min_size=4, max_size=4),
    is_named=st.booleans(),
)
def test_any_times_beside_each_other_reach_their_signals(
    tmp_path_factory: pytest.TempPathFactory, periods: list[int], ends: list[int], is_named: bool
) -> None:
    """Columns of one name or of several, of any rates and lengths: no signal has the times of another."""
    clocks = ["Name" if is_named else f"clock{at}" for at in range(len(periods))]
    header = ";".join(f"{clock};x{at}" for at, clock in enumerate(clocks))
    lengths = ends[: len(periods)]
    rows = [
        ";".join(
            f"{period * row};{1000 * at + row}" if row < end else ";"
            for at, (period, end) in enumerate(zip(periods, lengths, strict=True))
        )
        for row in range(max(lengths))
    ]
    path = table(tmp_path_factory.mktemp("times"), header, rows)
    sources: dict[str, dict[str, object]] = {
        f"x{at}": {"time": {"column": clock, "unit": "ms"}} for at, clock in enumerate(clocks)
    }
    found = samples(path, None, 0, "", **sources)
    for at, (period, end) in enumerate(zip(periods, lengths, strict=True)):
        values = [1000.0 * at + row for row in range(end)]
        assert_readings(found[f"x{at}"], [1e-3 * period * row for row in range(end)], values)
