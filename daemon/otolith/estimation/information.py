"""The information of one window about each parameter: Fisher information from the sensitivities of the prediction."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import islice, takewhile

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith_drivers.units import unit_text

QUANTILE = 1.959964  # two-sided 95 % of the standard normal distribution
MIN_SINGULAR = 1e-8  # relative singular value below which a direction is not observed
MIN_BASIS_SINGULAR = 1e-10  # relative singular value of the directions that are projected out
MAX_BLIND_SHARE = 1e-4  # share in an unobserved direction above which a parameter is not observed
MIN_SENSITIVITY = 1e-9  # relative to the largest: a smaller sensitivity is none
PUSHED = 2.0  # times the required interval: with a wider one it is open whether the value is beyond the bound
PRESSED = 3.0  # standard deviations by which a step without bounds must pass a bound: the value is beyond it
TRADED = 0.95  # correlation above which two parameters cannot be distinguished
MIN_INFLATED_COST = 1.1  # cost above which the residual is tested for autocorrelation: noise alone hardly reaches it
MAX_LAG = 0.25  # share of a window: largest lag of the autocorrelation
NOISE_DRAWS = 8  # of the noise of inputs, by which its bias is estimated
NEGLIGIBLE_BIAS = 0.02  # standard deviations of a window: a smaller bias is not corrected
MIN_KEPT_INFORMATION = 0.5  # share of the information of a direction that is not by the noise of inputs; less is noise
INFORMATION_OF_NOISE = 0.01  # share of the information of a direction that noise has determined: far less than stated
CORRELATED = 2.0  # long-run variance over variance above which an autocorrelation is not chance


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
    AGREED = "particle swarm and Gauss-Newton reached the same point"
    SWARM_WAS_BETTER = "the particle swarm found a better minimum than the prediction led to"
    PREDICTION_WAS_BETTER = "the particle swarm found no better minimum than the prediction led to"
    AMBIGUOUS = "different parameters explain the window equally well"
    NOTHING_TO_FIND = "the window has too little information for a search"
    UNFINISHED = "the fit converged neither under the prior nor on the window alone: the result is the best so far"


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


def information(jacobian: Array, width: Array, inflation: float) -> Information:
    """Return the uncertainty from the inverse of the Fisher information ``jacobian.T @ jacobian``.

    ``jacobian`` (residuals, guess) is of whitened residuals; ``width`` (guess,) scales the entries; ``inflation``
    multiplies the standard deviations (see :func:`inflation_of`). Singular values of the sensitivities are used, as the
    normal matrix would square the condition number.
    """
    scaled = jacobian * width
    norms = np.linalg.norm(scaled, axis=0)
    alive = norms > MIN_SENSITIVITY * max(float(norms.max(initial=0.0)), 1.0)
    sd = np.full(len(width), np.inf)
    correlation = np.eye(len(width))
    if alive.any():
        _, singular, rows = np.linalg.svd(scaled[:, alive] / norms[alive], full_matrices=False)
        observed = singular > MIN_SINGULAR * singular[0]
        inverse = rows[observed].T / singular[observed]
        covariance = inverse @ inverse.T
        deviation = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        blind = np.abs(rows[~observed]).max(axis=0, initial=0.0) > MAX_BLIND_SHARE
        sd[alive] = np.where(blind, np.inf, deviation / norms[alive] * width[alive] * inflation)
        correlation[np.ix_(alive, alive)] = np.where(
            np.outer(blind, blind), 1.0, covariance / np.outer(deviation, deviation)
        )
    return Information(sd, correlation)


def without_input_noise(root: Array, residual: Array, changes: Iterable[Array]) -> tuple[Array, Array]:
    """Return square-root information ``root`` and ``residual`` (rows,) without the bias by the noise of inputs.

    Noise of an input moves the residuals and their sensitivities alike, so that the mean of their product is not zero
    at the true parameters: errors in variables (W. A. Fuller, Measurement Error Models, section 1.1). ``changes`` are
    those (rows, columns + 1) of sensitivities and residuals by further noise of the same size (corrected score: T.
    Nakamura, Biometrika 77, 1990). A direction that mostly noise has determined has hardly any information.
    ``docs/explanation/filter.md`` has the equations.
    """
    size = np.linalg.norm(root, axis=0)
    size[size == 0.0] = np.inf  # a direction without information has no bias
    inverse = np.linalg.pinv(root / size, rcond=MIN_SINGULAR)
    moments, bias = np.zeros((len(size) + 1, len(size) + 1)), np.zeros(len(residual))
    scale, draws = np.append(size, 1.0), 0
    for change in islice(changes, NOISE_DRAWS):
        moments, draws = moments + (change / scale).T @ (change / scale), draws + 1
        bias = inverse.T @ moments[:-1, -1] / draws
        if np.abs(bias).max(initial=0.0) < NEGLIGIBLE_BIAS:
            return root, residual
    if not np.isfinite(moments).all():
        return root, residual
    shares, directions = np.linalg.eigh(np.eye(len(bias)) - inverse.T @ moments[:-1, :-1] @ inverse / max(draws, 1))
    kept = directions[:, shares >= MIN_KEPT_INFORMATION]
    shares = np.where(shares >= MIN_KEPT_INFORMATION, np.minimum(shares, 1.0), INFORMATION_OF_NOISE)
    return (directions * shares) @ directions.T @ root, kept @ (kept.T @ (residual - bias))


def orthonormal_basis(jacobian: Array) -> Array:
    """Return an orthonormal basis (residuals, directions) of what a change of the guess can explain."""
    size = np.linalg.norm(jacobian, axis=0)
    alive = size > 0.0
    basis, singular, _ = np.linalg.svd(jacobian[:, alive] / size[alive], full_matrices=False)
    return np.asarray(basis[:, singular > MIN_BASIS_SINGULAR * singular.max(initial=0.0)])


def inflation_of(residuals: Array, present: Mask, cost: float) -> float:
    """Return the factor on standard deviations for a residual larger than the noise.

    ``residuals`` (records, outputs) are whitened; those ``present`` count. What exceeds the noise is correlated from
    sample to sample and does not average out, so its long-run variance counts (W. K. Newey, K. D. West, Econometrica
    55, 1987), summed up to the first lag without correlation. White residuals show a correlation by chance, always of
    one sign; up to that size their variance alone counts.
    """
    if cost <= MIN_INFLATED_COST:
        return max(cost, 1.0)
    long_run = cost**2
    for column, measured in zip(residuals.T, present.T, strict=True):
        series = column if measured.all() else column[measured]
        records = len(series)
        lags = range(1, max(int(MAX_LAG * records), 1))
        covariances = (float(series[lag:] @ series[:-lag]) / records for lag in lags)
        variance = float(series @ series) / max(records, 1)
        total = variance + 2.0 * sum(takewhile(lambda covariance: covariance > 0.0, covariances))
        long_run = max(long_run, total if total > CORRELATED * variance else variance)
    return float(np.sqrt(long_run)) if np.isfinite(long_run) else float(cost)


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """What is required of one parameter, and whether its best value lies at a bound."""

    half_width: float  # Largest half-width of the 95 % interval of a determined parameter
    unit: str
    at_bound: bool
    value: float = 0.0  # The best value
    pressure: float = 0.0  # How far beyond the bound a further step would lead, in standard deviations


def at_its_bound(value: float, unit: str) -> str:
    """Return the reason of a parameter at a bound, with the way out."""
    bound = f"{value:.4g} {unit_text(unit)}".rstrip()
    return f"at its bound {bound}: widen the bounds in [parameters], or check the equations of the twin"


def classify(
    uncertainty: Information, index: int, names: Sequence[str], target: AccuracyTarget
) -> tuple[Identifiability, str]:
    """Return the identifiability of parameter ``index``, and the reason as a sentence."""
    reach = QUANTILE * uncertainty.sd[index]
    if target.at_bound and (reach <= PUSHED * target.half_width or target.pressure > PRESSED):
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
