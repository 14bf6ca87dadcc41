"""A table with the date in a column of its own, as German loggers write it."""

from pathlib import Path

import pytest

from tests.drivers.replay.test_tables import read, times

MIDNIGHT = 1_795_392_000.0  # 2026-11-23 00:00:00 UTC


@pytest.mark.parametrize("date", ["Datum", "DATE"])
@pytest.mark.parametrize("time", ["Uhrzeit", "Zeit", "t"])
def test_the_date_may_stand_in_a_column_of_its_own(tmp_path: Path, date: str, time: str) -> None:
    path = tmp_path / "log.csv"
    rows = ["22.11.2026;23:59:59,500;1,5", "23.11.2026; 00:00:00,000 ;2,5", "23.11.2026;00:00:00,500;3,5"]
    path.write_text("\n".join([f"{date};{time};x", *rows, ""]), encoding="utf-8")
    found, reader = read(path)
    assert times(found) == pytest.approx([MIDNIGHT - 0.5, MIDNIGHT, MIDNIGHT + 0.5])
    assert reader.bad == 0


def test_a_date_beside_seconds_changes_no_time(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Datum;t;x\n23.11.2026;0,5;1\n23.11.2026;1,0;2\n23.11.2026;1,5;3\n", encoding="utf-8")
    assert times(read(path)[0]) == [0.5, 1.0, 1.5]


def test_a_row_without_its_date_is_bad(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("Datum;Zeit;x\n23.11.2026;00:00:01;1\n;00:00:02;2\n23.11.2026;00:00:03;3\n", encoding="utf-8")
    found, reader = read(path)
    assert times(found) == [MIDNIGHT + 1.0, MIDNIGHT + 3.0]
    assert reader.bad == 1
