"""Samples onto the grid: what was sampled cyclically comes back exactly, whatever the arrival did."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.alignment import Limits, align, judge
from otolith.acquisition.window import Array, Verdict

PERIOD = 0.01


def ramp(count: int) -> Array:
    return np.arange(count, dtype=np.float64)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.003))
def test_jitter_of_the_arrival_leaves_no_trace(seed: int, jitter: float) -> None:
    late = np.random.default_rng(seed).uniform(0.0, jitter, 200)
    aligned = align(5.0 + ramp(200) * PERIOD + late, ramp(200), 5.0, 200, PERIOD)
    assert np.array_equal(aligned.values, ramp(200))
    assert not aligned.missing.any()


@given(st.integers(10, 150), st.integers(2, 25))
def test_a_burst_after_a_stall_is_put_back_in_its_slots(first: int, length: int) -> None:
    times = ramp(200) * PERIOD
    times[first : first + length] = times[first + length - 1] + 1e-5 * ramp(length)
    aligned = align(times, ramp(200), 0.0, 200, PERIOD)
    assert np.array_equal(aligned.values, ramp(200))


@given(st.sets(st.integers(1, 198), max_size=60))
def test_lost_samples_are_marked_and_bridged(lost: set[int]) -> None:
    kept = np.array([index for index in range(200) if index not in lost])
    aligned = align(kept * PERIOD, kept.astype(float), 0.0, 200, PERIOD)
    assert set(np.flatnonzero(aligned.missing).tolist()) == lost
    assert aligned.values == pytest.approx(ramp(200), abs=1e-9)


@given(
    st.lists(st.tuples(st.floats(-10.0, 10.0), st.floats(allow_nan=True, allow_infinity=True)), max_size=60),
    st.integers(1, 50),
)
def test_anything_gives_finite_values_and_a_verdict(samples: list[tuple[float, float]], records: int) -> None:
    samples.sort(key=lambda sample: sample[0])
    times, values = np.array([s[0] for s in samples]), np.array([s[1] for s in samples])
    aligned = align(times, values, 0.0, records, PERIOD)
    assert np.isfinite(aligned.values).all()
    assert len(aligned.values) == len(aligned.missing) == records
    quality = judge({"x": aligned}, PERIOD, Limits())
    assert 0.0 <= quality.missing <= 1.0
    assert (quality.verdict is Verdict.GOOD) == (not quality.reasons)


def test_a_slower_signal_is_interpolated() -> None:
    times = ramp(45) * 0.05 - 0.02
    aligned = align(times, 3.0 * times, 0.0, 200, PERIOD)
    assert aligned.values == pytest.approx(3.0 * PERIOD * ramp(200), abs=1e-12)
    assert not aligned.missing.any()


@pytest.mark.parametrize(
    ("keep", "sentence"),
    [
        (slice(0, 0), "no samples of x"),
        (slice(0, 100), "50% of x is missing"),
        (np.r_[0:100, 108:200], "x has a gap of 80 ms"),
    ],
)
def test_the_verdict_says_why(keep: slice, sentence: str) -> None:
    aligned = align((ramp(200) * PERIOD)[keep], ramp(200)[keep], 0.0, 200, PERIOD)
    quality = judge({"x": aligned}, PERIOD, Limits())
    assert quality.verdict is Verdict.BAD
    assert sentence in quality.reasons
