"""The noise of measured inputs, from how the innovations follow their fast changes.

Noise of an input drives the twin, but not the machine. So the innovations follow the noise with the opposite sign,
while they follow nothing that really drives the machine. Process noise alone has the same spectrum; it is this
correlation that tells them apart. ``docs/explanation/noise-identification.md`` has the equations.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.likelihood import Fits, FittedWindow
from otolith.estimation.information import orthonormal_basis
from otolith.twin.definition import Input

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
DRAWS = 16  # of noise for each window, by which the expected correlation is computed
SIGNIFICANT_SHARE = 3.0  # standard deviations
SECOND_DIFFERENCE_GAIN = np.sqrt(6.0)  # for white noise


@dataclass(frozen=True, slots=True)
class InputNoise:
    """What windows show of the noise of one input."""

    name: str
    shown: float  # Standard deviation of its changes from sample to sample, of the machine or of noise
    share: float  # Of the variance of ``shown``: how much of it is noise
    sd: float  # Standard deviation of ``share``

    @property
    def is_significant(self) -> bool:
        """Whether the innovations show that a part is noise."""
        return self.share > SIGNIFICANT_SHARE * self.sd

    @property
    def level(self) -> float:
        """Standard deviation of the noise, in the unit of the input."""
        return self.shown * float(np.sqrt(np.clip(self.share, 0.0, 1.0)))

    @property
    def level_sd(self) -> float:
        """Standard deviation of :attr:`level`."""
        return 0.5 * self.shown * self.sd / float(np.sqrt(np.clip(self.share, self.sd, 1.0)))

    @property
    def limit(self) -> float:
        """Largest noise that the windows do not contradict."""
        return self.shown * float(np.sqrt(np.clip(self.share + 2.0 * self.sd, 0.0, 1.0)))


def input_noise(fits: Fits, source: Input, shown: float, seed: int) -> InputNoise | None:
    """Return how much of the changes ``shown`` by an input is noise; None if no window has a sample in each record."""
    random = np.random.default_rng(seed)
    column = [driven.name for driven in fits[0].objective.kernel.definition.inputs].index(source.name)
    correlation = expected = variance = 0.0
    for fit in fits:
        if fit.window.missing_in(source.name).any():
            continue
        basis = orthonormal_basis(fit.result.jacobian)
        fast = _response(fit, column, _fast(fit.window, fit.window.column(source.name)))
        fast -= basis @ (basis.T @ fast)
        correlation += float(fit.result.residuals @ fast)
        variance += max(fit.cost, 1.0) ** 2 * float(fast @ fast)
        expected += float(np.mean(list(_expected(fit, column, shown, basis, random))))
    if not expected:
        return None
    return InputNoise(source.name, shown, correlation / expected, float(np.sqrt(variance)) / abs(expected))


def _expected(
    fit: FittedWindow, column: int, level: float, basis: Array, random: np.random.Generator
) -> Iterator[float]:
    """Yield the correlation of innovations with fast changes, for draws of noise of this ``level``."""
    for _ in range(DRAWS):
        noise = level * random.standard_normal(fit.window.records)
        moved = _response(fit, column, noise)
        yield float((moved - basis @ (basis.T @ moved)) @ _response(fit, column, _fast(fit.window, noise)))


def _fast(window: Window, values: Array) -> Array:
    """Return the fast changes (records,) of ``values``: at each record the distance from the line of its neighbours."""
    offsets, fast = window.grid.offsets, np.zeros(len(values))
    share = (offsets[1:-1] - offsets[:-2]) / (offsets[2:] - offsets[:-2])
    fast[1:-1] = values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:]
    return np.asarray(2.0 * fast / SECOND_DIFFERENCE_GAIN)


def _response(fit: FittedWindow, column: int, change: Array) -> Array:
    """Return the change (residuals,) of the whitened innovations by a ``change`` (records,) of one input."""
    objective, inputs = fit.objective, fit.objective.excitation.inputs.copy()
    inputs[:, column] += change
    excitation = replace(objective.excitation, inputs=inputs)
    moved = objective.kernel.simulate(
        objective.parameters(fit.guess[None]), fit.guess[None, objective.free :], excitation
    )
    predicted = objective.predict(fit.guess[None])
    return np.asarray((objective.residuals(moved) - objective.residuals(predicted)).ravel())
