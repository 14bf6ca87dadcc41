"""Samples of one signal: cleaned without inventing or losing any, and how often they come."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.samples import (
    MAX_VALUE,
    Series,
    finite_samples,
    has_equal_times,
    interval_of,
    merge_equal_times,
    stale_repeats,
)


@given(
    st.lists(st.tuples(st.integers(-50, 50), st.floats(-1e3, 1e3)), max_size=60),
    st.sampled_from([None, "zoh", "foh"]),
)
def test_one_sample_is_left_for_each_time(samples: list[tuple[int, float]], hold: str | None) -> None:
    samples.sort(key=lambda sample: sample[0])
    times, values = np.array([s[0] / 100 for s in samples]), np.array([s[1] for s in samples])
    merged = merge_equal_times(times, values, hold)
    assert np.array_equal(merged.times, np.unique(times))
    assert merged.repeated == len(times) - len(merged.times)
    assert has_equal_times(times) == (merged.repeated > 0)
    assert merge_equal_times(merged.times, merged.values, hold).repeated == 0
    for time, value in zip(merged.times, merged.values, strict=True):
        same = values[times == time]
        assert value == (same[-1] if hold == "zoh" else pytest.approx(same.mean(), abs=1e-9))
        if (same == same[0]).all():
            assert value == same[0]  # bit for bit: each row twice gives the samples of each row once


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=30))
def test_samples_that_are_no_numbers_are_left_out(values: list[float]) -> None:
    times, kept = finite_samples(np.arange(float(len(values))), np.array(values))
    assert len(times) == len(kept)
    assert np.array_equal(kept, [value for value in values if abs(value) <= MAX_VALUE])
    with np.errstate(over="raise", invalid="raise"):
        np.sum(kept**2)


@pytest.mark.parametrize("lost", [0.0, 0.2, 0.4, 0.6, 0.8])
@pytest.mark.parametrize("jitter", [0.0, 0.05])
def test_the_interval_of_a_clock_is_found_with_up_to_80_percent_lost(lost: float, jitter: float) -> None:
    for seed in range(40):
        random = np.random.default_rng(seed)
        slots = np.flatnonzero(random.random(400) >= lost)
        times = (slots + random.uniform(-jitter / 2, jitter / 2, len(slots))) * 0.01
        interval = interval_of(times)
        assert interval.usual == pytest.approx(0.01, rel=2.0 * jitter + 1e-6), seed
        long = np.diff(times) > interval.longest
        assert np.array_equal(long, np.diff(slots) > 1), seed


def test_intervals_without_a_clock_have_gaps_only_where_they_are_long() -> None:
    random = np.random.default_rng(2)
    times = np.cumsum(random.uniform(0.005, 0.02, 300))
    assert interval_of(times).usual == pytest.approx(0.0125, rel=0.1)
    assert (np.diff(times) < interval_of(times).longest).all()
    times[150:] += 0.2
    assert np.flatnonzero(np.diff(times) > interval_of(times).longest).tolist() == [149]


def test_fewer_than_two_samples_have_no_interval() -> None:
    for count in (0, 1):
        assert interval_of(np.arange(float(count))).usual == np.inf
        assert interval_of(np.arange(float(count))).longest == np.inf


@pytest.mark.parametrize("renewed_every", [2, 3, 5, 10])
def test_repeats_of_a_register_are_stale(renewed_every: int) -> None:
    random = np.random.default_rng(1)
    values = np.repeat(np.cumsum(random.normal(size=600 // renewed_every)), renewed_every)
    stale = stale_repeats(values)
    assert np.array_equal(values[~stale], values[::renewed_every])
    assert stale[1:].sum() == np.count_nonzero(np.diff(values) == 0.0)


def test_equal_values_of_a_coarse_encoder_are_measurements() -> None:
    """At a constant rate its runs are equally long, as those of a register, but it moves by single steps."""
    turning = np.floor(np.arange(600) / 5) * 0.01
    swinging = np.rint(20.0 * np.sin(np.arange(600) / 40)) * 0.01
    faster = np.floor(np.arange(600) / 2.5) * 0.01
    for values in (turning, swinging, faster, -turning):
        assert not stale_repeats(values).any()


@given(st.integers(0, 2**32 - 1), st.floats(0.05, 3.0))
def test_a_noisy_coarse_sensor_is_not_stale(seed: int, step: float) -> None:
    random = np.random.default_rng(seed)
    values = np.rint(np.sin(np.arange(600) / 30) / step + 0.2 * random.normal(size=600)) * step
    assert not stale_repeats(values).any()


def test_a_constant_or_a_command_that_is_held_is_not_stale() -> None:
    assert not stale_repeats(np.full(600, 3.0)).any()
    assert not stale_repeats(np.repeat([0.0, 1.0, 4.0], 200)).any()
    random = np.random.default_rng(3)
    runs = random.integers(1, 60, 40)
    assert not stale_repeats(np.repeat(random.normal(size=40), runs)).any()


@given(st.lists(st.floats(-1e9, 1e9), max_size=50), st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
def test_samples_within_a_time_are_those_at_it(times: list[float], start: float, end: float) -> None:
    ordered = np.unique(np.array(times))
    part = Series(ordered, ordered).within(start, end)
    assert np.array_equal(part.times, ordered[(ordered >= start) & (ordered < end)])
