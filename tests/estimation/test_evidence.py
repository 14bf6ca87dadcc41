"""The evidence of a window is the density of its residuals, whatever they are compared for."""

import numpy as np
import pytest
from scipy.special import chdtrc, chdtri

from otolith.acquisition.window import Array
from otolith.estimation.evidence import (
    CHANCE,
    LEVEL_ERROR,
    LogEvidence,
    chi_square_left,
    chi_square_limit,
    discount,
    is_explained,
    likelihood_ratios,
    log_determinant,
    penalty,
    prior_deviance,
)

RECORDS, VALUES = 40, 5


def linear_window(seed: int) -> tuple[Array, Array, Array]:
    """Residuals, their derivatives by some values, and the covariance with which these are known beforehand."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(VALUES, VALUES))
    return random.normal(size=RECORDS), random.normal(size=(RECORDS, VALUES)), root @ root.T


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_and_complexity_are_the_density_of_the_residuals(seed: int) -> None:
    residuals, jacobian, covariance = linear_window(seed)
    whole = np.eye(RECORDS) + jacobian @ covariance @ jacobian.T
    density = residuals @ np.linalg.solve(whole, residuals) + np.linalg.slogdet(whole)[1]
    known = np.linalg.inv(np.linalg.cholesky(covariance))
    least = chi_square_left(np.vstack([jacobian, known]), np.concatenate([residuals, np.zeros(VALUES)]))
    complexity = float(log_determinant(whole))
    assert LogEvidence(least, complexity).deviance == pytest.approx(density)
    # The same from the side of the values, and from the square root of their information.
    half, root = np.linalg.cholesky(covariance), np.linalg.qr(jacobian)[1]
    for small in (half.T @ jacobian.T @ jacobian @ half, root @ covariance @ root.T):
        assert float(log_determinant(np.eye(VALUES) + small)) == pytest.approx(complexity)


def test_the_complexity_of_what_nothing_is_known_of_grows_with_the_logarithm_of_the_records() -> None:
    """Bayesian information criterion: the limit of the complexity, up to what does not grow with the records."""
    random = np.random.default_rng(1)
    complexities = []
    for records in (1000, 16_000):
        jacobian = random.normal(size=(records, VALUES))
        complexities.append(float(log_determinant(np.eye(VALUES) + jacobian.T @ jacobian)))
    grown = penalty(VALUES, 16_000, 1.0) - penalty(VALUES, 1000, 1.0)
    assert complexities[1] - complexities[0] == pytest.approx(float(grown), rel=0.02)
    assert penalty(0.0, 1000, 7.0) == prior_deviance(7.0)


def test_two_alternatives_are_compared_with_one_discount() -> None:
    one, other = LogEvidence(900.0, 20.0, discount(800.0, 400.0)), LogEvidence(800.0, 26.0, discount(800.0, 400.0))
    assert one.over(other) == pytest.approx(one.deviance - other.deviance) == pytest.approx(50.0 - 6.0)
    ratios = likelihood_ratios(np.array([one.deviance, other.deviance]))
    assert ratios == pytest.approx([np.exp(-0.5 * one.over(other)), 1.0])


def test_noise_is_not_discounted() -> None:
    assert discount(300.0, 400.0) == 1.0
    assert discount(400.0, 400.0) == 1.0
    assert discount(900.0, 400.0) == 2.25


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 7, 12, 40, 99, 100])
def test_the_limit_of_chi_square_is_exact_for_few_degrees_of_freedom(degrees: int) -> None:
    assert chi_square_limit(degrees) == pytest.approx(float(chdtri(degrees, CHANCE)), rel=1e-9)


@pytest.mark.parametrize("degrees", [101, 400, 10_000, 1_000_000])
def test_the_limit_of_chi_square_is_close_for_many(degrees: int) -> None:
    assert 0.8 * CHANCE < float(chdtrc(degrees, chi_square_limit(degrees))) <= CHANCE


@pytest.mark.parametrize("count", [10, 20, 100, 400, 10_000, 1_000_000])
def test_noise_whose_level_is_known_is_explained_in_windows_of_any_length(count: int) -> None:
    """One window in 10⁹ exceeds it; an RMSE of 1.5 is exceeded by one window of ten values in eighty."""
    limit = float(chdtri(count, CHANCE))
    assert is_explained(limit, count)
    assert is_explained(LEVEL_ERROR**2 * 0.99 * limit, count)
    assert not is_explained(LEVEL_ERROR**2 * 1.01 * limit, count)


def test_a_long_window_is_explained_only_up_to_the_uncertainty_of_the_level() -> None:
    """An RMSE of 1.5 is 88 standard deviations of χ² of 10 000 values: no noise."""
    assert is_explained(1.5**2 * 400, 400)
    assert not is_explained(1.5**2 * 10_000, 10_000)
