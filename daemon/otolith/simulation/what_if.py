"""What a person supposes of the machine: another value of a parameter, or a component that is not there."""

from dataclasses import replace
from numbers import Real

from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import slot_of
from otolith_drivers.errors import ConfigurationError, nearest, shown
from otolith_drivers.units import Quantity


def with_value(posterior: Posterior, name: str, written: str | float) -> Posterior:
    """Return the same with a parameter known to have a value: a number in the unit of the twin, or a text with a unit.

    Raises:
        ConfigurationError: there is no such parameter, or the value is none that it may have.
    """
    problem = posterior.problem
    free = [item.name for item in problem.free]
    parameters = {item.name: item for item in problem.base_model.parameters}
    if name not in parameters:
        raise ConfigurationError(f"the twin has no parameter {name!r}: {nearest(name, list(parameters))}")
    parameter = problem.free[free.index(name)] if name in free else parameters[name]
    if isinstance(written, bool) or not isinstance(written, str | Real):
        fault = f"{name}: {shown(written)} is no value"
        raise ConfigurationError(f"{fault}: give a number in {parameter.unit}, or a text like '5.2 {parameter.unit}'")
    text = str(written).strip()
    try:
        value = float(text)
    except ValueError:
        try:
            value = Quantity(parameter.unit)(text)
        except ValueError as error:
            raise ConfigurationError(f"{name}={text}: {error}") from error
    low, high = parameter.low, parameter.high
    if not low <= value <= high:
        bounds = f"{low:g} and {high:g} {parameter.unit}"
        remedy = "the bounds of the machine file or of the twin: write a value within them, or change them there"
        raise ConfigurationError(f"{name}={text} is out of bounds: it must lie between {bounds}, {remedy}")
    if name not in free:
        known = tuple((key, value if key == name else item) for key, item in problem.known)
        return replace(posterior, problem=replace(problem, known=known))
    index = free.index(name)
    return posterior.reset_value(index, value, 0.0).reset_value(len(free) + index, 0.0, 0.0)


def supposed_values(posterior: Posterior) -> dict[str, float]:
    """Return the free parameters that are known exactly, which only :func:`with_value` does, by name."""
    problem, belief = posterior.problem, posterior.belief
    return {
        item.name: float(belief.mean[0, index] * problem.scale[index])
        for index, item in enumerate(problem.free)
        if not belief.covariance[:, index, index].any()
    }


def without_component(posterior: Posterior, key: str) -> Posterior:
    """Return the same without a component, by its key, or by the begin of it that no other has.

    Raises:
        ConfigurationError: the twin has no such component, or several.
    """
    known = {component.key: component for component in posterior.problem.components}
    found = [name for name in known if name == key] or [name for name in known if name.startswith(f"{key}/")]
    if len(found) != 1:
        listed = ", ".join(known) or "none"
        fault = f"several components are named {key!r}" if found else f"the twin has no component {key!r}"
        hint = nearest(key, list(known)) if known and not found else f"it has: {listed}"
        raise ConfigurationError(f"{fault}: {hint}")
    slot = slot_of(posterior.problem, known[found[0]])
    assert slot is not None  # noqa: S101 - it is among the components
    return posterior.marginal_without(slot)
