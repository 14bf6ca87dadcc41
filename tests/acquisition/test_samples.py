"""Samples of one signal: cleaned without inventing or losing any, how often they come, and aligned.

Aligned, cyclic samples return to the times at which they were taken, whatever delayed their arrival.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.quality import QualityLimits, assess_quality
from otolith.acquisition.records import Records, make_records
from otolith.acquisition.samples import (
    MAX_DROPPED_SAMPLES,
    MAX_VALUE,
    CyclicSeries,
    Series,
    SignalPlan,
    align,
    finite_samples,
    has_equal_times,
    interval_of,
    merge_equal_times,
    quantile_of,
    stale_repeats,
)
from otolith.acquisition.window import Array, GridSpan, Quality, Verdict
from otolith_drivers.base import Sampling
from tests.acquisition.series import ramp


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


@given(st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=60), st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]))
def test_a_quantile_is_that_of_numpy_bit_for_bit(values: list[float], share: float) -> None:
    assert quantile_of(np.array(values), share) == float(np.quantile(values, share))


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


PERIOD, RECORDS, GRACE = 0.01, 200, 0.1
SPAN = GridSpan(0.0, RECORDS, PERIOD)
LIMITS = QualityLimits(missing=0.05, gap=0.05)
PLANS = {"x": SignalPlan("x", sampling=Sampling.CYCLIC)}


def aligned(times: Array, values: Array, span: GridSpan = SPAN) -> CyclicSeries:
    return align(Series(times, values), span, GRACE)


def records_of(series: CyclicSeries, span: GridSpan = SPAN) -> Records:
    return make_records({"x": series.series}, PLANS, span)


def quality_of(series: CyclicSeries, limits: QualityLimits = LIMITS) -> Quality:
    return assess_quality(records_of(series), PLANS, {"x": series}, limits, SPAN)


def assert_restored(series: CyclicSeries, span: GridSpan = SPAN) -> None:
    """Each record has the value that was sampled at its time."""
    records = records_of(series, span)
    assert records.grid.period == PERIOD
    assert np.array_equal(records.values[:, 0], ramp(RECORDS))
    assert not records.missing.any()


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.003))
def test_arrival_jitter_does_not_change_values(seed: int, jitter: float) -> None:
    late = np.random.default_rng(seed).uniform(0.0, jitter, RECORDS)
    span = GridSpan(5.0, RECORDS, PERIOD)
    assert_restored(aligned(5.0 + ramp(RECORDS) * PERIOD + late, ramp(RECORDS), span), span)


@given(st.integers(10, 150), st.integers(2, 25))
def test_a_burst_after_a_stall_returns_to_its_slots(first: int, length: int) -> None:
    times = ramp(RECORDS) * PERIOD
    times[first : first + length] = times[first + length - 1] + 1e-5 * ramp(length)
    assert_restored(aligned(times, ramp(RECORDS)))


@given(st.sets(st.integers(1, 198), max_size=160))
def test_lost_samples_are_missing_and_move_no_other(lost: set[int]) -> None:
    kept = np.array([index for index in range(RECORDS) if index not in lost])
    records = records_of(aligned(kept * PERIOD, kept.astype(float)))
    assert set(np.flatnonzero(records.missing[:, 0]).tolist()) == lost
    assert np.array_equal(records.values[kept, 0], kept)


@given(
    st.lists(st.tuples(st.floats(-10.0, 10.0), st.floats(-1e300, 1e300)), max_size=60),
    st.integers(1, 50),
)
def test_any_samples_give_finite_values_and_a_verdict(samples: list[tuple[float, float]], records: int) -> None:
    samples.sort(key=lambda sample: sample[0])
    span = GridSpan(0.0, records, PERIOD)
    series = aligned(np.array([s[0] for s in samples]), np.array([s[1] for s in samples]), span)
    made = records_of(series, span)
    assert np.isfinite(made.values).all()
    assert np.isfinite(series.lateness).all()
    assert np.isfinite(series.irregularity)
    quality = assess_quality(made, PLANS, {"x": series}, LIMITS, span)
    assert 0.0 <= quality.missing <= 1.0
    assert (quality.verdict is Verdict.GOOD) == (not quality.reasons)


@pytest.mark.parametrize("at", [0, 1, 40, 160, 199])
@pytest.mark.parametrize("late", [1e-5, 2e-4, 4e-3])
def test_a_repeated_frame_moves_no_other_sample(at: int, late: float) -> None:
    times = np.insert(ramp(RECORDS) * PERIOD, at + 1, at * PERIOD + late)
    series = aligned(times, np.insert(ramp(RECORDS), at + 1, float(at)))
    assert_restored(series)
    assert series.surplus == 1
    assert quality_of(series).verdict is Verdict.GOOD


@pytest.mark.parametrize("apart", [0.001, 0.003])
def test_two_senders_of_a_signal_make_a_bad_window(apart: float) -> None:
    times = np.sort(np.concatenate([ramp(RECORDS) * PERIOD, ramp(RECORDS) * PERIOD + apart]))
    series = aligned(times, np.where(np.arange(2 * RECORDS) % 2 == 0, 5.0, 6.0))
    quality = quality_of(series)
    assert quality.verdict is Verdict.BAD
    assert "do two nodes send it?" in quality.reasons[0]
    assert "irregularity_limit" in quality.reasons[0]
    assert quality_of(series, replace(LIMITS, irregularity=1.0)).verdict is Verdict.GOOD


def test_too_much_jitter_makes_a_bad_window_if_a_sample_is_lost() -> None:
    """With a lost sample the slot of a late one is not certain; without one the order of all tells it."""
    late = np.random.default_rng(0).uniform(0.0, 0.0045, RECORDS)
    times, values = ramp(RECORDS) * PERIOD + late, ramp(RECORDS)
    whole = quality_of(aligned(times, values), replace(LIMITS, jitter=0.002))
    assert whole.jitter == pytest.approx(np.sqrt(np.mean(late**2)))
    assert whole.verdict is Verdict.GOOD
    quality = quality_of(aligned(np.delete(times, 80), np.delete(values, 80)), replace(LIMITS, jitter=0.002))
    assert quality.verdict is Verdict.BAD
    assert "ms of jitter, more than jitter_limit (2 ms)" in quality.reasons[0]


@pytest.mark.parametrize("stall", [0.02, 0.08])
def test_stalls_of_a_loaded_computer_refuse_no_window_without_a_loss(stall: float) -> None:
    """All frames of a stall arrive at its end, one after the other."""
    times = ramp(RECORDS) * PERIOD
    phase = (times - 0.05) % 0.2
    ends = (times - phase + stall) * (phase < stall)
    arrivals = np.maximum.accumulate(np.maximum(times, ends)) + 1e-5 * ramp(RECORDS)
    series = aligned(arrivals, ramp(RECORDS))
    assert_restored(series)
    assert quality_of(series).verdict is Verdict.GOOD


@pytest.mark.parametrize("surplus", [1, 20, 21, 22, 190])
def test_surplus_samples_are_dropped_up_to_a_limit(surplus: int) -> None:
    times = np.sort(np.concatenate([ramp(RECORDS + 10) - 10.0, ramp(RECORDS)[-surplus:]])) * PERIOD
    series = aligned(times, times)
    assert series.surplus == min(surplus, MAX_DROPPED_SAMPLES)
    assert not records_of(series).missing.any()
    assert quality_of(series).verdict is (Verdict.GOOD if surplus == 1 else Verdict.BAD)


def test_skew_is_the_offset_between_signals() -> None:
    series = {
        name: aligned(ramp(RECORDS) * PERIOD + late, ramp(RECORDS)) for name, late in (("x", 0.001), ("y", 0.003))
    }
    plans = {name: SignalPlan(name, sampling=Sampling.CYCLIC) for name in series}
    records = make_records({name: item.series for name, item in series.items()}, plans, SPAN)
    assert assess_quality(records, plans, series, LIMITS, SPAN).skew == pytest.approx(0.002)


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 5, 10]), st.floats(0.0, 0.15), st.integers(0, 9))
def test_a_slower_signal_has_slots_of_its_own_on_the_grid(seed: int, multiple: int, jitter: float, first: int) -> None:
    """Its samples are never late by less than the most punctual ones, and none is interpolated."""
    random = np.random.default_rng(seed)
    period, count = multiple * PERIOD, 3 * RECORDS // multiple
    late = random.uniform(0.0, jitter * PERIOD, count)
    taken = first * PERIOD + ramp(count) * period - SPAN.length
    series = aligned(taken + late, ramp(count))
    assert series.on_grid
    assert series.series.times == pytest.approx(taken, abs=1e-9)
    records = records_of(series)
    present = np.flatnonzero(~records.missing[:, 0])
    assert np.array_equal(np.diff(present), np.full(len(present) - 1, multiple))
    assert np.array_equal(np.diff(records.values[present, 0]), np.ones(len(present) - 1))


@pytest.mark.parametrize("jitter", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("lost", [0.0, 0.1, 0.4])
def test_the_clock_of_a_slower_signal_is_found_despite_jitter_and_loss(jitter: float, lost: float) -> None:
    """Arrivals that are late by up to a tenth of the period, of which some never come."""
    random, period = np.random.default_rng(4), 0.047
    kept = np.flatnonzero(random.random(120) >= lost)
    taken = kept * period - SPAN.length
    series = aligned(taken + random.uniform(0.0, jitter * period, len(kept)), kept.astype(float))
    assert np.array_equal(series.series.values, kept)
    error, allowed = series.series.times - taken, 3.0 * jitter * period / np.sqrt(len(kept)) + 1e-9
    assert np.ptp(error) < allowed
    assert np.abs(error).max() < 0.1 * jitter * period + allowed


@pytest.mark.parametrize("lost", [0.05, 0.2, 0.5])
def test_lost_samples_of_a_slower_signal_are_no_second_sender(lost: float) -> None:
    for seed in range(20):
        kept = ramp(120)[np.random.default_rng(seed).random(120) >= lost]
        quality = quality_of(aligned(kept * 0.05 - SPAN.length, kept), QualityLimits())
        assert quality.verdict is Verdict.GOOD, quality.reasons


@pytest.mark.parametrize(
    ("keep", "sentence"),
    [
        (slice(0, 0), "no samples of x from t = 0 s for 2 s: is the source on, and is its signal right in [signals]?"),
        (slice(0, 100), "50% of x is missing, more than missing_limit (5%)"),
        (np.r_[0:100, 108:200], "x has no sample for 0.08 s from t = 1 s, longer than gap_limit (0.05 s)"),
    ],
)
def test_reasons_name_signal_time_length_and_limit(keep: slice, sentence: str) -> None:
    quality = quality_of(aligned((ramp(RECORDS) * PERIOD)[keep], ramp(RECORDS)[keep]))
    assert quality.verdict is Verdict.BAD
    assert sentence in quality.reasons


def test_samples_around_a_window_that_arrive_at_once_are_one() -> None:
    """A sample long before the window, and one after it, each arrive twice at the same time."""
    inside = PERIOD * np.arange(RECORDS)
    times = np.concatenate([[-1.0, -1.0], inside, [3.0, 3.0]])
    series = aligned(times, np.arange(len(times), dtype=float)).series
    assert (np.diff(series.times) > 0.0).all()
    assert series.times[0] == -1.0
    assert series.values[0] == 1.0
