"""What a change of the guess can explain of a window."""

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.imm_filter import initial_modes
from otolith.estimation.information import linearisation_errors


class Bent:
    """Residuals that are linear in the first value of a guess, and bent by ``bend`` and ``twist`` in the second."""

    def __init__(self, bend: float, twist: float, high: float) -> None:
        self.measured = np.zeros((3, 1))
        self.low, self.high = np.full(2, -high), np.full(2, high)
        self._bend, self._twist = bend, twist

    def predict(self, guesses: Array) -> Array:
        first, second = guesses.T
        rows = [first, 0.1 * second + self._bend * second**2, self._twist * second**3]
        return np.stack(rows, axis=1)[..., None]

    def residuals(self, predicted: Array) -> Array:
        return predicted


SLOPES = np.array([[1.0, 0.0], [0.0, 0.1], [0.0, 0.0]])  # of Bent at zero; the second has a standard deviation of 10


@pytest.mark.parametrize("high", [1e3, 5.0])
def test_a_linear_window_has_no_error_whether_or_not_a_bound_is_near(high: float) -> None:
    errors = linearisation_errors(Bent(0.0, 0.0, high), np.zeros(2), SLOPES)  # type: ignore[arg-type]
    assert errors == pytest.approx(np.zeros((3, 2)))


def test_the_error_is_the_change_of_second_order() -> None:
    errors = linearisation_errors(Bent(0.02, 0.01, 1e3), np.zeros(2), SLOPES)  # type: ignore[arg-type]
    assert errors @ errors.T == pytest.approx(np.diag([0.0, 2.0**2, 0.0]))


def test_the_side_that_no_bound_cuts_off_counts_alone() -> None:
    bent = Bent(0.02, 0.0, 1e3)
    bent.low = np.zeros(2)
    errors = linearisation_errors(bent, np.zeros(2), SLOPES)  # type: ignore[arg-type]
    assert errors @ errors.T == pytest.approx(np.diag([0.0, 2.0**2, 0.0]))


def test_a_bound_keeps_the_error_of_a_ridge_within_it() -> None:
    errors = linearisation_errors(Bent(0.02, 0.0, 5.0), np.zeros(2), SLOPES)  # type: ignore[arg-type]
    assert errors @ errors.T == pytest.approx(np.diag([0.0, 0.5**2, 0.0]))


def test_posteriors_cannot_change_the_modes_that_they_share() -> None:
    posterior = initial_modes(np.zeros(4), np.eye(4))
    with pytest.raises(ValueError, match="read-only"):
        posterior.level[0, 0] = 1
