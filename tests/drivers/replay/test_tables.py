"""The column ``segment`` of a table: a change of its text begins a new recording."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay import tables
from otolith_drivers.replay.readers import Rows
from otolith_drivers.replay.tables import TableReader, TableSource


def read(path: Path, sources: dict[str, TableSource] | None = None) -> tuple[list[Rows], TableReader]:
    with TableReader(path, {"x": "1"}, sources) as reader:
        return list(reader.chunks()), reader


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


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
