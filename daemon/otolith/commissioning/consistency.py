"""Consistency test: do the estimates of several windows scatter as much as their uncertainties predict?

White process noise is identified from fast innovations, so it misses an error of the twin that is slow compared with
the sample period. Each window then underestimates its uncertainty, which only other windows can show. Process noise is
inflated until the windows are consistent.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.commissioning.likelihood import Fits, FittedWindow, Likelihood
from otolith.estimation.arrival_cost import eliminate_states

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
MIN_INFORMATION = 2.0  # prior standard deviations per one of the window: below it, a direction is not determined
SIGNIFICANCE = 0.05  # probability of a larger chi-square by chance, below which windows are inconsistent
MAX_FACTOR = 1e4  # on process noise
BRACKET_RATIO = 2.0  # between successive factors until they enclose the solution
FACTOR_TOLERANCE = 0.01  # of the factor's logarithm
MAX_OUTLYING_SHARE = 0.2  # of the windows: more of them are no exceptions
OUTLYING = 4.75  # standard deviations from which on a window is not one of the machine that the others show


@dataclass(frozen=True, slots=True)
class ChiSquareTest:
    """Chi-square of the windows' estimates about their common weighted mean."""

    reduced: float
    """Per degree of freedom: 1 is expected. Not a number without degrees of freedom."""
    degrees: int
    """Degrees of freedom; 0 if no two windows determine the same direction."""

    @property
    def passed(self) -> bool:
        """Whether chance explains the scatter."""
        if not self.degrees:
            return True
        from scipy.special import chdtri  # noqa: PLC0415 - only noise identification needs SciPy

        return bool(self.reduced <= chdtri(self.degrees, SIGNIFICANCE) / self.degrees)


def consistency_test(fits: Fits, width: Array) -> ChiSquareTest:
    """The test of ``fits``; ``width`` (guess,) is :attr:`Likelihood.width`."""
    free = fits[0].objective.free
    roots = [sqrt_information(fit, width) for fit in fits]
    stacked = np.vstack(roots)
    if not len(stacked):
        return ChiSquareTest(float("nan"), 0)
    estimates = [root @ (fit.guess[:free] / width[:free]) for root, fit in zip(roots, fits, strict=True)]
    whitened = np.concatenate(estimates)
    mean, _, rank, _ = np.linalg.lstsq(stacked, whitened, rcond=None)
    degrees = len(stacked) - int(rank)
    deviations = stacked @ mean - whitened
    return ChiSquareTest(float(deviations @ deviations) / degrees if degrees else float("nan"), degrees)


def outlyingness(fits: Fits, index: int, width: Array) -> float:
    """By how many standard deviations chance fails to explain window ``index`` if the machine is that of the others.

    That is the larger of two: of its innovations, and of its distance from the weighted mean of the others, whose
    uncertainty counts as well.
    """
    fit, others = fits[index], [*fits[:index], *fits[index + 1 :]]
    free = fit.objective.free
    deviate = _normal_deviate(fit.result.chi_square, int(fit.objective.count))
    # Without the reduction by large residuals, which would make a misfit look uncertain instead of improbable.
    own = sqrt_information(fit, width) * max(fit.cost, 1.0)
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


def sqrt_information(fit: FittedWindow, width: Array) -> Array:
    """(determined directions, free) square root of the information about the parameters, in units of ``width``.

    The initial state is eliminated. Residuals larger than the noise reduce the information.
    """
    free = fit.objective.free
    scaled = fit.result.jacobian * width
    _, singular, directions = np.linalg.svd(eliminate_states(scaled[:, :free], scaled[:, free:]), full_matrices=False)
    singular = singular / max(fit.cost, 1.0)
    determined = singular > MIN_INFORMATION
    return np.asarray(singular[determined, None] * directions[determined])


def inflate_process_noise(
    likelihood: Likelihood, levels: Callable[[float], Array], fits: Fits
) -> tuple[float, ChiSquareTest, Fits]:
    """The factor on process noise that makes the reduced chi-square of ``fits`` one, and test and fits with it.

    ``levels`` returns the levels (outputs + states,) for a factor. If none suffices, the test of the largest is failed.
    """
    from scipy.optimize import brentq  # noqa: PLC0415 - only noise identification needs SciPy

    tried = {0.0: (fits, consistency_test(fits, likelihood.width))}

    def log_excess(log_factor: float) -> float:
        if log_factor not in tried:
            last, _ = list(tried.values())[-1]
            refitted = likelihood.refit(levels(float(np.exp(log_factor))), last)
            tried[log_factor] = refitted, consistency_test(refitted, likelihood.width)
        _, test = tried[log_factor]
        return float(np.log(test.reduced)) if test.degrees else -1.0

    low, high = 0.0, float(np.log(BRACKET_RATIO))
    while log_excess(high) > 0.0 and high <= np.log(MAX_FACTOR):
        low, high = high, high + float(np.log(BRACKET_RATIO))
    if log_excess(high) <= 0.0:
        high = float(brentq(log_excess, low, high, xtol=FACTOR_TOLERANCE, rtol=FACTOR_TOLERANCE))
        log_excess(high)
    refitted, test = tried[high]
    return float(np.exp(high)), test, refitted
