"""Draws of what is uncertain in a prediction: parameters with their trends, and how they go on.

Draws come in pairs with opposite deviations, so that their median is that of the posterior where the twin is linear.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array, Mask
from otolith.estimation.imm_filter import TREND_NOISE, process_model
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import indices
from otolith.simulation.what_if import supposed_values

PAIRS = 200  # Of draws: the ends of a band are exact to 5 % of its width. docs/reference/thresholds-simulation.md


class Future(IntEnum):
    """What becomes of a trend after the last window.

    The data do not say it, so each is that of equally many draws.
    """

    ENDS = 0  # At once, as after a warming or a repair
    DECAYS = 1  # As the filter lets it
    GOES_ON = 2


def opposite(deviates: Array) -> Array:
    """Return ``deviates`` (pairs, ...), and their negatives after them."""
    return np.concatenate([deviates, -deviates])


def chosen(weights: Array, pairs: int) -> NDArray[np.int64]:
    """Return the index (pairs,) of one of several distributions for each pair, as often as ``weights`` say."""
    shares = (np.arange(pairs) + 0.5) / pairs
    return np.minimum(np.searchsorted(np.cumsum(weights), shares), len(weights) - 1)


def root_of(covariance: Array) -> Array:
    """Return a matrix whose product with its transpose is ``covariance`` (..., n, n), which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


@dataclass(slots=True, eq=False)
class ParameterDraws:
    """Free parameters of the draws; :meth:`advance` moves them along their trends."""

    values: Array  # (draws, free), each in its unit
    _trends: Array  # (draws, free) per second
    _trend_noise: Array  # (draws, free) process noise of each trend, per s^1.5 in the unit; 0 for what stays constant
    _bounds: tuple[Array, Array]

    @property
    def lasts(self) -> Mask:
        """Whether the trends of a draw (draws,) last; the predicted line is the median of these draws."""
        return np.not_equal(_futures(len(self.values) // 2), Future.ENDS)

    @classmethod
    def of(cls, posterior: Posterior, random: np.random.Generator, pairs: int = PAIRS) -> "ParameterDraws":
        """Draw ``pairs`` from ``posterior``: a mode of the filter by its probability, then values and trends in it.

        Phases and inner parameters of components have no trend here: a phase is what the frequency makes of it.
        """
        problem, belief = posterior.problem, posterior.belief
        free, size = len(problem.free), np.concatenate([problem.scale, problem.scale])
        mode = chosen(belief.weight, pairs)
        deviates = random.standard_normal((pairs, 2 * free))
        deviations = np.einsum("pij,pj->pi", root_of(belief.covariance)[mode], deviates)
        drawn = (np.tile(belief.mean[mode], (2, 1)) + opposite(deviations)) * size
        noise = np.tile(TREND_NOISE[belief.level[mode]], (2, 1)) * problem.scale
        held = [index for slot in range(len(problem.components)) for index in indices(problem, slot)[1:]]
        supposed = supposed_values(posterior)
        fixed = [index for index, item in enumerate(problem.free) if item.name in supposed]
        trends = drawn[:, free:]
        trends[:, held + fixed] = noise[:, held + fixed] = 0.0
        ended = _futures(pairs) == Future.ENDS
        trends[ended] = noise[ended] = 0.0
        values = np.clip(drawn[:, :free], *problem.bounds)
        return cls(values, trends, noise, problem.bounds)

    def advance(self, seconds: float, random: np.random.Generator) -> None:
        """Move all draws by ``seconds``."""
        (_, run), (_, fade) = process_model(seconds)[0]
        root = root_of(process_model(seconds)[1])
        pairs = len(self.values) // 2
        deviates = opposite(random.standard_normal((pairs, self.values.shape[1], 2)) @ root.T)
        noise = self._trend_noise[..., None] * deviates
        goes_on = (_futures(pairs) == Future.GOES_ON)[:, None]
        moved = self.values + np.where(goes_on, seconds, run) * self._trends + noise[..., 0]
        self._trends = np.where(goes_on, 1.0, fade) * self._trends + noise[..., 1]
        self.values = np.clip(moved, *self._bounds)


def _futures(pairs: int) -> NDArray[np.int64]:
    """Return what becomes of the trends of each draw (draws,), a :class:`Future`."""
    return np.tile(np.arange(pairs) % len(Future), 2)
