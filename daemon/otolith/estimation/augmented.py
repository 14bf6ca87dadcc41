"""The augmented twin: components in the slots of a twin (Eq. 3 of the paper), and their equations as text."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Window
from otolith.estimation.problem import Component, Problem
from otolith.twin.augmentation import (
    MAX_COMPONENTS,
    ComponentSource,
    augmented_model,
    component_parameters,
    family_setting,
    shift_setting,
    site_setting,
    sites,
    source_setting,
    sources,
)
from otolith.twin.component_families import family_code
from otolith.twin.definition import Definition, Parameter, Site

AMPLITUDE_BOUND = 10.0  # times the discovered amplitude
INNER_BOUND = 3.0  # times the discovered inner parameter, up and down
PHASE_BOUND = 4.0 * np.pi  # rad; every window brings the phase back between -pi and pi


def site_of(twin: Definition, name: str) -> Site:
    """Return the site of that name; ``twin`` is the base model."""
    return next(site for site in sites(twin) if site.name == name)


def source_of(twin: Definition, name: str) -> ComponentSource:
    """Return the source of that name; ``twin`` is the base model."""
    return next(source for source in sources(twin) if source.name == name)


def augment(problem: Problem, components: Sequence[Component]) -> Problem:
    """Return the problem with ``components`` added to those in its twin; their values are free parameters.

    Raises:
        ValueError: more components than the twin has slots.
    """
    twin, together = problem.base_model, (*problem.components, *components)
    if len(together) > MAX_COMPONENTS:
        raise ValueError(f"{len(together)} components: a twin has {MAX_COMPONENTS} slots")
    free = [parameter for parameter in problem.free if not parameter.name.startswith("_")]
    kept = {parameter.name: parameter for parameter in problem.free if parameter.name.startswith("_")}
    known = [pair for pair in problem.known if not pair[0].startswith("_")]
    for slot, component in enumerate(together):
        known += _settings(twin, slot, component).items()
        free += [kept.get(parameter.name, parameter) for parameter in _free_values(twin, slot, component)]
    return replace(problem, twin=augmented_model(twin), free=tuple(free), known=tuple(known), components=together)


def without(problem: Problem, removed: Component) -> Problem:
    """Return the problem without one of its components."""
    rest = [component for component in problem.components if component is not removed]
    bare = replace(
        problem,
        twin=problem.base_model,
        components=(),
        free=tuple(parameter for parameter in problem.free if not parameter.name.startswith("_")),
        known=tuple(pair for pair in problem.known if not pair[0].startswith("_")),
    )
    return augment(bare, rest) if rest else bare


def _settings(twin: Definition, slot: int, component: Component) -> dict[str, float]:
    """Return the known parameters that select family, site and source of a slot."""
    at = [site.name for site in sites(twin)].index(component.site)
    settings = {family_setting(slot): family_code(component.family), site_setting(slot, at): 1.0}
    source = [source.name for source in sources(twin)].index(component.source)
    return settings | ({source_setting(slot, source): 1.0} if source else {})


def _free_values(twin: Definition, slot: int, component: Component) -> list[Parameter]:
    """Return amplitude, inner parameter and phase as free parameters, as far as the family has them."""
    amplitude, inner, phase = component_parameters(slot)
    unit, model = site_of(twin, component.site).unit, component.model
    reach = AMPLITUDE_BOUND * abs(component.amplitude)
    low = max(0.0 if component.periodic else -reach, component.amplitude_low)
    high = min(reach, component.amplitude_high)
    values = [Parameter(amplitude, unit, component.amplitude, low, high, f"amplitude of {component.key}")]
    if model.inner is not None:
        unit = model.inner.unit.format(x=source_of(twin, component.source).unit)
        bounds = max(component.low, component.inner / INNER_BOUND), min(component.high, component.inner * INNER_BOUND)
        values.append(Parameter(inner, unit, component.inner, *bounds, f"{model.inner.meaning} of {component.key}"))
    if component.periodic:
        meaning = f"phase of {component.key}"
        values.append(Parameter(phase, "rad", component.phase, -PHASE_BOUND, PHASE_BOUND, meaning))
    return values


def indices(problem: Problem, slot: int) -> list[int]:
    """Return where the values of a slot stand among the free parameters: amplitude, inner parameter, phase."""
    names = [parameter.name for parameter in problem.free]
    return [names.index(name) for name in component_parameters(slot) if name in names]


def amplitude_indices(problem: Problem) -> list[int]:
    """Return where the amplitudes of all components stand among the free parameters."""
    return [indices(problem, slot)[0] for slot in range(len(problem.components))]


def slot_of(problem: Problem, component: Component) -> int | None:
    """Return the slot of a component, or None if the twin does not have it."""
    keys = [other.key for other in problem.components]
    return keys.index(component.key) if component.key in keys else None


def time_offsets(problem: Problem, window: Window) -> dict[str, float]:
    """Return the settings that count the time of a window from the origins of the components."""
    return {
        shift_setting(slot): window.start - component.origin
        for slot, component in enumerate(problem.components)
        if component.source == "t" and not component.periodic
    }


def equation(twin: Definition, component: Component, values: Sequence[float]) -> str:
    """Return the component as text; ``values`` are amplitude, inner parameter and phase as far as it has them."""
    rest = [*values[1:], 0.0, 0.0]
    phase = f"{'-' if rest[1] < 0.0 else '+'} {abs(rest[1]):.2f}"
    text = component.model.equation.format(a=f"{values[0]:.4g}", b=f"{rest[0]:.4g}", c=phase, x=component.source)
    text = text.replace("--", "")  # exp(--0.1·x) is exp(0.1·x)
    unit = site_of(twin, component.site).unit
    return text if unit == "1" else f"{text} {unit}"
