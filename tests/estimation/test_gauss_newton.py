"""Gauss-Newton finds the minimum within bounds."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from otolith.acquisition.window import Array
from otolith.estimation.gauss_newton import gauss_newton


class Linear:
    """Residuals ``told - rows @ guess`` in a box."""

    def __init__(self, rows: Array, told: Array, low: Array, high: Array) -> None:
        self._rows, self._told, self.low, self.high = rows, told, low, high

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        return self._told - self._rows @ guess, -self._rows


@pytest.mark.parametrize("seed", range(50))
def test_a_bound_across_the_valley_does_not_stop_it(seed: int) -> None:
    """Strongly correlated directions: a whole step cut off at the bound would lead uphill."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(60, 2)) @ random.normal(size=(2, 5)) + 0.03 * random.normal(size=(60, 5))
    told = rows @ random.uniform(-3.0, 3.0, 5) + random.normal(size=60)
    box = Linear(rows, told, -np.ones(5), np.ones(5))
    found = gauss_newton(box, random.uniform(-1.0, 1.0, 5), max_steps=200)
    best = lsq_linear(rows, told, (-1.0, 1.0), method="bvls")
    assert found.converged
    assert found.chi_square == pytest.approx(2.0 * best.cost, rel=1e-3)
    assert (np.abs(found.guess) <= 1.0).all()


def test_a_start_outside_the_bounds_is_brought_inside() -> None:
    box = Linear(np.eye(2), np.array([0.3, 5.0]), -np.ones(2), np.ones(2))
    assert gauss_newton(box, np.array([9.0, -9.0])).guess == pytest.approx([0.3, 1.0])
