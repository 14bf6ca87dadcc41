"""Whiteness of the innovations: noise levels that are right leave white ones.

Two tests of all windows together: their autocorrelations (G. M. Ljung, G. E. P. Box, Biometrika 65, 1978), and their
cumulative periodogram against a straight line (M. S. Bartlett, An Introduction to Stochastic Processes, section 9.3).
The first finds a short memory, the second a slow disturbance, whose correlation is small at every single lag.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from otolith.acquisition.window import Array
from otolith.commissioning.likelihood import Fits

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
LAGS = 20  # of the autocorrelation, records
MIN_RECORDS = 40  # of a window: twice the lags
SIGNIFICANCE = 1e-3  # probability of a test's result by chance, below which innovations are coloured
BAND_RATIO = 4.0  # between the ends of a band of the spectrum


@dataclass(frozen=True, slots=True)
class Band:
    """The power of the innovations between two frequencies."""

    low: float
    """Hz."""
    high: float
    """Hz."""
    ratio: float
    """Over the power of white noise with the noise levels."""


@dataclass(frozen=True, slots=True)
class Whiteness:
    """The innovations of one output, in all windows together."""

    output: str
    correlation: float
    """The autocorrelation of largest magnitude."""
    lag: float
    """s, of that autocorrelation."""
    of_correlations: float
    """Probability that white noise has autocorrelations as large."""
    of_periodogram: float | None
    """Probability that the cumulative periodogram of white noise is as far from a line; None at irregular times."""
    bands: tuple[Band, ...]
    """From low to high frequencies; none at irregular times."""

    @property
    def is_white(self) -> bool:
        """Whether chance explains both tests."""
        of_periodogram = 1.0 if self.of_periodogram is None else self.of_periodogram
        return min(self.of_correlations, of_periodogram) >= SIGNIFICANCE


def whiteness(fits: Fits) -> tuple[Whiteness, ...]:
    """Return the tests of each output; none of an output that is hardly measured."""
    names = [output.name for output in fits[0].objective.kernel.definition.outputs]
    rows = [_of_output(name, index, fits) for index, name in enumerate(names)]
    return tuple(row for row in rows if row is not None)


def _of_output(name: str, index: int, fits: Fits) -> Whiteness | None:
    from scipy.special import chdtrc  # noqa: PLC0415 - only noise identification needs SciPy

    series, steps, uniform = list[Array](), list[float](), list[Array]()
    for fit in fits:
        present, grid = fit.objective.present[:, index], fit.window.grid
        values = fit.result.residuals.reshape(fit.objective.measured.shape)[present, index]
        if len(values) < MIN_RECORDS:
            continue
        series.append(values)
        steps.append(float(np.median(np.diff(grid.offsets[present]))))
        if grid.period is not None and present.all():
            uniform.append(values)
    if not series:
        return None
    correlations, counts = _autocorrelations(series)
    largest = int(np.abs(correlations).argmax())
    probability = float(chdtrc(LAGS, float((counts * correlations**2).sum())))
    step = float(np.median(steps))
    of_periodogram, bands = _spectrum([values for values in uniform if len(values) == len(uniform[0])], step)
    return Whiteness(name, float(correlations[largest]), step * (largest + 1), probability, of_periodogram, bands)


def _autocorrelations(series: Sequence[Array]) -> tuple[Array, Array]:
    """Return the autocorrelations (lags,) of all series together, and how many products each has."""
    power = sum(float(values @ values) for values in series) / sum(map(len, series))
    lags = np.arange(1, LAGS + 1)
    products = np.array([sum(float(values[lag:] @ values[:-lag]) for values in series) for lag in lags])
    counts = np.array([sum(len(values) - lag for values in series) for lag in lags], dtype=np.float64)
    return products / counts / max(power, np.finfo(float).tiny), counts


def _spectrum(series: Sequence[Array], step: float) -> tuple[float | None, tuple[Band, ...]]:
    """Return the probability of the cumulative periodogram, and the bands, of ``series`` of equal length.

    The mean of W periodograms of m frequencies differs from a line as that of one with W m frequencies.
    """
    from scipy.special import kolmogorov  # noqa: PLC0415 - only noise identification needs SciPy

    if not series:
        return None, ()
    records = len(series[0])
    count = (records - 1) // 2
    power = np.mean([np.abs(np.fft.rfft(values)[1 : count + 1]) ** 2 / records for values in series], axis=0)
    frequencies = np.arange(1, count + 1) / (records * step)
    cumulative = np.cumsum(power) / max(float(power.sum()), np.finfo(float).tiny)
    deviation = float(np.abs(cumulative - np.arange(1, count + 1) / count).max())
    edges = [float(frequencies[0])]
    while edges[-1] <= frequencies[-1]:
        edges.append(BAND_RATIO * edges[-1])
    bands = tuple(
        Band(low, min(high, 0.5 / step), float(power[(low <= frequencies) & (frequencies < high)].mean()))
        for low, high in pairwise(edges)
    )
    return float(kolmogorov(deviation * np.sqrt(count * len(series)))), bands
