"""Delays of the signals of a healthy machine, from the likelihood of windows that are shifted by them.

Only differences between delays are observable, so delays are added one signal at a time, and only while the windows
become significantly more likely. The smallest delay is zero. ``docs/explanation/delays.md`` derives the equations.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.commissioning.identification import IdentifiedNoise, identify_noise, with_initial_noise
from otolith.commissioning.likelihood import FIRST_FITS, MAX_FIRST_COST, FittedWindow, Likelihood, Progress
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.estimation.timing import (
    delay_response,
    delayable,
    largest_delay,
    same_measurements,
    shifted,
    trial_delays,
    with_changes_between,
)

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
SEARCHED_WINDOWS = 8  # windows with the most information, in which delays are tried
SEARCH_STEPS, MAX_STEPS = 3, 8  # of Gauss-Newton for one delay in these windows, and for all delays in all windows
SIGNIFICANCE = 0.01  # probability that a signal without a delay is given one, over all signals
NEGLIGIBLE_STEP = 0.05  # standard deviations: step of a delay after which the search has ended
MAX_REFINEMENTS = 2  # of the delays with identified noise levels, and of these without the refined delays
MAX_UNCERTAINTY = 0.5  # of the largest delay: standard deviation of a delay above which the data show nothing of it
MIN_RECORDS = 8  # of a window

UNOBSERVABLE = "its delay cannot be identified: it does not move, or no output depends on it"
NO_DELAY = "no delay is significant; up to about {:.2g} ms could not be detected"
REFERENCE = "the delays of the other signals are against it"
AT_LIMIT = "at the largest delay that was searched"
NO_WINDOW = "no window can be used: no delay was identified"
CHANGING = 'it changes between its samples: add times = "polled" to it in [signals]'
STRUCTURE = "a delay of {:.4g} ms would explain as much as the structure that the twin lacks, so it is not identified"


@dataclass(frozen=True, slots=True)
class SignalDelay:
    """The delay of one signal against those that are not late."""

    name: str
    value: float  # s
    sd: float | None = None  # Standard deviation, s; None if it was not identified
    remark: str = ""  # Why there is none, or what limits it; empty if nothing does

    @property
    def is_late(self) -> bool:
        """Whether a delay was identified."""
        return self.value > 0.0


@dataclass(frozen=True, slots=True)
class IdentifiedDelays:
    """The delays of all signals, outputs first."""

    signals: tuple[SignalDelay, ...]
    windows: int = 0  # How many were used
    shifts: tuple[float, ...] = ()
    """By how much the samples of each signal are late in the windows, s; signed, zero for one of them."""
    changing: tuple[str, ...] = ()  # Commands that change between their samples
    noise_without: IdentifiedNoise | None = None
    """Noise levels of the windows as they come; None if the search did not need them."""

    @property
    def values(self) -> dict[str, float]:
        """The delay of each signal, s."""
        return {signal.name: signal.value for signal in self.signals}

    def applied(self, problem: Problem, windows: Sequence[Window]) -> list[Window]:
        """Return the windows that the delays were identified from, without what is left of the delays in them."""
        given = dict(zip((signal.name for signal in self.signals), self.shifts, strict=False))
        if self.changing:
            windows = [with_changes_between(window, self.changing) for window in windows]
        return [shifted(problem.twin, window, given) for window in windows]


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """All windows, shifted by ``delays`` and fitted."""

    delays: Array  # (signals,) s
    fits: list[FittedWindow]
    deviance: float


@dataclass(frozen=True, slots=True, eq=False)
class _Score:
    """Estimate of the delays of some signals from all windows, around a point."""

    step: Array  # (signals,) to the minimum, s
    covariance: Array
    """(signals, signals); enlarged where the windows differ by more than their uncertainties explain."""
    gain: float  # By which the deviance falls, with the same enlargement


def identify_delays(
    problem: Problem,
    windows: Sequence[Window],
    declared: Mapping[str, float],
    progress: Progress = lambda _: None,
    start: IdentifiedDelays | None = None,
) -> IdentifiedDelays:
    """Return the delays of the signals of ``problem`` from ``windows``; deterministic.

    ``declared`` delays (s) were taken off the windows already; the result is that of the signals as they come. The
    noise levels of the problem should be about right, process noise included. ``start`` has been identified from the
    same windows, with other noise levels.
    """
    return _Search(problem, windows, progress).run(declared, () if start is None else start.shifts)


def identify_delays_and_noise(
    problem: Problem, windows: Sequence[Window], declared: Mapping[str, float], progress: Progress = lambda _: None
) -> tuple[IdentifiedDelays, IdentifiedNoise]:
    """Return the delays as :func:`identify_delays`, and the noise levels of windows without them.

    A command that changes between its samples seems late by their mean distance. Which of both it is shows where the
    windows are decisively more likely.
    """
    late, noise = _delays_and_noise(problem, windows, declared, progress)
    commands = {driven.name for driven in problem.twin.inputs if driven.hold == "zoh"}
    names = tuple(own.name for own in late.signals if own.is_late and own.name in commands)
    if not names or not noise.windows:
        return late, noise
    changed = [with_changes_between(window, names) for window in windows]
    other, other_noise = _delays_and_noise(problem, changed, declared, progress)
    deviances = [
        _Search(levels.applied(problem), used, progress).deviance(delays)
        for delays, levels, used in ((late, noise, windows), (other, other_noise, changed))
    ]
    is_late = any(own.name in names and own.is_late for own in other.signals)  # by more than a time between samples
    if is_late or not deviances[1] <= deviances[0] - DECISIVE:  # a deviance may be no number
        return late, noise
    kept = tuple(replace(own, remark=CHANGING) if own.name in names else own for own in other.signals)
    return replace(other, signals=kept, changing=names), other_noise


def _delays_and_noise(
    problem: Problem, windows: Sequence[Window], declared: Mapping[str, float], progress: Progress
) -> tuple[IdentifiedDelays, IdentifiedNoise]:
    """Return the delays of signals, and the noise levels of windows without them.

    A delay looks like process noise, so delays come first, with initial noise levels. With the identified ones they
    are refined, and then the noise, because even the uncertainty of a delay looks like process noise.
    """
    delays = identify_delays(with_initial_noise(problem, windows), windows, declared, progress)
    noise = identify_noise(problem, delays.applied(problem, windows), progress)
    noise_without = None if any(delays.shifts) else noise
    for _ in range(MAX_REFINEMENTS if noise.windows else 0):
        refined = identify_delays(noise.applied(problem), windows, declared, progress, delays)
        is_settled = refined.shifts == delays.shifts
        delays = refined
        if is_settled:
            break
        noise = identify_noise(problem, delays.applied(problem, windows), progress)
    return replace(delays, noise_without=noise_without), noise


def without_delays(delays: IdentifiedDelays, declared: Mapping[str, float]) -> IdentifiedDelays:
    """Return the ``declared`` delays, with a remark on those that were identified where the twin lacks a structure."""
    kept = (
        replace(own, value=declared.get(own.name, 0.0), sd=None, remark=STRUCTURE.format(1e3 * own.value))
        if own.is_late
        else own
        for own in delays.signals
    )
    return IdentifiedDelays(tuple(kept), delays.windows)


class _Search:
    def __init__(self, problem: Problem, windows: Sequence[Window], progress: Progress) -> None:
        twin = problem.twin
        self.names = delayable(twin)
        self._likelihood = Likelihood(problem)
        self._problem, self._progress = problem, progress
        self._levels = np.array([*problem.noise, *(problem.process_noise or (0.0,) * len(twin.states))])
        good = [window for window in windows if window.quality.verdict is Verdict.GOOD]
        limits = (largest_delay(window.grid.length, window.sample_period) for window in good)
        self._limit = min(limits, default=0.0)
        self._windows = [window for window in good if window.records >= MIN_RECORDS]
        starts = [problem.nominal] * len(self._windows)
        point = self._evaluate(np.zeros(len(self.names)), self._windows, starts)
        used = [at for at, fit in enumerate(point.fits) if fit.cost < MAX_FIRST_COST]
        self._windows = [self._windows[at] for at in used]
        fits = [point.fits[at] for at in used]
        self._first = _Point(point.delays, fits, self._likelihood.deviance(fits))

    def run(self, declared: Mapping[str, float], start: Sequence[float] = ()) -> IdentifiedDelays:
        """Add delays to those of ``start`` until none is significant."""
        if not self._windows:
            kept = (SignalDelay(name, declared.get(name, 0.0), None, NO_WINDOW) for name in self.names)
            return IdentifiedDelays(tuple(kept))
        point, active = self._first, [index for index, shift in enumerate(start) if shift]
        if active:
            refined = self._refined(self._again(point, np.array(start)), active)
            point, active = self._simplified(refined, active)
        while len(active) < len(self.names) - 1:
            better = self._with_another(point, active)
            if better is None:
                break
            point, active = self._simplified(*better)
        results = tuple(self._results(point, active, declared))
        return IdentifiedDelays(results, len(self._windows), tuple(point.delays.tolist()))

    def deviance(self, delays: IdentifiedDelays) -> float:
        """Return that of the windows with these delays; infinite if none can be used."""
        shifts = np.array(delays.shifts or (0.0,) * len(self.names))
        return self._again(self._first, shifts).deviance if self._windows else np.inf

    def _evaluate(
        self, delays: Array, windows: Sequence[Window], starts: Sequence[Array], rounds: int = FIRST_FITS
    ) -> _Point:
        """Fit the windows, shifted by ``delays``; each fit begins with the parameters of ``starts``."""
        fits = []
        given = dict(zip(self.names, delays.tolist(), strict=True))
        twin = self._problem.twin
        for window, start in zip(windows, starts, strict=True):
            moved = shifted(twin, window, given)
            moved = same_measurements(twin, moved, given, moved.start - window.start, self._between(window))
            fits.append(self._likelihood.fit(self._levels, moved, [start], rounds))
        return _Point(delays, fits, self._likelihood.deviance(fits))

    def _between(self, window: Window) -> tuple[float, float]:
        """Return from when to when a sample stays in the window whatever the delay, s; rounding moves none across."""
        times = window.grid.offsets
        first, last = np.searchsorted(times, (self._limit, window.grid.length - self._limit))
        first, last = max(int(first), 1), min(int(last), len(times) - 1)
        return float(times[first - 1 : first + 1].mean()), float(times[last - 1 : last + 1].mean())

    def _again(
        self, point: _Point, delays: Array, chosen: Sequence[int] | None = None, rounds: int = FIRST_FITS
    ) -> _Point:
        """Fit all or the ``chosen`` windows again at other delays, from the parameters of ``point``."""
        places = range(len(self._windows)) if chosen is None else chosen
        starts = [point.fits[at].guess[: len(self._problem.free)] for at in range(len(point.fits))]
        return self._evaluate(delays, [self._windows[at] for at in places], starts, rounds)

    def _score(self, point: _Point, signals: Sequence[int]) -> _Score:
        """Return the Gauss-Newton step of the delays of ``signals``, the parameters of each window being free."""
        scores, information = [], []
        for fit in point.fits:
            response = delay_response(fit.objective, fit.guess)[:, list(signals)]
            left = self._likelihood.project(response, fit.result.jacobian)
            scores.append(left.T @ fit.result.residuals / fit.discount)
            information.append(left.T @ response / fit.discount)
        total = np.sum(information, axis=0)
        covariance = np.linalg.pinv(total, hermitian=True)
        step = -covariance @ np.sum(scores, axis=0)
        left_over = [score + own @ step for score, own in zip(scores, information, strict=True)]
        degrees = (len(scores) - 1) * len(signals)
        spread = sum(
            float(rest @ np.linalg.pinv(own, hermitian=True) @ rest)
            for rest, own in zip(left_over, information, strict=True)
        )
        excess = max(spread / degrees, 1.0) if degrees else 1.0
        return _Score(step, covariance * excess, float(step @ total @ step) / excess)

    @property
    def _threshold(self) -> float:
        """Gain of the deviance above which a delay is significant: χ² of one degree, for any of the signals."""
        from scipy.special import chdtri  # noqa: PLC0415 - only commissioning needs SciPy

        return float(chdtri(1.0, SIGNIFICANCE / max(len(self.names) - 1, 1)))

    def _with_another(self, point: _Point, active: list[int]) -> tuple[_Point, list[int]] | None:
        """Return the windows with one more delay, and the signals that have one; None if none is significant."""
        others = [index for index in range(len(self.names)) if index not in active]
        alone = {index: self._score(point, [index]) for index in others}
        if max(score.gain for score in alone.values()) <= self._threshold:
            return None
        chosen = self._most_informative(point)
        before = self._part(point, chosen)
        best, added = before, -1
        # Of two signals, one late is the other early: the trials have both signs.
        for index in others[:1] if len(self.names) == 2 else others:
            trial = self._searched(before, index, float(alone[index].step[0]), chosen)
            if trial.deviance < best.deviance:
                best, added = trial, index
        if added < 0:
            return None
        self._progress(f"delay of {self.names[added]}: {1e3 * best.delays[added]:.3g} ms")
        refined = self._refined(self._again(point, best.delays), [*active, added])
        score = self._score(refined, [*active, added])
        significance = refined.delays[added] ** 2 / float(score.covariance[-1, -1])
        if min(point.deviance - refined.deviance, significance) <= self._threshold:
            return None
        return refined, [*active, added]

    def _simplified(self, point: _Point, active: list[int]) -> tuple[_Point, list[int]]:
        """Return the delays against the signal for which the fewest others have a significant one, if that is fewer.

        What three of four signals have in common is a delay of the fourth. A delay that no longer exceeds its
        uncertainty is dropped, as it would not be added.
        """
        variances = self._variances(point, active)
        with np.errstate(divide="ignore", invalid="ignore"):
            differences = point.delays - point.delays[:, None]
            significant = (differences != 0.0) & ~(differences**2 <= self._threshold * variances)
        reference = min(range(len(self.names)), key=lambda index: (significant[index].sum(), index in active))
        fewer = np.flatnonzero(significant[reference]).tolist()
        if len(fewer) >= len(active):
            return point, active
        delays = np.where(significant[reference], differences[reference], 0.0)
        simple = self._refined(self._again(point, delays), fewer)
        only_drops = reference not in active  # delays that are not significant
        if only_drops or simple.deviance - point.deviance <= self._threshold:
            return simple, fewer
        return point, active

    def _variances(self, point: _Point, active: list[int]) -> Array:
        """Return the variances (signals, signals) of the differences between two delays; zero if both are given."""
        covariance = np.zeros((len(self.names), len(self.names)))
        if active:
            covariance[np.ix_(active, active)] = self._score(point, active).covariance
        own = np.diag(covariance)
        return np.asarray(np.maximum(own + own[:, None] - 2.0 * covariance, 0.0))

    def _most_informative(self, point: _Point) -> list[int]:
        """Return the windows in which delays show most."""
        sizes = [float((delay_response(fit.objective, fit.guess) ** 2).sum()) for fit in point.fits]
        return sorted(np.argsort(sizes, kind="stable")[::-1][:SEARCHED_WINDOWS].tolist())

    def _part(self, point: _Point, chosen: Sequence[int]) -> _Point:
        fits = [point.fits[at] for at in chosen]
        return _Point(point.delays, fits, self._likelihood.deviance(fits))

    def _searched(self, before: _Point, index: int, step: float, chosen: Sequence[int]) -> _Point:
        """Return the ``chosen`` windows with the best delay of one signal: a grid, a parabola, then Gauss-Newton.

        The deviance is not smooth below a sample period, so that Gauss-Newton alone does not leave a point of the grid.
        """

        def trial(value: float, rounds: int) -> _Point:
            delays = before.delays.copy()
            delays[index] = np.clip(value, -self._limit, self._limit)
            return self._again(before, delays, chosen, rounds)

        tried = trial_delays(min(window.sample_period for window in self._windows), self._limit)
        values = np.unique(np.clip([step, 0.0, *tried], -self._limit, self._limit))
        deviances = np.array([trial(value, 1).deviance for value in values.tolist()])
        at = int(np.clip(np.argmin(deviances), 1, len(values) - 2))
        bend, slope, _ = np.polyfit(values[at - 1 : at + 2] - values[at], deviances[at - 1 : at + 2], 2)
        ends = [values[np.argmin(deviances)], values[at] - 0.5 * slope / bend if bend > 0.0 else 0.0]
        best = min([before, *(trial(float(value), FIRST_FITS) for value in ends)], key=lambda point: point.deviance)
        return best if best is before else self._refined(best, [index], SEARCH_STEPS, chosen)

    def _refined(
        self, point: _Point, signals: list[int], steps: int = MAX_STEPS, chosen: Sequence[int] | None = None
    ) -> _Point:
        """Return the minimum of the deviance by the delays of ``signals``."""
        for _ in range(steps):
            score, share = self._score(point, signals), 1.0
            if (np.abs(score.step) <= NEGLIGIBLE_STEP * np.sqrt(np.diag(score.covariance))).all():
                break
            trial = point
            while trial.deviance >= point.deviance and share > NEGLIGIBLE_STEP:
                delays = point.delays.copy()
                delays[signals] = np.clip(delays[signals] + share * score.step, -self._limit, self._limit)
                trial = self._again(point, delays, chosen)
                share *= 0.5
            if trial.deviance >= point.deviance:
                break
            point = trial
        return point

    def _results(self, point: _Point, active: list[int], declared: Mapping[str, float]) -> list[SignalDelay]:
        """Return the delays against the signal that is the least late."""
        totals = np.array([declared.get(name, 0.0) for name in self.names]) + point.delays
        least = int(np.argmin(totals))
        variances = self._variances(point, active)[least]
        results = []
        for index, name in enumerate(self.names):
            value, sd = float(totals[index] - totals[least]), float(np.sqrt(variances[index]))
            if sd > 0.0:
                at_limit = abs(point.delays[index]) >= self._limit
                results.append(SignalDelay(name, value, sd, AT_LIMIT if at_limit else ""))
                continue
            if active and index == least and (index in active or len(active) == len(self.names) - 1):
                results.append(SignalDelay(name, value, None, REFERENCE))
                continue
            undetected = float(np.sqrt(self._threshold * self._own_variance(point, active, index)))
            if undetected > MAX_UNCERTAINTY * self._limit * QUANTILE:
                results.append(SignalDelay(name, value, None, UNOBSERVABLE))
            else:
                results.append(SignalDelay(name, value, undetected / QUANTILE, NO_DELAY.format(1e3 * undetected)))
        return results

    def _own_variance(self, point: _Point, active: list[int], index: int) -> float:
        """Return the variance of the delay of a signal that has none, beside those that have one."""
        others = [other for other in active if other != index]
        if index in active:
            return 0.0
        variance = float(self._score(point, [*others, index]).covariance[-1, -1])
        return variance if variance > 0.0 else np.inf
