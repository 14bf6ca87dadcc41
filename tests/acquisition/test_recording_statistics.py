"""Statistics of a recording: rate, jitter, gaps, repeats and their places, whatever the chunks; memory is bounded."""

from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from otolith.acquisition import playback
from otolith.acquisition.playback import RecordingStatistics, SignalSampling
from otolith.acquisition.samples import stale_repeats
from otolith.acquisition.window import Array
from otolith_drivers.replay.readers import Rows

Floats = NDArray[np.floating[Any]]


def rows_of(times: Array, values: Array, first: int = 2) -> Rows:
    lines = np.arange(first, first + len(times), dtype=np.int64)
    return Rows(times, {"x": values}, lines, np.zeros(len(times), dtype=np.int64))


def statistics_of(times: Floats, values: Floats | None = None, chunk: int = 10**9) -> RecordingStatistics:
    moments = np.asarray(times, dtype=np.float64)
    cells = np.asarray(np.sin(np.arange(len(times))) if values is None else values, dtype=np.float64)
    statistics = RecordingStatistics(("x",))
    for first in range(0, len(times), chunk):
        statistics.add(rows_of(moments[first : first + chunk], cells[first : first + chunk], first + 2))
    return statistics


def sampling_of(times: Floats, values: Floats | None = None, chunk: int = 10**9) -> SignalSampling:
    return statistics_of(times, values, chunk).signals()["x"]


def test_rate_and_jitter() -> None:
    random = np.random.default_rng(1)
    intervals = 0.0107 * (1.0 + 0.05 * random.standard_normal(5000))
    sampling = sampling_of(np.cumsum(intervals))
    assert sampling.interval_s == pytest.approx(0.0107, rel=0.003)
    assert sampling.jitter == pytest.approx(0.05, rel=0.05)
    assert (sampling.samples, sampling.gaps, sampling.longest_gap_s) == (5000, 0, None)


def test_gaps_are_counted_and_the_longest_has_its_place() -> None:
    times = np.arange(1000) * 0.01
    times[200:] += 0.04
    times[600:] += 27.0
    sampling = sampling_of(times)
    assert sampling.gaps == 2
    assert sampling.longest_gap_s == pytest.approx(27.01)
    assert sampling.longest_gap_start == pytest.approx(6.03)
    assert sampling.longest_gap_line == 602
    assert sampling.jitter == pytest.approx(0.0, abs=1e-9)


def test_one_lost_sample_is_no_gap_and_two_are() -> None:
    times = np.arange(1000) * 0.01
    assert sampling_of(np.delete(times, [300, 500])).gaps == 0
    assert sampling_of(np.delete(times, [300, 301, 500])).gaps == 1


def test_duplicates_repeated_times_and_steps_back() -> None:
    times, values = np.arange(100) * 0.01, np.sin(np.arange(100.0))
    twice = sampling_of(np.repeat(times, 2), np.repeat(values, 2))
    assert (twice.duplicates, twice.repeated_times, twice.repeats) == (100, 0, 0)
    assert twice.interval_s == pytest.approx(0.01)
    assert twice.renewal == 1
    assert sampling_of(np.repeat(times, 2), np.arange(200.0)).repeated_times == 100
    back = statistics_of(np.concatenate([times, times]), chunk=7)
    assert back.steps_back == 1
    assert back.first_step_back == (102, times[0], times[-1])
    assert (back.first, back.last) == (times[0], times[-1])


def test_a_register_that_is_renewed_every_fifth_sample() -> None:
    times = np.arange(1000) * 0.01
    random = np.random.default_rng(1)
    values = np.repeat(random.standard_normal(200), 5)
    stale = sampling_of(times, values, chunk=13)
    assert (stale.renewal, stale.repeats) == (5, 800)
    assert stale.renewal == sampling_of(times[3:], values[3:]).renewal
    assert stale_repeats(values).sum() == 800
    encoder = np.repeat(np.arange(200.0), 5)  # at a constant rate: it moves by single steps
    assert sampling_of(times, encoder).renewal == 1
    assert not stale_repeats(encoder).any()
    coarse = sampling_of(times, np.round(np.cumsum(random.standard_normal(1000)) / 3.0))
    assert coarse.repeats > 100
    assert coarse.renewal == 1
    assert sampling_of(times, np.ones(1000)).renewal == 1


def test_blank_cells_are_counted_and_split_no_interval() -> None:
    values = np.sin(np.arange(1000.0))
    values[np.arange(1000) % 5 != 0] = np.nan
    sampling = sampling_of(np.arange(1000) * 0.01, values, chunk=33)
    assert (sampling.samples, sampling.blank) == (200, 800)
    assert sampling.interval_s == pytest.approx(0.05)


def test_memory_is_bounded_and_the_choice_fair(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(playback, "MAX_KEPT", 1000)
    intervals = np.where(np.arange(60_000) % 2 == 0, 0.004, 0.006)
    times = np.cumsum(intervals)
    sampling = sampling_of(times, times, chunk=7000)
    assert len(sampling.values) <= 1000
    assert sampling.jitter == pytest.approx(0.2, rel=0.25)
    assert sampling.values.mean() == pytest.approx(150.0, rel=0.1)
    assert sampling.samples == 60_000


@given(
    times=st.lists(st.floats(-1e11, 1e11), max_size=40),
    values=st.lists(st.floats() | st.sampled_from([0.0, 1.0, np.nan]), min_size=40, max_size=40),
    chunk=st.integers(1, 41),
)
def test_any_rows_give_finite_statistics_that_do_not_depend_on_chunks(
    times: list[float], values: list[float], chunk: int
) -> None:
    moments, cells = np.array(times, dtype=np.float64), np.array(values[: len(times)], dtype=np.float64)
    whole, parts = sampling_of(moments, cells), sampling_of(moments, cells, chunk)
    for name in (field.name for field in fields(whole) if field.name != "values"):
        assert getattr(whole, name) == getattr(parts, name)
    assert np.isfinite(whole.jitter)
    assert whole.samples + whole.blank == len(times)
