"""Several files are replayed one after the other, each a recording of its own."""

import gc
import weakref
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.playback import Playback
from otolith.acquisition.samples import SignalPlan
from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.joined import JoinedReader
from otolith_drivers.replay.readers import Reader
from otolith_drivers.replay.table.reader import TableReader
from tests.messages import assert_each_says, raises_saying

PERIOD, RECORDS = 0.01, 50


def write(folder: Path, name: str, start: float, rows: int, value: float) -> Path:
    path = folder / name
    lines = [f"{start + row * PERIOD:.2f},{value + row}" for row in range(rows)]
    path.write_text("\n".join(["t,x", *lines, "bad,1"]) + "\n", encoding="utf-8")
    return path


def opened(path: Path) -> Reader:
    return TableReader(path, {"x": "1"})


@pytest.mark.parametrize("later", [0.0, 1.2, 100.0, 1e9])
def test_no_window_spans_two_files(tmp_path: Path, later: float) -> None:
    files = [write(tmp_path, "a.csv", 5.0, 120, 0.0), write(tmp_path, "b.csv", 5.0 + later, 120, 1e6)]
    playback = Playback([SignalPlan("x")], RECORDS, PERIOD)
    with JoinedReader(files, opened) as joined:
        windows = [window for rows in joined.chunks() for window in playback.windows(rows)]
        windows += playback.rest()
        assert joined.progress == 1.0
        assert joined.bad == 2
        assert [line.split(":")[0] for line in joined.summary_lines()] == ["a.csv", "b.csv"]
        assert_each_says(joined.warnings(), [str(path) for path in files])
    values = [window.column("x") for window in windows]
    assert [len(column) for column in values] == [RECORDS] * 4
    assert np.array_equal(np.concatenate(values[:2]), np.arange(100.0))
    assert np.array_equal(np.concatenate(values[2:]), 1e6 + np.arange(100.0))
    assert [window.start for window in windows[2:]] == pytest.approx([5.0 + later, 5.5 + later])
    assert playback.counts.segments == 1


def test_a_missing_file_is_named_before_any_is_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"absent\.csv"):
        JoinedReader([write(tmp_path, "a.csv", 0.0, 10, 0.0), tmp_path / "absent.csv"], opened)


def test_of_two_hundred_files_one_is_open_at_a_time(tmp_path: Path) -> None:
    files = [write(tmp_path, f"{number}.csv", 10.0 * number, 5, 0.0) for number in range(200)]
    before, most, rows = descriptors(), 0, 0
    with JoinedReader(files, opened) as joined:
        most = descriptors() - before
        for part in joined.chunks():
            most, rows = max(most, descriptors() - before), rows + len(part.times)
    assert rows == 1000
    assert most <= 2
    assert descriptors() == before


def descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def test_a_file_with_times_of_another_meaning_is_named_before_any_is_read(tmp_path: Path) -> None:
    def opened_as(path: Path) -> Reader:
        reader = opened(path)
        reader.sampling = Sampling.POLLED if path.name == "b.csv" else Sampling.TRUE
        return reader

    files = [write(tmp_path, name, 0.0, 10, 0.0) for name in ("a.csv", "b.csv")]
    before = descriptors()
    with raises_saying(ConfigurationError, "b.csv", "polled", "a.csv", "true"):
        JoinedReader(files, opened_as)
    assert descriptors() == before


def test_a_file_that_only_has_the_name_of_a_recording_is_named_before_any_is_read(tmp_path: Path) -> None:
    first, other = write(tmp_path, "a.csv", 0.0, 10, 0.0), tmp_path / "b.rrd"
    with raises_saying(ConfigurationError, "b.rrd", "No such file"):
        JoinedReader([first, other], opened)
    other.write_text("t,x", encoding="utf-8")
    with raises_saying(ConfigurationError, "b.rrd", "no recording"):
        JoinedReader([first, other], opened)


def test_a_file_that_was_not_reached_is_named(tmp_path: Path) -> None:
    files = [write(tmp_path, name, 0.0, 10, 0.0) for name in ("a.csv", "b.csv")]
    with JoinedReader(files, opened) as joined:
        next(joined.chunks())
        assert joined.summary_lines()[1] == "b.csv: not read"
        assert joined.file == files[0]


def test_a_file_that_was_read_is_not_kept(tmp_path: Path) -> None:
    files = [write(tmp_path, f"{number}.csv", 10.0 * number, 5, 0.0) for number in range(50)]
    made = list[weakref.ref[Reader]]()

    def noted(path: Path) -> Reader:
        reader = opened(path)
        made.append(weakref.ref(reader))
        return reader

    with JoinedReader(files, noted) as joined:
        for number, _ in enumerate(joined.chunks()):
            if number % 20 == 0:
                gc.collect()  # a reader and its rows refer to each other
                assert sum(reader() is not None for reader in made) <= 2
        assert (joined.bad, joined.progress) == (50, 1.0)
        assert_each_says(joined.warnings(), (str(files[0]), "47 more"))
        assert_each_says(joined.summary_lines(), ("250 rows", "50 of 50"), ("50 bad",))


def test_what_holds_of_each_file_is_said_once(tmp_path: Path) -> None:
    """As that dates without a zone are taken as UTC."""
    files = [tmp_path / f"{day}.csv" for day in ("monday", "tuesday")]
    for day, file in enumerate(files, start=1):
        rows = [f"2026-03-0{day} 10:00:0{second},1.{second}" for second in range(5)]
        file.write_text("\n".join(["t,x", *rows]) + "\n", encoding="utf-8")
    with JoinedReader(files, opened) as joined:
        for _ in joined.chunks():
            pass
        assert_each_says(joined.warnings(), ("UTC", "timezone", *map(str, files)))
