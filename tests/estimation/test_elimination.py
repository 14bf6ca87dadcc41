"""What a change of the unknowns of a linearised window explains, and what it leaves."""

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.evidence import Elimination, chi_square_left


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
        left = Elimination.of(columns).left(residuals)
        total = float(residuals @ residuals)
        assert chi_square_left(columns, residuals) == pytest.approx(left @ left, abs=1e-10 * total)


@pytest.mark.parametrize("kind", ["independent", "zero", "dependent", "wide"])
def test_what_is_explained_and_what_is_left_are_the_whole(kind: str) -> None:
    random = np.random.default_rng(8)
    for _ in range(50):
        columns = jacobian(kind, random) * 10.0 ** random.uniform(-6.0, 6.0, size=5)
        rows = random.normal(size=(len(columns), 3))
        unknowns = Elimination.of(columns)
        assert columns @ unknowns.explaining(rows) + unknowns.left(rows) == pytest.approx(rows, abs=1e-8)
        assert unknowns.left(columns) == pytest.approx(np.zeros(columns.shape), abs=1e-8 * np.abs(columns).max())
