"""From window to window: every parameter as value and trend, with covariance, under several ideas of how it changes.

Windows are not independent experiments. What is known after one, carried on to the end of the next, is that one's
prior (see :mod:`otolith.estimation.arrival_cost`). How fast a parameter may change is not known beforehand, from "it
hardly does" to "it runs away". So a bank of models is carried along, each weighted by how well it foretold the
windows: one with what seems right for every parameter, and some in which one of them is calmer, livelier or runs away
(interacting multiple models: H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33, 1988; with a
model set that moves: X. R. Li, Y. Bar-Shalom, IEEE Transactions on Automatic Control 41, 1996).

How a parameter moves between windows: its trend is a random process, its value the integral of it.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array
from otolith.estimation.arrival_cost import Evidence, Prior, initial_prior
from otolith.estimation.problem import Problem

MEMORY = 300.0  # s: a trend that nothing confirms dies away, so that no held value runs off


def process_model(passed: float) -> tuple[Array, Array]:
    """Transition and noise (per unit of agitation) of value and trend over ``passed`` s.

    The trend is an Ornstein-Uhlenbeck process, the value its integral (C. W. Gardiner, Stochastic Methods, section
    3.8).
    """
    share = passed / MEMORY
    fade = np.exp(-share)
    run = MEMORY * -np.expm1(-share)
    if share < 1e-3:  # the closed form loses its digits
        noise = np.array([[passed**3 / 3.0, passed**2 / 2.0], [passed**2 / 2.0, passed]])
    else:
        both = MEMORY**2 * 0.5 * (1.0 - fade) ** 2
        value = MEMORY**3 * (share - 2.0 * (1.0 - fade) + 0.5 * (1.0 - fade**2))
        noise = np.array([[value, both], [both, MEMORY * 0.5 * (1.0 - fade**2)]])
    return np.array([[1.0, run], [0.0, fade]]), noise


TREND_NOISE = np.array([1e-7, 1e-6, 1e-5, 1e-4])  # 1/s^1.5: how much a trend strays, in shares of the parameter
STAY = 0.97  # probability that from one window to the next the same model holds
CALMEST = 1  # levels under the liveliest parameter's
LIVELIEST = len(TREND_NOISE) - 1
FIRST_LEVEL = 2
CALMER = 1.5  # how much likelier a calmer model must be to be believed: calm is the assumption that does harm
NEWCOMER = 0.02  # weight of a model that comes into the bank
LEAST_WEIGHT = 1e-12
LONGEST_GAP = 1e7  # s between windows: the models are stationary by then
SCATTER_MEMORY = 0.1  # share of the newest window in the scatter
MOST_SCATTER = 1e4
CLIPPED = 9.0  # surprise of one window that counts at most, so that none alone makes everything doubtful
CONTRADICTION = 25.0  # the most that a window may raise the scatter that contradicted those before and after it

Levels = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class ImmPosterior:
    """What is known of parameters and trends, in shares of the parameters' sizes; plain, so that it pickles."""

    level: Levels
    """(models, free) which of the agitations; the first model is the one that the others are neighbours of."""
    mean: Array
    """(models, 2 free) at ``end``."""
    covariance: Array
    """(models, 2 free, 2 free)."""
    weight: Array
    """(models,) probabilities."""
    end: float
    """Unix seconds of the last record that it is about; minus infinity before the first window."""
    variance_ratio: float = 1.0
    """How much more windows differ from each other than they say themselves (variance): one if all is well."""


def initial_posterior(problem: Problem) -> ImmPosterior:
    """Before the first window."""
    prior, size = initial_prior(problem), _size(problem)
    free = len(problem.free)
    level = _around(np.full(free, FIRST_LEVEL))
    mean = np.tile(prior.mean / size, (len(level), 1))
    covariance = np.tile(prior.covariance / np.outer(size, size), (len(level), 1, 1))
    trends = np.arange(free, 2 * free)
    covariance[:, trends, trends] = TREND_NOISE[level] ** 2 * MEMORY / 2.0
    return ImmPosterior(level, mean, covariance, np.full(len(level), 1.0 / len(level)), -np.inf)


def _around(centre: Levels) -> Levels:
    """(free,) -> (models, free): itself, and others in which one parameter is calmer, livelier or runs away.

    None is much calmer than the liveliest: what drifts could be any of those it is traded with.
    """
    models = [centre]
    for parameter, level in enumerate(centre):
        for other in sorted({max(level - 1, 0), min(level + 1, LIVELIEST), LIVELIEST} - {level}):
            models.append(centre.copy())
            models[-1][parameter] = other
    bank = [np.maximum(model, model.max() - CALMEST) for model in models]
    return np.array(list({tuple(model.tolist()): None for model in bank}))  # each once, the centre first


def predict(belief: ImmPosterior, end: float) -> ImmPosterior:
    """The belief at a later time (Unix s): values run on along their trends, and everything becomes less certain."""
    if not np.isfinite(belief.end):
        return replace(belief, end=end)
    if end <= belief.end:  # a clock that was set back tells nothing
        return belief
    belief = _mix(belief)
    free = belief.mean.shape[1] // 2
    transition, noise = process_model(min(end - belief.end, LONGEST_GAP))
    move, strays = _per_parameter(transition, np.ones(free)), _per_parameter(noise, TREND_NOISE[belief.level] ** 2)
    covariance = move @ belief.covariance @ move.T + strays
    return replace(belief, mean=belief.mean @ move.T, covariance=covariance, end=end)


def moment_match(belief: ImmPosterior, problem: Problem) -> Prior:
    """All models as one normal distribution, in the units of the parameters."""
    size = _size(problem)
    mean, covariance = _moments(belief)
    return Prior(mean * size, covariance * np.outer(size, size))


def _moments(belief: ImmPosterior) -> tuple[Array, Array]:
    mean = belief.weight @ belief.mean
    off = belief.mean - mean
    return mean, np.einsum("m,mij->ij", belief.weight, belief.covariance + off[:, :, None] * off[:, None, :])


def _recentred(belief: ImmPosterior) -> ImmPosterior:
    """The bank around its likeliest model."""
    calmer = (belief.level < belief.level[0]).any(axis=1)
    best = int(np.where(calmer, belief.weight / CALMER, belief.weight).argmax())
    if best == 0:
        return belief
    level = _around(belief.level[best])
    mean, covariance = _moments(belief)
    old = {tuple(row): index for index, row in enumerate(belief.level.tolist())}
    kept = [old.get(tuple(row)) for row in level.tolist()]
    weight = np.array([NEWCOMER if index is None else belief.weight[index] for index in kept])
    return replace(
        belief,
        level=level,
        mean=np.array([mean if index is None else belief.mean[index] for index in kept]),
        covariance=np.array([covariance if index is None else belief.covariance[index] for index in kept]),
        weight=weight / weight.sum(),
    )


def nis(belief: ImmPosterior, evidence: Evidence, problem: Problem) -> float:
    """Squared distance of a window from what was expected, under the model that takes it best: χ² of 2 free degrees."""
    _, foretold, innovation = _innovation(belief, evidence, problem)
    return float(np.einsum("mi,mij,mj->m", innovation, np.linalg.inv(foretold), innovation).min())


def remap_parameters(belief: ImmPosterior, problem: Problem, other: Problem) -> ImmPosterior:
    """The belief for another choice of free parameters: what both have is kept, and nothing known of what is new."""
    fresh, (mean, covariance) = initial_posterior(other), _moments(belief)
    order = {entry.label: index for index, entry in enumerate(problem.free)}  # slots may have changed their places
    both = [(order[entry.label], index) for index, entry in enumerate(other.free) if entry.label in order]
    old, new = (np.array(part, dtype=np.int64) for part in (zip(*both, strict=True) if both else ((), ())))
    level = np.full(len(other.free), FIRST_LEVEL)
    level[new] = belief.level[0][old]
    level = _around(np.maximum(level, level.max() - CALMEST))
    ratio = problem.scale[old] / other.scale[new]
    ratio = np.concatenate([ratio, ratio])
    old, new = (np.concatenate([part, part + count]) for part, count in ((old, len(order)), (new, len(other.free))))
    begun_mean, begun_covariance = _moments(fresh)
    begun_mean[new] = mean[old] * ratio
    begun_covariance[new, :] = begun_covariance[:, new] = 0.0
    begun_covariance[np.ix_(new, new)] = covariance[np.ix_(old, old)] * np.outer(ratio, ratio)
    count = len(level)
    return ImmPosterior(
        level,
        np.tile(begun_mean, (count, 1)),
        np.tile(begun_covariance, (count, 1, 1)),
        np.full(count, 1.0 / count),
        belief.end,
        belief.variance_ratio,
    )


def reset_marginal(belief: ImmPosterior, at: int, sd: float, value: float | None = None) -> ImmPosterior:
    """The belief where of number ``at`` (in shares) no more is known than ``sd``, nor of what goes with it."""
    mean, covariance = belief.mean.copy(), belief.covariance.copy()
    if value is not None:
        mean[:, at] = value
    covariance[:, at, :] = covariance[:, :, at] = 0.0
    covariance[:, at, at] = sd**2
    return replace(belief, mean=mean, covariance=covariance)


def set_all_modes(belief: ImmPosterior, prior: Prior, problem: Problem) -> ImmPosterior:
    """The belief with ``prior`` under every model of change."""
    size, models = _size(problem), len(belief.weight)
    mean = np.tile(prior.mean / size, (models, 1))
    return replace(belief, mean=mean, covariance=np.tile(prior.covariance / np.outer(size, size), (models, 1, 1)))


def update(belief: ImmPosterior, evidence: Evidence, problem: Problem) -> ImmPosterior:
    """The belief after a window; ``belief`` has been carried to its end."""
    root, foretold, innovation = _innovation(belief, evidence, problem)
    inverse = np.linalg.inv(foretold)
    gain = belief.covariance @ root.T @ inverse
    distance = np.einsum("mi,mij,mj->m", innovation, inverse, innovation)
    mean = belief.mean - np.einsum("mij,mj->mi", gain, innovation)
    kept = np.eye(belief.mean.shape[1]) - gain @ root
    covariance = kept @ belief.covariance @ kept.transpose(0, 2, 1) + gain @ gain.transpose(0, 2, 1)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    likelihood = -0.5 * (distance + np.linalg.slogdet(foretold)[1])
    weight = belief.weight * np.exp(likelihood - likelihood.max())
    weight = np.maximum(weight / weight.sum(), LEAST_WEIGHT)
    variance_ratio = _scattered(belief.variance_ratio, float(distance.min()) / len(root))
    learned = ImmPosterior(belief.level, mean, covariance, weight / weight.sum(), belief.end, variance_ratio)
    return _recentred(learned)


def inflate_variance(belief: ImmPosterior, surprise_per_degree: float) -> ImmPosterior:
    """The belief after a window that disagreed with those before it and those after it: windows scatter that much."""
    return replace(
        belief, variance_ratio=belief.variance_ratio * float(np.clip(surprise_per_degree / CLIPPED, 1.0, CONTRADICTION))
    )


def _innovation(belief: ImmPosterior, evidence: Evidence, problem: Problem) -> tuple[Array, Array, Array]:
    """The window's root in shares, and per model its innovation's covariance and the innovation."""
    size = _size(problem)
    grown = np.sqrt(belief.variance_ratio)
    root = evidence.root * size / grown
    foretold = np.eye(len(root)) + root @ belief.covariance @ root.T
    innovation = evidence.rest / grown + (belief.mean - evidence.point / size) @ root.T
    return root, foretold, innovation


def _scattered(variance_ratio: float, surprise_per_degree: float) -> float:
    change = 1.0 + SCATTER_MEMORY * (min(surprise_per_degree, CLIPPED) - 1.0)
    return float(np.clip(variance_ratio * change, 1.0, MOST_SCATTER))


def _per_parameter(block: Array, weight: Array) -> Array:
    """(2, 2) of value and trend, (..., free) -> (..., 2 free, 2 free), each parameter's share times its weight."""
    free = weight.shape[-1]
    apart = weight[..., None, :, None, None] * np.eye(free)[:, None, :]  # (..., 1, free, 1, free)
    found: Array = (block[:, None, :, None] * apart).reshape(*weight.shape[:-1], 2 * free, 2 * free)
    return found


def _mix(belief: ImmPosterior) -> ImmPosterior:
    """Models change into each other with a small probability, so that none dies out."""
    models = len(belief.weight)
    change = np.full((models, models), (1.0 - STAY) / (models - 1))
    np.fill_diagonal(change, STAY)
    weight = belief.weight @ change
    share = belief.weight[:, None] * change / weight  # of each old model in each new one
    mean = share.T @ belief.mean
    off = belief.mean[:, None, :] - mean[None, :, :]
    spread = belief.covariance[:, None] + off[..., :, None] * off[..., None, :]
    return replace(belief, mean=mean, covariance=np.einsum("on,onij->nij", share, spread), weight=weight)


def _size(problem: Problem) -> Array:
    """(2 free,)."""
    return np.tile(problem.scale, 2)
