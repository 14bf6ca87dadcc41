"""The hypothesis that signals are less certain than the problem states: sensors are noisier, commands change unseen.

Levels of outputs, inputs and states are the most likely ones of a window. The hypothesis is compared by the full
likelihood of the innovations, whose normalisation grows with the noise. So parameters or a component that explain a
window up to the stated noise are better. Only innovations that are white with this noise count as noise.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import repeat
from math import comb

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, FittedHypothesis
from otolith.discovery.linear_response import LinearResponse, chi_square_of_parameters
from otolith.discovery.screening import DECISIVE
from otolith.estimation.data_checks import MAD_TO_SD, median, sample_differences
from otolith.estimation.information import Prior, information, orthonormal_basis
from otolith.estimation.objective import EXPLAINED
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit, fit

# Thresholds: docs/reference/thresholds-discovery.md has the origin of each.
MIN_NOISE_FACTOR = 1.3  # on a standard deviation: a smaller factor is left to the variance between windows
MAX_NOISE_FACTOR = 100.0  # a sensor that is worse than this measures nothing
VISIBLE = 1.0  # in -2 log likelihood: a step of the levels that gains less is the last one
WHITE_DEVIATIONS = 4.0  # of the autocorrelation at the first lags, in standard deviations of that of white noise
WHITE_LAGS = 4
SMOOTH_MARGIN = 20.0  # in -2 log likelihood: by which noise of states must explain more than smooth errors of sensors
SPREAD = 5.0  # standard deviations of χ² up to which it is as stated
SMOOTH_LAGS = 16  # records: order up to which errors of a sensor follow each other
ROUNDS = 2  # of fitting with the noise and estimating it again
STEPS = 25  # of Gauss-Newton with the noise
MAX_REPEATED = 0.1  # share of the samples that repeat the one before: with more, a converter hides the noise
LEAST_SHARE = 0.05  # of a stated level: the least one that a window can show
MAX_SCORING = 10  # steps of Fisher scoring
LENGTHS = (1.0, 0.3, 0.1, 0.03, 0.01)  # of a step that are tried
MIN_SHRINKING = 0.04  # ratio of a variance after a step to that before
RIDGE = 0.05  # added to the correlations of slopes, which few random vectors estimate


def noisier_signals(fitted: Sequence[FittedHypothesis]) -> list[FittedHypothesis]:
    """Return the hypotheses of larger noise beside those ``fitted`` to a window, the null first; all leave white noise.

    There is none where the best hypothesis leaves white noise as stated.
    """
    null, around = fitted[0], fitted[0].fit
    best = min(fitted, key=lambda item: item.deviance(null.fit.count, 1.0)).fit
    if is_white(best) and abs(best.window_chi_square - best.count) <= SPREAD * np.sqrt(2.0 * best.count):
        return []
    fits = _fitted(_likely(around.linearised_at_end()), null.fit)
    for _ in range(ROUNDS if null.fit.cost > EXPLAINED else 0):  # far from the null, levels are those of its errors
        best = min(fits, key=lambda item: item.chi_square + normalisation(item, null.fit), default=around)
        around = replace(best, problem=null.problem)
        fits = _fitted(_likely(around.linearised_at_end()), null.fit)
    return [_hypothesis(item, null) for item in fits if is_white(item)]


def _likely(before: Fit) -> list[Fit]:
    """Return the window at likely levels where noise is stated, and elsewhere too."""
    elsewhere = _at_likely_levels(before, allowed := _allowed(before))
    if _is_smooth(before, elsewhere):
        of_inputs = np.arange(len(allowed)) < len(before.problem.base_model.inputs)
        elsewhere = _at_likely_levels(before, allowed & of_inputs)
    return [_at_likely_levels(before, allowed & ~allowed), elsewhere]


def _is_smooth(before: Fit, trial: Fit) -> bool:
    """Whether noise of states that ``trial`` has beside that of ``before`` may be smooth errors of sensors."""
    at = len(before.problem.base_model.signals)
    is_new = np.array(trial.problem.levels[at:])[np.array(before.problem.levels[at:]) == 0.0].any()
    return bool(is_new and _deviance(before) - _deviance(trial) <= _gain_of_smooth_errors(before) + SMOOTH_MARGIN)


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


def _fitted(trials: list[Fit], null: Fit) -> list[Fit]:
    """Fit the window of ``null`` at the levels of each of the ``trials`` with larger ones, but no useless sensor."""
    stated, useless = np.array(null.problem.levels), MAX_NOISE_FACTOR * np.array(null.problem.noise)
    distinct = {trial.problem.levels: trial for trial in trials if (np.array(trial.problem.levels) > stated).any()}
    fits = [
        fit(null.problem.with_levels(levels), null.window, _widened(null, trial), null.prior.mean, STEPS)
        for levels, trial in distinct.items()
    ]
    return [item for item in fits if (np.array(item.problem.noise) <= useless).all()]


def _widened(null: Fit, trial: Fit) -> Prior:
    """Return the prior of ``null``, less certain by as much as a window is with the noise of ``trial``."""
    rows, free = len(null.prior.mean), len(null.problem.free)
    known, own = (
        information(jacobian[:-rows], np.ones(jacobian.shape[1]), 1.0).sd[:free]
        for jacobian in (null.result.first[2], trial.result.first[2])
    )
    ratios = np.divide(own, known, out=np.ones(free), where=np.isfinite(own) & np.isfinite(known))
    return replace(null.prior, covariance=null.prior.covariance * max(float(median(ratios)), 1.0) ** 2)


def _hypothesis(fitted: Fit, null: FittedHypothesis) -> FittedHypothesis:
    """Return the hypothesis of the levels of ``fitted``."""
    twin, before, levels = fitted.problem.base_model, np.array(null.problem.levels), np.array(fitted.problem.levels)
    names = np.array([*twin.signals, *(f"der({state.name})" for state in twin.states)])
    changed = int((levels != before).sum())
    stated = FaultHypothesis(FaultType.NOISE, ", ".join(names[levels > before]), changed, comb(len(names), changed))
    return FittedHypothesis(stated, fitted, normalisation(fitted, null.fit))


def _at_likely_levels(stated: Fit, allowed: Mask) -> Fit:
    """Return the window linearised at likely levels where noise is stated, and of further ``allowed`` places (levels,).

    Each of these makes it more likely by one value. Inputs are kept rather than the states that they drive. A level
    that is hardly larger stays, and so does a smaller one unless that is decisively less likely.
    """
    before, places, added = np.array(stated.problem.levels), np.arange(len(allowed)), allowed
    trial = _most_likely(stated, (before > 0.0) | added)
    for at in np.flatnonzero(allowed)[::-1]:
        without = added & (places != at)
        fewer = _at(trial, np.where(places == at, 0.0, trial.problem.levels))
        fewer = _most_likely(fewer, (before > 0.0) | without)
        if _deviance(fewer) <= _deviance(trial) + np.log(stated.count):
            added, trial = without, fewer
    ratios = np.array(trial.problem.levels) / np.where(before > 0.0, before, np.inf)
    larger = added | (ratios > MIN_NOISE_FACTOR)
    for kept in (larger, larger | ((before > 0.0) & (ratios < 1.0 / MIN_NOISE_FACTOR))):
        again = _most_likely(_at(trial, np.where(kept, trial.problem.levels, before)), kept)
        if _deviance(again) <= _deviance(trial) + DECISIVE:
            break
    return again


def _gain_of_smooth_errors(fitted: Fit) -> float:
    """Return by what -2 log likelihood would fall with autoregressive errors of the outputs, less two for a value."""
    _, residuals, jacobian = fitted.result.first
    basis, present, total = orthonormal_basis(jacobian), fitted.objective.present, 0.0
    left = (residuals - basis @ (basis.T @ residuals))[: present.size].reshape(present.shape)
    for series, measured in zip(left.T, present.T, strict=True):
        values = series[measured]
        count, power, order = len(values), float(values @ values), min(SMOOTH_LAGS, len(values) // 4)
        covariances = np.array([values[lag:] @ values[: count - lag] for lag in range(order + 1)]) / max(count, 1)
        near = covariances[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
        variance = covariances[0] - covariances[1:] @ np.linalg.lstsq(near, covariances[1:], rcond=None)[0]
        if variance > 0.0:
            total += max(power - count * (1.0 + np.log(variance)) - 2.0 * (order + 1), 0.0)
    return total


def _allowed(stated: Fit) -> Mask:
    """Return where no noise is stated but may be (levels,): inputs that show some, states that are no mere sums."""
    twin = stated.problem.base_model
    equations, names = dict(twin.equations), [state.name for state in twin.states]
    of_states = [equations[f"der({name})"].strip() not in names for name in names]
    free = (np.array(stated.problem.levels) == 0.0) & (_limits(stated)[1] > 0.0)
    return np.asarray(free & np.array([True] * len(twin.signals) + of_states))


def _most_likely(trial: Fit, places: Mask) -> Fit:
    """Return the window linearised at the levels of ``places`` (levels,) that maximise the likelihood.

    Fisher scoring over variances (N. K. Gupta, R. K. Mehra, IEEE Transactions on Automatic Control 19, 1974). Slope and
    expected curvature are mean and covariance of the squared inner products with random vectors.
    """
    lowest, highest = _limits(trial)
    for _ in range(MAX_SCORING if places.any() else 0):
        variances, squares = np.array(trial.problem.levels) ** 2, LinearResponse(trial).squares_of_noise()
        slope, covariance = squares[:, 0] - squares[:, 1:].mean(axis=1), np.cov(squares[:, 1:]) / 2.0
        scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
        correlation, free = covariance / np.outer(scale, scale) + RIDGE * np.eye(len(scale)), places
        for _ in range(2):  # a level that would fall below its limit stays
            inverse = np.linalg.pinv(np.where(np.outer(free, free), correlation, 0.0))
            step = inverse @ (slope / scale) / scale
            free = places & ((variances > lowest**2) | (step > 0.0))
        if 0.5 * float(slope @ step) < VISIBLE:
            break
        bounds = np.maximum(lowest**2, MIN_SHRINKING * variances), highest**2
        moved = (np.clip(variances + share * step, *bounds) for share in LENGTHS)
        trials = (_at(trial, np.sqrt(np.where(places, own, variances))) for own in moved)
        better = next((own for own in trials if _deviance(own) < _deviance(trial)), None)
        if better is None:
            break
        trial = better
    return trial


def _limits(trial: Fit) -> tuple[Array, Array]:
    """Return the least level of each place, which a converter raises, and the largest that samples of an input show."""
    problem, stated = trial.problem, np.array(trial.problem.stated_levels)
    lowest, inputs = LEAST_SHARE * stated, len(problem.base_model.inputs)
    for at, (output, step) in enumerate(
        zip(problem.base_model.outputs, problem.steps or repeat(0.0), strict=False), inputs
    ):
        is_coarse = (np.diff(trial.window.readings(output.name)) == 0.0).mean() > MAX_REPEATED
        lowest[at] = stated[at] if is_coarse else max(lowest[at], min(step, stated[at]))
    highest = np.full(len(stated), np.inf)
    for at, source in enumerate(problem.base_model.inputs):
        differences = np.abs(sample_differences(source.name, trial.window))
        highest[at] = max(MAD_TO_SD * median(differences) if len(differences) else 0.0, stated[at])
    return lowest, highest


def _at(trial: Fit, levels: Array) -> Fit:
    return replace(trial, problem=trial.problem.with_levels(levels.tolist())).linearised_at_end()


def _deviance(trial: Fit) -> float:
    """Return -2 log likelihood of a window around which the twin is linearised."""
    return chi_square_of_parameters(trial) + trial.objective.innovation_model.log_determinant


def likelier_levels_of(fitted: Fit) -> Problem:
    """Return the problem of ``fitted`` with the likely levels of its window if all are smaller, else with its own.

    Process noise that is stated too large for that of the sensors makes the predictor follow every sample. The gain of
    a sensor would change how far it follows, and would pass for a cause.
    """
    likely = _at_likely_levels(fitted.linearised_at_end(), np.zeros(len(fitted.problem.levels), dtype=np.bool_)).problem
    return likely if (np.array(likely.levels) <= fitted.problem.levels).all() else fitted.problem


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
