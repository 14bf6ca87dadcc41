"""Several files are replayed one after the other, each a recording of its own."""

from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.playback import Playback
from otolith.acquisition.samples import SignalPlan
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import JoinedReader, Reader
from otolith_drivers.replay.tables import TableReader

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
        assert all(str(path) in line for path, line in zip(files, joined.warnings(), strict=True))
    values = [window.column("x") for window in windows]
    assert [len(column) for column in values] == [RECORDS] * 4
    assert np.array_equal(np.concatenate(values[:2]), np.arange(100.0))
    assert np.array_equal(np.concatenate(values[2:]), 1e6 + np.arange(100.0))
    assert [window.start for window in windows[2:]] == pytest.approx([5.0 + later, 5.5 + later])
    assert playback.counts.segments == 1


def test_a_missing_file_is_named_before_any_is_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"absent\.csv"):
        JoinedReader([write(tmp_path, "a.csv", 0.0, 10, 0.0), tmp_path / "absent.csv"], opened)
