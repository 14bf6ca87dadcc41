"""The baseline: the values of the parameters while the machine was healthy, to which relative limits refer."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from otolith.health.limits import MonitoredQuantity, MonitoringPlan
from otolith.health.prognosis import MIN_POINTS, History


@dataclass(frozen=True, slots=True)
class Baseline:
    """The value of a parameter of the healthy machine, at its reference temperature."""

    value: float
    sd: float
    windows: int
    """Number of estimates that it is the mean of."""
    end: float
    """Time of the last of them, Unix s."""


def baselines(histories: Mapping[str, History]) -> dict[str, Baseline]:
    """Return the baseline of each parameter with enough estimates.

    Their errors are correlated, so the mean is as uncertain as one of them, and as much as they differ.
    """
    known: dict[str, Baseline] = {}
    for name, history in histories.items():
        if len(history) >= MIN_POINTS:
            _, values, variances = np.array(history).T
            sd = math.sqrt(float(variances.mean() + values.var()))
            known[name] = Baseline(float(values.mean()), sd, len(history), history[-1][0])
    return known


def with_baselines(plan: MonitoringPlan, known: Mapping[str, Baseline]) -> MonitoringPlan:
    """Return the plan with the baselines that are ``known``, and with no others."""
    stated = plan.parameters if plan.stated is None else plan.stated
    parameters = {name: with_baseline(quantity, known.get(name)) for name, quantity in stated.items()}
    return replace(plan, parameters=parameters, stated=stated)


def with_baseline(quantity: MonitoredQuantity, baseline: Baseline | None) -> MonitoredQuantity:
    """Return a parameter whose relative limits refer to ``baseline``; without one, to the nominal value."""
    ratio = baseline.value / quantity.nominal if baseline is not None and quantity.nominal else 0.0
    if baseline is None or not 0.0 < ratio < math.inf:
        return quantity
    limits = tuple(
        replace(limit, value=ratio * limit.value) if limit.is_relative else limit for limit in quantity.limits
    )
    return replace(quantity, nominal=baseline.value, limits=limits, has_baseline=True)
