"""The column ``segment`` of a table: a change of its text begins a new recording."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Rows
from otolith_drivers.replay.table import reader as tables
from otolith_drivers.replay.table.header import MAX_PREAMBLE
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import TableReader
from tests.messages import raises_saying


def read(path: Path, sources: dict[str, TableSource] | None = None) -> tuple[list[Rows], TableReader]:
    with TableReader(path, {"x": "1"}, sources) as reader:
        return list(reader.chunks()), reader


def numbers(rows: list[Rows], name: str = "x") -> list[float]:
    return list(map(float, np.concatenate([part.columns[name] for part in rows])))


def times(rows: list[Rows]) -> list[float]:
    return list(map(float, np.concatenate([part.times for part in rows])))


def lines(rows: list[Rows]) -> list[int]:
    return list(map(int, np.concatenate([part.lines for part in rows])))


def table(folder: Path, segments: list[str], heading: str = "t,segment,x") -> Path:
    path = folder / "table.csv"
    rows = [f"{row / 100},{segment},{row}" for row, segment in enumerate(segments)]
    path.write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
    return path


def begins(rows: list[Rows]) -> list[int]:
    return np.flatnonzero(np.concatenate([part.begins for part in rows])).tolist()


@pytest.mark.parametrize(
    ("segments", "expected"),
    [
        (["1", "1", "2", "2", "1"], [2, 4]),
        (["run A", " run A ", "run B"], [2]),
        (["", "1", "", "1", "2", "", ""], [4]),
        (["a", "", "NaN", "null", "b", "b"], [4]),
        (["", "", ""], []),
    ],
)
def test_a_change_of_its_text_begins_a_recording(tmp_path: Path, segments: list[str], expected: list[int]) -> None:
    rows, reader = read(table(tmp_path, segments))
    assert begins(rows) == expected
    assert reader.ignored == ()
    assert reader.bad == 0


@settings(max_examples=60)
@given(st.lists(st.sampled_from(["", "a", "b", "Straße", "nan"]), min_size=1, max_size=60), st.integers(10, 60))
def test_marks_do_not_depend_on_chunks(tmp_path: Path, segments: list[str], chunk: int) -> None:
    path = table(tmp_path, segments)
    at_once, _ = read(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tables, "CHUNK", chunk)
        in_parts, _ = read(path)
    assert begins(in_parts) == begins(at_once)
    named = [segment for segment in segments if segment not in ("", "nan")]
    assert len(begins(at_once)) == sum(one != other for one, other in pairwise(named))


def test_a_bad_row_leaves_the_mark_to_the_next_row(tmp_path: Path) -> None:
    path = table(tmp_path, ["1", "1", "2", "2"])
    path.write_text(path.read_text(encoding="utf-8").replace("0.02,2,2", "never,2,2"), encoding="utf-8")
    rows, _ = read(path)
    assert begins(rows) == [2]
    assert np.concatenate([part.times for part in rows]).tolist() == [0.0, 0.01, 0.03]


def test_a_table_without_the_column_has_one_recording(tmp_path: Path) -> None:
    rows, _ = read(table(tmp_path, ["1", "2"], heading="t,Segment,x"))
    assert begins(rows) == []
    assert all(part.marks is None for part in rows)


def test_a_signal_may_have_the_column(tmp_path: Path) -> None:
    rows, _ = read(table(tmp_path, ["1", "2"]), {"x": TableSource(column="segment")})
    assert begins(rows) == []
    assert np.concatenate([part.columns["x"] for part in rows]).tolist() == [1.0, 2.0]


def test_a_second_column_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="a second column segment: remove one"):
        read(table(tmp_path, ["1,1"], heading="t,segment,segment,x"))


MORNING = 1774749598.25  # s since 1970: 2026-03-29 01:59:58.25 UTC


@pytest.mark.parametrize(
    ("written", "heading"),
    [
        ("2026-03-29T01:59:58.250Z", "timestamp"),
        ("2026-03-29 01:59:58.25", "DateTime"),
        ("2026-03-29 03:59:58.250+02:00", "_time"),
        ("2026-03-29T01:59:58.250000000+00:00", "t"),
        ("2026/03/29 01:59:58.250", "Time"),
        ("29.03.2026 01:59:58,250", "Zeitstempel"),
    ],
)
def test_times_may_be_dates(tmp_path: Path, written: str, heading: str) -> None:
    path = tmp_path / "table.csv"
    later = written.replace("58", "59")
    path.write_text(f"{heading};x\n{written};1,5\n{later};2,5\n", encoding="utf-8")
    rows, reader = read(path)
    assert all("UTC" in line for line in reader.warnings())  # of a date without a zone
    assert times(rows) == [MORNING, MORNING + 1.0]
    assert numbers(rows) == [1.5, 2.5]


@pytest.mark.parametrize("written", ["2026-13-29 01:59:58", "today"])
def test_times_that_are_none_are_refused(tmp_path: Path, written: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"t,x\n{written},1.5\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "table.csv:2", "t is ", "seconds", "Unix", "date"):
        read(path)


def test_the_line_below_the_header_may_have_the_units(tmp_path: Path) -> None:
    """A column of ms taken for s would make each parameter of a dimension with time wrong, silently."""
    path = tmp_path / "table.csv"
    path.write_text("time,i,omega\nms,[mA],(rpm)\n0,1500,60\n10,2500,\n", encoding="utf-8")
    with TableReader(path, {"i": "A", "omega": "rad/s"}) as reader:
        rows = list(reader.chunks())
    assert reader.warnings() == []
    assert times(rows) == [0.0, 0.01]
    assert lines(rows) == [3, 4]
    assert numbers(rows, "i") == pytest.approx([1.5, 2.5])
    assert numbers(rows, "omega")[0] == pytest.approx(2.0 * np.pi)


@pytest.mark.parametrize("line", ["ms,V", "s,words", "1,1", "nan,nan", ","])
def test_the_line_below_the_header_is_a_row_or_an_error_if_it_has_no_units(tmp_path: Path, line: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"t,i\n{line}\n2,5\n", encoding="utf-8")
    try:
        with TableReader(path, {"i": "A"}) as reader:
            rows = list(reader.chunks())
    except ConfigurationError as error:
        assert line == "ms,V"
        assert "table.csv:1: column 2 ('i'): unit 'V'" in str(error)  # noqa: PT017 - which it is depends on the line
    else:
        assert times(rows)[-1] == 2.0
        assert numbers(rows, "i")[-1] == 5.0


@pytest.mark.parametrize(
    "header",
    [
        "time,i,omega\nfloat,float,float\nms,mA,rpm",
        "time,i,omega\n\n# units\nms,mA,rpm",
        "time,i,omega\n,,\nms,mA,rpm\n",
        "ms,mA,rpm\ntime,i,omega",
        "names\nms,mA,rpm\ntime,i,omega",
    ],
)
def test_units_may_be_in_another_line_beside_the_header(tmp_path: Path, header: str) -> None:
    path = tmp_path / "table.csv"
    path.write_text(f"{header}\n0,1500,60\n10,2500,120\n", encoding="utf-8")
    with TableReader(path, {"i": "A", "omega": "rad/s"}) as reader:
        rows = list(reader.chunks())
    assert reader.warnings() == []
    assert times(rows) == [0.0, 0.01]
    assert lines(rows)[-1] == header.count("\n") + 3
    assert numbers(rows, "i") == pytest.approx([1.5, 2.5])
    assert numbers(rows, "omega") == pytest.approx([2.0 * np.pi, 4.0 * np.pi])


def test_a_word_for_the_unit_of_the_time_leaves_the_other_units(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t,x\nTime,%\n1,50\n", encoding="utf-8")
    assert numbers(read(path)[0]) == [0.5]


def test_a_unit_that_is_not_known_is_refused_where_the_others_are_units(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t,i,omega,x\ns,mA,rpm,Frobs\n0,1500,60,1\n", encoding="utf-8")
    units = {"i": "A", "omega": "rad/s", "x": "V"}
    with raises_saying(ConfigurationError, "table.csv:1", "column 4", "'x'", "'Frobs'"):
        TableReader(path, units)
    with TableReader(path, units, {"x": TableSource(unit="V")}) as reader:
        assert numbers(list(reader.chunks())) == [1.0]


def test_names_in_a_comment_are_the_header_if_numbers_follow(tmp_path: Path) -> None:
    """As numpy.savetxt writes them."""
    path = tmp_path / "table.csv"
    path.write_text("# made by hand\n# t [ms],x\n10,1\n20,2\n", encoding="utf-8")
    rows, reader = read(path)
    assert (times(rows), numbers(rows), lines(rows)) == ([0.01, 0.02], [1.0, 2.0], [3, 4])
    assert reader.warnings() == []
    path.write_text("# t [ms],x\nt,x\n10,1\n", encoding="utf-8")
    assert times(read(path)[0]) == [10.0]


@pytest.mark.parametrize(
    ("separator", "cells", "expected"),
    [
        (";", ["1.001,5", "-12.345.678,25", "999,5"], [1001.5, -12345678.25, 999.5]),
        (";", ["1,001.5", "1,234,567.25", "999.5"], [1001.5, 1234567.25, 999.5]),
        (",", ['"1,001.5"', '"1,234,567"', '"999.5"'], [1001.5, 1234567.0, 999.5]),
        (";", ["1 001,5", "12\u00a0345\u202f678,25", "\u2212999,5"], [1001.5, 12345678.25, -999.5]),
        (";", ["1'001.5", "12\u2019345\u2019678.25", "0.5"], [1001.5, 12345678.25, 0.5]),
        (";", ["1.001", "0,5", "1?001,5"], [np.nan, 0.5, np.nan]),
        (";", ["1,001", "0.5", "12,34.5"], [np.nan, 0.5, np.nan]),
    ],
)
def test_thousands_may_be_separated(tmp_path: Path, separator: str, cells: list[str], expected: list[float]) -> None:
    """Three digits alone behind the other decimal sign are no number: they may be decimals."""
    path = tmp_path / "table.csv"
    rows = [f"{index}{separator}{cell}" for index, cell in enumerate(cells)]
    path.write_text("\n".join([f"t{separator}x", *rows]) + "\n", encoding="utf-8")
    read_rows, reader = read(path)
    assert numbers(read_rows) == pytest.approx(expected, nan_ok=True)
    assert reader.bad == np.count_nonzero(np.isnan(expected))


@pytest.mark.parametrize(("separator", "sign"), [(";", "."), (";", ","), (",", ",")])
def test_whole_numbers_with_separated_thousands_are_refused(tmp_path: Path, separator: str, sign: str) -> None:
    """1,001 beside 999 would be taken for 1.001, a thousandth, without a warning."""
    path = tmp_path / "table.csv"
    cells = [f'"{number:,}"'.replace(",", sign) for number in range(980, 1020)]
    rows = [f"{index}{separator}{cell}" for index, cell in enumerate(cells)]
    path.write_text("\n".join([f"t{separator}x", *rows]) + "\n", encoding="utf-8")
    with raises_saying(ConfigurationError, f"'1{sign}000'", "1000 ", "thousands"):
        read(path)
    path.write_text("\n".join([f"t{separator}x", *rows, f'40{separator}"0{sign}5"']) + "\n", encoding="utf-8")
    assert numbers(read(path)[0])[-1] == 0.5


def test_the_decimal_sign_is_named_where_a_cell_has_the_other(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("t;x\n0.0;1,5\n0.1;1,6\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "csv:2", "'0.0'", "','", "decimal sign"):
        read(path)
    path.write_text("t;x\n0;1,5\n1;1,6\n2;1.6\n", encoding="utf-8")
    assert "line 4: x is '1.6', but ',' is the decimal sign of other cells" in read(path)[1].warnings()[0]


def test_a_header_may_have_units_in_parentheses_and_names_with_them(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text(
        "Time (ms),u (mV),x (left),x (right) [mV],v (axis 2),y (1),y (2)\n10,2000,3,4000,5,6,7\n", encoding="utf-8"
    )
    sources = {
        "a": TableSource(column="x (right)"), "b": TableSource(column="x (left)"), "c": TableSource(column="u (mV)"),
        "d": TableSource(column="v (axis 2)", unit="kV"), "e": TableSource(column="y (1)"),
    }  # fmt: skip
    with TableReader(path, dict.fromkeys(sources, "V"), sources) as reader:
        (rows,) = reader.chunks()
    values = {name: float(column[0]) for name, column in rows.columns.items()}
    assert values == pytest.approx({"a": 4.0, "b": 3.0, "c": 2.0, "d": 5000.0, "e": 6.0})
    assert rows.times[0] == 0.01


def test_lines_above_the_header_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    above = "Model,XY4054\nFirmware Version,2.68\n\n% comment\nSample Interval,2e-2\nLabel,,\n"
    path.write_text(f"{above}TIME,x\n0.00,1.5\n0.01,2.5\n", encoding="utf-8")
    rows, reader = read(path)
    assert lines(rows) == [8, 9]
    assert reader.bad == 0


def test_what_is_missing_is_named_in_the_line_with_most_names(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("Model,XY4054\n\nTIME,CH1,CH2\n0.00,1.5,2\n0.01,2.5,3\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "table.csv:3", "'x'", "CH1, CH2"):
        read(path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-8-sig", "cp1252"])
def test_a_table_may_have_any_usual_encoding(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "table.csv"
    mark = "\ufeff" if encoding in {"utf-16-le", "utf-16-be"} else ""
    path.write_bytes(f"{mark}t,x,größe\r\n0.5,1.5,2\r\n".encode(encoding))
    rows, reader = read(path)
    assert numbers(rows) == [1.5]
    assert reader.ignored == ("größe",)


@pytest.mark.parametrize("heading", ["Time,x,Time,y", "Time [s],x,Time [ms],y", "time,x,Timestamp,y"])
def test_two_columns_of_times_are_refused(tmp_path: Path, heading: str) -> None:
    """Trends are exported with a time beside each signal: that of another one would be taken."""
    path = tmp_path / "table.csv"
    path.write_text(f"{heading}\n0,1,5,2\n1,2,6,3\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"table.csv:1: '[Tt]ime.*', 'Time.*' may be the column"):
        read(path)


def test_any_number_of_comments_may_be_above_the_header(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_text("# made by a logger\n\n" * MAX_PREAMBLE + "t,x\n0,1\n", encoding="utf-8")
    rows, _ = read(path)
    assert lines(rows) == [2 * MAX_PREAMBLE + 2]
