"""Bridged inputs: the stated variances are those of what can happen between the samples, by Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.bridging import (
    BridgedInput,
    InputKind,
    InputSamples,
    LostIntervals,
    OtherSamples,
    bridge,
    curve_variance,
    kind_of,
    line_variance,
    lost_samples,
)
from otolith.acquisition.samples import Interval, Series, SignalPlan, interval_of
from otolith.acquisition.window import Array
from otolith_drivers.base import Sampling
from tests.acquisition.series import ramp

PERIOD, DRAWS = 0.01, 20_000
COMMAND, SAMPLED = SignalPlan("u", "zoh"), SignalPlan("u", "zoh", on_change=False)
POLLED = SignalPlan("u", "zoh", Sampling.POLLED)
MEASURED = SignalPlan("v", "foh")
NO_OTHERS = OtherSamples(np.zeros(0), Interval(np.inf, np.inf))
WITHIN = 4.0 * np.sqrt(2.0 / DRAWS)  # of a variance: four standard deviations of its estimate from DRAWS normal numbers


def bridged(times: Array, values: Array, plan: SignalPlan, at: Array, steps: Array) -> BridgedInput:
    series = Series(times, values)
    return bridged_among(series, kind_of(plan, values), OtherSamples(times, interval_of(times)), at, steps)


def bridged_among(series: Series, kind: InputKind, others: OtherSamples, at: Array, steps: Array) -> BridgedInput:
    own = interval_of(series.times)
    return bridge(InputSamples(series, kind, 0.0, own, lost_samples(series, kind, own, others)), at, steps)


def variance_of_integral(result: BridgedInput, steps: Array) -> float:
    """Return that of independent errors of the records."""
    return float(np.sum(result.error.held_variance * steps**2))


@pytest.mark.parametrize("lost", [1, 2, 9])
@pytest.mark.parametrize("plan", [COMMAND, SAMPLED], ids=["on change", "sampled"])
def test_the_variance_of_a_lost_command_is_that_of_random_change_instants(lost: int, plan: SignalPlan) -> None:
    """It changed once, at any of the lost instants or at the next sample."""
    before, after, at = ramp(30) * PERIOD, 29 * PERIOD + (lost + 1) * PERIOD, ramp(lost + 1)
    times = np.concatenate([before, after + ramp(30) * PERIOD])
    values = np.where(times < after - PERIOD / 2, 1.0, 4.0)
    records = 29 * PERIOD + at * PERIOD
    steps = np.full(lost + 1, PERIOD)
    if plan is COMMAND:  # its samples are those at which it changes, and the other signals have gaps
        series = Series(np.array([0.0, after]), np.array([1.0, 4.0]))
        others = OtherSamples(times, interval_of(times))
        result = bridged_among(series, InputKind.ON_CHANGE, others, records, steps)
    else:
        result = bridged(times, values, plan, records, steps)
    changes = np.random.default_rng(1).integers(1, lost + 2, DRAWS)
    truth = np.where(at[None, :] >= changes[:, None], 4.0, 1.0)
    assert result.values == pytest.approx(truth.mean(axis=0), abs=4.0 * 1.5 / np.sqrt(DRAWS))
    assert result.error.variance == pytest.approx(truth.var(axis=0), abs=9.0 * WITHIN)
    integral = ((truth - result.values) * steps).sum(axis=1)
    assert variance_of_integral(result, steps) == pytest.approx(np.mean(integral**2), rel=2.0 * WITHIN)


@pytest.mark.parametrize("records", [1, 2, 4])
def test_a_polled_command_may_change_at_any_instant_between_two_readings(records: int) -> None:
    """Mean and variance over uniform instants: of the value, and of the integral over the interval."""
    random, polls = np.random.default_rng(1), ramp(20) * PERIOD
    step = PERIOD / records
    values = np.where(ramp(20) < 10, 1.0, 4.0)
    within = ramp(records) * step
    steps = np.full(records, step)
    result = bridged(polls, values, POLLED, 9 * PERIOD + within, steps)
    changes = random.uniform(0.0, PERIOD, DRAWS)
    means = 1.0 + 3.0 * np.clip((within[None, :] + step - changes[:, None]) / step, 0.0, 1.0)  # over each step
    assert result.values == pytest.approx(means.mean(axis=0), abs=4.0 * 1.5 / np.sqrt(DRAWS))
    at_record = np.where(changes[:, None] <= within[None, :], 4.0, 1.0)
    assert result.error.variance == pytest.approx(np.mean((at_record - result.values) ** 2, axis=0), rel=2.0 * WITHIN)
    integral = ((means - result.values) * steps).sum(axis=1)
    assert variance_of_integral(result, steps) == pytest.approx(integral.var(), rel=2.0 * WITHIN)
    assert result.values - result.error.expected_change == pytest.approx(np.ones(records))


def test_a_polled_command_that_keeps_its_value_is_exact() -> None:
    polls = ramp(20) * PERIOD
    result = bridged(polls, np.where(ramp(20) < 10, 1.0, 4.0), POLLED, polls[:9], np.full(9, PERIOD))
    assert (result.values == 1.0).all()
    assert not result.error.variance.any()
    assert not result.error.held_variance.any()


def test_a_polled_command_is_exact_where_both_readings_are_equal() -> None:
    """However long the step of a record is, and before the first reading no change is expected."""
    polls = ramp(20) * PERIOD
    values = np.where(ramp(20) < 15, 1.0, 4.0)
    result = bridged(polls, values, POLLED, np.array([2.0, 12.0]) * PERIOD, np.array([10.0, 1.0]) * PERIOD)
    assert not result.error.held_variance.any()
    early = bridged(polls[14:], values[14:], POLLED, polls[10:13], np.full(3, PERIOD))
    assert (early.values == 1.0).all()
    assert not early.error.expected_change.any()


def test_the_variance_of_a_lost_command_that_always_changes_is_that_of_a_random_walk() -> None:
    random, lost = np.random.default_rng(2), 9
    walks = np.cumsum(random.normal(size=(DRAWS, lost + 1)), axis=1)
    ends = walks[:, -1:]
    share = ramp(lost + 1) / (lost + 1)
    truth = np.concatenate([np.zeros((DRAWS, 1)), walks[:, :-1]], axis=1) - share * ends  # given both ends
    times = np.concatenate([ramp(400), 399 + lost + 1 + ramp(400)]) * PERIOD
    values = np.cumsum(random.normal(size=800))
    values[400:] += values[399] - values[400]  # the walk comes back to where it was: its ends show no change
    steps = np.full(lost + 1, PERIOD)
    result = bridged(times, values, SAMPLED, (399 + ramp(lost + 1)) * PERIOD, steps)
    assert result.error.variance[1:] == pytest.approx(
        truth.var(axis=0)[1:], rel=0.25
    )  # of the walk's own scale: 800 samples
    integral = (truth * steps).sum(axis=1)
    assert variance_of_integral(result, steps) == pytest.approx(np.mean(integral**2), rel=0.25)


def bridges(random: np.random.Generator, count: int) -> Array:
    """Return random walks of ``count`` steps of variance one that end where they began, (DRAWS, count)."""
    walks = np.cumsum(random.normal(size=(DRAWS, count)), axis=1)
    return np.concatenate([np.zeros((DRAWS, 1)), walks[:, :-1] - walks[:, -1:] * np.arange(1, count) / count], axis=1)


@pytest.mark.parametrize("between", [5, 20])
def test_the_variance_of_a_line_through_a_random_walk(between: int) -> None:
    random = np.random.default_rng(3)
    walk = np.cumsum(random.normal(size=between * 2000))
    times = ramp(2000) * between * PERIOD
    at = times[1000] + np.arange(between) * PERIOD
    steps = np.full(between, PERIOD)
    result = bridged(times, walk[::between], MEASURED, at, steps)
    truth = bridges(random, between)
    assert result.error.variance[0] == 0.0
    assert result.error.variance[1:] == pytest.approx(
        truth.var(axis=0)[1:], rel=0.15
    )  # of a walk's scale from 2000 samples
    integral = (truth * steps).sum(axis=1)
    assert variance_of_integral(result, steps) == pytest.approx(np.mean(integral**2), rel=0.2)


def test_the_line_variance_follows_the_length_of_the_line() -> None:
    """A gap of eight intervals in a random walk: eight times the variance; in a smooth curve 8**4 times."""
    random, noise = np.random.default_rng(4), 0.002
    times = np.arange(4000.0)
    walk = line_variance(Series(times, np.cumsum(random.normal(size=4000))), 0.0)
    smooth = line_variance(Series(times, np.sin(times / 8.0) + noise * random.normal(size=4000)), noise)
    for length in (1.0, 8.0):
        assert float(walk(np.array([length]))[0]) == pytest.approx(length / 4.0, rel=0.2)
    curvature = 0.5 / 8.0**4  # mean square of the second derivative of the sine
    for length in (2.0, 8.0):
        assert float(smooth(np.array([length]))[0]) == pytest.approx(curvature * length**4 / 64.0, rel=0.3)


@pytest.mark.parametrize("missing", [0.3, 0.8])
def test_the_variance_of_a_walk_is_right_between_samples_at_any_times(missing: float) -> None:
    random, stated, true = np.random.default_rng(8), 0.0, 0.0
    for _ in range(20):
        times = np.flatnonzero(random.uniform(size=4000) >= missing).astype(float)
        walk = np.cumsum(random.normal(size=len(times)) * np.sqrt(np.diff(times, prepend=-1.0)))
        lengths = np.diff(times)
        stated += float(line_variance(Series(times, walk), 0.0)(lengths) @ lengths**2)
        true += float(lengths / 4.0 @ lengths**2)
    assert stated == pytest.approx(true, rel=0.1)


@pytest.mark.parametrize("missing", [0.0, 0.5])
@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_a_smooth_quantity_is_bridged_by_a_curve(missing: float, noise: float) -> None:
    """A line through a sine is wrong in one direction for half a period, like another moment of inertia of a motor."""
    random, frequency = np.random.default_rng(9), 6.0
    squares, stated, of_line = [], [], []
    for phase in random.uniform(0.0, 2.0 * np.pi, 50):
        times = 0.05 * np.flatnonzero(random.uniform(size=round(46 / (1.0 - missing))) >= missing).astype(float)
        values = np.sin(frequency * times + phase) + noise * random.normal(size=len(times))
        at = np.arange(times[0], times[-1], PERIOD)
        own = interval_of(times)
        lost = lost_samples(Series(times, values), InputKind.LINE, own, NO_OTHERS)
        samples = InputSamples(Series(times, values), InputKind.LINE, noise, own, lost)
        result, truth = bridge(samples, at, np.full(len(at), PERIOD)), np.sin(frequency * at + phase)
        squares.append(np.mean((result.values - result.error.expected_change - truth) ** 2))
        stated.append(np.mean(result.error.variance))
        of_line.append(np.mean((np.interp(at, times, values) - truth) ** 2))
    assert np.mean(squares) < np.mean(of_line) / 10.0
    assert np.mean(squares) < 4.0 * (np.mean(stated) + noise**2)


def test_no_curve_goes_far_beyond_the_samples() -> None:
    """Where steps of 10 ms and of an hour follow each other, a spline overshoots a hundredfold."""
    random = np.random.default_rng(11)
    for _ in range(200):
        times = np.cumsum(random.choice([1e-6, 0.01, 3600.0], 60))
        values = np.sin(random.uniform(6.0, 30.0) * times / times[-1])
        own, series = interval_of(times), Series(times, values)
        samples = InputSamples(series, InputKind.LINE, 0.0, own, lost_samples(series, InputKind.LINE, own, NO_OTHERS))
        at = np.linspace(times[0], times[-1], 200)
        assert np.abs(bridge(samples, at, np.full(len(at), 0.01)).values).max() < 3.0


def test_only_a_smooth_quantity_is_a_curve() -> None:
    random, times = np.random.default_rng(10), 0.05 * np.arange(40.0)
    rough: list[Array] = [
        np.cumsum(random.normal(size=40)),
        random.normal(size=40),
        np.where(times > 1.02, 1.0, 0.0),
        np.round(100.0 * np.sin(times)),
        np.zeros(40),
    ]
    assert all(curve_variance(Series(times, values), 0.0) is None for values in rough)
    smooth = curve_variance(Series(times, np.sin(6.0 * times)), 0.0)
    assert smooth is not None
    line = line_variance(Series(times, np.sin(6.0 * times)), 0.0)
    assert float(smooth(np.array([0.05]))[0]) < float(line(np.array([0.05]))[0]) / 100.0


@pytest.mark.parametrize("late", [5, 40])
def test_the_variance_after_the_last_sample_is_that_of_a_random_walk(late: int) -> None:
    random = np.random.default_rng(5)
    values = np.cumsum(random.normal(size=4000))
    at = (3999 + ramp(late)) * PERIOD
    steps = np.full(late, PERIOD)
    result = bridged(ramp(4000) * PERIOD, values, MEASURED, at, steps)
    walks = np.concatenate([np.zeros((DRAWS, 1)), np.cumsum(random.normal(size=(DRAWS, late - 1)), axis=1)], axis=1)
    assert np.array_equal(result.values, np.full(late, values[-1]))
    assert result.error.variance == pytest.approx(walks.var(axis=0), rel=0.1, abs=1e-9)
    integral = (walks * steps).sum(axis=1)
    assert variance_of_integral(result, steps) == pytest.approx(np.mean(integral**2), rel=0.15)


def test_before_its_first_sample_an_input_is_uncertain() -> None:
    random = np.random.default_rng(6)
    values = np.cumsum(random.normal(size=4000))
    at, steps = (ramp(40) - 40) * PERIOD, np.full(40, PERIOD)
    for plan in (MEASURED, SAMPLED, COMMAND):
        result = bridged(ramp(4000) * PERIOD, values, plan, at, steps)
        assert np.array_equal(result.values, np.full(40, values[0]))
        assert result.error.variance == pytest.approx(40.0 - np.arange(40.0), rel=0.15)


def test_the_noise_of_samples_that_are_far_apart_lasts_longer() -> None:
    """The noise of a sample disturbs the states for the whole time between two samples."""
    random, between = np.random.default_rng(7), 10
    times, steps = np.arange(0.0, 200.0, between) * PERIOD, np.full(150, PERIOD)
    at = ramp(150) * PERIOD
    noise = random.normal(size=(DRAWS, len(times)))
    integrals = np.array([np.sum(np.interp(at, times, row) * steps) for row in noise[:4000]])
    result = bridged(times, np.zeros(len(times)), MEASURED, at, steps)
    assert result.error.noise_ratio == pytest.approx(between)
    assert np.sum(result.error.noise_ratio * steps**2) == pytest.approx(np.var(integrals), rel=0.1)


def test_a_command_that_is_recorded_on_change_is_exact_while_it_holds() -> None:
    """Other signals have their samples, so no change was lost; and a command of its own clock loses none at all."""
    series = Series(np.array([0.0, 0.5, 1.5]), np.array([1.0, 2.0, 0.5]))
    at = np.arange(0.0, 2.0, PERIOD)
    others = OtherSamples(at, Interval(PERIOD, 1.5 * PERIOD))
    assert kind_of(COMMAND, series.values) is InputKind.ON_CHANGE
    for other in (others, NO_OTHERS, OtherSamples(at[::7] + 0.003, Interval(0.07, 0.1))):
        result = bridged_among(series, InputKind.ON_CHANGE, other, at, np.full(len(at), PERIOD))
        assert np.array_equal(result.values, np.where(at < 0.5, 1.0, np.where(at < 1.5, 2.0, 0.5)))
        assert not result.error.variance.any()
        assert not result.error.held_variance.any()


def test_the_machine_file_says_whether_a_command_is_recorded_on_change() -> None:
    repeated = np.array([1.0, 1.0, 2.0])
    assert kind_of(COMMAND, repeated) is InputKind.SAMPLED
    for sampling in Sampling:
        assert kind_of(SignalPlan("u", "zoh", sampling, on_change=True), repeated) is InputKind.ON_CHANGE
    assert kind_of(SAMPLED, np.array([1.0, 2.0])) is InputKind.SAMPLED
    assert kind_of(POLLED, np.array([1.0, 2.0])) is InputKind.POLLED


@given(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=8, unique=True), st.floats(-1.0, 11.0), st.floats(0.0, 3.0))
def test_lost_instants_are_between_the_samples_around_them(edges: list[float], start: float, length: float) -> None:
    edges = sorted(edges)
    begins, ends = np.array(edges[:-1]), np.array(edges[1:])
    lost = LostIntervals(begins, ends, np.full(len(begins), 0.1))
    instants = lost.instants(start, start + length, 1000)
    assert (np.diff(instants) > 0.0).all()
    assert ((instants >= start - 1e-6) & (instants <= start + length + 1e-6)).all()
    for instant in instants:
        at = int(np.searchsorted(begins, instant)) - 1
        assert begins[at] < instant < ends[at]
        assert (instant - begins[at]) / 0.1 == pytest.approx(round((instant - begins[at]) / 0.1), abs=1e-6)


def test_lost_instants_beyond_the_limit_are_not_computed() -> None:
    """After a burst of samples a nanosecond apart, an hour without any would have lost billions of them."""
    lost = LostIntervals(np.array([0.0]), np.array([3600.0]), np.array([1e-9]))
    assert not len(lost.instants(0.0, 3600.0, 1000))
    assert lost.instants(0.0, 10.7e-9, 10) == pytest.approx(1e-9 * np.arange(1, 11))


@pytest.mark.parametrize("between", [0, 2])
def test_the_line_from_record_to_record_has_the_integral_of_the_curve(between: int) -> None:
    """A sine between samples of 20 ms is above its chords for half a period: a torque that moves the machine."""
    random, frequency = np.random.default_rng(12), 6.0
    samples = 0.02 * (ramp(100) + random.uniform(-0.2, 0.2, 100))
    at = np.sort(np.concatenate([samples[20:-20], random.uniform(samples[20], samples[-21], between * 60)]))
    steps = np.diff(at, append=samples[-20])
    own, series = interval_of(samples), Series(samples, np.sin(frequency * samples))
    result = bridge(
        InputSamples(series, InputKind.LINE, 0.0, own, lost_samples(series, InputKind.LINE, own, NO_OTHERS)), at, steps
    )
    truth = (np.cos(frequency * at[0]) - np.cos(frequency * at)) / frequency
    errors = []
    for values in (result.values, np.interp(at, samples, series.values)):
        areas = 0.5 * (values[1:] + values[:-1]) * np.diff(at)
        errors.append(np.abs(np.concatenate([[0.0], np.cumsum(areas)]) - truth).max())
    assert errors[0] < errors[1] / 10.0
    assert result.values - result.error.expected_change == pytest.approx(np.sin(frequency * at), abs=1e-4)
