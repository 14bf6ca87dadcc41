"""From window to window: every parameter as value and trend, with covariance, under several ideas of how it changes.

Windows are not independent experiments. What is known after one, carried on to the end of the next, is that one's prior
(see :mod:`otolith.adaptation.prior`). How fast a healthy parameter may change is not known beforehand, so a bank of
models from "it hardly does" to "it runs away" is carried along, each weighted by how well it foretold the windows
(interacting multiple models: H. A. P. Blom, Y. Bar-Shalom, IEEE Transactions on Automatic Control 33, 1988).
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.prior import Evidence, Prior, vague
from otolith.adaptation.problem import Problem

AGITATIONS = np.array([1e-8, 1e-7, 1e-6, 1e-5, 1e-4])  # 1/s^1.5: how much a trend strays, in shares of the parameter
MEMORY = 1000.0  # s: a trend that nothing confirms dies away, so that no held value runs off
STAY = 0.9  # probability that from one window to the next the same model holds
LEAST_WEIGHT = 1e-12
LONGEST_GAP = 1e7  # s between windows: the models are stationary by then
SCATTER_MEMORY = 0.1  # share of the newest window in the scatter
MOST_SCATTER = 1e4
CLIPPED = 9.0  # surprise of one window that counts at most, so that none alone makes everything doubtful
CONTRADICTION = 25.0  # the most that a window may raise the scatter that contradicted those before and after it


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What is known of parameters and trends, in shares of the parameters' sizes; plain, so that it pickles."""

    mean: Array
    """(models, 2 free) at ``end``."""
    covariance: Array
    """(models, 2 free, 2 free)."""
    weight: Array
    """(models,) probabilities."""
    end: float
    """Unix seconds of the last record that it is about; minus infinity before the first window."""
    scatter: float = 1.0
    """How much more windows differ from each other than they say themselves (variance): one if all is well."""


def begin_belief(problem: Problem) -> Belief:
    """Before the first window."""
    prior, size = vague(problem), _size(problem)
    free, models = len(problem.free), len(AGITATIONS)
    mean = np.tile(prior.mean / size, (models, 1))
    covariance = np.tile(prior.covariance / np.outer(size, size), (models, 1, 1))
    trends = np.arange(free, 2 * free)
    covariance[:, trends, trends] = (AGITATIONS**2 * MEMORY / 2.0)[:, None]
    return Belief(mean, covariance, np.full(models, 1.0 / models), -np.inf)


def carried(belief: Belief, end: float) -> Belief:
    """The belief at a later time (Unix s): values run on along their trends, and everything becomes less certain."""
    if not np.isfinite(belief.end):
        return replace(belief, end=end)
    belief = _mixed(belief)
    passed = float(np.clip(end - belief.end, 0.0, LONGEST_GAP))
    free = belief.mean.shape[1] // 2
    transition, noise = _motion(passed)
    move = np.kron(transition, np.eye(free))
    strays = AGITATIONS[:, None, None] ** 2 * np.kron(noise, np.eye(free))
    mean = belief.mean @ move.T
    return replace(belief, mean=mean, covariance=move @ belief.covariance @ move.T + strays, end=end)


def overall(belief: Belief, problem: Problem) -> Prior:
    """All models as one normal distribution, in the units of the parameters."""
    mean = belief.weight @ belief.mean
    off = belief.mean - mean
    covariance = np.einsum("m,mij->ij", belief.weight, belief.covariance + off[:, :, None] * off[:, None, :])
    size = _size(problem)
    return Prior(mean * size, covariance * np.outer(size, size))


def surprise(belief: Belief, evidence: Evidence, problem: Problem) -> float:
    """Squared distance of a window from what was expected, under the model that takes it best: χ² of 2 free degrees."""
    _, foretold, innovation = _foretold(belief, evidence, problem)
    return float(np.einsum("mi,mij,mj->m", innovation, np.linalg.inv(foretold), innovation).min())


def updated(belief: Belief, evidence: Evidence, problem: Problem) -> Belief:
    """The belief after a window; ``belief`` has been carried to its end."""
    root, foretold, innovation = _foretold(belief, evidence, problem)
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
    return replace(
        belief,
        mean=mean,
        covariance=covariance,
        weight=weight / weight.sum(),
        scatter=_scattered(belief.scatter, float(distance.min()) / len(root)),
    )


def contradicted(belief: Belief, surprise_per_degree: float) -> Belief:
    """The belief after a window that disagreed with those before it and those after it: windows scatter that much."""
    return replace(belief, scatter=belief.scatter * float(np.clip(surprise_per_degree / CLIPPED, 1.0, CONTRADICTION)))


def _foretold(belief: Belief, evidence: Evidence, problem: Problem) -> tuple[Array, Array, Array]:
    """The window's root in shares, and per model its innovation's covariance and the innovation."""
    size = _size(problem)
    doubt = np.sqrt(belief.scatter)
    root = evidence.root * size / doubt
    foretold = np.eye(len(root)) + root @ belief.covariance @ root.T
    innovation = evidence.rest / doubt + (belief.mean - evidence.point / size) @ root.T
    return root, foretold, innovation


def _scattered(scatter: float, surprise_per_degree: float) -> float:
    change = 1.0 + SCATTER_MEMORY * (min(surprise_per_degree, CLIPPED) - 1.0)
    return float(np.clip(scatter * change, 1.0, MOST_SCATTER))


def _mixed(belief: Belief) -> Belief:
    """Models change into their neighbours with a small probability, so that none dies out."""
    models = len(belief.weight)
    move = STAY * np.eye(models)
    for index in range(models):
        neighbours = [other for other in (index - 1, index + 1) if 0 <= other < models]
        move[index, neighbours] = (1.0 - STAY) / len(neighbours)
    weight = belief.weight @ move
    share = belief.weight[:, None] * move / weight  # of each old model in each new one
    mean = share.T @ belief.mean
    off = belief.mean[:, None, :] - mean[None, :, :]
    spread = belief.covariance[:, None] + off[..., :, None] * off[..., None, :]
    return replace(belief, mean=mean, covariance=np.einsum("on,onij->nij", share, spread), weight=weight)


def _motion(passed: float) -> tuple[Array, Array]:
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


def _size(problem: Problem) -> Array:
    """(2 free,)."""
    return np.tile(problem.scale, 2)
