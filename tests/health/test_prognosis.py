"""Forecasts from histories: right and covered on degradations, none without a trend; histories stay small."""

from itertools import product

import numpy as np
import pytest
from benchmarks.prognosis import QUANTITY, SHARES, coverage, median_error, run, run_motor

from otolith.acquisition.window import Array
from otolith.discovery.alternatives import WindowDecision
from otolith.health.events import HealthState, assess
from otolith.health.prognosis import (
    MAX_POINTS,
    MIN_CHANGE,
    MIN_POINTS,
    REFIT,
    History,
    Trend,
    _cells,
    _Data,
    _Shapes,
    errors_of_means,
    find_trend,
    forecast,
    is_due,
    is_plausible,
    span,
    with_point,
)
from otolith.health.schema import CrossingDocument, ForecastDocument
from otolith.health.text import crossing_text, duration_text, event_text
from tests.health.test_events import PLAN, assessed, changes, report
from tests.messages import assert_says
from tests.variants import often

SD = 0.01  # ohm
NOMINAL = QUANTITY.nominal


def history_of(values: list[float], period: float = 2.0, sd: float = SD) -> History:
    history: History = ()
    for index, value in enumerate(values):
        history = with_point(history, period * (index + 1), value, sd**2)
    return history


def test_a_degradation_as_in_the_paper_is_forecast_from_half_way() -> None:
    """Twelve of the runs of ``benchmarks/prognosis.py``, five forecasts each."""
    outcomes = [outcome for seed in range(12) for outcome in run(seed)]
    assert median_error(outcomes) < 0.1
    assert 0.65 <= coverage(outcomes) <= 0.95


@pytest.mark.full
def test_eighty_percent_intervals_hold_eighty_percent() -> None:
    outcomes = [outcome for seed in range(1, 101) for outcome in run(seed)]
    assert median_error(outcomes) < 0.1
    assert 0.75 <= coverage(outcomes) <= 0.85


def correlated(count: int, rho: float, random: np.random.Generator) -> Array:
    """(count,) errors of variance one, of which each is correlated with the one before."""
    errors = random.standard_normal(count)
    for index in range(1, count):
        errors[index] = rho * errors[index - 1] + np.sqrt(1.0 - rho**2) * errors[index]
    return errors


@pytest.mark.full
@pytest.mark.parametrize("growth", [0.0, 3.0])
def test_intervals_of_long_histories_with_correlated_errors_hold_eighty_percent(growth: float) -> None:
    """Of thousands of estimates; all but the last points are means of many, which average less out than is stated."""
    period, held = 2.0, list[bool]()
    for count, rho in product([800, 3000], [0.0, 0.5, 0.9]):
        times = period * np.arange(1, count + 1)
        points = np.array(history_of([0.0] * count, period))
        numbers = np.rint(SD**2 / points[:, 2]).astype(int)
        for seed in range(40):
            random = np.random.default_rng(seed)
            onset, end = period * count * random.uniform([0.0, 1.2], [0.3, 2.0])
            share = np.maximum(times - onset, 0.0) / (end - onset)
            shape = np.expm1(growth * share) / np.expm1(growth) if growth else share
            values = NOMINAL - 0.65 * shape + random.uniform(0.7, 1.4) * SD * correlated(count, rho, random)
            points[:, 1] = np.add.reduceat(values, np.cumsum([0, *numbers[:-1]])) / numbers
            crossing = forecast(QUANTITY, tuple(map(tuple, points.tolist()))).act
            assert crossing is not None
            held.append(crossing.low <= end <= (crossing.high or np.inf))
    assert 0.75 <= np.mean(held) <= 0.85


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.97])
def test_the_error_of_a_mean_of_correlated_estimates_is_that_of_an_autoregressive_process(rho: float) -> None:
    numbers = np.array([30, 30, 30, 8, 8, 8, 1, 1, 1])
    ends = np.cumsum(numbers)
    means = np.zeros((len(numbers), ends[-1]))
    for row, (end, number) in enumerate(zip(ends, numbers, strict=True)):
        means[row, end - number : end] = 1.0 / number
    covariance = means @ rho ** np.abs(np.subtract.outer(np.arange(ends[-1]), np.arange(ends[-1]))) @ means.T
    sd = np.sqrt(np.diag(covariance))
    expected = np.diag(covariance, 1) / (sd[1:] * sd[:-1])
    middles = ends - 0.5 * (numbers + 1.0)
    factors, correlation = errors_of_means(np.diff(middles), np.array([[rho]]))
    inner, pairs = [0, 1, 3, 4, 6, 7, 8], [0, 3, 6, 7]  # of means that are as long as the distances beside them
    assert factors[0, inner] == pytest.approx((sd**2 * numbers)[inner], rel=1e-9)
    assert correlation[0, pairs] == pytest.approx(expected[pairs], rel=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_precise_estimates_of_a_degradation_give_a_precise_forecast(seed: int) -> None:
    """Onset and exponent that fit lie on a ridge that is much narrower than the distance of a coarse grid's points."""
    random, times = np.random.default_rng(seed), np.arange(2.0, 520.0, 2.0)
    onset, rate, sd = random.uniform(100.0, 200.0), random.uniform(0.0025, 0.0035), 5e-4
    values = NOMINAL - 0.044 * np.expm1(rate * np.maximum(times - onset, 0.0)) + sd * random.standard_normal(len(times))
    result = forecast(QUANTITY, history_of(values.tolist(), sd=sd)).act
    end = onset + np.log1p(0.65 / 0.044) / rate
    assert result is not None
    assert result.high is not None
    assert result.at == pytest.approx(end, abs=0.1 * (end - 518.0))
    assert abs(result.at - end) < 5.0 * (result.high - result.low)


@pytest.mark.full
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_paper_s_degradation_is_forecast_from_the_signals_of_the_motor(seed: int) -> None:
    outcomes = run_motor(seed)
    assert len(outcomes) == len(SHARES)
    assert max(abs(outcome.error) for outcome in outcomes) < 0.1


@pytest.mark.parametrize("rho", often([0.8, 1.0], [0.0, 0.8, 0.98, 1.0]))
def test_correlated_errors_are_no_trend(rho: float) -> None:
    """A healthy machine, and one whose estimate is a random walk, observed at ten moments."""
    for seed in range(3):
        random = np.random.default_rng(seed)
        errors = random.standard_normal(1000)
        for index in range(1, len(errors)):
            step = np.sqrt(1.0 - rho**2) if rho < 1.0 else 0.1
            errors[index] = rho * errors[index - 1] + step * errors[index]
        values = (NOMINAL + SD * errors).tolist()
        for count in range(100, 1001, 100):
            result = forecast(QUANTITY, history_of(values[:count]))
            assert result.act is None
            assert result.reason


@pytest.mark.parametrize("seed", often([1], [1, 2, 3]))
def test_a_model_of_a_history_is_the_regression_with_correlated_errors(seed: int) -> None:
    """Against the same regression with the whole covariance matrix of the errors, at each time constant."""
    random, change = np.random.default_rng(seed), 0.8
    history = history_of((NOMINAL + SD * correlated(60, 0.7, random) + np.linspace(0.0, 0.4, 60)).tolist())
    data, shapes = _Data.of(history, change), _Shapes(np.array([10.0, 60.0]), np.array([0.0, 3.0]), np.full(2, np.inf))
    cells = _cells(data, shapes)
    mean, covariance = cells.mean.reshape(-1, 2, 2), cells.covariance.reshape(-1, 2, 2, 2)
    for constant, (deviations, rho) in enumerate(zip(data.deviations, data.correlation, strict=True)):
        lag = np.concatenate([[0.0], np.cumsum(np.log(rho))])
        errors = np.exp(-np.abs(lag[:, None] - lag[None, :])) * np.outer(deviations, deviations)
        for cell, curve in enumerate(shapes.at(data.times, data.times[-1])):
            rows = np.stack([np.ones_like(curve), curve])
            precision = rows @ np.linalg.solve(errors, rows.T) + np.diag([(100.0 * change) ** -2.0, change**-2.0])
            expected = np.linalg.solve(precision, rows @ np.linalg.solve(errors, data.values))
            sd = np.sqrt(np.diag(np.linalg.inv(precision)))
            assert mean[constant, cell] - [data.origin, 0.0] == pytest.approx(expected, abs=1e-6 * sd.min())
            ratio = covariance[constant, cell] / np.linalg.inv(precision)  # the unknown factor on all variances
            assert ratio == pytest.approx(np.full((2, 2), ratio[0, 0]), rel=1e-6)


def test_few_estimates_give_no_forecast() -> None:
    result = forecast(QUANTITY, history_of([NOMINAL - 0.02 * index for index in range(MIN_POINTS - 1)]))
    assert result.reason == f"too short: {MIN_POINTS - 1} of {MIN_POINTS} estimates"


def test_what_levels_off_or_leads_away_reaches_no_limit() -> None:
    random = np.random.default_rng(2)
    times = np.arange(300)
    warm = NOMINAL + 0.3 * (1.0 - np.exp(-times / 60.0)) + SD * random.standard_normal(300)
    assert isinstance(find_trend(history_of(warm.tolist()), 0.65), Trend)
    assert_says(forecast(QUANTITY, history_of(warm.tolist())).reason, "trend", "no further limit")
    levelling = NOMINAL - 0.3 * (1.0 - np.exp(-times / 60.0)) + SD * random.standard_normal(300)
    assert forecast(QUANTITY, history_of(levelling.tolist())).act is None


@pytest.mark.parametrize(("share", "expected"), [(0.7 * MIN_CHANGE, False), (1.5 * MIN_CHANGE, True)])
def test_a_small_part_of_the_way_gives_no_forecast(share: float, expected: bool) -> None:
    random = np.random.default_rng(4)
    values = NOMINAL - share * 0.65 * np.linspace(0.0, 1.0, 200) + 0.1 * SD * random.standard_normal(200)
    assert (forecast(QUANTITY, history_of(values.tolist(), sd=0.1 * SD)).act is not None) == expected


def test_a_linear_trend_is_called_so() -> None:
    random = np.random.default_rng(5)
    values = NOMINAL - 0.001 * np.arange(200) + SD * random.standard_normal(200)
    result = forecast(QUANTITY, history_of(values.tolist()))
    assert result.family == "linear"
    assert result.act is not None
    assert result.act.low < result.act.at == pytest.approx(2.0 * 650.0, rel=0.1)


def test_a_history_stays_small_and_dense_where_it_is_recent() -> None:
    history: History = ()
    for index in range(5000):
        history = with_point(history, 2.0 * index, NOMINAL, SD**2)
    assert len(history) == MAX_POINTS
    assert is_plausible(history)
    gaps = np.diff([time for time, _, _ in history])
    assert gaps[-1] == 2.0
    assert gaps[:20].mean() > 3.0 * gaps[-20:].mean()
    assert history[0][0] < 0.02 * 10000.0


def test_a_history_keeps_what_all_estimates_say_about_the_mean() -> None:
    random = np.random.default_rng(7)
    values = (NOMINAL + SD * random.standard_normal(3000)).tolist()
    _, kept, variances = np.array(history_of(values)).T
    precision = 1.0 / variances
    assert precision @ kept / precision.sum() == pytest.approx(np.mean(values), abs=1e-9)
    assert precision.sum() == pytest.approx(3000.0 / SD**2)


def test_a_history_takes_the_estimate_of_the_window_alone_at_its_middle() -> None:
    """The value from all windows lags behind a trend, and its error is that of the window before, too."""
    plain, alone = report(0, 6.4), report(1, 6.4)
    own = alone.parameters["R_a"].model_copy(update={"raw": 6.3, "raw_sd": 0.02})
    alone = alone.model_copy(update={"parameters": {"R_a": own}})
    stepped = alone.model_copy(update={"decision": WindowDecision.DISCOVERED})
    for document, expected in (
        (plain, (2.0, 6.4, 0.01**2)),
        (alone, (3.0, 6.3, 0.02**2)),
        (stepped, (4.0, 6.4, 0.01**2)),
    ):
        state, _ = assess(PLAN, HealthState(), document)
        (point,) = state.histories["R_a"]
        assert point == pytest.approx(expected)


def test_a_clock_that_is_set_keeps_a_history_usable() -> None:
    """A computer without a clock of its own starts in 1970, and is set later; or is set back."""
    values = [NOMINAL - 0.001 * index for index in range(300)]
    jumped = history_of(values[:30])
    for index, value in enumerate(values[30:]):
        jumped = with_point(jumped, 1.8e9 + 2.0 * index, value, SD**2)
    assert span(jumped) < 1000.0
    assert forecast(QUANTITY, jumped).computed == jumped[-1][0]
    back = with_point(jumped, 30.0, NOMINAL, SD**2)
    assert back[-1] == (30.0, NOMINAL, SD**2)
    assert is_plausible(back)
    assert not is_plausible(((2.0, 1.0, 1.0), (1.0, 1.0, 1.0)))
    assert not is_plausible(((2.0, 1.0, 0.0),))


def ramp_with_an_end(seed: int, kind: str) -> tuple[History, History, float]:
    """A history until a change has ended, the estimates after that, and the size of their errors.

    The change is a ``ramp`` of random slope, a ``step``, or a ramp and its ``repair``. No point is a mean of several.
    """
    random = np.random.default_rng(seed)
    before, during, after = (int(random.uniform(*range_)) for range_ in ((30, 70), (40, 100), (30, 31)))
    share, noise, rho = random.uniform(0.3, 0.9), NOMINAL * random.uniform(3e-4, 1e-3), random.choice([0.0, 0.5, 0.8])
    ramp = np.full(during, 1.0) if kind == "step" else np.linspace(0.0, 1.0, during)
    shape = np.concatenate([np.zeros(before), ramp, np.full(after, 0.0 if kind == "repair" else 1.0)])
    values = NOMINAL - 0.65 * share * shape + noise * correlated(len(shape), rho, random)
    history = history_of(values.tolist(), sd=noise)
    return history[: before + during], history[before + during :], noise


@pytest.mark.parametrize("kind", ["ramp", "step", "repair"])
@pytest.mark.parametrize("seed", often(range(3), range(12)))
def test_a_forecast_ends_with_its_trend(kind: str, seed: int) -> None:
    """Seen on a winding: "ACT in 88 s to 109 s", 100 s after its ramp had ended."""
    until, later, _ = ramp_with_an_end(seed, kind)
    if kind == "ramp":
        assert forecast(QUANTITY, until).act is not None
    for count in (15, 30):
        ended = forecast(QUANTITY, (*until, *later[:count])).act
        assert ended is None or ended.high is None or ended.low > later[-1][0] + 300.0


@pytest.mark.full
def test_the_first_forecasts_of_random_ramps_hold_as_often_as_they_say() -> None:
    """Each is the first one after the onset of a ramp, which few estimates show: the time left was a quarter of it."""
    held, ratios = list[bool](), list[float]()
    for seed in range(40):
        random = np.random.default_rng(seed)
        before, during = int(random.uniform(30.0, 100.0)), int(random.uniform(50.0, 200.0))
        noise, rho = NOMINAL * random.uniform(3e-4, 1.5e-3), random.choice([0.0, 0.5, 0.8])
        ramp = np.maximum(np.arange(before + during) - before, 0.0) / during
        values = NOMINAL - 0.65 * ramp + noise * correlated(len(ramp), rho, random)
        history, end = history_of(values.tolist(), sd=noise), 2.0 * (before + during + 1)
        forecasts = (forecast(QUANTITY, history[:count]) for count in range(before + 10, before + during, 3))
        first = next((item for item in forecasts if item.act is not None), None)
        if first is not None and first.act is not None:
            held.append(first.act.low <= end <= (first.act.high or np.inf))
            ratios.append((first.act.at - first.computed) / (end - first.computed))
    assert len(held) >= 36
    assert np.mean(held) >= 0.7
    assert 0.8 <= np.median(ratios) <= 1.25


def test_a_trend_that_has_ended_in_a_long_history_is_fitted_again_soon() -> None:
    """A share of a long history may be hours."""
    history = history_of([0.0] * 2000)
    own = ForecastDocument(computed=history[-12][0], family="linear")
    leads = own.model_copy(update={"act": CrossingDocument(limit=6.0, at=1e5, low=1e5, high=1e5)})
    assert not is_due(own, history)
    assert is_due(leads, history)
    assert not is_due(leads.model_copy(update={"computed": history[-5][0]}), history)


def test_no_forecast_while_windows_contradict_what_it_is_made_from() -> None:
    """The fault of a sensor held the estimates, and the forecast stayed."""
    random = np.random.default_rng(6)
    falling = [report(index, NOMINAL - 0.002 * index + 0.001 * random.standard_normal(), 0.001) for index in range(90)]
    wrong = [report(index, NOMINAL - 0.18, 0.001, decision=WindowDecision.SENSOR) for index in range(90, 100)]
    last, *held = (document.parameters["R_a"].forecast for document in assessed([*falling, *wrong])[89:])
    assert last is not None
    assert last.act is not None
    assert [item is not None and item.act is not None for item in held] == [True, True, *[False] * 8]
    assert held[-1] is not None
    assert held[-1].reason


def test_the_event_and_the_report_have_the_forecast() -> None:
    random = np.random.default_rng(6)
    state, documents = HealthState(), []
    for index in range(150):
        value = NOMINAL - 0.002 * index + 0.001 * random.standard_normal()
        state, document = assess(PLAN, state, report(index, value, 0.001))
        documents.append(document)
    result = documents[-1].parameters["R_a"].forecast
    assert result is not None
    assert result.act is not None
    assert result.act.at == pytest.approx(2.0 * 251.0, rel=0.02)
    assert result.act.limit == 6.0
    (event,) = documents[-1].events
    assert "reaches ACT in " in event_text(event)
    assert "reaches WATCH" not in event_text(event)
    computed = {document.parameters["R_a"].forecast.computed for document in documents}  # type: ignore[union-attr]
    assert len(computed) < 20 + 5.0 / REFIT  # fitted when the history has grown, not with each window
    assert len(changes(documents)) == 1


def test_a_sudden_change_begins_a_new_history() -> None:
    state = HealthState()
    for index in range(40):
        decision = WindowDecision.STEPPED if index == 30 else WindowDecision.LEARNED
        state, document = assess(PLAN, state, report(index, 6.5 if index < 30 else 6.4, decision=decision))
    assert len(state.histories["R_a"]) == 10
    assert document.parameters["R_a"].forecast is not None
    assert document.parameters["R_a"].forecast.reason.startswith("too short")


def test_a_forecast_is_said_in_words() -> None:
    crossing = CrossingDocument(limit=6.0, at=4.0 * 3600.0, low=3.0 * 3600.0, high=5.0 * 3600.0)
    assert crossing_text(crossing, "ACT", 0.0) == "reaches ACT in 3 h to 5 h"
    assert crossing_text(crossing.model_copy(update={"high": None}), "ACT", 0.0) == "reaches ACT in more than 3 h"
    durations = {-1.0: "0 s", 1.3: "1.3 s", 119.0: "119 s", 200.0: "3.3 min", 86400.0: "24 h", 2.6e6: "30 d"}
    assert {seconds: duration_text(seconds) for seconds in durations} == durations
