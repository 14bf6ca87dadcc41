"""Alignment: cyclic samples are restored exactly, whatever delayed their arrival."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.alignment import QualityLimits, align, align_polled, assess_quality
from otolith.acquisition.window import Array, Verdict
from otolith_drivers.base import Sampling

PERIOD = 0.01
LIMITS = QualityLimits(missing=0.05, gap=0.05, jitter=0.005)


def ramp(count: int) -> Array:
    return np.arange(count, dtype=np.float64)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.003))
def test_arrival_jitter_does_not_change_values(seed: int, jitter: float) -> None:
    late = np.random.default_rng(seed).uniform(0.0, jitter, 200)
    aligned = align(5.0 + ramp(200) * PERIOD + late, ramp(200), 5.0, 200, PERIOD)
    assert np.array_equal(aligned.values, ramp(200))
    assert not aligned.missing.any()


@given(st.integers(10, 150), st.integers(2, 25))
def test_a_burst_after_a_stall_returns_to_its_slots(first: int, length: int) -> None:
    times = ramp(200) * PERIOD
    times[first : first + length] = times[first + length - 1] + 1e-5 * ramp(length)
    aligned = align(times, ramp(200), 0.0, 200, PERIOD)
    assert np.array_equal(aligned.values, ramp(200))


@given(st.sets(st.integers(1, 198), max_size=60))
def test_lost_samples_are_missing_and_interpolated(lost: set[int]) -> None:
    kept = np.array([index for index in range(200) if index not in lost])
    aligned = align(kept * PERIOD, kept.astype(float), 0.0, 200, PERIOD)
    assert set(np.flatnonzero(aligned.missing).tolist()) == lost
    assert aligned.values == pytest.approx(ramp(200), abs=1e-9)


@given(
    st.lists(st.tuples(st.floats(-10.0, 10.0), st.floats(allow_nan=True, allow_infinity=True)), max_size=60),
    st.integers(1, 50),
)
def test_any_samples_give_finite_values_and_a_verdict(samples: list[tuple[float, float]], records: int) -> None:
    samples.sort(key=lambda sample: sample[0])
    times, values = np.array([s[0] for s in samples]), np.array([s[1] for s in samples])
    aligned = align(times, values, 0.0, records, PERIOD)
    assert np.isfinite(aligned.values).all()
    assert len(aligned.values) == len(aligned.missing) == records
    quality = assess_quality({"x": aligned}, PERIOD, LIMITS)
    assert 0.0 <= quality.missing <= 1.0
    assert (quality.verdict is Verdict.GOOD) == (not quality.reasons)


@pytest.mark.parametrize("at", [0, 1, 40, 160, 199])
@pytest.mark.parametrize("late", [1e-5, 2e-4, 4e-3])
def test_a_repeated_frame_moves_no_other_sample(at: int, late: float) -> None:
    times = np.insert(ramp(200) * PERIOD, at + 1, at * PERIOD + late)
    values = np.insert(ramp(200), at + 1, float(at))
    aligned = align(times, values, 0.0, 200, PERIOD)
    assert np.array_equal(aligned.values, ramp(200))
    assert aligned.surplus == 1
    assert assess_quality({"x": aligned}, PERIOD, LIMITS).verdict is Verdict.GOOD


@pytest.mark.parametrize("apart", [0.001, 0.003])
def test_two_senders_of_a_signal_make_a_bad_window(apart: float) -> None:
    times = np.sort(np.concatenate([ramp(200) * PERIOD, ramp(200) * PERIOD + apart]))
    values = np.where(np.arange(400) % 2 == 0, 5.0, 6.0)
    quality = assess_quality({"x": align(times, values, 0.0, 200, PERIOD)}, PERIOD, LIMITS)
    assert quality.verdict is Verdict.BAD
    assert "do two nodes send it?" in quality.reasons[0]


def test_too_much_jitter_makes_a_bad_window() -> None:
    late = np.random.default_rng(0).uniform(0.0, 0.0045, 200)
    aligned = align(ramp(200) * PERIOD + late, ramp(200), 0.0, 200, PERIOD)
    quality = assess_quality({"x": aligned}, PERIOD, replace(LIMITS, jitter=0.002))
    assert quality.jitter == pytest.approx(np.sqrt(np.mean(late**2)))
    assert quality.verdict is Verdict.BAD
    assert "ms of jitter" in quality.reasons[0]


@pytest.mark.parametrize("surplus", [1, 20, 21, 22, 190])
def test_surplus_samples_are_dropped_up_to_a_limit(surplus: int) -> None:
    times = np.sort(np.concatenate([ramp(210) - 10.0, ramp(200)[-surplus:]])) * PERIOD
    aligned = align(times, times, 0.0, 200, PERIOD)
    assert aligned.surplus == min(surplus, 20)
    assert not aligned.missing.any()
    verdict = assess_quality({"x": aligned}, PERIOD, LIMITS).verdict
    assert verdict is (Verdict.GOOD if surplus == 1 else Verdict.BAD)


def test_skew_is_the_offset_between_signals() -> None:
    first, second = (align(ramp(200) * PERIOD + late, ramp(200), 0.0, 200, PERIOD) for late in (0.001, 0.003))
    assert assess_quality({"x": first, "y": second}, PERIOD, LIMITS).skew == pytest.approx(0.002)


def test_gaps_of_a_slower_signal_are_missing() -> None:
    times = np.delete(ramp(60) * 0.05, slice(20, 30))
    aligned = align(times, times, 0.0, 200, PERIOD)
    assert aligned.missing[96:149].all()
    assert not aligned.missing[:95].any()


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
def test_reasons_name_signal_and_value(keep: slice, sentence: str) -> None:
    aligned = align((ramp(200) * PERIOD)[keep], ramp(200)[keep], 0.0, 200, PERIOD)
    quality = assess_quality({"x": aligned}, PERIOD, LIMITS)
    assert quality.verdict is Verdict.BAD
    assert sentence in quality.reasons


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.004), st.floats(0.0, 0.002))
def test_polled_signals_are_interpolated_to_the_grid(seed: int, later: float, jitter: float) -> None:
    """Registers of different requests have different times, each that at which the value was true."""
    times = ramp(202) * PERIOD - PERIOD + later + np.random.default_rng(seed).uniform(0.0, jitter, 202)
    aligned = align_polled(times, np.sin(20.0 * times), 0.0, 200, PERIOD)
    assert not aligned.missing.any()
    assert aligned.values == pytest.approx(np.sin(20.0 * ramp(200) * PERIOD), abs=(20.0 * (PERIOD + jitter)) ** 2 / 8)


@given(st.sets(st.integers(2, 197), max_size=40))
def test_polled_readings_that_never_came_are_missing(lost: set[int]) -> None:
    kept = np.array([index for index in range(200) if index not in lost])
    aligned = align_polled(kept * PERIOD + 0.001, kept.astype(float), 0.0, 200, PERIOD)
    assert set(np.flatnonzero(aligned.missing).tolist()) == lost


def test_the_offset_of_a_polled_signal_is_no_jitter() -> None:
    aligned = {"x": align_polled(ramp(200) * PERIOD + 0.004, ramp(200), 0.0, 200, PERIOD)}
    assert assess_quality(aligned, PERIOD, replace(LIMITS, jitter=0.001), Sampling.POLLED).verdict is Verdict.GOOD
    assert assess_quality(aligned, PERIOD, replace(LIMITS, jitter=0.001), Sampling.CYCLIC).verdict is Verdict.BAD
