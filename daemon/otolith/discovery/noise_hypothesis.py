"""The hypothesis that signals are less certain than the problem states: sensors are noisier, commands change unseen.

Levels of sensors, inputs, and of states where the machine file states some, are the most likely ones of a window. The
hypothesis is compared by the full likelihood of the innovations, whose normalisation grows with the noise. So
parameters or a component that explain a window up to the stated noise are better. Only innovations that are white with
this noise count as noise.
"""

from dataclasses import replace
from itertools import repeat
from math import comb

import numpy as np

from otolith.acquisition.samples import MAD_TO_SD
from otolith.acquisition.window import Array, Mask, Window
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, FittedHypothesis, largest_chi_square
from otolith.discovery.linear_response import LinearResponse, chi_square_of_parameters
from otolith.estimation.data_checks import median, sample_differences
from otolith.estimation.evidence import DECISIVE, SIGNIFICANT_DEVIATE, LogEvidence
from otolith.estimation.information import MIN_SINGULAR, initial_prior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit, fit

# Thresholds: docs/reference/thresholds-discovery.md has the origin of each.
MIN_NOISE_FACTOR = 1.3  # on a standard deviation: a smaller factor is left to the variance between windows
MAX_NOISE_FACTOR = 100.0  # a sensor that is worse than this measures nothing
MIN_GAIN = 1.0  # in -2 log likelihood: a step of the levels that would gain less is not taken
WHITE_LAGS = 4
ROUNDS = 2  # of fitting with the noise and estimating it again
STEPS = 25  # of Gauss-Newton with the noise
MAX_REPEATED = 0.1  # share of the samples that repeat the one before: with more, a converter hides the noise
LEAST_SHARE = 0.05  # of a stated level: the least one that a window can show
MAX_SCORING = 10  # steps of Fisher scoring
STEP_SHARES = (1.0, 0.3, 0.1, 0.03, 0.01)  # of a step of Fisher scoring that are tried
MIN_VARIANCE_RATIO = 0.04  # least ratio of a variance after a step to that before
RIDGE = 0.05  # added to the correlations of slopes, which few random vectors estimate


def noisier_signals(null: FittedHypothesis, least: float) -> list[FittedHypothesis]:
    """Return the hypothesis of larger noise, fitted to the window of ``null``, if it leaves white noise.

    There is none if it would be far less likely than the other hypotheses, of which the best leaves χ² of ``least``.
    """
    max_deviance, around = largest_chi_square(least, null.fit.count), null.fit
    for _ in range(1 if null.fit.is_explained else 1 + ROUNDS):  # far from the null, levels are those of its errors
        best = _at_larger_levels(around, null.fit, max_deviance)
        if best is None:
            return []
        around = best
    return [_hypothesis(around, null)] if is_white(around) else []


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


def _at_larger_levels(around: Fit, null: Fit, max_deviance: float) -> Fit | None:
    """Return the window of ``null`` fitted at likely levels around another fit; None if none is larger than stated.

    None as well if χ² and normalisation exceed ``max_deviance``. A sensor that would be useless makes no hypothesis.
    """
    stated, useless = np.array(null.problem.levels), MAX_NOISE_FACTOR * np.array(null.problem.noise)
    max_deviance += null.objective.spread
    unstated = input_noise_bounds(null.problem, null.window) > 0.0
    inputs = np.pad(unstated, (0, len(stated) - len(unstated)))
    there = replace(around, problem=null.problem).linearised_at_end()
    trial = _backward_elimination(there, inputs, max_deviance)
    if (np.array(trial.problem.levels) <= stated).all() or (np.array(trial.problem.noise) > useless).any():
        return None
    inflation = prior_inflation(null, trial)
    prior = replace(null.prior, covariance=null.prior.covariance * np.outer(inflation, inflation))
    return fit(trial.problem, null.window, prior, null.prior.mean, STEPS)


def prior_inflation(null: Fit, trial: Fit) -> Array:
    """Return factors (2 free,) on the standard deviations of the prior of ``null``: earlier windows were as noisy.

    They were weighted by the noise of ``null``, not by that of ``trial``. Least squares with other weights than those
    of the noise have the covariance J⁺ Σ J⁺ᵀ (H. White, Econometrica 48, 1980), where Σ is that of the whitened
    residuals: I, and what the difference of each level adds. Trends follow the parameters. Nothing becomes less certain
    than before any window.
    """
    rows, free = len(null.prior.mean), len(null.problem.free)
    jacobian = np.delete(null.result.first[2][:-rows], np.s_[free : 2 * free], axis=1)  # trends are nearly known
    size = np.linalg.norm(jacobian, axis=0)
    scaled = np.divide(jacobian, size, out=np.zeros(jacobian.shape), where=size > 0.0)
    estimators = np.ascontiguousarray(np.linalg.pinv(scaled, rcond=MIN_SINGULAR)[:free].T)
    known, added = (estimators**2).sum(axis=0), np.array(trial.problem.levels) ** 2 - np.array(null.problem.levels) ** 2
    with np.errstate(invalid="ignore"):  # where the twin diverges
        more = added @ LinearResponse(null).squares_of_noise(estimators)
    ratios = np.sqrt(1.0 + np.divide(more, known, out=np.zeros(free), where=np.isfinite(more) & (more > 0.0)))
    without_any_window = initial_prior(null.problem).sd / null.prior.sd
    return np.maximum(np.minimum(np.resize(ratios, rows), without_any_window), 1.0)


def _hypothesis(fitted: Fit, null: FittedHypothesis) -> FittedHypothesis:
    """Return the hypothesis of the levels of ``fitted``."""
    twin, before, levels = fitted.problem.base_model, np.array(null.problem.levels), np.array(fitted.problem.levels)
    names = np.array([*twin.signals, *(f"der({state.name})" for state in twin.states)])
    changed = int((levels != before).sum())
    stated = FaultHypothesis(FaultType.NOISE, ", ".join(names[levels > before]), changed, comb(len(names), changed))
    return FittedHypothesis(stated, fitted, normalisation(fitted, null.fit))


def _backward_elimination(stated: Fit, allowed: Mask, max_deviance: float = np.inf) -> Fit:
    """Return the window linearised at likely levels where noise is stated, and of further ``allowed`` places (levels,).

    A level within ``MIN_NOISE_FACTOR`` of the stated one stays as it is, as does one without which the window is not
    decisively less likely. Those of states are tried first: they follow nearly everything. If no levels lead to a
    deviance of at most ``max_deviance``, all stay as stated.
    """
    before, places = np.array(stated.problem.levels), np.arange(len(allowed))
    trial = _maximise_likelihood(stated, (before > 0.0) | allowed)
    if _deviance(trial) > max_deviance:
        return stated
    ratios = np.array(trial.problem.levels) / np.where(before > 0.0, before, 1.0)
    kept = allowed | ((before > 0.0) & ((ratios > MIN_NOISE_FACTOR) | (ratios < 1.0 / MIN_NOISE_FACTOR)))
    trial = _with_levels_of(trial, stated, kept)
    for at in np.flatnonzero(kept)[::-1]:
        fewer = _with_levels_of(trial, stated, kept & (places != at))
        if _deviance(fewer) <= _deviance(trial) + DECISIVE:
            kept, trial = kept & (places != at), fewer
    return trial


def _with_levels_of(trial: Fit, stated: Fit, places: Mask) -> Fit:
    """Return the window at the most likely levels of ``places`` (levels,), searched from ``trial``, else as stated."""
    return _maximise_likelihood(_at(trial, np.where(places, trial.problem.levels, stated.problem.levels)), places)


def input_noise_bounds(problem: Problem, window: Window) -> Array:
    """Return upper bounds (inputs,) of the noise of inputs, from differences of samples; zero where one is stated."""
    stated = np.array(problem.levels[: len(problem.base_model.inputs)])
    bounds = np.array([_noise_bound(source.name, window) for source in problem.base_model.inputs])
    return np.where((stated == 0.0) & np.isfinite(bounds), bounds, 0.0)


def _noise_bound(signal: str, window: Window) -> float:
    differences = np.abs(sample_differences(signal, window))
    return MAD_TO_SD * median(differences) if len(differences) else 0.0


def _maximise_likelihood(trial: Fit, places: Mask) -> Fit:
    """Return the window linearised at the levels of ``places`` (levels,) that maximise the likelihood.

    Fisher scoring over variances (N. K. Gupta, R. K. Mehra, IEEE Transactions on Automatic Control 19, 1974). Slope and
    expected curvature are mean and covariance of the squared inner products with random vectors.
    """
    lowest, highest = _limits(trial)
    for _ in range(MAX_SCORING if places.any() else 0):
        variances, squares = np.array(trial.problem.levels) ** 2, LinearResponse(trial).squares_of_noise()
        if not np.isfinite(squares).all():  # the twin diverges
            break
        slope, covariance = squares[:, 0] - squares[:, 1:].mean(axis=1), np.cov(squares[:, 1:]) / 2.0
        scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        correlation, free = covariance / np.outer(scale, scale) + RIDGE * np.eye(len(scale)), places
        for _ in range(2):  # a level that would fall below its limit stays
            inverse = np.linalg.pinv(np.where(np.outer(free, free), correlation, 0.0))
            step = inverse @ (slope / scale) / scale
            free = places & ((variances > lowest**2) | (step > 0.0))
        if 0.5 * float(slope @ step) < MIN_GAIN:
            break
        bounds = np.maximum(lowest**2, MIN_VARIANCE_RATIO * variances), highest**2
        moved, deviance = (np.clip(variances + share * step, *bounds) for share in STEP_SHARES), _deviance(trial)
        trials = (_at(trial, np.sqrt(np.where(places, own, variances))) for own in moved)
        better = next((own for own in trials if _deviance(own) < deviance), None)
        if better is None:
            break
        trial = better
    return trial


def _limits(trial: Fit) -> tuple[Array, Array]:
    """Return the lowest and the highest level (levels,) that may be estimated.

    The lowest is a share of the stated one, or the step of a converter. The highest, of inputs, is what samples show.
    """
    problem, stated = trial.problem, np.array(trial.problem.stated_levels)
    lowest, inputs = LEAST_SHARE * stated, len(problem.base_model.inputs)
    for at, (output, step) in enumerate(
        zip(problem.base_model.outputs, problem.steps or repeat(0.0), strict=False), inputs
    ):
        values = trial.window.readings(output.name)[~trial.window.missing_in(output.name)]
        is_coarse = np.count_nonzero(np.diff(values) == 0.0) > MAX_REPEATED * len(values)
        lowest[at] = stated[at] if is_coarse else max(lowest[at], min(step, stated[at]))
    highest = np.full(len(stated), np.inf)
    for at, source in enumerate(problem.base_model.inputs):
        highest[at] = max(_noise_bound(source.name, trial.window), stated[at])
    return lowest, highest


def _at(trial: Fit, levels: Array) -> Fit:
    return replace(trial, problem=trial.problem.with_levels(levels.tolist())).linearised_at_end()


def _deviance(trial: Fit) -> float:
    """Return -2 log evidence of a window around which the twin is linearised; all levels have the same complexity."""
    return LogEvidence(chi_square_of_parameters(trial) + trial.objective.spread).deviance


def likelier_levels_of(fitted: Fit) -> Problem:
    """Return the problem of ``fitted`` with the likely levels of its window if none is larger, else with its own.

    Process noise that is stated too large for that of the sensors makes the predictor follow every sample. The gain of
    a sensor would change how far it follows, and would pass for a cause.
    """
    if not fitted.is_explained:
        return fitted.problem
    likely = _backward_elimination(
        fitted.linearised_at_end(), np.zeros(len(fitted.problem.levels), dtype=np.bool_)
    ).problem
    return likely if (np.array(likely.levels) <= fitted.problem.levels).all() else fitted.problem


def normalisation(fitted: Fit, reference: Fit) -> float:
    """Return by how much -2 log likelihood of ``fitted`` exceeds its χ², against ``reference``."""
    own, other = (each.objective.spread for each in (fitted, reference))
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
            if abs(float(values[lag:] @ values[:-lag])) > SIGNIFICANT_DEVIATE * max(power, count) / np.sqrt(count):
                return False
    return True
