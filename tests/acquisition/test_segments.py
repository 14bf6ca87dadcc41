"""Segments: a mark or time that starts again begins a recording; a late row or a wrong time does not."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.playback import CONFIRMING_ROWS, Playback, SegmentFinder
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, Mask
from otolith_drivers.replay.readers import Rows
from tests.acquisition.series import ramp

PERIOD, RECORDS = 0.01, 50
LENGTH = RECORDS * PERIOD


def log(times: Array, marks: Mask | None = None) -> Rows:
    count = np.arange(len(times))
    return Rows(times, {"x": count.astype(float)}, count + 2, 0 * count, marks)


def begins(rows: Rows, cuts: list[int]) -> list[int]:
    """Return the first row of each segment but the first, if the rows come in chunks that end at ``cuts``."""
    finder = SegmentFinder(LENGTH)
    edges = [0, *sorted({cut for cut in cuts if 0 < cut < len(rows.times)}), len(rows.times)]
    parts = [part for first, last in pairwise(edges) for part in finder.mark(rows.part(slice(first, last)))]
    parts += finder.rest()
    assert np.array_equal(np.concatenate([part.times for part in parts]), rows.times)
    assert np.array_equal(np.concatenate([part.lines for part in parts]), rows.lines)
    return np.flatnonzero(np.concatenate([part.begins for part in parts])).tolist()


TIMES = st.lists(st.one_of(st.floats(-1e3, 1e3), st.integers(0, 40).map(lambda slot: slot * 0.1)), min_size=1)


@given(TIMES, st.lists(st.integers(0, 60)), st.sets(st.integers(1, 40)))
def test_segments_do_not_depend_on_chunks(times: list[float], cuts: list[int], marked: set[int]) -> None:
    marks = np.array([row in marked for row in range(len(times))])
    rows = log(np.array(times), marks)
    at_once = begins(rows, [])
    assert begins(rows, cuts) == at_once
    assert set(np.flatnonzero(marks)) <= set(at_once)


def test_time_that_starts_again_begins_a_segment() -> None:
    times = np.concatenate([ramp(300), ramp(200), 50.0 + ramp(100)]) * PERIOD
    assert begins(log(times), [7, 299, 301, 500, 502]) == [300, 500]


@pytest.mark.parametrize("rows_back", [1, 2, CONFIRMING_ROWS - 1])
def test_a_few_rows_with_a_wrong_time_begin_no_segment(rows_back: int) -> None:
    times = 10.0 + ramp(300) * PERIOD
    times[100 : 100 + rows_back] = ramp(rows_back) * PERIOD
    assert begins(log(times), []) == []


def test_late_rows_begin_no_segment() -> None:
    times = ramp(300) * PERIOD
    times[100:120] -= 0.8 * LENGTH
    assert begins(log(times), []) == []


def test_one_time_far_ahead_does_not_hide_the_following_rows() -> None:
    """A single wrong time in the future is followed by rows that continue: they are used."""
    times = ramp(600) * PERIOD
    times[100] = 1e6
    playback = Playback([SignalPlan("x")], RECORDS, PERIOD)
    windows = [*playback.windows(log(times)), *playback.rest()]
    used = np.concatenate([window.values[~window.missing[:, 0], 0] for window in windows])
    assert len(used) > 450


def test_windows_do_not_span_two_segments() -> None:
    """Each segment is windowed like a file of its own."""
    first, second = ramp(170) * PERIOD, 1.7 + ramp(180) * PERIOD
    times = np.concatenate([first, second])
    playback = Playback([SignalPlan("x")], RECORDS, PERIOD)
    windows = [*playback.windows(log(times, np.arange(350) == 170)), *playback.rest()]
    assert playback.counts.segments == 1
    assert [window.start for window in windows] == pytest.approx([0.0, 0.5, 1.0, 1.7, 2.2, 2.7])
    assert [window.index for window in windows] == list(range(6))
    values = np.concatenate([window.values[:, 0] for window in windows])
    assert np.array_equal(values, [*range(150), *range(170, 320)])


@pytest.mark.parametrize("late", [0.0, -2.0, -100.0, 5.0])
def test_a_file_that_follows_another_is_windowed_as_alone(late: float) -> None:
    times = ramp(300) * PERIOD
    alone = Playback([SignalPlan("x")], RECORDS, PERIOD)
    windows = [*alone.windows(log(times + late)), *alone.rest()]
    joined = Playback([SignalPlan("x")], RECORDS, PERIOD)
    both = log(np.concatenate([times, times + late]), np.arange(600) == 300)
    after = [*joined.windows(both), *joined.rest()][-len(windows) :]
    for one, other in zip(windows, after, strict=True):
        assert one.start == other.start
        assert np.array_equal(one.values + 300.0, other.values)
