"""Records: each sample at its own time, whatever the times; nothing but inputs between samples."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from otolith.acquisition.playback import Playback
from otolith.acquisition.records import Records, make_records
from otolith.acquisition.samples import (
    EARLY,
    ON_GRID,
    Series,
    SignalPlan,
    finite_samples,
    lies_on_grid,
    merge_equal_times,
    phase_of_grid,
)
from otolith.acquisition.window import Array, GridSpan, Verdict, Window
from otolith_drivers.base import Sampling
from otolith_drivers.replay.readers import Rows
from tests.acquisition.series import ramp

PERIOD, RECORDS = 0.01, 50
SPAN = GridSpan(0.0, RECORDS, PERIOD)
OUTPUT, COMMAND, MEASURED = SignalPlan("y"), SignalPlan("u", "zoh"), SignalPlan("v", "foh", noise=0.01)
PLANS = {plan.name: plan for plan in (OUTPUT, COMMAND, MEASURED)}

TIMES = st.one_of(
    st.floats(-1.0, 2.0),
    st.integers(-100, 200).map(lambda slot: slot * PERIOD),
    st.sampled_from([0.0, 1e-12, 0.5, 0.5 - 1e-6, 0.0049999]),
)
VALUES = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-10.0, 10.0), st.sampled_from([0.0, 1.0]))
SAMPLES = st.lists(st.tuples(TIMES, VALUES), max_size=80)


def series_of(samples: list[tuple[float, float]], hold: str | None = None) -> Series:
    ordered = sorted(samples, key=lambda sample: sample[0])
    times, values = (np.array([sample[part] for sample in ordered]) for part in (0, 1))
    return merge_equal_times(*finite_samples(times, values), hold)


def at(times: Array, plan: SignalPlan = OUTPUT, values: Array | None = None, **others: Series) -> Records:
    """Records of a window in which one signal has samples at ``times``."""
    series = {plan.name: Series(times, np.sin(times) if values is None else values), **others}
    return make_records(series, {name: PLANS[name] if name != plan.name else plan for name in series}, SPAN)


def assert_sound(records: Records, length: float) -> None:
    grid = records.grid
    assert grid.records == len(records.values) == len(records.missing) >= 1
    assert grid.offsets[0] == 0.0
    assert (np.diff(grid.offsets) > 0.0).all()
    assert (grid.steps >= 0.0).all()
    assert grid.offsets[-1] + grid.steps[-1] == pytest.approx(length)
    assert np.isfinite(records.values).all()
    if records.bridge_error is not None:
        error = records.bridge_error
        assert (error.noise_ratio >= 1.0 - 1e-9).all()
        for variance in (error.noise_ratio, error.variance, error.held_variance):
            assert np.isfinite(variance).all()
            assert (variance >= 0.0).all()


@settings(max_examples=300)
@given(SAMPLES, SAMPLES, SAMPLES)
def test_any_samples_give_sound_records(
    outputs: list[tuple[float, float]], commands: list[tuple[float, float]], measured: list[tuple[float, float]]
) -> None:
    samples = {"y": outputs, "u": commands, "v": measured}
    series = {name: series_of(samples[name], PLANS[name].hold) for name in samples}
    records = make_records(series, PLANS, SPAN)
    assert_sound(records, SPAN.length)
    end = SPAN.end - EARLY * PERIOD
    assert records.unknown == {name for name in ("u", "v") if not (series[name].times < end).any()}
    at_own = ~records.missing[:, 0]
    assert np.isin(records.values[at_own, 0], series["y"].values).all()


ROWS = st.lists(st.tuples(TIMES.map(lambda time: 4.0 * time), VALUES, VALUES, VALUES), min_size=1, max_size=120)


@settings(max_examples=200)
@given(ROWS, st.sampled_from(Sampling), st.booleans(), st.sampled_from([0.0, 0.004, 0.3]))
def test_any_log_gives_sound_windows_in_order(
    rows: list[tuple[float, float, float, float]], sampling: Sampling, ordered: bool, delay: float
) -> None:
    table = np.array(sorted(rows, key=lambda row: row[0]) if ordered else rows)
    count = np.arange(len(table))
    log = Rows(table[:, 0], dict(zip(PLANS, table[:, 1:].T, strict=True)), count + 2, 0 * count)
    plans = [replace(plan, sampling=sampling, delay=delay * (plan is OUTPUT)) for plan in PLANS.values()]
    playback = Playback(plans, RECORDS, PERIOD)
    windows = [*playback.windows(log), *playback.rest()]
    for window in windows:
        records = Records(window.grid, window.values, window.missing, window.bridge_error, 0, frozenset(), frozenset())
        assert_sound(records, SPAN.length)
        assert 0.0 <= window.quality.missing <= 1.0
        assert np.isfinite([window.quality.longest_gap, window.quality.jitter, window.quality.skew]).all()
        assert (window.quality.verdict is Verdict.GOOD) == (not window.quality.reasons)
    if not playback.counts.segments and sampling is Sampling.TRUE:
        starts = np.array([window.start for window in windows])
        assert (np.diff(starts) >= SPAN.length - 1e-6).all()  # no sample is in two windows


def play(times: Array, values: Array | None = None, plan: SignalPlan = OUTPUT) -> list[Window]:
    count = np.arange(len(times))
    log = Rows(times, {plan.name: count.astype(float) if values is None else values}, count + 2, 0 * count)
    playback = Playback([plan], RECORDS, PERIOD)
    return [*playback.windows(log), *playback.rest()]


def used(windows: list[Window]) -> Array:
    return np.concatenate([window.values[~window.missing[:, 0], 0] for window in windows])


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0107, 0.0035, 0.01, 0.02, 1 / 150, 1 / 60]),
    st.sampled_from([0.0, 1e-6, 1e-5, 1e-4]),
    st.sampled_from([0.0, 0.3, 0.8]),
)
def test_each_sample_at_a_true_time_is_in_one_record(
    seed: int, interval: float, resolution: float, lost: float
) -> None:
    """Whatever the interval, the resolution of the clock of the log, and the loss."""
    random = np.random.default_rng(seed)
    times = np.flatnonzero(random.random(500) >= lost).astype(np.float64) * interval + random.uniform(0.0, 1.0)
    times = np.round(times / resolution) * resolution if resolution else times
    assume(np.diff(times).max() < SPAN.length)
    windows = play(times)
    values = used(windows)
    assert len(values) > 0
    assert np.array_equal(values, values[0] + np.arange(len(values)))
    for window in windows:
        stated = times[window.values[~window.missing[:, 0], 0].astype(int)]
        offsets = window.grid.offsets[~window.missing[:, 0]]
        assert window.start + offsets == pytest.approx(stated, abs=2.1 * ON_GRID * PERIOD)


@given(st.floats(-0.9, 0.9), st.integers(20, 180))
def test_a_clock_that_steps_moves_no_sample_into_two_windows(step: float, at_sample: int) -> None:
    times = np.arange(300.0) * PERIOD
    times[at_sample:] += step * PERIOD
    values = used(play(times))
    assert np.array_equal(values, np.arange(float(len(values))))


def test_the_grid_takes_the_phase_of_the_samples_after_a_pause() -> None:
    times = np.arange(400.0) * PERIOD
    times[170:] += 0.104 + 0.31 * PERIOD
    windows = play(times)
    uniform = [window.grid.period is not None for window in windows]
    assert uniform.count(False) == 1  # the window with the pause
    for window in windows:
        stated = times[window.values[~window.missing[:, 0], 0].astype(int)]
        assert window.start + window.grid.offsets[~window.missing[:, 0]] == pytest.approx(stated, abs=1e-7)


@given(st.floats(-0.5, 0.5), st.integers(2, 60))
def test_the_phase_of_a_grid_is_that_of_all_its_times(phase: float, count: int) -> None:
    found_phase = phase_of_grid((ramp(count) + phase) * PERIOD, 0.0, PERIOD)
    assert found_phase is not None
    turns = found_phase / PERIOD - phase
    assert turns == pytest.approx(round(turns), abs=1e-6)
    assert phase_of_grid(np.cumsum(np.linspace(0.3, 0.9, count + 2)) * PERIOD, 0.0, PERIOD) is None
    assert lies_on_grid(ramp(count) * PERIOD, 0.0, PERIOD)


def test_records_are_the_union_of_sample_times() -> None:
    fast, slow = np.arange(0.0, 0.5, 0.007), np.arange(0.0031, 0.5, 0.05)
    records = at(fast, v=Series(slow, np.cos(slow)), u=Series(np.array([-1.0, 0.2]), np.array([1.0, 2.0])))
    assert records.grid.offsets == pytest.approx(np.unique(np.concatenate([fast, slow, [0.2]])))
    assert int((~records.missing[:, 0]).sum()) == len(fast)
    command = records.values[:, 2]
    assert np.array_equal(command, np.where(records.grid.offsets < 0.2 - 1e-9, 1.0, 2.0))


def test_a_uniform_log_keeps_the_uniform_grid() -> None:
    times = ramp(RECORDS) * PERIOD
    records = at(times, v=Series(times, np.cos(times)), u=Series(times, np.sin(times)))
    assert records.grid.period == PERIOD
    assert records.bridge_error is None
    assert not records.missing.any()
    slow = at(times[::5], v=Series(times, np.cos(times)), u=Series(times, np.sin(times)))
    assert slow.grid.period == PERIOD
    assert slow.missing[:, 0].mean() == pytest.approx(0.8)
    assert slow.bridge_error is None


def test_an_output_is_never_interpolated() -> None:
    times = np.array([0.0, 0.013, 0.3])
    records = at(times, v=Series(ramp(RECORDS) * PERIOD, np.ones(RECORDS)))
    present = ~records.missing[:, 0]
    assert records.grid.offsets[present] == pytest.approx(times)
    assert records.values[present, 0] == pytest.approx(np.sin(times))


def test_a_command_that_never_had_a_sample_is_unknown() -> None:
    times = ramp(RECORDS) * PERIOD
    none = Series(np.zeros(0), np.zeros(0))
    assert at(times, u=none).unknown == {"u"}
    assert at(times, u=Series(np.array([-0.7]), np.array([3.0]))).unknown == set()
    assert (at(times, u=Series(np.array([-0.7]), np.array([3.0]))).values[:, 1] == 3.0).all()


def test_the_grid_follows_a_clock_whose_signals_are_all_delayed() -> None:
    """After 200 windows a clock that is 200 ppm fast would be off the grid by eight periods."""
    delay, drift, count = 0.035, 2e-4, 200 * RECORDS
    own = ramp(count) * (PERIOD * (1.0 + drift))
    times = own + delay
    log = Rows(times, {"x": np.sin(own), "y": np.cos(own)}, np.arange(count) + 2, np.zeros(count, dtype=np.int64))
    plans = [SignalPlan(name, sampling=Sampling.CYCLIC, delay=delay) for name in ("x", "y")]
    playback = Playback(plans, RECORDS, PERIOD)
    windows = [*playback.windows(log), *playback.rest()]
    assert len(windows) >= 198
    for window in windows:
        assert window.grid.period is not None
        assert not window.missing.any()
        assert window.quality.jitter < 0.01 * PERIOD
        expected = np.sin(window.start + window.grid.offsets)
        assert window.column("x") == pytest.approx(expected, abs=2.0 * drift * RECORDS * PERIOD + 1e-3)


def test_a_polled_command_may_change_after_its_last_reading_in_a_window() -> None:
    """The first reading after the window differs; outputs come with requests of their own."""
    polls, outputs = ramp(300) * 0.02, ramp(300) * 0.02 + 0.007
    command = np.where(polls < SPAN.length + 0.001, 1.0, 4.0)
    series = {"u": Series(polls, command), "x": Series(outputs, np.sin(outputs))}
    plans = {"u": SignalPlan("u", "zoh", sampling=Sampling.POLLED), "x": SignalPlan("x", sampling=Sampling.POLLED)}
    records = make_records(series, plans, GridSpan(SPAN.start + 0.01, SPAN.records, SPAN.period))
    last = float(polls[command == 1.0][-1])
    assert np.abs(records.grid.offsets + SPAN.start + 0.01 - last).min() < 1e-9
    assert records.bridge_error is not None
    assert records.bridge_error.expected_change[-1, 0] > 0.0


@pytest.mark.parametrize("read", [2, 5])
def test_a_polled_command_is_recorded_as_it_was_read(read: int) -> None:
    """The value of a record allows for a change before the next reading; the reading is kept."""
    random = np.random.default_rng(3)
    times = np.arange(400.0) * PERIOD
    command = np.where(np.arange(400) % read == 0, np.repeat(random.normal(size=80), 5), np.nan)
    log = Rows(times, {"u": command, "x": np.sin(times)}, np.arange(400) + 2, np.zeros(400, dtype=np.int64))
    playback = Playback([SignalPlan("u", "zoh", sampling=Sampling.POLLED), SignalPlan("x")], RECORDS, PERIOD)
    windows = [*playback.windows(log), *playback.rest()]
    assert len(windows) >= 7
    for window in windows:
        present = ~window.missing_in("u")
        at = np.rint((window.start + window.grid.offsets) / PERIOD).astype(int)
        assert window.readings("u")[present] == pytest.approx(command[at[present]], abs=1e-12)
        assert not np.allclose(window.column("u"), window.readings("u"))
        assert window.bridge_error is not None
        assert window.bridge_error.held_variance[:, 0].any()


@pytest.mark.parametrize("delay", [0.0035, 0.01, 0.035])
def test_a_delay_of_a_cyclic_signal_is_kept_to_the_fraction_of_a_period(delay: float) -> None:
    late = np.random.default_rng(1).uniform(0.0, 0.001, 800)
    times = np.repeat(np.arange(400.0) * PERIOD, 2) + np.tile([0.0, delay], 400)
    is_y = np.tile([False, True], 400)
    order = np.argsort(times + late, kind="stable")
    true = np.sin(times - np.where(is_y, delay, 0.0))
    x, y = np.where(is_y, np.nan, true)[order], np.where(is_y, true, np.nan)[order]
    log = Rows((times + late)[order], {"x": x, "y": y}, np.arange(800) + 2, np.zeros(800, dtype=np.int64))
    playback = Playback(
        [SignalPlan("x", sampling=Sampling.CYCLIC), SignalPlan("y", sampling=Sampling.CYCLIC, delay=delay)],
        RECORDS,
        PERIOD,
    )
    windows = [*playback.windows(log), *playback.rest()]
    assert len(windows) >= 6
    for window in windows:
        expected = np.sin(window.start + window.grid.offsets)
        for name in ("x", "y"):
            present = ~window.missing_in(name)
            assert present.sum() in (
                (RECORDS,) if window.index else (RECORDS - 1, RECORDS)
            )  # the first one may begin before y
            assert window.column(name)[present] == pytest.approx(expected[present], abs=8e-4)


def test_the_delay_of_a_signal_is_subtracted_from_its_times() -> None:
    times = np.arange(400.0) * PERIOD
    delayed = times + 0.035
    both = np.concatenate([times, delayed])
    order = np.argsort(both, kind="stable")
    plain = np.where(np.arange(800) < 400, np.sin(both), np.nan)[order]
    late = np.where(np.arange(800) >= 400, np.sin(both - 0.035), np.nan)[order]
    log = Rows(both[order], {"x": plain, "y": late}, np.arange(800) + 2, np.zeros(800, dtype=np.int64))
    playback = Playback([SignalPlan("x"), SignalPlan("y", delay=0.035)], RECORDS, PERIOD)
    windows = [*playback.windows(log), *playback.rest()]
    assert len(windows) >= 7
    for window in windows:
        assert not window.missing.any()
        assert window.column("x") == pytest.approx(window.column("y"), abs=1e-9)
        assert window.column("x") == pytest.approx(np.sin(window.start + window.grid.offsets), abs=1e-9)


def test_a_log_much_faster_than_the_grid_keeps_its_samples() -> None:
    """10 kHz with a sample period of 1 s: only those at the very start share its record."""
    span, times = GridSpan(0.0, 10, 1.0), 1e-4 * ramp(100_000) + 3e-5
    records = make_records({"y": Series(times, times)}, {"y": OUTPUT}, span)
    assert (~records.missing).sum() > 0.99 * len(times)
