"""Orders of harmonics of an angle: whole ones in a prediction, where nothing contradicts it.

What turns with a shaft acts a whole number of times per turn, as an unbalance does once. The filter knows its order to
an interval, and in a prediction over many turns that interval would become one of all phases.
"""

from dataclasses import replace

import numpy as np

from otolith.estimation import imm_filter
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import indices, source_of


def with_whole_orders(posterior: Posterior) -> Posterior:
    """Return the same with each order of an angle known to be a whole number, if the evidence for that is decisive.

    The two hypotheses are a whole order and any order, with a density of one per unit (J. M. Dickey, Annals of
    Mathematical Statistics 42, 1971). A whole one has no trend.
    """
    problem, prior, belief = posterior.problem, posterior.prior(), posterior.belief
    count, size = len(problem.free), np.concatenate([problem.scale, problem.scale])
    for slot, component in enumerate(problem.components):
        if not component.periodic or source_of(problem.base_model, component.source).unit != "rad":
            continue
        inner = indices(problem, slot)[1]
        order, sd = float(prior.mean[inner]), float(prior.sd[inner])
        whole = round(order)
        if whole and sd > 0.0 and _evidence(order - whole, sd) < -DECISIVE:
            belief = imm_filter.condition(belief, inner, whole / size[inner])
            belief = imm_filter.condition(belief, count + inner, 0.0)
    return replace(posterior, belief=belief)


def _evidence(deviation: float, sd: float) -> float:
    """Return -2 log of the odds of a whole order against any, if an order deviates by that much from a whole one."""
    return float((deviation / sd) ** 2 + np.log(2.0 * np.pi * sd**2))
