"""Hypotheses that state no more than another: nothing beside the null hypothesis, or what a parameter states as well.

A voltage c·i in the armature circuit enters the equation of the current as R_a·i does: it is R_a, changed by c. No data
tell the two apart, so they are one statement, and the parameter makes it. This holds for the equations, whatever the
machine does; that a window does not tell two statements apart is another matter.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.alternatives import ALTERNATIVES
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis, names_of
from otolith.estimation.evidence import DECISIVE, SIGNIFICANT_DEVIATE
from otolith.estimation.information import QUANTILE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem, amplitude_indices, indices
from otolith.twin.definition import Definition, Input, Parameter, StateVariable
from otolith.twin.rates import right_sides

DISCRIMINATES = 4.0  # in -2 log evidence of one window: a smaller difference does not discriminate
TRIALS, MIN_TRIALS = 64, 8  # random values of states and inputs at which effects are compared; least with any effect
STEP = 1e-4  # of the width of a parameter's bounds, and of the right side for a component: what gives an effect
SAME_EFFECT = 1e-5  # of the largest effect on an equation: difference of two effects that are the same


def without_repetitions(tracked: Sequence[TrackedHypothesis], problem: Problem) -> list[TrackedHypothesis]:
    """Return the hypotheses without those whose components another states by parameters, within their bounds.

    ``problem`` is that of the filter. The other must explain the windows as well: a fit may have failed.
    """
    return [item for item in tracked if not any(_states_the_same(other, item, problem) for other in tracked)]


def prune(tracked: Sequence[TrackedHypothesis], deviances: Sequence[float]) -> list[TrackedHypothesis]:
    """Drop hypotheses that have become equal to the null hypothesis and explained the window no better.

    A window that was itself wrong may be explained by something that does not return. Quiet windows do not
    discriminate, so evidence alone would keep such a hypothesis for ever. A parameter of the null hypothesis follows a
    ramp too late: one that has moved stays as long as all windows together are decisively for it.
    """
    at = next((at for at, item in enumerate(tracked) if item.type is FaultType.NOTHING), None)
    if at is None:
        return list(tracked)
    null = tracked[at]
    return [
        item
        for item, deviance in zip(tracked, deviances, strict=True)
        if item is null
        or deviance < deviances[at] - DISCRIMINATES
        or (item.type is FaultType.PARAMETER and item.deviance < null.deviance - DECISIVE)
        or not _equals_null(item, null)
    ]


def without_insignificant(tracked: TrackedHypothesis) -> TrackedHypothesis:
    """Return the hypothesis without its weakest component, if that is not significant (the paper's "deactivated")."""
    if len(tracked.problem.components) < 2:
        return tracked
    significance = _significance(tracked.posterior)
    weakest = int(np.argmin(significance))
    if significance[weakest] >= SIGNIFICANT_DEVIATE:
        return tracked
    posterior, hypothesis = tracked.posterior.without_slot(weakest), tracked.hypothesis
    if ALTERNATIVES[hypothesis.type].names_components:
        hypothesis = replace(hypothesis, name=names_of(posterior.problem.components))
    return replace(tracked, hypothesis=hypothesis, posterior=posterior)


def _significance(posterior: Posterior) -> Array:
    """Return the amplitudes (components,) in their standard deviations."""
    prior, amplitudes = posterior.prior(), amplitude_indices(posterior.problem)
    return np.abs(prior.mean[amplitudes]) / prior.sd[amplitudes]


def _equals_null(tracked: TrackedHypothesis, null: TrackedHypothesis) -> bool:
    """Whether neither its additional components nor its delay nor its shifts of parameters are significant."""
    known, own = ([item.key for item in each.problem.components] for each in (null, tracked))
    if own[: len(known)] != known:  # it states that a component is gone
        return False
    if any(
        abs(delay) * np.sqrt(tracked.delay_information) >= SIGNIFICANT_DEVIATE for _, delay in tracked.problem.delays
    ):
        return False
    added = _significance(tracked.posterior)[len(known) :]
    return bool((added < SIGNIFICANT_DEVIATE).all() and (_shifts(tracked, null) < SIGNIFICANT_DEVIATE).all())


def _shifts(tracked: TrackedHypothesis, null: TrackedHypothesis) -> Array:
    """Return how far its parameters (parameters,) are from those of ``null``, in standard deviations."""
    own, other = tracked.posterior.prior(), null.posterior.prior()
    expected = {name: (value, 0.0) for name, value in null.problem.known}
    for at, parameter in enumerate(null.problem.free):
        expected[parameter.name] = float(other.mean[at]), float(other.covariance[at, at])
    shifts = []
    for at, parameter in enumerate(tracked.problem.free):
        if parameter.name in expected:  # others belong to a component that it adds
            value, variance = expected[parameter.name]
            shifts.append(abs(own.mean[at] - value) / np.sqrt(own.covariance[at, at] + variance))
    return np.array(shifts)


def _states_the_same(other: TrackedHypothesis, item: TrackedHypothesis, problem: Problem) -> bool:
    """Whether ``other`` states by its parameters what the components do that only ``item`` adds to ``problem``."""
    if item.type is not FaultType.COMPONENT or other.misfit > item.misfit + DECISIVE:
        return False
    own, others, known = ({each.key for each in one.components} for one in (item.problem, other.problem, problem))
    more = own - others
    if not more or more & known or not others <= own:
        return False
    values = other.posterior.prior().mean  # of parameters, then of trends
    free = {each.label for at, each in enumerate(other.problem.free) if each.low <= values[at] <= each.high}
    if other.type is FaultType.PARAMETER:
        free &= set(other.hypothesis.name.split(", "))
    elif other.type is not FaultType.COMPONENT:
        return False
    twin, slots = problem.base_model, enumerate(item.problem.components)
    likes = [parameters_like(twin, each.site, _family(item, at), each.source) for at, each in slots if each.key in more]
    return all(free.intersection(like) for like in likes)


def _family(item: TrackedHypothesis, slot: int) -> str:
    """Return the family of a component; a power whose exponent may be one is a line."""
    component, prior = item.problem.components[slot], item.posterior.prior()
    at = indices(item.problem, slot)
    is_line = component.family == "power" and abs(prior.mean[at[1]] - 1.0) <= QUANTILE * prior.sd[at[1]]
    return "linear" if is_line else component.family


@lru_cache(maxsize=1024)
def parameters_like(base: Definition, site: str, family: str, source: str) -> tuple[str, ...]:
    """Return the parameters whose changes have the effect of a component, whatever the machine does.

    ``base`` has no slots. Constants and lines are compared: other families have shapes of their own. So has the error
    of a sensor its place.
    """
    names, columns = [item.name for item in base.sites], _random_values(base)
    shapes = {"constant": np.ones(TRIALS), "linear": columns.get(source)}
    shape = shapes.get(family)
    if site not in names or shape is None:
        return ()
    own = _effect_of_component(base, columns, names.index(site), shape)
    return tuple(item.name for item in base.parameters if _are_proportional(_effect(base, columns, item), own))


def _random_values(base: Definition) -> dict[str, Array]:
    """Return values of states, inputs and outputs (trials,), and one of each parameter, within their bounds."""
    random = np.random.default_rng(0)
    moving: tuple[StateVariable | Input, ...] = (*base.states, *base.inputs)
    values = {item.name: random.uniform(item.low, item.high, TRIALS) for item in moving}
    values |= {item.name: random.uniform(item.low, item.high, 1) for item in base.parameters}
    shown = zip(base.equations, right_sides(base, values, 0, np.zeros(1)), strict=True)
    return values | {left: np.broadcast_to(row, TRIALS) for (left, _), row in shown if not left.startswith("der(")}


def _effect_of_component(base: Definition, columns: Mapping[str, Array], site: int, shape: Array) -> Array:
    """Return how the right sides (equations, trials) change with the amplitude of a ``shape`` (trials,) at a site."""
    now, one = (right_sides(base, columns, site, entering) for entering in (np.zeros(1), shape))
    entered = np.abs(one - now).max(axis=1) > 0.0
    if not entered.any():
        return np.zeros((len(now), TRIALS))
    comparable = float((np.abs(now[entered]).max(axis=1) / np.abs(one - now)[entered].max(axis=1)).min())
    steps = (sign * STEP * (comparable or 1.0) * shape for sign in (1.0, -1.0))
    return _half_difference(right_sides(base, columns, site, entering) for entering in steps)


def _effect(base: Definition, columns: Mapping[str, Array], parameter: Parameter) -> Array:
    """Return how the right sides (equations, trials) change with a parameter."""
    step, value = STEP * (parameter.high - parameter.low), columns[parameter.name]
    moved = ({**columns, parameter.name: value + sign * step} for sign in (1.0, -1.0))
    return _half_difference(right_sides(base, own, 0, np.zeros(1)) for own in moved)


def _half_difference(pair: Iterable[Array]) -> Array:
    more, less = pair
    return np.asarray(np.broadcast_to(0.5 * (more - less), (len(more), TRIALS)))


def _are_proportional(effects: Array, others: Array) -> bool:
    """Whether two effects (equations, trials) differ by a factor only, the same in all equations."""
    size = np.abs(others).max(axis=1, keepdims=True)
    entered = size[:, 0] > 0.0
    if np.count_nonzero(others[entered].any(axis=0)) < MIN_TRIALS:
        return False
    scaled = others[entered] / size[entered]
    factor = float((effects[entered] / size[entered] * scaled).sum() / (scaled**2).sum())
    largest = np.maximum(np.abs(effects).max(axis=1, keepdims=True), abs(factor) * size)
    return factor != 0.0 and bool((np.abs(effects - factor * others) <= SAME_EFFECT * largest).all())
