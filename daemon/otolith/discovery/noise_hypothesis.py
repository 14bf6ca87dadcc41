"""The hypothesis that sensors are noisier than the problem states.

Each output has its own factor on the standard deviation of its noise: the root mean square of its whitened innovations.
The hypothesis is compared by the full likelihood of the innovations, whose normalisation grows with the factor. So
parameters or a component that explain a window up to the stated noise are better. Only white innovations count as
noise: what follows a curve is no noise, however large.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, FittedHypothesis
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit, fit

# Thresholds: docs/reference/thresholds-discovery.md has the origin of each.
MIN_NOISE_FACTOR = 1.3  # on a standard deviation: a smaller factor is left to the variance between windows
MAX_NOISE_FACTOR = 6.0  # a sensor that is worse than this is faulty
WHITE_DEVIATIONS = 4.0  # of the autocorrelation at the first lags, in standard deviations of that of white noise
WHITE_LAGS = 4
ROUNDS = 4  # of fitting with the noise and estimating it
STEPS = 25  # of Gauss-Newton in each


def noisier_sensors(null: FittedHypothesis) -> FittedHypothesis | None:
    """Return the hypothesis that sensors are noisier, fitted to the window of ``null``; None if they are not.

    The innovations of a sensor that is not noisier must be as large as stated, and all must be white.
    """
    problem, best = null.problem, null.fit
    factors = np.ones(len(problem.noise))
    for _ in range(ROUNDS):
        factors *= _noise_ratios(best)
        factors = np.where(factors < MIN_NOISE_FACTOR, 1.0, factors)
        if (factors == 1.0).all() or (factors > MAX_NOISE_FACTOR).any():
            return None
        best = fit(_scaled(problem, factors), best.window, best.prior, best.prior.mean, STEPS)
    if not is_white(best):
        return None
    outputs = [output.name for output in problem.base_model.outputs]
    noisy = [name for name, factor in zip(outputs, factors, strict=True) if factor > 1.0]
    stated = FaultHypothesis(FaultType.NOISE, ", ".join(noisy), len(noisy), 2.0 ** len(outputs) - 1.0)
    return FittedHypothesis(stated, best, normalisation(best, null.fit))


def normalisation(fitted: Fit, reference: Fit) -> float:
    """Return by how much -2 log likelihood of ``fitted`` exceeds its χ², against ``reference``."""
    own, other = (each.objective.innovation_model.log_determinant for each in (fitted, reference))
    return own - other


def is_white(fitted: Fit) -> bool:
    """Whether the whitened innovations of each output are uncorrelated at the first lags.

    The standard deviation of an autocorrelation of n white values is 1/√n (G. E. P. Box, D. A. Pierce, Journal of the
    American Statistical Association 65, 1970).
    """
    present = fitted.objective.present
    for innovations, measured in zip(_innovations(fitted).T, present.T, strict=True):
        values = innovations[measured]
        power, count = float(values @ values), len(values)
        for lag in range(1, min(WHITE_LAGS, count - 1) + 1):
            if abs(float(values[lag:] @ values[:-lag])) > WHITE_DEVIATIONS * power / np.sqrt(count):
                return False
    return True


def _innovations(fitted: Fit) -> Array:
    """Return the whitened innovations (records, outputs)."""
    return fitted.map_objective.window_residuals(fitted.result).reshape(fitted.objective.measured.shape)


def _noise_ratios(fitted: Fit) -> Array:
    """Return the root mean square (outputs,) of the whitened innovations."""
    present = fitted.objective.present
    squares = np.where(present, _innovations(fitted) ** 2, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(present.sum(axis=0), 1)))


def _scaled(problem: Problem, factors: Array) -> Problem:
    """Return the problem with ``factors`` (outputs,) on the noise of the sensors."""
    stated = problem.stated_noise or problem.noise
    noise = tuple((np.array(problem.noise) * factors).tolist())
    return replace(problem, noise=noise, stated_noise=stated)
