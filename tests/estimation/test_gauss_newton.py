"""Gauss-Newton finds the minimum within bounds."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from otolith.acquisition.window import Array
from otolith.estimation.minimisers import gauss_newton


class Linear:
    """Residuals ``target - rows @ guess`` within bounds."""

    def __init__(self, rows: Array, target: Array, low: Array, high: Array) -> None:
        self._rows, self._target, self.low, self.high = rows, target, low, high

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        return self._target - self._rows @ guess, -self._rows


@pytest.mark.parametrize("seed", range(50))
def test_gauss_newton_converges_along_active_bounds(seed: int) -> None:
    """The parameters are strongly correlated: a full step that is clipped at the bound would raise the cost."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(60, 2)) @ random.normal(size=(2, 5)) + 0.03 * random.normal(size=(60, 5))
    target = rows @ random.uniform(-3.0, 3.0, 5) + random.normal(size=60)
    problem = Linear(rows, target, -np.ones(5), np.ones(5))
    result = gauss_newton(problem, random.uniform(-1.0, 1.0, 5), max_steps=200)
    reference = lsq_linear(rows, target, (-1.0, 1.0), method="bvls")
    assert result.converged
    assert result.chi_square == pytest.approx(2.0 * reference.cost, rel=1e-3)
    assert (np.abs(result.guess) <= 1.0).all()


def test_gauss_newton_accepts_a_start_outside_the_bounds() -> None:
    problem = Linear(np.eye(2), np.array([0.3, 5.0]), -np.ones(2), np.ones(2))
    assert gauss_newton(problem, np.array([9.0, -9.0])).guess == pytest.approx([0.3, 1.0])
