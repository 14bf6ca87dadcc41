"""The evidence of a window for one alternative: the one definition of -2 log p(window | alternative).

Around a point, the whitened residuals of a window are r = J z + e. The errors e are independent with unit variance, and
of the values z (parameters, trends, initial state, amplitudes of components) a normal distribution with the covariance
P is known beforehand. Integrated over z, up to a constant that all alternatives share::

    -2 log p  =  min over z of (|r - J z|² + zᵀ P⁻¹ z)  +  ln|S|  +  ln|I + J P Jᵀ|
                 χ², of window and prior                     spread     complexity

S is the covariance of the innovations before they were whitened. Where nothing is known of k values, n measured ones
make the complexity k ln n (Bayesian information criterion: G. Schwarz, Annals of Statistics 6, 1978).

Where even the best alternative leaves more than the noise, what it leaves is no independent evidence for any of them:
χ² is divided by the *discount*. ``docs/explanation/evidence.md`` says where it is which.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import erfc, exp, gamma, sqrt
from statistics import NormalDist

import numpy as np

from otolith.acquisition.window import Array

# Thresholds: docs/reference/thresholds-estimation.md has the origin of each.
DECISIVE = 10.0  # in -2 log evidence: a Bayes factor of 150, "very strong" (R. E. Kass, A. E. Raftery, 1995)
LEVEL_ERROR = 1.235  # factor by which the noise may be larger than stated
CHANCE = 1e-9  # probability of what noise alone does not do
# Standard deviations of what is normal if only noise is at work:
CHANCE_DEVIATE = 3.0  # within them it counts as chance; 0.3 % lie beyond
SIGNIFICANT_DEVIATE = 4.0  # beyond them it is no chance, also of many tests in a row: 0.006 %
CERTAIN_DEVIATE = 5.0  # no chance reaches them: 6e-7
EXACT_DEGREES = 100  # of freedom, up to which the limit of χ² is exact; above, it is too large by 0.4 % at most
STRUCTURE = 1.5  # RMSE over the noise, with the correlation of what is left, above which that is more than noise
MIN_EXPLAINED = 1e-10  # share of the largest singular value, or length, below which a direction is rounding
NULL_ODDS = 3.0  # how much more probable the null hypothesis is than each other type, before any evidence


@dataclass(frozen=True, slots=True)
class LogEvidence:
    """-2 log evidence of a window for one alternative, by its terms."""

    chi_square: float = 0.0  # Least χ² of window and prior, with ln|S| where alternatives differ in it
    penalty: float = 0.0  # Of the complexity, and of the prior odds
    discount: float = 1.0  # What χ² is divided by

    @property
    def misfit(self) -> float:
        """The part of the data alone: without complexity and prior odds."""
        return self.chi_square / self.discount

    @property
    def deviance(self) -> float:
        """-2 log evidence."""
        return self.misfit + self.penalty

    def over(self, other: "LogEvidence") -> float:
        """Return by how much the deviance exceeds that of ``other``, whose discount counts for both."""
        return (self.chi_square - other.chi_square) / other.discount + self.penalty - other.penalty


NO_EVIDENCE = LogEvidence()  # of no window


def discount(chi_square: float, count: float) -> float:
    """Return what evidence is divided by where the best alternative leaves ``chi_square`` of ``count`` values.

    That is how many times the variance of the noise it leaves; at least one.
    """
    return max(chi_square / count, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Elimination:
    """The unknowns of a linearised window, to be eliminated from residuals and responses."""

    basis: Array  # (residuals, directions) orthonormal: what a change of the unknowns explains
    steps: Array  # (unknowns, directions) the changes that do

    @classmethod
    def of(cls, jacobian: Array, width: Array | None = None) -> "Elimination":
        """Return the elimination of unknowns with the derivatives ``jacobian`` (residuals, unknowns).

        ``width`` (unknowns,) is the unit in which each counts: a direction that then has less effect than rounding
        explains nothing. By default it is what has an effect of one; an unknown without effect is none.
        """
        if width is None:
            size = np.linalg.norm(jacobian, axis=0)
            width = np.divide(1.0, size, out=np.zeros(len(size)), where=size > 0.0)
        basis, singular, directions = np.linalg.svd(jacobian * width, full_matrices=False)
        kept = singular > MIN_EXPLAINED * max(singular.max(initial=0.0), 1.0)
        return cls(basis[:, kept], (directions[kept] / singular[kept, None] * width).T)

    def left(self, rows: Array) -> Array:
        """Return what is left of ``rows`` (residuals, ...)."""
        return np.asarray(rows - self.basis @ (self.basis.T @ rows))

    def explaining(self, rows: Array) -> Array:
        """Return the change (unknowns, ...) that explains most of ``rows`` (residuals, ...)."""
        return np.asarray(self.steps @ (self.basis.T @ rows))


def chi_square_left(jacobian: Array, residuals: Array) -> float:
    """Return χ² of what the elimination leaves of ``residuals``: a triangular factor is faster than the basis.

    If columns depend on each other, the factor would also leave out a direction that rounding chooses.
    """
    size = np.linalg.norm(jacobian, axis=0)
    alive = size > 0.0
    columns = np.column_stack([jacobian[:, alive] / size[alive], residuals])
    diagonal = np.diag(np.linalg.qr(columns, mode="r"))
    if len(diagonal) == columns.shape[1] and (np.abs(diagonal[:-1]) > MIN_EXPLAINED).all():
        return float(diagonal[-1] ** 2)
    return float((Elimination.of(jacobian).left(residuals) ** 2).sum())


@lru_cache(maxsize=256)
def chi_square_limit(degrees: int) -> float:
    """Return the χ² of so many degrees of freedom that noise alone exceeds with the probability ``CHANCE``.

    For many degrees of freedom its cube root is normal (E. B. Wilson, M. M. Hilferty, PNAS 17, 1931), which is too
    large for few.
    """
    spread = 2.0 / (9.0 * degrees)
    high = degrees * (1.0 - spread - NormalDist().inv_cdf(CHANCE) * sqrt(spread)) ** 3
    if degrees > EXACT_DEGREES:
        return high
    low = float(degrees)
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _upper_tail(middle, degrees) > CHANCE else (low, middle)
    return high


def _upper_tail(chi_square: float, degrees: int) -> float:
    """Return the probability of a larger χ²: a finite sum (M. Abramowitz, I. A. Stegun, formulas 26.4.4 and 26.4.5)."""
    half, is_odd = 0.5 * chi_square, degrees % 2
    term, total = (exp(-half) * sqrt(half) / gamma(1.5), erfc(sqrt(half))) if is_odd else (exp(-half), 0.0)
    for number in range(1, degrees // 2 + 1):
        total += term
        term *= half / (number + 0.5 * is_odd)
    return total


def is_explained(chi_square: float, count: float) -> bool:
    """Whether ``chi_square`` of ``count`` measured values is what noise leaves, whose level may be misstated."""
    return chi_square <= LEVEL_ERROR**2 * chi_square_limit(int(count))


def log_determinant(covariance: Array) -> Array:
    """Return ln|I + M| (...,) of covariances I + M (..., n, n): of innovations, or of a window seen from a prior.

    With M = R P Rᵀ and RᵀR = JᵀJ this is the complexity of what is estimated; with M = Lᵀ JᵀJ L and L Lᵀ = P as well.
    """
    return np.asarray(np.linalg.slogdet(covariance)[1])


def prior_deviance(alternatives: float | Array) -> Array:
    """Return -2 log of the prior odds of one of so many hypotheses of a type against the null hypothesis."""
    return np.asarray(2.0 * np.log(NULL_ODDS * alternatives))


def penalty(values: float | Array, count: float, alternatives: float | Array) -> Array:
    """Return the penalty of ``values`` of which nothing was known, from ``count`` measured ones, and of prior odds."""
    return np.asarray(values * np.log(count) + prior_deviance(alternatives))


def likelihood_ratios(deviances: Array) -> Array:
    """Return the likelihood of each alternative over that of the likeliest one."""
    return np.asarray(np.exp(-0.5 * (deviances - deviances.min())))
