"""When a parameter passes its limits, from the history of its estimates.

Three models of the paper (Table 1) are compared: a constant, a line, and an exponential that accelerates or levels off.
Line and exponential begin at an unknown onset. A fourth model is a line that has ended, as a repair, a step, or a ramp
whose cause is over. Its end is unknown, and it is constant from there on:

    value(t) = c + d·φ(t),   φ = s or (exp(x·s) - 1)/(exp(x) - 1),   s = (t - onset)/(end - onset), 0 before the onset

``end`` is now where the change goes on. Where it has probably ended, only what came after that change counts.

Errors of consecutive estimates are correlated, because what the twin lacks lasts for several windows. They are
an Ornstein-Uhlenbeck process of unknown time constant, whose variance is that of the estimates times an unknown factor.
For given onset, ``x`` and time constant this is a linear regression with a conjugate prior (C. M. Bishop, Pattern
Recognition and Machine Learning, section 3.5). These three are summed over a grid, which is refined where the evidence
is, so that a forecast is the average over all models that go on, by their evidence.

The baseline is the begin of that history: the values while the machine was healthy, to which relative limits refer.

A load that changes each shift or each day moves temperatures, and with them parameters, up and down. Each slope of such
a cycle is a trend that would pass a limit if it went on. A trend is therefore announced only where the cycles before it
never led, and it is over only after a day without it.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array
from otolith.estimation.information import QUANTILE
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.schema import CrossingDocument, ForecastDocument

# Thresholds: docs/reference/thresholds-health.md has the origin of each.
MAX_POINTS = 200  # of a history
REFIT = 0.02  # of the span of a history: how much longer it must be for another fit
MIN_POINTS = 20  # of a history, for a forecast
VAGUE, VAGUE_SHARE = 3.0, 0.1  # times the interval of most estimates, and share of the value, beyond which one is vague
MAX_BASELINE_SHARE = 0.5  # of a baseline that its 95 % interval may have
MIN_POINTS_AFTER = 10  # of a history after an onset, for a forecast
MIN_TREND_PROBABILITY = 0.99  # of a trend, for a forecast
MIN_CHANGE = 0.1  # of the distance to a limit that a trend must have covered, for a forecast
HORIZON = 10.0  # spans of the history after now: no forecast beyond
COVERAGE = 0.8  # probability of the interval of a forecast
GROWTH = (-6.0, 8.0)  # lowest and highest exponent of an exponential between its onset and now
MIN_GOING_ON = 0.2  # probability that a trend has not ended, for a forecast of where it leads if it goes on
CHANGES = 4  # that have ended, after which a history is one of changes, and has no forecast
MIN_LENGTH = 1e-6  # of a history: length of a sudden change
ENDED = "the last change has ended"
NO_LIMIT = "the trend leads to no further limit"
GRID = 13, 15, 10  # points of onset, exponent or end, and time constant
REFINEMENTS = 9  # of the grid, at most
REFINED = 0.2  # of the points of a grid: how many must have weight so that it is not refined any more
MIN_WEIGHT = 1e-3  # weight of a grid point, over that of the best one, from which on it counts
FACTOR_SHAPE = 1.5  # of the inverse gamma prior of the factor on the variances, and its scale: its mode is 0.6
UNKNOWN_CONSTANT = 100.0  # standard deviation of the constant, over that of the change
MIN_TREND_SPAN = 3600.0  # s: of a history whose trend is announced before a limit is passed
MIN_WAY = 0.5  # of the way from the healthy value to a limit, that the value must have gone
MIN_BEYOND = 0.1  # of that way, by which it must be further than in the older half of its history
HOLD, MAX_HOLD = 0.05, 3600.0  # of the length of the history, and s: for which this must be so, the shorter one
MIN_SEEN = 3  # estimates that must show it meanwhile, however far they are apart
QUIET = 86400.0  # s without it, after which it is over: a day, the longest cycle of most loads
BISECTIONS = 40  # of the time of a crossing: more than a number has digits

History = tuple[tuple[float, float, float], ...]  # Time (s), value and variance of a parameter; the times rise


@dataclass(frozen=True, slots=True)
class Crossing:
    """Seconds from now until a limit is passed: median and interval of probability :data:`COVERAGE`."""

    median: float
    low: float
    high: float  # Infinite beyond the horizon


@dataclass(frozen=True, slots=True, eq=False)
class _Shapes:
    """Changes of a history; (cells,) each."""

    onset: Array  # Service time, s
    exponent: Array  # 0 for a line
    end: Array  # Service time, s, from which on it is constant; infinite for one that goes on

    def at(self, times: Array, now: float) -> Array:
        """Return φ of the module's docstring, (cells, times)."""
        onset, has_ended = self.onset[:, None], np.isfinite(self.end)[:, None]
        s = np.maximum(times[None, :] - onset, 0.0) / (np.where(has_ended, self.end[:, None], now) - onset)
        s = np.where(has_ended, np.minimum(s, 1.0), s)
        x = np.where(np.abs(self.exponent) < 1e-6, 1e-6, self.exponent)[:, None]  # the limit is the line
        return np.asarray(np.expm1(np.minimum(x * s, 300.0)) / np.expm1(x))  # its square is still a number

    def rows(self, which: NDArray[np.int64]) -> "_Shapes":
        """Return some of them, by their indices."""
        return _Shapes(self.onset[which], self.exponent[which], self.end[which])


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """Grid points with their posterior; one row each."""

    log_weight: Array
    shapes: "_Shapes"
    mean: Array  # (cells, 2) constant and change until now
    covariance: Array  # (cells, 2, 2)

    @property
    def heavy(self) -> Array:
        """Which of them have more than :data:`MIN_WEIGHT`."""
        return np.asarray(self.log_weight > self.log_weight.max() + math.log(MIN_WEIGHT))


@dataclass(frozen=True, slots=True, eq=False)
class Trend:
    """The posterior of the models of a history."""

    family: str  # linear or exponential: the one with more evidence
    now: float  # Time of the last point, s
    span: float  # See span
    cells: _Cells

    def crossing(self, limit: float, *, is_lower: bool) -> Crossing | None:
        """Return when ``limit`` is passed, downwards if ``is_lower``.

        None if the trend has not yet covered a tenth of the way, or probably does not pass it within the horizon.
        """
        weight = np.exp(self.cells.log_weight)
        constant, change = weight @ self.cells.mean
        way = limit - constant
        if change / way < MIN_CHANGE if way else True:
            return None
        before = self._beyond(weight, limit, 0.0, is_lower=is_lower)
        tail = 0.5 * (1.0 - COVERAGE)
        times = [
            self._quantile(weight, limit, before + share * (1.0 - before), is_lower=is_lower)
            for share in (0.5, tail, 1.0 - tail)
        ]
        return Crossing(*times) if before < 0.5 and math.isfinite(times[0]) else None

    def _quantile(self, weight: Array, limit: float, probability: float, *, is_lower: bool) -> float:
        """Return after how many seconds the value is beyond ``limit`` with ``probability``; infinity if not."""
        low, high = 0.0, HORIZON * self.span
        if self._beyond(weight, limit, high, is_lower=is_lower) < probability:
            return math.inf
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            is_beyond = self._beyond(weight, limit, middle, is_lower=is_lower) >= probability
            low, high = (low, middle) if is_beyond else (middle, high)
        return high

    def _beyond(self, weight: Array, limit: float, seconds: float, *, is_lower: bool) -> float:
        """Return the probability that the value is beyond ``limit`` after ``seconds``."""
        cells = self.cells
        shape = cells.shapes.at(np.array([self.now + seconds]), self.now)[:, 0]
        mean = cells.mean[:, 0] + cells.mean[:, 1] * shape
        covariance = cells.covariance
        variance = covariance[:, 0, 0] + 2.0 * shape * covariance[:, 0, 1] + shape**2 * covariance[:, 1, 1]
        excess = (limit - mean if is_lower else mean - limit) / np.sqrt(variance)
        tails = map(math.erfc, (excess / -math.sqrt(2.0)).tolist())  # SciPy's is not for the daemon, which imports this
        return 0.5 * float(weight @ np.fromiter(tails, np.float64, len(excess)))


def with_point(history: History, time: float, value: float, variance: float) -> History:
    """Return the history with another point and at most :data:`MAX_POINTS`, whose density falls with the root of age.

    Two neighbours become their mean, weighted by their precisions. Points that are not before ``time`` are dropped: a
    log may begin again.
    """
    kept = [*(point for point in history if point[0] < time), (time, value, variance)]
    if len(kept) > MAX_POINTS:
        times = np.array([point[0] for point in kept])
        first = int(np.argmin(np.diff(times)[:-1] / np.sqrt(time - times[:-2])))
        pair = np.array(kept[first : first + 2])
        precision = 1.0 / pair[:, 2]
        middle, mean = (precision @ pair[:, :2] / precision.sum()).tolist()
        kept[first : first + 2] = [(middle, mean, float(1.0 / precision.sum()))]
    return tuple(kept)


def is_plausible(history: History) -> bool:
    """Whether a history may have been made by :func:`with_point`."""
    times = [time for time, _, _ in history]
    rising = all(before < after for before, after in itertools.pairwise(times))
    return len(history) <= MAX_POINTS and rising and all(0.0 < variance < math.inf for _, _, variance in history)


def span(history: History) -> float:
    """Return twice the age of the middle point, s: the length of the history unless its clock was once set forward."""
    return 2.0 * (history[-1][0] - history[len(history) // 2][0])


def find_trend(history: History, change: float) -> Trend | str:
    """Return the trend of a history, or why there is none; ``change`` is the standard deviation of its prior."""
    if len(history) < MIN_POINTS:
        return f"too short: {len(history)} of {MIN_POINTS} estimates"
    for _ in range(CHANGES):
        data = _Data.of(history, change)
        constant = _cells(data, _line(data, np.zeros((1, 2))), is_constant=True)
        going = {"linear": _refined(data, _line), "exponential": _refined(data, _exponential)}
        ended = _refined(data, _ended_line)
        evidence = {name: _log_sum(cells.log_weight) for name, cells in going.items()}
        of_constant, of_ended = (_log_sum(cells.log_weight) for cells in (constant, ended))
        total = _log_sum(np.array([of_constant, of_ended, *evidence.values()]))
        if 1.0 - math.exp(of_constant - total) < MIN_TREND_PROBABILITY:
            return "no trend"
        if of_ended - total < math.log(1.0 - MIN_GOING_ON):
            family = max(evidence, key=lambda name: evidence[name])
            return Trend(family, history[-1][0], span(history), _together(*going.values()))
        history = tuple(point for point in history if point[0] > ended.shapes.end[np.argmax(ended.log_weight)])
        if len(history) < MIN_POINTS:
            return ENDED
    return ENDED


@dataclass(frozen=True, slots=True, eq=False)
class _Data:
    """A history relative to its last value, with the errors of each possible time constant made white."""

    times: Array
    origin: float  # Of the values
    values: Array
    deviations: Array  # (time constants, points)
    change: float
    correlation: Array  # (time constants, points - 1) of consecutive errors
    innovation: Array  # Share of the variance of an error that the one before does not predict

    @classmethod
    def of(cls, history: History, change: float) -> "_Data":
        times, values, variances = np.array(history).T
        gaps = np.diff(times)
        shortest, constants = gaps.min(), np.geomspace(0.3 * gaps.min(), 0.5 * span(history), GRID[2])[:, None]
        factors, correlation = errors_of_means(gaps / shortest, np.exp(-shortest / constants))
        deviations, origin = np.sqrt(factors * variances), float(values[-1])
        return cls(times, origin, values - origin, deviations, change, correlation, 1.0 - correlation**2)

    def time_at(self, share: Array, *, after: int) -> Array:
        """Return the times at a share of the points but the last ones ``after`` them."""
        return np.interp(share * (len(self.times) - 1.0 - after), np.arange(len(self.times)), self.times)

    def whitened(self, row: Array) -> Array:
        """Return a row (points,) for each time constant: (time constants, points) with independent errors."""
        scaled = row / self.deviations
        later = (scaled[:, 1:] - self.correlation * scaled[:, :-1]) / np.sqrt(self.innovation)
        return np.concatenate([scaled[:, :1], later], axis=1)

    def products(self, curves: Array, rows: Array) -> tuple[Array, Array]:
        """Return the sums over the points of whitened curves with rows that are white, and of their squares.

        ``curves`` are (curves, points), ``rows`` (rows, time constants, points), the sums (rows, time constants,
        curves) and (time constants, curves). A white curve is a sum of the steps of the curve and of its values, each
        times what is the same for all curves: so it is not made, and products of matrices have the sums. None of them
        is a difference of large numbers.
        """
        first, spread = self.deviations[:, :1], np.sqrt(self.innovation)
        of_step = 1.0 / (self.deviations[:, 1:] * spread)
        of_value = of_step - self.correlation / (self.deviations[:, :-1] * spread)
        steps, values, begin = np.diff(curves), curves[:, :-1], curves[:, :1]
        with_rows = rows[:, :, :1] / first * begin[:, 0]
        with_rows += (of_step * rows[:, :, 1:]) @ steps.T + (of_value * rows[:, :, 1:]) @ values.T
        squares = (begin[:, 0] / first) ** 2 + of_step**2 @ (steps**2).T + of_value**2 @ (values**2).T
        return with_rows, squares + 2.0 * (of_step * of_value) @ (steps * values).T


def errors_of_means(gaps: Array, rho: Array) -> tuple[Array, Array]:
    """Return by what the variance of each point exceeds that of independent estimates, and the correlation of the next.

    A point is the mean of the estimates that came one after the other within the shorter of the ``gaps`` beside it, in
    intervals of two estimates (points - 1,). ``rho`` (time constants, 1) is the correlation of two such estimates.
    """
    number = np.minimum(np.concatenate([gaps[:1], gaps]), np.concatenate([gaps, gaps[-1:]]))
    together = (1.0 - rho**number) / (1.0 - rho)
    factors = (1.0 + rho - 2.0 * rho * together / number) / (1.0 - rho)
    size = together / np.sqrt(number * factors)
    return factors, rho ** (gaps - 0.5 * (number[:-1] + number[1:]) + 1.0) * size[:, :-1] * size[:, 1:]


def _together(*families: _Cells) -> _Cells:
    """Return the grid points of all families that have weight; the sum of their weights is 1."""
    log_weight, mean, covariance = (
        np.concatenate([getattr(cells, name) for cells in families]) for name in ("log_weight", "mean", "covariance")
    )
    shapes = _Shapes(
        *(np.concatenate([getattr(cells.shapes, name) for cells in families]) for name in ("onset", "exponent", "end"))
    )
    heavy = np.flatnonzero(_Cells(log_weight, shapes, mean, covariance).heavy)
    log_weight = log_weight[heavy] - _log_sum(log_weight[heavy])
    return _Cells(log_weight, shapes.rows(heavy), mean[heavy], covariance[heavy])


def _cells(data: _Data, changes: _Shapes, *, is_constant: bool = False) -> _Cells:
    """Return the posterior at each of the ``changes`` and each time constant, with its evidence.

    The evidence lacks factors that are the same for all models of a history.
    """
    curves = changes.at(data.times, data.times[-1])
    count, points = curves.shape
    rows = np.stack([data.whitened(np.ones(points)), data.whitened(data.values)])
    (of_ones, with_value), (_, of_values) = (rows[:, None] * rows[None]).sum(3)
    (with_ones, with_values), squares = data.products(np.zeros_like(curves) if is_constant else curves, rows)
    # The precision of constant and change is a matrix of two rows: it is inverted by hand, for each cell.
    of_prior = (UNKNOWN_CONSTANT * data.change) ** -2.0, data.change**-2.0
    of_constant = np.broadcast_to(of_ones[:, None] + of_prior[0], squares.shape)
    left = with_ones / of_constant
    of_change = squares + of_prior[1] - left * with_ones  # once the constant is known
    moment = np.stack([np.broadcast_to(with_value[:, None], squares.shape), with_values], axis=2)
    change = (moment[..., 1] - left * moment[..., 0]) / of_change
    mean = np.stack([moment[..., 0] / of_constant - left * change, change], axis=2)
    crossed = -left / of_change
    covariance = np.stack([1.0 / of_constant - left * crossed, crossed, crossed, 1.0 / of_change], axis=2)
    covariance = covariance.reshape(*squares.shape, 2, 2)
    residual = of_values[:, None] - (mean * moment).sum(2)
    # The factor on the variances has an inverse gamma posterior of this scale and order.
    scale, order = FACTOR_SHAPE + 0.5 * np.maximum(residual, 0.0), FACTOR_SHAPE + 0.5 * points
    log_weight = 0.5 * (math.log(of_prior[0] * of_prior[1]) - np.log(of_constant * of_change)) - order * np.log(scale)
    log_weight -= (0.5 * np.log(data.innovation).sum(1) + np.log(data.deviations).sum(1))[:, None]
    log_weight -= math.log(log_weight.size)
    covariance = covariance * (scale / (order - 1.0))[..., None, None]
    mean[..., 0] += data.origin
    shapes = changes.rows(np.tile(np.arange(count), len(squares)))
    return _Cells(log_weight.ravel(), shapes, mean.reshape(-1, 2), covariance.reshape(-1, 2, 2))


def _line(data: _Data, place: Array) -> _Shapes:
    """Return lines that go on, by the place (lines, 2) of their onset among the points, in shares of their number."""
    return _Shapes(
        data.time_at(place[:, 0], after=MIN_POINTS_AFTER), np.zeros(len(place)), np.full(len(place), math.inf)
    )


def _exponential(data: _Data, place: Array) -> _Shapes:
    """Return exponentials that go on, by onset and exponent (exponentials, 2) in shares of their ranges."""
    exponent = GROWTH[0] + (GROWTH[1] - GROWTH[0]) * place[:, 1]
    return _Shapes(data.time_at(place[:, 0], after=MIN_POINTS_AFTER), exponent, np.full(len(place), math.inf))


def _ended_line(data: _Data, place: Array) -> _Shapes:
    """Return lines that have ended, by onset and the share (lines, 2) of the time after it that they took."""
    onset = data.time_at(place[:, 0], after=1)
    shortest = MIN_LENGTH * (data.times[-1] - data.times[0])
    return _Shapes(onset, np.zeros(len(place)), onset + np.maximum(place[:, 1] * (data.times[-1] - onset), shortest))


def _refined(data: _Data, family: Callable[[_Data, Array], _Shapes]) -> _Cells:
    """Return the grid points of a family, on a grid that is refined around the best of them.

    Onsets and exponents that fit equally well lie on a narrow ridge: each grid is aligned with the best points before.
    """
    whole = np.array([1.0, 0.0 if family is _line else 1.0])
    numbers = GRID[:2] if whole[1] > 0.0 else (GRID[0], 1)
    steps = np.indices(numbers).reshape(2, -1).T
    axes, begin, spacing = np.eye(2), np.zeros(2), (whole > 0.0) / np.maximum(np.subtract(numbers, 1), 1)
    for number in range(REFINEMENTS + 1):
        place = (begin + spacing * steps) @ axes  # in shares of the whole
        place = place[(np.abs(place - 0.5) <= 0.5 + 1e-9).all(1)]
        cells = _cells(data, family(data, place))
        cells.log_weight[:] += math.log(len(place) * np.prod((spacing * numbers)[whole > 0.0]) / len(steps))
        best = cells.log_weight.reshape(-1, len(place)).max(0)
        heavy = int((best > best.max() + math.log(MIN_WEIGHT)).sum())
        if number == REFINEMENTS or heavy >= REFINED * len(steps):
            break
        kept = place[np.argsort(-best)[: max(heavy, math.ceil(0.5 * REFINED * len(steps)))]]
        if whole[1] > 0.0:
            before, axes = axes, np.linalg.eigh(np.cov(kept.T))[1].T
            spacing = np.abs(axes @ before.T) @ spacing
        along = kept @ axes.T
        begin, end = along.min(0) - spacing, along.max(0) + spacing
        spacing = (whole > 0.0) * (end - begin) / np.maximum(np.subtract(numbers, 1), 1)
    return cells


def _log_sum(values: Array) -> float:
    """Return the logarithm of the sum of the exponentials of ``values``."""
    highest = float(values.max())
    return highest + math.log(float(np.exp(values - highest).sum()))


def forecast(
    quantity: MonitoredQuantity, history: History, required: Mapping[str, tuple[Limit, ...]] | None = None
) -> ForecastDocument:
    """Return when the parameter of a history passes its limits, or why that cannot be forecast.

    ``required`` are further ones, beyond which a figure of performance lacks its required value, by its name. Limits or
    some of these there must be.
    """
    now, required = history[-1][0], required or {}
    limits = quantity.limits or tuple(itertools.chain(*required.values()))
    trend = find_trend(history, max(abs(limit.value - quantity.nominal) for limit in limits))
    if isinstance(trend, str):
        return ForecastDocument(computed=now, reason=trend)
    by_level = {level.lower(): [row for row in quantity.limits if row.level is level] for level in Level}
    crossings = {key: first for key, rows in by_level.items() if (first := _first_crossing(trend, rows))}
    figures = {name: first for name, rows in required.items() if (first := _first_crossing(trend, rows))}
    reason = "" if crossings or figures else NO_LIMIT
    return ForecastDocument(computed=now, family=trend.family, reason=reason, figures=figures or None, **crossings)


def _first_crossing(trend: Trend, limits: Iterable[Limit]) -> CrossingDocument | None:
    """Return when the first of some limits is passed; None if none is."""
    now, found = trend.now, []
    for limit in limits:
        if (crossing := trend.crossing(limit.value, is_lower=limit.is_lower)) is not None:
            high = now + crossing.high if math.isfinite(crossing.high) else None
            times = {"at": now + crossing.median, "low": now + crossing.low, "high": high}
            found.append(CrossingDocument(limit=limit.value, **times))
    return min(found, key=lambda item: item.at, default=None)


def is_due(before: ForecastDocument | None, history: History) -> bool:
    """Whether a history has grown so much since the forecast ``before`` that it is fitted again.

    A trend that leads to a limit may have ended: after a few more estimates it is fitted again, in a long history too.
    """
    if before is None or not 0.0 <= history[-1][0] - before.computed < REFIT * span(history):
        return True
    leads = before.watch is not None or before.act is not None or before.figures is not None
    return leads and sum(time > before.computed for time, _, _ in history[-MIN_POINTS_AFTER:]) >= MIN_POINTS_AFTER


@dataclass(frozen=True, slots=True)
class Baseline:
    """The value of a parameter of the healthy machine, at its reference temperature."""

    value: float
    sd: float
    windows: int  # Number of estimates that it is the mean of
    end: float  # Service time of the last of them, s
    model: str = ""  # Fingerprint of twin and known values with which it was found; empty in older files

    def holds_with(self, model: str) -> bool:
        """Whether it is the value that a daemon estimates with the twin and the values of this fingerprint."""
        return self.model in ("", model)


@dataclass(frozen=True, slots=True)
class BaselineSearch:
    """What the estimates of the healthy machine give for a parameter."""

    baseline: Baseline | None  # None with a reason
    vague: int = 0  # Estimates that were not counted: their intervals are far wider than those of the others
    interval: float = 0.0  # Half of the 95 % interval of the narrowest of them
    reason: str = ""  # Why there is no baseline, or why it is not known well


def find_baseline(history: History, quantity: MonitoredQuantity) -> BaselineSearch:
    """Return the baseline that a history gives.

    Errors of estimates are correlated, so the mean is as uncertain as one of them, and as much as they differ. Near
    standstill a window hardly shows a parameter: estimates with a wide interval, which most others do not have, are not
    counted. A baseline whose interval is as large as itself is none.
    """
    if len(history) < MIN_POINTS:
        return BaselineSearch(None, reason=f"{len(history)} estimates, {MIN_POINTS} are needed")
    times, values, variances = np.array(history).T
    half = QUANTILE * np.sqrt(variances)
    vague = (half > VAGUE * np.quantile(half, 0.25)) & (half > VAGUE_SHARE * np.abs(np.median(values)))
    left, narrowest = int(vague.sum()), float(half[vague].min(initial=math.inf))
    times, values, variances = times[~vague], values[~vague], variances[~vague]
    interval = narrowest if left else 0.0
    if len(values) < MIN_POINTS:
        few = f"{len(values)} estimates with a narrow interval, {MIN_POINTS} are needed"
        return BaselineSearch(None, left, interval, few)
    value, sd = float(values.mean()), math.sqrt(float(variances.mean() + values.var()))
    if QUANTILE * sd >= MAX_BASELINE_SHARE * abs(value):
        return BaselineSearch(None, left, interval, f"its interval is {_share(sd, value)} of the value")
    known = Baseline(value, sd, len(values), float(times[-1]))
    limits = (*quantity.limits, *quantity.waiting)
    relative = [abs(limit.value / quantity.nominal - 1.0) for limit in limits if limit.is_relative]
    reason = ""
    if relative and QUANTILE * sd > min(relative) * abs(value):
        reason = f"its interval is {_share(sd, value)} of the value, wider than its nearest limit ({min(relative):.0%})"
    return BaselineSearch(known, left, interval, reason)


def _share(sd: float, value: float) -> str:
    return f"±{QUANTILE * sd / abs(value):.0%}" if value else "far more than 100 %"


def with_baselines(plan: MonitoringPlan, known: Mapping[str, Baseline]) -> MonitoringPlan:
    """Return the plan with the baselines that are ``known``, and with no others."""
    stated = plan.parameters if plan.stated is None else plan.stated
    parameters = {name: with_baseline(quantity, known.get(name)) for name, quantity in stated.items()}
    return replace(plan, parameters=parameters, stated=stated)


def with_baseline(quantity: MonitoredQuantity, baseline: Baseline | None) -> MonitoredQuantity:
    """Return a parameter whose relative limits refer to ``baseline``; without one, it is as the machine file has it."""
    ratio = baseline.value / quantity.nominal if baseline is not None and quantity.nominal else 0.0
    if baseline is None or not 0.0 < ratio < math.inf:
        return quantity
    limits = tuple(
        replace(limit, value=ratio * limit.value) if limit.is_relative else limit
        for limit in (*quantity.limits, *quantity.waiting)
    )
    return replace(quantity, nominal=baseline.value, limits=limits, waiting=(), is_example=False, has_baseline=True)


@dataclass(frozen=True, slots=True)
class SeenTrend:
    """Since when and until when a parameter was on its way to a limit, service times in s."""

    since: float
    until: float
    estimates: int = 1  # That showed it

    def is_over(self, now: float) -> bool:
        """Whether it was not seen for so long that its event ends."""
        return not 0.0 <= now - self.until < QUIET

    def is_lasting(self, now: float, length: float) -> bool:
        """Whether it is seen ``now``, and has been for long enough, in a history of ``length`` s."""
        return self.until == now and now - self.since >= _hold(length) and self.estimates >= MIN_SEEN


def _hold(length: float) -> float:
    """Return for how long a trend must be seen in a history of ``length`` s, s."""
    return min(HOLD * length, MAX_HOLD)


def seen_trend(
    quantity: MonitoredQuantity,
    history: History,
    forecast: ForecastDocument | None,
    before: SeenTrend | None,
    now: float,
) -> SeenTrend | None:
    """Return when the trend of a history was seen, up to ``now``; None if it never was.

    It goes on where estimates have not shown it for a short time only. A time without estimates does not count.
    """
    if (crossing := next_crossing(forecast, now)) is None or not _is_new(quantity, history, crossing.limit):
        return before
    if before is None or not before.until <= now:
        return SeenTrend(now, now)
    unseen = next((time for time, _, _ in history if time > before.until), now)
    goes_on = now - unseen < _hold(span(history))
    return SeenTrend(before.since, now, before.estimates + 1) if goes_on else SeenTrend(now, now)


def next_crossing(forecast: ForecastDocument | None, now: float) -> CrossingDocument | None:
    """Return the next limit that will be passed, if it is known up to when."""
    both = () if forecast is None else (forecast.watch, forecast.act)
    first = next((item for item in both if item is not None and item.low > now), None)
    return None if first is None or first.high is None else first


def _is_new(quantity: MonitoredQuantity, history: History, limit: float) -> bool:
    """Whether the value has gone far towards the limit, and further than in the older half of its history."""
    way = limit - quantity.nominal
    gone = [(value - quantity.nominal) / way for _, value, _ in history]
    middle = history[-1][0] - 0.5 * span(history)
    older = [share for share, (time, _, _) in zip(gone, history, strict=True) if time <= middle]
    return gone[-1] >= MIN_WAY and gone[-1] >= max(older, default=0.0) + MIN_BEYOND
