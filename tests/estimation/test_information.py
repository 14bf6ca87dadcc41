"""What a change of the guess can explain of a window."""

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.imm_filter import initial_modes
from otolith.estimation.information import chi_square_left, orthonormal_basis


def jacobian(kind: str, random: np.random.Generator) -> Array:
    """(residuals, guess) of which columns are independent, zero, equal but for rounding, or more than the rows."""
    columns: Array = random.normal(size=(3 if kind == "wide" else 40, 5))
    if kind == "zero":
        columns[:, 2] = 0.0
    if kind == "dependent":
        columns[:, 2] = (columns[:, 0] + 0.1 * columns[:, 1]) / 3.0
        columns[:, 4] = 7.0 * columns[:, 3]
    return columns


@pytest.mark.parametrize("kind", ["independent", "zero", "dependent", "wide"])
@pytest.mark.parametrize("size", [1.0, 1e6])
def test_what_is_left_is_what_the_basis_leaves(kind: str, size: float) -> None:
    random = np.random.default_rng(7)
    for _ in range(50):
        columns = jacobian(kind, random) * 10.0 ** random.uniform(-6.0, 6.0, size=5)
        residuals = size * random.normal(size=len(columns))
        basis = orthonormal_basis(columns)
        left = residuals - basis @ (basis.T @ residuals)
        total = float(residuals @ residuals)
        assert chi_square_left(columns, residuals) == pytest.approx(left @ left, abs=1e-10 * total)


def test_posteriors_cannot_change_the_modes_that_they_share() -> None:
    posterior = initial_modes(np.zeros(4), np.eye(4))
    with pytest.raises(ValueError, match="read-only"):
        posterior.level[0, 0] = 1
