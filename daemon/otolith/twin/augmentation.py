"""Augmented twins: the author's twin with component slots, augmentation inputs at its sites, and angles as states.

Settings choose the component of a slot: its family, the site it enters and the source it depends on. They are ordinary
arguments of the kernel, so one compiled kernel serves every component and nothing is compiled during a search.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

from otolith.twin.component_families import SourceKind
from otolith.twin.definition import Definition, Input, Output, Parameter, Role, Site, StateVariable
from otolith.twin.expressions import dimension_of

MAX_COMPONENTS = 3  # Component slots of an augmented twin. Engineering choice: compile time grows with each slot.
UNBOUNDED = 1e30  # bounds of parameters whose real bounds come with the component; any finite number would do
ELAPSED = "_elapsed"  # input: s since the first record; no author can write a name that begins with "_"
INTEGRAL_UNITS = {"rad/s": "rad", "m/s": "m"}


@dataclass(frozen=True, slots=True)
class ComponentSource:
    """A quantity that a component may depend on."""

    name: str
    unit: str
    kind: SourceKind
    symbol: str  # Its name in the augmented twin; empty for no quantity


@lru_cache(maxsize=64)
def sites(base: Definition) -> tuple[Site, ...]:
    """The author's sites, then one for the error of each sensor: outputs, then inputs."""
    names = [*(output.name for output in base.outputs), *(driven.name for driven in base.inputs)]
    sensors = [(name, sensor_site(name)) for name in names]
    return (
        *base.sites,
        *(Site(sensor, base.unit_of(name), f"error of the {sensor}", name, "additive") for name, sensor in sensors),
    )


def sensor_site(signal: str) -> str:
    """Return the name of the site of errors of the sensor of ``signal``."""
    return f"sensor of {signal}"


@lru_cache(maxsize=64)
def sources(base: Definition) -> tuple[ComponentSource, ...]:
    """Nothing, time, angles, inputs, states, and the outputs that are no states."""
    states = [state.name for state in base.states]
    shown: list[StateVariable | Output] = [*base.states, *(o for o in base.outputs if o.name not in states)]
    return (
        ComponentSource("", "1", SourceKind.NOTHING, ""),
        ComponentSource("t", "s", SourceKind.TIME, ELAPSED),
        *(ComponentSource(f"angle({name})", unit, SourceKind.PLACE, _angle(name)) for name, unit in _speeds(base)),
        *(ComponentSource(driven.name, driven.unit, _input_kind(driven.unit), driven.name) for driven in base.inputs),
        *(ComponentSource(quantity.name, quantity.unit, _kind(quantity.unit), quantity.name) for quantity in shown),
    )


def _input_kind(unit: str) -> SourceKind:
    """Return the kind of an input: a place that is given is an ordinary signal."""
    return SourceKind.SPEED if _integral_unit(unit) else SourceKind.SIGNAL


def _kind(unit: str) -> SourceKind:
    if unit in ("rad", "m"):
        return SourceKind.PLACE
    return SourceKind.SPEED if _integral_unit(unit) else SourceKind.SIGNAL


def _integral_unit(unit: str) -> str:
    """Return the unit of the integral of a speed; empty if ``unit`` is that of no speed."""
    for speed, integral in INTEGRAL_UNITS.items():
        # 1/s has the dimension of an angular speed too, but may be the rate of anything.
        if dimension_of(unit) == dimension_of(speed) and (speed == "m/s" or "rad" in unit or "rpm" in unit):
            return integral
    return ""


def _angle(speed: str) -> str:
    return f"_angle_{speed}"


def _speeds(base: Definition) -> list[tuple[str, str]]:
    """States that are speeds, with the unit of their integral; without those whose integral is a state already."""
    integrated = {text.strip() for left, text in base.equations if left.startswith("der(")}
    return [
        (state.name, _integral_unit(state.unit))
        for state in base.states
        if state.name not in integrated and _integral_unit(state.unit)
    ]


def augmentation_input(site: int) -> str:
    """The input that is added at a site, by the site's number."""
    return f"_enter_{site}"


def augmentation_inputs(base: Definition) -> tuple[str, ...]:
    """The augmentation inputs, in the order of the sites."""
    return tuple(augmentation_input(site) for site in range(len(sites(base))))


def component_parameters(slot: int) -> tuple[str, str, str]:
    """Amplitude, inner parameter and phase of a slot's component."""
    return f"_amplitude_{slot}", f"_inner_{slot}", f"_phase_{slot}"


def family_setting(slot: int) -> str:
    """The setting with the code of the family in a slot."""
    return f"_family_{slot}"


def shift_setting(slot: int) -> str:
    """The setting that is added to the source of a slot."""
    return f"_shift_{slot}"


def source_setting(slot: int, source: int) -> str:
    """The setting that is 1 for the source of a slot and 0 for every other, by the source's number."""
    return f"_weight_{slot}_{source}"


def site_setting(slot: int, site: int) -> str:
    """The setting that is 1 for the site of a slot and 0 for every other, by the site's number."""
    return f"_place_{slot}_{site}"


@lru_cache(maxsize=64)
def augmented_model(base: Definition) -> Definition:
    """``base`` with empty component slots, the angles of its speeds as states, and an input for each site."""
    speeds = _speeds(base)
    free: list[str] = []
    settings: list[str] = []
    for slot in range(MAX_COMPONENTS):
        free += component_parameters(slot)
        settings += [family_setting(slot), shift_setting(slot)]
        settings += [source_setting(slot, index) for index in range(1, len(sources(base)))]
        settings += [site_setting(slot, index) for index in range(len(sites(base)))]
    site_inputs = zip(augmentation_inputs(base), sites(base), strict=True)
    return replace(
        base,
        states=(*base.states, *(StateVariable(_angle(name), unit, "", 0.0, 0.0, 0.0) for name, unit in speeds)),
        inputs=(
            *base.inputs,
            Input(ELAPSED, "s", "", "foh"),
            *(Input(name, site.unit, "", "foh") for name, site in site_inputs),
        ),
        parameters=(
            *base.parameters,
            *(Parameter(name, "1", 0.0, -UNBOUNDED, UNBOUNDED, "") for name in free),
            *(Parameter(name, "1", 0.0, -UNBOUNDED, UNBOUNDED, "", Role.SETTING) for name in settings),
        ),
        equations=(*base.equations, *((f"der({_angle(name)})", name) for name, _ in speeds)),
        base=base,
    )


def positions(base: Definition) -> list[int]:
    """Return the indices of the sources that are positions and do not begin at zero in each window.

    What depends on time, or on a signal that drifts, resembles a parameter that drifts.
    """
    rows = enumerate(sources(base))
    return [at for at, source in rows if source.kind is SourceKind.PLACE and not source.symbol.startswith("_")]
