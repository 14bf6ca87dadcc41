"""How a twin is completed by components, and how they are written down (Eq. 3)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Component, Problem
from otolith.twin.augmentation import (
    ELAPSED,
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

REACH = 10.0  # times what was found: how large an amplitude may become
STRETCH = 3.0  # times what was found: how far an inner number may move
TURNS = 4.0 * np.pi  # rad: bounds of a phase, which is brought back between -pi and pi after every window


def site_of(twin: Definition, name: str) -> Site:
    """By its name; ``twin`` is the author's."""
    return next(entry for entry in sites(twin) if entry.name == name)


def source_of(twin: Definition, name: str) -> ComponentSource:
    """By its name; ``twin`` is the author's."""
    return next(entry for entry in sources(twin) if entry.name == name)


def base_model(problem: Problem) -> Definition:
    """The author's twin."""
    return problem.twin.base or problem.twin


def augment(problem: Problem, components: Sequence[Component]) -> Problem:
    """The problem with ``components`` in its twin, in addition to those it has; their numbers are free.

    Raises:
        ValueError: there are more than a twin has slots.
    """
    twin, together = base_model(problem), (*problem.components, *components)
    if len(together) > MAX_COMPONENTS:
        raise ValueError(f"{len(together)} components: a twin has {MAX_COMPONENTS} slots")
    free = [entry for entry in problem.free if not entry.name.startswith("_")]
    kept = {entry.name: entry for entry in problem.free if entry.name.startswith("_")}
    known = [entry for entry in problem.known if not entry[0].startswith("_")]
    for slot, component in enumerate(together):
        known += _settings(twin, slot, component).items()
        free += [kept.get(entry.name, entry) for entry in _numbers(twin, slot, component)]
    return replace(problem, twin=augmented_model(twin), free=tuple(free), known=tuple(known), components=together)


def without(problem: Problem, gone: Component) -> Problem:
    """The problem without one of its components."""
    rest = [entry for entry in problem.components if entry is not gone]
    bare = replace(
        problem,
        twin=base_model(problem),
        components=(),
        free=tuple(entry for entry in problem.free if not entry.name.startswith("_")),
        known=tuple(entry for entry in problem.known if not entry[0].startswith("_")),
    )
    return augment(bare, rest) if rest else bare


def _settings(twin: Definition, slot: int, component: Component) -> dict[str, float]:
    at = [entry.name for entry in sites(twin)].index(component.site)
    found = {family_setting(slot): family_code(component.family), site_setting(slot, at): 1.0}
    source = [entry.name for entry in sources(twin)].index(component.source)
    given = {component_parameters(slot)[1]: component.inner} if component.model.fixed_inner is not None else {}
    return found | given | ({source_setting(slot, source): 1.0} if source else {})


def _numbers(twin: Definition, slot: int, component: Component) -> list[Parameter]:
    """The free numbers of a component as parameters."""
    amplitude, inner, phase = component_parameters(slot)
    unit, row = site_of(twin, component.site).unit, component.model
    reach = REACH * abs(component.amplitude)
    low = 0.0 if component.repeats else -reach
    found = [Parameter(amplitude, unit, component.amplitude, low, reach, f"amplitude of {component.key}")]
    if row.inner is not None:
        unit = row.inner.unit.format(x=source_of(twin, component.source).unit)
        bounds = max(component.low, component.inner / STRETCH), min(component.high, component.inner * STRETCH)
        found.append(Parameter(inner, unit, component.inner, *bounds, f"{row.inner.meaning} of {component.key}"))
    if component.repeats:
        found.append(Parameter(phase, "rad", component.phase, -TURNS, TURNS, f"phase of {component.key}"))
    return found


def indices(problem: Problem, slot: int) -> list[int]:
    """Where in a guess the numbers of a slot are: amplitude, then inner number and phase if it has them."""
    names = [entry.name for entry in problem.free]
    return [names.index(name) for name in component_parameters(slot) if name in names]


def time_offsets(problem: Problem, window: Window) -> dict[str, float]:
    """The settings that count time from the origins of the components."""
    found = {}
    for slot, component in enumerate(problem.components):
        if component.source == "t" and not component.repeats:
            found[shift_setting(slot)] = window.start - component.origin
    return found


def input_matrix(twin: Definition, window: Window) -> Array:
    """(records, inputs) of a twin, slotted or not."""
    columns = [np.zeros((window.records, 0))]
    for entry in twin.inputs:
        if entry.name == ELAPSED:
            columns.append(window.sample_period * np.arange(window.records, dtype=np.float64)[:, None])
        elif entry.name.startswith("_"):
            columns.append(np.zeros((window.records, 1)))
        else:
            columns.append(window.column(entry.name)[:, None])
    return np.hstack(columns)


def equation(twin: Definition, component: Component, values: Sequence[float]) -> str:
    """As a person would write it, with ``values`` for amplitude, inner number and phase as far as it has them."""
    rest = [*values[1:], 0.0, 0.0]
    phase = f"{'−' if rest[1] < 0.0 else '+'} {abs(rest[1]):.2f}"
    text = component.model.equation.format(a=f"{values[0]:.4g}", b=f"{rest[0]:.4g}", c=phase, x=component.source)
    unit = site_of(twin, component.site).unit
    return text if unit == "1" else f"{text} {unit}"
