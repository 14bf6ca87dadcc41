"""Inputs between their samples: bridged as their hold says, with the variance of what the bridge may hide.

A command (``zoh``) holds its value until the next sample. Where a sample of it was lost, it may have changed at any of
the lost instants: the value moves from one end to the other with the probability that it has changed by then. A command
that is polled may have changed at any time since the last reading, and moves in the same way. A measured
quantity (``foh``) is a straight line between two samples, or a smooth curve if its samples show that it is one. How far
it may be from that is taken from the window itself: a sample against the line or curve through those around it, at two
spacings, gives a power law of the spacing. ``docs/explanation/sampling.md`` derives the variances.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.samples import Indices, Interval, Series, SignalPlan
from otolith.acquisition.window import Array, BridgeError
from otolith_drivers.base import Sampling

LINE_NOISE = 1.5  # variance of a sample about the line through its neighbours, in variances of the noise of a sample
CURVE_NOISE = 1.76  # the same about the cubic spline through the samples around it
SMOOTHER = 1.5  # times the mean square about the spline, above which that about the line shows a smooth curve
CREDIBLE = 3.0  # standard deviations from the line up to which a spline is used
MIN_KNOTS = 5  # of a spline whose errors are measured
NORMAL_SQUARE_MEDIAN = 0.455  # of the square of a standard normal deviate
LINE_EXPONENTS = (1.0, 4.0)  # of the variance of a line, by its length: a random walk, and a smooth curve
CURVE_EXPONENTS = (1.0, 8.0)  # of that of a spline: a random walk, and a curve with four derivatives
MIN_STEP = 1e-9  # s; against division by the step between two equal times
ROUNDING = 1e-6  # usual intervals: rounding of the times of lost instants


class InputKind(StrEnum):
    """What an input does between its samples."""

    LINE = "line"  # A measured quantity: near the line between two samples
    SAMPLED = "sampled"  # A command that changes at its samples only
    ON_CHANGE = "on change"  # A command that is recorded when it changes, and holds until then
    POLLED = "polled"  # A command that may change at any time between two readings


def kind_of(plan: SignalPlan, values: Array) -> InputKind:
    """Return the kind of an input with samples ``values`` (n,).

    Without ``on_change`` in the machine file, a command is recorded on change if no value is repeated. A polled command
    that keeps its value is exact between its readings.
    """
    if plan.hold != "zoh":
        return InputKind.LINE
    changes = np.diff(values) != 0.0
    if plan.on_change is None and plan.sampling is not Sampling.POLLED:
        return InputKind.ON_CHANGE if changes.all() else InputKind.SAMPLED
    if plan.on_change:
        return InputKind.ON_CHANGE
    return InputKind.POLLED if plan.sampling is Sampling.POLLED and changes.any() else InputKind.SAMPLED


@dataclass(frozen=True, slots=True, eq=False)
class LostIntervals:
    """Where samples of a command were lost: it may have changed at every ``usual`` s between start and end."""

    start: Array
    end: Array
    usual: Array

    def instants(self, start: float, end: float, limit: int) -> Array:
        """Return the times of the lost samples from ``start`` until ``end``, s; none if more than ``limit``."""
        firsts = np.maximum(np.ceil((start - self.start) / self.usual), 1.0)
        lasts = np.ceil((np.minimum(self.end, end) - self.start) / self.usual - 0.5)
        if np.maximum(lasts - firsts, 0.0).sum() > limit:
            return np.zeros(0)
        bounds = zip(self.start, self.usual, firsts, lasts, strict=True)
        return np.concatenate(
            [np.zeros(0), *(at + usual * np.arange(first, last) for at, usual, first, last in bounds)]
        )


NOTHING_LOST = LostIntervals(np.zeros(0), np.zeros(0), np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class OtherSamples:
    """The samples of all other signals."""

    times: Array  # s, increasing
    interval: Interval  # Of the signal that comes most often


def lost_samples(series: Series, kind: InputKind, own: Interval, others: OtherSamples) -> LostIntervals:
    """Return where samples of an input were lost.

    A command that is recorded when it changes has no sample while it holds, although other signals have theirs. Its
    changes are lost only with the samples of all others, and never if they are recorded apart from the others. A polled
    command may change at all times, so that a lost reading adds no instant.
    """
    starts, ends, usual = series.times[:-1], series.times[1:], own.usual
    if kind is InputKind.POLLED:
        long = np.zeros(len(starts), dtype=np.bool_)
    elif kind is not InputKind.ON_CHANGE:
        long = ends - starts > own.longest
    elif np.isin(series.times, others.times).all():
        last = np.searchsorted(others.times, ends) - 1
        starts = np.maximum(starts, others.times[np.maximum(last, 0)])
        long, usual = ends - starts > others.interval.longest, others.interval.usual
    else:
        long = np.zeros(len(starts), dtype=np.bool_)
    return LostIntervals(starts[long], ends[long], np.full(int(long.sum()), usual))


@dataclass(frozen=True, slots=True, eq=False)
class BridgedInput:
    """An input at the records of a window."""

    values: Array  # (records,)
    error: BridgeError  # Of this input: (records,) each


@dataclass(frozen=True, slots=True, eq=False)
class InputSamples:
    """The samples of an input, at least one, and where some were lost."""

    series: Series
    kind: InputKind
    noise: float  # Standard deviation of the noise of a sample
    interval: Interval
    lost: LostIntervals


@dataclass(frozen=True, slots=True, eq=False)
class _Error:
    """Error of a bridge, (records,) each."""

    variance: Array
    duration: Array  # How long the error lasts, s


def bridge(samples: InputSamples, times: Array, steps: Array) -> BridgedInput:
    """Return an input at ``times`` (records,) s, each followed by a step (records,) s."""
    series, usual = samples.series, samples.interval.usual
    steps = np.maximum(steps, MIN_STEP)
    before, after = _neighbours(samples, times, steps)
    length = series.times[after] - series.times[before]
    ended = after == before
    spacing = np.where(ended, usual if np.isfinite(usual) else steps, length)
    expected_change = np.zeros(len(times))
    if samples.kind is InputKind.LINE:
        values, error, expected_change = _measured(samples, times, steps)
    else:
        values, error = _hold(samples, times, before)
    outdated = _outdated(samples, times)
    variance = error.variance + outdated.variance
    duration = np.where(outdated.variance > 0.0, outdated.duration, error.duration)
    held_variance = variance * np.maximum(1.0, duration / steps)
    if samples.kind is InputKind.POLLED:
        unseen = _unseen_change(samples, times, steps, before, after)
        expected_change = unseen.expected
        variance, held_variance = variance + unseen.variance, held_variance + unseen.held_variance
    noise_ratio = np.maximum(spacing, steps) / steps
    return BridgedInput(values + expected_change, BridgeError(noise_ratio, variance, held_variance, expected_change))


def _neighbours(samples: InputSamples, times: Array, steps: Array) -> tuple[Indices, Indices]:
    """Return the last sample before or at each of ``times``, and the one after it; the last sample has none."""
    series, rounding = samples.series, ROUNDING * np.minimum(steps, samples.interval.usual)
    before = np.maximum(np.searchsorted(series.times, times + rounding, "right") - 1, 0)
    return before, np.minimum(before + 1, len(series.times) - 1)


@dataclass(frozen=True, slots=True, eq=False)
class _UnseenChange:
    """The change of a polled command in the step after each record, (records,) each."""

    expected: Array  # Mean over the step of what is expected beside the last reading
    variance: Array
    held_variance: Array


def _unseen_change(samples: InputSamples, times: Array, steps: Array, before: Indices, after: Indices) -> _UnseenChange:
    """Return what a command may have changed since its last reading; each instant until the next one is as likely.

    Where readings were lost, it may also have wandered and come back.
    """
    series = samples.series
    interval, since = series.times[after] - series.times[before], times - series.times[before]
    length = np.maximum(interval, steps)
    between = (interval > 0.0) & (since >= -ROUNDING * steps)
    change = np.where(between, series.values[after] - series.values[before], 0.0)
    wander = _usual_change(series, samples.interval) * interval / samples.interval.usual
    squared = np.maximum(change**2, np.where(between & (interval > samples.interval.longest), wander, 0.0))
    share, half_step = np.clip(since / length, 0.0, 1.0), 0.5 * steps / length
    return _UnseenChange(
        change * (share + half_step),
        squared * (share * (1.0 - share) + half_step**2),
        squared * length / (12.0 * steps),
    )


def _hold(samples: InputSamples, times: Array, before: Indices) -> tuple[Array, _Error]:
    """Return a command at ``times``, and its error."""
    series, lost = samples.series, samples.lost
    values, none = series.values[before], np.zeros(len(times))
    if not len(lost.start):
        return values, _Error(none, none)
    at = np.maximum(np.searchsorted(lost.start, times + ROUNDING * lost.usual[0], "right") - 1, 0)
    start, end, usual = lost.start[at], lost.end[at], lost.usual[at]
    inside = (times >= start - ROUNDING * usual) & (times < end - ROUNDING * usual)
    chances = np.maximum(np.rint((end - start) / usual), 1.0)
    share = np.clip(np.floor((times - start) / usual + ROUNDING) / chances, 0.0, 1.0)
    following = np.minimum(np.searchsorted(series.times, end - ROUNDING * usual), len(series.times) - 1)
    change = np.where(inside, series.values[following] - values, 0.0)
    wander = _usual_change(series, samples.interval) * (end - start) / samples.interval.usual
    variance = np.where(inside, np.maximum(change**2, wander) * share * (1.0 - share), 0.0)
    duration = np.where(inside, np.maximum(usual, 0.5 * (end - start)), 0.0)
    return values + change * share, _Error(variance, duration)


def _usual_change(series: Series, own: Interval) -> float:
    """Return the squared change of a command from sample to sample, robust against single steps."""
    usual = np.diff(series.times) <= own.longest
    return float(np.median(np.diff(series.values)[usual] ** 2)) / NORMAL_SQUARE_MEDIAN if usual.any() else 0.0


def _measured(samples: InputSamples, times: Array, steps: Array) -> tuple[Array, _Error, Array]:
    """Return a measured quantity at ``times``, its error, and by how much each value is moved.

    The twin draws a line from record to record. A curve is above it or below it for half a period, which looks like
    another moment of inertia. Half of the integral between both is added at each end of a step, by Simpson's rule.
    """
    both = np.concatenate([times, times + 0.5 * steps])
    values, error = _line(samples, both, np.concatenate([steps, steps]))
    at_records, middles = values[: len(times)], values[len(times) :]
    with np.errstate(over="ignore", invalid="ignore"):  # absurd values
        following = np.append(at_records[1:], 2.0 * middles[-1:] - at_records[-1:])
        area = 2.0 / 3.0 * (middles - 0.5 * (at_records + following)) * steps
        moved = (area + np.append(0.0, area[:-1])) / (steps + np.append(0.0, steps[:-1]))
    moved[~np.isfinite(moved)] = 0.0
    return at_records, _Error(error.variance[: len(times)], error.duration[: len(times)]), moved


def _line(samples: InputSamples, times: Array, steps: Array) -> tuple[Array, _Error]:
    """Return a measured quantity at ``times``, and its error."""
    series, (before, after) = samples.series, _neighbours(samples, times, steps)
    length = series.times[after] - series.times[before]
    values, none = np.interp(times, series.times, series.values), np.zeros(len(times))
    share = np.clip((times - series.times[before]) / np.maximum(length, MIN_STEP), 0.0, 1.0)
    spread = np.where(after > before, 4.0 * share * (1.0 - share), 0.0)
    inside = spread > ROUNDING
    if not inside.any():
        return values, _Error(none, none)
    variance = line_variance(series, samples.noise)(length)
    of_curve = curve_variance(series, samples.noise)
    if of_curve is not None:
        curve, curve_error = _curve(series, times), of_curve(length)
        # In a long gap a curve is worse than a line; beside a burst of samples it overshoots.
        curved = inside & (curve_error < variance) & (np.abs(curve - values) <= CREDIBLE * np.sqrt(variance))
        values = np.where(curved, curve, values)
        variance = np.where(curved, curve_error, variance)
    return values, _Error(np.where(inside, variance * spread, 0.0), 0.5 * length)


@dataclass(frozen=True, slots=True)
class GapVariance:
    """Variance of a quantity in the middle between two samples: ``at_two * (length / two)**exponent``."""

    at_two: float
    two: float  # Two intervals, s
    exponent: float

    def __call__(self, length: Array) -> Array:
        """Return the variance for gaps of ``length`` s."""
        return np.asarray(self.at_two * (np.maximum(length, 0.0) / self.two) ** self.exponent)


def line_variance(series: Series, noise: float) -> GapVariance:
    """Return the variance of a line through samples, from what the samples between show; ``noise`` is their own."""
    if len(series.times) < 3:
        return GapVariance(float(np.var(series.values)), 2.0 * float(np.ptp(series.times)) or 1.0, LINE_EXPONENTS[0])
    squares = (_mean_square(_about_line(series, 1)), _mean_square(_about_line(series, 2)))
    return _power_law(series, squares, LINE_NOISE * noise**2, LINE_EXPONENTS)


def curve_variance(series: Series, noise: float) -> GapVariance | None:
    """Return the variance of a cubic spline through samples; None if they do not show a smooth curve."""
    if len(series.times) < 4 * MIN_KNOTS:
        return None
    short = _mean_square(_about_curve(series, 1))
    if not short * SMOOTHER < _mean_square(_about_line(series, 1)) < np.inf:
        return None
    noise_square = CURVE_NOISE * noise**2
    short = max(short, noise_square * (1.0 + np.sqrt(2.0 / len(series.times))))  # as far as noise lets it be known
    return _power_law(series, (short, _mean_square(_about_curve(series, 2))), noise_square, CURVE_EXPONENTS)


def _power_law(
    series: Series, squares: tuple[float, float], noise: float, exponents: tuple[float, float]
) -> GapVariance:
    """Return the variance that explains the mean ``squares`` without ``noise``, at two and at four intervals."""
    short, long = (max(square - noise, 0.0) if np.isfinite(square) else 0.0 for square in squares)
    exponent = float(np.clip(np.log2(max(long, short) / short), *exponents)) if short > 0.0 else exponents[0]
    length = series.times[2:] - series.times[:-2]
    share = (series.times[1:-1] - series.times[:-2]) / length
    two = float(np.mean(length**exponent * 4.0 * share * (1.0 - share)) ** (1.0 / exponent))
    return GapVariance(short if short > 0.0 else long / 2.0**exponent, two, exponent)


def _mean_square(errors: Array) -> float:
    """Return the mean square of errors; infinite if it is beyond all numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        square = float(np.mean(errors**2))
    return square if np.isfinite(square) else np.inf


def _about_line(series: Series, reach: int) -> Array:
    """Return the samples minus the line through those ``reach`` before and after."""
    times, values = series.times, series.values
    if len(times) <= 2 * reach:
        return values - float(values.mean())
    left, middle, right = slice(None, -2 * reach), slice(reach, -reach), slice(2 * reach, None)
    share = (times[middle] - times[left]) / (times[right] - times[left])
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(values[middle] - (1.0 - share) * values[left] - share * values[right])


def _about_curve(series: Series, reach: int) -> Array:
    """Return the samples minus the spline through each ``2 * reach``-th one, in the middle between two of these."""
    times, values, pitch = series.times, series.values, 2 * reach
    errors = []
    with np.errstate(over="ignore", invalid="ignore"):
        for first in range(pitch):
            knots = slice(first, None, pitch)
            middles = slice(first + reach, -reach, pitch)
            errors.append(values[middles] - _curve(Series(times[knots], values[knots]), times[middles]))
    return np.asarray(np.concatenate(errors))


def _curve(series: Series, times: Array) -> Array:
    """Return the cubic spline through four or more samples, at ``times``."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415 - 34 MB that only smooth inputs need

    return np.asarray(CubicSpline(series.times, series.values)(times))


def _outdated(samples: InputSamples, times: Array) -> _Error:
    """Return the error before the first and after the last sample, which grows with the distance in time."""
    series, none = samples.series, np.zeros(len(times))
    early, late = np.maximum(series.times[0] - times, 0.0), np.maximum(times - series.times[-1], 0.0)
    if samples.kind is InputKind.ON_CHANGE:
        late = none
    elif samples.kind is InputKind.SAMPLED:
        late = np.where(late > samples.interval.longest, late, 0.0)
    away = early + late
    if not away.any() or len(series.times) < 2:
        return _Error(none, none)
    with np.errstate(over="ignore", invalid="ignore"):
        change = float(np.mean(np.diff(series.values) ** 2)) - 2.0 * samples.noise**2
    change = max(change, 0.0) if np.isfinite(change) else 0.0
    return _Error(change * away / samples.interval.usual, away)
