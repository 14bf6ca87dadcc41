"""A prediction of the outputs, and its 95 % bands from draws of what is uncertain."""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from otolith.acquisition.window import Array, Mask
from otolith.estimation.information import QUANTILE
from otolith_drivers.errors import ConfigurationError, nearest, shown

TAIL = float(ndtr(-QUANTILE))  # probability on either side of a band
# Thresholds: docs/reference/thresholds-simulation.md has the origin of each.
NORMAL_SPREAD = 0.5  # spread of the draws over the sensor noise, up to which their sum counts as normal
BISECTIONS = 60  # of a band, at most
BAND_ERROR = 1e-3  # of the standard deviation of a reading: error of the ends of a band


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Readings of the outputs as the twin predicts them, each in its unit. All numbers are finite.

    Attributes:
        outputs: names of the outputs, the columns of the arrays.
        units: of the outputs.
        start: time of the first record, s.
        offsets: (records,) time since the first record, s.
        values: (records, outputs) median of the draws whose trends do not end at once, each in its unit.
        low: (records, outputs) lower end of the 95 % band, each in its unit.
        high: (records, outputs) upper end of the 95 % band, each in its unit.
        driving: (records, inputs) what drove the twin, each in its unit.
        measured: (records, outputs) readings of the same time, each in its unit; not-a-number where there are none.
        draws: number of draws of parameters, trends, initial state and noise.
        seed: of the random generator.
        diverges: seconds (s) after the first record from which on some draws are not finite, so that nothing is
            predicted; None if all are.
    """

    outputs: tuple[str, ...]
    units: tuple[str, ...]
    start: float
    offsets: Array
    values: Array
    low: Array
    high: Array
    driving: Array
    measured: Array
    draws: int
    seed: int
    diverges: float | None = None

    @property
    def times(self) -> Array:
        """(records,) s, as the times of the inputs."""
        return self.start + self.offsets

    @property
    def records(self) -> int:
        """Number of records."""
        return len(self.offsets)

    def column(self, output: str) -> int:
        """Return the column of an output in the arrays.

        Raises:
            otolith_drivers.errors.ConfigurationError: the twin has no such output.
        """
        if output not in self.outputs:
            hint = nearest(str(output), list(self.outputs))
            raise ConfigurationError(f"output: the twin has no output {shown(output)}: {hint}")
        return self.outputs.index(output)

    def rmse(self, output: str) -> float | None:
        """Return the root mean square of measured minus predicted, in the unit of the output; None without readings."""
        error = (self.measured - self.values)[:, self.column(output)]
        present = error[np.isfinite(error)]
        return float(np.sqrt(np.mean(present**2))) if len(present) else None

    def coverage(self, output: str) -> float | None:
        """Return the share of the readings within the band, 0 to 1; None without readings."""
        column = self.column(output)
        measured = self.measured[:, column]
        present = np.isfinite(measured)
        within = (measured >= self.low[:, column]) & (measured <= self.high[:, column])
        return float(np.mean(within[present])) if present.any() else None


def bands(draws: Array, noise: Array, of_line: Mask) -> tuple[Array, Array, Array]:
    """Return median and ends of the 95 % band (records, outputs) of readings with normal ``noise`` (outputs,).

    ``draws`` (records, draws, outputs) are values without that noise; the median is that of those ``of_line`` (draws,).
    A reading is distributed as their mixture of
    normal distributions, so the noise needs no draws of its own.
    """
    mean = draws.mean(axis=1)
    variance = draws.var(axis=1)
    reach = QUANTILE * np.sqrt(variance + noise**2)
    low, high = mean - reach, mean + reach
    wide = variance > (NORMAL_SPREAD * noise) ** 2
    for output in np.flatnonzero(wide.any(axis=0)):
        rows = np.flatnonzero(wide[:, output])
        chosen, sd = draws[rows, :, output], float(noise[output])
        guess = low[rows, output], high[rows, output]
        low[rows, output] = _quantile(chosen, sd, TAIL, guess[0])
        high[rows, output] = _quantile(chosen, sd, 1.0 - TAIL, guess[1])
    return np.median(draws[:, of_line], axis=1), low, high


def _quantile(draws: Array, sd: float, probability: float, guess: Array) -> Array:
    """Return the quantile (records,) of normal mixtures around ``draws`` (records, draws): Newton's method, bracketed.

    If a step leaves the bracket, the bracket is halved instead.
    """
    offset = QUANTILE * sd if probability > 0.5 else -QUANTILE * sd  # of a single normal distribution
    low, high = draws.min(axis=1) + offset, draws.max(axis=1) + offset
    at, tolerance = np.clip(guess, low, high), BAND_ERROR * np.hypot(sd, draws.std(axis=1))
    open_ = np.arange(len(at))
    for _ in range(BISECTIONS):
        deviation = (at[open_, None] - draws[open_]) / sd
        excess = ndtr(deviation).mean(axis=1) - probability
        below = excess < 0.0
        low[open_[below]], high[open_[~below]] = at[open_[below]], at[open_[~below]]
        density = np.exp(-0.5 * deviation**2).mean(axis=1) / (sd * np.sqrt(2.0 * np.pi))
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # far from all draws the density is 0
            step = at[open_] - excess / density
        is_inside = (step > low[open_]) & (step < high[open_])
        moved = np.where(is_inside, step, 0.5 * (low[open_] + high[open_]))
        is_done = np.abs(moved - at[open_]) <= tolerance[open_]
        at[open_] = moved
        open_ = open_[~is_done]
        if not len(open_):
            break
    return at
