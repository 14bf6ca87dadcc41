"""The candidate library of a twin: which component families may enter at which of its sites, and how large.

A component adds c·a·f to the rate of a state, c being the coefficient of its site. The equation is a balance, so that
in a window |c·a·f| is at most the sum of the magnitudes of the other terms and of the rate itself. Friction takes power
from the machine: with the friction that the twin has, it opposes the speed. ``docs/explanation/discovery.md`` has the
equations.
"""

from collections.abc import Mapping
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.problem import UNLIMITED, key_of
from otolith.twin.components import (
    COMPONENT_FAMILIES,
    ComponentFamily,
    ComponentSource,
    SourceKind,
    augmented_model,
    family_code,
    sites,
    sources,
)
from otolith.twin.definition import Definition
from otolith.twin.expressions import terms
from otolith.twin.kernel import kernel_of
from otolith.twin.rates import ordered_equations, rate_terms

SENSOR_FAMILIES = frozenset({"constant", "linear"})  # the errors of a sensor: an offset and a gain
BALANCE_MARGIN = 2.0  # times the terms of the site's equation: parameters and inputs may be off
FRICTION_SPEEDS = np.geomspace(0.02, 1.0, 12)  # of the largest speed: where friction is compared with the twin's own
TRIALS = 3  # random values of all quantities at which it is tested whether a parameter is a factor
PROBE = 1e-3  # in the unit of a site: difference that gives its coefficient; components enter linearly


class CandidateForm(NamedTuple):
    """A component without amplitude, inner parameter and phase."""

    site: int  # Index of the site
    model: ComponentFamily
    source: int  # Index of the source
    bounds: tuple[float, float] = (0.0, 0.0)  # Of the inner parameter


class CandidateTable(NamedTuple):
    """Every component that a twin could have: the bounds, and which of them a window distinguishes, depend on it."""

    shapes: tuple[tuple[ComponentFamily, int], ...]  # Each family with the index of a source
    rows: tuple[tuple[int, ComponentFamily, int, int], ...]  # Site, family, source, and index of the shape


@lru_cache(maxsize=64)
def candidate_table(base: Definition, taken: frozenset[str]) -> CandidateTable:
    """Return every component that ``base``, a twin without slots, could have, but for keys in ``taken``."""
    machine_sites = len(base.sites)
    shapes: dict[tuple[ComponentFamily, int], int] = {}
    rows = tuple(
        (index, model, number, shapes.setdefault((model, number), len(shapes)))
        for index, site in enumerate(sites(base))
        for model in COMPONENT_FAMILIES
        for number, source in enumerate(sources(base))
        if source.kind in model.inputs
        and (index < machine_sites or (site.through == "1" and _is_sensor_error(model, source, site.into)))
        and key_of(site.name, model.name, source.name) not in taken
    )
    return CandidateTable(tuple(shapes), rows)


def _is_sensor_error(model: ComponentFamily, source: ComponentSource, signal: str) -> bool:
    """Whether the form is an offset, or a gain error, of the sensor of ``signal``."""
    if model.name not in SENSOR_FAMILIES:
        return False
    return source.kind is SourceKind.NOTHING or source.name == signal


@lru_cache(maxsize=64)
def scales_a_sum(base: Definition, site: int) -> bool:
    """Whether a site scales a quantity as a whole, of which each parameter of the twin scales a part only.

    A constant there and a step of a parameter are different causes, even where the other parts happen to be zero.
    """
    if site >= len(base.sites) or base.sites[site].mode != "multiplicative":
        return False
    ordered, _ = ordered_equations(base)
    if base.sites[site].into not in dict(ordered):
        return False

    def quantity(doubled: str = "") -> Array:
        random = np.random.default_rng(0)
        values = {name: [random.uniform(0.5, 1.5, TRIALS) * (1.0 + (name == doubled))] for name in base.units()}
        for name, tree in ordered:
            values[name] = terms(tree, values)
        return np.asarray(sum(values[base.sites[site].into]))

    with np.errstate(all="ignore"):
        ratios = np.array([quantity(each.name) / quantity() for each in base.parameters])
    scales_all = np.isclose(ratios, ratios[:, :1]).all(axis=1) & ~np.isclose(ratios[:, 0], 1.0)
    return bool(np.isfinite(ratios).all()) and not scales_all.any()


class PhysicalRange:
    """The amplitudes that the equations of a twin allow in one window."""

    def __init__(self, base: Definition, x: Array, times: Array, parameters: Mapping[str, float]) -> None:
        """``base`` has no slots; ``x`` (sources, records) at ``times`` (records,), s."""
        self._base, self._x, self._times = base, x, times
        self._sources = sources(base)
        rows = {source.name: row for source, row in zip(self._sources, x, strict=True)}
        kinds = {source.name: source.kind for source in self._sources}
        self._speeds = {state.name for state in base.states if kinds[state.name] is SourceKind.SPEED}
        self._moving = [*(state.name for state in base.states), *(driven.name for driven in base.inputs)]
        self._columns = {name: rows[name] for name in self._moving}
        self._columns |= {each.name: np.array([parameters[each.name]]) for each in base.parameters}
        self._of_sites: dict[int, dict[int, Array]] = {}

    def amplitudes(self, form: CandidateForm, inner: float) -> tuple[float, float]:
        """Return the lowest and the highest amplitude of a form with that inner parameter, or ±UNLIMITED."""
        if form.site >= len(self._base.sites):
            return -UNLIMITED, UNLIMITED
        reach, low, high = UNLIMITED, -UNLIMITED, UNLIMITED
        for state, coefficient in self._coefficients_of(form.site).items():
            reach = min(reach, self._balanced(state, coefficient, form, inner))
            if form.model.dissipates and self._is_force_at_speed(state, form):
                low, high = self._dissipating(state, float(np.median(coefficient)), form, inner)
        return max(low, -reach), min(high, reach)

    def _coefficients_of(self, site: int) -> dict[int, Array]:
        """Return the states into whose rates a site enters, and its coefficients (records,) there."""
        if site not in self._of_sites:
            self._of_sites[site] = self._slopes_of(site)
        return self._of_sites[site]

    @cached_property
    def _balances(self) -> Array:
        """(3, states): the largest sum of all magnitudes in a balance, inputs observed, lowest, highest."""
        steps = np.diff(self._times)
        moved = [np.abs(np.diff(self._columns[each.name]) / steps).max(initial=0.0) for each in self._base.states]
        drives = [{}, *self._declared_inputs()]
        return np.asarray(np.array(moved) + np.array([self._largest_sums(inputs) for inputs in drives]))

    def _slopes_of(self, site: int) -> dict[int, Array]:
        more, less = (rate_terms(self._base, self._columns, site, sign * PROBE) for sign in (1.0, -1.0))
        slopes = [(a.sum(axis=0) - b.sum(axis=0)) / (2.0 * PROBE) for a, b in zip(more, less, strict=True)]
        return {state: slope for state, slope in enumerate(slopes) if slope.any()}

    def _balanced(self, state: int, coefficient: Array, form: CandidateForm, inner: float) -> float:
        """Return the largest amplitude whose effect on the rate of a state the other terms can balance."""
        effect = float(np.abs(coefficient * self._shape(form, inner, self._x[form.source])).max())
        reach = BALANCE_MARGIN * float(self._balances[0, state]) / effect if effect > 0.0 else UNLIMITED
        if not form.model.threshold_at_rest:
            return reach
        # At rest the shape is one, which the window need not show: what the inputs can move bounds it there.
        available = float(self._balances[:, state].max())
        return min(reach, BALANCE_MARGIN * available / float(np.abs(coefficient).max()))

    def _largest_sums(self, inputs: Mapping[str, Array]) -> list[float]:
        """Return for each state the largest sum of the magnitudes of the terms of its rate, with these inputs."""
        return [float(np.abs(rows).sum(axis=0).max()) for rows in rate_terms(self._base, {**self._columns, **inputs})]

    def _declared_inputs(self) -> list[dict[str, Array]]:
        """Return all inputs at the lower, then at the upper ends of their ranges."""
        ends = ("low", "high")
        return [{driven.name: np.array([getattr(driven, end)]) for driven in self._base.inputs} for end in ends]

    def _shape(self, form: CandidateForm, inner: float, x: Array) -> Array:
        """Return the magnitude (values,) of a component of unit amplitude where its source is ``x`` (values,)."""
        count = len(form.model.phases)
        codes, phases = np.full(count, family_code(form.model.name)), np.array(form.model.phases)
        first = np.zeros(count, dtype=np.int64)
        values = kernel_of(augmented_model(self._base)).curves(codes, x[None], first, np.full(count, inner), phases)
        return np.asarray(np.hypot.reduce(values, axis=1))

    def _is_force_at_speed(self, state: int, form: CandidateForm) -> bool:
        """Whether the source is the speed that the site's force accelerates: their product is a power."""
        source, site = self._sources[form.source], self._base.sites[form.site]
        name = self._base.states[state].name
        return name in self._speeds and source.name == name and site.mode == "additive"

    def _dissipating(self, state: int, coefficient: float, form: CandidateForm, inner: float) -> tuple[float, float]:
        """Return the amplitudes with which the component and the twin's own friction oppose the speed together."""
        speeds = FRICTION_SPEEDS * float(np.abs(self._columns[self._base.states[state].name]).max())
        shape = abs(coefficient) * self._shape(form, inner, speeds)
        visible = shape > 0.0
        if not visible.any():
            return -UNLIMITED, UNLIMITED
        with np.errstate(over="ignore"):  # where a narrow hump has almost vanished, it limits nothing
            driving = max(float((self._own_friction(state, speeds)[visible] / shape[visible]).min()), 0.0)
        return (-UNLIMITED, driving) if coefficient > 0.0 else (-driving, UNLIMITED)

    def _own_friction(self, state: int, speeds: Array) -> Array:
        """Return by how much the twin's own friction reduces the rate at ``speeds`` (speeds,).

        It is the odd part of the rate, as a function of this speed alone or of all speeds together: two speeds that are
        equal have no damping between them. The smaller counts.
        """
        name, odd = self._base.states[state].name, []
        rest = dict.fromkeys(self._moving, np.zeros(1))
        for moving in ({name}, self._speeds):
            forward, backward = (
                rate_terms(self._base, self._columns | rest | dict.fromkeys(moving, sign * speeds))[state].sum(axis=0)
                for sign in (1.0, -1.0)
            )
            odd.append(0.5 * (backward - forward))
        return np.asarray(np.minimum(*odd))
