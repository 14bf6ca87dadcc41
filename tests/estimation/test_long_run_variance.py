"""What a residual adds to standard deviations: its long-run variance, in windows of any length and colour."""

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.information import inflation_of

LENGTHS = pytest.mark.parametrize("records", [200, 1000, 5000, 30000])
SEEDS = 15


def slow_part(records: int, time_constant: float, random: np.random.Generator) -> Array:
    """A first-order process (records,) of unit variance; its time constant is in records."""
    kept, value, values = np.exp(-1.0 / time_constant), random.normal(), []
    for shock in np.sqrt(1.0 - kept**2) * random.standard_normal(records):
        value = kept * value + shock
        values.append(value)
    return np.array(values)


def long_run_factor(share: float, time_constant: float) -> float:
    """Of unit white noise beside a slow part of the variance ``share``: root of the spectrum at frequency zero."""
    kept = np.exp(-1.0 / time_constant)
    return float(np.sqrt(1.0 + share * (1.0 + kept) / (1.0 - kept)))


def factor_of(series: Array, scale: float = 1.0) -> float:
    residuals = scale * series.reshape(len(series), -1)
    cost = float(np.sqrt(np.mean(residuals**2)))
    return inflation_of(residuals, np.ones(residuals.shape, dtype=np.bool_), cost)


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("records", [20, 200, 1000, 5000, 30000])
def test_white_noise_is_not_inflated(records: int, outputs: int) -> None:
    """Beyond its own RMSE, an output may be by chance, but not because one of several always leaves most."""
    random = np.random.default_rng(1)
    factors = []
    for _ in range(200):
        series = random.standard_normal((records, outputs))
        factors.append(factor_of(series) / max(float(np.sqrt(np.mean(series**2))), 1.0))
    by_chance = 0.0135 * outputs  # up to ten independent sums that pass three standard deviations
    assert np.mean(np.array(factors) > 1.01) <= by_chance + 3.0 * np.sqrt(by_chance / 200)
    assert np.mean(factors) < 1.01
    assert np.quantile(factors, 0.9) == pytest.approx(1.0)


def test_an_output_that_is_far_noisier_than_the_others_counts_alone() -> None:
    random = np.random.default_rng(4)
    residuals = random.standard_normal((5000, 3)) * [0.5, 0.5, 2.0]
    assert factor_of(residuals) == pytest.approx(2.0, rel=0.05)


@LENGTHS
@pytest.mark.parametrize("time_constant", [2.0, 10.0, 100.0])
@pytest.mark.parametrize("share", [0.05, 0.2, 1.0])
def test_the_factor_of_a_correlated_residual_is_that_of_its_spectrum(
    records: int, time_constant: float, share: float
) -> None:
    """Whatever the cost is: at 5000 records with a slow part of 0.2 it is 1.1. Few values do not show a weak part."""
    random, truth = np.random.default_rng(2), long_run_factor(share, time_constant)
    factors = [
        factor_of(random.standard_normal(records) + np.sqrt(share) * slow_part(records, time_constant, random))
        for _ in range(SEEDS)
    ]
    middle = float(np.median(factors))
    assert 1.0 <= middle < 1.15 * truth
    is_shown = share * np.sqrt(records * min(time_constant, 20.0)) >= 8.0 * (1.0 + share)
    assert not (is_shown and records >= 30.0 * time_constant) or middle > 0.7 * truth


@LENGTHS
def test_the_factor_has_no_jump_at_any_cost_and_share(records: int) -> None:
    """It is continuous in the size of the residual, and grows with the share of its slow part."""
    random = np.random.default_rng(3)
    white, slow = random.standard_normal(records), slow_part(records, 100.0, random)
    coloured = white + 0.45 * slow
    coloured /= np.sqrt(np.mean(coloured**2))
    by_cost = np.array([factor_of(coloured, cost) for cost in np.arange(0.9, 1.3, 0.005)])
    assert (np.diff(by_cost) >= 0.0).all()
    assert np.diff(by_cost).max() <= 0.0051 * max(factor_of(coloured), 1.0)
    by_share = np.array([factor_of(white + np.sqrt(share) * slow) for share in np.arange(0.0, 1.0, 0.01)])
    assert (np.diff(by_share) > -0.02).all()
    assert np.diff(by_share**2).max() < 8.0  # a tenth of that of the whole slow part
