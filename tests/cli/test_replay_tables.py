"""Replay of tables: formats, missing and bad cells, rows out of order, random text."""

import gzip
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith.health.schema import ReportDocument, Status
from otolith.machine import load_machine
from otolith.runtime.replay import Replay
from otolith_drivers.errors import OtolithError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.table import reader as table
from tests.cli.replays import HEADING, MACHINE, PERIOD, Lines, recorded, reports, summed_up, values, written
from tests.conftest import SIGNALS
from tests.messages import assert_refuses, raises_saying


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario)


def test_table_result_does_not_depend_on_the_chunk_size(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rows[250], rows[251], rows[300][2], rows[400][3] = rows[251], rows[250], "", "?"
    data = written(tmp_path, rows)
    whole = reports(data, capsys)
    monkeypatch.setattr(table, "CHUNK", 97)
    assert reports(data, capsys) == whole


def test_table_with_decimal_commas_units_and_cp1252(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    lines = ["# Prüfstand 3", "", "t [ms];V_a [mV];Bemerkung;T_load;i;omega [U/min];"]
    for t, voltage, load, current, speed in rows:
        cells = [f"{1e3 * float(t):.1f}", repr(1e3 * float(voltage)), "ok", load, current]
        lines.append(";".join([*cells, repr(float(speed) * 30 / np.pi), ""]).replace(".", ","))
    path = tmp_path / "export.csv"
    path.write_bytes("\r\n".join(lines).encode("utf-8-sig"))
    assert values(reports(path, capsys)) == pytest.approx(plain, rel=1e-6)
    path.write_bytes("\r\n".join(lines).encode("cp1252"))
    assert values(reports(path, capsys)) == pytest.approx(plain, rel=1e-6)


@pytest.mark.parametrize("name", ["time", "Time (s)", "Timestamp [s]", "Zeit", "t_s"])
def test_table_whose_times_have_another_name(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    assert values(reports(written(tmp_path, rows, heading=(name, *HEADING[1:])), capsys)) == plain


@pytest.mark.parametrize("name", ["time (ms)", "Time_ms"])
def test_table_whose_times_are_in_milliseconds_without_brackets(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    scaled = [[f"{1e3 * float(row[0]):.1f}", *row[1:]] for row in rows]
    replayed = values(reports(written(tmp_path, scaled, heading=(name, *HEADING[1:])), capsys))
    assert replayed == pytest.approx(plain, rel=1e-6)


def test_table_prefers_t_to_other_names_and_refuses_two_of_them(tmp_path: Path, rows: Lines) -> None:
    units = dict(zip(HEADING[1:], ("V", "N*m", "A", "rad/s"), strict=True))
    doubled = [[row[0], *row] for row in rows]
    with table.TableReader(written(tmp_path, doubled, heading=("time", *HEADING)), units) as reader:
        assert reader.ignored == ("time",)
    two = written(tmp_path, doubled, heading=("time", "timestamp", *HEADING[1:]))
    with raises_saying(OtolithError, "'time', 'timestamp'", "rename"):
        table.TableReader(two, units)


@pytest.mark.parametrize("style", ["tab", "quotes", "quoted decimal comma", "sep=", "gzip"])
def test_table_separators_quotes_and_gzip(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str], style: str
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    if style == "tab":
        path = written(tmp_path, rows, separator="\t")
    elif style == "gzip":
        path = tmp_path / "data.csv.gz"
        path.write_bytes(gzip.compress(written(tmp_path, rows).read_bytes()))
    elif style == "sep=":
        path = written(tmp_path, rows, separator="|")
        path.write_text("sep=|\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    else:
        sign = "," if "comma" in style else "."
        quoted = [[f'"{cell.replace(".", sign)}"' for cell in row] for row in rows]
        path = written(tmp_path, quoted, heading=tuple(f'"{name}"' for name in HEADING))
    assert values(reports(path, capsys)) == plain


def test_table_truncated_gzip_is_read_to_its_end(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "data.csv.gz"
    path.write_bytes(gzip.compress(written(tmp_path, rows).read_bytes())[:-3000])
    text = summed_up(path, capsys)
    assert "4 windows: 4 good, 0 bad" in text
    assert "cut off: Compressed file ended" in text


def test_table_counts_and_locates_bad_rows_and_cells(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    rows[210][1], rows[220][2], rows[230][3] = "", "NaN", "#REF!"
    rows[240][4], rows[250][0] = "1_000", "yesterday"
    rows[260] = rows[260][:2]
    del rows[450:453]
    rows[300:300] = [["# a remark"], [""], ["", "", "", "", ""]]
    data = written(tmp_path, rows)
    documents = reports(data, capsys)
    assert len(documents) == 5
    assert all(document.parameters["R_a"].status is Status.ESTIMATED for document in documents)
    assert [document.window.quality.missing > 0.01 for document in documents] == [False, True, True, False, False]
    assert documents[-1].counters is not None
    assert (documents[-1].counters.bad, documents[-1].counters.lost) == (4, 0)
    text = summed_up(data, capsys)
    assert f"{len(rows) - 5} rows read, 0 reordered, 2 bad rows, 2 bad cells, 2 cells blank" in text
    assert "bad cells: 2, bad rows: 2, the first in line 232: i is '#REF!', no number" in text


def test_table_with_sentinels_is_one_with_blank_cells(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    blank = [list(row) for row in rows]
    for at, (column, sentinel) in enumerate([(3, "-9999"), (4, "32767"), (4, "65535"), (1, "-9999"), (2, "-999")]):
        for row in range(210 + at, 900, 97):
            rows[row][column], blank[row][column] = sentinel, ""
    plain = values(reports(written(tmp_path, blank), capsys))
    data = written(tmp_path, rows)
    documents = reports(data, capsys)
    assert values(documents) == plain
    assert not any(document.events for document in documents)
    text = summed_up(data, capsys)
    for signal, sentinel in [
        ("i", "-9999"),
        ("omega", "32767"),
        ("omega", "65535"),
        ("V_a", "-9999"),
        ("T_load", "-999"),
    ]:
        assert f"{signal}: {sentinel} in 8 cells is no reading and left out" in text


def test_table_rows_are_reordered_within_the_window(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    for at in range(30, 190, 7):
        rows[at], rows[at + 3] = rows[at + 3], rows[at]
    documents = reports(written(tmp_path, rows), capsys)
    assert values(documents) == plain
    assert documents[-1].counters is not None
    assert documents[-1].counters.lost == 0
    late = rows.pop(100)
    rows.insert(700, late)
    text = summed_up(written(tmp_path, rows), capsys)
    assert "; 4000 samples, 4 lost" in text
    assert f"closed: 1, the first in line 702, at t = {float(late[0]):g} s after t = 7 s above" in text.replace(
        "\n", " "
    )


def test_table_locates_a_time_far_ahead(tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    rows[500][0] = "99999999"
    text = summed_up(written(tmp_path, rows), capsys)
    assert "4 windows: 4 good, 0 bad" in text
    assert "gaps longer than a window, skipped: 1, the longest of 1e+08 s" in text
    assert "recordings in the file: 2" in text


def test_table_gap_longer_than_a_window_is_skipped(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    for silence in (10.0, 1e5):
        again = [[f"{float(row[0]) + 10.0 + silence:.3f}", *row[1:]] for row in rows]
        documents = reports(written(tmp_path, rows + again), capsys)
        assert [document.window.index for document in documents] == list(range(10))
        assert all(document.window.quality.verdict == "good" for document in documents)
        assert documents[-1].window.end == pytest.approx(20.0 + silence)


def test_table_with_irregular_rows_and_slow_columns(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(5)
    for index, row in enumerate(rows):
        row[0] = f"{float(row[0]) + random.uniform(0.0, 0.002):.6f}"
        row[2] = row[2] if index % 10 == 0 else ""
    documents = reports(written(tmp_path, rows), capsys)
    assert len(documents) == 5
    assert all(document.window.quality.verdict == "good" for document in documents)
    for before, after in pairwise(documents):
        assert after.window.start == pytest.approx(before.window.end, abs=PERIOD / 4)
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.005)


@pytest.mark.parametrize(("blank", "names"), [((3, 4), "i, omega"), ((1,), "V_a"), ((2,), "T_load")])
def test_table_without_outputs_or_with_a_blank_input_gives_bad_windows_naming_it(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str], blank: tuple[int, ...], names: str
) -> None:
    emptied = [["" if column in blank else cell for column, cell in enumerate(row)] for row in rows]
    text = summed_up(written(tmp_path, emptied), capsys)
    assert "0 good, " in text
    assert f"bad like: no samples of {names} from t = " in text


def test_table_with_one_blank_output_is_used(tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    documents = reports(written(tmp_path, [[*row[:4], ""] for row in rows]), capsys)
    assert all(document.window.quality.verdict == "good" for document in documents)
    assert documents[-1].window.quality.missing == 1.0


def test_table_rows_denser_than_the_grid_are_not_lost(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    dense = [[f"{index * 1e-4:.4f}", *rows[index // 100][1:]] for index in range(len(rows) * 100)]
    documents = reports(written(tmp_path, dense), capsys)
    assert len(documents) == 5
    assert documents[-1].counters is not None
    assert documents[-1].counters.lost == 0


JUNK = st.sampled_from(
    ["", "nan", "1", "-2.5", "1e308", "-1e308", "1e999", "#", '"', "a", "1,5", "\x00", "é", " ", "inf"]
)
ANYTHING = st.text(max_size=400) | st.builds(
    lambda lines, sep, end: end.join(["t,V_a,T_load,i,omega".replace(",", sep), *(sep.join(line) for line in lines)]),
    st.lists(st.lists(JUNK | st.floats(width=32).map(repr), min_size=3, max_size=6), max_size=30),
    st.sampled_from([",", ";", "\t"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
)


@settings(max_examples=150)
@given(ANYTHING)
def test_table_of_random_text_is_refused_or_read(tmp_path: Path, text: str) -> None:
    path = tmp_path / "data.csv"
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    check_any(path)


ROW = st.tuples(st.floats(-0.2, 3.0), st.lists(JUNK | st.floats(-5, 5).map(repr), min_size=4, max_size=4))


@settings(max_examples=60)
@given(st.lists(ROW, min_size=2, max_size=80), st.booleans(), st.sampled_from([1.0, 0.1, 1e6]))
def test_table_of_random_cells_is_refused_or_read(
    tmp_path: Path, rows: list[tuple[float, list[str]]], ordered: bool, pace: float
) -> None:
    lines = [[repr(time * pace), *cells] for time, cells in (sorted(rows) if ordered else rows)]
    check_any(written(tmp_path, lines, separator=";"), len(lines))


def check_any(path: Path, rows: int = 0) -> None:
    """Refused with a reason, or every window gets its report, and each of ``rows`` that is not used is counted."""
    machine = path.with_name("machine.toml")
    window = '[window]\nlength = "0.2 s"\nmissing_limit = "100 %"\ngap_limit = "1 s"\njitter_limit = "1 s"\n'
    swarm = "[swarm]\ngenerations = 2\nsize = 3\n"
    machine.write_text(MACHINE.read_text(encoding="utf-8") + window + swarm, encoding="utf-8")
    plan = load_machine(machine, with_driver=False)
    try:
        with table.TableReader(path, {name: plan.twin.unit_of(name) for name in SIGNALS}) as opened:
            for index, report in enumerate(Replay(plan, opened).reports()):
                document = report.document
                assert document.window.index == index
                assert document.counters is not None
                assert document.counters.windows_missed == 0
                assert ReportDocument.from_json(document.to_json()) == document
        counts = opened.counts
        assert counts.rows + counts.bad_rows == rows or not rows
        assert bool(counts.bad_rows + counts.bad_cells) == (counts.first_bad is not None)
    except OtolithError as error:
        assert_refuses(error, path)
