"""The filter across windows: an interacting multiple model filter for values and trends of the parameters.

The prediction of the filter is the prior of the next window (see :mod:`otolith.estimation.information`). How fast a
parameter may change is not known beforehand. So a bank of modes runs side by side, each with its own process noise of
every trend, weighted by how well it predicted the windows (H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic
Control 33, 1988). The bank is centred on its most probable mode. In each neighbour the trend noise of one parameter is
one level lower, one level higher, or at the highest level; all others are raised to at most one level below the highest
of the mode (moving model set: X. R. Li, Y. Bar-Shalom, IEEE Transactions on Automatic Control 41, 1996).
``docs/explanation/filter.md`` has the equations.

The bank never excludes a trend that is possible but not there: the mixing returns its variance to each mode in each
window, and a prediction far ahead needs that it is excluded. So there is a further mode, in which all parameters are
constant. It takes from the bank as modes do, and loses the trends of what it takes (Y. Bar-Shalom, X. R. Li, T.
Kirubarajan, Estimation with Applications to Tracking and Navigation, section 11.6). The bank takes nothing from it, and
predictions of what follows alone read it: a drift that begins contradicts it, and is no reason for a search.

All numbers are relative to the sizes of the parameters; :mod:`otolith.estimation.posterior` converts.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array
from otolith.estimation.evidence import (
    CERTAIN_DEVIATE,
    CHANCE_DEVIATE,
    chi_square_limit,
    likelihood_ratios,
    log_determinant,
)
from otolith.estimation.information import Evidence

# 1/s^1.5: process noise of a trend, relative to the parameter; the last one of a parameter that is constant
TREND_NOISE = np.array([1e-7, 1e-6, 1e-5, 1e-4, 0.0])
CONSTANT = -1  # level of a parameter without trend, in the mode of constants
HIGHEST_LEVEL = len(TREND_NOISE) - 2
FIRST_LEVEL = HIGHEST_LEVEL  # before the first window: a parameter may already be drifting
ADDED_LEVEL = 2  # of a parameter that a hypothesis adds
MAX_LEVELS_BELOW = 1  # levels of a parameter below the highest of its mode: either of two correlated ones may drift
STAY_PROBABILITY = 0.97  # that the same mode holds in the next window
CALMER_FACTOR = 1.5  # how much more probable a calmer mode must be to become the centre
NEW_MODE_WEIGHT = 0.02  # probability of a mode that enters the bank
MIN_MODE_WEIGHT = 1e-12
TREND_MEMORY = 300.0  # s: time constant with which an unconfirmed trend decays
UNKNOWN_AWAY = 86_400.0  # s: what a time that no clock measured counts as, between two windows
MAX_GAP = 1e7  # s between windows: the modes are stationary by then
VARIANCE_RATIO_GAIN = 0.1  # share of the newest window in the variance ratio
MAX_VARIANCE_RATIO = 1e4
MAX_PRECISION = 1e7  # of a window: prior standard deviations over its own, in the direction of which it states most
SHIFT_REFERENCE = 1.0  # standard deviations: a window that shifts a parameter by less is evidence against a change
LARGEST_SHARE = 0.6  # of the limit that one window adds at most: a wrong window alone does not reach it
WINDOWS_PER_ALARM = 3e4  # healthy windows in which one of all sums exceeds its limit once
LEAST_SUMS = 4  # for which the limit is computed: of one parameter it is that of two
OVERSHOOT = 1.166  # standard deviations by which a sum exceeds its limit, twice: 2 · 0.583
SHIFTED_ALONG = 0.5  # of the limit: sum of a parameter that has been shifted along with another

Levels = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ImmPosterior:
    """Parameters and trends relative to the parameters' sizes, one normal distribution per mode. It pickles."""

    level: Levels  # (modes, free) indices into TREND_NOISE; the first mode is the centre of the bank
    mean: Array  # (modes, 2 free) at end
    covariance: Array  # (modes, 2 free, 2 free)
    weight: Array  # (modes,) probabilities
    end: float  # End of the last window, s on the clock of the windows; minus infinity before the first window
    variance_ratio: float = 1.0  # Variance between windows over the variance that they state; one if they agree


def initial_modes(mean: Array, covariance: Array) -> ImmPosterior:
    """Return the bank before the first window; trends have the stationary variance of their mode."""
    free = len(mean) // 2
    level = _bank((FIRST_LEVEL,) * free)
    covariances = np.tile(covariance, (len(level), 1, 1))
    trends = np.arange(free, 2 * free)
    covariances[:, trends, trends] = TREND_NOISE[level] ** 2 * TREND_MEMORY / 2.0
    return ImmPosterior(level, np.tile(mean, (len(level), 1)), covariances, _uniform(len(level)), -np.inf)


def equal_modes(level: Levels, mean: Array, covariance: Array, end: float, variance_ratio: float) -> ImmPosterior:
    """Return a bank around ``level`` (free,) whose modes all have the same mean and covariance."""
    bank = _bank(tuple(np.maximum(level, level.max() - MAX_LEVELS_BELOW).tolist()))
    count = len(bank)
    means, covariances = np.tile(mean, (count, 1)), np.tile(covariance, (count, 1, 1))
    return ImmPosterior(bank, means, covariances, _uniform(count), end, variance_ratio)


def _uniform(count: int) -> Array:
    return np.full(count, 1.0 / count)


@lru_cache(maxsize=64)
def _bank(levels: tuple[int, ...]) -> Levels:
    """Return the modes (modes, free) around the ``levels`` of the first one, each once."""
    centre = np.array(levels)
    modes = [centre]
    for parameter, level in enumerate(centre):
        for other in sorted({max(level - 1, 0), min(level + 1, HIGHEST_LEVEL), HIGHEST_LEVEL} - {level}):
            modes.append(centre.copy())
            modes[-1][parameter] = other
    raised = [np.maximum(mode, mode.max() - MAX_LEVELS_BELOW) for mode in modes]
    bank = np.array(list({tuple(mode.tolist()): None for mode in raised}))
    bank.flags.writeable = False  # many posteriors share it
    return bank


def process_model(elapsed: float) -> tuple[Array, Array]:
    """Return transition and noise covariance per unit of trend noise, both (2, 2), over ``elapsed`` s.

    The trend is an Ornstein-Uhlenbeck process, the value its integral (C. W. Gardiner, Stochastic Methods, section
    3.8).
    """
    share = elapsed / TREND_MEMORY
    fade = np.exp(-share)
    run = TREND_MEMORY * -np.expm1(-share)
    if share < 1e-3:  # the closed form loses its digits
        noise = np.array([[elapsed**3 / 3.0, elapsed**2 / 2.0], [elapsed**2 / 2.0, elapsed]])
    else:
        cross = TREND_MEMORY**2 * 0.5 * (1.0 - fade) ** 2
        value = TREND_MEMORY**3 * (share - 2.0 * (1.0 - fade) + 0.5 * (1.0 - fade**2))
        noise = np.array([[value, cross], [cross, TREND_MEMORY * 0.5 * (1.0 - fade**2)]])
    return np.array([[1.0, run], [0.0, fade]]), noise


def predict(posterior: ImmPosterior, end: float) -> ImmPosterior:
    """Return the prediction at ``end`` (s on the clock of the windows).

    If ``end`` lies before the last window, as in a log that begins again, the time since is unknown.
    """
    if not np.isfinite(posterior.end):
        return replace(posterior, end=end)
    elapsed = end - posterior.end if end >= posterior.end else UNKNOWN_AWAY
    if elapsed == 0.0:
        return posterior
    posterior = _mix(posterior)
    free = posterior.mean.shape[1] // 2
    transition, noise = process_model(min(elapsed, MAX_GAP))
    move = _block_diagonal(transition, np.ones(free))
    process_noise = _block_diagonal(noise, TREND_NOISE[posterior.level] ** 2)
    covariance = move @ posterior.covariance @ move.T + process_noise + _spread_of_decay(posterior.mean, elapsed)
    return replace(posterior, mean=posterior.mean @ move.T, covariance=covariance, end=end)


def _spread_of_decay(mean: Array, elapsed: float) -> Array:
    """Return the covariance (modes, 2 free, 2 free) of the unknown decay of the trends over ``elapsed`` s.

    The process model lets a trend decay, but it may also go on. The trend of a fast ramp would decay by more than the
    process noise adds in a window, and the filter would lag behind the ramp.
    """
    free = mean.shape[1] // 2
    trend, elapsed = mean[:, free:], min(elapsed, TREND_MEMORY)
    (_, run), (_, fade) = process_model(elapsed)[0]
    lost = np.concatenate([trend * (elapsed - run), trend * (1.0 - fade)], axis=1)
    own = np.tile(np.eye(free), (2, 2))  # the trends of two parameters decay independently
    return np.asarray(lost[:, :, None] * lost[:, None, :] * own)


def _mix(posterior: ImmPosterior) -> ImmPosterior:
    """Return the mixing step of the IMM filter: each mode starts from a mixture of all."""
    modes = len(posterior.weight)
    transition = np.full((modes, modes), (1.0 - STAY_PROBABILITY) / (modes - 1))
    np.fill_diagonal(transition, STAY_PROBABILITY)
    weight = posterior.weight @ transition
    share = posterior.weight[:, None] * transition / weight  # of each old mode in each new one
    mean = share.T @ posterior.mean
    offset = posterior.mean[:, None, :] - mean[None, :, :]
    spread = posterior.covariance[:, None] + offset[..., :, None] * offset[..., None, :]
    return replace(posterior, mean=mean, covariance=np.einsum("on,onij->nij", share, spread), weight=weight)


def moment_match(posterior: ImmPosterior) -> tuple[Array, Array]:
    """Return mean (2 free,) and covariance (2 free, 2 free) of the mixture of all modes."""
    mean = posterior.weight @ posterior.mean
    offset = posterior.mean - mean
    spread = posterior.covariance + offset[:, :, None] * offset[:, None, :]
    return mean, np.einsum("m,mij->ij", posterior.weight, spread)


@dataclass(frozen=True, slots=True, eq=False)
class Innovation:
    """By how much the evidence of a window differs from its prediction, in each mode."""

    prediction: ImmPosterior
    evidence: Evidence
    sqrt_information: Array  # (2 free, 2 free) of the window: R of docs/explanation/filter.md
    covariance: Array  # (modes, 2 free, 2 free): S
    inverse: Array  # (modes, 2 free, 2 free) of the covariance
    value: Array  # (modes, 2 free): ν
    nis_of_mode: Array  # (modes,) normalised innovation squared

    @property
    def nis(self) -> float:
        """The smallest normalised innovation squared over the modes.

        Under the true mode it follows χ² with two degrees of freedom for each free parameter.
        """
        return float(self.nis_of_mode.min())

    @property
    def is_expected(self) -> bool:
        """Whether it is within what healthy windows reach."""
        return self.nis <= chi_square_limit(len(self.sqrt_information))

    def inflate_variance(self, reduced_chi_square: float) -> "Innovation":
        """Return the same with a larger variance ratio, after a window that agreed with none before and none after it.

        ``reduced_chi_square`` is that of the window under the null hypothesis.
        """
        factor = float(np.clip(reduced_chi_square / CHANCE_DEVIATE**2, 1.0, CERTAIN_DEVIATE**2))
        prediction = replace(self.prediction, variance_ratio=self.prediction.variance_ratio * factor)
        return innovation_of(prediction, self.evidence)


@dataclass(frozen=True, slots=True, eq=False)
class ParameterCusum:
    """CUSUM test of the innovations of parameters, upwards and downwards (E. S. Page, Biometrika 41, 1954).

    It detects a change that no single window shows. The innovation test of one window misses a step of a few standard
    deviations, and the filter would follow it slowly, with an interval that excludes both values.
    """

    sums: Array | None = None  # (2, free); None if nothing is summed

    def after(self, shifts: Array) -> "ParameterCusum":
        """Return the sums after a window of these ``shifts`` (free,), in standard deviations."""
        both = np.array([shifts, -shifts]) - SHIFT_REFERENCE
        before = self.sums if self.sums is not None and self.sums.shape == both.shape else np.zeros(both.shape)
        return ParameterCusum(np.maximum(before + np.minimum(both, LARGEST_SHARE * shift_limit(both.size)), 0.0))

    @property
    def moved(self) -> list[int]:
        """Indices of the parameters that have moved: none unless the sum of one exceeds the limit.

        A change also shifts parameters that are correlated with the one that has moved. They count as moved from a
        share of the limit on.
        """
        if self.sums is None or not (self.sums > (limit := shift_limit(self.sums.size))).any():
            return []
        farthest: Array = self.sums.max(axis=0)
        return np.flatnonzero(farthest > SHIFTED_ALONG * limit).tolist()


def shift_limit(sums: int) -> float:
    """Return the limit of each of so many ``sums``, from the mean time to a false alarm of any of them.

    (D. Siegmund, Sequential Analysis, section 2.6.)
    """
    exponent = np.log(2.0 * SHIFT_REFERENCE**2 * WINDOWS_PER_ALARM * max(sums, LEAST_SUMS))
    return float(exponent / (2.0 * SHIFT_REFERENCE) - OVERSHOOT)


def innovation_of(prediction: ImmPosterior, evidence: Evidence) -> Innovation:
    """Return the innovation of a window in each mode."""
    inflation = np.sqrt(prediction.variance_ratio)
    limited = _limited(evidence, np.sqrt(np.diagonal(prediction.covariance, axis1=1, axis2=2).max(axis=0)))
    root = limited.sqrt_information / inflation
    covariance = np.eye(len(root)) + root @ prediction.covariance @ root.T
    inverse = np.linalg.inv(covariance)
    value = limited.residual / inflation + (prediction.mean - limited.point) @ root.T
    nis_of_mode = np.einsum("mi,mij,mj->m", value, inverse, value)
    return Innovation(prediction, evidence, root, covariance, inverse, value, nis_of_mode)


def update(innovation: Innovation) -> ImmPosterior:
    """Return the posterior after a window: Kalman update of each mode, then of the mode probabilities."""
    prediction, root = innovation.prediction, innovation.sqrt_information
    gain = prediction.covariance @ root.T @ innovation.inverse
    mean = prediction.mean - np.einsum("mij,mj->mi", gain, innovation.value)
    kept = np.eye(prediction.mean.shape[1]) - gain @ root  # Joseph form
    covariance = kept @ prediction.covariance @ kept.transpose(0, 2, 1) + gain @ gain.transpose(0, 2, 1)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    weight = prediction.weight * likelihood_ratios(innovation.nis_of_mode + log_determinant(innovation.covariance))
    weight = np.maximum(weight / weight.sum(), MIN_MODE_WEIGHT)
    ratio = _updated_ratio(prediction.variance_ratio, innovation.nis / len(root))
    return _recentre(ImmPosterior(prediction.level, mean, covariance, weight / weight.sum(), prediction.end, ratio))


def _limited(evidence: Evidence, sd: Array) -> Evidence:
    """Return evidence that is at most ``MAX_PRECISION`` times as precise as a prior of ``sd`` (2 free,).

    Beyond it the innovation's covariance is singular up to rounding, as where an axis stands still for long steps.
    """
    relative = evidence.sqrt_information * sd
    if np.abs(relative).sum() <= MAX_PRECISION:  # no singular value is larger than this sum
        return evidence
    directions, precision, _ = np.linalg.svd(relative)
    factors = np.ones(len(directions))
    factors[: len(precision)] = MAX_PRECISION / np.maximum(precision, MAX_PRECISION)
    reduced = (directions * factors).T
    return Evidence(evidence.point, reduced @ evidence.sqrt_information, reduced @ evidence.residual)


def _updated_ratio(variance_ratio: float, nis_per_degree: float) -> float:
    change = 1.0 + VARIANCE_RATIO_GAIN * (min(nis_per_degree, CHANCE_DEVIATE**2) - 1.0)
    return min(max(variance_ratio * change, 1.0), MAX_VARIANCE_RATIO)


def _recentre(posterior: ImmPosterior) -> ImmPosterior:
    """Return the bank centred on its most probable mode; a calmer one must be clearly more probable."""
    calmer = (posterior.level < posterior.level[0]).any(axis=1)
    best = int(np.where(calmer, posterior.weight / CALMER_FACTOR, posterior.weight).argmax())
    if best == 0:
        return posterior
    level = _bank(tuple(posterior.level[best].tolist()))
    mean, covariance = moment_match(posterior)
    old = {tuple(row): index for index, row in enumerate(posterior.level.tolist())}
    kept = [old.get(tuple(row)) for row in level.tolist()]
    weight = np.array([NEW_MODE_WEIGHT if index is None else posterior.weight[index] for index in kept])
    return replace(
        posterior,
        level=level,
        mean=np.array([mean if index is None else posterior.mean[index] for index in kept]),
        covariance=np.array([covariance if index is None else posterior.covariance[index] for index in kept]),
        weight=weight / weight.sum(),
    )


def reset_marginal(posterior: ImmPosterior, index: int, sd: float, value: float | None = None) -> ImmPosterior:
    """Return the posterior with a new, independent marginal of one entry in every mode."""
    mean, covariance = posterior.mean.copy(), posterior.covariance.copy()
    if value is not None:
        mean[:, index] = value
    covariance[:, index, :] = covariance[:, :, index] = 0.0
    covariance[:, index, index] = sd**2
    return replace(posterior, mean=mean, covariance=covariance)


def project(posterior: ImmPosterior, index: int, low: float, high: float) -> ImmPosterior:
    """Return the posterior whose entry at ``index`` lies between ``low`` and ``high``; correlated entries move with it.

    Estimate projection (D. Simon, IET Control Theory & Applications 4, 2010): the covariances stay.
    """
    beyond = np.clip(posterior.mean[:, index], low, high) - posterior.mean[:, index]
    gains = posterior.covariance[:, :, index] / posterior.covariance[:, index, index, None]
    return replace(posterior, mean=posterior.mean + gains * beyond[:, None])


def condition(posterior: ImmPosterior, index: int, value: float) -> ImmPosterior:
    """Return the posterior given that the entry at ``index`` is exactly ``value``; correlated entries move with it."""
    variance = posterior.covariance[:, index, index, None]
    gains = posterior.covariance[:, :, index] / np.where(variance > 0.0, variance, 1.0)  # its row is zero as well
    mean = posterior.mean + gains * (value - posterior.mean[:, index])[:, None]
    covariance = posterior.covariance - gains[:, :, None] * posterior.covariance[:, None, :, index]
    return reset_marginal(replace(posterior, mean=mean, covariance=covariance), index, 0.0, value)


def set_all_modes(posterior: ImmPosterior, mean: Array, covariance: Array) -> ImmPosterior:
    """Return the posterior with the same mean (2 free,) and covariance (2 free, 2 free) in every mode."""
    modes = len(posterior.weight)
    return replace(posterior, mean=np.tile(mean, (modes, 1)), covariance=np.tile(covariance, (modes, 1, 1)))


def _block_diagonal(block: Array, weight: Array) -> Array:
    """Return (..., 2 free, 2 free): ``block`` (2, 2) of value and trend for each parameter, times its weight."""
    free = weight.shape[-1]
    apart = weight[..., None, :, None, None] * np.eye(free)[:, None, :]  # (..., 1, free, 1, free)
    blocks: Array = (block[:, None, :, None] * apart).reshape(*weight.shape[:-1], 2 * free, 2 * free)
    return blocks


def constant_mode(bank: ImmPosterior) -> ImmPosterior:
    """Return the mode before any window supports it: values as the ``bank`` knows them, without trends.

    It has the probability of a mode that enters: a parameter may be drifting.
    """
    mean, covariance = _values_alone(bank)
    level = np.full((1, len(mean) // 2), CONSTANT)
    weight = np.array([NEW_MODE_WEIGHT])
    return ImmPosterior(level, mean[None], covariance[None], weight, bank.end, bank.variance_ratio)


def predict_constants(mode: ImmPosterior, bank: ImmPosterior, end: float) -> ImmPosterior:
    """Return the mode at ``end`` (s on the clock of the windows); it and the ``bank`` are those of the last window.

    If ``end`` lies before that, as in a log that begins again, it begins anew.
    """
    if end < bank.end:
        return replace(constant_mode(bank), end=end)
    if end == bank.end or not np.isfinite(bank.end):
        return replace(mode, end=end)
    mean, covariance = _values_alone(bank)
    (before,) = mode.weight
    weight = STAY_PROBABILITY * before + (1.0 - STAY_PROBABILITY) * (1.0 - before)
    share = (1.0 - STAY_PROBABILITY) * (1.0 - before) / weight  # of the bank in it
    offset = mean - mode.mean[0]
    spread = share * (1.0 - share) * np.outer(offset, offset)
    mixed = (1.0 - share) * mode.covariance[0] + share * covariance + spread
    return replace(mode, mean=mode.mean + share * offset, covariance=mixed[None], weight=np.array([weight]), end=end)


def update_constants(mode: ImmPosterior, innovation: Innovation) -> ImmPosterior:
    """Return the predicted ``mode`` after a window, of which the ``innovation`` is that of the bank."""
    bank, root = innovation.prediction, innovation.sqrt_information
    value = innovation.value[0] + root @ (mode.mean[0] - bank.mean[0])
    spread = np.eye(len(root)) + root @ mode.covariance[0] @ root.T
    gain = np.linalg.solve(spread, root @ mode.covariance[0]).T
    kept = np.eye(len(mode.mean[0])) - gain @ root  # Joseph form
    covariance = kept @ mode.covariance[0] @ kept.T + gain @ gain.T
    own = float(value @ np.linalg.solve(spread, value)) + float(log_determinant(spread))
    of_bank = innovation.nis_of_mode + log_determinant(innovation.covariance)
    against = float(np.logaddexp.reduce(np.log(bank.weight) - 0.5 * of_bank)) + 0.5 * own  # log of the Bayes factor
    odds = mode.weight / (1.0 - mode.weight) * np.exp(-np.clip(against, -700.0, 700.0))
    weight = np.clip(odds / (1.0 + odds), MIN_MODE_WEIGHT, 1.0 - MIN_MODE_WEIGHT)
    return replace(
        mode,
        mean=mode.mean - (gain @ value)[None],
        covariance=0.5 * (covariance + covariance.T)[None],
        weight=weight,
    )


def with_constants(bank: ImmPosterior, mode: ImmPosterior) -> ImmPosterior:
    """Return all modes, each with its probability: for a prediction of what follows."""
    return replace(
        bank,
        level=np.concatenate([bank.level, mode.level]),
        mean=np.concatenate([bank.mean, mode.mean]),
        covariance=np.concatenate([bank.covariance, mode.covariance]),
        weight=np.append((1.0 - mode.weight) * bank.weight, mode.weight),
    )


def _values_alone(bank: ImmPosterior) -> tuple[Array, Array]:
    """Return mean (2 free,) and covariance (2 free, 2 free) of the values in all modes; those of trends are zero."""
    mean, covariance = moment_match(bank)
    free = len(mean) // 2
    mean[free:] = 0.0
    covariance[free:] = covariance[:, free:] = 0.0
    return mean, covariance
