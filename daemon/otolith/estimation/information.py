"""The information of one window: with what was known before it, and about each parameter.

What is known of the parameters before a window is the prior; with it, the window's objective has an arrival cost (C. V.
Rao, J. B. Rawlings, D. Q. Mayne, Constrained state estimation for nonlinear discrete-time systems: stability and moving
horizon approximations, IEEE Transactions on Automatic Control 48, 2003). What the window adds is its :class:`Evidence`;
about a single parameter, the Fisher information from the sensitivities of the prediction.

A window is nonlinear in its parameters. Correlated parameters lie on a long curved ridge, and the linear approximation
at its best point claims too much. The second-order change of the residuals, one standard deviation away in every
direction, therefore counts as noise (modified Gaussian second-order filter: A. H. Jazwinski, Stochastic Processes and
Filtering Theory, section 9.3).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, cached_property
from itertools import chain, islice
from statistics import NormalDist

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.estimation.evidence import CHANCE_DEVIATE, MIN_EXPLAINED, Elimination
from otolith.estimation.minimisers import FitResult
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.twin.kernel import Indices
from otolith_drivers.units import unit_text

QUANTILE = NormalDist().inv_cdf(0.975)  # two-sided 95 % of the standard normal distribution
MIN_SINGULAR = 1e-8  # relative singular value below which a direction is not observed
MAX_BLIND_SHARE = np.sqrt(MIN_SINGULAR)  # share in an unobserved direction above which a parameter is not observed
PUSHED = 2.0  # times the required interval: with a wider interval it is not known whether the value exceeds the bound
TRADED = 0.95  # correlation above which two parameters cannot be distinguished
MAX_LAG = 0.25  # share of a window: largest lag of the autocorrelation
NOISE_DRAWS = 8  # of the noise of inputs, by which its bias is estimated
NEGLIGIBLE_BIAS = 0.02  # standard deviations of a window: a smaller bias is not corrected
MIN_KEPT_INFORMATION = 0.5  # share of the information of a direction that is not by the noise of inputs; less is noise
INFORMATION_OF_NOISE = 0.01  # share of the information of a direction that noise has determined: far less than stated
WIDEN_BOUNDS = "widen the bounds in [parameters], or check the equations of the twin"
INITIAL_TREND_SD = 1e-3  # 1/s: standard deviation of an unknown trend, relative to the parameter's size
MOVED_TREND_SD = 1e-2  # 1/s: the same of a parameter that has moved: it may go on moving
MAX_TREND = 1.0  # 1/s: bound of a trend, relative to the parameter's size


class Identifiability(StrEnum):
    """How well a window determines a parameter."""

    DETERMINED = "determined"
    WEAK = "weak"
    TRADED = "traded"
    FLAT = "flat"
    AT_BOUND = "at bound"


class Outcome(StrEnum):
    """How the search of a window ended."""

    CONTINUED = "Gauss-Newton continued from the prediction"
    AGREED = "global search and Gauss-Newton reached the same point"
    SEARCH_WAS_BETTER = "the global search found a better minimum than the prediction led to"
    PREDICTION_WAS_BETTER = "the global search found no better minimum than the prediction led to"
    UNREPEATED = "the global search ended before it found its best minimum again: the result is the best so far"
    AMBIGUOUS = "different parameters explain the window equally well"
    NOTHING_TO_FIND = "the window has too little information for a search"
    UNFINISHED = "the fit converged neither under the prior nor on the window alone: the result is the best so far"

    @classmethod
    def _missing_(cls, value: object) -> "Outcome | None":
        """Return the outcome that a report of an earlier version calls by another name."""
        former = {own.value.replace("global search", "particle swarm"): own for own in cls}
        return former.get(str(value))


@dataclass(frozen=True, slots=True)
class Information:
    """Uncertainty of every entry of a guess from one window alone."""

    sd: Array  # (guess,) standard deviation; infinite where the window has no information
    correlation: Array  # (guess, guess)


@dataclass(frozen=True, slots=True)
class ParameterEstimate:
    """The estimate of one parameter from one window alone."""

    name: str
    value: float
    sd: float  # Standard deviation; infinite where the window has no information
    identifiability: Identifiability
    reason: str
    traded_with: tuple[str, ...] = ()  # Other parameters from which the window does not distinguish it


def information(jacobian: Array, width: Array, inflation: float) -> Information:
    """Return the uncertainty from the inverse of the Fisher information ``jacobian.T @ jacobian``.

    ``jacobian`` (residuals, guess) is of whitened residuals; ``width`` (guess,) scales the entries; ``inflation``
    multiplies the standard deviations (see :func:`inflation_of`). Singular values of the sensitivities are used, as the
    normal matrix would square the condition number.
    """
    scaled = jacobian * width
    norms = np.linalg.norm(scaled, axis=0)
    alive = norms > MIN_EXPLAINED * max(float(norms.max(initial=0.0)), 1.0)
    sd = np.full(len(width), np.inf)
    correlation = np.eye(len(width))
    if alive.any():
        _, singular, rows = np.linalg.svd(scaled[:, alive] / norms[alive], full_matrices=False)
        observed = singular > MIN_SINGULAR * singular[0]
        inverse = rows[observed].T / singular[observed]
        covariance = inverse @ inverse.T
        deviation = np.sqrt(np.maximum(covariance.diagonal(), np.finfo(float).tiny))
        blind = np.abs(rows[~observed]).max(axis=0, initial=0.0) > MAX_BLIND_SHARE
        sd[alive] = np.where(blind, np.inf, deviation / norms[alive] * width[alive] * inflation)
        blinded = blind[:, None] & blind
        own = np.where(blinded, 1.0, covariance / (deviation[:, None] * deviation))
        if len(own) == len(correlation):
            correlation = own
        else:
            correlation[np.ix_(alive, alive)] = own
    return Information(sd, correlation)


def without_input_noise(root: Array, residual: Array, changes: Iterable[Array]) -> tuple[Array, Array]:
    """Return square-root information ``root`` and ``residual`` (rows,) without the bias by the noise of inputs.

    Noise of an input moves the residuals and their sensitivities alike, so that the mean of their product is not zero
    at the true parameters: errors in variables (W. A. Fuller, Measurement Error Models, section 1.1). ``changes`` are
    those (rows, columns + 1) of sensitivities and residuals by further noise of the same size (corrected score: T.
    Nakamura, Biometrika 77, 1990). A direction that mostly noise has determined has hardly any information.
    ``docs/explanation/filter.md`` has the equations.
    """
    drawn = islice(changes, NOISE_DRAWS)
    if (first := next(drawn, None)) is None:
        return root, residual
    size = np.linalg.norm(root, axis=0)
    size[size == 0.0] = np.inf  # a direction without information has no bias
    inverse = np.linalg.pinv(root / size, rcond=MIN_SINGULAR)
    # Sums over the draws: C in all but the last row and column, g in the last column.
    moments, bias = np.zeros((len(size) + 1, len(size) + 1)), np.zeros(len(residual))
    scale, draws = np.concatenate([size, [1.0]]), 0
    for change in chain([first], drawn):
        moments, draws = moments + (change / scale).T @ (change / scale), draws + 1
        bias = inverse.T @ moments[:-1, -1] / draws
        if np.abs(bias).max(initial=0.0) < NEGLIGIBLE_BIAS:
            return root, residual
    if not np.isfinite(moments).all():
        return root, residual
    # S by its eigenvalues: the share of the information of each direction that is not by the noise.
    shares, directions = np.linalg.eigh(np.eye(len(bias)) - inverse.T @ moments[:-1, :-1] @ inverse / draws)
    kept = directions[:, shares >= MIN_KEPT_INFORMATION]
    shares = np.where(shares >= MIN_KEPT_INFORMATION, np.minimum(shares, 1.0), INFORMATION_OF_NOISE)
    return (directions * shares) @ directions.T @ root, kept @ (kept.T @ (residual - bias))


def inflation_of(residuals: Array, present: Mask, cost: float) -> float:
    """Return the factor on standard deviations for a residual larger than the noise, or correlated.

    ``residuals`` (records, outputs) are whitened; those ``present`` count. What is correlated from sample to sample
    does not average out, so the largest long-run variance of an output counts (W. K. Newey, K. D. West, Econometrica
    55, 1987), as far as it exceeds the variance of all of them by more than chance.
    """
    variance = max(cost, 1.0) ** 2
    if present.all():
        of_outputs = _long_run_variances(residuals.T, variance)
    else:
        columns = (column[measured] for column, measured in zip(residuals.T, present.T, strict=True))
        of_outputs = [own for series in columns for own in _long_run_variances(series[None], variance)]
    long_run = max(variance, *of_outputs)
    return float(np.sqrt(long_run)) if np.isfinite(long_run) else float(cost)


def _long_run_variances(series: Array, expected: float) -> list[float]:
    """Return the variance of each of ``series`` (series, records) plus twice its autocovariances.

    Both count as far as white noise would not show them.

    White noise of the variance ``expected`` has no autocovariances, and n values of it show only chance: a variance
    with the relative standard deviation √(2/n), and sums of m autocovariances with √(m/n) (M. S. Bartlett, 1946). What
    lies within ``CHANCE_DEVIATE`` of these is chance; what is larger shrinks as by the positive-part rule (W. James, C.
    Stein, 1961). Lags of 1, 2 to 3, 4 to 7 and so on are summed. A negative sum ends the correlation (initial positive
    sequence: C. J. Geyer, Statistical Science 7, 1992); up to ``CHANCE_DEVIATE`` it does so by degrees.
    """
    records = series.shape[1]
    variance = np.array([own @ own for own in series]) / max(records, 1)
    by_chance, lags = CHANCE_DEVIATE * variance / np.sqrt(max(records, 1)), int(MAX_LAG * records)
    with np.errstate(divide="ignore", invalid="ignore"):  # of series that are zero, or not finite
        long_run = np.minimum(variance, expected) + _beyond(variance - expected, np.sqrt(2.0) * by_chance)
        if lags >= 2:
            spectrum = np.abs(np.fft.rfft(series, 2 ** (records + lags).bit_length())) ** 2
            starts, lengths = _sums_of_lags(lags)
            sums = np.add.reduceat(np.fft.irfft(spectrum)[:, 1:lags] / records, starts, axis=1)
            limits = by_chance[:, None] * lengths
            kept = np.minimum.accumulate(np.clip(1.0 + sums / limits, 0.0, 1.0), axis=1)
            long_run += 2.0 * np.sum(kept * _beyond(sums, limits), axis=1)
    of_series: list[float] = np.where((variance == 0.0) | ~np.isfinite(variance), variance, long_run).tolist()
    return of_series


@cache
def _sums_of_lags(lags: int) -> tuple[Indices, Array]:
    """Return where each sum begins among lags from one on, and the root of the number of its lags."""
    starts = 2 ** np.arange((lags - 1).bit_length()) - 1
    return starts, np.sqrt(np.diff(starts, append=lags - 1))


def _beyond(values: Array | float, by_chance: Array | float) -> Array:
    """Return what is left of ``values`` of which up to ``by_chance`` is chance: none of it, up to all."""
    larger = np.maximum(values, by_chance)
    return np.asarray(larger * (1.0 - (by_chance / larger) ** 2))


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """What is required of one parameter, and whether its best value lies at a bound."""

    half_width: float  # Largest half-width of the 95 % interval of a determined parameter
    unit: str
    at_bound: bool
    value: float = 0.0  # The best value
    pressure: float = 0.0  # How far beyond the bound a further step would lead, in standard deviations


def required_half_widths(problem: Problem, values: Array) -> Array:
    """Return the largest half-width (free,) of the 95 % interval of determined parameters at ``values`` (free,).

    It is relative to the value that was found: the nominal value may be a guess. A parameter that may be zero has a
    size of its own, that of its nominal value, below which an interval need not be relative.
    """
    low, high = problem.bounds
    found = np.clip(np.abs(values), low, high)
    return problem.determined_within * np.where(low > 0.0, found, np.maximum(np.abs(values), problem.scale))


def at_its_bound(value: float, unit: str) -> str:
    """Return the reason of a parameter at a bound, with the way out."""
    bound = f"{value:.4g} {unit_text(unit)}".rstrip()
    return f"at its bound {bound}: {WIDEN_BOUNDS}"


def partners(uncertainty: Information, index: int, names: Sequence[str]) -> tuple[str, ...]:
    """Return which of the parameters ``names`` can be traded with parameter ``index``."""
    correlations = np.abs(uncertainty.correlation[index, : len(names)])
    return tuple(name for at, name in enumerate(names) if at != index and correlations[at] > TRADED)


def classify(
    uncertainty: Information, index: int, names: Sequence[str], target: AccuracyTarget
) -> tuple[Identifiability, str]:
    """Return the identifiability of parameter ``index``, and the reason as a sentence."""
    reach = QUANTILE * uncertainty.sd[index]
    if target.at_bound and (reach <= PUSHED * target.half_width or target.pressure > CHANCE_DEVIATE):
        return Identifiability.AT_BOUND, at_its_bound(target.value, target.unit)
    if reach <= target.half_width:
        return Identifiability.DETERMINED, ""
    correlations = np.abs(uncertainty.correlation[index]).copy()
    correlations[index] = 0.0
    partner = int(correlations.argmax())
    if not np.isfinite(reach) and correlations[partner] <= TRADED:
        return Identifiability.FLAT, "the window does not depend on it"
    if correlations[partner] > TRADED:
        partners = f"it can be traded with {names[partner]} (correlation {correlations[partner]:.3f})"
        return Identifiability.TRADED, partners
    bound = "; its best value lies at its bound" if target.at_bound else ""
    unit = unit_text(target.unit)
    reached, asked = (f"{value:.3g} {unit}".rstrip() for value in (reach, target.half_width))
    weak = f"the window determines it to ±{reached} only, ±{asked} is required: too little excitation"
    return Identifiability.WEAK, weak + bound


@dataclass(frozen=True, eq=False)  # no slots: what follows from it is computed once
class Prior:
    """A normal distribution of the parameters at the end of a window, then of their trends per second."""

    mean: Array  # (2 free,)
    covariance: Array  # (2 free, 2 free)

    @cached_property
    def sd(self) -> Array:
        """(2 free,) standard deviations."""
        return np.asarray(np.sqrt(self.covariance.diagonal()))

    @cached_property
    def whitening(self) -> Array:
        """(2 free, 2 free) matrix that makes deviations from the mean independent with unit variance."""
        correlation = self.covariance / np.outer(self.sd, self.sd)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(correlation)) / self.sd)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The information of one window about parameters and trends, with the initial state eliminated.

    Square-root information form (G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, chapter V):
    ``residual + sqrt_information @ (z - point)`` has unit variance for the true ``z``.
    """

    point: Array  # (2 free,)
    sqrt_information: Array  # (2 free, 2 free)
    residual: Array  # (2 free,)


def initial_prior(problem: Problem) -> Prior:
    """Return the prior before the first window, from the values and bounds of the machine file."""
    low, high = problem.bounds
    deviations = np.concatenate([(high - low) / np.sqrt(12.0), INITIAL_TREND_SD * problem.scale])
    return Prior(np.concatenate([problem.nominal, np.zeros(len(low))]), np.diag(deviations**2))


def extend_prior(prior: Prior, problem: Problem, wider: Problem) -> Prior:
    """Return ``prior`` of ``problem`` for ``wider``, whose additional parameters have the initial prior."""
    extended, free = initial_prior(wider), len(wider.free)
    order = [parameter.name for parameter in wider.free]
    columns = [order.index(parameter.name) for parameter in problem.free]
    columns += [free + column for column in columns]
    extended.mean[columns] = prior.mean
    extended.covariance[np.ix_(columns, columns)] = prior.covariance
    return extended


def forget_parameter(prior: Prior, problem: Problem, index: int) -> Prior:
    """Return ``prior`` with the initial prior for one parameter, which may go on moving."""
    mean, covariance, fresh = prior.mean.copy(), prior.covariance.copy(), initial_prior(problem)
    trend = index + len(problem.free)
    fresh.covariance[trend, trend] = (MOVED_TREND_SD * problem.scale[index]) ** 2
    for at in (index, trend):
        mean[at] = fresh.mean[at]
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = fresh.covariance[at, at]
    return Prior(mean, covariance)


class MapObjective:
    """The objective of a window plus the prior. A guess holds parameters at the end, trends, and the initial state."""

    def __init__(self, objective: Objective, problem: Problem, prior: Prior) -> None:
        free = objective.free
        reach = MAX_TREND * problem.scale
        self.low = np.concatenate([objective.low[:free], -reach, objective.low[free:]])
        self.high = np.concatenate([objective.high[:free], reach, objective.high[free:]])
        self._objective = objective
        self._mean = prior.mean
        self._whitening = prior.whitening
        self._prior_jacobian = np.zeros((len(prior.mean), len(self.low)))
        self._prior_jacobian[:, : len(prior.mean)] = self._whitening

    def guess(self, parameters: Array, initial: Array) -> Array:
        """Return the guess of ``parameters`` (free,) and ``initial`` (states,) with the trends of the prior."""
        return np.concatenate([parameters, self._mean[len(parameters) :], initial])

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """Return the residuals of the window, then of the prior, and their derivatives."""
        residuals, jacobian = self._objective.linearise_with_trends(guess)
        count = len(self._mean)
        prior_residuals = self._whitening @ (guess[:count] - self._mean)
        return np.concatenate([residuals, prior_residuals]), np.concatenate([jacobian, self._prior_jacobian])

    def evidence(self, fit: FitResult, inflation: float, *, has_noisy_inputs: bool = True) -> Evidence:
        """Return the evidence of the window around ``fit``; ``inflation`` multiplies its standard deviations.

        If ``has_noisy_inputs``, it is without the bias that their noise causes. Symbols in the comments are those of
        ``docs/explanation/filter.md``.
        """
        count = len(self._mean)
        residuals, jacobian = fit.residuals[:-count], fit.jacobian[:-count]
        constant = np.concatenate([np.arange(count // 2), np.arange(count, len(fit.guess))])  # all but the trends
        curvature = linearisation_errors(self._objective, fit.guess[constant], fit.jacobian[:, constant])
        of_states = Elimination.of(jacobian[:, count:], (self.high - self.low)[count:])
        columns = np.concatenate([jacobian[:, :count], residuals[:, None], curvature], axis=1)  # J, r, N
        columns = of_states.left(columns)
        basis, root = np.linalg.qr(columns[:, :count])  # J = QR
        rotated = basis.T @ columns[:, count:]
        residual, noise = rotated[:, 0], rotated[:, 1:]  # b and N, in the directions that R measures
        if has_noisy_inputs:
            moved = self._objective.changes_by_input_noise(fit.guess, residuals, jacobian)
            parts = (of_states.left(np.delete(rows, np.s_[count:-1], axis=1)) for rows in moved)
            root, residual = without_input_noise(root, residual, parts)  # R' and b'
        root, residual = _with_noise(root / inflation, residual / inflation, noise)
        return Evidence(fit.guess[:count], root, residual)


def linearisation_errors(objective: Objective, guess: Array, jacobian: Array) -> Array:
    """Return the errors (residuals, directions) of linearised residuals, one standard deviation from ``guess``.

    Each is the mean of both sides, without what the linear window predicts there: their second-order change. A side
    where a bound cuts the step off shows less, so the other one counts alone. ``jacobian`` (rows, guess) includes the
    rows of the prior.
    """
    count = objective.measured.size
    if not np.isfinite(jacobian).all():
        return np.zeros((count, 0))
    size = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    _, singular, directions = np.linalg.svd(np.linalg.qr(jacobian / size, mode="r"))
    kept = singular > MIN_EXPLAINED * singular[0]
    steps = directions[kept] / singular[kept, None] / size
    around = np.concatenate([guess + steps, guess - steps, guess[None]])
    inside = np.clip(around, objective.low, objective.high)
    with np.errstate(over="ignore", invalid="ignore"):
        residuals = objective.residuals(objective.predict(inside)).reshape(len(around), -1)
        errors = (residuals - residuals[-1])[:-1] - (inside[:-1] - guess) @ jacobian[:count].T
    above, below = np.split((inside == around).all(axis=1)[:-1], 2)  # whether a whole step is within the bounds
    share = np.where(above == below, 0.5, np.where(above, 1.0, 0.0))[:, None]
    upper, lower = np.split(errors, 2)
    change = share * upper + (1.0 - share) * lower
    return np.asarray(np.where(np.isfinite(change).all(axis=1)[:, None], change, 0.0).T)


def _with_noise(root: Array, residual: Array, noise: Array) -> tuple[Array, Array]:
    """Whiten ``root`` (rows, columns) and ``residual`` (rows,) again, with additional ``noise`` (rows, directions).

    The inverse square root of the covariance I + N Nᵀ is formed from the singular values of N, so that rounding cannot
    make it singular.
    """
    basis, sizes, _ = np.linalg.svd(noise, full_matrices=False)
    share = 1.0 - 1.0 / np.hypot(1.0, sizes)
    return root - (basis * share) @ (basis.T @ root), residual - (basis * share) @ (basis.T @ residual)
