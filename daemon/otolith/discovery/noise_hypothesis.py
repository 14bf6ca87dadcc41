"""The hypothesis that signals are less certain than the problem states: sensors are noisier, commands change unseen.

Each output has its own factor on the standard deviation of its noise: the root mean square of its whitened innovations.
The noise of an input colours the innovations. It is at most what its signal shows from sample to sample, and the most
likely level up to there. The hypothesis is compared by the full likelihood of the innovations, whose normalisation
grows with the noise. So parameters or a component that explain a window up to the stated noise are better. Only
innovations that are white with this noise count as noise: what follows a curve is no noise, however large.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, FittedHypothesis
from otolith.discovery.linear_response import chi_square_of_parameters
from otolith.discovery.screening import DECISIVE, linearised
from otolith.estimation.data_checks import MAD_TO_SD, median, sample_differences
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit, fit

# Thresholds: docs/reference/thresholds-discovery.md has the origin of each.
MIN_NOISE_FACTOR = 1.3  # on a standard deviation: a smaller factor is left to the variance between windows
MAX_NOISE_FACTOR = 100.0  # a sensor that is worse than this measures nothing
INPUT_SHARES = 0.5 ** (0.5 * np.arange(7.0))  # of what an input shows from sample to sample: its noise
LESS_NOISE = 0.5  # ratio of two levels of noise that are compared
VISIBLE = 1.0  # in -2 log likelihood: an input's noise that changes the normalisation by less does not show
WHITE_DEVIATIONS = 4.0  # of the autocorrelation at the first lags, in standard deviations of that of white noise
WHITE_LAGS = 4
ROUNDS = 4  # of fitting with the noise and estimating it
STEPS = 25  # of Gauss-Newton in each


def noisier_sensors(null: FittedHypothesis) -> list[FittedHypothesis]:
    """Return the hypotheses that sensors are noisier, fitted to the window of ``null``: outputs alone, or inputs too.

    The innovations of a sensor that is not noisier must be as large as stated, and all must be white.
    """
    problems = [null.problem]
    if (noisier := _with_noisier_inputs(null.fit)).levels != null.problem.levels:
        problems.append(noisier)
    fitted = (_fitted(problem, null) for problem in problems)
    return [item for item in fitted if item is not None]


def changing_commands(null: FittedHypothesis, gains: Array) -> list[FittedHypothesis]:
    """Return the hypotheses that a command, or each, changes between its samples, fitted to the window of ``null``.

    The command is late by another time at each change. ``gains`` are those of delays, as of :func:`delayable`.
    """
    twin = null.problem.base_model
    of_inputs = zip(twin.inputs, gains[len(twin.outputs) :].tolist(), strict=True)
    late = [source.name for source, gain in of_inputs if source.hold == "zoh" and gain > DECISIVE]
    choices = [(name,) for name in late] + [tuple(late)] * (len(late) > 1)
    hypotheses = []
    for names in choices:
        problem = replace(null.problem, changing=tuple(dict.fromkeys((*null.problem.changing, *names))))
        best = fit(problem, null.fit.window, null.fit.prior, null.fit.prior.mean, STEPS)
        stated = FaultHypothesis(FaultType.NOISE, f"{', '.join(names)} between samples", 0, float(len(choices)))
        if is_white(best):
            hypotheses.append(FittedHypothesis(stated, best, normalisation(best, null.fit)))
    return hypotheses


def _fitted(problem: Problem, null: FittedHypothesis) -> FittedHypothesis | None:
    """Return the hypothesis of the levels of ``problem``, with those of the outputs fitted; None if it has none."""
    before, known = null.problem.levels, null.fit
    if problem.levels != before:
        known = fit(problem, known.window, known.prior, known.prior.mean, STEPS)
    best = known
    factors = np.ones(len(problem.noise))
    for _ in range(ROUNDS):
        factors *= _noise_ratios(best)
        factors = np.where(factors < MIN_NOISE_FACTOR, 1.0, factors)
        if (factors > MAX_NOISE_FACTOR).any():
            return None
        if (factors == 1.0).all():
            best = known
            break
        inputs = problem.levels[: -len(factors)]
        scaled = problem.with_levels((*inputs, *(np.array(problem.noise) * factors).tolist()))
        best = fit(scaled, best.window, best.prior, best.prior.mean, STEPS)
    signals = problem.base_model.signals
    rows = zip(signals, best.problem.levels, before, strict=True)
    noisy = [name for name, level, other in rows if level > other]
    if not noisy or not is_white(best):
        return None
    stated = FaultHypothesis(FaultType.NOISE, ", ".join(noisy), len(noisy), 2.0 ** len(signals) - 1.0)
    return FittedHypothesis(stated, best, normalisation(best, null.fit))


def _with_noisier_inputs(null: Fit) -> Problem:
    """Return the problem with the most likely noise of each input, if its gain exceeds the penalty of one value."""
    best, least = null.problem, _deviance(linearised(null.problem, null.window, null.prior, null.parameters))
    unseen = null.objective.innovation_model.log_determinant + VISIBLE
    for at, source in enumerate(best.base_model.inputs):
        differences, levels = np.abs(sample_differences(source.name, null.window)), best.levels
        shown = MAD_TO_SD * median(differences) if len(differences) else 0.0
        shares = shown * INPUT_SHARES
        for level in shares[shares > MIN_NOISE_FACTOR * levels[at]].tolist():
            problem = null.problem.with_levels((*levels[:at], level, *levels[at + 1 :]))
            trial = linearised(problem, null.window, null.prior, null.parameters)
            if trial.objective.innovation_model.log_determinant <= unseen:
                break
            penalty = np.log(null.count) if best.levels[at] == levels[at] else 0.0
            if (deviance := _deviance(trial)) + penalty < least:
                best, least = problem, deviance
    return best


def _deviance(trial: Fit) -> float:
    """Return -2 log likelihood of a window around which the twin is linearised."""
    return chi_square_of_parameters(trial) + trial.objective.innovation_model.log_determinant


def likelier_levels(problem: Problem, deviance: Callable[[Problem], float]) -> Problem:
    """Return the problem with the noise of states, or of outputs, halved as often as its ``deviance`` falls decisively.

    Process noise that is stated too large for that of the sensors makes the predictor follow every sample. The gain of
    a sensor would change how far it follows, and would pass for a cause.
    """
    least = deviance(problem)
    while any(problem.process_noise):
        states, outputs = (tuple(LESS_NOISE * level for level in own) for own in (problem.process_noise, problem.noise))
        inputs = problem.levels[: -len(outputs)]
        lower = replace(problem, process_noise=states), problem.with_levels((*inputs, *outputs))
        deviances = list(map(deviance, lower))
        if min(deviances) >= least - DECISIVE:
            break
        least = min(deviances)
        problem = lower[deviances.index(least)]
    return problem


def likelier_levels_of(fitted: Fit) -> Problem:
    """Return the problem of ``fitted`` with the :func:`likelier_levels` of its window, linearised at its parameters."""
    window, prior, start = fitted.window, fitted.prior, fitted.parameters
    return likelier_levels(fitted.problem, lambda problem: _deviance(linearised(problem, window, prior, start)))


def normalisation(fitted: Fit, reference: Fit) -> float:
    """Return by how much -2 log likelihood of ``fitted`` exceeds its χ², against ``reference``."""
    own, other = (each.objective.innovation_model.log_determinant for each in (fitted, reference))
    return own - other


def is_white(fitted: Fit) -> bool:
    """Whether the whitened innovations of each output are uncorrelated at the first lags.

    The standard deviation of an autocorrelation of n white values is 1/√n (G. E. P. Box, D. A. Pierce, Journal of the
    American Statistical Association 65, 1970). Noise that is stated too large correlates innovations that are smaller:
    then it is the scale of the correlation.
    """
    present = fitted.objective.present
    for innovations, measured in zip(fitted.innovations.T, present.T, strict=True):
        values = innovations[measured]
        power, count = float(values @ values), len(values)
        for lag in range(1, min(WHITE_LAGS, count - 1) + 1):
            if abs(float(values[lag:] @ values[:-lag])) > WHITE_DEVIATIONS * max(power, count) / np.sqrt(count):
                return False
    return True


def _noise_ratios(fitted: Fit) -> Array:
    """Return the root mean square (outputs,) of the whitened innovations."""
    present = fitted.objective.present
    squares = np.where(present, fitted.innovations**2, 0.0).sum(axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(present.sum(axis=0), 1)))
