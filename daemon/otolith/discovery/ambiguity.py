"""Hypotheses that the data cannot distinguish, and what is known of the parameters under all of them.

Hypotheses of different types or places may explain the same windows: a resistance of the pipe that has risen, and a
gain of the sensor of the throttle. Their prior weights and numbers of values must not decide between them. They form a
class: the best hypothesis of each place has the same probability. What is published of a parameter is the mixture of
all hypotheses. It is certain where they agree, and its interval holds all of them where they differ.
``docs/explanation/discovery.md`` has the equations.
"""

from collections.abc import Sequence

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.screening import DECISIVE
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem

MAX_OPEN_WINDOWS = 8  # windows after which a test tracks only the best hypothesis of each place
MIN_WEIGHT = 0.05  # of a hypothesis whose own interval the published one contains
WRONG_WINDOW = 0.5  # probability that the window that opened a test is itself wrong


def interchangeable(hypotheses: Sequence[TrackedHypothesis]) -> list[list[int]]:
    """Return the indices of the hypotheses that explain the windows equally well, grouped by type and place.

    Their misfits are at most ``DECISIVE`` above the least. The best of each group comes first. A component is in a
    group only if nothing with fewer values explains the windows as well. Otherwise its deviance decides, with the
    complexity penalty. The null hypothesis is contained in all others, so it is in no group.
    """
    others = [at for at, item in enumerate(hypotheses) if item.type is not FaultType.NOTHING]
    least = min((hypotheses[at].misfit for at in others), default=0.0)
    equal = [at for at in others if hypotheses[at].misfit <= least + DECISIVE]
    least_values = min((hypotheses[at].hypothesis.added for at in equal), default=0)
    moved = [hypotheses[at] for at in equal if hypotheses[at].type is FaultType.PARAMETER]
    simplest = min(moved, key=lambda item: (item.hypothesis.added, item.deviance), default=None)
    groups: dict[tuple[FaultType, tuple[str, ...]], list[int]] = {}
    for at in sorted(equal, key=lambda at: hypotheses[at].deviance):
        item = hypotheses[at]
        if item.type is not FaultType.COMPONENT or item.hypothesis.added <= least_values:
            groups.setdefault((item.type, _place(item, simplest)), []).append(at)
    return list(groups.values())


def _place(item: TrackedHypothesis, simplest: TrackedHypothesis | None) -> tuple[str, ...]:
    """Return what ``item`` is about: of moved parameters their names.

    More moved parameters than those of the ``simplest`` hypothesis of moved parameters are a variant of it.
    """
    if simplest is None or item.type is not FaultType.PARAMETER:
        return item.places
    return ((item if item.hypothesis.added <= simplest.hypothesis.added else simplest).hypothesis.name,)


def probabilities(hypotheses: Sequence[TrackedHypothesis], groups: Sequence[Sequence[int]]) -> list[float]:
    """Return the probability of each hypothesis; ``groups`` of interchangeable ones are equally probable."""
    logs = -0.5 * np.array([item.deviance for item in hypotheses])
    totals = [float(np.logaddexp.reduce(logs[list(group)])) for group in groups]
    for group, total in zip(groups, totals, strict=True):
        logs[list(group)] += max(totals) - total
    weights = np.exp(logs - logs.max())
    shares: list[float] = (weights / weights.sum()).tolist()
    return shares


def without_duplicates(
    hypotheses: tuple[TrackedHypothesis, ...], groups: Sequence[Sequence[int]]
) -> tuple[TrackedHypothesis, ...]:
    """Return the hypotheses with only the best of each of the ``groups`` of interchangeable ones."""
    worse = {at for group in groups for at in group[1:]}
    return tuple(item for at, item in enumerate(hypotheses) if at not in worse)


def mixture(
    hypotheses: Sequence[TrackedHypothesis], shares: Sequence[float], problem: Problem, before: Prior, wrong: float
) -> Prior:
    """Return what is known of the free parameters of ``problem`` under all hypotheses, as one normal distribution.

    ``shares`` are their probabilities if the window that opened the test is right. With probability ``wrong`` it is
    not, and ``before`` holds, which is known without it.
    """
    priors = [*(item.known(problem) for item in hypotheses), before]
    weights = np.append((1.0 - wrong) * np.array(shares), wrong)
    means = np.array([prior.mean for prior in priors])
    mean: Array = weights @ means
    offsets = means - mean
    own = np.array([prior.covariance for prior in priors])
    covariance = np.einsum("h,hij->ij", weights, own + offsets[:, :, None] * offsets[:, None, :])
    sd = np.sqrt(np.diag(covariance))
    reach = np.abs(offsets) / QUANTILE + np.sqrt(np.diagonal(own, axis1=1, axis2=2))
    wider = np.maximum(reach[weights >= MIN_WEIGHT].max(axis=0, initial=0.0) / np.where(sd > 0.0, sd, 1.0), 1.0)
    return Prior(mean, covariance * np.outer(wider, wider))
