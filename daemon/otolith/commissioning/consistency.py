"""Tests of identified noise levels: consistent estimates, and white innovations.

Consistency: do the estimates of several windows scatter as much as their uncertainties predict? White process noise is
identified from fast innovations, so it misses an error of the twin that is slow compared with the sample period. Each
window then underestimates its uncertainty, which only other windows can show. Process noise is inflated until the
windows are consistent.

A machine that changes between two windows, as a load that is put down, is no noise: the windows before and after it are
compared among themselves.

Whiteness: noise levels that are right leave white innovations. Two tests of all windows together: their
autocorrelations (G. M. Ljung, G. E. P. Box, Biometrika 65, 1978), and their cumulative periodogram against a straight
line (M. S. Bartlett, An Introduction to Stochastic Processes, section 9.3). The first finds a short memory, the second
a slow disturbance, whose correlation is small at every single lag.

``docs/explanation/noise-identification.md`` has the equations.
"""

from bisect import bisect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from otolith.acquisition.window import Array
from otolith.commissioning.likelihood import Fits, FittedWindow, Likelihood
from otolith.estimation.evidence import Elimination

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
MIN_INFORMATION = 2.0  # prior standard deviations per one of the window: below it, a direction is not determined
SIGNIFICANCE = 0.05  # probability of a larger chi-square by chance, below which windows are inconsistent
MAX_FACTOR = 1e4  # on process noise
HARDLY_MORE = 1.1  # times the least reduced chi-square of all factors
BRACKET_RATIO = 2.0  # between successive factors until they enclose the solution
FACTOR_TOLERANCE = 0.01  # of the factor's logarithm
MIN_REGIME = 4  # windows between two changes of the machine
CHANGE_SIGNIFICANCE = 1e-6  # probability of a difference by chance, below which the machine has changed
MAX_OUTLYING_SHARE = 0.2  # of the windows: more of them are no exceptions
OUTLYING = 4.75  # standard deviations from which on a window is not one of the machine that the others show
LAGS = 20  # of the autocorrelation, records
MIN_RECORDS = 2 * LAGS  # of a window
WHITE_SIGNIFICANCE = 1e-3  # probability of a result by chance, below which innovations are coloured, or a sign is wrong
BAND_RATIO = 4.0  # between the ends of a band of the spectrum


Estimates = Sequence[tuple[Array, Array]]
"""Of each window the square root of its information about some values, and that times their estimates."""


@dataclass(frozen=True, slots=True)
class Band:
    """The power of the innovations between two frequencies."""

    low: float  # Hz
    high: float  # Hz
    ratio: float  # Over the power of white noise with the noise levels


@dataclass(frozen=True, slots=True)
class Whiteness:
    """The innovations of one output, in all windows together."""

    output: str
    correlation: float  # The autocorrelation of largest magnitude
    lag: float  # s, of that autocorrelation
    of_correlations: float  # Probability that white noise has autocorrelations as large
    of_periodogram: float | None
    """Probability that the cumulative periodogram of white noise is as far from a line; None at irregular times."""
    bands: tuple[Band, ...]  # From low to high frequencies; none at irregular times

    @property
    def is_white(self) -> bool:
        """Whether chance explains both tests."""
        of_periodogram = 1.0 if self.of_periodogram is None else self.of_periodogram
        return min(self.of_correlations, of_periodogram) >= WHITE_SIGNIFICANCE


def whiteness(fits: Fits) -> tuple[Whiteness, ...]:
    """Return the tests of each output; none of an output that is hardly measured."""
    names = [output.name for output in fits[0].objective.kernel.definition.outputs]
    rows = [_of_output(name, index, fits) for index, name in enumerate(names)]
    return tuple(row for row in rows if row is not None)


def _of_output(name: str, index: int, fits: Fits) -> Whiteness | None:
    from scipy.special import chdtrc  # noqa: PLC0415 - only noise identification needs SciPy

    series, steps, uniform = list[Array](), list[float](), list[Array]()
    for fit in fits:
        present, grid = fit.objective.present[:, index], fit.window.grid
        values = fit.result.residuals.reshape(fit.objective.measured.shape)[present, index]
        if len(values) < MIN_RECORDS:
            continue
        series.append(values)
        steps.append(float(np.median(np.diff(grid.offsets[present]))))
        if grid.period is not None and present.all():
            uniform.append(values)
    if not series:
        return None
    correlations, counts = _autocorrelations(series)
    largest = int(np.abs(correlations).argmax())
    probability = float(chdtrc(LAGS, float((counts * correlations**2).sum())))
    step = float(np.median(steps))
    of_periodogram, bands = _spectrum([values for values in uniform if len(values) == len(uniform[0])], step)
    return Whiteness(name, float(correlations[largest]), step * (largest + 1), probability, of_periodogram, bands)


def _autocorrelations(series: Sequence[Array]) -> tuple[Array, Array]:
    """Return the autocorrelations (lags,) of all series together, and how many products each has."""
    power = sum(float(values @ values) for values in series) / sum(map(len, series))
    lags = np.arange(1, LAGS + 1)
    products = np.array([sum(float(values[lag:] @ values[:-lag]) for values in series) for lag in lags])
    counts = np.array([sum(len(values) - lag for values in series) for lag in lags], dtype=np.float64)
    return products / counts / max(power, np.finfo(float).tiny), counts


def _spectrum(series: Sequence[Array], step: float) -> tuple[float | None, tuple[Band, ...]]:
    """Return the probability of the cumulative periodogram, and the bands, of ``series`` of equal length.

    The mean of W periodograms of m frequencies differs from a line as that of one with W m frequencies.
    """
    from scipy.special import kolmogorov  # noqa: PLC0415 - only noise identification needs SciPy

    if not series:
        return None, ()
    records = len(series[0])
    count = (records - 1) // 2
    power = np.mean([np.abs(np.fft.rfft(values)[1 : count + 1]) ** 2 / records for values in series], axis=0)
    frequencies = np.arange(1, count + 1) / (records * step)
    cumulative = np.cumsum(power) / max(float(power.sum()), np.finfo(float).tiny)
    deviation = float(np.abs(cumulative - np.arange(1, count + 1) / count).max())
    edges = [float(frequencies[0])]
    while edges[-1] <= frequencies[-1]:
        edges.append(BAND_RATIO * edges[-1])
    bands = tuple(
        Band(low, min(high, 0.5 / step), float(power[(low <= frequencies) & (frequencies < high)].mean()))
        for low, high in pairwise(edges)
    )
    return float(kolmogorov(deviation * np.sqrt(count * len(series)))), bands


@dataclass(frozen=True, slots=True)
class ChiSquareTest:
    """Chi-square of the windows' estimates about their common weighted mean."""

    reduced: float  # Per degree of freedom: 1 is expected. Not a number without degrees of freedom
    degrees: int  # Degrees of freedom; 0 if no two windows determine the same direction

    @property
    def passed(self) -> bool:
        """Whether chance explains the scatter."""
        if not self.degrees:
            return True
        from scipy.special import chdtri  # noqa: PLC0415 - only noise identification needs SciPy

        return bool(self.reduced <= chdtri(self.degrees, SIGNIFICANCE) / self.degrees)


def consistency_test(fits: Fits, width: Array, changes: Sequence[float] = ()) -> ChiSquareTest:
    """The test of ``fits``, which have a mean of their own after each of the ``changes`` (start of a window).

    ``width`` (guess,) is :attr:`Likelihood.width`.
    """
    parts = [CommonValues.of([whitened(fit, width) for fit in part]) for part in regimes(fits, changes)]
    chi_square, degrees = sum(part.chi_square for part in parts), sum(part.degrees for part in parts)
    return ChiSquareTest(chi_square / degrees if degrees else float("nan"), degrees)


def regimes(fits: Fits, changes: Sequence[float]) -> list[list[FittedWindow]]:
    """Return the windows before, between and after the ``changes``."""
    return [list(part) for _, part in groupby(fits, key=lambda fit: bisect(changes, fit.window.start))]


def changes_of_the_machine(fits: Fits, width: Array) -> tuple[float, ...]:
    """Return the starts of the windows from which on the machine is another than before, in their order.

    The windows before and after a change agree much better among themselves than all of them do.
    """
    if consistency_test(fits, width).passed:
        return ()
    return tuple(fits[at].window.start for at in _changes([whitened(fit, width) for fit in fits]))


def _changes(rows: Estimates) -> list[int]:
    """Return which windows are the first after a change.

    The window in which it falls belongs to neither side. The probability of a change by chance is that of an F test,
    times the number of tests.
    """
    trials = []
    for at in range(MIN_REGIME, len(rows) - MIN_REGIME):
        for reach in (MIN_REGIME, len(rows)):  # the nearest windows alone show a change that is taken back
            rest = [*rows[max(0, at - reach) : at], *rows[at + 1 : at + 1 + reach]]
            same, apart = CommonValues.of(rest), CommonValues.of(rest, step_at(min(at, reach), len(rest)))
            if 0 < apart.degrees < same.degrees:
                chance, ratio = chance_of_change(same, apart)
                trials.append((chance, -ratio, at))
    probability, _, at = min(trials, default=(1.0, 0.0, 0))
    if not trials or probability * len(trials) > CHANGE_SIGNIFICANCE:
        return []
    before, after = rows[:at], rows[at + 1 :]
    misfits = [
        CommonValues.of([*own, rows[at]]).chi_square - CommonValues.of(own).chi_square for own in (before, after)
    ]
    first = at + 1 if misfits[0] < misfits[1] else at
    return [*_changes(before), first, *(at + 1 + later for later in _changes(after))]


def whitened(fit: FittedWindow, width: Array, own: Sequence[int] | None = None) -> tuple[Array, Array]:
    """Return :func:`sqrt_information` and the estimate multiplied by it, of unit variance."""
    root, places = sqrt_information(fit, width, own), list(range(fit.objective.free) if own is None else own)
    return root, root @ (fit.guess[places] / width[places])


@dataclass(frozen=True, slots=True, eq=False)
class CommonValues:
    """The weighted least squares of what windows estimate, in units of the width."""

    chi_square: float  # That it leaves
    degrees: int  # Of freedom that are left
    values: Array  # (terms, values)
    stacked: Array  # (determined directions, terms * values)

    @classmethod
    def of(cls, rows: Estimates, shape: Array | None = None) -> "CommonValues":
        """Return those of values that are linear combinations of the terms ``shape`` (windows, terms).

        By default, they are the same in all windows.
        """
        terms = np.ones((len(rows), 1)) if shape is None else shape
        stacked = np.vstack([np.kron(own, root) for (root, _), own in zip(rows, terms, strict=True)])
        estimates = np.concatenate([estimate for _, estimate in rows])
        found, _, rank, _ = np.linalg.lstsq(stacked, estimates, rcond=None)
        errors = stacked @ found - estimates
        return cls(float(errors @ errors), len(estimates) - int(rank), found.reshape(terms.shape[1], -1), stacked)


def step_at(at: int, count: int) -> Array:
    """Return the terms (windows, 2) of values that are others from window ``at`` on."""
    return np.column_stack([np.ones(count), np.arange(count) >= at])


def chance_of_change(same: CommonValues, changed: CommonValues) -> tuple[float, float]:
    """Return the probability that noise alone explains by how much less a model of change leaves, and the F ratio.

    The scatter that it leaves counts, so that windows which an imperfect twin explains differently are no change.
    """
    from scipy.special import fdtrc  # noqa: PLC0415 - only commissioning needs SciPy

    more = same.degrees - changed.degrees
    reduced = max(changed.chi_square / changed.degrees, 1.0)
    ratio = (same.chi_square - changed.chi_square) / more / reduced
    return float(fdtrc(more, changed.degrees, ratio)), ratio


def outlyingness(fits: Fits, index: int, width: Array) -> float:
    """By how many standard deviations chance fails to explain window ``index`` if the machine is that of the others.

    That is the larger of two: of its innovations, and of its distance from the weighted mean of the others, whose
    uncertainty counts as well.
    """
    fit, others = fits[index], [*fits[:index], *fits[index + 1 :]]
    free = fit.objective.free
    deviate = _normal_deviate(fit.result.chi_square, int(fit.objective.count))
    # Without the reduction by large residuals, which would make a misfit look uncertain instead of improbable.
    own = sqrt_information(fit, width) * np.sqrt(fit.discount)
    roots = [sqrt_information(other, width) for other in others]
    stacked = np.vstack(roots)
    if not len(own) or not len(stacked):
        return deviate
    estimates = [root @ (other.guess[:free] / width[:free]) for root, other in zip(roots, others, strict=True)]
    mean = np.linalg.lstsq(stacked, np.concatenate(estimates), rcond=None)[0]
    distance = own @ (fit.guess[:free] / width[:free] - mean)
    # The bounds are the prior, so that what the others do not determine is uncertain.
    uncertainty = np.linalg.inv(stacked.T @ stacked + np.eye(free))
    chi_square = distance @ np.linalg.solve(np.eye(len(own)) + own @ uncertainty @ own.T, distance)
    return max(deviate, _normal_deviate(float(chi_square), len(own)))


def _normal_deviate(chi_square: float, degrees: int) -> float:
    """Standard normal deviate of the same probability (E. B. Wilson, M. M. Hilferty, PNAS 17, 1931)."""
    spread = 2.0 / (9.0 * degrees)
    return float((np.cbrt(chi_square / degrees) - 1.0 + spread) / np.sqrt(spread))


def sqrt_information(fit: FittedWindow, width: Array, own: Sequence[int] | None = None) -> Array:
    """(determined directions, own) square root of the information about its ``own`` values, in units of ``width``.

    They are all parameters by default. All others, and the initial state, are eliminated. Residuals larger than the
    noise reduce the information.
    """
    jacobian, places = fit.result.jacobian, list(range(fit.objective.free) if own is None else own)
    others = [place for place in range(len(width)) if place not in places]
    left = Elimination.of(jacobian[:, others], width[others]).left(jacobian[:, places] * width[places])
    _, singular, directions = np.linalg.svd(left, full_matrices=False)
    singular = singular / np.sqrt(fit.discount)
    determined = singular > MIN_INFORMATION
    return np.asarray(singular[determined, None] * directions[determined])


def inflate_process_noise(
    likelihood: Likelihood, levels: Callable[[float], Array], fits: Fits, changes: Sequence[float] = ()
) -> tuple[float, ChiSquareTest, Fits]:
    """The factor on process noise that makes the reduced chi-square of ``fits`` one, and test and fits with it.

    ``levels`` returns the levels (outputs + states,) for a factor; for ``changes`` see :func:`consistency_test`. If
    none suffices, it is the smallest one that leaves hardly more than the best.
    """
    from scipy.optimize import brentq  # noqa: PLC0415 - only noise identification needs SciPy

    tried = {0.0: (fits, consistency_test(fits, likelihood.width, changes))}

    def log_excess(log_factor: float) -> float:
        if log_factor not in tried:
            last, _ = list(tried.values())[-1]
            refitted = likelihood.refit(levels(float(np.exp(log_factor))), last)
            tried[log_factor] = refitted, consistency_test(refitted, likelihood.width, changes)
        _, test = tried[log_factor]
        return float(np.log(test.reduced)) if test.degrees else -1.0

    low, high = 0.0, float(np.log(BRACKET_RATIO))
    while log_excess(high) > 0.0 and high <= np.log(MAX_FACTOR):
        low, high = high, high + float(np.log(BRACKET_RATIO))
    if log_excess(high) <= 0.0:
        high = float(brentq(log_excess, low, high, xtol=FACTOR_TOLERANCE, rtol=FACTOR_TOLERANCE))
        log_excess(high)
    else:
        least = min(test.reduced for _, test in tried.values())
        high = min(log_factor for log_factor, (_, test) in tried.items() if test.reduced <= HARDLY_MORE * least)
    refitted, test = tried[high]
    return float(np.exp(high)), test, refitted
